//! Meshes whose triangles divide those of a coarser mesh into four: dividing, and finding the coarser mesh again.

use super::{TriangleMesh, flatten_triangles};
use crate::math::Vec2;

/// How a mesh follows from a coarser one, every triangle of which it divides into four, once or several times.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refinement {
    /// The fine vertex of every coarse one, ascending.
    pub copies: Vec<u32>,
    /// Fine vertices in the middle of an edge, with the two ends of it in fine numbers. An end is one of `copies` or
    /// comes earlier here.
    pub middles: Vec<[u32; 3]>,
    /// The fine triangles of every coarse one, `parts` each.
    pub triangles: Vec<u32>,
    /// Fine triangles in a coarse one: 1, 4, 16, ...
    pub parts: usize,
}

impl Refinement {
    /// A mesh that is the same at both levels.
    pub fn none(vertices: usize, triangles: usize) -> Refinement {
        Refinement {
            copies: (0..vertices as u32).collect(),
            middles: Vec::new(),
            triangles: (0..triangles as u32).collect(),
            parts: 1,
        }
    }

    /// True if both levels are the same mesh.
    pub fn is_none(&self) -> bool {
        self.parts == 1
    }

    /// From the coarse mesh of `self` to the fine mesh of `finer`, whose coarse mesh is the fine one of `self`.
    pub fn then(&self, finer: &Refinement) -> Refinement {
        let up = |&vertex: &u32| finer.copies[vertex as usize];
        let own = self.middles.iter().map(|middle| middle.each_ref().map(up));
        let parts_of = |&t: &u32| &finer.triangles[t as usize * finer.parts..(t as usize + 1) * finer.parts];
        Refinement {
            copies: self.copies.iter().map(up).collect(),
            middles: own.chain(finer.middles.iter().copied()).collect(),
            triangles: self.triangles.iter().flat_map(parts_of).copied().collect(),
            parts: self.parts * finer.parts,
        }
    }

    /// From the coarse mesh of `self` to that of `lower`, which leads to the same fine mesh and is the finer of both.
    pub fn down_to(&self, lower: &Refinement) -> Refinement {
        let known = |vertex: u32| lower.copies.binary_search(&vertex).ok().map(|at| at as u32);
        let middle = |&[vertex, a, b]: &[u32; 3]| Some([known(vertex)?, known(a)?, known(b)?]);
        let mut coarse_of = vec![0; lower.triangles.len()];
        for (parts, t) in lower.triangles.chunks_exact(lower.parts).zip(0u32..) {
            parts.iter().for_each(|&part| coarse_of[part as usize] = t);
        }
        let within = |parts: &[u32]| {
            let mut within: Vec<u32> = parts.iter().map(|&part| coarse_of[part as usize]).collect();
            within.sort_unstable();
            within.dedup();
            within
        };
        Refinement {
            copies: self.copies.iter().filter_map(|&vertex| known(vertex)).collect(),
            middles: self.middles.iter().filter_map(middle).collect(),
            triangles: self.triangles.chunks_exact(self.parts).flat_map(within).collect(),
            parts: self.parts / lower.parts,
        }
    }

    /// The coarse vertices of a selection of fine ones, ascending. Of a selection without any, they are the ends of the
    /// coarse edges that its vertices lie on.
    pub fn coarse_of(&self, fine: &[u32]) -> Vec<u32> {
        let coarse_of = |vertex: u32| self.copies.binary_search(&vertex).ok().map(|coarse| coarse as u32);
        let mut coarse: Vec<u32> = fine.iter().filter_map(|&vertex| coarse_of(vertex)).collect();
        if coarse.is_empty() {
            let mut wanted = fine.to_vec();
            for [middle, a, b] in self.middles.iter().rev() {
                if wanted.contains(middle) {
                    wanted.extend([a, b]);
                }
            }
            coarse = wanted.into_iter().filter_map(coarse_of).collect();
        }
        coarse.sort_unstable();
        coarse.dedup();
        coarse
    }
}

/// Triangles divided into four.
pub(super) struct Divided {
    /// Triangle t of the coarse mesh is 4 t to 4 t + 3: those at its corners, then the one in the middle.
    pub triangles: Vec<[u32; 3]>,
    /// The ends of the edge that each added vertex halves, smaller one first. Added vertices follow the others.
    pub parents: Vec<[u32; 2]>,
    /// Added vertices on edges of one triangle.
    pub on_boundary: Vec<u32>,
}

/// Divides every triangle of a mesh of `vertices` vertices at the middles of its edges.
pub(super) fn divide(vertices: usize, triangles: &[[u32; 3]]) -> Divided {
    let mut middles = Middles::new(vertices, triangles);
    let mut parents = Vec::new();
    let mut fine = Vec::with_capacity(4 * triangles.len());
    for &[a, b, c] in triangles {
        let [ab, bc, ca] = [[a, b], [b, c], [c, a]].map(|[p, q]| {
            let ends = [p.min(q), p.max(q)];
            let next = (vertices + parents.len()) as u32;
            let middle = middles.of(ends, next);
            if middle == next {
                parents.push(ends);
            }
            middle
        });
        fine.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
    }
    Divided { triangles: fine, parents, on_boundary: middles.of_boundary().collect() }
}

impl TriangleMesh {
    /// The mesh with its vertices in another order, and the place of every vertex in it. Triangles keep theirs.
    /// `order`: every vertex once.
    pub fn reordered(self, order: &[u32]) -> (TriangleMesh, Vec<u32>) {
        let mut place_of = vec![0u32; order.len()];
        (0u32..).zip(order).for_each(|(place, &v)| place_of[v as usize] = place);
        let mesh = TriangleMesh {
            positions: order.iter().map(|&v| self.positions[v as usize]).collect(),
            triangles: self.triangles.iter().map(|t| t.map(|v| place_of[v as usize])).collect(),
            material_uv: self.material_uv,
        };
        (mesh, place_of)
    }

    /// The mesh with every triangle divided into four flat ones at the middles of its edges. Its vertices are the first
    /// ones of the result, and triangle t becomes 4 t to 4 t + 3.
    pub fn divided(&self) -> TriangleMesh {
        let Divided { triangles, parents, .. } = divide(self.positions.len(), &self.triangles);
        let mut positions = self.positions.clone();
        positions.extend(parents.iter().map(|&[a, b]| self.positions[a as usize].midpoint(self.positions[b as usize])));
        let of_parts = |&[a, b, c]: &[Vec2; 3]| {
            let [ab, bc, ca] = [a.midpoint(b), b.midpoint(c), c.midpoint(a)];
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        };
        TriangleMesh { positions, triangles, material_uv: self.material_uv.iter().flat_map(of_parts).collect() }
    }

    /// The ends of the edges that the vertices halve which [`TriangleMesh::divided`] adds, in their order.
    pub(crate) fn halved_edges(&self) -> Vec<[u32; 2]> {
        divide(self.positions.len(), &self.triangles).parents
    }
}

/// Middle vertex of every edge, found by the ends of the edge.
struct Middles {
    /// First slot of every vertex; its slots are for the edges of which it is the smaller end.
    first: Vec<u32>,
    /// An inner edge has two triangles, so some slots stay empty.
    slots: Vec<Option<Middle>>,
}

#[derive(Clone, Copy)]
struct Middle {
    larger_end: u32,
    vertex: u32,
    triangles: u32,
}

impl Middles {
    fn new(vertices: usize, triangles: &[[u32; 3]]) -> Middles {
        let mut first = vec![0u32; vertices + 1];
        for &[a, b, c] in triangles {
            [a.min(b), b.min(c), c.min(a)].into_iter().for_each(|v| first[v as usize + 1] += 1);
        }
        (0..vertices).for_each(|v| first[v + 1] += first[v]);
        Middles { slots: vec![None; first[vertices] as usize], first }
    }

    /// The middle of the edge with these ends, smaller one first; `next` from now on if it has none yet.
    fn of(&mut self, [low, high]: [u32; 2], next: u32) -> u32 {
        let range = self.first[low as usize] as usize..self.first[low as usize + 1] as usize;
        for slot in &mut self.slots[range] {
            let middle = slot.get_or_insert(Middle { larger_end: high, vertex: next, triangles: 0 });
            if middle.larger_end == high {
                middle.triangles += 1;
                return middle.vertex;
            }
        }
        unreachable!("an edge has a slot for each of its triangles")
    }

    /// The middles of edges with one triangle.
    fn of_boundary(&self) -> impl Iterator<Item = u32> {
        self.slots.iter().flatten().filter(|middle| middle.triangles == 1).map(|middle| middle.vertex)
    }
}

/// Largest relative difference of the halves of a divided edge, and of their sum from its length: what rounding in a
/// file and a slight smoothing of the divided mesh leave.
const UNEQUAL_MOST: f32 = 0.1;

/// The mesh that `fine` divides into four, if there is one, whatever the order of its vertices and triangles.
/// `is_shape`: the rest shape of `fine` is its shape in space, so that of the coarse mesh is, too.
///
/// Its vertices are vertices of `fine`, ascending; its triangles have the order of the triangles in their middles.
pub fn coarser(fine: &TriangleMesh, is_shape: bool) -> Option<(TriangleMesh, Refinement)> {
    let divisions = divisions(&fine.triangles)?;
    let mut is_old = vec![false; fine.positions.len()];
    let old = |division: &Division| [0, 1, 2].map(|k| fine.triangles[division.corners[k] as usize][division.old[k]]);
    divisions.iter().flat_map(old).for_each(|vertex| is_old[vertex as usize] = true);
    let copies: Vec<u32> = (0..fine.positions.len() as u32).filter(|&vertex| is_old[vertex as usize]).collect();
    let mut ends_of: Vec<Option<[u32; 2]>> = vec![None; fine.positions.len()];
    let mut mesh = TriangleMesh::default();
    let mut triangles = Vec::with_capacity(fine.triangles.len());
    for division in &divisions {
        let corners = old(division);
        let middle = fine.triangles[division.center as usize];
        // Corner k lies opposite to edge k of the middle triangle, so it lies between the middles k and k + 1.
        for k in 0..3 {
            let [p, q] = [corners[(k + 2) % 3], corners[k]];
            let ends = [p.min(q), p.max(q)];
            let known = ends_of[middle[k] as usize].get_or_insert(ends);
            if *known != ends || is_old[middle[k] as usize] {
                return None;
            }
        }
        mesh.triangles.push(corners.map(|v| copies.binary_search(&v).unwrap_or_default() as u32));
        mesh.material_uv.push([0, 1, 2].map(|k| fine.material_uv[division.corners[k] as usize][division.old[k]]));
        triangles.extend(division.corners);
        triangles.push(division.center);
    }
    mesh.positions = copies.iter().map(|&v| fine.positions[v as usize]).collect();
    if is_shape {
        mesh.material_uv = flatten_triangles(&mesh.positions, &mesh.triangles);
    }
    let halves = divisions.iter().zip(&mesh.material_uv).all(|(division, uv)| is_halved(fine, division, uv));
    let ends = (0u32..).zip(ends_of).filter_map(|(middle, ends)| ends.map(|[a, b]| [middle, a, b]));
    let refinement = Refinement { copies, middles: ends.collect(), triangles, parts: 4 };
    halves.then_some((mesh, refinement))
}

/// Whether the edges of a coarse triangle of material coordinates `uv` are halved in the rest shape.
fn is_halved(fine: &TriangleMesh, division: &Division, uv: &[Vec2; 3]) -> bool {
    // Length of the side of corner triangle k from its old vertex to the next (1) or the one before (2).
    let half = |k: usize, to: usize| {
        let (uv, old) = (&fine.material_uv[division.corners[k] as usize], division.old[k]);
        uv[old].distance(uv[(old + to) % 3])
    };
    (0..3).all(|k| {
        let (one, other) = (half(k, 1), half((k + 1) % 3, 2));
        let (sum, length) = (one + other, uv[k].distance(uv[(k + 1) % 3]));
        (one - other).abs() <= UNEQUAL_MOST * sum && (length - sum).abs() <= UNEQUAL_MOST * sum
    })
}

/// Four triangles that make up one.
struct Division {
    /// The one in the middle.
    center: u32,
    /// The one beyond each of its edges.
    corners: [u32; 3],
    /// Which of their vertices are those of the coarse triangle.
    old: [usize; 3],
}

/// What a triangle is in its division.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Place {
    Unknown,
    Center,
    /// At a corner, with the number of the vertex that the coarse mesh has.
    Corner(usize),
}

/// All divisions, ascending by their triangle in the middle; none if the triangles cannot be put together by fours.
fn divisions(triangles: &[[u32; 3]]) -> Option<Vec<Division>> {
    if triangles.is_empty() || !triangles.len().is_multiple_of(4) {
        return None;
    }
    let beyond = beyond_edges(triangles);
    let mut places = vec![Place::Unknown; triangles.len()];
    for t in 0..triangles.len() {
        if places[t] == Place::Unknown {
            // The triangle is in the middle, or one of its neighbors is.
            let centers = [Some(t as u32)].into_iter().chain(beyond[t]).flatten();
            centers.into_iter().find(|&center| spread(center, triangles, &beyond, &mut places))?;
        }
    }
    let centers = (0..triangles.len()).filter(|&t| places[t] == Place::Center);
    let division = |t: usize| {
        let corners = beyond[t].map(Option::unwrap_or_default);
        let old = corners.map(|corner| match places[corner as usize] {
            Place::Corner(old) => old,
            _ => 0,
        });
        Division { center: t as u32, corners, old }
    };
    let divisions: Vec<Division> = centers.map(division).collect();
    (4 * divisions.len() == triangles.len()).then_some(divisions)
}

/// Gives places to the connected piece around a triangle that is in the middle. False, and nothing is changed, if they
/// contradict each other.
fn spread(center: u32, triangles: &[[u32; 3]], beyond: &[[Option<u32>; 3]], places: &mut [Place]) -> bool {
    let mut given: Vec<u32> = Vec::new();
    let give = |t: u32, place: Place, given: &mut Vec<u32>, places: &mut [Place]| match places[t as usize] {
        Place::Unknown => {
            places[t as usize] = place;
            given.push(t);
            true
        }
        known => known == place,
    };
    let mut fits = give(center, Place::Center, &mut given, places);
    let mut next = 0;
    while fits && next < given.len() {
        let t = given[next] as usize;
        next += 1;
        for edge in 0..3 {
            let ends = [triangles[t][edge], triangles[t][(edge + 1) % 3]];
            let number_in = |other: u32, vertex: u32| triangles[other as usize].iter().position(|&v| v == vertex);
            let opposite = |other: u32| (0..3).find(|&k| !ends.contains(&triangles[other as usize][k]));
            fits &= match (places[t], beyond[t][edge]) {
                (Place::Center, Some(other)) => match opposite(other) {
                    Some(old) => give(other, Place::Corner(old), &mut given, places),
                    None => false,
                },
                (Place::Center, None) => false,
                // The edge opposite to the old vertex.
                (Place::Corner(old), other) if edge == (old + 1) % 3 => {
                    other.is_some_and(|other| give(other, Place::Center, &mut given, places))
                }
                (Place::Corner(old), Some(other)) => match number_in(other, triangles[t][old]) {
                    Some(number) => give(other, Place::Corner(number), &mut given, places),
                    None => false,
                },
                _ => true,
            };
        }
    }
    if !fits {
        given.iter().for_each(|&t| places[t as usize] = Place::Unknown);
    }
    fits
}

/// The triangle beyond each edge of every triangle; edge k runs from corner k to the next.
fn beyond_edges(triangles: &[[u32; 3]]) -> Vec<[Option<u32>; 3]> {
    let mut sides: Vec<(u64, u32)> = Vec::with_capacity(3 * triangles.len());
    for (t, corners) in triangles.iter().enumerate() {
        for k in 0..3 {
            let (from, to) = (corners[k], corners[(k + 1) % 3]);
            sides.push((u64::from(from.min(to)) << 32 | u64::from(from.max(to)), (3 * t + k) as u32));
        }
    }
    sides.sort_unstable();
    let mut beyond = vec![[None; 3]; triangles.len()];
    for pair in sides.windows(2).filter(|pair| pair[0].0 == pair[1].0) {
        let [one, other] = [pair[0].1, pair[1].1];
        beyond[one as usize / 3][one as usize % 3] = Some(other / 3);
        beyond[other as usize / 3][other as usize % 3] = Some(one / 3);
    }
    beyond
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::shapes;

    /// A closed surface, divided `times`, with vertices and triangles in another order.
    fn shuffled(times: usize) -> TriangleMesh {
        let mut mesh = sphere();
        (0..times).for_each(|_| mesh = mesh.divided());
        let (n, m) = (mesh.positions.len(), mesh.triangles.len());
        let vertex = |v: u32| (v as usize * 11 + 3) % n;
        assert!(!n.is_multiple_of(11) && !m.is_multiple_of(13));
        let mut other = mesh.clone();
        (0..n).for_each(|v| other.positions[vertex(v as u32)] = mesh.positions[v]);
        for t in 0..m {
            let to = (t * 13 + 5) % m;
            other.triangles[to] = mesh.triangles[t].map(|v| vertex(v) as u32);
            other.material_uv[to] = mesh.material_uv[t];
            other.triangles[to].rotate_left(t % 3);
            other.material_uv[to].rotate_left(t % 3);
        }
        other
    }

    fn sphere() -> TriangleMesh {
        let shape = shapes::sphere(1.0, 3);
        let material_uv = flatten_triangles(&shape.positions, &shape.triangles);
        TriangleMesh { positions: shape.positions, triangles: shape.triangles, material_uv }
    }

    #[test]
    fn a_divided_mesh_is_found_again_in_any_order() {
        let fine = shuffled(2);
        let (middle, upper) = coarser(&fine, true).expect("divided twice");
        let (coarse, lower) = coarser(&middle, true).expect("divided once more");
        assert_eq!(16 * coarse.triangles.len(), fine.triangles.len());
        let all = lower.then(&upper);
        assert_eq!((all.parts, all.copies.len()), (16, sphere().positions.len()));
        for (v, &of) in coarse.positions.iter().zip(&all.copies) {
            assert_eq!(*v, fine.positions[of as usize]);
        }
        assert_eq!(all.copies.len() + all.middles.len(), fine.positions.len());
        let mut known: Vec<u32> = all.copies.clone();
        for &[middle, a, b] in &all.middles {
            assert!(known.contains(&a) && known.contains(&b), "ends come first");
            known.push(middle);
            let [m, a, b] = [middle, a, b].map(|v| fine.positions[v as usize]);
            assert!(m.distance(a.midpoint(b)) < 1e-6);
        }
        let back = all.down_to(&upper);
        assert_eq!((&back.copies, &back.middles, back.parts), (&lower.copies, &lower.middles, 4));
        for (ours, theirs) in back.triangles.chunks_exact(4).zip(lower.triangles.chunks_exact(4)) {
            let mut theirs = theirs.to_vec();
            theirs.sort_unstable();
            assert_eq!(ours, theirs);
        }
        // The parts of a coarse triangle lie in it, and are as large as it is.
        let area = |mesh: &TriangleMesh, t: u32| {
            let [a, b, c] = mesh.triangles[t as usize].map(|v| mesh.positions[v as usize]);
            (b - a).cross(c - a)
        };
        for t in 0..coarse.triangles.len() {
            let parts: crate::math::Vec3 = all.triangles[16 * t..16 * (t + 1)].iter().map(|&t| area(&fine, t)).sum();
            assert!(parts.distance(area(&coarse, t as u32)) < 1e-5);
        }
        assert!(coarser(&sphere(), true).is_none(), "three parts per edge are not two");
    }

    #[test]
    fn a_mesh_that_is_no_division_has_no_coarser_one() {
        let mut fine = sphere().divided();
        assert!(coarser(&fine, true).is_some());
        // A vertex in the middle of an edge moves towards one of its ends.
        let [middle, a, _] = coarser(&fine, true).unwrap().1.middles[0];
        fine.positions[middle as usize] = fine.positions[middle as usize].lerp(fine.positions[a as usize], 0.4);
        fine.material_uv = flatten_triangles(&fine.positions, &fine.triangles);
        assert!(coarser(&fine, true).is_none());
        let mut fine = sphere().divided();
        // An edge is turned round.
        let hinge = crate::mesh::hinges(&fine)[17];
        let [a, b, c, d] = hinge.vertices;
        let [s, t] = hinge.triangles.map(|t| t as usize);
        (fine.triangles[s], fine.triangles[t]) = ([c, a, d], [d, b, c]);
        assert!(coarser(&fine, true).is_none());
    }

    #[test]
    fn a_selection_has_coarse_vertices() {
        let fine = sphere().divided();
        let (_, up) = coarser(&fine, true).unwrap();
        let [middle, a, b] = up.middles[5];
        assert_eq!(up.coarse_of(&[up.copies[7], middle, up.copies[2]]), [2, 7]);
        let mut ends = [a, b].map(|v| up.copies.binary_search(&v).unwrap() as u32);
        ends.sort_unstable();
        assert_eq!(up.coarse_of(&[middle]), ends);
    }
}
