//! Angles at rest of the edges of a sewn mesh: seams have their own, and what is known of an edge goes on to the parts
//! of it.

use std::collections::HashMap;

use crate::mesh::{TriangleMesh, ascending, hinges};
use crate::scene::{Fold, Sewing};

/// The angle at rest of every edge of `joined`, the mesh of `panels` with its seams sewn, that a seam with an angle of
/// its own has made. Both meshes have the same triangles.
pub(super) fn folds_of_seams(panels: &TriangleMesh, joined: &TriangleMesh, sewing: &Sewing) -> HashMap<[u32; 2], f32> {
    let mut folds = HashMap::new();
    if sewing.angles.iter().all(|&angle| angle == 0.0) {
        return folds;
    }
    let seam = |[p, q]: [u32; 2]| {
        let pair = sewing.pairs.binary_search(&ascending([p, q])).ok();
        pair.map(|pair| sewing.seam_of_pair[pair])
    };
    for hinge in hinges(joined) {
        // The vertex of the panels that `vertex` is in each of both triangles.
        let before = |vertex: u32| {
            hinge.triangles.map(|t| {
                let corners = joined.triangles[t as usize].iter().zip(&panels.triangles[t as usize]);
                corners.fold(u32::MAX, |found, (&here, &there)| if here == vertex { there } else { found })
            })
        };
        let [a, b] = [hinge.vertices[0], hinge.vertices[1]];
        // Where seams meet in a corner, its pair has the first of them, and an edge of another one has that at its
        // other end.
        if let Some(seam) = seam(before(a)).max(seam(before(b))) {
            folds.insert([a, b], sewing.angles[seam as usize]);
        }
    }
    folds
}

/// Adds what `of_edge` knows of every edge, with ascending vertices, for the two parts of it that every level of
/// `halved` makes, and for the parts of those. `first`: the vertex in the middle of the first edge.
pub(super) fn add_parts<T: Copy>(of_edge: &mut HashMap<[u32; 2], T>, halved: &[Vec<[u32; 2]>], first: u32) {
    for (middle, &[a, b]) in (first..).zip(halved.iter().flatten()) {
        if let Some(&value) = of_edge.get(&ascending([a, b])) {
            of_edge.insert(ascending([a, middle]), value);
            of_edge.insert(ascending([b, middle]), value);
        }
    }
}

/// Folds in ascending order. What is flat needs none.
pub(super) fn listed(of_edge: impl Iterator<Item = ([u32; 2], f32)>) -> Vec<Fold> {
    let mut folds: Vec<Fold> =
        of_edge.filter(|(_, angle)| *angle != 0.0).map(|(edge, angle)| Fold { edge, angle }).collect();
    folds.sort_unstable_by_key(|fold| fold.edge);
    folds
}
