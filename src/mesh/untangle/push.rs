//! One round of pushing. A push moves two features apart along a line and is shared between their vertices. A vertex
//! moves by the mean of its pushes.

use super::regions::{Hit, Region, Shape, at, edges_of, hits, normal, regions, through};
use super::tangle::Tangle;
use super::targets::Targets;
use crate::math::{DVec3, Vec3};

/// Below this length the mean of the normals along a cut gives no reliable direction.
const DECISIVE: f64 = 0.3;

/// Displacement of every vertex, meters.
pub(super) fn moves(positions: &[Vec3], tangle: &Tangle, shape: &Shape, pairs: &[[u32; 2]]) -> Vec<DVec3> {
    let hits = hits(positions, tangle.triangles, shape, pairs);
    let (regions, part) = regions(positions, tangle.triangles, shape, &hits);
    let mut round = Round { positions, tangle, shape, sums: vec![(DVec3::ZERO, 0.0); positions.len()] };
    // If one region is pushed, the region on the other side of the same cut stays.
    let mut claimed: Vec<[u32; 2]> = Vec::new();
    for region in &regions {
        let mut pairs: Vec<[u32; 2]> = region.cuts.iter().map(|(hit, _)| hit.pair()).collect();
        pairs.sort_unstable();
        pairs.dedup();
        let taken = pairs.iter().filter(|pair| claimed.binary_search(pair).is_ok()).count();
        if 2 * taken <= pairs.len() && round.region(region, &part) {
            claimed.extend(pairs);
            claimed.sort_unstable();
        }
    }
    for (run, odd) in through(&hits) {
        if !odd {
            round.passage(run);
        } else {
            run.iter().filter(|hit| claimed.binary_search(&hit.pair()).is_err()).for_each(|hit| round.edge(hit));
        }
    }
    for pair in pairs {
        round.fold(pair.map(|t| tangle.triangles[t as usize]));
    }
    round.sums.iter().map(|&(sum, weight)| if weight > 0.0 { sum / weight } else { DVec3::ZERO }).collect()
}

struct Round<'a> {
    positions: &'a [Vec3],
    tangle: &'a Tangle<'a>,
    shape: &'a Shape,
    /// Weighted sum of the pushes of every vertex, and the sum of the weights.
    sums: Vec<(DVec3, f64)>,
}

impl Round<'_> {
    fn at(&self, vertex: u32) -> DVec3 {
        at(self.positions, vertex)
    }

    fn normal(&self, face: u32) -> DVec3 {
        normal(self.positions, self.tangle.triangles[face as usize])
    }

    /// Pushes a region through the surface that cuts it off. False if no vertex can move.
    fn region(&mut self, region: &Region, part: &[u32]) -> bool {
        let Some(along) = self.way_out(region, part) else { return false };
        let targets = Targets::new(self.positions, self.tangle, self.shape, region, part, along);
        let nothing = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let grown = |(low, high): (DVec3, DVec3), &v: &u32| (low.min(self.at(v)), high.max(self.at(v)));
        let (low, high) = region.vertices.iter().fold(nothing, grown);
        let cuts = region.cuts.iter().map(|(hit, _)| (self.at(hit.edge[1]) - self.at(hit.edge[0])).length());
        let reach_m = 2.0 * (high - low).length() + cuts.fold(0.0, f64::max);
        let mut pushed = false;
        for &vertex in &region.vertices {
            if let Some(crossed) = targets.first(vertex, reach_m) {
                let corners = self.tangle.triangles[crossed.face as usize];
                let face = [0, 1, 2].map(|i| (corners[i], -crossed.weights[i].max(0.0)));
                pushed |= self.push(along, crossed.distance_m, &[(vertex, 1.0), face[0], face[1], face[2]]);
            }
        }
        // At the border of the obstructing surface a vertex can pass beside it although its edge crosses it.
        for &(hit, wrong) in &region.cuts {
            if self.sums[wrong as usize].1 == 0.0 {
                pushed |= self.end(&hit, wrong);
            }
        }
        pushed
    }

    /// The direction in which a region is pushed out.
    fn way_out(&self, region: &Region, part: &[u32]) -> Option<DVec3> {
        let mut mean = DVec3::ZERO;
        for (hit, wrong) in &region.cuts {
            let right = hit.edge[0] + hit.edge[1] - wrong;
            let normal = self.normal(hit.face);
            mean += normal * normal.dot(self.at(right) - self.at(*wrong)).signum();
        }
        mean /= region.cuts.len() as f64;
        if mean.length() < DECISIVE {
            let own = part[region.vertices[0] as usize];
            let inside = |corners: &&[u32; 3]| corners.iter().any(|&v| part[v as usize] == own);
            let area = |corners: &[u32; 3]| {
                let [a, b, c] = corners.map(|v| self.at(v));
                (b - a).cross(c - a)
            };
            let own: DVec3 = self.tangle.triangles.iter().filter(inside).map(area).sum();
            mean = own * if own.dot(mean) < 0.0 { -1.0 } else { 1.0 };
        }
        mean.try_normalize()
    }

    /// Pushes one end of an edge to the other side of a face.
    fn end(&mut self, hit: &Hit, wrong: u32) -> bool {
        let right = hit.edge[0] + hit.edge[1] - wrong;
        let corners = self.tangle.triangles[hit.face as usize];
        let normal = self.normal(hit.face);
        let [from, to] = [wrong, right].map(|v| normal.dot(self.at(v) - self.at(corners[0])));
        let along = normal * if to != from { (to - from).signum() } else { self.order(hit) };
        let share = if to != from { (from / (from - to)).clamp(0.0, 1.0) } else { 0.5 };
        let place = self.at(wrong).lerp(self.at(right), share);
        let weights = barycentric(place, corners.map(|v| self.at(v)));
        let face = [0, 1, 2].map(|i| (corners[i], -weights[i]));
        self.push(along, from.abs(), &[(wrong, 1.0), face[0], face[1], face[2]])
    }

    /// Orders coplanar features. Any order works if it is the same for all pairs of two pieces.
    fn order(&self, hit: &Hit) -> f64 {
        let piece = |t: u32| self.shape.piece[self.tangle.triangles[t as usize][0] as usize];
        if piece(hit.owner) > piece(hit.face) { 1.0 } else { -1.0 }
    }

    /// Pushes an edge that enters and leaves a surface over the ridge formed by the two faces.
    fn passage(&mut self, run: &[Hit]) {
        let edge = run[0].edge;
        let [from, to] = edge.map(|v| self.at(v));
        let Some(ahead) = (to - from).try_normalize() else { return };
        let mut faces: Vec<(f64, u32)> = Vec::new();
        for same in run.chunk_by(|a, b| a.face == b.face) {
            let normal = self.normal(same[0].face);
            let corner = self.at(self.tangle.triangles[same[0].face as usize][0]);
            let [low, high] = [from, to].map(|p| normal.dot(p - corner));
            if low == high {
                // An edge in the plane of a face neither enters nor leaves it.
                for v in edge {
                    self.end(&same[0], v);
                }
                return;
            }
            faces.push(((low / (low - high)).clamp(0.0, 1.0), same[0].face));
        }
        faces.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        for ends in faces.chunks_exact(2) {
            let [(enters, one), (leaves, other)] = [ends[0], ends[1]];
            let [n, m] = [one, other].map(|face| self.normal(face));
            let (n, m) = (n * -n.dot(ahead).signum(), m * m.dot(ahead).signum());
            let Some(along) = (n + m).try_normalize() else { continue };
            // Slope of the faces over the edge, seen from the entry and from the exit.
            let [rise, fall] = [-n.dot(ahead) / n.dot(along), m.dot(ahead) / m.dot(along)];
            let length = (to - from).length() * (leaves - enters);
            let (top, height_m) = match rise + fall {
                sum if sum > 0.0 => (fall / sum, length * (rise * fall / sum).min(1.0)),
                _ => (0.5, 0.0),
            };
            let share = enters + (leaves - enters) * top;
            for (face, at) in [(one, enters), (other, leaves)] {
                let corners = self.tangle.triangles[face as usize];
                let weights = barycentric(from.lerp(to, at), corners.map(|v| self.at(v)));
                let [a, b, c] = [0, 1, 2].map(|i| (corners[i], -weights[i]));
                self.push(along, height_m, &[(edge[0], 1.0 - share), (edge[1], share), a, b, c]);
            }
        }
    }

    /// Pushes an edge outside all regions over the nearest border of the face, or else pushes its nearer end back.
    fn edge(&mut self, hit: &Hit) {
        let mut nearest: Option<(f64, [u32; 2], [f64; 2])> = None;
        for side in edges_of(&self.tangle.triangles[hit.face as usize]) {
            if self.shape.is_border(side) {
                let shares = closest(hit.edge.map(|v| self.at(v)), side.map(|v| self.at(v)));
                let gap = self.along_edge(side, shares[1]).distance(self.along_edge(hit.edge, shares[0]));
                if nearest.is_none_or(|(least, ..)| gap < least) {
                    nearest = Some((gap, side, shares));
                }
            }
        }
        let Some((distance_m, side, [s, t])) = nearest else {
            let corner = self.at(self.tangle.triangles[hit.face as usize][0]);
            let depth = hit.edge.map(|v| self.normal(hit.face).dot(self.at(v) - corner).abs());
            self.end(hit, hit.edge[usize::from(depth[1] < depth[0])]);
            return;
        };
        let apart = self.along_edge(side, t) - self.along_edge(hit.edge, s);
        let edges = [hit.edge, side].map(|[a, b]| self.at(b) - self.at(a));
        let along = apart.try_normalize().or_else(|| edges[0].cross(edges[1]).try_normalize());
        let along = along.unwrap_or_else(|| self.normal(hit.face) * self.order(hit));
        let ends = [(hit.edge[0], 1.0 - s), (hit.edge[1], s), (side[0], t - 1.0), (side[1], -t)];
        self.push(along, distance_m, &ends);
    }

    /// Opens two triangles that are folded flat onto each other at a common edge.
    fn fold(&mut self, corners: [[u32; 3]; 2]) {
        let alone = [0, 1].map(|t: usize| corners[t].iter().find(|v| !corners[1 - t].contains(v)).copied());
        let shared = corners[0].iter().filter(|v| corners[1].contains(v)).count();
        if let ([Some(one), Some(other)], 2) = (alone, shared) {
            self.push(normal(self.positions, corners[0]), 0.0, &[(one, 1.0), (other, -1.0)]);
        }
    }

    fn along_edge(&self, [a, b]: [u32; 2], share: f64) -> DVec3 {
        self.at(a).lerp(self.at(b), share)
    }

    /// Moves two features past each other by `distance_m` plus the gap. `weights` are positive for the vertices of one
    /// and negative for those of the other. False if none of the vertices can move.
    fn push(&mut self, along: DVec3, distance_m: f64, weights: &[(u32, f64)]) -> bool {
        let movable = |v: u32| self.tangle.movable[v as usize];
        let sum: f64 = weights.iter().filter(|(v, _)| movable(*v)).map(|(_, weight)| weight * weight).sum();
        if sum < 1e-6 {
            return false;
        }
        let scale = (distance_m + self.tangle.gap_m) / sum;
        for &(v, weight) in weights.iter().filter(|(v, _)| movable(*v)) {
            let (moved, weights) = &mut self.sums[v as usize];
            *moved += along * (scale * weight * weight.abs());
            *weights += weight.abs();
        }
        true
    }
}

/// Barycentric weights of the point in a triangle's plane nearest to `p`, clamped to the triangle.
fn barycentric(p: DVec3, [a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let normal = (b - a).cross(c - a);
    let weight = |from: DVec3, to: DVec3| normal.dot((to - from).cross(p - from)).max(0.0);
    let weights = [weight(b, c), weight(c, a), weight(a, b)];
    let sum: f64 = weights.iter().sum();
    if sum > 0.0 { weights.map(|w| w / sum) } else { [1.0 / 3.0; 3] }
}

/// The closest points of two segments, as fractions of their lengths.
fn closest([a, b]: [DVec3; 2], [c, d]: [DVec3; 2]) -> [f64; 2] {
    let (u, v, w) = (b - a, d - c, a - c);
    let (uu, uv, vv, uw, vw) = (u.dot(u), u.dot(v), v.dot(v), u.dot(w), v.dot(w));
    let determinant = uu * vv - uv * uv;
    let s = if determinant > 1e-12 * uu * vv { ((uv * vw - vv * uw) / determinant).clamp(0.0, 1.0) } else { 0.5 };
    let t = if vv > 0.0 { ((uv * s + vw) / vv).clamp(0.0, 1.0) } else { 0.5 };
    let s = if uu > 0.0 { ((uv * t - uw) / uu).clamp(0.0, 1.0) } else { 0.5 };
    [s, t]
}
