//! Sub-vectors that travel in pieces: each cut into equal chunks, every chunk by a route of its own, several lanes (links)
//! into a rank at once. The fine print of schedule `best`; the work queues beside it stay whole.

/// One piece that a rank receives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Piece {
    /// Rank that hands it over; it is the owner or has received the piece before.
    pub source: usize,
    /// Sub-vector that it is a part of.
    pub vector: usize,
    /// Number of the part, from 0.
    pub chunk: usize,
    /// Pieces of one lane arrive one after the other, lanes beside each other.
    pub lane: usize,
}

/// All pieces of all ranks, in the order in which every lane receives them.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Pieces {
    /// Equal chunks per sub-vector.
    pub chunks: usize,
    /// Pieces that each rank receives, `queues[rank]`, in order.
    pub queues: Vec<Vec<Piece>>,
}

/// The first rule that pieces break.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PieceFault {
    /// A number out of range.
    #[error("rank {rank} receives a piece that names a rank or chunk that there is not: {piece:?}")]
    NoSuch {
        /// Rank that receives.
        rank: usize,
        /// The piece that it lists.
        piece: Piece,
    },
    /// The receiver owns the piece or receives it twice.
    #[error("rank {rank} receives chunk {chunk} of v{vector} although it has it already")]
    Twice {
        /// Rank that receives.
        rank: usize,
        /// Index of the sub-vector.
        vector: usize,
        /// Number of the part of the sub-vector.
        chunk: usize,
    },
    /// Some pieces do not arrive.
    #[error("rank {rank} receives {found} pieces of the {expected} that it needs")]
    Missing {
        /// Rank that receives.
        rank: usize,
        /// Pieces in its queue.
        found: usize,
        /// Pieces that make up all other sub-vectors.
        expected: usize,
    },
    /// No order of transfers lets every source hold what it hands on.
    #[error("{stuck} pieces wait for each other in a circle")]
    Circle {
        /// Number of pieces that never arrive.
        stuck: usize,
    },
}

impl Pieces {
    /// Checks that every rank receives every chunk of every other sub-vector exactly once and that the pieces can be moved
    /// in the order stated: each from a rank that holds it by then.
    pub fn check(&self) -> Result<(), PieceFault> {
        let (gpus, chunks) = (self.queues.len(), self.chunks);
        let at = |vector: usize, chunk: usize| vector * chunks + chunk;
        let mut seen = vec![vec![false; gpus * chunks]; gpus];
        for (rank, queue) in self.queues.iter().enumerate() {
            for &piece in queue {
                let Piece { source, vector, chunk, .. } = piece;
                if source >= gpus || vector >= gpus || chunk >= chunks {
                    return Err(PieceFault::NoSuch { rank, piece });
                }
                if vector == rank || std::mem::replace(&mut seen[rank][at(vector, chunk)], true) {
                    return Err(PieceFault::Twice { rank, vector, chunk });
                }
            }
            let expected = (gpus - 1) * chunks;
            if queue.len() != expected {
                return Err(PieceFault::Missing { rank, found: queue.len(), expected });
            }
        }
        self.check_order()
    }

    /// Moves pieces lane by lane as far as sources hold them.
    fn check_order(&self) -> Result<(), PieceFault> {
        let (gpus, chunks) = (self.queues.len(), self.chunks);
        let mut holds = vec![vec![false; gpus * chunks]; gpus];
        for (rank, held) in holds.iter_mut().enumerate() {
            held[rank * chunks..(rank + 1) * chunks].fill(true);
        }
        let mut waiting: Vec<Vec<Piece>> = self.queues.clone();
        loop {
            let mut moved = false;
            for rank in 0..gpus {
                let mut blocked = std::collections::BTreeSet::new();
                let mut rest = Vec::new();
                for piece in std::mem::take(&mut waiting[rank]) {
                    let item = piece.vector * chunks + piece.chunk;
                    if !blocked.contains(&piece.lane) && holds[piece.source][item] {
                        holds[rank][item] = true;
                        moved = true;
                    } else {
                        blocked.insert(piece.lane);
                        rest.push(piece);
                    }
                }
                waiting[rank] = rest;
            }
            if !moved {
                break;
            }
        }
        match waiting.iter().map(Vec::len).sum() {
            0 => Ok(()),
            stuck => Err(PieceFault::Circle { stuck }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(source: usize, vector: usize, chunk: usize) -> Piece {
        Piece { source, vector, chunk, lane: 0 }
    }

    #[test]
    fn every_broken_rule_is_named() {
        let good = Pieces {
            chunks: 2,
            queues: vec![vec![piece(1, 1, 0), piece(1, 1, 1)], vec![piece(0, 0, 1), piece(0, 0, 0)]],
        };
        assert_eq!(good.check(), Ok(()));
        let broken = |change: fn(&mut Pieces)| {
            let mut pieces = good.clone();
            change(&mut pieces);
            pieces.check().unwrap_err()
        };
        assert_eq!(broken(|p| p.queues[0][1].chunk = 0), PieceFault::Twice { rank: 0, vector: 1, chunk: 0 });
        assert_eq!(broken(|p| p.queues[0][1].vector = 0), PieceFault::Twice { rank: 0, vector: 0, chunk: 1 });
        let missing = PieceFault::Missing { rank: 1, found: 1, expected: 2 };
        assert_eq!(broken(|p| p.queues[1].truncate(1)), missing);
        assert_eq!(broken(|p| p.queues[0][0].chunk = 2), PieceFault::NoSuch { rank: 0, piece: piece(1, 1, 2) });
        // Each gets the third's chunk from the other.
        let circle = Pieces {
            chunks: 1,
            queues: vec![
                vec![piece(1, 2, 0), piece(1, 1, 0)],
                vec![piece(0, 2, 0), piece(0, 0, 0)],
                vec![piece(0, 0, 0), piece(1, 1, 0)],
            ],
        };
        assert_eq!(circle.check(), Err(PieceFault::Circle { stuck: 4 }));
    }
}
