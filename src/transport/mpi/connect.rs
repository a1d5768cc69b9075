//! Connection of the workers of a crew to each other.

use super::data::{MpiOptions, MpiTransport};
use super::library::Library;
use crate::transport::connect::with_links;
use crate::transport::{Connect, Connection, Transport, TransportError};

/// Connections of a crew that have tags of their own; crews follow each other in steps of this number.
const CONNECTIONS_OF_CREW: u32 = 16;

/// Connects the workers of a crew.
pub(super) struct MpiConnect {
    pub library: Library,
    /// Number of the crew.
    pub crew: u32,
    /// Process of worker 0.
    pub first: usize,
    /// By process: lowest process of its host.
    pub hosts: Vec<usize>,
}

impl Connect for MpiConnect {
    fn connect(&mut self, connection: Connection) -> Result<Box<dyn Transport>, TransportError> {
        let Connection { rank, ranks, epoch, max_len, deadline, on_wait, links } = connection;
        let processes: Vec<usize> = (self.first..self.first + ranks).collect();
        let own_host = self.hosts[self.first + rank];
        let sharing = self.hosts.iter().filter(|&&host| host == own_host).count();
        let connection = self.crew * CONNECTIONS_OF_CREW + epoch % CONNECTIONS_OF_CREW;
        let options = MpiOptions { rank, processes, connection, max_len, deadline, sharing, on_wait };
        Ok(with_links(MpiTransport::connect(&self.library, options)?, links, deadline))
    }
}
