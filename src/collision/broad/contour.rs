//! The contour of a union of patches: which edges it has, and whether it keeps apart from itself when seen from one side. See
//! `cull` for what that proves.

use glam::{Vec2, Vec3A, Vec4};

use super::boxes::Trajectories;

/// Edges whose bounds are looked at together.
const CHUNK: usize = 4;
/// Relative error bound of projected coordinates: differences of coordinates, a rotation, a sum of three.
const ROUNDING: f32 = 1e-6;

/// A point at both ends of the step.
type Path = [Vec2; 2];

/// A contour as seen along a direction.
#[derive(Default)]
pub(super) struct Contour {
    points: Vec<Path>,
    /// Of every edge, and of every chunk of edges.
    edges: Vec<Bounds>,
    chunks: Vec<Bounds>,
}

/// Boundary edges of triangles, in their direction; none if some edge has more than two triangles or two that do not agree
/// on which side is up.
pub(super) fn outline(triangles: &[[u32; 3]]) -> Option<Vec<[u32; 2]>> {
    boundary(triangles.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]))
}

/// The directed edges without an opposite one; none if some edge occurs twice in one direction.
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

/// True if all of `some` stay beyond all of `others` along an axis of any length, by more than a margin in meters.
fn beyond(axis: Vec2, some: &[Path], others: &[Path], margin_m: f32) -> bool {
    let least_squared = margin_m * margin_m * axis.length_squared();
    (0..2).all(|end| {
        let least = some.iter().map(|p| axis.dot(p[end])).fold(f32::INFINITY, f32::min);
        let most = others.iter().map(|p| axis.dot(p[end])).fold(f32::NEG_INFINITY, f32::max);
        let gap = least - most;
        gap > 0.0 && gap * gap > least_squared
    })
}

fn middle(of: &[Path]) -> Vec2 {
    of.iter().map(|p| p[0] + p[1]).sum::<Vec2>() / of.len() as f32
}

/// Edge from the first to the last point, at half time, twice as long.
fn along(of: &[Path]) -> Vec2 {
    let (first, last) = (of[0], of[of.len() - 1]);
    (last[0] + last[1]) - (first[0] + first[1])
}

/// True if a point or edge and an edge are proven apart.
fn apart(some: &[Path], others: &[Path], margin_m: f32) -> bool {
    let either = |axis: Vec2| beyond(axis, some, others, margin_m) || beyond(-axis, some, others, margin_m);
    // The first one points from the others to the one.
    beyond(middle(some) - middle(others), some, others, margin_m)
        || either(along(others).perp())
        || either(along(some).perp())
}

/// Bounds of points: lower and upper coordinates, at the start and at the end.
#[derive(Clone, Copy)]
struct Bounds {
    lo: Vec4,
    hi: Vec4,
}

impl Bounds {
    fn of(points: impl Iterator<Item = Path>) -> Bounds {
        let mut bounds = Bounds { lo: Vec4::INFINITY, hi: Vec4::NEG_INFINITY };
        for [start, end] in points {
            let point = Vec4::new(start.x, start.y, end.x, end.y);
            (bounds.lo, bounds.hi) = (bounds.lo.min(point), bounds.hi.max(point));
        }
        bounds
    }

    /// True if both stay apart along one of the two axes of the view.
    fn are_apart(&self, other: &Bounds, margin_m: f32) -> bool {
        let above = (self.lo - other.hi).cmpgt(Vec4::splat(margin_m)).bitmask();
        let below = (other.lo - self.hi).cmpgt(Vec4::splat(margin_m)).bitmask();
        // Along the same axis at both ends.
        ((above & (above >> 2)) | (below & (below >> 2))) & 3 != 0
    }
}

impl Contour {
    /// Takes the points of a contour as seen along the unit vector `view`; how far they may be off, meters.
    pub(super) fn project(&mut self, paths: &Trajectories, vertices: &[u32], view: Vec3A) -> f32 {
        let side = view.any_orthonormal_vector();
        let up = view.cross(side);
        let origins = [false, true].map(|end| paths.at(vertices[0], end));
        let mut extent = 0.0f32;
        self.points.clear();
        self.points.extend(vertices.iter().map(|&vertex| {
            [0, 1].map(|end| {
                let x = paths.at(vertex, end == 1) - origins[end];
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

    /// True if the contour keeps farther than a margin from itself, as `cull` asks for.
    pub(super) fn is_apart(&mut self, margin_m: f32) -> bool {
        let count = self.points.len();
        let corners = (0..count).all(|at| {
            let [before, corner, after] = [at + count - 1, at, at + 1].map(|at| self.point(at));
            apart(&[before], &[corner, after], margin_m) && apart(&[after], &[before, corner], margin_m)
        });
        if !corners {
            return false;
        }
        self.bound();
        let chunks = self.chunks.len();
        (0..chunks).all(|one| (one..chunks).all(|other| self.are_apart(one, other, margin_m)))
    }

    fn bound(&mut self) {
        let count = self.points.len();
        let mut edges = std::mem::take(&mut self.edges);
        edges.clear();
        edges.extend((0..count).map(|at| Bounds::of(self.edge(at).into_iter())));
        self.chunks.clear();
        let chunk = |edges: &[Bounds]| Bounds {
            lo: edges.iter().fold(Vec4::INFINITY, |lo, edge| lo.min(edge.lo)),
            hi: edges.iter().fold(Vec4::NEG_INFINITY, |hi, edge| hi.max(edge.hi)),
        };
        self.chunks.extend(edges.chunks(CHUNK).map(chunk));
        self.edges = edges;
    }

    fn are_apart(&self, one: usize, other: usize, margin_m: f32) -> bool {
        if one != other && self.chunks[one].are_apart(&self.chunks[other], margin_m) {
            return true;
        }
        let count = self.points.len();
        let edges = |chunk: usize| chunk * CHUNK..((chunk + 1) * CHUNK).min(count);
        edges(one).all(|a| {
            let mut others = edges(other).filter(|&b| b > a + 1 && (b + 1) % count != a);
            others.all(|b| {
                self.edges[a].are_apart(&self.edges[b], margin_m) || apart(&self.edge(a), &self.edge(b), margin_m)
            })
        })
    }
}
