//! What a command says about a scene far from the world's origin.

use crate::math::DVec3;
use crate::scene::Scene;

/// Where a scene is computed and how far its files round it; none near the origin.
pub(super) fn far_line(scene: &Scene) -> Option<String> {
    let DVec3 { x, y, z } = scene.origin_m;
    let farthest = scene.mesh.positions.iter().map(|p| (p.as_dvec3() + scene.origin_m).abs().max_element());
    // Half the distance between two numbers of f32.
    let rounding_m = 0.5 * spacing(farthest.fold(0.0, f64::max) as f32);
    (scene.origin_m != DVec3::ZERO).then(|| {
        let rounding_mm = 1e3 * rounding_m;
        format!(
            "computed about the local origin [{x}, {y}, {z}] m; ply and pc2 files hold f32, which rounds positions \
             there by up to {rounding_mm:.2} mm (obj files hold all digits)"
        )
    })
}

/// Distance from `x` to the next larger number of f32.
fn spacing(x: f32) -> f64 {
    f64::from(x.next_up()) - f64::from(x)
}
