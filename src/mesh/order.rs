//! Vertex order for locality: recursive bisection. Depends on the coordinates alone, never on a number of ranks, so that
//! row blocks for any rank count are ranges of one order.

use crate::math::Vec3;

use super::TriangleMesh;

/// `old_from_new`: recursive bisection at the median of the longest axis, ties broken by the old index. O(n log n).
pub fn locality_order(coordinates: &[Vec3]) -> Vec<u32> {
    let mut points: Vec<(Vec3, u32)> = coordinates.iter().copied().zip(0..).collect();
    let mut ranges = vec![(0, points.len())];
    while let Some((start, end)) = ranges.pop() {
        let part = &mut points[start..end];
        if part.len() < 2 {
            continue;
        }
        let (low, high) = part.iter().fold((part[0].0, part[0].0), |(low, high), p| (low.min(p.0), high.max(p.0)));
        let extent = high - low;
        let axis = (0..3).fold(0, |longest, axis| if extent[axis] > extent[longest] { axis } else { longest });
        let middle = part.len() / 2;
        part.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1)));
        ranges.extend([(start, start + middle), (start + middle, end)]);
    }
    points.into_iter().map(|p| p.1).collect()
}

/// Coordinates to order a mesh's vertices by: material coordinates if it is one sheet without seams (a fold in space does
/// not bring its layers together there), positions otherwise.
pub fn ordering_coordinates(mesh: &TriangleMesh) -> Vec<Vec3> {
    const UNSEEN: Vec3 = Vec3::NAN;
    let mut coordinates = vec![UNSEEN; mesh.positions.len()];
    for (corners, uv) in mesh.triangles.iter().zip(&mesh.material_uv) {
        for (&v, uv) in corners.iter().zip(uv) {
            let slot = &mut coordinates[v as usize];
            if slot.is_nan() {
                *slot = uv.extend(0.0);
            } else if *slot != uv.extend(0.0) {
                return mesh.positions.clone();
            }
        }
    }
    if pieces(mesh) == 1 { coordinates } else { mesh.positions.clone() }
}

/// Number of connected pieces.
fn pieces(mesh: &TriangleMesh) -> usize {
    let mut parent: Vec<u32> = (0..mesh.positions.len() as u32).collect();
    let mut pieces = parent.len();
    for &[a, b, c] in &mesh.triangles {
        for other in [b, c] {
            let (root, joined) = (find(&mut parent, a), find(&mut parent, other));
            if root != joined {
                parent[root.max(joined) as usize] = root.min(joined);
                pieces -= 1;
            }
        }
    }
    pieces
}

fn find(parent: &mut [u32], mut v: u32) -> u32 {
    while parent[v as usize] != v {
        parent[v as usize] = parent[parent[v as usize] as usize];
        v = parent[v as usize];
    }
    v
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Vec2;

    #[test]
    fn halves_lie_on_either_side_of_the_median_and_ties_follow_the_index() {
        let line = [3.0, 1.0, 2.0, 0.0].map(|x| Vec3::new(x, 0.0, 0.0));
        assert_eq!(locality_order(&line), [3, 1, 2, 0]);
        assert_eq!(locality_order(&[Vec3::ONE; 5]), [0, 1, 2, 3, 4]);
        assert!(locality_order(&[]).is_empty());
    }

    #[test]
    fn material_coordinates_serve_one_sheet_only() {
        let uv = [Vec2::ZERO, Vec2::X, Vec2::ONE];
        let mut mesh = TriangleMesh {
            positions: vec![Vec3::splat(7.0), Vec3::splat(8.0), Vec3::new(0.0, 7.0, 8.0), Vec3::splat(9.0)],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            material_uv: vec![uv, [Vec2::ZERO, Vec2::ONE, Vec2::Y]],
        };
        assert_eq!(ordering_coordinates(&mesh), [Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y]);
        mesh.material_uv[1][1] = Vec2::new(2.0, 2.0);
        assert_eq!(ordering_coordinates(&mesh), mesh.positions);
    }

    #[test]
    fn pieces_are_counted() {
        let mut mesh =
            TriangleMesh { positions: vec![Vec3::ZERO; 6], triangles: vec![[0, 1, 2], [3, 4, 5]], material_uv: vec![] };
        assert_eq!(pieces(&mesh), 2);
        mesh.triangles.push([2, 1, 3]);
        assert_eq!(pieces(&mesh), 1);
    }
}
