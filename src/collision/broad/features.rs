//! Boxes of the vertices and edges that a triangle owns, in groups of four so that one comparison tests four of them.

use glam::Vec4;

use super::boxes::Aabb;
use super::input::Input;
use super::mesh::edge_of;

/// Four boxes, coordinate by coordinate.
#[derive(Clone, Copy)]
struct Four {
    lo: [Vec4; 3],
    hi: [Vec4; 3],
}

/// A box, each bound four times.
pub(super) struct Spread {
    lo: [Vec4; 3],
    hi: [Vec4; 3],
}

impl Spread {
    #[inline(always)]
    pub(super) fn of(aabb: &Aabb) -> Spread {
        Spread { lo: aabb.lo.to_array().map(Vec4::splat), hi: aabb.hi.to_array().map(Vec4::splat) }
    }
}

impl Spread {
    /// Moves each bound inwards by `by`, as [`Aabb::shrink`] does.
    #[inline(always)]
    pub(super) fn shrink(&mut self, by: f32) {
        for axis in 0..3 {
            self.lo[axis] += by;
            self.hi[axis] -= by;
        }
    }
}

/// Four boxes that overlap nothing: unused slots.
const NOWHERE: Four = Four { lo: [Vec4::INFINITY; 3], hi: [Vec4::NEG_INFINITY; 3] };

impl Four {
    /// Bit k is set if box k overlaps the other.
    #[inline(always)]
    fn overlaps(&self, other: &Spread) -> u32 {
        let axis = |k: usize| self.lo[k].cmple(other.hi[k]) & other.lo[k].cmple(self.hi[k]);
        (axis(0) & axis(1) & axis(2)).bitmask()
    }
}

/// The up to six features that a triangle owns, in slots, vertices first.
#[derive(Clone, Copy)]
pub(super) struct Features {
    pub corners: [u32; 3],
    /// The vertex twice, or the edge, smaller vertex first.
    pub ends: [[u32; 2]; 6],
    boxes: [Four; 2],
    /// Bits of the slots that hold vertices.
    pub vertices: u32,
    /// Bits of the slots that hold edges.
    pub edges: u32,
    /// Smallest vertex of the piece that the triangle belongs to.
    pub piece: u32,
    /// True once the other fields are set.
    pub known: bool,
}

impl Features {
    pub(super) const UNKNOWN: Features = Features {
        corners: [0; 3],
        ends: [[0; 2]; 6],
        boxes: [NOWHERE; 2],
        vertices: 0,
        edges: 0,
        piece: 0,
        known: false,
    };

    #[inline(always)]
    pub(super) fn set(&mut self, input: &Input, triangle: u32) {
        let corners = input.mesh.triangles[triangle as usize];
        let owned = u32::from(input.mesh.owned[triangle as usize]);
        let vertices = corners.map(|v| input.paths.vertex(v));
        self.corners = corners;
        self.piece = input.mesh.pieces[corners[0] as usize];
        self.known = true;
        self.boxes = [NOWHERE; 2];
        let count = (owned & 7).count_ones();
        self.vertices = (1 << count) - 1;
        self.edges = ((1 << owned.count_ones()) - 1) & !self.vertices;
        let (mut left, mut slot) = (owned, 0);
        while left != 0 {
            let bit = left.trailing_zeros() as usize;
            left &= left - 1;
            let (ends, aabb) = if bit < 3 {
                ([corners[bit]; 2], vertices[bit])
            } else {
                // Widening is monotone, so the union of widened boxes is the widened union.
                (edge_of(corners, bit - 3), vertices[bit - 3].join(vertices[(bit - 2) % 3]))
            };
            self.ends[slot] = ends;
            let four = &mut self.boxes[slot / 4];
            for axis in 0..3 {
                four.lo[axis].as_mut()[slot % 4] = aabb.lo[axis];
                four.hi[axis].as_mut()[slot % 4] = aabb.hi[axis];
            }
            slot += 1;
        }
    }

    /// Bits of the slots whose boxes overlap a box.
    #[inline(always)]
    pub(super) fn reach(&self, other: &Spread) -> u32 {
        let first = self.boxes[0].overlaps(other);
        // More than four features are rare.
        if (self.vertices | self.edges) >> 4 == 0 { first } else { first | self.boxes[1].overlaps(other) << 4 }
    }

    /// The box in a slot.
    #[inline(always)]
    pub(super) fn spread(&self, slot: usize) -> Spread {
        let four = &self.boxes[slot / 4];
        let bound = |of: &[Vec4; 3]| of.map(|bound| Vec4::splat(bound.to_array()[slot % 4]));
        Spread { lo: bound(&four.lo), hi: bound(&four.hi) }
    }
}

/// The set bits of `mask`, ascending.
#[inline(always)]
pub(super) fn bits(mut mask: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = mask.trailing_zeros() as usize;
        (mask != 0).then(|| {
            mask &= mask - 1;
            bit
        })
    })
}
