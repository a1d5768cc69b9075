//! Connection of a worker to the data transport of its run, independent of the mechanism.

use std::time::Duration;

use super::{EmulatedTransport, Transport, TransportError, WaitHook};
use crate::interconnect::RankLinks;

/// Parameters of a connection. They are the same on all ranks, except rank, hook and links.
pub struct Connection {
    /// Own rank.
    pub rank: usize,
    /// Number of ranks.
    pub ranks: usize,
    /// Number of this connection; it increases with every connection of the run.
    pub epoch: u32,
    /// Maximum number of values of a message.
    pub max_len: usize,
    /// Longest wait of a call and of connecting.
    pub deadline: Duration,
    /// Called at least every 50 ms during a wait; returns true to give up.
    pub on_wait: WaitHook,
    /// Links to emulate; their time stamps are part of `max_len`.
    pub links: Option<RankLinks>,
}

/// Connects a worker to the transport of its run.
pub trait Connect {
    /// Connects this rank with all others; returns after every rank has connected. The transport of an earlier
    /// connection must have been dropped.
    fn connect(&mut self, connection: Connection) -> Result<Box<dyn Transport>, TransportError>;
}

/// `transport`, delayed by `links` if there are any.
pub(super) fn with_links(
    transport: impl Transport + 'static,
    links: Option<RankLinks>,
    deadline: Duration,
) -> Box<dyn Transport> {
    match links {
        Some(links) => Box::new(EmulatedTransport::new(transport, links, deadline)),
        None => Box::new(transport),
    }
}
