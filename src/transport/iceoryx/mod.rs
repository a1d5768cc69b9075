//! Processes of one machine over iceoryx2: the only folder that knows its API. [`IceoryxTransport`] carries the step's
//! data, `control` the coordinator's messages.
//!
//! iceoryx2 is used as a mechanism, not as a protocol. Three rules of ours make it one:
//! - **Credits.** A publisher sends only while those that read its messages have room, which it knows from a counter that
//!   each reader keeps on its blackboard. So `send` neither blocks nor drops what somebody reads, a dead reader never blocks
//!   a sender inside foreign code, and three buffers per publisher are enough for any number of readers (`data.rs`).
//! - **Announced sleep.** A rank that is about to sleep writes on its blackboard for whom it waits, and only those wake
//!   it: rounds in which everyone meets awake cost no system call.
//! - **Nobody cleans up piecemeal.** All files carry the run's prefix and go in one purge after the last process has
//!   left (`RunName::purge_if_last`); cleaning by iceoryx2 while others start or stop can take innocent ones down.
//!
//! It promises nothing across machines, nor to processes of other users.

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
