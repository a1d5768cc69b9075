//! Transport between the ranks of a run: what a step needs from the interconnect, and nothing else.
//!
//! Every rank makes the same sequence of calls on its transport (a collective program); messages of one source arrive in
//! the order in which they were published. At any point of that sequence at most two messages of a source may be published
//! and not yet received by everybody: then nobody ever waits in a circle. Implementations: processes ([`IceoryxTransport`]),
//! threads ([`InProcessTransport`]), two wrappers for tests, one that holds messages back as the links of
//! another machine would ([`EmulatedTransport`]) and one that records waits ([`TracedTransport`]).
//!
//! Beside it: the control channel between coordinator and workers ([`ControlCoordinator`], [`ControlWorker`], [`encode`]),
//! where workers come from ([`Launcher`]), how they join the transport ([`Connect`]), what their place offers ([`Machine`]), and
//! what a run takes of the machine and leaves behind ([`RunName`]). Two mechanisms implement all of them: processes joined by
//! shared memory (`iceoryx`, [`ProcessLauncher`]) and threads of one process (`threads`). Linux only.

mod collective;
mod connect;
mod control;
mod descriptors;
mod emulated;
mod faulty;
mod frames;
mod iceoryx;
mod in_process;
mod launcher;
mod machine;
mod message;
mod process;
mod process_launcher;
mod recording;
mod run_lock;
mod run_name;
mod shared_memory;
mod solo;
mod threads;
mod traced;
mod wait;

pub use collective::{share_lists, share_ranges};
pub use connect::{Connect, Connection};
pub use control::{ControlCoordinator, ControlError, ControlWorker, Heartbeat, Silence};
pub use descriptors::{TooFewDescriptors, check_descriptors, required_descriptors};
pub use emulated::{EmulatedTransport, STAMP_VALUES};
pub use faulty::{Fault, FaultyTransport};
pub use iceoryx::{IceoryxConnect, IceoryxCoordinator, IceoryxOptions, IceoryxTransport, IceoryxWorker};
pub use in_process::{InProcessTransport, SendHook};
pub use launcher::{Launcher, Life};
pub use machine::{Machine, MachineError, OneProcess, RANKS_MAX, SharedMemoryMachine, cores};
pub use message::{MessageError, decode, encode, items_of};
pub use process::{ProcessWatch, share_cores, start_ticks};
pub use process_launcher::{ProcessLauncher, WorkerCommand, worker_role};
pub use recording::{Action, Record, RecordingTransport};
pub use run_name::{
    FoundRun, Member, RunError, RunMember, RunName, RunState, SHARED_MEMORY_FOLDER, list_runs, remove_dead_runs,
};
pub use shared_memory::{SharedMemoryError, check_shared_memory, required_shared_memory_bytes, shared_memory_space};
pub use solo::SoloTransport;
pub use threads::{
    ThreadConnect, ThreadCoordinator, ThreadJob, ThreadLauncher, ThreadWorker, WorkerSeat, thread_channel,
};
pub use traced::TracedTransport;
pub use wait::{HOOK_INTERVAL, WaitHook};

use thiserror::Error;

/// Why a transport call failed. All of them end the run of this rank.
#[derive(Debug, Error, PartialEq)]
pub enum TransportError {
    /// No message within the deadline.
    #[error("rank {rank} waited {waited_s:.1} s for rank {source_rank} ({what})")]
    TimedOut { rank: usize, source_rank: usize, what: &'static str, waited_s: f64 },
    /// The run was told to stop while waiting (a peer died or the user asked for it).
    #[error("rank {rank} was told to stop while waiting for rank {source_rank} ({what})")]
    Aborted { rank: usize, source_rank: usize, what: &'static str },
    /// A message arrived that the program did not expect here.
    #[error("rank {rank} expected message {expected} of rank {source_rank} and got {got}")]
    OutOfOrder { rank: usize, source_rank: usize, expected: u64, got: u64 },
    /// The mechanism below failed.
    #[error("transport of rank {rank}: {message}")]
    Mechanism { rank: usize, message: String },
}

/// Most values that one rank may contribute to [`Transport::all_gather`].
pub const ALL_GATHER_MAX: usize = 2048;

/// One rank's connection to all others.
pub trait Transport {
    /// Own rank.
    fn rank(&self) -> usize;
    /// Number of ranks.
    fn ranks(&self) -> usize;
    /// Makes `len` values readable by every other rank. `fill` writes them in place (the buffer holds unspecified values).
    /// Returns as soon as the message is handed over; blocks only while a slow reader holds all buffers.
    fn publish(&mut self, len: usize, fill: &mut dyn FnMut(&mut [f32])) -> Result<(), TransportError>;
    /// Waits for the next message of `source` and shows it to `read` in place. Every published message must be
    /// received by every other rank exactly once, also when it holds nothing of interest.
    fn receive(&mut self, source: usize, read: &mut dyn FnMut(&[f32])) -> Result<(), TransportError>;
    /// True if a message of `source` can be received without waiting.
    fn ready(&mut self, source: usize) -> bool;
    /// Waits until a message of `source` can be received; lets a trace tell waiting from reading.
    fn wait(&mut self, source: usize) -> Result<(), TransportError>;
    /// Gathers up to [`ALL_GATHER_MAX`] values of every rank: `out[r]` = what rank r contributed (the own rank too).
    /// One latency; this is what an all-reduce is built on (`solver::reduction` adds in a fixed order).
    fn all_gather(&mut self, own: &[f64], out: &mut Vec<Vec<f64>>) -> Result<(), TransportError>;
    /// Says that `bytes` bytes of halo rows will be read of the next message of `source`. Only those would travel where
    /// ranks do not share memory; a transport that emulates links wants to know.
    fn expect_halo(&mut self, _source: usize, _bytes: u64) {}
    /// A sign of life between two calls that may wait, for long stretches of work: gives the run's hook its turn.
    fn alive(&mut self) -> Result<(), TransportError> {
        Ok(())
    }
    /// Returns after every rank has called it.
    fn barrier(&mut self) -> Result<(), TransportError> {
        let mut out = Vec::new();
        self.all_gather(&[], &mut out)
    }
    /// Most values that a message may hold.
    fn max_message_values(&self) -> usize;
    /// Bytes of all messages published so far (counted once each, however many ranks read them).
    fn bytes_published(&self) -> u64;
    /// Bytes of all messages received so far.
    fn bytes_received(&self) -> u64;
}
