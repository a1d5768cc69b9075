//! Edges across panels that seams would lay on each other.
//!
//! A triangle with two sides on the border of a panel has a third one between two vertices of seams, and the panel on
//! the other side of the seams may have one between the same two. Sewn, they would be one edge of four triangles. A
//! vertex in the middle of one of them keeps them apart.

use std::collections::{BTreeMap, BTreeSet};

use crate::mesh::{TriangleMesh, ascending};

/// A vertex of a piece of cloth.
type Vertex = (usize, u32);

/// The edges that need a vertex in their middle, by piece. `joined`: vertices that seams make one; `cut`: edges along
/// seams that get vertices, ascending.
pub(super) fn chords(
    meshes: &[&TriangleMesh],
    joined: &[[Vertex; 2]],
    cut: &BTreeSet<(usize, [u32; 2])>,
) -> Vec<(usize, [u32; 2])> {
    let mut place: BTreeMap<Vertex, Vertex> = BTreeMap::new();
    for &[a, b] in joined {
        let [a, b] = [a, b].map(|vertex| place_of(&place, vertex));
        place.insert(a.max(b), a.min(b));
        place.entry(a.min(b)).or_insert(a.min(b));
    }
    let mut of_places: BTreeMap<[Vertex; 2], BTreeMap<(usize, [u32; 2]), usize>> = BTreeMap::new();
    for (piece, mesh) in meshes.iter().enumerate() {
        let is_on_seam = |v: u32| place.contains_key(&(piece, v));
        for &[a, b, c] in &mesh.triangles {
            for edge in [[a, b], [b, c], [c, a]].map(ascending) {
                if edge.iter().all(|&v| is_on_seam(v)) && !cut.contains(&(piece, edge)) {
                    let mut ends = edge.map(|v| place_of(&place, (piece, v)));
                    ends.sort_unstable();
                    *of_places.entry(ends).or_default().entry((piece, edge)).or_default() += 1;
                }
            }
        }
    }
    let mut found = Vec::new();
    for edges in of_places.values() {
        let mut triangles: usize = edges.values().sum();
        // What is left is the border, or else the last edge within a panel.
        for (&edge, _) in edges.iter().filter(|(_, count)| **count == 2) {
            if triangles > 2 {
                found.push(edge);
                triangles -= 2;
            }
        }
    }
    found
}

/// Where a vertex is once seams are sewn: the first of all that meet there.
fn place_of(place: &BTreeMap<Vertex, Vertex>, vertex: Vertex) -> Vertex {
    let mut at = vertex;
    while let Some(&next) = place.get(&at).filter(|next| **next != at) {
        at = next;
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_of_two_edges_that_would_meet_is_found() {
        // A corner of two panels: the triangles beyond their third sides, and seams along both other sides.
        let panel = TriangleMesh { triangles: vec![[0, 1, 2], [1, 3, 2]], ..TriangleMesh::default() };
        let joined = [[(0, 0), (1, 0)], [(0, 1), (1, 2)], [(0, 2), (1, 1)]];
        let meshes = [&panel, &panel];
        assert_eq!(chords(&meshes, &joined, &BTreeSet::new()), [(0, [1, 2])]);
        assert_eq!(chords(&meshes, &joined[..2], &BTreeSet::new()), []);
        // The other panel has its edge between other vertices.
        let other = TriangleMesh { triangles: vec![[0, 1, 3], [0, 3, 2]], ..TriangleMesh::default() };
        assert_eq!(chords(&[&panel, &other], &joined, &BTreeSet::new()), []);
    }
}
