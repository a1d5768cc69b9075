//! A query: what is searched, what it may leave out, how it can fail and what it did. Searches nothing itself.

use std::time::Instant;

use thiserror::Error;

use crate::collision::Candidate;
use crate::gpu::GpuError;
use crate::transport::TransportError;

/// What to search.
#[derive(Clone, Copy, Debug)]
pub struct Query<'a> {
    /// Start positions, metres: x, y, z of every vertex, obstacles included.
    pub x_t0: &'a [f32],
    /// End positions, metres; the start positions again for a proximity query.
    pub x_t1: &'a [f32],
    /// Distance up to which pairs are wanted, metres: the thickness for proximity, 0 or the smallest separation for
    /// continuous collision detection.
    pub radius_m: f32,
}

/// What a search leaves out of a query's pairs.
#[derive(Clone, Copy, Debug, Default)]
pub struct Choice<'a> {
    /// Per vertex: pairs of triangles of which none has a vertex that is set here are left out. None keeps all.
    pub touched: Option<&'a [bool]>,
    /// Distance beyond which pairs within one piece may be left out, metres. None stands for the query's radius.
    pub piece_radius_m: Option<f32>,
    /// Whether pairs within one piece that are proven farther apart than that distance on the whole way may be left out, by
    /// self-collision culling. Not looked at in a search among touched vertices.
    pub cull: bool,
}

/// What may be dropped besides pairs whose boxes are apart.
#[derive(Clone, Copy, Debug)]
pub enum Filter<'a> {
    /// Nothing: the candidates of the native search.
    Boxes,
    /// Pairs proven farther apart than this on the whole way, by more than rounded closest points may be wrong.
    ByStencil {
        /// Distance of features of different pieces, metres.
        reach_m: f32,
        /// Per vertex: distance of features of one piece, metres. A vertex and a face have the vertex's, two edges the
        /// least of their ends.
        within_piece_m: &'a [f32],
    },
    /// Pairs proven farther apart than this on the whole way.
    Separation {
        /// Distance, metres.
        separation_m: f32,
    },
}

/// A search: the same on all ranks, but for the memory limit.
#[derive(Clone, Copy, Debug)]
pub struct Search<'a> {
    /// Positions and radius.
    pub query: Query<'a>,
    /// What is left out for sure.
    pub choice: Choice<'a>,
    /// What a device may drop besides. The native search does not look at it.
    pub filter: Filter<'a>,
    /// Bound of this rank's tables, bytes; None: no bound. What does not fit is searched in batches of cells, at the price of
    /// one pass over all triangles each.
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

/// What a query did on this rank. Counts repeat exactly; times do not.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BroadStats {
    /// Triangle-triangle tests of all ranks.
    pub tests_total: u64,
    /// Those of this rank.
    pub tests: u64,
    /// Buckets with at least one test, over all ranks.
    pub cells: u64,
    /// Triangle entries that this rank wrote, over all batches.
    pub entries: u64,
    /// Pairs of features that this rank reported.
    pub candidates: u64,
    /// Patches of triangles that took part, and those of the mesh, over all ranks.
    pub patches: [u64; 2],
    /// Largest number of bytes held at once: patches, counters, sums, entries, buffers. Not the mesh, not the positions.
    pub bytes: u64,
    /// Passes of fill and test.
    pub batches: u64,
    /// Time of the passes before entries are made, waiting for other ranks included.
    pub count_ns: u64,
    /// Time of the fill passes.
    pub fill_ns: u64,
    /// Time of the tests, the work on candidates included.
    pub test_ns: u64,
}

/// Why a query gave no candidates.
#[derive(Debug, Error, PartialEq)]
pub enum BroadError {
    /// Not one position per vertex.
    #[error("the {which} positions have {values} values, but {vertices} vertices need {}", 3 * vertices)]
    PositionCount {
        /// "start" or "end".
        which: &'static str,
        /// Values given.
        values: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// Not a number, infinite or absurd.
    #[error("vertex {vertex} has the {which} coordinate {value_m} m; coordinates must be finite and at most 1e18 m")]
    Position {
        /// "start" or "end".
        which: &'static str,
        /// Vertex, counting from 0.
        vertex: usize,
        /// The coordinate.
        value_m: f32,
    },
    /// Not a distance.
    #[error("the search radius is {radius_m} m; it must be finite and not negative")]
    Radius {
        /// The radius.
        radius_m: f32,
    },
    /// Not one mark per vertex.
    #[error("{values} vertices are marked as touched or not, but the mesh has {vertices} vertices")]
    TouchedCount {
        /// Marks given.
        values: usize,
        /// Vertices of the mesh.
        vertices: usize,
    },
    /// No such rank.
    #[error("rank {rank} of {ranks} ranks does not exist")]
    Rank {
        /// The rank.
        rank: usize,
        /// Number of ranks.
        ranks: usize,
    },
    /// Not even the fullest cell fits.
    #[error(
        "collision tables need {needs_bytes} bytes, more than the memory limit of {limit_bytes} bytes; raise the limit or use more workers"
    )]
    MemoryLimit {
        /// A limit that would do.
        needs_bytes: u64,
        /// The limit given.
        limit_bytes: u64,
    },
    /// The device stopped.
    #[error(transparent)]
    Device(#[from] GpuError),
    /// Another rank was not heard.
    #[error(transparent)]
    Transport(#[from] TransportError),
}

/// Time since a moment, nanoseconds; at most what 64 bits hold.
pub(in crate::collision) fn nanoseconds(since: Instant) -> u64 {
    u64::try_from(since.elapsed().as_nanos()).unwrap_or(u64::MAX)
}
