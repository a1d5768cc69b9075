//! Blackboard of one rank: small values that it alone writes and all others read without system calls.

use std::sync::atomic::{Ordering, fence};

use iceoryx2::port::reader::{EntryHandle, Reader};
use iceoryx2::port::writer::{EntryHandleMut, Writer};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::blackboard::PortFactory;

use super::node::{Ipc, service_name, text};
use crate::transport::ALL_GATHER_MAX;

/// Values that fit beside the sequence number into one cache line.
pub(super) const HEAD_VALUES: usize = 6;

/// Contribution to an all-gather: number of the operation, then the values if they are few.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[repr(C)]
pub(super) struct Head {
    /// Operation, counting from 1; 0 = none yet.
    pub sequence: u64,
    pub len: u64,
    pub values: [f64; HEAD_VALUES],
}

/// Contribution of more than [`HEAD_VALUES`] values; written before its head.
#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[repr(C)]
pub(super) struct Tail {
    pub values: [f64; ALL_GATHER_MAX],
}

const KEY_HEAD: u64 = 0;
const KEY_TAIL: u64 = 2;
const KEY_ASLEEP: u64 = 4;
const KEY_CONSUMED: u64 = 5;

/// The own blackboard.
pub(super) struct OwnCells {
    /// One slot per parity of the operation. Two suffice: operation k + 2 overwrites k, and nobody begins k + 2 before
    /// everybody has contributed to k + 1, that is, has read all of k.
    pub heads: [EntryHandleMut<Ipc, u64, Head>; 2],
    pub tails: [EntryHandleMut<Ipc, u64, Tail>; 2],
    /// Bit r is set while this rank sleeps (or is about to) until rank r does something.
    pub asleep: EntryHandleMut<Ipc, u64, u64>,
    /// Messages of each source that this rank has read and given back.
    pub consumed: Vec<EntryHandleMut<Ipc, u64, u64>>,
    _writer: Writer<Ipc, u64>,
    _service: PortFactory<Ipc, u64>,
}

impl OwnCells {
    pub(super) fn create(node: &Node<Ipc>, name: &str, ranks: usize) -> Result<OwnCells, String> {
        let mut creator = node
            .service_builder(&service_name(name)?)
            .blackboard_creator::<u64>()
            .max_readers(ranks)
            .max_nodes(ranks)
            .add(KEY_ASLEEP, 0u64);
        for slot in 0..2 {
            creator = creator.add(KEY_HEAD + slot, Head::default());
            creator = creator.add(KEY_TAIL + slot, Tail { values: [0.0; ALL_GATHER_MAX] });
        }
        for source in 0..ranks as u64 {
            creator = creator.add(KEY_CONSUMED + source, 0u64);
        }
        let service = creator.create().map_err(text("blackboard"))?;
        let writer = service.writer_builder().create().map_err(text("blackboard writer"))?;
        let entry = text("blackboard entry");
        Ok(OwnCells {
            heads: [writer.entry(&KEY_HEAD).map_err(&entry)?, writer.entry(&(KEY_HEAD + 1)).map_err(&entry)?],
            tails: [writer.entry(&KEY_TAIL).map_err(&entry)?, writer.entry(&(KEY_TAIL + 1)).map_err(&entry)?],
            asleep: writer.entry(&KEY_ASLEEP).map_err(&entry)?,
            consumed: (0..ranks as u64)
                .map(|source| writer.entry(&(KEY_CONSUMED + source)).map_err(&entry))
                .collect::<Result<_, _>>()?,
            _writer: writer,
            _service: service,
        })
    }

    /// Says for whom this rank is about to sleep (0: for nobody). A look at the awaited value must follow.
    pub(super) fn announce_sleep(&self, mask: u64) {
        self.asleep.update_with_copy(mask);
        // Pairs with the fence in `PeerCells::sleeps_for`: either the waker sees the mask or the sleeper, looking once
        // more before it sleeps, sees what the waker wrote.
        fence(Ordering::SeqCst);
    }
}

/// The blackboard of another rank.
pub(super) struct PeerCells {
    heads: [EntryHandle<Ipc, u64, Head>; 2],
    tails: [EntryHandle<Ipc, u64, Tail>; 2],
    asleep: EntryHandle<Ipc, u64, u64>,
    /// Messages of the own rank that this peer has read and given back.
    consumed: EntryHandle<Ipc, u64, u64>,
    _reader: Reader<Ipc, u64>,
    _service: PortFactory<Ipc, u64>,
}

impl PeerCells {
    pub(super) fn new(service: PortFactory<Ipc, u64>, own_rank: usize) -> Result<PeerCells, String> {
        let reader = service.reader_builder().create().map_err(text("blackboard reader"))?;
        let entry = text("blackboard entry");
        Ok(PeerCells {
            heads: [reader.entry(&KEY_HEAD).map_err(&entry)?, reader.entry(&(KEY_HEAD + 1)).map_err(&entry)?],
            tails: [reader.entry(&KEY_TAIL).map_err(&entry)?, reader.entry(&(KEY_TAIL + 1)).map_err(&entry)?],
            asleep: reader.entry(&KEY_ASLEEP).map_err(&entry)?,
            consumed: reader.entry(&(KEY_CONSUMED + own_rank as u64)).map_err(&entry)?,
            _reader: reader,
            _service: service,
        })
    }

    pub(super) fn head(&self, slot: usize) -> Head {
        *self.heads[slot].get()
    }

    /// The values of an operation whose head has been seen.
    pub(super) fn copy_values(&self, slot: usize, head: &Head, out: &mut Vec<f64>) {
        let len = (head.len as usize).min(ALL_GATHER_MAX);
        out.clear();
        if len <= HEAD_VALUES {
            out.extend_from_slice(&head.values[..len]);
        } else {
            out.extend_from_slice(&self.tails[slot].get().values[..len]);
        }
    }

    pub(super) fn consumed(&self) -> u64 {
        *self.consumed.get()
    }

    /// True if the peer sleeps for rank `rank`. Call [`before_waking`] once between the write it may wait for and this.
    pub(super) fn sleeps_for(&self, rank: usize) -> bool {
        *self.asleep.get() & (1 << rank) != 0
    }
}

/// Orders the writes that others may wait for before the look at who sleeps.
pub(super) fn before_waking() {
    fence(Ordering::SeqCst);
}
