//! `wrap` of a cloth: flat panels that are bent about the limb of a body that they hang before.
//!
//! What lies before or behind the middle of a panel, looked at along the panel's normal, is taken as the limb. Its axis
//! is the direction in the panel's plane along which the normals of its surface change least; the panel becomes a part
//! of a cylinder about it. A cylinder is developable, so the panel's shape at rest is kept.

use std::f64::consts::PI;

use crate::math::{DVec2, DVec3, Vec3};
use crate::mesh::{Group, GroupKind, TriangleMesh, crossings, pieces};

/// Distance from its plane up to which a panel counts as flat, over its size.
const FLAT: f64 = 1e-3;
/// Rays through the middle of a panel, along each of both directions of its plane.
const RAYS: usize = 48;
/// Largest angle that a panel is bent through on each side, so that its sides do not meet.
const BENT_MOST: f64 = 0.95 * PI;

/// The surface of a body at the start.
pub(super) struct Body<'a> {
    pub name: &'a str,
    pub positions: &'a [Vec3],
    pub triangles: &'a [[u32; 3]],
    /// Distance that panels keep from it, meters.
    pub gap_m: f64,
}

/// The plane of a panel: its middle, and two directions in it.
struct Plane {
    middle: DVec3,
    u: DVec3,
    v: DVec3,
    normal: DVec3,
    /// Half of the panel's shorter side.
    reach_m: f64,
}

impl Plane {
    /// The plane of the vertices `panel`, none if they lie in none.
    fn of(positions: &[Vec3], panel: &[u32], corners: impl Iterator<Item = [u32; 3]>) -> Option<Plane> {
        let at = |v: u32| positions[v as usize].as_dvec3();
        let area = |[a, b, c]: [u32; 3]| (at(b) - at(a)).cross(at(c) - at(a));
        let normal = corners.map(area).sum::<DVec3>().try_normalize()?;
        let u = normal.any_orthonormal_vector();
        let v = normal.cross(u);
        let flat = |p: DVec3| DVec2::new(p.dot(u), p.dot(v));
        let points = || panel.iter().map(|&v| at(v));
        // Directions along the longest and the shortest extent, so that the middle does not depend on `u`.
        let mean = points().sum::<DVec3>() / panel.len() as f64;
        let spread = covariance(points().map(|p| flat(p - mean)));
        let along = principal(spread, true);
        let (u, v) = (u * along.x + v * along.y, v * along.x - u * along.y);
        let extent = |direction: DVec3| {
            let range = |(low, high): (f64, f64), x: f64| (low.min(x), high.max(x));
            points().map(|p| (p - mean).dot(direction)).fold((f64::INFINITY, f64::NEG_INFINITY), range)
        };
        let ([(u0, u1), (v0, v1)], (n0, n1)) = ([extent(u), extent(v)], extent(normal));
        let middle = mean + u * (0.5 * (u0 + u1)) + v * (0.5 * (v0 + v1)) + normal * (0.5 * (n0 + n1));
        let is_flat = n1 - n0 <= FLAT * (u1 - u0);
        is_flat.then(|| Plane { middle, u, v, normal, reach_m: 0.5 * (v1 - v0).min(u1 - u0) })
    }

    /// Coordinates of a point: in the plane, and its height above it.
    fn local(&self, p: Vec3) -> (DVec2, f64) {
        let from = p.as_dvec3() - self.middle;
        (DVec2::new(from.dot(self.u), from.dot(self.v)), from.dot(self.normal))
    }
}

/// What a ray along the normal of a panel meets of a body.
#[derive(Clone, Copy)]
struct Chord {
    low: f64,
    high: f64,
    /// Outward normals, in the plane, where it is lowest and highest.
    normals: [DVec2; 2],
}

/// The limb before a panel, in coordinates of its plane.
struct Limb {
    /// A point of the axis, and its height.
    at: DVec2,
    height: f64,
    /// Direction of the axis.
    axis: DVec2,
    radius_m: f64,
}

impl Limb {
    /// None if no ray through the middle of the panel meets the body.
    fn of(plane: &Plane, body: &Body) -> Option<Limb> {
        let spacing = 2.0 * plane.reach_m / RAYS as f64;
        let place = |i: usize| (i as f64 + 0.5) * spacing - plane.reach_m;
        let mut chords: Vec<Option<Chord>> = vec![None; RAYS * RAYS];
        for corners in body.triangles {
            meet(corners.map(|v| plane.local(body.positions[v as usize])), place, spacing, plane.reach_m, &mut chords);
        }
        let hit = |i: usize| chords[i].map(|chord| (DVec2::new(place(i % RAYS), place(i / RAYS)), chord));
        let is_inside = |i: &usize| hit(*i).is_some_and(|(at, _)| at.length() <= plane.reach_m);
        let hits: Vec<usize> = (0..RAYS * RAYS).filter(is_inside).collect();
        let far = |i: usize| hit(i).map_or(f64::INFINITY, |(at, _)| at.length_squared());
        let first = hits.iter().copied().min_by(|&a, &b| far(a).total_cmp(&far(b)))?;
        let limb: Vec<(DVec2, Chord)> = connected(first, &hits).into_iter().filter_map(hit).collect();
        let count = limb.len() as f64;
        let at = limb.iter().map(|(at, _)| *at).sum::<DVec2>() / count;
        let height = limb.iter().map(|(_, chord)| 0.5 * (chord.low + chord.high)).sum::<f64>() / count;
        let normals = limb.iter().flat_map(|(_, chord)| chord.normals);
        let axis = principal(covariance(normals), false);
        let from_axis = |(p, chord): &(DVec2, Chord)| {
            let aside = (*p - at).perp_dot(axis);
            (chord.high - height).abs().max((chord.low - height).abs()).hypot(aside)
        };
        let radius_m = limb.iter().map(from_axis).fold(0.0, f64::max);
        Some(Limb { at, height, axis, radius_m })
    }
}

/// Adds a triangle to the chords of the rays through it; a corner: its place in the plane, and its height.
fn meet(
    corners: [(DVec2, f64); 3],
    place: impl Fn(usize) -> f64,
    spacing: f64,
    reach: f64,
    chords: &mut [Option<Chord>],
) {
    let [(a, ha), (b, hb), (c, hc)] = corners;
    let doubled = (b - a).perp_dot(c - a);
    if doubled == 0.0 {
        return;
    }
    let normal = (b - a).extend(hb - ha).cross((c - a).extend(hc - ha)).normalize_or_zero().truncate();
    let range = |low: f64, high: f64| {
        let ray = |x: f64| (((x + reach) / spacing).clamp(0.0, RAYS as f64)) as usize;
        ray(low)..(ray(high) + 1).min(RAYS)
    };
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    for j in range(low.y, high.y) {
        for i in range(low.x, high.x) {
            let p = DVec2::new(place(i), place(j));
            let weights = [(c - b).perp_dot(p - b), (a - c).perp_dot(p - c), (b - a).perp_dot(p - a)]
                .map(|of_corner| of_corner / doubled);
            if weights.iter().any(|&weight| weight < 0.0) {
                continue;
            }
            let height = weights[0] * ha + weights[1] * hb + weights[2] * hc;
            let chord = chords[j * RAYS + i].get_or_insert(Chord { low: height, high: height, normals: [normal; 2] });
            if height < chord.low {
                (chord.low, chord.normals[0]) = (height, normal);
            }
            if height > chord.high {
                (chord.high, chord.normals[1]) = (height, normal);
            }
        }
    }
}

/// The rays among `hits`, ascending, that are connected with `first`.
fn connected(first: usize, hits: &[usize]) -> Vec<usize> {
    let (mut found, mut open) = (vec![first], vec![first]);
    while let Some(ray) = open.pop() {
        let (i, j) = (ray % RAYS, ray / RAYS);
        let around = [(i > 0, ray.wrapping_sub(1)), (i + 1 < RAYS, ray + 1), (j > 0, ray.wrapping_sub(RAYS))];
        for (_, next) in around.into_iter().chain([(j + 1 < RAYS, ray + RAYS)]).filter(|(is_there, _)| *is_there) {
            if hits.binary_search(&next).is_ok() && !found.contains(&next) {
                found.push(next);
                open.push(next);
            }
        }
    }
    found.sort_unstable();
    found
}

/// Sums of xx, yy and xy.
fn covariance(points: impl Iterator<Item = DVec2>) -> [f64; 3] {
    points.fold([0.0; 3], |[xx, yy, xy], p| [xx + p.x * p.x, yy + p.y * p.y, xy + p.x * p.y])
}

/// The direction of the largest or of the smallest spread.
fn principal([xx, yy, xy]: [f64; 3], largest: bool) -> DVec2 {
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let direction = DVec2::from_angle(angle);
    if largest { direction } else { direction.perp() }
}

/// Shares of the full curvature of a panel, tried one after the other until it crosses nothing.
const SHARES: [f64; 5] = [1.0, 0.8, 0.6, 0.4, 0.2];

/// Bends every connected panel of `mesh` about the limb of `body` that it hangs before. `name`: that of the panel of a
/// triangle. Panels that would cross each other or the body are bent less.
///
/// # Errors
/// Half a sentence: a panel is not flat, or nothing of the body lies before or behind its middle.
pub(super) fn wrap(mesh: &mut TriangleMesh, body: &Body, name: impl Fn(u32) -> String) -> Result<(), String> {
    let piece_of = pieces(mesh.positions.len(), &mesh.triangles);
    let mut panels: Vec<u32> = mesh.triangles.iter().map(|[a, ..]| piece_of[*a as usize]).collect();
    panels.sort_unstable();
    panels.dedup();
    let mut found = Vec::with_capacity(panels.len());
    for piece in panels {
        let panel: Vec<u32> = (0..mesh.positions.len() as u32).filter(|&v| piece_of[v as usize] == piece).collect();
        let of_panel = |corners: &[u32; 3]| piece_of[corners[0] as usize] == piece;
        let first = mesh.triangles.iter().position(of_panel).unwrap_or_default() as u32;
        let corners = mesh.triangles.iter().copied().filter(of_panel);
        let plane = Plane::of(&mesh.positions, &panel, corners)
            .ok_or_else(|| format!("bends flat panels, and {} is not flat", name(first)))?;
        let limb = Limb::of(&plane, body).ok_or_else(|| {
            format!("no part of obstacle `{}` lies before or behind the middle of {}", body.name, name(first))
        })?;
        found.push((panel, plane, limb));
    }
    let flat = mesh.positions.clone();
    let (mut tried, mut crossing): (Vec<usize>, Vec<bool>) = (vec![0; found.len()], vec![true; found.len()]);
    while crossing.contains(&true) {
        for (at, (panel, plane, limb)) in found.iter().enumerate().filter(|(at, _)| crossing[*at]) {
            bend(&flat, &mut mesh.positions, panel, plane, limb, body.gap_m, SHARES[tried[at]]);
        }
        let met = pieces_that_cross(mesh, body, &piece_of);
        for (at, (panel, ..)) in found.iter().enumerate() {
            let is_more = tried[at] + 1 < SHARES.len();
            crossing[at] = is_more && met.binary_search(&piece_of[panel[0] as usize]).is_ok();
            tried[at] += usize::from(crossing[at]);
        }
    }
    Ok(())
}

/// The connected pieces of the cloth that cross each other or the body, ascending.
fn pieces_that_cross(mesh: &TriangleMesh, body: &Body, piece_of: &[u32]) -> Vec<u32> {
    let first = mesh.positions.len() as u32;
    let positions = [&mesh.positions[..], body.positions].concat();
    let of_body = body.triangles.iter().map(|corners| corners.map(|v| v + first));
    let triangles: Vec<[u32; 3]> = mesh.triangles.iter().copied().chain(of_body).collect();
    let cloth = mesh.triangles.len();
    let groups = [
        Group { triangles: 0..cloth, kind: GroupKind::Cloth },
        Group { triangles: cloth..triangles.len(), kind: GroupKind::Obstacle },
    ];
    let pairs = crossings(&positions, &triangles, &groups);
    let corner = |&t: &u32| mesh.triangles.get(t as usize).map(|[a, ..]| piece_of[*a as usize]);
    let mut met: Vec<u32> = pairs.iter().flatten().filter_map(corner).collect();
    met.sort_unstable();
    met.dedup();
    met
}

/// Bends a panel about a limb. Its middle keeps its distance from the axis, unless the limb is thicker or the panel
/// would meet itself on the other side. With a `share` of the curvature below 1 it is bent about a line behind the
/// axis.
fn bend(flat: &[Vec3], bent: &mut [Vec3], panel: &[u32], plane: &Plane, limb: &Limb, gap_m: f64, share: f64) {
    let across = limb.axis.perp();
    let aside = |p: DVec2| (p - limb.at).dot(across);
    let widest = panel.iter().map(|&v| aside(plane.local(flat[v as usize]).0).abs()).fold(0.0, f64::max);
    let from_axis = limb.height.abs().max(limb.radius_m + gap_m).max(widest / BENT_MOST);
    let radius = from_axis / share;
    // Away from the limb.
    let out = if limb.height > 0.0 { -plane.normal } else { plane.normal };
    let in_space = |p: DVec2| plane.u * p.x + plane.v * p.y;
    let center = plane.middle + in_space(limb.at) + plane.normal * limb.height + out * (from_axis - radius);
    for &v in panel {
        let (p, height) = plane.local(flat[v as usize]);
        let angle = aside(p) / radius;
        let radius = radius + height * out.dot(plane.normal);
        let around = out * (radius * angle.cos()) + in_space(across) * (radius * angle.sin());
        let along = in_space(limb.axis) * (p - limb.at).dot(limb.axis);
        bent[v as usize] = (center + along + around).as_vec3();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Vec2;

    /// A grid of `n` by `n` squares of a panel of `size` (meters) in a plane of constant z.
    fn panel(size: [f32; 2], n: u32, middle: Vec3) -> TriangleMesh {
        let at = |i: u32, side: f32| (i as f32 / n as f32 - 0.5) * side;
        let grid = || (0..=n).flat_map(|j| (0..=n).map(move |i| (i, j)));
        let flat: Vec<Vec2> = grid().map(|(i, j)| Vec2::new(at(i, size[0]), at(j, size[1]))).collect();
        let corner = |i: u32, j: u32| j * (n + 1) + i;
        let squares = (0..n).flat_map(|j| (0..n).map(move |i| (i, j)));
        let triangles: Vec<[u32; 3]> = squares
            .flat_map(|(i, j)| {
                let [a, b, c, d] = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
                [[a, b, c], [a, c, d]]
            })
            .collect();
        TriangleMesh {
            positions: flat.iter().map(|p| middle + p.extend(0.0)).collect(),
            material_uv: triangles.iter().map(|t| t.map(|v| flat[v as usize])).collect(),
            triangles,
        }
    }

    /// A closed cylinder about an axis in the plane z = 0 through the origin.
    fn cylinder(axis: Vec3, radius: f32, length: f32) -> (Vec<Vec3>, Vec<[u32; 3]>) {
        const SIDES: u32 = 48;
        let across = axis.cross(Vec3::Z);
        let (mut positions, mut triangles) = (Vec::new(), Vec::new());
        for end in [-0.5, 0.5] {
            for side in 0..SIDES {
                let (sin, cos) = (side as f32 / SIDES as f32 * std::f32::consts::TAU).sin_cos();
                positions.push(axis * (end * length) + (across * cos + Vec3::Z * sin) * radius);
            }
        }
        for side in 0..SIDES {
            let next = (side + 1) % SIDES;
            triangles.push([side, next, SIDES + side]);
            triangles.push([next, SIDES + next, SIDES + side]);
        }
        (positions, triangles)
    }

    #[test]
    fn panels_lie_on_a_cylinder_about_the_limb_with_their_lengths() {
        for (axis, z, radius) in
            [(Vec3::Y, 0.2f32, 0.2f32), (Vec3::new(0.6, 0.8, 0.0), -0.15, 0.15), (Vec3::X, 0.03, 0.1)]
        {
            let (positions, triangles) = cylinder(axis, 0.08, 1.0);
            let body = Body { name: "arm", positions: &positions, triangles: &triangles, gap_m: 0.02 };
            let flat = panel([0.4, 0.3], 24, Vec3::new(0.0, 0.0, z));
            let mut bent = flat.clone();
            wrap(&mut bent, &body, |_| String::new()).unwrap();
            for p in &bent.positions {
                let from_axis = (*p - axis * p.dot(axis)).length();
                assert!((from_axis - radius).abs() < 2e-3, "{axis}: {from_axis} m");
            }
            // Chords of a circle are shorter than its arcs: 1 - (s/r)^2 / 24.
            for corners in &flat.triangles {
                for [a, b] in [[0, 1], [1, 2], [2, 0]].map(|side| side.map(|i| corners[i] as usize)) {
                    let before = flat.positions[a].distance(flat.positions[b]);
                    let after = bent.positions[a].distance(bent.positions[b]);
                    assert!((after / before - 1.0).abs() < 2e-3, "{axis}: {after} m for {before}");
                }
            }
        }
    }

    #[test]
    fn a_panel_wider_than_around_the_limb_does_not_meet_itself() {
        let (positions, triangles) = cylinder(Vec3::Y, 0.05, 1.0);
        let body = Body { name: "arm", positions: &positions, triangles: &triangles, gap_m: 0.002 };
        let mut bent = panel([0.4, 0.3], 24, Vec3::new(0.0, 0.0, 0.06));
        wrap(&mut bent, &body, |_| String::new()).unwrap();
        let sides = |y: usize| bent.positions[y * 25].distance(bent.positions[y * 25 + 24]);
        let radius = 0.2 / BENT_MOST as f32;
        for y in 0..25 {
            assert!((sides(y) - 2.0 * radius * (PI as f32 - BENT_MOST as f32).sin()).abs() < 1e-3, "{}", sides(y));
        }
    }

    #[test]
    fn panels_that_are_bent_or_hang_elsewhere_are_refused() {
        let (positions, triangles) = cylinder(Vec3::Y, 0.05, 1.0);
        let body = Body { name: "arm", positions: &positions, triangles: &triangles, gap_m: 0.002 };
        let mut aside = panel([0.4, 0.3], 4, Vec3::new(1.0, 0.0, 0.1));
        let what = wrap(&mut aside, &body, |_| "`front`".into()).unwrap_err();
        assert_eq!(what, "no part of obstacle `arm` lies before or behind the middle of `front`");
        let mut bent = panel([0.4, 0.3], 4, Vec3::new(0.0, 0.0, 0.1));
        bent.positions[12].z += 0.01;
        let what = wrap(&mut bent, &body, |_| "`front`".into()).unwrap_err();
        assert_eq!(what, "bends flat panels, and `front` is not flat");
    }
}
