//! Rounder surfaces for pictures: Loop subdivision [Loop 1987]. It moves vertices, so what a picture shows between
//! them is not the surface that a run has proven free of crossings.

use std::collections::HashMap;

use crate::math::Vec3;

/// A mesh with two colors per vertex.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Colored {
    /// Meters.
    pub positions: Vec<Vec3>,
    /// Front and back of every vertex.
    pub colors: Vec<[Vec3; 2]>,
    /// Valid indices.
    pub triangles: Vec<[u32; 3]>,
}

/// The two ends and up to two opposite corners of an edge.
struct Edge {
    ends: [u32; 2],
    opposite: [u32; 2],
    triangles: u32,
}

/// The mesh with four triangles for each: inner vertices move to the mean of 5/8 to 7/16 of themselves and their
/// neighbors, those of a border as a cubic spline. Edges of more than two triangles count as border.
pub(super) fn subdivided(mesh: &Colored) -> Colored {
    let vertices = mesh.positions.len();
    let mut edges: Vec<Edge> = Vec::with_capacity(mesh.triangles.len() * 3 / 2);
    let mut edge_of = HashMap::with_capacity(mesh.triangles.len() * 3 / 2);
    let mut sides = Vec::with_capacity(mesh.triangles.len());
    for &[a, b, c] in &mesh.triangles {
        sides.push([(a, b, c), (b, c, a), (c, a, b)].map(|(from, to, opposite)| {
            let ends = [from.min(to), from.max(to)];
            let number = *edge_of.entry(ends).or_insert_with(|| {
                edges.push(Edge { ends, opposite: [0; 2], triangles: 0 });
                edges.len() - 1
            });
            let edge = &mut edges[number];
            if edge.triangles < 2 {
                edge.opposite[edge.triangles as usize] = opposite;
            }
            edge.triangles += 1;
            number as u32
        }));
    }
    // Sums over neighbors: of all edges, and of edges of the border.
    let mut ring = vec![(Vec3::ZERO, 0u32); vertices];
    let mut rim = vec![(Vec3::ZERO, 0u32); vertices];
    for edge in &edges {
        for (own, other) in [(edge.ends[0], edge.ends[1]), (edge.ends[1], edge.ends[0])] {
            let neighbor = mesh.positions[other as usize];
            let add = |sum: &mut (Vec3, u32)| *sum = (sum.0 + neighbor, sum.1 + 1);
            add(&mut ring[own as usize]);
            if edge.triangles != 2 {
                add(&mut rim[own as usize]);
            }
        }
    }
    let moved = (0..vertices).map(|v| match (mesh.positions[v], ring[v], rim[v]) {
        (own, (sum, count), (_, 0)) if count > 2 => {
            let near = 0.375 + 0.25 * (std::f32::consts::TAU / count as f32).cos();
            let share = 0.625 - near * near;
            own * (1.0 - share) + sum * (share / count as f32)
        }
        (own, _, (sum, 2)) => own * 0.75 + sum * 0.125,
        (own, ..) => own,
    });
    let mut fine = Colored { positions: moved.collect(), colors: mesh.colors.clone(), triangles: Vec::new() };
    for edge in &edges {
        let at = |v: u32| mesh.positions[v as usize];
        let (ends, opposite) = (at(edge.ends[0]) + at(edge.ends[1]), edge.opposite.map(at));
        let inner = edge.triangles == 2;
        fine.positions.push(if inner { ends * 0.375 + (opposite[0] + opposite[1]) * 0.125 } else { ends * 0.5 });
        let [a, b] = edge.ends.map(|v| mesh.colors[v as usize]);
        fine.colors.push([0, 1].map(|side| 0.5 * (a[side] + b[side])));
    }
    for (&[a, b, c], side) in mesh.triangles.iter().zip(&sides) {
        let [ab, bc, ca] = side.map(|edge| vertices as u32 + edge);
        fine.triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
    }
    fine
}

#[cfg(test)]
mod tests {
    use super::*;

    fn colored(positions: Vec<Vec3>, triangles: Vec<[u32; 3]>) -> Colored {
        Colored { colors: vec![[Vec3::ONE, Vec3::ZERO]; positions.len()], positions, triangles }
    }

    #[test]
    fn a_flat_mesh_stays_flat_and_keeps_its_corners_colors_and_sides() {
        let corners = vec![Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y];
        let fine = subdivided(&colored(corners, vec![[0, 1, 2], [0, 2, 3]]));
        assert_eq!((fine.positions.len(), fine.triangles.len()), (9, 8));
        assert!(fine.positions.iter().all(|p| p.z == 0.0) && fine.colors.iter().all(|c| *c == [Vec3::ONE, Vec3::ZERO]));
        let up = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| fine.positions[v as usize]);
            (b - a).cross(c - a).z > 0.0
        };
        assert!(fine.triangles.iter().all(up));
    }

    #[test]
    fn an_octahedron_becomes_nearly_a_sphere() {
        let corners = vec![Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z];
        let [x, y, z, left, down, back] = [0u32, 1, 2, 3, 4, 5];
        let faces = vec![
            [x, y, z],
            [y, left, z],
            [left, down, z],
            [down, x, z],
            [y, x, back],
            [left, y, back],
            [down, left, back],
            [x, down, back],
        ];
        let mesh = subdivided(&colored(corners, faces));
        // [Loop 1987]: a corner of four edges goes to 1 - 31/64 of itself, the middle of an edge to 3/8 of both ends.
        assert!((mesh.positions[0] - Vec3::X * 33.0 / 64.0).length() < 1e-6, "{}", mesh.positions[0]);
        assert!((mesh.positions[6] - Vec3::new(0.375, 0.375, 0.0)).length() < 1e-6, "{}", mesh.positions[6]);
        let mesh = subdivided(&subdivided(&mesh));
        assert_eq!(mesh.triangles.len(), 8 * 64);
        let radii = || mesh.positions.iter().map(|p| p.length());
        let spread = radii().fold(0.0, f32::max) / radii().fold(f32::MAX, f32::min);
        assert!(spread < 1.1, "{spread}");
    }
}
