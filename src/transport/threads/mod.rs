//! A run whose workers are threads of this process: control channel, launcher and connection to the data transport
//! ([`super::InProcessTransport`]). It has no effect outside the process. A worker that never reaches a call of its
//! channel or its transport cannot be ended; its thread is left running.

mod channel;
mod launcher;

pub use channel::{ThreadCoordinator, ThreadWorker, WorkerSeat, thread_channel};
pub use launcher::{ThreadJob, ThreadLauncher};

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::connect::with_links;
use super::{Connect, Connection, InProcessTransport, Transport, TransportError};

/// Transports that ranks have yet to fetch, by the number of the connection.
type Waiting = HashMap<u32, Vec<Option<InProcessTransport>>>;

/// Connects the threads of a run. Every rank holds a clone.
#[derive(Clone, Default)]
pub struct ThreadConnect {
    waiting: Arc<Mutex<Waiting>>,
}

impl Connect for ThreadConnect {
    fn connect(&mut self, connection: Connection) -> Result<Box<dyn Transport>, TransportError> {
        let Connection { rank, ranks, epoch, max_len, deadline, on_wait, links } = connection;
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        let group =
            waiting.entry(epoch).or_insert_with(|| InProcessTransport::group(ranks).into_iter().map(Some).collect());
        let Some(mut transport) = group.get_mut(rank).and_then(Option::take) else {
            let message = format!("rank {rank} of {ranks} ranks has connected already or does not exist");
            return Err(TransportError::Mechanism { rank, message });
        };
        if group.iter().all(Option::is_none) {
            waiting.remove(&epoch);
        }
        drop(waiting);
        transport.set_deadline(deadline);
        transport.set_max_message_values(max_len);
        let mut transport = transport.with_hook(on_wait);
        transport.barrier()?;
        Ok(with_links(transport, links, deadline))
    }
}
