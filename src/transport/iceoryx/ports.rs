//! The ports of the data transport: a rank's own publisher, and the ports to every other rank.

use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::cells::PeerCells;
use super::node::{Ipc, OpenError, open_when_created, service_name, text};
use crate::transport::TransportError;
use crate::transport::pattern::{BUFFERS, DEPTH};
use crate::transport::wait::Patience;

/// Header of every message.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[repr(C)]
pub(super) struct Header {
    /// Number of the exchange, counting from 0.
    pub sequence: u64,
}

pub(super) type Values = [f32];
/// A received message, in place.
pub(super) type ValueSample = iceoryx2::sample::Sample<Ipc, Values, Header>;

/// Another rank as this one sees it.
pub(super) struct Peer {
    pub cells: PeerCells,
    pub subscriber: Subscriber<Ipc, Values, Header>,
    pub notifier: Notifier<Ipc>,
    /// The next message that this rank reads, if it has been found in the list.
    pub found: Option<ValueSample>,
    /// Last observed value of this peer's counter ([`PeerCells::consumed`]).
    pub consumed: u64,
    _values: publish_subscribe::PortFactory<Ipc, Values, Header>,
    _wake: event::PortFactory<Ipc>,
}

impl Peer {
    /// Searches the message of exchange `expected` and discards older ones, which this rank does not read. Returns true
    /// if it is there (in `found`).
    pub(super) fn find(&mut self, rank: usize, source_rank: usize, expected: u64) -> Result<bool, TransportError> {
        while self.found.is_none() {
            let sample = self.subscriber.receive().map_err(|error| {
                let message = format!("receive: {error:?}");
                TransportError::Mechanism { rank, message }
            })?;
            let Some(sample) = sample else { return Ok(false) };
            self.found = Some(sample).filter(|sample| sample.user_header().sequence >= expected);
        }
        match self.found.as_ref().map_or(expected, |sample| sample.user_header().sequence) {
            got if got == expected => Ok(true),
            got => Err(TransportError::OutOfOrder { rank, source_rank, expected, got }),
        }
    }
}

/// The error of an abandoned wait for `source_rank`.
type OwnValues = (publish_subscribe::PortFactory<Ipc, Values, Header>, Publisher<Ipc, Values, Header>);

/// Name of the service of `rank` in connection `epoch`.
pub(super) fn port_name(epoch: u32, rank: usize, kind: &str) -> String {
    format!("epoch/{epoch}/rank/{rank}/{kind}")
}

/// The service of the own messages and its publisher.
pub(super) fn create_values(node: &Node<Ipc>, name: &str, ranks: usize, max_len: usize) -> Result<OwnValues, String> {
    // `payload_alignment` is not set, because it would round up the size of every single value.
    let service = node
        .service_builder(&service_name(name)?)
        .publish_subscribe::<Values>()
        .user_header::<Header>()
        .max_publishers(1)
        .max_subscribers((ranks - 1).max(1))
        .max_nodes(ranks)
        .subscriber_max_buffer_size(DEPTH)
        .subscriber_max_borrowed_samples(1)
        .history_size(0)
        // A rank that does not read a source leaves its messages in the list; newer ones displace them.
        .enable_safe_overflow(true)
        .create()
        .map_err(text("messages"))?;
    let publisher = service
        .publisher_builder()
        .initial_max_slice_len(max_len.max(1))
        .max_loaned_samples(1)
        .allocation_strategy(AllocationStrategy::Static)
        .backpressure_strategy(BackpressureStrategy::DiscardData)
        .override_sample_preallocation(|_| BUFFERS)
        .create()
        .map_err(text("publisher"))?;
    Ok((service, publisher))
}

/// Opens the ports to rank `source` as soon as they exist.
pub(super) fn open_peer(
    node: &Node<Ipc>,
    rank: usize,
    epoch: u32,
    source: usize,
    patience: &mut Patience,
) -> Result<Peer, TransportError> {
    let fail = |message: String| TransportError::Mechanism { rank, message };
    let not_opened = |error: OpenError| match error {
        OpenError::Stopped(stopped) => stopped.error(rank, source, "its start"),
        OpenError::Failed(message) => fail(format!("rank {source}: {message}")),
    };
    let name = |kind: &str| service_name(&port_name(epoch, source, kind)).map_err(fail);
    let cells_name = name("cells")?;
    let cells = open_when_created(patience, "blackboard", || {
        node.service_builder(&cells_name).blackboard_opener::<u64>().open()
    });
    let cells = PeerCells::new(cells.map_err(not_opened)?, rank).map_err(fail)?;
    let values_name = name("values")?;
    let values = open_when_created(patience, "messages", || {
        node.service_builder(&values_name).publish_subscribe::<Values>().user_header::<Header>().open()
    })
    .map_err(not_opened)?;
    let subscriber = values.subscriber_builder().buffer_size(DEPTH).create();
    let subscriber = subscriber.map_err(|error| fail(format!("subscriber: {error:?}")))?;
    let wake_name = name("wake")?;
    let wake = open_when_created(patience, "wake-up service", || node.service_builder(&wake_name).event().open())
        .map_err(not_opened)?;
    let notifier = wake.notifier_builder().create().map_err(|error| fail(format!("notifier: {error:?}")))?;
    Ok(Peer { cells, subscriber, notifier, found: None, consumed: 0, _values: values, _wake: wake })
}
