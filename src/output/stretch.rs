//! Stretch of triangles: principal stretches against the shape at rest, and what is beyond strain limits.

use serde::{Deserialize, Serialize};

use super::touching::touched_obstacles;
use crate::math::{DVec2, DVec3, Vec2, Vec3};
use crate::model::{RestStretch, State, UNSTRETCHED};
use crate::scene::{Obstacles, Scene, StrainLimit};

/// Strain beyond a limit from which on a triangle is counted in a report.
const COUNTED_FROM: f64 = 0.005;

/// Triangles of a frame that are beyond their strain limits, and the worst of them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BeyondLimits {
    /// Triangles more than 0.5 % of strain beyond a limit.
    pub triangles: usize,
    /// Those of them with a corner that a pin holds.
    pub at_pins: usize,
    /// Those of them that touch obstacles, by the nearest one.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub at_obstacles: Vec<TouchedObstacle>,
    /// Largest strain beyond a limit.
    pub strain: f64,
    /// Triangle of the mesh where that is.
    pub triangle: usize,
    /// A corner of it: one that a pin holds if there is one, and the pin is what asks for the stretch; otherwise with
    /// the obstacle that it touches, if it does.
    pub place: String,
}

/// Triangles beyond their strain limits that touch an obstacle.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct TouchedObstacle {
    /// Name of the obstacle.
    pub obstacle: String,
    /// Number of triangles.
    pub triangles: usize,
}

impl BeyondLimits {
    /// What is beyond the limits in `state` at `time_s`; none if nothing is.
    pub fn of(scene: &Scene, obstacles: &Obstacles, state: &State, time_s: f64) -> Option<BeyondLimits> {
        if scene.fabrics.iter().all(|fabric| fabric.strain_limit.is_none()) {
            return None;
        }
        let mut held = vec![false; scene.mesh.positions.len()];
        let took_hold = |vertex: u32| state.holds.binary_search_by_key(&vertex, |hold| hold.vertex).is_ok();
        let holds = |pin: &&crate::scene::Pin| {
            (pin.start_s..pin.end_s).contains(&time_s) && (!pin.on_touch || took_hold(pin.vertex))
        };
        scene.pins.iter().filter(holds).for_each(|pin| held[pin.vertex as usize] = true);
        let mut found = BeyondLimits::default();
        let (mut beyond, mut worst, mut worst_is_held) = (Vec::new(), 0, false);
        for (triangle, corners) in scene.mesh.triangles.iter().enumerate() {
            let Some(limit) = &scene.fabrics[usize::from(scene.fabric_of_triangle[triangle])].strain_limit else {
                continue;
            };
            let at = corners.map(|v| state.positions[v as usize]);
            let rest = state.stretches.get(triangle).unwrap_or(&UNSTRETCHED);
            let strain = beyond_limit(limit, at, at_rest(scene.mesh.material_uv[triangle], rest));
            if strain <= COUNTED_FROM {
                continue;
            }
            let pinned = corners.iter().find(|&&v| held[v as usize]);
            found.triangles += 1;
            found.at_pins += usize::from(pinned.is_some());
            beyond.push(at);
            if strain > found.strain {
                (worst, worst_is_held) = (beyond.len() - 1, pinned.is_some());
                let place = match pinned {
                    Some(&v) => format!("{}, which a pin holds", scene.vertex_name(v)),
                    None => scene.vertex_name(corners[0]),
                };
                (found.strain, found.triangle, found.place) = (strain, triangle, place);
            }
        }
        // Contacts push within the thickness.
        let touched = touched_obstacles(obstacles, time_s, &beyond, scene.settings.thickness_m as f32);
        for (number, name) in (0..obstacles.len()).map(|number| (number, obstacles.name(number))) {
            let triangles = touched.iter().filter(|&&obstacle| obstacle == Some(number)).count();
            if triangles > 0 {
                found.at_obstacles.push(TouchedObstacle { obstacle: name.to_string(), triangles });
            }
        }
        if let Some(&Some(obstacle)) = touched.get(worst).filter(|_| !worst_is_held) {
            found.place += &format!(", where the cloth touches `{}`", obstacles.name(obstacle));
        }
        (found.triangles > 0).then_some(found)
    }
}

/// The shape at rest of a triangle of the mesh, `uv`, that has this rest stretch.
fn at_rest(uv: [Vec2; 3], &[uu, vv, xy, _]: &RestStretch) -> [Vec2; 3] {
    uv.map(|p| Vec2::new(uu * p.x + xy * p.y, xy * p.x + vv * p.y))
}

/// Strain of a triangle beyond a limit, below 0 if it is within: a stretch minus its limit, for shear half the sine of
/// the change of angle minus half that of the limit. `uv`: shape at rest.
pub fn beyond_limit(limit: &StrainLimit, corners: [Vec3; 3], uv: [Vec2; 3]) -> f64 {
    let beyond = |stretch: f64, range: Option<[f64; 2]>| {
        range.map_or(f64::NEG_INFINITY, |[least, most]| (stretch - most).max(least - stretch))
    };
    match *limit {
        StrainLimit::Every([least, most]) => {
            let [largest, smallest] = principal_stretches(corners, uv);
            (largest - most).max(least - smallest)
        }
        StrainLimit::Along { warp, weft, shear_deg } => {
            let [u, v] = deformation(corners, uv);
            let sine = u.dot(v).abs() / (u.length() * v.length()).max(f64::MIN_POSITIVE);
            let shear = shear_deg.map_or(f64::NEG_INFINITY, |angle| 0.5 * (sine - angle.to_radians().sin()));
            beyond(u.length(), warp).max(beyond(v.length(), weft)).max(shear)
        }
    }
}

/// Largest and smallest stretch (length / length at rest) of a triangle in any direction. `uv`: its shape at rest.
pub fn principal_stretches(corners: [Vec3; 3], uv: [Vec2; 3]) -> [f64; 2] {
    let [u, v] = deformation(corners, uv);
    let (mean, half) = (0.5 * (u.dot(u) + v.dot(v)), 0.5 * (u.dot(u) - v.dot(v)));
    let radius = half.hypot(u.dot(v));
    [(mean + radius).sqrt(), (mean - radius).max(0.0).sqrt()]
}

/// d(position)/d(warp) and d(position)/d(weft).
fn deformation(corners: [Vec3; 3], uv: [Vec2; 3]) -> [DVec3; 2] {
    let [p, q, r] = corners.map(Vec3::as_dvec3);
    let [a, b, c] = uv.map(Vec2::as_dvec2);
    let (e1, e2) = (b - a, c - a);
    let det = e1.perp_dot(e2);
    // Gradients of the barycentric coordinates of the second and third corner.
    let (w1, w2) = (DVec2::new(e2.y, -e2.x) / det, DVec2::new(-e1.y, e1.x) / det);
    [(q - p) * w1.x + (r - p) * w2.x, (q - p) * w1.y + (r - p) * w2.y]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stretches_do_not_depend_on_directions() {
        let uv = [Vec2::new(1.0, 2.0), Vec2::new(1.3, 2.1), Vec2::new(0.9, 2.4)];
        for (turn, along) in [(0.0f32, 0.0f32), (0.7, 0.3), (2.0, -1.1)] {
            // Stretched by 1.2 along a direction and 0.9 across it, then turned in space.
            let (d, n) = (Vec2::from_angle(along), Vec2::from_angle(along).perp());
            let in_space = uv.map(|p| {
                let (x, y) = (1.2 * p.dot(d), 0.9 * p.dot(n));
                Vec3::new(x * turn.cos(), y, x * turn.sin())
            });
            let [largest, smallest] = principal_stretches(in_space, uv);
            assert!((largest - 1.2).abs() < 1e-5 && (smallest - 0.9).abs() < 1e-5, "{largest} {smallest}");
        }
    }
}
