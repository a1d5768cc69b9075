//! How a worker joins the data transport of its run, whatever carries it.

use std::time::Duration;

use super::{EmulatedTransport, Transport, TransportError, WaitHook};
use crate::interconnect::RankLinks;

/// What a rank says when it joins; the same on all ranks, apart from rank, hook and links.
pub struct Connection {
    /// Own rank.
    pub rank: usize,
    /// Number of ranks.
    pub ranks: usize,
    /// Number of this connection; ranks that connect again count up.
    pub epoch: u32,
    /// Most values of one message.
    pub max_len: usize,
    /// Longest wait of one call, also while connecting.
    pub deadline: Duration,
    /// Called at least every 50 ms while waiting; true = give up.
    pub on_wait: WaitHook,
    /// Links that are emulated; their stamps are part of `max_len`.
    pub links: Option<RankLinks>,
}

/// A worker's way to the transport of its run.
pub trait Connect {
    /// Connects this rank with all others; returns after every rank has connected. The transport of an earlier connection
    /// must have been dropped.
    fn connect(&mut self, connection: Connection) -> Result<Box<dyn Transport>, TransportError>;
}

/// `transport`, held back as `links` say if there are any.
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
