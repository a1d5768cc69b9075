//! A query: what is searched, what it may leave out, how it can fail and what it did. Searches nothing itself.

use std::time::Instant;

use thiserror::Error;

use crate::collision::Candidate;
use crate::gpu::GpuError;
use crate::transport::TransportError;

/// Positions over a step and the distance up to which pairs of features are wanted.
#[derive(Clone, Copy, Debug)]
pub struct Query<'a> {
    /// Start positions, meters: x, y, z of every vertex, obstacles included.
    pub x_t0: &'a [f32],
    /// End positions, meters; the start positions again for a proximity query.
    pub x_t1: &'a [f32],
    /// Distance up to which pairs are wanted, meters: the thickness for proximity, 0 or the smallest separation for
    /// continuous collision detection.
    pub radius_m: f32,
}

/// Pairs of a query that a search leaves out.
#[derive(Clone, Copy, Debug, Default)]
pub struct Choice<'a> {
    /// Per vertex: pairs of triangles of which none has a vertex that is set here are left out. None keeps all.
    pub touched: Option<&'a [bool]>,
    /// Distance beyond which pairs within one piece may be left out, meters. None stands for the query's radius.
    pub piece_radius_m: Option<f32>,
    /// True if pairs within one piece that are proven farther apart than that distance on the whole way may be left
    /// out, by self-collision culling. Not looked at in a search among touched vertices.
    pub cull: bool,
}

/// Pairs with overlapping boxes that a device may drop.
#[derive(Clone, Copy, Debug)]
pub enum Filter<'a> {
    /// Nothing: the candidates of the native search.
    Boxes,
    /// Pairs proven farther apart than this on the whole way, by more than the error of rounded closest points.
    ByPair {
        /// Distance of features of different pieces, meters.
        reach_m: f32,
        /// Per vertex: distance of features of one piece, meters. A vertex and a face have the vertex's, two edges the
        /// least of their ends.
        within_piece_m: &'a [f32],
    },
    /// Pairs proven farther apart than this on the whole way.
    Separation {
        /// The separation of continuous detection, meters.
        separation_m: f32,
    },
}

/// A search: the same on all ranks, but for the memory limit.
#[derive(Clone, Copy, Debug)]
pub struct Search<'a> {
    /// What to search.
    pub query: Query<'a>,
    /// What is left out on every executor.
    pub choice: Choice<'a>,
    /// What a device may drop besides. The native search ignores it.
    pub filter: Filter<'a>,
    /// Bound of this rank's tables, bytes; None: no bound. What does not fit is searched in batches of cells, at the
    /// price of one pass over all triangles each.
    pub memory_limit_bytes: Option<u64>,
}

impl<'a> Search<'a> {
    /// All pairs of a query, without a memory limit.
    pub fn all(query: Query<'a>) -> Search<'a> {
        Search { query, choice: Choice::default(), filter: Filter::Boxes, memory_limit_bytes: None }
    }
}

/// Takes the candidates that one thread finds.
pub trait Sink: Send {
    /// Takes candidates; called again and again with at most a few thousand.
    fn take(&mut self, found: &[Candidate]);
}

/// Counts, times and memory of one search on this rank. Counts repeat exactly; times do not.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BroadStats {
    /// Triangle-triangle tests of all ranks.
    pub tests_total: u64,
    /// Triangle-triangle tests of this rank.
    pub tests: u64,
    /// Buckets with at least one test, over all ranks.
    pub cells: u64,
    /// Triangle entries that this rank wrote, over all batches.
    pub entries: u64,
    /// Pairs of features that this rank reported.
    pub candidates: u64,
    /// Patches of triangles that took part, and those of the mesh, over all ranks.
    pub patches: [u64; 2],
    /// Largest number of bytes held at once: patches, counters, sums, entries, buffers. Not the mesh, not the
    /// positions.
    pub bytes: u64,
    /// Passes of fill and test.
    pub batches: u64,
    /// Time of the passes before entries are made, nanoseconds, waiting for other ranks included.
    pub count_ns: u64,
    /// Time of the fill passes, nanoseconds.
    pub fill_ns: u64,
    /// Time of the tests, nanoseconds, the work on candidates included.
    pub test_ns: u64,
}

/// Why a query gave no candidates.
#[derive(Debug, Error, PartialEq)]
pub enum BroadError {
    /// There is not one position per vertex.
    #[error("the {which} positions have {values} values, but {vertices} vertices need {}", 3 * vertices)]
    PositionCount {
        /// "start" or "end".
        which: &'static str,
        /// Length of the list.
        values: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// A coordinate is NaN, infinite or absurdly large.
    #[error("vertex {vertex} has the {which} coordinate {value_m} m; coordinates must be finite and at most 1e18 m")]
    Position {
        /// "start" or "end".
        which: &'static str,
        /// Vertex, counting from 0.
        vertex: usize,
        /// The coordinate, meters.
        value_m: f32,
    },
    /// The radius is negative, NaN or infinite.
    #[error("the search radius is {radius_m} m; it must be finite and not negative")]
    Radius {
        /// The radius, meters.
        radius_m: f32,
    },
    /// There is not one mark per vertex.
    #[error("{values} vertices are marked as touched or not, but the mesh has {vertices} vertices")]
    TouchedCount {
        /// Number of marks.
        values: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// The rank is not below the number of ranks.
    #[error("rank {rank} of {ranks} ranks does not exist")]
    Rank {
        /// Rank that was asked for.
        rank: usize,
        /// Number of ranks.
        ranks: usize,
    },
    /// The counters and the fullest cell do not fit the limit.
    #[error(
        "collision tables need {needs_bytes} bytes, more than the memory limit of {limit_bytes} bytes; raise the limit or use more workers"
    )]
    MemoryLimit {
        /// A limit that suffices, bytes.
        needs_bytes: u64,
        /// The limit that was set, bytes.
        limit_bytes: u64,
    },
    /// The device stopped during the search.
    #[error(transparent)]
    Device(#[from] GpuError),
    /// Another rank did not answer.
    #[error(transparent)]
    Transport(#[from] TransportError),
}

/// Time since a moment, nanoseconds; at most what 64 bits hold.
pub(in crate::collision) fn nanoseconds(since: Instant) -> u64 {
    u64::try_from(since.elapsed().as_nanos()).unwrap_or(u64::MAX)
}
