//! Coulomb friction with known answers: a sheet on an incline holds below tan(angle) = mu and slides with
//! g (sin - mu cos) above.

mod contact_support;
mod support;

use contact_support::{contact_scene, obstacle};
use loomtree::math::Vec3;
use loomtree::mesh::shapes;
use loomtree::scene::Scene;
use support::physics::{DOWN, OneRank};
use support::sheet;

const THICKNESS_M: f32 = 1e-3;

/// Along the incline downwards, and away from it.
fn directions(angle_deg: f64) -> (Vec3, Vec3) {
    let (sin, cos) = angle_deg.to_radians().sin_cos();
    (Vec3::new(cos as f32, 0.0, -sin as f32), Vec3::new(sin as f32, 0.0, cos as f32))
}

/// A sheet just within reach of an incline.
fn incline(angle_deg: f64, mu: f64, cells: usize) -> Scene {
    let (along, up) = directions(angle_deg);
    let size = 0.02 * cells as f32;
    let mesh = sheet(cells + 1, cells + 1, [size; 2], up * (0.97 * THICKNESS_M), along, Vec3::Y);
    let mut scene = contact_scene(mesh, f64::from(THICKNESS_M), 0.0, DOWN);
    let mut plane = shapes::rectangle([4.0, 0.6], [20, 3]);
    plane.positions.iter_mut().for_each(|p| *p = along * (p.x + 1.5) - Vec3::Y * p.z + up * p.y);
    scene.obstacles = vec![obstacle("incline", plane, mu)];
    scene
}


#[test]
fn explore() {
    for (mu, off, start, cells, step_s) in [
        (0.6, 10.0, 0.0, [1, 1], 0.004),
        (0.6, 10.0, 0.0, [20, 3], 0.004),
        (0.6, 10.0, 1.0, [20, 3], 0.004),
        (0.6, 10.0, 1.0, [20, 3], 0.001),
        (0.6, 10.0, 1.0, [1, 1], 0.004),
        (0.0, 10.0, 1.0, [20, 3], 0.004),
        (0.0, 10.0, 1.0, [1, 1], 0.004),
        (0.3, 1.0, 0.5, [1, 1], 0.004),
        (0.3, 1.0, 0.5, [20, 3], 0.004),
        (0.3, 5.0, 0.5, [1, 1], 0.004),
        (0.3, 5.0, 0.5, [20, 3], 0.004),
        (0.3, -5.0, 0.5, [20, 3], 0.004),
    ] {
        let angle = f64::atan(mu).to_degrees() + off;
        let mut scene = incline(angle, mu, 5);
        let (along, up) = directions(angle);
        scene.settings.step_s = step_s;
        let mut plane = shapes::rectangle([6.0, 0.6], cells);
        plane.positions.iter_mut().for_each(|p| *p = along * (p.x + 2.5) - Vec3::Y * p.z + up * p.y);
        scene.obstacles = vec![obstacle("incline", plane, mu)];
        scene.velocities.iter_mut().for_each(|v| *v = along * start);
        let mut cloth = OneRank::new(&scene);
        let expected = 9.81 * (angle.to_radians().sin() - mu * angle.to_radians().cos());
        let height = |cloth: &OneRank| cloth.positions().iter().map(|x| x.dot(up)).fold((f32::MAX, 0.0), |a: (f32, f32), b| (a.0.min(b), a.1.max(b)));
        let speed = |cloth: &OneRank| cloth.velocities().iter().map(|x| x.dot(along)).sum::<f32>() / 36.0;
        let mut log = String::new();
        let mut last = start;
        let mut range = (f32::MAX, 0f32);
        let (mut contacts, mut impacts) = (0, 0);
        let block = (0.2 / step_s) as usize;
        for i in 1..=5 * block {
            let s = cloth.step();
            contacts += s.contacts; impacts += s.zones.impacts;
            let h = height(&cloth);
            range = (range.0.min(h.0), range.1.max(h.1));
            if i % block == 0 {
                let v = speed(&cloth);
                log += &format!(" v {v:.4} a {:.4} h {:.5} {:.5} c {};", (v - last) / 0.2, range.0*1e3, range.1*1e3, contacts / block as u64);
                last = v;
                contacts = 0;
                range = (f32::MAX, 0f32);
            }
        }
        println!("mu {mu} off {off} start {start} {cells:?} dt {step_s}: expected {expected:.4}; impacts {impacts} {log}");
    }
}
