//! The triangles in the way of a region, in a grid perpendicular to the direction of the push.

use super::Tangle;
use super::regions::{Region, Shape, at};
use crate::math::{DVec2, DVec3, Vec3};

/// Limit of the cells along a side of the grid.
const SIDE_MOST: usize = 512;

pub(super) struct Targets<'a> {
    positions: &'a [Vec3],
    tangle: &'a Tangle<'a>,
    shape: &'a Shape,
    /// Unit vector of the push direction, followed by two vectors perpendicular to it.
    along: DVec3,
    across: [DVec3; 2],
    low: DVec2,
    cell: DVec2,
    side: usize,
    /// Start of each cell: the triangles of cell i are `list[start[i]..start[i + 1]]`, ascending.
    start: Vec<u32>,
    list: Vec<u32>,
}

/// Intersection of a line and a target.
pub(super) struct Crossed {
    pub face: u32,
    pub weights: [f64; 3],
    pub distance_m: f64,
}

impl<'a> Targets<'a> {
    /// The triangles in the way of `region`: those of the pieces that cut it off, without the region itself. `part` =
    /// number of the part that every vertex is in.
    pub(super) fn new(
        positions: &'a [Vec3],
        tangle: &'a Tangle<'a>,
        shape: &'a Shape,
        region: &Region,
        part: &[u32],
        along: DVec3,
    ) -> Targets<'a> {
        let (u, v) = along.any_orthonormal_pair();
        let own = part[region.vertices[0] as usize];
        let mut pieces: Vec<u32> =
            region.cuts.iter().map(|(hit, _)| shape.piece[tangle.triangles[hit.face as usize][0] as usize]).collect();
        pieces.sort_unstable();
        pieces.dedup();
        let flat = |p: DVec3| DVec2::new(u.dot(p), v.dot(p));
        let none = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let grown = |(low, high): (DVec2, DVec2), p: DVec2| (low.min(p), high.max(p));
        let (low, high) = region.vertices.iter().map(|&w| flat(at(positions, w))).fold(none, grown);
        let mut near: Vec<(u32, DVec2, DVec2)> = Vec::new();
        for (t, corners) in (0..).zip(tangle.triangles) {
            let foreign = !corners.iter().all(|&c| part[c as usize] == own);
            if foreign && pieces.binary_search(&shape.piece[corners[0] as usize]).is_ok() {
                let (a, b) = corners.iter().map(|&c| flat(at(positions, c))).fold(none, grown);
                if a.cmple(high).all() && low.cmple(b).all() {
                    near.push((t, a, b));
                }
            }
        }
        let side = ((near.len() as f64).sqrt() as usize).clamp(1, SIDE_MOST);
        let cell = ((high - low) / side as f64).max(DVec2::splat(f64::MIN_POSITIVE));
        let mut targets = Targets {
            positions,
            tangle,
            shape,
            along,
            across: [u, v],
            low,
            cell,
            side,
            start: vec![0],
            list: Vec::new(),
        };
        let mut entries: Vec<(u32, u32)> = Vec::new();
        for (t, a, b) in near {
            let [from, to] = [targets.cell_of(a), targets.cell_of(b)];
            for y in from[1]..=to[1] {
                entries.extend((from[0]..=to[0]).map(|x| ((y * side + x) as u32, t)));
            }
        }
        entries.sort_unstable();
        let starts = (1..=side * side).map(|i| entries.partition_point(|entry| (entry.0 as usize) < i) as u32);
        targets.start.extend(starts);
        targets.list = entries.into_iter().map(|entry| entry.1).collect();
        targets
    }

    fn cell_of(&self, p: DVec2) -> [usize; 2] {
        let place = (p - self.low) / self.cell;
        // The cast clamps positions outside the grid at 0; `min` clamps the other side.
        [place.x, place.y].map(|place| (place as usize).min(self.side - 1))
    }

    /// The first target on the path of a vertex, at most `reach_m` away. A closed obstacle counts only where the path
    /// leaves it.
    pub(super) fn first(&self, vertex: u32, reach_m: f64) -> Option<Crossed> {
        let origin = at(self.positions, vertex);
        let [x, y] = self.cell_of(DVec2::new(self.across[0].dot(origin), self.across[1].dot(origin)));
        let cell = y * self.side + x;
        let list = &self.list[self.start[cell] as usize..self.start[cell + 1] as usize];
        let mut first: Option<Crossed> = None;
        for &face in list {
            let corners = self.tangle.triangles[face as usize];
            if corners.contains(&vertex) {
                continue;
            }
            let Some((distance_m, weights, leaves)) = self.meet(origin, corners.map(|c| at(self.positions, c))) else {
                continue;
            };
            let outward = self.shape.outward[face as usize];
            let through = outward == 0 || (outward > 0) == leaves;
            if through && distance_m <= first.as_ref().map_or(reach_m, |found| found.distance_m) {
                first = Some(Crossed { face, weights, distance_m });
            }
        }
        first
    }

    /// Distance and barycentric weights of the point where the line from `origin` meets a triangle, and true if the
    /// line runs along its normal.
    fn meet(&self, origin: DVec3, [a, b, c]: [DVec3; 3]) -> Option<(f64, [f64; 3], bool)> {
        let normal = (b - a).cross(c - a);
        let rate = normal.dot(self.along);
        if rate.abs() <= 1e-9 * normal.length() {
            return None;
        }
        let distance_m = normal.dot(a - origin) / rate;
        let p = origin + distance_m * self.along;
        let weight = |from: DVec3, to: DVec3| normal.dot((to - from).cross(p - from)) / normal.length_squared();
        let weights = [weight(b, c), weight(c, a), weight(a, b)];
        (distance_m >= 0.0 && weights.iter().all(|&w| w >= -1e-9)).then_some((distance_m, weights, rate > 0.0))
    }
}
