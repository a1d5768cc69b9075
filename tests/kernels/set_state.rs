//! A step depends on the scene, the state and its number only: a state that is set, after every step, late, or once
//! more after other steps, leads to the bits of the run that went through it. Ranks as threads, native executor.

use std::path::Path;

use loomtree::gpu::Executor;
use loomtree::math::{DVec3, Vec3};
use loomtree::model::{GlobalModel, RankModel, RankState};
use loomtree::partition::RowPartition;
use loomtree::scene::{
    Hold, Keyframe, Motion, Overrides, Pin, Plasticity, PreconditionerKind, Scene, StrainLimit, parse,
};
use loomtree::solver::ExchangeMode;
use loomtree::step::{ExchangePlan, Simulation};
use loomtree::transport::Transport;
use support::contact::{ball, between_balls, contact_scene, floor, together};
use support::{cpu, direct_queue, isotropic_fabric, on_ranks, scene, sheet, whole_state};

const STEPS: u32 = 14;
/// Step whose state is set late or again.
const MIDDLE: u32 = 8;
const STEP_S: f64 = 0.004;
const DOWN: Vec3 = Vec3::new(0.0, 0.0, -9.81);

/// A sheet in the wind. One pin rests until step 6, one moves, one holds during steps 5 to 11, one rests although its
/// vertex starts with a velocity.
fn flag() -> Scene {
    const CELLS: u32 = 20;
    let side = CELLS as usize + 1;
    let mesh = sheet(side, side, [0.4; 2], Vec3::ZERO, Vec3::X, Vec3::Y);
    let mut scene = scene(mesh, isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.001), &[], STEP_S, DOWN);
    scene.settings.wind_m_s = Vec3::new(1.0, 2.0, 0.5);
    scene.settings.air_density_kg_m3 = 1.2;
    let forward = Keyframe { translation_m: DVec3::new(0.01, 0.0, 0.02), ..Keyframe::identity(0.04) };
    scene.motions = vec![Motion { keyframes: vec![Keyframe::identity(0.01), forward] }];
    let pin = Pin::new;
    scene.pins = vec![
        pin(0, None, 0.0, 6.0 * STEP_S),
        pin(CELLS, Some(0), 0.0, f64::INFINITY),
        pin(CELLS * (CELLS + 1), None, 4.0 * STEP_S, 11.0 * STEP_S),
        pin(CELLS * (CELLS + 2), None, 0.0, f64::INFINITY),
    ];
    scene.velocities[(CELLS * (CELLS + 2)) as usize] = Vec3::new(0.3, -0.2, 0.4);
    scene
}

/// The same with pins that rest from the start: only their first step prescribes a velocity.
fn resting() -> Scene {
    let mut scene = flag();
    scene.motions.clear();
    scene.pins = vec![scene.pins[0], scene.pins[3]].into_iter().map(|pin| Pin { motion: None, ..pin }).collect();
    scene
}

/// A sheet that has just hit a ball.
fn sphere() -> Scene {
    let mesh = sheet(17, 17, [0.3, 0.3], Vec3::new(-0.14, -0.155, 0.003), Vec3::X, Vec3::Y);
    let mut scene = contact_scene(mesh, 1e-3, 0.3, DOWN);
    scene.velocities.iter_mut().for_each(|velocity| velocity.z = -1.0);
    scene.obstacles = vec![ball(0.08, 6, Vec3::new(0.0, 0.0, -0.08), 0.3)];
    scene.pins = vec![Pin::new(3, None, 3.0 * STEP_S, 10.0 * STEP_S)];
    scene
}

/// Three sheets that hit each other and a floor so fast that zones have work.
fn stack() -> Scene {
    let sheets = (0..3).map(|i| {
        let (sin, cos) = (0.1 * i as f32).sin_cos();
        let (u, v) = (Vec3::new(cos, sin, 0.0), Vec3::new(-sin, cos, 0.0));
        sheet(9, 9, [0.2; 2], Vec3::new(-0.1, -0.1, 0.02 + 0.01 * i as f32), u, v)
    });
    let mut scene = contact_scene(together(sheets), 1e-3, 0.3, DOWN);
    scene.velocities.iter_mut().for_each(|velocity| velocity.z = -8.0);
    scene.obstacles = vec![floor(1.0, 4, 0.3)];
    scene
}

/// The flag of a fabric that creases at once.
fn creased() -> Scene {
    let mut scene = flag();
    let plasticity = Plasticity { yield_curvature_1_m: 0.2, hardening: 0.1, weakening: 0.5, ..Plasticity::NONE };
    scene.fabrics[0].plasticity = Some(plasticity);
    scene
}

/// The flag of a fabric that creases and stays stretched at once, and weakens, with strain limits beside them.
fn stretched() -> Scene {
    let mut scene = creased();
    let plasticity = scene.fabrics[0].plasticity.as_mut().expect("plastic");
    plasticity.yield_strain = 2e-4;
    scene.fabrics[0].strain_limit = Some(StrainLimit::Every([0.95, 1.002]));
    scene
}

/// A sheet that falls on a box, which carries away what touches it; springs take hold of two corners, one of them while
/// the sheet falls.
fn attached() -> Scene {
    let text = format!(
        r#"
        [simulation]
        step_s = {STEP_S}
        substeps = 1
        [[cloth]]
        sheet = {{ size_m = [0.4, 0.4], triangles = 256 }}
        plane = "xz"
        origin_m = [-0.2, 0.101, 0.2]
        velocity_m_s = [0, -0.5, 0]
        [[obstacle]]
        name = "ball"
        sphere = {{ center_m = [3, 0, 0], radius_m = 0.1, triangles = 20 }}
        [[obstacle]]
        name = "table"
        box = {{ center_m = [0, 0, 0], size_m = [0.2, 0.18, 0.2], triangles = 48 }}
        motion = [{{ time_s = 0 }}, {{ time_s = 1, translate_m = [0.3, 0.2, 0] }}]
        [[pin]]
        attach = "table"
        box_m = [[-0.15, 0, -0.15], [0.15, 1, 0.15]]
        [[pin]]
        corners = "top-left"
        stiffness_n_m = 20
        [[pin]]
        corners = "top-right"
        stiffness_n_m = 20
        start_s = {}
        [[pin]]
        follow = "table"
        nearest = {{ point_m = [-0.2, 0.1, 0.2], count = 3 }}
        start_s = {}
        "#,
        5.0 * STEP_S,
        9.0 * STEP_S
    );
    let scene = parse(&text, Path::new("x.toml"), &Overrides::default()).expect("a scene");
    assert!(scene.pins.len() > 50);
    scene
}

fn step(simulation: &mut Simulation, transport: &mut dyn Transport, step: u32) -> RankState {
    simulation.step(transport, step, false).unwrap();
    simulation.state()
}

/// Goes from `state`, that of step `from`, to the last step.
fn go_on(simulation: &mut Simulation, transport: &mut dyn Transport, state: &RankState, from: u32) -> RankState {
    simulation.set_state(state.clone());
    (from + 1..=STEPS).map(|number| step(simulation, transport, number)).last().expect("a step")
}

fn assert_bits(name: &str, states: &[RankState], expected: &[RankState]) {
    let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    for (rank, (state, expected)) in states.iter().zip(expected).enumerate() {
        assert!(bits(&state.positions) == bits(&expected.positions), "{name}: positions of rank {rank}");
        assert!(bits(&state.velocities) == bits(&expected.velocities), "{name}: velocities of rank {rank}");
        assert_eq!(state.let_go, expected.let_go, "{name}: what rank {rank} has let go");
        assert_eq!(state.holds, expected.holds, "{name}: what the pins of rank {rank} hold at");
        let (creases, expected_creases) = (state.creases.as_flattened(), expected.creases.as_flattened());
        assert!(bits(creases) == bits(expected_creases), "{name}: creases of rank {rank}");
        let (stretches, expected) = (state.stretches.as_flattened(), expected.stretches.as_flattened());
        assert!(bits(stretches) == bits(expected), "{name}: rest stretches of rank {rank}");
    }
}

fn check(name: &str, scene: &Scene, ranks: usize, mode: ExchangeMode) {
    let name = format!("{name} on {ranks} ranks, {mode:?}");
    let model = GlobalModel::new(scene);
    let through = on_ranks(&model, ranks, mode, cpu, |simulation, transport| {
        let mut states = vec![simulation.state()];
        states.extend((1..=STEPS).map(|number| step(simulation, transport, number)));
        // What later steps have left must not count when an earlier state comes back.
        let again = [MIDDLE, 0].map(|from| go_on(simulation, transport, &states[from as usize], from));
        (states, again)
    });
    let of_step = |step: u32| through.iter().map(|(states, _)| states[step as usize].clone()).collect::<Vec<_>>();
    let last = of_step(STEPS);
    assert_ne!(last[0].positions, through[0].0[0].positions, "{name}: something moves");
    for (which, from) in [MIDDLE, 0].into_iter().enumerate() {
        let again: Vec<_> = through.iter().map(|(_, again)| again[which].clone()).collect();
        assert_bits(&format!("{name}, again from step {from}"), &again, &last);
    }

    let anew = on_ranks(&model, ranks, mode, cpu, |simulation, transport| {
        for number in 1..=STEPS {
            let state = step(simulation, transport, number);
            simulation.set_state(state);
        }
        simulation.state()
    });
    assert_bits(&format!("{name}, set after every step"), &anew, &last);

    let middle = of_step(MIDDLE);
    let late = on_ranks(&model, ranks, mode, cpu, {
        let middle = middle.clone();
        move |simulation, transport| {
            let state = middle[transport.rank()].clone();
            go_on(simulation, transport, &state, MIDDLE)
        }
    });
    assert_bits(&format!("{name}, loaded and set"), &late, &last);
}

fn parts(model: &GlobalModel, ranks: usize) -> Vec<RankModel> {
    let mut parts = Vec::new();
    let split = RankModel::split(model, &RowPartition::new(model.rows(), ranks), |_, part| {
        parts.push(part);
        Ok::<(), ()>(())
    });
    split.expect("parts");
    parts
}

#[test]
fn pins_that_begin_and_end() {
    for ranks in [1, 3] {
        for kind in [PreconditionerKind::Jacobi, PreconditionerKind::Schwarz] {
            for mut scene in [flag(), resting()] {
                scene.settings.preconditioner = kind;
                check("flag", &scene, ranks, ExchangeMode::Halo);
            }
        }
    }
    check("flag", &flag(), 3, ExchangeMode::Full);
}

#[test]
fn creases() {
    for ranks in [1, 3] {
        check("creased", &creased(), ranks, ExchangeMode::Halo);
    }
    check("creased", &creased(), 3, ExchangeMode::Full);
    let whole = |ranks| {
        let model = GlobalModel::new(&creased());
        let parts = on_ranks(&model, ranks, ExchangeMode::Halo, cpu, |simulation, transport| {
            (1..=STEPS).map(|number| step(simulation, transport, number)).last().expect("a step")
        });
        whole_state(&model, parts.iter())
    };
    let one = whole(1);
    let yielded = one.creases.iter().filter(|[angle, plastic]| *angle != 0.0 && *plastic > 0.0).count();
    assert!(yielded > one.creases.len() / 10, "{yielded} of {} hinges have yielded", one.creases.len());
    for ranks in [2, 3, 4, 8] {
        assert_eq!(whole(ranks).hash(), one.hash(), "{ranks} ranks");
    }
}

#[test]
fn rest_stretches() {
    for ranks in [1, 3] {
        check("stretched", &stretched(), ranks, ExchangeMode::Halo);
    }
    let whole = |ranks| {
        let model = GlobalModel::new(&stretched());
        let parts = on_ranks(&model, ranks, ExchangeMode::Halo, cpu, |simulation, transport| {
            (1..=STEPS).map(|number| step(simulation, transport, number)).last().expect("a step")
        });
        whole_state(&model, parts.iter())
    };
    let one = whole(1);
    let yielded = one.stretches.iter().filter(|stretch| stretch[3] > 0.0).count();
    assert!(yielded > one.stretches.len() / 10, "{yielded} of {} triangles have yielded", one.stretches.len());
    assert!(one.creases.iter().any(|crease| crease[1] > 0.0));
    for ranks in [2, 3, 5, 8] {
        assert_eq!(whole(ranks).hash(), one.hash(), "{ranks} ranks");
    }
}

#[test]
fn a_sphere_in_contact() {
    for ranks in [1, 3] {
        check("sphere", &sphere(), ranks, ExchangeMode::Halo);
    }
    check("sphere", &sphere(), 3, ExchangeMode::Full);
}

#[test]
fn a_sheet_pinched_between_balls() {
    let mut scene = between_balls(0.006, [0.0, 0.032, 0.064]);
    pinched(&scene);
    // Creases and pairs that are let go in one state, with strain limits beside them.
    scene.fabrics[0].plasticity =
        Some(Plasticity { yield_curvature_1_m: 0.2, hardening: 0.1, weakening: 0.5, ..Plasticity::NONE });
    scene.fabrics[0].strain_limit = Some(StrainLimit::Every([0.95, 1.002]));
    let state = pinched(&scene);
    let yielded = state.creases.iter().filter(|crease| crease[1] > 0.0).count();
    assert!(yielded > 10, "{yielded} of {} hinges have yielded", state.creases.len());
}

/// Checks the scene and returns the state in the middle.
fn pinched(scene: &Scene) -> RankState {
    let model = GlobalModel::new(scene);
    let mut middle = on_ranks(&model, 1, ExchangeMode::Halo, cpu, |simulation, transport| {
        (1..=MIDDLE).map(|number| step(simulation, transport, number)).last().expect("a step")
    });
    assert!(!middle[0].let_go.is_empty(), "what is let go is a part of the state in the middle");
    for ranks in [1, 3] {
        check("pinched", scene, ranks, ExchangeMode::Halo);
    }
    middle.remove(0)
}

#[test]
fn pins_that_take_hold_while_the_cloth_moves() {
    let model = GlobalModel::new(&attached());
    let whole = |ranks| {
        let parts = on_ranks(&model, ranks, ExchangeMode::Halo, cpu, |simulation, transport| {
            (1..=MIDDLE).map(|number| step(simulation, transport, number)).last().expect("a step")
        });
        whole_state(&model, parts.iter())
    };
    let one = whole(1);
    let (free, on_table) =
        one.holds.iter().copied().partition::<Vec<Hold>, _>(|hold| hold.corners == Hold::NO_TRIANGLE);
    assert_eq!(free.len(), 1, "the spring that took hold in the air");
    assert!(on_table.len() > 5 && on_table.iter().all(|hold| hold.corners[0] >= 12), "those on the second obstacle");
    for ranks in [2, 3, 5, 8] {
        assert_eq!(whole(ranks).hash(), one.hash(), "{ranks} ranks");
    }
    for ranks in [1, 3] {
        check("attached", &attached(), ranks, ExchangeMode::Halo);
    }
    check("attached", &attached(), 3, ExchangeMode::Full);
}

#[test]
fn a_stack_with_impact_zones() {
    for (ranks, kind) in
        [(1, PreconditionerKind::Schwarz), (3, PreconditionerKind::Schwarz), (3, PreconditionerKind::Jacobi)]
    {
        let mut scene = stack();
        scene.settings.preconditioner = kind;
        check("stack", &scene, ranks, ExchangeMode::Halo);
    }
}

#[test]
fn another_resolution_in_between_leaves_nothing() {
    let fine = GlobalModel::new(&sphere());
    let mut coarse = sphere();
    coarse.mesh = sheet(9, 9, [0.3, 0.3], Vec3::new(-0.14, -0.155, 0.003), Vec3::X, Vec3::Y);
    coarse.velocities = vec![Vec3::new(0.0, 0.0, -1.0); coarse.mesh.positions.len()];
    coarse.fabric_of_triangle = vec![0; coarse.mesh.triangles.len()];
    let coarse = GlobalModel::new(&coarse);
    for ranks in [1, 3] {
        let levels = (parts(&fine, ranks), parts(&coarse, ranks));
        let states = on_ranks(&fine, ranks, ExchangeMode::Halo, cpu, move |simulation, transport| {
            let rank = transport.rank();
            let plan = ExchangePlan { mode: ExchangeMode::Halo, queue: direct_queue(rank, ranks) };
            let load = |executor: Executor, level: &[RankModel]| {
                Simulation::new(executor, level[rank].clone(), &plan).expect("a simulation")
            };
            let states: Vec<_> = (1..=STEPS).map(|number| step(simulation, transport, number)).collect();
            let mut other = load(cpu(rank), &levels.1);
            (1..=3).for_each(|number| drop(step(&mut other, transport, number)));
            let mut back = load(other.into_executor(), &levels.0);
            let again = go_on(&mut back, transport, &states[MIDDLE as usize - 1], MIDDLE);
            (again, states.into_iter().last().expect("a state"))
        });
        let (again, last): (Vec<_>, Vec<_>) = states.into_iter().unzip();
        assert_bits(&format!("sphere on {ranks} ranks, after a coarse one"), &again, &last);
    }
}
