//! Oracle of the tests: every vertex against every face and every edge against every edge, in quadratic time. Shares
//! only the boxes with the hashed search.

use super::boxes::Trajectories;
use super::mesh::CollisionMesh;
use super::query::{BroadError, Choice, Query};
use crate::collision::Candidate;

/// All pairs of features with overlapping boxes, sorted: what all ranks of [`super::Broad::candidates`] report together.
pub fn brute_force(mesh: &CollisionMesh, query: &Query) -> Result<Vec<Candidate>, BroadError> {
    let paths = Trajectories::new(mesh, query, &Choice::default())?;
    let obstacle = |vertex: u32| vertex as usize >= mesh.cloth_vertices;
    let mut found = Vec::new();
    let faces: Vec<_> = mesh.triangles.iter().map(|&t| paths.triangle(t)).collect();
    let mut used = vec![false; mesh.vertices];
    mesh.triangles.as_flattened().iter().for_each(|&v| used[v as usize] = true);
    for vertex in (0..mesh.vertices as u32).filter(|&v| used[v as usize]) {
        let own = paths.vertex(vertex);
        for (face, corners) in faces.iter().zip(&mesh.triangles) {
            if own.overlaps(face) && !corners.contains(&vertex) && !(obstacle(vertex) && obstacle(corners[0])) {
                found.push(Candidate::vertex_face(vertex, *corners));
            }
        }
    }
    let edges: Vec<_> = mesh.edges.iter().map(|&e| paths.edge(e)).collect();
    for (i, a) in mesh.edges.iter().enumerate() {
        for (j, b) in mesh.edges.iter().enumerate().skip(i + 1) {
            let apart = !a.contains(&b[0]) && !a.contains(&b[1]);
            if edges[i].overlaps(&edges[j]) && apart && !(obstacle(a[0]) && obstacle(b[0])) {
                found.push(Candidate::edge_edge(*a, *b));
            }
        }
    }
    found.sort_unstable();
    Ok(found)
}
