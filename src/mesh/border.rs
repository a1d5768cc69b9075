//! The border of a mesh: its edges with one triangle, ways along it, and vertices added on edges.

use std::collections::{HashMap, HashSet};

use super::{FileMesh, TriangleMesh};
use crate::math::Vec2;

/// An edge of the border, found by its two vertices in ascending order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BorderEdge {
    /// The only triangle with this edge.
    pub triangle: u32,
    /// True if the triangle runs along the edge from the smaller vertex to the larger one.
    pub ascends: bool,
    /// Length in the rest shape, meters.
    pub length_m: f64,
}

/// All edges of a mesh that have one triangle.
#[derive(Clone, Debug)]
pub struct Border {
    edges: HashMap<[u32; 2], BorderEdge>,
    /// The vertices joined to a vertex by an edge of the border, in the order of the triangles.
    beside: HashMap<u32, Vec<u32>>,
}

/// Both vertices of an edge, the smaller one first.
pub(crate) fn ascending([a, b]: [u32; 2]) -> [u32; 2] {
    [a.min(b), a.max(b)]
}

impl Border {
    /// The border of `mesh`.
    pub fn new(mesh: &TriangleMesh) -> Border {
        let mut edges = HashMap::new();
        let mut inner = HashSet::new();
        for (t, (corners, uv)) in mesh.triangles.iter().zip(&mesh.material_uv).enumerate() {
            for side in 0..3 {
                let [a, b] = [corners[side], corners[(side + 1) % 3]];
                let length_m = uv[side].as_dvec2().distance(uv[(side + 1) % 3].as_dvec2());
                let edge = BorderEdge { triangle: t as u32, ascends: a < b, length_m };
                if edges.insert(ascending([a, b]), edge).is_some() {
                    inner.insert(ascending([a, b]));
                }
            }
        }
        edges.retain(|edge, _| !inner.contains(edge));
        let mut beside: HashMap<u32, Vec<u32>> = HashMap::new();
        for corners in &mesh.triangles {
            for side in 0..3 {
                let [a, b] = [corners[side], corners[(side + 1) % 3]];
                if edges.contains_key(&ascending([a, b])) {
                    beside.entry(a).or_default().push(b);
                    beside.entry(b).or_default().push(a);
                }
            }
        }
        Border { edges, beside }
    }

    /// The edge between two vertices, if it belongs to the border.
    pub fn edge(&self, a: u32, b: u32) -> Option<BorderEdge> {
        self.edges.get(&ascending([a, b])).copied()
    }

    /// The vertices along the border from one vertex to another one, both included, on the shorter of the two ways at
    /// rest; none if they do not lie on one loop of the border.
    pub fn way(&self, from: u32, to: u32) -> Option<Vec<u32>> {
        if from != to && self.edge(from, to).is_some() {
            return Some(vec![from, to]);
        }
        let mut best: Option<(f64, Vec<u32>)> = None;
        for &first in self.beside.get(&from)? {
            let (mut length_m, mut way) = (0.0, vec![from]);
            let (mut before, mut at) = (from, first);
            while way.len() <= self.edges.len() {
                length_m += self.edge(before, at)?.length_m;
                way.push(at);
                if at == to || at == from {
                    break;
                }
                let next = self.beside.get(&at)?.iter().copied().find(|&next| next != before)?;
                (before, at) = (at, next);
            }
            if at == to && best.as_ref().is_none_or(|(length, _)| length_m < *length) {
                best = Some((length_m, way));
            }
        }
        best.map(|(_, way)| way)
    }
}

/// A place on an edge where a vertex is added.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EdgeCut {
    /// The ends of the edge.
    pub edge: [u32; 2],
    /// Share of the edge from its first end, above 0 and below 1.
    pub share: f64,
}

impl TriangleMesh {
    /// Adds a vertex at every cut, on the straight edge in space and at rest, and divides the triangles there. The
    /// surface stays the same. Returns the added vertices in the order of the cuts, which must all differ; they follow
    /// all others. The second list has the first part of every triangle, and the number of all parts.
    pub fn cut_edges(&mut self, cuts: &[EdgeCut]) -> (Vec<u32>, Vec<u32>) {
        let mut on_edge: HashMap<[u32; 2], Vec<(f64, u32)>> = HashMap::new();
        let mut added = Vec::with_capacity(cuts.len());
        for cut in cuts {
            let [a, b] = cut.edge;
            let vertex = self.positions.len() as u32;
            let [from, to] = [a, b].map(|v| self.positions[v as usize].as_dvec3());
            self.positions.push(from.lerp(to, cut.share).as_vec3());
            let share = if a < b { cut.share } else { 1.0 - cut.share };
            on_edge.entry(ascending([a, b])).or_default().push((share, vertex));
            added.push(vertex);
        }
        on_edge.values_mut().for_each(|on| on.sort_by(|a, b| a.0.total_cmp(&b.0)));
        let mut first_part = vec![0u32];
        let (mut triangles, mut material_uv) = (Vec::new(), Vec::new());
        for (corners, uv) in self.triangles.iter().zip(&self.material_uv) {
            for (corners, uv) in divided(*corners, *uv, &on_edge) {
                triangles.push(corners);
                material_uv.push(uv);
            }
            first_part.push(triangles.len() as u32);
        }
        (self.triangles, self.material_uv) = (triangles, material_uv);
        (added, first_part)
    }
}

impl FileMesh {
    /// As [`TriangleMesh::cut_edges`]; the parts of the mesh go on to the parts of their triangles.
    pub fn cut_edges(&mut self, cuts: &[EdgeCut]) -> Vec<u32> {
        let (added, first_part) = self.mesh.cut_edges(cuts);
        cuts.iter().for_each(|cut| self.note_added(cut.edge));
        for part in &mut self.parts {
            part.triangles = first_part[part.triangles.start as usize]..first_part[part.triangles.end as usize];
        }
        added
    }
}

/// A triangle and its material coordinates.
type Corners = ([u32; 3], [Vec2; 3]);

/// The parts of a triangle with vertices `on_edge` on its sides: of every side a fan from the corner opposite.
fn divided(corners: [u32; 3], uv: [Vec2; 3], on_edge: &HashMap<[u32; 2], Vec<(f64, u32)>>) -> Vec<Corners> {
    let mut parts: Vec<Corners> = vec![(corners, uv)];
    for side in 0..3 {
        let ends = [corners[side], corners[(side + 1) % 3]];
        let Some(on) = on_edge.get(&ascending(ends)) else { continue };
        let [uv_a, uv_b] = [uv[side], uv[(side + 1) % 3]].map(|uv| uv.as_dvec2());
        let mut points: Vec<(f64, u32)> = on.clone();
        if ends[0] > ends[1] {
            points = points.into_iter().rev().map(|(share, vertex)| (1.0 - share, vertex)).collect();
        }
        // The part that has the rest of the side, which begins with `from`.
        let mut from = ends[0];
        for (share, vertex) in points {
            let at = parts
                .iter()
                .position(|(corners, _)| (0..3).any(|i| corners[i] == from && corners[(i + 1) % 3] == ends[1]));
            let Some(at) = at else { continue };
            let (whole, whole_uv) = parts[at];
            let i = (0..3).find(|&i| whole[i] == from).unwrap_or_default();
            let point = uv_a.lerp(uv_b, share).as_vec2();
            let turn = |corners: [u32; 3], uv: [Vec2; 3], i: usize, vertex: u32| {
                let (mut corners, mut uv) = (corners, uv);
                (corners[i], uv[i]) = (vertex, point);
                (corners, uv)
            };
            parts[at] = turn(whole, whole_uv, (i + 1) % 3, vertex);
            parts.insert(at + 1, turn(whole, whole_uv, i, vertex));
            from = vertex;
        }
    }
    parts
}

/// Pairs of places on the two sides of a seam, given by the arc length of every vertex along its side, 0 to 1. Ends
/// meet ends; every vertex of the side with fewer vertices is paired with a vertex of the other side, without crossing
/// and with the least sum of squared differences; what is left of the other side falls between two of them.
pub fn match_sides(many: &[f64], few: &[f64]) -> Vec<Meeting> {
    assert!(many.len() >= few.len() && few.len() >= 2, "the side with more vertices comes first");
    let (n, m) = (many.len(), few.len());
    // best[j][i]: the least cost of pairing the first j + 1 of `few`, the last of them with `many[i]`.
    let cost = |i: usize, j: usize| (many[i] - few[j]).powi(2);
    let mut chosen = vec![0usize; m];
    chosen[m - 1] = n - 1;
    let mut best = vec![f64::INFINITY; n];
    best[0] = 0.0;
    let mut from: Vec<Vec<u32>> = Vec::with_capacity(m);
    for j in 1..m {
        let mut next = vec![f64::INFINITY; n];
        let mut came = vec![0u32; n];
        let (mut least, mut at) = (f64::INFINITY, 0);
        for i in 1..n {
            if best[i - 1] < least {
                (least, at) = (best[i - 1], i - 1);
            }
            let is_end = i == n - 1;
            if (j == m - 1) == is_end {
                next[i] = least + cost(i, j);
                came[i] = at as u32;
            }
        }
        from.push(came);
        best = next;
    }
    for j in (1..m).rev() {
        chosen[j - 1] = from[j - 1][chosen[j]] as usize;
    }
    let mut meetings = Vec::with_capacity(n);
    for j in 0..m - 1 {
        let [first, last] = [chosen[j], chosen[j + 1]];
        meetings.push(Meeting { many: first, few: j, share: 0.0 });
        let length = many[last] - many[first];
        let share = |i: usize| if length > 0.0 { (many[i] - many[first]) / length } else { 0.0 };
        let evenly = |i: usize| (i - first) as f64 / (last - first) as f64;
        for i in first + 1..last {
            let share = share(i);
            let share = if share > 0.0 && share < 1.0 { share } else { evenly(i) };
            meetings.push(Meeting { many: i, few: j, share });
        }
    }
    meetings.push(Meeting { many: n - 1, few: m - 1, share: 0.0 });
    meetings
}

/// A vertex of the side with more vertices, and the place on the other side that it meets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Meeting {
    /// Its number along its side.
    pub many: usize,
    /// The vertex of the other side at or before the place.
    pub few: usize,
    /// 0 at that vertex, else the share of the edge to the next one.
    pub share: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Vec3;
    use crate::mesh::{Part, flatten_triangles, validate};

    /// Two triangles of a unit square, 0 1 2 3 around it.
    fn square() -> FileMesh {
        let positions = vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y];
        let triangles = vec![[0, 1, 2], [0, 2, 3]];
        let material_uv = flatten_triangles(&positions, &triangles);
        let part = |name: &str, t| Part { object: name.into(), group: String::new(), triangles: t..t + 1 };
        let mesh = TriangleMesh { positions, triangles, material_uv };
        let mut file = FileMesh::from(mesh);
        file.parts = vec![part("low", 0), part("high", 1)];
        file
    }

    #[test]
    fn ways_along_the_border_take_the_shorter_side() {
        let mut file = square();
        assert_eq!(Border::new(&file.mesh).way(0, 1), Some(vec![0, 1]));
        assert_eq!(Border::new(&file.mesh).edge(0, 2), None);
        let added = file.cut_edges(&[EdgeCut { edge: [0, 1], share: 0.5 }, EdgeCut { edge: [3, 0], share: 0.25 }]);
        assert_eq!(added, [4, 5]);
        let border = Border::new(&file.mesh);
        assert_eq!(border.way(0, 1), Some(vec![0, 4, 1]));
        assert_eq!(border.way(5, 4), Some(vec![5, 0, 4]));
        assert_eq!(border.way(4, 5), Some(vec![4, 0, 5]));
        assert!((border.edge(5, 3).unwrap().length_m - 0.25).abs() < 1e-6);
        assert_eq!(border.way(0, 9), None);
    }

    #[test]
    fn cuts_keep_the_surface_and_its_parts() {
        let mut file = square();
        let cuts = [
            EdgeCut { edge: [1, 0], share: 0.25 },
            EdgeCut { edge: [0, 1], share: 0.25 },
            EdgeCut { edge: [1, 2], share: 0.5 },
            EdgeCut { edge: [2, 3], share: 0.9 },
        ];
        assert_eq!(file.cut_edges(&cuts), [4, 5, 6, 7]);
        assert_eq!(validate(&file.mesh), Ok(()));
        let at = |v: usize| file.mesh.positions[v];
        assert_eq!([at(4), at(5)], [Vec3::new(0.75, 0.0, 0.0), Vec3::new(0.25, 0.0, 0.0)]);
        assert_eq!(file.mesh.triangles.len(), 6);
        assert_eq!([file.parts[0].triangles.clone(), file.parts[1].triangles.clone()], [0..4, 4..6]);
        let areas = file.mesh.material_uv.iter().map(|[a, b, c]| (*b - *a).perp_dot(*c - *a) / 2.0);
        assert!((areas.clone().sum::<f32>() - 1.0).abs() < 1e-6 && areas.into_iter().all(|area| area > 0.0));
        // What a file counts from stays.
        assert_eq!((file.vertex(3), file.vertex(4)), (Some(3), None));
    }

    #[test]
    fn sides_of_different_counts_meet_end_to_end_and_in_order() {
        let meet = |many: &[f64], few: &[f64]| {
            match_sides(many, few).iter().map(|one| (one.many, one.few, one.share)).collect::<Vec<_>>()
        };
        assert_eq!(meet(&[0.0, 0.4, 1.0], &[0.0, 0.6, 1.0]), [(0, 0, 0.0), (1, 1, 0.0), (2, 2, 0.0)]);
        assert_eq!(meet(&[0.0, 0.5, 1.0], &[0.0, 1.0]), [(0, 0, 0.0), (1, 0, 0.5), (2, 1, 0.0)]);
        let many: Vec<f64> = (0..=10).map(|i| f64::from(i) / 10.0).collect();
        let found = meet(&many, &[0.0, 0.33, 0.68, 1.0]);
        assert_eq!(found.len(), 11);
        assert_eq!([found[3], found[7]], [(3, 1, 0.0), (7, 2, 0.0)]);
        assert!((found[1].2 - 1.0 / 3.0).abs() < 1e-12 && found[1].1 == 0);
        // A vertex of the side with fewer is never dropped, however close they lie.
        let found = meet(&many, &[0.0, 0.01, 0.02, 0.03, 1.0]);
        assert_eq!(found.iter().filter(|one| one.2 == 0.0).count(), 5);
    }
}
