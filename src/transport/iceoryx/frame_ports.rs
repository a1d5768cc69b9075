//! The two ends of a stream of frames between two processes: at most [`FRAME_MAX`] bytes per frame.

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::service::builder::publish_subscribe::Builder;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::node::{Ipc, text};
use crate::transport::frames::{FRAME_MAX, FrameHead, Inbox, Outbox};
use crate::transport::pattern::{BUFFERS, DEPTH};

/// A [`FrameHead`] in shared memory.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[repr(C)]
pub(super) struct Header {
    sequence: u64,
    message_len: u64,
    offset: u64,
}

pub(super) type FrameService = PortFactory<Ipc, [u8], Header>;

fn builder(node: &Node<Ipc>, name: &ServiceName) -> Builder<[u8], Header, Ipc> {
    node.service_builder(name).publish_subscribe::<[u8]>().user_header::<Header>()
}

/// Creates the stream's service; both ends open ports on it.
pub(super) fn create_stream(node: &Node<Ipc>, name: &ServiceName) -> Result<FrameService, String> {
    builder(node, name)
        .max_publishers(1)
        .max_subscribers(1)
        .max_nodes(2)
        .subscriber_max_buffer_size(DEPTH)
        .subscriber_max_borrowed_samples(1)
        .history_size(0)
        .enable_safe_overflow(false)
        .create()
        .map_err(text("control stream"))
}

/// Opens the stream's service at its other end.
pub(super) fn open_stream(
    node: &Node<Ipc>,
    name: &ServiceName,
) -> Result<FrameService, iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError> {
    builder(node, name).open()
}

/// Sending end.
pub(super) struct FrameSender {
    publisher: Publisher<Ipc, [u8], Header>,
    pub(super) outbox: Outbox,
}

impl FrameSender {
    pub(super) fn new(service: &FrameService) -> Result<FrameSender, String> {
        let publisher = service
            .publisher_builder()
            .initial_max_slice_len(FRAME_MAX)
            .max_loaned_samples(1)
            .allocation_strategy(AllocationStrategy::Static)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .override_sample_preallocation(|_| BUFFERS)
            .create()
            .map_err(text("control publisher"))?;
        Ok(FrameSender { publisher, outbox: Outbox::default() })
    }

    /// Sends frames while the reader, which has released `consumed` of them, has room; never waits. Returns true if it
    /// sent a frame, so that the caller should wake the reader.
    pub(super) fn pump(&mut self, consumed: u64) -> Result<bool, String> {
        let before = self.outbox.frames_sent();
        while let Some((head, bytes)) = self.outbox.next() {
            if self.outbox.frames_sent().saturating_sub(consumed) >= DEPTH as u64 {
                break;
            }
            let mut sample = self.publisher.loan_slice_uninit(bytes.len()).map_err(text("control buffer"))?;
            let FrameHead { sequence, message_len, offset } = head;
            *sample.user_header_mut() = Header { sequence, message_len, offset };
            // Without a reader the frame stays the next one.
            if sample.write_from_slice(bytes).send().map_err(text("control send"))? == 0 {
                break;
            }
            self.outbox.sent();
        }
        Ok(self.outbox.frames_sent() > before)
    }
}

/// Receiving end.
pub(super) struct FrameReceiver {
    subscriber: Subscriber<Ipc, [u8], Header>,
    inbox: Inbox,
}

impl FrameReceiver {
    pub(super) fn new(service: &FrameService) -> Result<FrameReceiver, String> {
        let subscriber =
            service.subscriber_builder().buffer_size(DEPTH).create().map_err(text("control subscriber"))?;
        Ok(FrameReceiver { subscriber, inbox: Inbox::default() })
    }

    /// Receives one frame if there is one: `None` if not, otherwise the message that it completed, if any. The caller
    /// must then tell the sender that [`FrameReceiver::consumed`] has grown.
    pub(super) fn take(&mut self) -> Result<Option<Option<Vec<u8>>>, String> {
        let Some(sample) = self.subscriber.receive().map_err(text("control receive"))? else { return Ok(None) };
        let Header { sequence, message_len, offset } = *sample.user_header();
        self.inbox.accept(&FrameHead { sequence, message_len, offset }, sample.payload()).map(Some)
    }

    /// Number of frames received.
    pub(super) fn consumed(&self) -> u64 {
        self.inbox.frames_accepted()
    }
}
