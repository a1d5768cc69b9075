//! Finds the parts of a surface on the wrong side of another surface: pieces of mesh, cut along the edges that cross.

use std::collections::BTreeMap;
use std::ops::Range;

use super::super::intersect::edge_crosses_triangle;
use super::super::{Group, GroupKind};
use crate::math::{DVec3, Vec3};

/// Data that stay the same while vertices move.
pub(super) struct Shape {
    /// Number of the connected piece of every vertex.
    pub piece: Vec<u32>,
    /// For every triangle: 1 or -1 if it belongs to a closed obstacle and faces outward or inward, else 0.
    pub outward: Vec<i8>,
    /// True for every triangle of an obstacle.
    pub obstacle: Vec<bool>,
    /// Edges with only one triangle, ascending.
    border: Vec<[u32; 2]>,
    /// Every edge in both directions, ascending.
    neighbors: Vec<[u32; 2]>,
}

impl Shape {
    pub(super) fn new(positions: &[Vec3], triangles: &[[u32; 3]], groups: &[Group]) -> Shape {
        let mut sets = Sets::new(positions.len());
        triangles.iter().for_each(|&[a, b, c]| {
            sets.join(a, b);
            sets.join(a, c);
        });
        let piece = sets.roots();
        let mut edges: Vec<[u32; 2]> = triangles.iter().flat_map(edges_of).collect();
        edges.sort_unstable();
        let border = edges.chunk_by(|a, b| a == b).filter(|same| same.len() == 1).map(|same| same[0]).collect();
        edges.dedup();
        let mut neighbors: Vec<[u32; 2]> = edges.iter().flat_map(|&[a, b]| [[a, b], [b, a]]).collect();
        neighbors.sort_unstable();
        let (outward, obstacle) = (vec![0; triangles.len()], vec![false; triangles.len()]);
        let mut shape = Shape { piece, outward, obstacle, border, neighbors };
        for group in groups.iter().filter(|group| group.kind == GroupKind::Obstacle) {
            shape.obstacle[group.triangles.clone()].fill(true);
            shape.orient(positions, triangles, group.triangles.clone());
        }
        shape
    }

    pub(super) fn is_border(&self, edge: [u32; 2]) -> bool {
        self.border.binary_search(&edge).is_ok()
    }

    /// The vertices that share an edge with `vertex`, ascending.
    pub(super) fn neighbors(&self, vertex: u32) -> impl Iterator<Item = u32> {
        let first = self.neighbors.partition_point(|pair| pair[0] < vertex);
        self.neighbors[first..].iter().take_while(move |pair| pair[0] == vertex).map(|pair| pair[1])
    }

    /// Fills `outward` for the closed, consistently wound pieces of an obstacle.
    fn orient(&mut self, positions: &[Vec3], triangles: &[[u32; 3]], range: Range<usize>) {
        let mut directed: Vec<[u32; 2]> =
            triangles[range.clone()].iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]]).collect();
        directed.sort_unstable();
        let mut open: Vec<u32> = Vec::new();
        for same in directed.chunk_by(|a, b| a == b) {
            let [a, b] = same[0];
            if same.len() > 1 || directed.binary_search(&[b, a]).is_err() {
                open.push(self.piece[a as usize]);
            }
        }
        open.sort_unstable();
        let mut volumes: BTreeMap<u32, f64> = BTreeMap::new();
        let origin = triangles.get(range.start).map_or(DVec3::ZERO, |t| positions[t[0] as usize].as_dvec3());
        for corners in &triangles[range.clone()] {
            let [a, b, c] = corners.map(|v| positions[v as usize].as_dvec3() - origin);
            *volumes.entry(self.piece[corners[0] as usize]).or_default() += a.dot(b.cross(c));
        }
        for t in range {
            let piece = self.piece[triangles[t][0] as usize];
            if open.binary_search(&piece).is_err() {
                self.outward[t] = if volumes[&piece] > 0.0 { 1 } else { -1 };
            }
        }
    }
}

/// An edge that meets a face.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Hit {
    /// Smaller vertex first.
    pub edge: [u32; 2],
    /// Piece of the face.
    pub piece: u32,
    pub face: u32,
    /// A triangle of the edge.
    pub owner: u32,
}

impl Hit {
    pub(super) fn pair(&self) -> [u32; 2] {
        [self.owner.min(self.face), self.owner.max(self.face)]
    }
}

/// The pairs of an edge and a face at which the triangles of `pairs` meet, ascending.
pub(super) fn hits(positions: &[Vec3], triangles: &[[u32; 3]], shape: &Shape, pairs: &[[u32; 2]]) -> Vec<Hit> {
    let mut hits = Vec::new();
    for &[s, t] in pairs {
        for (owner, face) in [(s, t), (t, s)] {
            let [a, b, c] = triangles[face as usize].map(|v| positions[v as usize]);
            let piece = shape.piece[triangles[face as usize][0] as usize];
            for edge in edges_of(&triangles[owner as usize]) {
                let [p, q] = edge.map(|v| positions[v as usize]);
                let shares = edge.iter().any(|v| triangles[face as usize].contains(v));
                if !shares && edge_crosses_triangle(p, q, a, b, c) {
                    hits.push(Hit { edge, piece, face, owner });
                }
            }
        }
    }
    hits.sort_unstable();
    hits
}

/// A part of a piece that is cut off and lies on the wrong side.
pub(super) struct Region {
    /// Its vertices, ascending.
    pub vertices: Vec<u32>,
    /// The cuts around the region: a hit, and the vertex of its edge that belongs to the region.
    pub cuts: Vec<(Hit, u32)>,
    /// True for a part of an obstacle. It cannot move, so the cloth moves in the opposite direction.
    pub obstacle: bool,
}

/// Groups the hits by edge and piece. With an odd number of faces, the ends of the edge are on different sides.
pub(super) fn through(hits: &[Hit]) -> impl Iterator<Item = (&[Hit], bool)> {
    hits.chunk_by(|a, b| (a.edge, a.piece) == (b.edge, b.piece)).map(|run| {
        let faces = run.chunk_by(|a, b| a.face == b.face).count();
        (run, faces % 2 == 1)
    })
}

/// The regions in processing order, and the number of the part that each vertex is in.
pub(super) fn regions(
    positions: &[Vec3],
    triangles: &[[u32; 3]],
    shape: &Shape,
    hits: &[Hit],
) -> (Vec<Region>, Vec<u32>) {
    let odd = || through(hits).filter(|(_, odd)| *odd).map(|(run, _)| run);
    let mut cut: Vec<[u32; 2]> = odd().map(|run| run[0].edge).collect();
    cut.dedup();
    let mut sets = Sets::new(positions.len());
    // Only a few pieces are cut, and only a few of their edges.
    let mut cut_vertex = vec![false; positions.len()];
    cut.iter().flatten().for_each(|&v| cut_vertex[v as usize] = true);
    for corners in triangles {
        for [a, b] in edges_of(corners) {
            let whole = !(cut_vertex[a as usize] && cut_vertex[b as usize]) || cut.binary_search(&[a, b]).is_err();
            if whole {
                sets.join(a, b);
            }
        }
    }
    let part = sets.roots();
    let mut size = vec![0u32; positions.len()];
    part.iter().for_each(|&root| size[root as usize] += 1);

    let mut found: BTreeMap<u32, Region> = BTreeMap::new();
    for hit in odd().flatten() {
        let [a, b] = hit.edge;
        let [of_a, of_b] = hit.edge.map(|v| part[v as usize]);
        if of_a == of_b {
            continue;
        }
        let outward = f64::from(shape.outward[hit.face as usize]);
        let rises = normal(positions, triangles[hit.face as usize]).dot(at(positions, b) - at(positions, a)) * outward;
        let wrong = match rises {
            _ if shape.obstacle[hit.owner as usize] => smaller([a, b], [of_a, of_b], &size),
            rises if rises > 0.0 => a,
            rises if rises < 0.0 => b,
            _ => smaller([a, b], [of_a, of_b], &size),
        };
        let obstacle = shape.obstacle[hit.owner as usize];
        let region = found.entry(part[wrong as usize]);
        region.or_insert_with(|| Region { vertices: Vec::new(), cuts: Vec::new(), obstacle }).cuts.push((*hit, wrong));
    }
    for (v, root) in (0..).zip(&part) {
        if let Some(region) = found.get_mut(root) {
            region.vertices.push(v);
        }
    }
    let mut found: Vec<Region> = found.into_values().collect();
    // Small regions come first, because the guess is most reliable for them. The sort is stable, so equal ones stay in
    // the order of their vertices.
    found.sort_by_key(|region| (region.obstacle, region.vertices.len()));
    (found, part)
}

fn smaller([a, b]: [u32; 2], [of_a, of_b]: [u32; 2], size: &[u32]) -> u32 {
    if (size[of_a as usize], of_a) < (size[of_b as usize], of_b) { a } else { b }
}

/// The edges of a triangle, the smaller vertex first.
pub(super) fn edges_of(&[a, b, c]: &[u32; 3]) -> [[u32; 2]; 3] {
    [[a, b], [b, c], [c, a]].map(|[a, b]| [a.min(b), a.max(b)])
}

pub(super) fn at(positions: &[Vec3], vertex: u32) -> DVec3 {
    positions[vertex as usize].as_dvec3()
}

/// Unit normal of a triangle, or zero.
pub(super) fn normal(positions: &[Vec3], corners: [u32; 3]) -> DVec3 {
    let [a, b, c] = corners.map(|v| at(positions, v));
    (b - a).cross(c - a).normalize_or_zero()
}

/// Union-find over vertices. The root of a set is its smallest vertex.
struct Sets(Vec<u32>);

impl Sets {
    fn new(vertices: usize) -> Sets {
        Sets((0..vertices as u32).collect())
    }

    fn root(&mut self, mut v: u32) -> u32 {
        while self.0[v as usize] != v {
            self.0[v as usize] = self.0[self.0[v as usize] as usize];
            v = self.0[v as usize];
        }
        v
    }

    fn join(&mut self, a: u32, b: u32) {
        let [a, b] = [self.root(a), self.root(b)];
        self.0[a.max(b) as usize] = a.min(b);
    }

    fn roots(mut self) -> Vec<u32> {
        (0..self.0.len() as u32).map(|v| self.root(v)).collect()
    }
}
