//! Long messages in short frames, so that the data in transit stay small for any length of a message. Frames of one
//! sender arrive complete and in order; this module checks it and does not repair it.

use std::collections::VecDeque;

/// Maximum bytes of a frame. A frame is long enough that copying outweighs the cost of a hand-over, and short enough
/// that the buffers of all ranks fit into a container's 64 MiB of shared memory.
pub(super) const FRAME_MAX: usize = 256 << 10;

/// Maximum bytes of a message. A greater length is a damaged frame and must not cause an allocation.
pub(super) const MESSAGE_MAX: u64 = 64 << 30;

/// Position of a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct FrameHead {
    /// Number of this frame among those of its sender, from 0.
    pub sequence: u64,
    /// Bytes of the whole message.
    pub message_len: u64,
    /// Offset of this frame's bytes in the message.
    pub offset: u64,
}

/// Messages that wait to be sent, frame by frame.
#[derive(Debug, Default)]
pub(super) struct Outbox {
    messages: VecDeque<Vec<u8>>,
    /// Bytes of the first message that have been sent.
    offset: usize,
    /// Frames sent.
    sequence: u64,
}

impl Outbox {
    pub(super) fn push(&mut self, message: Vec<u8>) {
        self.messages.push_back(message);
    }

    /// The next frame, if there is one. It stays the next one until [`Outbox::sent`].
    pub(super) fn next(&self) -> Option<(FrameHead, &[u8])> {
        let message = self.messages.front()?;
        let end = message.len().min(self.offset + FRAME_MAX);
        let head = FrameHead { sequence: self.sequence, message_len: message.len() as u64, offset: self.offset as u64 };
        Some((head, &message[self.offset..end]))
    }

    /// Records that the frame of [`Outbox::next`] has been sent.
    pub(super) fn sent(&mut self) {
        let Some(len) = self.messages.front().map(Vec::len) else { return };
        self.sequence += 1;
        self.offset = len.min(self.offset + FRAME_MAX);
        if self.offset == len {
            self.messages.pop_front();
            self.offset = 0;
        }
    }

    pub(super) fn frames_sent(&self) -> u64 {
        self.sequence
    }

    pub(super) fn is_empty(&self) -> bool {
        self.messages.is_empty()
    }
}

/// Assembles a message from its frames.
#[derive(Debug, Default)]
pub(super) struct Inbox {
    message: Vec<u8>,
    /// Frames accepted.
    sequence: u64,
}

impl Inbox {
    /// Adds a frame; returns the message that it completes.
    pub(super) fn accept(&mut self, head: &FrameHead, bytes: &[u8]) -> Result<Option<Vec<u8>>, String> {
        let FrameHead { sequence, message_len, offset } = *head;
        let end = offset.saturating_add(bytes.len() as u64);
        let in_place = sequence == self.sequence && offset == self.message.len() as u64;
        if !in_place || end > message_len || message_len > MESSAGE_MAX || (bytes.is_empty() && message_len > 0) {
            let (expected, len) = (self.sequence, self.message.len());
            return Err(format!("{head:?} with {} bytes does not follow frame {expected} at byte {len}", bytes.len()));
        }
        self.sequence += 1;
        if offset == 0 {
            let reserved = self.message.try_reserve_exact(message_len as usize);
            reserved.map_err(|error| format!("no memory for a message of {message_len} bytes: {error}"))?;
        }
        self.message.extend_from_slice(bytes);
        Ok((end == message_len).then(|| std::mem::take(&mut self.message)))
    }

    pub(super) fn frames_accepted(&self) -> u64 {
        self.sequence
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_all_lengths_come_through() {
        let (mut outbox, mut inbox) = (Outbox::default(), Inbox::default());
        let lengths = [0, 1, FRAME_MAX - 1, FRAME_MAX, FRAME_MAX + 1, 3 * FRAME_MAX, 0, 7];
        let message = |len: usize| -> Vec<u8> { (0..len).map(|i| (i * 31 + len) as u8).collect() };
        for len in lengths {
            outbox.push(message(len));
        }
        let mut received = Vec::new();
        while let Some((head, bytes)) = outbox.next() {
            assert!(bytes.len() <= FRAME_MAX);
            received.extend(inbox.accept(&head, bytes).unwrap());
            outbox.sent();
        }
        assert!(outbox.is_empty());
        assert_eq!(received, lengths.map(message));
        assert_eq!(outbox.frames_sent(), inbox.frames_accepted());
        assert_eq!(outbox.frames_sent(), 1 + 1 + 1 + 1 + 2 + 3 + 1 + 1);
    }

    #[test]
    fn frames_out_of_place_are_refused() {
        let head = FrameHead { sequence: 0, message_len: 10, offset: 0 };
        let refused = |head: FrameHead, bytes: &[u8]| Inbox::default().accept(&head, bytes).is_err();
        assert!(refused(FrameHead { sequence: 1, ..head }, b"12345"));
        assert!(refused(FrameHead { offset: 5, ..head }, b"12345"));
        assert!(refused(head, b"12345678901"));
        assert!(refused(head, b""));
        assert!(refused(FrameHead { message_len: u64::MAX, ..head }, b"1"));
        let mut inbox = Inbox::default();
        assert_eq!(inbox.accept(&head, b"12345").unwrap(), None);
        assert!(inbox.accept(&FrameHead { sequence: 1, ..head }, b"67890").is_err());
    }
}
