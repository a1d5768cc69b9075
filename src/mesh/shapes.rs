//! Parametric surfaces for obstacles: spheres, rectangles, boxes and surfaces of revolution.
//!
//! Points are computed in f64 and rounded once. Triangles share their vertices, so a closed shape has no seam. The
//! shapes have no material coordinates, because they are not cloth.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use crate::math::DVec3;

use super::Surface;

/// A sphere around the origin: each face of an icosahedron is divided into `frequency`^2 triangles, so there are 20
/// `frequency`^2 of nearly equal size. Faces point outward.
pub fn sphere(radius_m: f64, frequency: u32) -> Surface {
    let n = frequency.max(1);
    let (corners, faces) = icosahedron();
    let mut surface = Builder::default();
    // A point is identified by its weights at the corners, so that faces share the points on edges and corners.
    let mut known: BTreeMap<[(usize, u32); 3], u32> = BTreeMap::new();
    for [a, b, c] in faces {
        let mut at = |i: u32, j: u32| {
            let mut key = [(a, n - i - j), (b, i), (c, j)];
            key.iter_mut().filter(|entry| entry.1 == 0).for_each(|entry| entry.0 = usize::MAX);
            key.sort_unstable();
            *known.entry(key).or_insert_with(|| {
                let sum = corners[a] * f64::from(n - i - j) + corners[b] * f64::from(i) + corners[c] * f64::from(j);
                surface.point(sum.normalize() * radius_m)
            })
        };
        let mut triangles = Vec::new();
        for i in 0..n {
            for j in 0..n - i {
                triangles.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
                if i + j + 1 < n {
                    triangles.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
        surface.triangles.extend(triangles);
    }
    surface.finish()
}

/// Corners and outward faces.
fn icosahedron() -> ([DVec3; 12], [[usize; 3]; 20]) {
    let g = (1.0 + 5f64.sqrt()) / 2.0;
    let corners = [
        [-1.0, g, 0.0],
        [1.0, g, 0.0],
        [-1.0, -g, 0.0],
        [1.0, -g, 0.0],
        [0.0, -1.0, g],
        [0.0, 1.0, g],
        [0.0, -1.0, -g],
        [0.0, 1.0, -g],
        [g, 0.0, -1.0],
        [g, 0.0, 1.0],
        [-g, 0.0, -1.0],
        [-g, 0.0, 1.0],
    ]
    .map(|corner| DVec3::from(corner).normalize());
    // Three corners at edge length from each other are a face. Their order makes it point outward.
    let edge = corners[0].distance(corners[1]) * 1.01;
    let near = |a: usize, b: usize| corners[a].distance(corners[b]) < edge;
    let mut faces = [[0; 3]; 20];
    let mut found = 0;
    for a in 0..12 {
        for b in a + 1..12 {
            for c in b + 1..12 {
                if near(a, b) && near(b, c) && near(c, a) {
                    let outward = (corners[b] - corners[a]).cross(corners[c] - corners[a]).dot(corners[a]) > 0.0;
                    faces[found] = if outward { [a, b, c] } else { [a, c, b] };
                    found += 1;
                }
            }
        }
    }
    (corners, faces)
}

/// A horizontal rectangle around the origin with `cells` along x and z. Its faces point to +y.
pub fn rectangle(size_m: [f64; 2], cells: [u32; 2]) -> Surface {
    let [columns, rows] = cells.map(|n| n.max(1));
    let mut surface = Builder::default();
    for row in 0..=rows {
        for column in 0..=columns {
            let (x, z) = (along(size_m[0], column, columns), along(size_m[1], row, rows));
            surface.point(DVec3::new(x, 0.0, z));
        }
    }
    let at = |column: u32, row: u32| row * (columns + 1) + column;
    for row in 0..rows {
        for column in 0..columns {
            surface.quad([at(column, row), at(column, row + 1), at(column + 1, row + 1), at(column + 1, row)]);
        }
    }
    surface.finish()
}

/// A closed box around the origin with `cells` along x, y and z. Faces point outward.
pub fn cuboid(size_m: [f64; 3], cells: [u32; 3]) -> Surface {
    let n = cells.map(|n| n.max(1));
    let mut surface = Builder::default();
    let mut known: BTreeMap<[u32; 3], u32> = BTreeMap::new();
    for axis in 0..3 {
        let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
        for end in [0, n[axis]] {
            for i in 0..n[u] {
                for j in 0..n[v] {
                    let corners = [[i, j], [i + 1, j], [i + 1, j + 1], [i, j + 1]].map(|[i, j]| {
                        let mut at = [0; 3];
                        (at[axis], at[u], at[v]) = (end, i, j);
                        *known.entry(at).or_insert_with(|| {
                            surface.point(DVec3::from([0, 1, 2].map(|k| along(size_m[k], at[k], n[k]))))
                        })
                    });
                    let [a, b, c, d] = corners;
                    surface.quad(if end == 0 { [d, c, b, a] } else { [a, b, c, d] });
                }
            }
        }
    }
    surface.finish()
}

/// The surface that the profile (radius, height) sweeps around the y axis, open at both ends. Faces point outward where
/// the profile rises. Every radius must be above 0 and `segments` at least 3.
pub fn revolution(profile: &[[f64; 2]], segments: u32) -> Surface {
    let mut surface = Builder::default();
    for &[radius, height] in profile {
        for i in 0..segments {
            let (sin, cos) = (TAU * f64::from(i) / f64::from(segments)).sin_cos();
            surface.point(DVec3::new(radius * cos, height, radius * sin));
        }
    }
    let at = |ring: usize, i: u32| ring as u32 * segments + i % segments;
    for ring in 1..profile.len() {
        for i in 0..segments {
            surface.quad([at(ring - 1, i), at(ring, i), at(ring, i + 1), at(ring - 1, i + 1)]);
        }
    }
    surface.finish()
}

fn along(size: f64, i: u32, n: u32) -> f64 {
    size * (f64::from(i) / f64::from(n) - 0.5)
}

#[derive(Default)]
struct Builder {
    points: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
}

impl Builder {
    fn point(&mut self, point: DVec3) -> u32 {
        self.points.push(point);
        self.points.len() as u32 - 1
    }

    fn quad(&mut self, [a, b, c, d]: [u32; 4]) {
        self.triangles.extend([[a, b, c], [a, c, d]]);
    }

    fn finish(self) -> Surface {
        let positions = self.points.iter().map(|point| point.as_vec3()).collect();
        Surface { positions, triangles: self.triangles, ..Surface::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::validate::check_surface;

    /// Volume by the divergence theorem; positive = faces outwards.
    fn volume(surface: &Surface) -> f64 {
        let corner = |v: u32| surface.positions[v as usize].as_dvec3();
        surface.triangles.iter().map(|&[a, b, c]| corner(a).dot(corner(b).cross(corner(c))) / 6.0).sum()
    }

    #[test]
    fn spheres_are_closed_round_and_face_outwards() {
        for frequency in [1, 2, 3, 7, 16] {
            let sphere = sphere(2.0, frequency);
            let n = frequency as usize;
            assert_eq!((sphere.triangles.len(), sphere.positions.len()), (20 * n * n, 10 * n * n + 2));
            check_surface(&sphere.positions, &sphere.triangles).unwrap();
            assert!(sphere.positions.iter().all(|p| (p.length() - 2.0).abs() < 1e-6));
        }
        let ball = 4.0 / 3.0 * std::f64::consts::PI * 8.0;
        assert!((volume(&sphere(2.0, 16)) / ball - 1.0).abs() < 0.01);
    }

    #[test]
    fn boxes_are_closed_and_face_outwards() {
        let cuboid = cuboid([1.0, 2.0, 3.0], [2, 3, 4]);
        check_surface(&cuboid.positions, &cuboid.triangles).unwrap();
        assert_eq!(cuboid.triangles.len(), 4 * (2 * 3 + 3 * 4 + 4 * 2));
        // Euler: v - e + f = 2 with e = 3 f / 2.
        assert_eq!(cuboid.positions.len(), 2 + cuboid.triangles.len() / 2);
        assert!((volume(&cuboid) - 6.0).abs() < 1e-6);
    }

    #[test]
    fn rectangles_face_up_and_funnels_open_upwards_face_out() {
        let plane = rectangle([2.0, 4.0], [2, 3]);
        check_surface(&plane.positions, &plane.triangles).unwrap();
        let [a, b, c] = plane.triangles[0].map(|v| plane.positions[v as usize]);
        assert!((b - a).cross(c - a).y > 0.0);
        assert_eq!((plane.positions[0].to_array(), plane.triangles.len()), ([-1.0, 0.0, -2.0], 12));
        let cone = revolution(&[[1.0, 0.0], [2.0, 1.0]], 8);
        check_surface(&cone.positions, &cone.triangles).unwrap();
        let [a, b, c] = cone.triangles[0].map(|v| cone.positions[v as usize]);
        assert!((b - a).cross(c - a).x > 0.0);
        assert_eq!((cone.positions.len(), cone.triangles.len()), (16, 16));
    }
}
