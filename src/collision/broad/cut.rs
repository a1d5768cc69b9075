//! Cutting triangles into patches: a few dozen neighboring triangles of one piece each. Depends on the mesh alone.

use std::ops::Range;

use crate::mesh::middle;

/// Most vertices whose triangles make a patch. In the locality order of vertices ([`crate::mesh::vertex_order`]) that
/// many consecutive ones, from one of its own cuts to the next, are neighbors.
const VERTICES: usize = 32;
/// Orders triangles, which are sorted by their smallest vertices, such that each patch is consecutive: the triangles of
/// one piece whose smallest vertex is in one of the parts into which `vertices` are cut as in their order. Adds the end
/// of each to `ends`.
pub(super) fn cut(
    triangles: &mut [[u32; 3]],
    pieces: &[u32],
    vertices: Range<usize>,
    chunk: usize,
    ends: &mut Vec<u32>,
) {
    if vertices.len() > VERTICES {
        let middle = middle(&vertices, chunk);
        cut(triangles, pieces, vertices.start..middle, chunk, ends);
        cut(triangles, pieces, middle..vertices.end, chunk, ends);
        return;
    }
    let smallest = |t: &[u32; 3]| t[0].min(t[1]).min(t[2]) as usize;
    let start = triangles.partition_point(|t| smallest(t) < vertices.start);
    let end = start + triangles[start..].partition_point(|t| smallest(t) < vertices.end);
    let piece = |t: &[u32; 3]| pieces[t[0] as usize];
    triangles[start..end].sort_by_key(piece);
    let mut at = start;
    for patch in triangles[start..end].chunk_by(|a, b| piece(a) == piece(b)) {
        at += patch.len();
        ends.push(at as u32);
    }
}
