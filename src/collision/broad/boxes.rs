//! Swept, inflated boxes of features. If two features come within the query's radius of each other (in exact arithmetic,
//! at any common time between start and end), their boxes overlap; the reverse is not promised.

use glam::Vec3A;

use super::mesh::CollisionMesh;
use super::query::{BroadError, Choice, Query};

/// Relative widening of every bound: more than the rounding of a few f32 operations on the coordinates, so that a test
/// that decides with rounded numbers is still handed the pair.
const SLACK: f32 = 1.0 / (1 << 21) as f32;
/// Largest coordinate, meters; beyond it squares leave f32.
const MOST_M: f32 = 1e18;

/// An axis-aligned box; empty if a lower bound exceeds the upper one.
#[derive(Clone, Copy, Debug)]
pub(super) struct Aabb {
    pub lo: Vec3A,
    pub hi: Vec3A,
}

impl Aabb {
    /// Overlaps nothing; neutral for [`Aabb::join`].
    pub(super) const EMPTY: Aabb = Aabb { lo: Vec3A::INFINITY, hi: Vec3A::NEG_INFINITY };

    #[inline(always)]
    pub(super) fn join(self, other: Aabb) -> Aabb {
        Aabb { lo: self.lo.min(other.lo), hi: self.hi.max(other.hi) }
    }

    #[inline(always)]
    pub(super) fn clip(self, other: &Aabb) -> Aabb {
        Aabb { lo: self.lo.max(other.lo), hi: self.hi.min(other.hi) }
    }

    /// True if the boxes have a point in common; touching boxes overlap.
    #[inline(always)]
    pub(super) fn overlaps(&self, other: &Aabb) -> bool {
        (self.lo.cmple(other.hi) & other.lo.cmple(self.hi)).all()
    }

    /// Widens the box by `pad` and for rounding. Every operation is monotone in its argument also after rounding;
    /// therefore bounds whose gap is at most the radius meet, and the box of a triangle holds the boxes of its
    /// features.
    #[inline(always)]
    pub(super) fn inflated(self, pad: Vec3A) -> Aabb {
        let (lo, hi) = (self.lo - pad, self.hi + pad);
        Aabb { lo: lo - lo.abs() * SLACK, hi: hi + hi.abs() * SLACK }
    }

    /// Moves each bound inwards by `by`. May become inverted (lo > hi); it then overlaps only boxes that contain it.
    #[inline(always)]
    pub(super) fn shrink(self, by: Vec3A) -> Aabb {
        Aabb { lo: self.lo + by, hi: self.hi - by }
    }

    /// True if the box is [`Aabb::EMPTY`] or inverted along x.
    #[inline(always)]
    pub(super) fn is_empty(&self) -> bool {
        self.lo.x > self.hi.x
    }

    /// Longest side, meters.
    #[inline(always)]
    pub(super) fn extent(&self) -> f32 {
        (self.hi - self.lo).max_element()
    }
}

/// Straight paths of all vertices over a query, checked, and how far boxes around them are widened.
pub(super) struct Trajectories<'a> {
    start: &'a [f32],
    end: &'a [f32],
    pad: Vec3A,
    /// How much a box may shrink before it is tested with one of the same piece, meters; none if not at all.
    pub within_piece: Option<Vec3A>,
    /// Distance up to which pairs within one piece are wanted, meters.
    pub within_piece_m: f32,
}

impl<'a> Trajectories<'a> {
    /// # Errors
    /// Positions or a radius that boxes cannot be built from.
    pub(super) fn new(
        mesh: &CollisionMesh,
        query: &Query<'a>,
        choice: &Choice,
    ) -> Result<Trajectories<'a>, BroadError> {
        for (which, positions) in [("start", query.x_t0), ("end", query.x_t1)] {
            if positions.len() != 3 * mesh.vertices {
                return Err(BroadError::PositionCount { which, values: positions.len(), vertices: mesh.vertices });
            }
            // Chunks without a branch inside; a NaN fails the comparison.
            for (chunk, values) in positions.chunks(1024).enumerate() {
                if !values.iter().fold(true, |fine, x| fine & (x.abs() <= MOST_M)) {
                    let at = values.iter().position(|x| x.is_nan() || x.abs() > MOST_M).unwrap_or(0);
                    return Err(BroadError::Position { which, vertex: (chunk * 1024 + at) / 3, value_m: values[at] });
                }
            }
        }
        if !(query.radius_m >= 0.0 && query.radius_m <= MOST_M) {
            return Err(BroadError::Radius { radius_m: query.radius_m });
        }
        let within_piece = choice.piece_radius_m.filter(|&radius_m| radius_m < query.radius_m);
        let within_piece_m = within_piece.map_or(query.radius_m, |radius_m| radius_m.max(0.0));
        // Rounding of the shrunk bounds is within what inflating added.
        let within_piece =
            within_piece.map(|radius_m| Vec3A::splat((query.radius_m - radius_m.max(0.0)) * (1.0 - SLACK)));
        let pad = Vec3A::splat(0.5 * query.radius_m * (1.0 + SLACK));
        Ok(Trajectories { start: query.x_t0, end: query.x_t1, pad, within_piece, within_piece_m })
    }

    /// Box of the path of a vertex, not inflated.
    #[inline(always)]
    fn path(&self, vertex: u32) -> Aabb {
        let at = 3 * vertex as usize;
        let (a, b) = (&self.start[at..at + 3], &self.end[at..at + 3]);
        let (a, b) = (Vec3A::new(a[0], a[1], a[2]), Vec3A::new(b[0], b[1], b[2]));
        Aabb { lo: a.min(b), hi: a.max(b) }
    }

    #[inline(always)]
    fn inflate(&self, path: Aabb) -> Aabb {
        path.inflated(self.pad)
    }

    /// False if start and end are the same array.
    pub(super) fn moves(&self) -> bool {
        !std::ptr::eq(self.start, self.end)
    }

    /// Position of a vertex at the start of its path, or at its end.
    #[inline(always)]
    pub(super) fn at(&self, vertex: u32, end: bool) -> Vec3A {
        let x = if end { self.end } else { self.start };
        let at = 3 * vertex as usize;
        let x = &x[at..at + 3];
        Vec3A::new(x[0], x[1], x[2])
    }

    /// How far boxes are inflated, meters.
    pub(super) fn pad_m(&self) -> f32 {
        self.pad.x
    }

    /// Holds the boxes of all cloth features.
    pub(super) fn cloth_bounds(&self, mesh: &CollisionMesh) -> Aabb {
        let path = (0..mesh.cloth_vertices as u32).fold(Aabb::EMPTY, |bounds, v| bounds.join(self.path(v)));
        self.inflate(path)
    }

    #[inline(always)]
    pub(super) fn vertex(&self, vertex: u32) -> Aabb {
        self.inflate(self.path(vertex))
    }

    #[inline(always)]
    pub(super) fn edge(&self, [a, b]: [u32; 2]) -> Aabb {
        self.inflate(self.path(a).join(self.path(b)))
    }

    #[inline(always)]
    pub(super) fn triangle(&self, [a, b, c]: [u32; 3]) -> Aabb {
        self.inflate(self.path(a).join(self.path(b)).join(self.path(c)))
    }
}
