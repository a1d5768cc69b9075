//! Transport between processes of one machine over iceoryx2. Only this folder uses its API. [`IceoryxTransport`]
//! carries the data of steps, `control` the coordinator's messages.
//!
//! iceoryx2 provides the mechanism; three rules of this folder make a protocol of it:
//! - **Credits.** A publisher sends only while the readers of its messages have room. It knows this from a counter that
//!   each reader keeps on its blackboard. So `send` neither blocks nor drops a message that has readers, a dead reader
//!   never blocks a sender inside iceoryx2, and three buffers per publisher suffice for any number of readers
//!   (`data.rs`).
//! - **Announced sleep.** Before a rank sleeps it writes on its blackboard which ranks it waits for, and only those
//!   wake it. Rounds in which all ranks are awake cost no system call.
//! - **One purge.** All files carry the run's prefix and are removed at once after the last process has left
//!   (`RunName::purge_if_last`), because the cleanup of iceoryx2 can remove files of processes that start or stop.
//!
//! It does not work across machines, nor with processes of other users.

mod cells;
mod connect;
mod control;
mod control_worker;
mod data;
mod frame_ports;
mod node;
mod ports;

pub use connect::IceoryxConnect;
pub use control::IceoryxCoordinator;
pub use control_worker::IceoryxWorker;
pub use data::{IceoryxOptions, IceoryxTransport};
