//! The contour of a union of patches: which edges it has, and whether it keeps apart from itself when seen from one side. See
//! `cull` for what that proves.

use glam::Vec2;
use glam::Vec3A;

use super::boxes::Motion;

/// Edges whose bounds are looked at together.
const CHUNK: usize = 8;
/// Coordinates are wrong by less than this part of the largest: differences of coordinates, a rotation, a sum of three.
const ROUNDING: f32 = 1e-6;

/// A point at both ends of the step.
type Path = [Vec2; 2];

/// A contour as seen along a direction.
#[derive(Default)]
pub(super) struct Contour {
    points: Vec<Path>,
    /// Per chunk of edges: lower and upper bounds at both ends.
    bounds: Vec<[Path; 2]>,
}

/// Boundary edges of triangles, in their direction; none if some edge has more than two triangles or two that do not agree
/// on which side is up.
pub(super) fn outline(triangles: &[[u32; 3]]) -> Option<Vec<[u32; 2]>> {
    boundary(triangles.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]))
}

/// What is left of directed edges when opposite ones are taken away.
fn boundary(edges: impl Iterator<Item = [u32; 2]>) -> Option<Vec<[u32; 2]>> {
    let mut sides: Vec<([u32; 2], bool)> = edges.map(|[a, b]| ([a.min(b), a.max(b)], a < b)).collect();
    sides.sort_unstable();
    let mut left = Vec::new();
    for same in sides.chunk_by(|a, b| a.0 == b.0) {
        match *same {
            [([a, b], forth)] => left.push(if forth { [a, b] } else { [b, a] }),
            [(_, false), (_, true)] => {}
            _ => return None,
        }
    }
    Some(left)
}

/// The vertices of the boundary of all parts together, in order, if it is one closed polygon; else nothing.
pub(super) fn polygon<'a>(parts: impl Iterator<Item = Option<&'a [[u32; 2]]>>) -> Vec<u32> {
    let mut edges = Vec::new();
    for part in parts {
        let Some(part) = part else { return Vec::new() };
        edges.extend_from_slice(part);
    }
    let Some(mut edges) = boundary(edges.into_iter()) else { return Vec::new() };
    edges.sort_unstable();
    if edges.len() < 3 || edges.windows(2).any(|pair| pair[0][0] == pair[1][0]) {
        return Vec::new();
    }
    let mut vertices = vec![edges[0][0]];
    let mut next = edges[0][1];
    while next != vertices[0] {
        let Ok(at) = edges.binary_search_by_key(&next, |edge| edge[0]) else { return Vec::new() };
        // Every edge is followed once at most, so this ends.
        if vertices.len() == edges.len() {
            return Vec::new();
        }
        vertices.push(next);
        next = edges[at][1];
    }
    if vertices.len() == edges.len() { vertices } else { Vec::new() }
}

/// Whether all of `some` stay beyond all of `others` along an axis, by more than a margin in units of its length.
fn beyond(axis: Vec2, some: &[Path], others: &[Path], margin: f32) -> bool {
    (0..2).all(|end| {
        let least = some.iter().map(|p| axis.dot(p[end])).fold(f32::INFINITY, f32::min);
        let most = others.iter().map(|p| axis.dot(p[end])).fold(f32::NEG_INFINITY, f32::max);
        least - most > margin
    })
}

/// The same in either order, along an axis of any length.
fn separates(axis: Vec2, some: &[Path], others: &[Path], margin_m: f32) -> bool {
    let Some(axis) = axis.try_normalize() else { return false };
    beyond(axis, some, others, margin_m) || beyond(axis, others, some, margin_m)
}

fn middle(of: &[Path]) -> Vec2 {
    of.iter().map(|p| p[0] + p[1]).sum::<Vec2>() / of.len() as f32
}

/// Edge from the first to the last point, at half time, twice as long.
fn along(of: &[Path]) -> Vec2 {
    let (first, last) = (of[0], of[of.len() - 1]);
    (last[0] + last[1]) - (first[0] + first[1])
}

/// Whether a point or edge and an edge are proven apart.
fn apart(some: &[Path], others: &[Path], margin_m: f32) -> bool {
    let axes = [middle(some) - middle(others), along(others).perp(), along(some).perp()];
    axes.into_iter().any(|axis| separates(axis, some, others, margin_m))
}

impl Contour {
    /// Takes the points of a contour as seen along the unit vector `view`; how far they may be off, metres.
    pub fn project(&mut self, motion: &Motion, vertices: &[u32], view: Vec3A) -> f32 {
        let side = view.any_orthonormal_vector();
        let up = view.cross(side);
        let origins = [false, true].map(|end| motion.at(vertices[0], end));
        let mut extent = 0.0f32;
        self.points.clear();
        self.points.extend(vertices.iter().map(|&vertex| {
            [0, 1].map(|end| {
                let x = motion.at(vertex, end == 1) - origins[end];
                extent = extent.max(x.abs().max_element());
                Vec2::new(x.dot(side), x.dot(up))
            })
        }));
        // Of both things whose distance is asked for, and of the axis along which it is taken.
        8.0 * ROUNDING * extent
    }

    fn point(&self, at: usize) -> Path {
        self.points[at % self.points.len()]
    }

    fn edge(&self, at: usize) -> [Path; 2] {
        [self.point(at), self.point(at + 1)]
    }

    /// Whether the contour keeps farther than a margin from itself, as `cull` asks for.
    pub fn is_apart(&mut self, margin_m: f32) -> bool {
        let count = self.points.len();
        let corners = (0..count).all(|at| {
            let [before, corner, after] = [at + count - 1, at, at + 1].map(|at| self.point(at));
            apart(&[before], &[corner, after], margin_m) && apart(&[after], &[before, corner], margin_m)
        });
        if !corners {
            return false;
        }
        self.bound();
        let chunks = self.bounds.len();
        (0..chunks).all(|one| (one..chunks).all(|other| self.are_apart(one, other, margin_m)))
    }

    fn bound(&mut self) {
        let count = self.points.len();
        let chunks = count.div_ceil(CHUNK);
        self.bounds.clear();
        for chunk in 0..chunks {
            let mut bounds = [[Vec2::INFINITY; 2], [Vec2::NEG_INFINITY; 2]];
            for at in chunk * CHUNK..((chunk + 1) * CHUNK).min(count) + 1 {
                let point = self.point(at);
                for end in 0..2 {
                    bounds[0][end] = bounds[0][end].min(point[end]);
                    bounds[1][end] = bounds[1][end].max(point[end]);
                }
            }
            self.bounds.push(bounds);
        }
    }

    fn are_apart(&self, one: usize, other: usize, margin_m: f32) -> bool {
        let (bounds, others) = (&self.bounds[one], &self.bounds[other]);
        let over = |some: &[Path; 2], others: &[Path; 2]| {
            let gap = (some[0][0] - others[1][0]).min(some[0][1] - others[1][1]);
            gap.max_element() > margin_m
        };
        if over(bounds, others) || over(others, bounds) {
            return true;
        }
        let count = self.points.len();
        let edges = |chunk: usize| chunk * CHUNK..((chunk + 1) * CHUNK).min(count);
        edges(one).all(|a| {
            let edge = self.edge(a);
            edges(other).filter(|&b| b > a + 1 && (b + 1) % count != a).all(|b| apart(&edge, &self.edge(b), margin_m))
        })
    }
}
