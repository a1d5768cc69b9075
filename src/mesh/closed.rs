//! Parts of a mesh that close a volume.

use std::collections::HashMap;

use crate::math::Vec3;

/// For every triangle of a part that closes a volume 1 if its corners run counterclockwise seen from outside and -1 if
/// they run clockwise; 0 for those of a part with a border. A part is what hangs together by edges. In a part that
/// crosses itself, outside is where most of the volume is not.
pub fn closed_parts(triangles: &[[u32; 3]], positions: &[Vec3]) -> Vec<f32> {
    let mut of_edge: HashMap<[u32; 2], Vec<u32>> = HashMap::new();
    for (t, corners) in (0u32..).zip(triangles) {
        edges(corners).for_each(|edge| of_edge.entry(edge).or_default().push(t));
    }
    let mut outward: Vec<Option<f32>> = vec![None; triangles.len()];
    for first in 0..triangles.len() {
        if outward[first].is_some() {
            continue;
        }
        outward[first] = Some(0.0);
        let (mut part, mut next, mut closed, mut volume) = (vec![first as u32], 0, true, 0.0);
        // Far from the origin the volumes to it would cancel.
        let middle = positions[triangles[first][0] as usize].as_dvec3();
        while let Some(&t) = part.get(next) {
            let corners = &triangles[t as usize];
            let [a, b, c] = corners.map(|v| positions[v as usize].as_dvec3() - middle);
            volume += a.dot(b.cross(c));
            for edge in edges(corners) {
                let around = &of_edge[&edge];
                closed &= around.len() == 2;
                for &other in around {
                    if outward[other as usize].is_none() {
                        outward[other as usize] = Some(0.0);
                        part.push(other);
                    }
                }
            }
            next += 1;
        }
        if closed && volume != 0.0 {
            part.iter().for_each(|&t| outward[t as usize] = Some(volume.signum() as f32));
        }
    }
    outward.into_iter().map(Option::unwrap_or_default).collect()
}

fn edges([a, b, c]: &[u32; 3]) -> impl Iterator<Item = [u32; 2]> {
    [[*a, *b], [*b, *c], [*c, *a]].into_iter().map(|[a, b]| [a.min(b), a.max(b)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closed_parts_know_their_outside() {
        // A tetrahedron, one that is turned inside out, far away, and a single triangle.
        let corners = [Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::Z];
        let mut positions: Vec<Vec3> = corners.to_vec();
        positions.extend(corners.map(|p| p + Vec3::splat(500.0)));
        positions.extend(&corners[..3]);
        let outside = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
        let mut triangles: Vec<[u32; 3]> = outside.to_vec();
        triangles.extend(outside.map(|[a, b, c]| [b + 4, a + 4, c + 4]));
        triangles.push([8, 9, 10]);
        let found = closed_parts(&triangles, &positions);
        assert_eq!(found, [[1.0; 4].as_slice(), &[-1.0; 4], &[0.0]].concat());
        assert_eq!(closed_parts(&outside[..3], &corners), [0.0; 3], "one side is missing");
    }
}
