//! How often a step reads the state of the own rows back from its executor, and that what is kept of it is what the
//! executor holds: on the native executor and on a device.

use loomtree::gpu::Executor;
use loomtree::math::Vec3;
use loomtree::model::{GlobalModel, RankState};
use loomtree::scene::Scene;
use loomtree::solver::ExchangeMode;
use loomtree::step::StepStats;
use loomtree::telemetry::{Activity, EventName};
use support::contact::{contact_scene, floor, together};
use support::device;
use support::{cpu, on_ranks, sheet};

/// Steps of every run.
const STEPS: u32 = 8;

/// Three sheets, turned against each other, that hit each other and a floor at 20 m/s.
fn falling() -> Scene {
    const CELLS: usize = 8;
    let sheets = (0..3).map(|i| {
        let (sin, cos) = (0.1 * i as f32).sin_cos();
        let (u, v) = (Vec3::new(cos, sin, 0.0), Vec3::new(-sin, cos, 0.0));
        sheet(CELLS + 1, CELLS + 1, [0.2; 2], Vec3::new(-0.1, -0.1, 0.02 + 0.01 * i as f32), u, v)
    });
    let mut scene = contact_scene(together(sheets), 1e-3, 0.3, Vec3::new(0.0, 0.0, -9.81));
    scene.velocities.iter_mut().for_each(|velocity| velocity.z = -20.0);
    scene.obstacles = vec![floor(1.0, 4, 0.3)];
    scene
}

/// A device per rank.
fn gpu(rank: usize) -> Executor {
    Executor::gpu(None, rank).unwrap()
}

/// Reads of every step on every rank.
fn reads(scene: &Scene, ranks: usize, executor: fn(usize) -> Executor) -> Vec<Vec<(usize, StepStats)>> {
    let model = GlobalModel::new(scene);
    on_ranks(&model, ranks, ExchangeMode::Halo, executor, |simulation, transport| {
        let mut reads = Vec::new();
        for step in 1..=STEPS {
            let stats = simulation.step(transport, step, true).unwrap();
            let rows = simulation.state().positions.len() as u64 / 3;
            let events = simulation.recorder.take();
            let found: Vec<_> = events.iter().filter(|event| event.name == EventName::ReadState as u32).collect();
            assert!(found.iter().all(|event| event.activity == Activity::Transfer as u32 && event.bytes == rows * 24));
            reads.push((found.len(), stats));
        }
        reads
    })
}

#[test]
fn a_step_with_collisions_reads_the_state_once_per_solve() {
    let mut executors: Vec<fn(usize) -> Executor> = vec![cpu];
    if device::executor().is_some() {
        executors.push(gpu);
    }
    for executor in executors {
        for ranks in [1, 2] {
            let reads = reads(&falling(), ranks, executor);
            let moved = reads[0].iter().any(|(_, stats)| stats.zones.rounds > 0);
            assert!(moved, "no impact zone has moved anything: {reads:?}");
            for (step, (count, stats)) in reads.iter().flat_map(|rank| rank.iter().enumerate()) {
                // After each of two solves, and the start state on top; a step that is cut in two is solved four times
                // more.
                let first = usize::from(step == 0);
                let expected = 2 + first + 4 * stats.zones.halvings as usize;
                assert_eq!(*count, expected, "step {}, {ranks} ranks: {stats:?}", step + 1);
            }
        }
    }
}

#[test]
fn without_collisions_a_step_reads_nothing() {
    let mut scene = falling();
    scene.settings.collisions = false;
    scene.obstacles.clear();
    assert!(reads(&scene, 2, cpu).iter().flatten().all(|(count, _)| *count == 0));
}

/// Positions and velocities after all steps, each step in a simulation of its own or all in one.
fn states(executor: fn(usize) -> Executor, each_anew: bool) -> (Vec<f32>, Vec<f32>) {
    let mut model = GlobalModel::new(&falling());
    let spans = if each_anew { (1..=STEPS).map(|step| step..=step).collect() } else { vec![1..=STEPS] };
    for span in spans {
        let run = on_ranks(&model, 1, ExchangeMode::Halo, executor, move |simulation, transport| {
            for step in span.clone() {
                simulation.step(transport, step, false).unwrap();
            }
            simulation.state()
        });
        RankState { positions: model.positions, velocities: model.velocities, .. } = run.into_iter().next().unwrap();
    }
    (model.positions, model.velocities)
}

#[test]
fn what_is_kept_is_what_the_executor_holds() {
    let bits = |values: &[f32]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
    let mut executors: Vec<fn(usize) -> Executor> = vec![cpu];
    if device::executor().is_some() {
        executors.push(gpu);
    }
    for executor in executors {
        let (kept, anew) = (states(executor, false), states(executor, true));
        assert_eq!(bits(&kept.0), bits(&anew.0), "positions");
        assert_eq!(bits(&kept.1), bits(&anew.1), "velocities");
    }
}
