//! Rounds that make the triangles of a level set nearly equilateral, with edges of one length.

use super::field::LevelSet;
use super::topology::compact;
use crate::math::DVec3;

/// Rounds of all four operations.
const ROUNDS: usize = 6;
/// Edges longer than this times the length that is aimed at are split, those shorter than the next are collapsed.
const LONG: f64 = 4.0 / 3.0;
const SHORT: f64 = 4.0 / 5.0;
/// Collapsing and flipping may turn no triangle by more than the angle with this cosine.
const TURNED: f64 = 0.5;
/// A triangle that is gone.
const GONE: [u32; 3] = [u32::MAX; 3];

/// The same surface with edges of about `edge` meters.
pub(super) fn remesh(
    points: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    surface: &LevelSet,
    edge: f64,
) -> (Vec<DVec3>, Vec<[u32; 3]>) {
    let mut mesh = Mesh::new(points, triangles, surface, edge);
    mesh.relax(1);
    for _ in 0..ROUNDS {
        mesh.split();
        mesh.collapse();
        mesh.flip();
        mesh.relax(1);
    }
    mesh.flip();
    mesh.relax(3);
    mesh.triangles.retain(|corners| *corners != GONE);
    compact(mesh.points, mesh.triangles)
}

struct Mesh<'a> {
    points: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    /// Triangles of every vertex.
    around: Vec<Vec<u32>>,
    /// Vertices on the border of the surface.
    rim: Vec<bool>,
    surface: &'a LevelSet<'a>,
    edge: f64,
}

impl<'a> Mesh<'a> {
    fn new(points: Vec<DVec3>, triangles: Vec<[u32; 3]>, surface: &'a LevelSet<'a>, edge: f64) -> Mesh<'a> {
        let mut around = vec![Vec::new(); points.len()];
        for (t, corners) in (0..).zip(&triangles) {
            corners.iter().for_each(|&v| around[v as usize].push(t));
        }
        let rim = vec![false; points.len()];
        let mut mesh = Mesh { points, triangles, around, rim, surface, edge };
        for [a, b] in mesh.edges() {
            if mesh.of_edge(a, b).len() == 1 {
                mesh.rim[a as usize] = true;
                mesh.rim[b as usize] = true;
            }
        }
        mesh
    }

    /// All edges, smaller vertex first, in order.
    fn edges(&self) -> Vec<[u32; 2]> {
        let mut edges: Vec<[u32; 2]> = Vec::with_capacity(2 * self.triangles.len());
        for &[a, b, c] in self.triangles.iter().filter(|corners| **corners != GONE) {
            edges.extend([[a, b], [b, c], [c, a]].map(|[s, t]| [s.min(t), s.max(t)]));
        }
        edges.sort_unstable();
        edges.dedup();
        edges
    }

    /// The triangles at an edge.
    fn of_edge(&self, a: u32, b: u32) -> Vec<u32> {
        let has_b = |t: &u32| self.triangles[*t as usize].contains(&b);
        self.around[a as usize].iter().copied().filter(has_b).collect()
    }

    fn length(&self, a: u32, b: u32) -> f64 {
        self.points[a as usize].distance(self.points[b as usize])
    }

    /// The vertices next to one, ascending.
    fn neighbors(&self, v: u32) -> Vec<u32> {
        let corners = self.around[v as usize].iter().flat_map(|&t| self.triangles[t as usize]);
        let mut neighbors: Vec<u32> = corners.filter(|&w| w != v).collect();
        neighbors.sort_unstable();
        neighbors.dedup();
        neighbors
    }

    fn normal(&self, corners: [u32; 3]) -> DVec3 {
        let [a, b, c] = corners.map(|v| self.points[v as usize]);
        (b - a).cross(c - a)
    }

    /// The point of the surface next to the middle of an edge.
    fn middle(&self, a: u32, b: u32, on_rim: bool) -> DVec3 {
        let middle = (self.points[a as usize] + self.points[b as usize]) / 2.0;
        self.projected(middle, on_rim, 1)
    }

    fn projected(&self, point: DVec3, on_rim: bool, steps: usize) -> DVec3 {
        let reach = self.edge / 2.0;
        if on_rim { self.surface.onto_rim(point, reach, steps) } else { self.surface.onto(point, reach, steps) }
    }

    fn split(&mut self) {
        for [a, b] in self.edges() {
            if self.length(a, b) <= LONG * self.edge {
                continue;
            }
            let at_edge = self.of_edge(a, b);
            let on_rim = at_edge.len() == 1;
            let middle = self.points.len() as u32;
            self.points.push(self.middle(a, b, on_rim));
            self.rim.push(on_rim);
            self.around.push(Vec::new());
            for t in at_edge {
                let corners = self.triangles[t as usize];
                let other = self.triangles.len() as u32;
                self.triangles.push(corners.map(|v| if v == a { middle } else { v }));
                self.triangles[t as usize] = corners.map(|v| if v == b { middle } else { v });
                self.around[b as usize].retain(|&own| own != t);
                self.around[b as usize].push(other);
                self.around[middle as usize].extend([t, other]);
                let third = corners.into_iter().find(|&v| v != a && v != b);
                third.into_iter().for_each(|v| self.around[v as usize].push(other));
            }
        }
    }

    fn collapse(&mut self) {
        for [a, b] in self.edges() {
            let at_edge = self.of_edge(a, b);
            // A collapse before this one can have taken the edge away.
            if at_edge.is_empty() || self.length(a, b) >= SHORT * self.edge {
                continue;
            }
            let on_rim = at_edge.len() == 1;
            let rims = [a, b].map(|v| self.rim[v as usize]);
            if rims == [true; 2] && !on_rim {
                continue;
            }
            let (stays, goes) = if rims[1] && !rims[0] { (b, a) } else { (a, b) };
            let [of_stays, of_goes] = [stays, goes].map(|v| self.neighbors(v));
            let common = of_goes.iter().filter(|v| of_stays.contains(v)).count();
            if common != at_edge.len() || (on_rim && of_stays.len() + of_goes.len() < 5) {
                continue;
            }
            let point = match rims {
                [false, false] => self.middle(a, b, false),
                [true, true] => self.middle(a, b, true),
                _ => self.points[stays as usize],
            };
            let far = |v: &u32| self.points[*v as usize].distance(point) > LONG * self.edge;
            if of_goes.iter().chain(&of_stays).any(far) || !self.may_move(&[stays, goes], point) {
                continue;
            }
            self.points[stays as usize] = point;
            for &t in &at_edge {
                for v in std::mem::replace(&mut self.triangles[t as usize], GONE) {
                    self.around[v as usize].retain(|&own| own != t);
                }
            }
            for t in std::mem::take(&mut self.around[goes as usize]) {
                self.triangles[t as usize] = self.triangles[t as usize].map(|v| if v == goes { stays } else { v });
                self.around[stays as usize].push(t);
            }
        }
    }

    /// True if no triangle that is left turns too far when these vertices go to `point`.
    fn may_move(&self, vertices: &[u32; 2], point: DVec3) -> bool {
        vertices.iter().flat_map(|&v| &self.around[v as usize]).all(|&t| {
            let corners = self.triangles[t as usize];
            if vertices.iter().all(|v| corners.contains(v)) {
                return true;
            }
            let [a, b, c] = corners.map(|v| if vertices.contains(&v) { point } else { self.points[v as usize] });
            let (before, after) = (self.normal(corners), (b - a).cross(c - a));
            before.dot(after) > TURNED * before.length() * after.length()
        })
    }

    fn flip(&mut self) {
        for [a, b] in self.edges() {
            let at_edge = self.of_edge(a, b);
            let [s, t] = at_edge[..] else { continue };
            let third = |t: u32| self.triangles[t as usize].into_iter().find(|&v| v != a && v != b);
            let (Some(c), Some(d)) = (third(s), third(t)) else { continue };
            if !self.of_edge(c, d).is_empty() {
                continue;
            }
            let off = |v: u32, change: i64| {
                let best = if self.rim[v as usize] { 3 } else { 6 };
                (self.around[v as usize].len() as i64 + change - best).pow(2)
            };
            let before = off(a, 0) + off(b, 0) + off(c, 0) + off(d, 0);
            let after = off(a, -1) + off(b, -1) + off(c, 1) + off(d, 1);
            if after >= before {
                continue;
            }
            // The triangle that runs from a to b keeps its way around.
            let forward = |t: u32| {
                let corners = self.triangles[t as usize];
                (0..3).any(|i| corners[i] == a && corners[(i + 1) % 3] == b)
            };
            let (c, d, s, t) = if forward(s) { (c, d, s, t) } else { (d, c, t, s) };
            let (one, other) = ([a, d, c], [d, b, c]);
            let old = self.normal(self.triangles[s as usize]) + self.normal(self.triangles[t as usize]);
            let kept = |corners: [u32; 3]| {
                let normal = self.normal(corners);
                normal.dot(old) > TURNED * normal.length() * old.length()
            };
            if !kept(one) || !kept(other) {
                continue;
            }
            self.triangles[s as usize] = one;
            self.triangles[t as usize] = other;
            self.around[a as usize].retain(|&own| own != t);
            self.around[b as usize].retain(|&own| own != s);
            self.around[c as usize].push(t);
            self.around[d as usize].push(s);
        }
    }

    /// Moves every vertex into the middle of its neighbors, along the surface or along its rim.
    fn relax(&mut self, steps: usize) {
        let moved = |v: usize| {
            let neighbors = self.neighbors(v as u32);
            let on_rim = self.rim[v];
            let chosen = neighbors.iter().filter(|&&w| !on_rim || self.of_edge(v as u32, w).len() == 1);
            let points: Vec<DVec3> = chosen.map(|&w| self.points[w as usize]).collect();
            if points.is_empty() {
                return self.points[v];
            }
            let middle = points.iter().sum::<DVec3>() / points.len() as f64;
            self.projected(middle, on_rim, steps)
        };
        self.points = (0..self.points.len()).map(moved).collect();
    }
}
