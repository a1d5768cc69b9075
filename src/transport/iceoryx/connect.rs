//! Connection of a worker process to the other ranks.

use crate::transport::connect::with_links;
use crate::transport::{Connect, Connection, IceoryxOptions, IceoryxTransport, RunName, Transport, TransportError};

/// Connects the processes of a run over shared memory.
pub struct IceoryxConnect {
    run: RunName,
}

impl IceoryxConnect {
    /// Connects the ranks of `run`.
    pub fn new(run: &RunName) -> IceoryxConnect {
        IceoryxConnect { run: run.clone() }
    }
}

impl Connect for IceoryxConnect {
    fn connect(&mut self, connection: Connection) -> Result<Box<dyn Transport>, TransportError> {
        let Connection { rank, ranks, epoch, max_len, deadline, on_wait, links } = connection;
        let options = IceoryxOptions { rank, ranks, epoch, max_len, deadline, on_wait };
        Ok(with_links(IceoryxTransport::connect(&self.run, options)?, links, deadline))
    }
}
