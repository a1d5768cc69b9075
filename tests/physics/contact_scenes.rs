//! Nothing ever passes through anything: cloth on a ball, on a floor, on itself, in layers and between plates, at the
//! usual speed and thickness, ten times as fast, a tenth as thick. Every step is looked at by the exact check of
//! `mesh`, which knows nothing of contacts and impacts; what could pass as a whole within a step is found by the side
//! it is on.

use loomtree::gpu::Executor;
use loomtree::math::{DVec3, Vec3};
use loomtree::mesh::TriangleMesh;
use loomtree::model::GlobalModel;
use loomtree::scene::{Pin, PreconditionerKind, Scene};
use loomtree::solver::ExchangeMode;
use loomtree::step::Failure;
use support::contact::{Watched, assert_free, ball, contact_scene, floor, plate, rolled, together, watch};
use support::device;
use support::physics::DOWN;
use support::{cpu, on_ranks, sheet};

/// The same scene as it is usual, ten times as fast, a tenth as thick.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Usual,
    Fast,
    Thin,
}

const KINDS: [Kind; 3] = [Kind::Usual, Kind::Fast, Kind::Thin];

impl Kind {
    fn thickness_m(self) -> f64 {
        if self == Kind::Thin { 1.5e-4 } else { 1.5e-3 }
    }

    fn speed_m_s(self) -> f32 {
        if self == Kind::Fast { 20.0 } else { 2.0 }
    }

    fn scene(self, mesh: TriangleMesh) -> Scene {
        contact_scene(mesh, self.thickness_m(), 0.3, DOWN)
    }
}

/// Runs on one rank and on four: the same bits, and nothing crosses after any step.
fn check(name: &str, scene: &Scene, steps: u32) -> Watched {
    let start = std::time::Instant::now();
    let one = watch(scene, 1, steps, cpu);
    println!("{name}: {}; {:.2} s", one.summary(), start.elapsed().as_secs_f64());
    assert!(one.stats.iter().map(|s| s.contacts).sum::<u64>() > 100, "{name}: {}", one.summary());
    assert_free(scene, &one);
    assert!(one.stats.iter().all(|s| s.let_go == Default::default()), "{name}: nothing is let go");
    let four = watch(scene, 4, steps, cpu);
    assert!(one.bits() == four.bits(), "{name}: four ranks give other bits than one");
    let counts = |run: &Watched| run.stats.iter().map(|s| (s.contacts, s.zones.impacts)).collect::<Vec<_>>();
    assert_eq!(counts(&one), counts(&four), "{name}: contacts and impacts of four ranks");
    one
}

/// A sheet of `cells` squared above a ball.
fn over_a_ball(kind: Kind, cells: usize) -> Scene {
    let mesh = sheet(cells + 1, cells + 1, [0.3, 0.3], Vec3::new(-0.14, -0.155, 0.003), Vec3::X, Vec3::Y);
    let mut scene = kind.scene(mesh);
    scene.velocities.iter_mut().for_each(|v| v.z = -kind.speed_m_s());
    scene.obstacles = vec![ball(0.08, 6, Vec3::new(0.0, 0.0, -0.08), 0.3)];
    scene
}

#[test]
fn dropped_on_a_ball() {
    for kind in KINDS {
        let run = check(&format!("ball, {kind:?}"), &over_a_ball(kind, 20), 40);
        for (step, x) in run.positions.iter().enumerate() {
            // Facets of the ball lie up to 1.5 mm below its radius.
            let nearest = x.iter().map(|x| x.distance(Vec3::Z * -0.08)).fold(f32::MAX, f32::min);
            assert!(nearest > 0.0785, "{kind:?}, step {}: {nearest} m from the ball's centre", step + 1);
        }
    }
}

/// Layers, each turned and shifted against the one below, fall on each other and on a floor; the top ones are the
/// fastest.
fn layers(kind: Kind, count: usize, cells: usize) -> Scene {
    let sheets = (0..count).map(|i| {
        let (sin, cos) = (0.1 * i as f32).sin_cos();
        let (u, v) = (Vec3::new(cos, sin, 0.0), Vec3::new(-sin, cos, 0.0));
        let at = Vec3::new(-0.1 + 0.003 * i as f32, -0.1 - 0.002 * i as f32, 0.004 + 0.005 * i as f32);
        sheet(cells + 1, cells + 1, [0.2; 2], at, u, v)
    });
    let mut scene = kind.scene(together(sheets));
    let per_sheet = (cells + 1) * (cells + 1);
    for (v, velocity) in scene.velocities.iter_mut().enumerate() {
        velocity.z = -kind.speed_m_s() * (1 + v / per_sheet) as f32 / count as f32;
    }
    scene.obstacles = vec![floor(1.0, 4, 0.3)];
    scene
}

#[test]
fn layers_on_a_floor() {
    for kind in KINDS {
        let run = check(&format!("layers, {kind:?}"), &layers(kind, 4, 10), 40);
        for (step, x) in run.positions.iter().enumerate() {
            let lowest = x.iter().map(|x| x.z).fold(f32::MAX, f32::min);
            assert!(lowest > 0.0, "{kind:?}, step {}: {lowest} m", step + 1);
            let heights: Vec<f32> = x.chunks_exact(121).map(|sheet| sheet.iter().map(|x| x.z).sum()).collect();
            assert!(heights.windows(2).all(|pair| pair[0] < pair[1]), "{kind:?}, step {}: {heights:?}", step + 1);
        }
    }
}

/// A roll of two turns, `cells` long and wide, that lands on a floor on its side and is pressed flat by its own speed.
fn roll(kind: Kind, cells: [usize; 2]) -> Scene {
    let mesh = sheet(cells[0] + 1, cells[1] + 1, [0.4, 0.08], Vec3::ZERO, Vec3::X, Vec3::Y);
    let mut scene = kind.scene(rolled(mesh, 0.025, 0.006, Vec3::Z * 0.045));
    scene.velocities.iter_mut().for_each(|v| v.z = -kind.speed_m_s());
    scene.obstacles = vec![floor(1.0, 4, 0.3)];
    scene
}

#[test]
fn a_roll_falls_onto_itself() {
    for kind in KINDS {
        let run = check(&format!("roll, {kind:?}"), &roll(kind, [40, 8]), 50);
        let lowest = run.positions.iter().flatten().map(|x| x.z).fold(f32::MAX, f32::min);
        assert!(lowest > 0.0, "{kind:?}: {lowest} m");
    }
}

/// A strip of `cells` along and across, folded in an S, hung at one end, squeezed between two plates that stop at a gap
/// that it fits in.
fn between_plates(kind: Kind, cells: [usize; 2]) -> Scene {
    let mut mesh = sheet(cells[0] + 1, cells[1] + 1, [0.4, 0.08], Vec3::ZERO, Vec3::X, Vec3::Y);
    for x in &mut mesh.positions {
        // Waves of 10 cm; arc length is kept by shrinking x.
        let phase = x.x * 60.0;
        *x = Vec3::new(x.x * 0.7, x.y, 0.012 * phase.sin());
    }
    let mut scene = kind.scene(mesh);
    scene.settings.gravity_m_s2 = Vec3::ZERO;
    let at_end = (0..=cells[1] as u32).map(|i| i * (cells[0] as u32 + 1));
    scene.pins = at_end.map(|vertex| Pin::new(vertex, None, 0.0, f64::INFINITY)).collect();
    let closing_s = 0.014 / f64::from(kind.speed_m_s() * 0.1);
    let size = [0.5, 0.2, 0.01];
    let at = |z: f32| Vec3::new(0.15, 0.04, z);
    scene.obstacles = vec![
        plate("upper", size, at(0.025), DVec3::Z * -0.014, 0.0, closing_s),
        plate("lower", size, at(-0.025), DVec3::Z * 0.014, 0.0, closing_s),
    ];
    scene
}

#[test]
fn squeezed_between_plates() {
    for kind in KINDS {
        let run = check(&format!("plates, {kind:?}"), &between_plates(kind, [40, 8]), 40);
        let last = run.positions.last().unwrap();
        // Faces of the plates end 6 mm from the middle.
        assert!(last.iter().all(|x| x.z.abs() < 0.006), "{kind:?}: between the plates");
    }
}

/// All of the above, smaller, on a device: lavapipe where there is no better one.
#[test]
fn every_scene_on_a_device() {
    if device::executor().is_none() {
        return;
    }
    let gpu = |rank: usize| Executor::gpu(None, rank).unwrap();
    for kind in KINDS {
        let scenes = [
            ("layers", layers(kind, 2, 6), 12),
            ("ball", over_a_ball(kind, 10), 10),
            ("roll", roll(kind, [30, 4]), 16),
            ("plates", between_plates(kind, [30, 4]), 24),
        ];
        for (name, mut scene, steps) in scenes {
            // The small scenes take Jacobi by themselves.
            if (name, kind) == ("layers", Kind::Fast) {
                scene.settings.preconditioner = PreconditionerKind::Schwarz;
            }
            let start = std::time::Instant::now();
            let one = watch(&scene, 1, steps, gpu);
            println!("device, {name}, {kind:?}: {}; {:.2} s", one.summary(), start.elapsed().as_secs_f64());
            assert!(one.stats.iter().map(|s| s.contacts).sum::<u64>() > 30, "{name}, {kind:?}: {}", one.summary());
            assert_free(&scene, &one);
            let four = watch(&scene, 4, steps, gpu);
            assert!(four.bits() == one.bits(), "{name}, {kind:?}: four ranks give other bits than one");
        }
    }
}

/// A vertex that is about to leave what collisions can be computed for is named, not the failure it would cause.
#[test]
fn a_vertex_out_of_range_is_named() {
    let mut scene = layers(Kind::Usual, 2, 3);
    scene.velocities[20].x = 1e21;
    let model = GlobalModel::new(&scene);
    let errors = on_ranks(&model, 2, ExchangeMode::Halo, cpu, |simulation, transport| {
        simulation.step(transport, 1, false).map(|_| ()).unwrap_err()
    });
    for error in errors {
        let Failure::NotFinite { step: 1, row, quantity, cause, .. } = &error else { panic!("{error}") };
        assert_eq!((model.original_from_global[*row as usize], quantity.as_ref()), (20, "position"), "{error}");
        assert!(cause.contains("at the end of the step"), "{cause}");
    }
}
