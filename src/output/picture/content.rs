//! The contents of a picture: cloth and obstacles of a frame as one set of triangles, with normals and colors per
//! vertex.

use crate::gpu::SWATCHES;
use crate::math::Vec3;
use crate::output::FrameMesh;

/// Colors of obstacles; those below are for pieces of cloth.
pub(super) const OBSTACLE: u32 = SWATCHES as u32 - 1;
/// Colors of pieces where there are several; 0 is for cloth in one piece.
const PIECE_COLORS: u32 = OBSTACLE - 1;
/// Obstacles keep the edges at which their triangles meet more sharply: cosine of 40 degrees.
const SMOOTH: f32 = 0.766;

/// Triangles ready to be drawn.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Content {
    /// Positions in the scene, meters.
    pub positions: Vec<Vec3>,
    /// Directions that the front faces, of unit length or zero.
    pub normals: Vec<Vec3>,
    /// Index into the colors; the same for all corners of a triangle.
    pub swatches: Vec<u32>,
    /// Those without broken (not finite) corners.
    pub triangles: Vec<[u32; 3]>,
}

impl Content {
    /// Cloth, every piece in a color of its own, and obstacles.
    pub(super) fn new(cloth: FrameMesh, obstacle: Option<FrameMesh>) -> Content {
        let normals = vertex_normals(&cloth);
        let swatches = piece_colors(cloth.positions.len(), &cloth.triangles);
        let mut content = Content { positions: cloth.positions, normals, swatches, triangles: cloth.triangles };
        let positions = &content.positions;
        content.triangles.retain(|t| t.iter().all(|i| positions[*i as usize].is_finite()));
        if let Some(obstacle) = obstacle {
            content.add_obstacle(&obstacle);
        }
        content
    }

    /// Every triangle gets corners of its own: their normals are the vertex's where the surface is smooth there, else the
    /// triangle's.
    fn add_obstacle(&mut self, obstacle: &FrameMesh) {
        let smooth = vertex_normals(obstacle);
        for t in &obstacle.triangles {
            let corners = t.map(|i| obstacle.positions[i as usize]);
            if !corners.iter().all(|p| p.is_finite()) {
                continue;
            }
            let flat = normal_of(corners).normalize_or_zero();
            let normals = t.map(|i| smooth[i as usize]);
            let first = self.positions.len() as u32;
            self.positions.extend(corners);
            self.normals.extend(normals.map(|n| if n.dot(flat) > SMOOTH { n } else { flat }));
            self.swatches.extend([OBSTACLE; 3]);
            self.triangles.push([first, first + 1, first + 2]);
        }
    }
}

/// Normal of a triangle, twice its area long.
fn normal_of([a, b, c]: [Vec3; 3]) -> Vec3 {
    (b - a).cross(c - a)
}

/// Directions of the sums of the triangles' normals, weighted by area.
fn vertex_normals(mesh: &FrameMesh) -> Vec<Vec3> {
    let mut normals = vec![Vec3::ZERO; mesh.positions.len()];
    for t in &mesh.triangles {
        let normal = normal_of(t.map(|i| mesh.positions[i as usize]));
        if normal.is_finite() {
            t.iter().for_each(|i| normals[*i as usize] += normal);
        }
    }
    // Unit length here: corners of big and small triangles shall count alike when normals are blended.
    normals.iter_mut().for_each(|n| *n = n.normalize_or_zero());
    normals
}

/// A color per vertex: 0 if all triangles hang together, else 1, 2, .. in the order of the pieces' first triangles, and
/// from the start when colors run out.
fn piece_colors(vertices: usize, triangles: &[[u32; 3]]) -> Vec<u32> {
    // Every vertex points to one of its piece with a smaller or equal number; the smallest points to itself.
    let mut parent: Vec<u32> = (0..vertices as u32).collect();
    for [a, b, c] in triangles {
        for (p, q) in [(*a, *b), (*a, *c)] {
            let (p, q) = (root(&mut parent, p), root(&mut parent, q));
            parent[p.max(q) as usize] = p.min(q);
        }
    }
    const NONE: u32 = u32::MAX;
    let mut piece_of_root = vec![NONE; vertices];
    let mut pieces = 0;
    for t in triangles {
        let root = root(&mut parent, t[0]) as usize;
        if piece_of_root[root] == NONE {
            piece_of_root[root] = pieces;
            pieces += 1;
        }
    }
    let color = |vertex: u32, parent: &mut [u32]| match piece_of_root[root(parent, vertex) as usize] {
        piece if pieces > 1 && piece != NONE => 1 + piece % PIECE_COLORS,
        _ => 0,
    };
    (0..vertices as u32).map(|vertex| color(vertex, &mut parent)).collect()
}

/// Smallest vertex of the piece, as far as it is known; shortens the way there.
fn root(parent: &mut [u32], mut vertex: u32) -> u32 {
    while parent[vertex as usize] != vertex {
        parent[vertex as usize] = parent[parent[vertex as usize] as usize];
        vertex = parent[vertex as usize];
    }
    vertex
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_numbered_by_their_first_triangles() {
        assert_eq!(piece_colors(5, &[[0, 1, 2], [2, 3, 4]]), [0; 5]);
        // Vertices 0, 4, 5 and 1, 2, 3 are two pieces, 6 belongs to none.
        assert_eq!(piece_colors(7, &[[3, 2, 1], [0, 4, 5]]), [2, 1, 1, 1, 2, 2, 0]);
        let islands: Vec<[u32; 3]> = (0..9).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        let colors = piece_colors(27, &islands);
        assert_eq!((colors[0], colors[18], colors[21], colors[26]), (1, 7, 1, 2));
        assert!(colors.iter().all(|color| *color < OBSTACLE));
    }

    #[test]
    fn broken_triangles_go_and_sharp_obstacles_stay_sharp() {
        let nan = Vec3::splat(f32::NAN);
        let cloth =
            FrameMesh { positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, nan], triangles: vec![[0, 1, 2], [0, 2, 3]] };
        // Two triangles that meet at a right angle along x.
        let roof =
            FrameMesh { positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z], triangles: vec![[0, 1, 2], [1, 0, 3]] };
        let content = Content::new(cloth, Some(roof));
        assert_eq!(content.triangles, [[0, 1, 2], [4, 5, 6], [7, 8, 9]]);
        assert_eq!(content.normals[4..7], [Vec3::Z; 3]);
        assert_eq!(content.normals[7..10], [Vec3::Y; 3]);
        assert_eq!(content.swatches, [0, 0, 0, 0, 8, 8, 8, 8, 8, 8]);
    }
}
