//! Transport between the ranks of a run: the communication of steps.
//!
//! Every rank makes the same sequence of calls on its [`Transport`] (a collective program). A [`Pattern`] states which
//! rank reads which rows of which other rank in an exchange. A rank that does not read a message neither waits for it
//! nor receives it. If ranks share memory a message is written once for any number of readers; a transport between
//! machines would send every reader its rows.
//!
//! Implementations: processes ([`IceoryxTransport`]), threads ([`InProcessTransport`]), one rank ([`SoloTransport`]),
//! two wrappers for tests, one wrapper that delays messages as the links of another machine would
//! ([`EmulatedTransport`]) and one that records waits ([`TracedTransport`]).
//!
//! The module also has the control channel between coordinator and workers ([`ControlCoordinator`], [`ControlWorker`],
//! [`encode`]), the start and end of workers ([`Launcher`]), their connection to the transport ([`Connect`]), the
//! resources of their machine ([`Machine`]), and the files of a run on the machine ([`RunName`]). Two mechanisms
//! implement all of them: processes joined by shared memory (`iceoryx`, [`ProcessLauncher`]) and threads of one process
//! (`threads`). Linux only.

mod collective;
mod connect;
mod control;
mod data;
mod descriptors;
mod emulated;
mod error;
mod faulty;
mod frames;
mod iceoryx;
mod in_process;
mod launcher;
mod machine;
mod message;
#[cfg(feature = "mpi")]
mod mpi;
mod pattern;
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
mod world;

pub use collective::{gather_lists, share_lists, share_positions, share_ranges};
pub use connect::{Connect, Connection};
pub use control::{ControlCoordinator, ControlError, ControlWorker, Heartbeat, Silence};
pub use data::Transport;
pub use descriptors::{TooFewDescriptors, check_descriptors, required_descriptors};
pub use emulated::{EmulatedTransport, STAMP_VALUES};
pub use error::{ALL_GATHER_MAX, TransportError};
pub use faulty::{Fault, FaultyTransport};
pub use iceoryx::{IceoryxConnect, IceoryxCoordinator, IceoryxOptions, IceoryxTransport, IceoryxWorker};
pub use in_process::{InProcessTransport, SendHook};
pub use launcher::{Launcher, Life};
pub use machine::{Machine, MachineError, OneProcess, RANKS_MAX, SharedMemoryMachine, cores};
pub use message::{MessageError, decode, encode, items_of};
#[cfg(feature = "mpi")]
pub use mpi::{Inside, Membership, MpiWorld, Serve};
pub use pattern::{Counts, Message, Neighbor, Pattern, Rows};
pub use process::{ProcessWatch, share_cores, start_ticks};
pub use process_launcher::{ProcessLauncher, WorkerCommand, worker_role};
pub use recording::{Action, Record, RecordingTransport};
pub use run_name::{
    FoundRun, Member, RunError, RunMember, RunName, RunState, SHARED_MEMORY_FOLDER, list_runs, remove_dead_runs,
};
pub use shared_memory::{
    SetupTurn, SharedMemoryError, check_shared_memory, required_shared_memory_bytes, shared_memory_is_read_only,
    shared_memory_space,
};
pub use solo::SoloTransport;
pub use threads::{
    ThreadConnect, ThreadCoordinator, ThreadJob, ThreadLauncher, ThreadWorker, WorkerSeat, thread_channel,
};
pub use traced::TracedTransport;
pub use wait::{HOOK_INTERVAL, WaitHook};
pub use world::{MeasuredLink, MeasuredWorld, World, WorldCrew};
