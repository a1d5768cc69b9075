//! Contacts take energy and never give any; they keep momentum.

mod contact_support;
mod support;

use contact_support::{assert_free, contact_scene, floor, watch};
use loomtree::math::Vec3;
use support::physics::DOWN;
use support::{cpu, sheet};

#[test]
fn explore() {
    for (step_s, thickness, speed) in [(0.004, 1e-3, 0.0), (0.004, 1e-3, 3.0), (0.0005, 1e-3, 0.0), (0.0005, 1e-3, 3.0), (0.004, 1e-4, 0.0), (0.004, 5e-3, 0.0)] {
        let n = 13;
        let mesh = sheet(n, n, [0.2, 0.2], Vec3::new(-0.1, -0.1, 0.05), Vec3::X, Vec3::Y);
        let mut scene = contact_scene(mesh, thickness, 0.3, DOWN);
        scene.settings.step_s = step_s;
        scene.velocities.iter_mut().for_each(|v| v.z = -speed);
        scene.obstacles = vec![floor(1.0, 5, 0.3)];
        let steps = (0.5 / step_s) as u32;
        let run = watch(&scene, 1, steps, cpu);
        let low = |x: &Vec<Vec3>| x.iter().map(|p| p.z).fold(f32::MAX, f32::min);
        let mean = |x: &Vec<Vec3>| x.iter().map(|p| p.z).sum::<f32>() / x.len() as f32;
        let meanv: Vec<f32> = run.velocities.iter().map(mean).collect();
        let hit = run.stats.iter().position(|s| s.contacts > 0 || s.zones.impacts > 0).unwrap();
        let in_v = meanv[..=hit].iter().fold(0f32, |a, &b| a.min(b));
        let out_v = meanv[hit..].iter().fold(0f32, |a, &b| a.max(b));
        let bounce = run.positions[hit..].iter().skip(2).map(mean).fold(0f32, f32::max);
        let k = run.kinetic_j();
        println!("dt {step_s} h {thickness} v {speed}: hit at {hit}, in {in_v:.3} out {out_v:.4}, bounce {:.3e} m, lowest {:.3e}, end mean {:.3e} kinetic start {:.2e} max {:.2e} end {:.2e}; {}",
            bounce, run.positions.iter().map(low).fold(f32::MAX, f32::min), mean(run.positions.last().unwrap()), k[0], k.iter().fold(0.0, |a: f64, &b| a.max(b)), k.last().unwrap(), run.summary());
        assert_free(&scene, &run);
    }
}
