//! Blackboard of one rank: small values that only this rank writes and all others read without system calls.

use std::sync::atomic::{Ordering, fence};

use iceoryx2::port::reader::{EntryHandle, Reader};
use iceoryx2::port::writer::{EntryHandleMut, Writer};
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::blackboard::PortFactory;

use super::node::{Ipc, service_name, text};
use crate::transport::{ALL_GATHER_MAX, RANKS_MAX};

/// Values that fit into one cache line with the sequence number.
pub(super) const HEAD_VALUES: usize = 6;

/// Contribution to an all-gather: number of the operation, then the values if they fit.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[repr(C)]
pub(super) struct Head {
    /// Operation, counting from 1; 0 = none yet.
    pub sequence: u64,
    pub len: u64,
    pub values: [f64; HEAD_VALUES],
}

/// Values of one piece of a tail. A cell is always copied whole, so pieces are small; a dot product of many ranks fits
/// into one piece.
const PIECE: usize = 64;
const PIECES: usize = ALL_GATHER_MAX.div_ceil(PIECE);

/// Piece of a contribution of more than [`HEAD_VALUES`] values; written before its head.
#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[repr(C)]
pub(super) struct Tail {
    values: [f64; PIECE],
}

const KEY_HEAD: u64 = 0;
const KEY_ASLEEP: u64 = 4;
/// Of source 0; the others follow.
const KEY_CONSUMED: u64 = 5;
/// Of piece 0 in slot 0; slots alternate.
const KEY_TAIL: u64 = KEY_CONSUMED + RANKS_MAX as u64;

pub(super) struct OwnCells {
    /// One slot per parity of the operation. Two suffice: operation k + 2 overwrites k, and no rank begins k + 2 before
    /// all ranks have contributed to k + 1, that is, have read all of k.
    heads: [EntryHandleMut<Ipc, u64, Head>; 2],
    tails: [Vec<EntryHandleMut<Ipc, u64, Tail>>; 2],
    /// r + 1 while this rank sleeps (or is about to) until rank r acts; 0 = awake.
    pub asleep: EntryHandleMut<Ipc, u64, u64>,
    /// By source: one more than the number of the last exchange whose message this rank has read and released; 0 =
    /// none.
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
            for piece in 0..PIECES as u64 {
                creator = creator.add(KEY_TAIL + 2 * piece + slot, Tail { values: [0.0; PIECE] });
            }
        }
        for source in 0..ranks as u64 {
            creator = creator.add(KEY_CONSUMED + source, 0u64);
        }
        let service = creator.create().map_err(text("blackboard"))?;
        let writer = service.writer_builder().create().map_err(text("blackboard writer"))?;
        let entry = text("blackboard entry");
        let tail = |slot: u64| {
            (0..PIECES as u64)
                .map(|piece| writer.entry(&(KEY_TAIL + 2 * piece + slot)).map_err(&entry))
                .collect::<Result<Vec<_>, String>>()
        };
        Ok(OwnCells {
            heads: [writer.entry(&KEY_HEAD).map_err(&entry)?, writer.entry(&(KEY_HEAD + 1)).map_err(&entry)?],
            tails: [tail(0)?, tail(1)?],
            asleep: writer.entry(&KEY_ASLEEP).map_err(&entry)?,
            consumed: (0..ranks as u64)
                .map(|source| writer.entry(&(KEY_CONSUMED + source)).map_err(&entry))
                .collect::<Result<_, _>>()?,
            _writer: writer,
            _service: service,
        })
    }

    /// Writes a contribution to an all-gather: first the values that exceed the head, then the head.
    pub(super) fn contribute(&self, slot: usize, sequence: u64, own: &[f64]) {
        let mut head = Head { sequence, len: own.len() as u64, values: [0.0; HEAD_VALUES] };
        if own.len() <= HEAD_VALUES {
            head.values[..own.len()].copy_from_slice(own);
        } else {
            for (part, cell) in own.chunks(PIECE).zip(&self.tails[slot]) {
                let mut piece = Tail { values: [0.0; PIECE] };
                piece.values[..part.len()].copy_from_slice(part);
                cell.update_with_copy(piece);
            }
        }
        self.heads[slot].update_with_copy(head);
    }

    /// Publishes that this rank is about to sleep until rank `source` acts. The caller must then check the awaited
    /// value once more.
    pub(super) fn announce_sleep(&self, source: usize) {
        self.asleep.update_with_copy(source as u64 + 1);
        // Pairs with the fence in `PeerCells::sleeps_for`: either the waker sees the number, or the sleeper, which
        // looks once more before it sleeps, sees the value that the waker wrote.
        fence(Ordering::SeqCst);
    }
}

pub(super) struct PeerCells {
    heads: [EntryHandle<Ipc, u64, Head>; 2],
    tails: [Vec<EntryHandle<Ipc, u64, Tail>>; 2],
    asleep: EntryHandle<Ipc, u64, u64>,
    /// One more than the number of the last exchange in which this peer has read the own rank's message; 0 = none.
    consumed: EntryHandle<Ipc, u64, u64>,
    _reader: Reader<Ipc, u64>,
    _service: PortFactory<Ipc, u64>,
}

impl PeerCells {
    pub(super) fn new(service: PortFactory<Ipc, u64>, own_rank: usize) -> Result<PeerCells, String> {
        let reader = service.reader_builder().create().map_err(text("blackboard reader"))?;
        let entry = text("blackboard entry");
        let tail = |slot: u64| {
            (0..PIECES as u64)
                .map(|piece| reader.entry(&(KEY_TAIL + 2 * piece + slot)).map_err(&entry))
                .collect::<Result<Vec<_>, String>>()
        };
        Ok(PeerCells {
            heads: [reader.entry(&KEY_HEAD).map_err(&entry)?, reader.entry(&(KEY_HEAD + 1)).map_err(&entry)?],
            tails: [tail(0)?, tail(1)?],
            asleep: reader.entry(&KEY_ASLEEP).map_err(&entry)?,
            consumed: reader.entry(&(KEY_CONSUMED + own_rank as u64)).map_err(&entry)?,
            _reader: reader,
            _service: service,
        })
    }

    pub(super) fn head(&self, slot: usize) -> Head {
        *self.heads[slot].get()
    }

    /// The values of an operation whose head has been read.
    pub(super) fn copy_values(&self, slot: usize, head: &Head, out: &mut Vec<f64>) {
        let len = (head.len as usize).min(ALL_GATHER_MAX);
        out.clear();
        if len <= HEAD_VALUES {
            out.extend_from_slice(&head.values[..len]);
        } else {
            for (piece, start) in self.tails[slot].iter().zip((0..len).step_by(PIECE)) {
                out.extend_from_slice(&piece.get().values[..(len - start).min(PIECE)]);
            }
        }
    }

    pub(super) fn consumed(&self) -> u64 {
        *self.consumed.get()
    }

    /// True if the peer sleeps for rank `rank`. Call [`before_waking`] once between the write that it may wait for and
    /// this.
    pub(super) fn sleeps_for(&self, rank: usize) -> bool {
        *self.asleep.get() == rank as u64 + 1
    }
}

/// Orders the writes that others may wait for before the check for sleeping ranks.
pub(super) fn before_waking() {
    fence(Ordering::SeqCst);
}
