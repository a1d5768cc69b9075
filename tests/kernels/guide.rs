//! Steps that are drawn toward a given motion, and steps that are given: what seams of a shot split in time are made
//! of.

use loomtree::math::Vec3;
use loomtree::model::{GlobalModel, RankState};
use loomtree::solver::ExchangeMode;
use loomtree::step::{Guidance, Guide, Simulation};
use loomtree::transport::Transport;
use support::contact::{ball, contact_scene};
use support::{cpu, on_ranks, sheet, whole_state};

const STEPS: u32 = 24;
/// Step at which the cloth is beside its guide.
const BESIDE: u32 = 10;
const DOWN: Vec3 = Vec3::new(0.0, 0.0, -9.81);

/// A sheet that falls on a ball and hangs over it from step 12 on.
fn draped() -> GlobalModel {
    let mesh = sheet(17, 17, [0.3, 0.3], Vec3::new(-0.14, -0.155, 0.006), Vec3::X, Vec3::Y);
    let mut scene = contact_scene(mesh, 1e-3, 0.3, DOWN);
    scene.obstacles = vec![ball(0.08, 6, Vec3::new(0.0, 0.0, -0.08), 0.3)];
    GlobalModel::new(&scene)
}

fn steps(simulation: &mut Simulation, transport: &mut dyn Transport) -> Vec<RankState> {
    let start = simulation.state();
    let made = (1..=STEPS).map(|number| {
        simulation.step(transport, number, false).unwrap();
        simulation.state()
    });
    std::iter::once(start).chain(made.collect::<Vec<_>>()).collect()
}

fn toward(states: &[RankState], step: u32, weight: f64, distance_left: f64) -> Guide {
    let [start, end] = [step - 1, step].map(|step| states[step as usize].positions.clone());
    Guide { start, end, guidance: Guidance { weight, distance_left } }
}

/// A state a little beside `state`, so far that the cloth touches nothing.
fn beside(state: &RankState) -> RankState {
    let mut other = state.clone();
    other.positions.chunks_exact_mut(3).for_each(|x| (x[0], x[2]) = (x[0] + 0.003, x[2] + 0.004));
    other
}

fn largest_distance_m(a: &RankState, b: &RankState) -> f64 {
    let pairs = a.positions.chunks_exact(3).zip(b.positions.chunks_exact(3));
    pairs.map(|(a, b)| Vec3::from_slice(a).as_dvec3().distance(Vec3::from_slice(b).as_dvec3())).fold(0.0, f64::max)
}

#[test]
fn a_guide_without_weight_changes_no_bit() {
    let states = on_ranks(&draped(), 2, ExchangeMode::Halo, cpu, |simulation, transport| {
        let states = steps(simulation, transport);
        simulation.set_state(states[BESIDE as usize].clone());
        let far = Guide { start: vec![3.0; states[0].positions.len()], ..toward(&states, 1, 0.0, 0.5) };
        simulation.guided_step(transport, BESIDE + 1, false, far).unwrap();
        (simulation.state(), states[BESIDE as usize + 1].clone())
    });
    assert!(states.iter().all(|(guided, plain)| guided == plain));
}

/// The way from beside the run to its last state: how far the cloth is from the run after every step, and its last
/// state.
fn joined(ranks: usize) -> (Vec<f64>, loomtree::State) {
    let model = draped();
    let parts = on_ranks(&model, ranks, ExchangeMode::Halo, cpu, |simulation, transport| {
        let states = steps(simulation, transport);
        simulation.set_state(beside(&states[BESIDE as usize]));
        let count = STEPS - 1 - BESIDE;
        let left = |step: u32| {
            let t = f64::from(step - BESIDE) / f64::from(count);
            1.0 - t * t * (3.0 - 2.0 * t)
        };
        let mut distances = Vec::new();
        for step in BESIDE + 1..STEPS {
            let weight = (f64::from(step - BESIDE) / f64::from(count)).min(0.999);
            let guide = toward(&states, step, weight, left(step) / left(step - 1));
            simulation.guided_step(transport, step, false, guide).unwrap();
            distances.push(largest_distance_m(&simulation.state(), &states[step as usize]));
        }
        let stats = simulation.arrive(transport, STEPS, false, states[STEPS as usize].clone()).unwrap();
        assert_eq!(stats.arrived, Some(true));
        assert_eq!(simulation.state(), states[STEPS as usize]);
        (distances, simulation.state())
    });
    let distances = (0..parts[0].0.len()).map(|i| parts.iter().map(|part| part.0[i]).fold(0.0, f64::max)).collect();
    (distances, whole_state(&model, parts.iter().map(|part| &part.1)))
}

#[test]
fn a_cloth_is_drawn_onto_its_guide_and_arrives() {
    let (distances, state) = joined(1);
    println!("{distances:?}");
    assert!(distances[0] > 0.004, "it starts 5 mm beside the run");
    assert!(distances[distances.len() - 1] < 1e-4, "{distances:?}");
    for ranks in [2, 3] {
        let (again, same) = joined(ranks);
        assert_eq!((again, same.hash()), (distances.clone(), state.hash()), "{ranks} ranks");
    }
}

#[test]
fn what_would_pass_through_does_not_arrive() {
    let states = on_ranks(&draped(), 2, ExchangeMode::Halo, cpu, |simulation, transport| {
        let states = steps(simulation, transport);
        simulation.set_state(states[BESIDE as usize].clone());
        let mut through = states[BESIDE as usize].clone();
        through.positions.chunks_exact_mut(3).for_each(|x| x[2] -= 0.3);
        let stats = simulation.arrive(transport, BESIDE + 1, false, through).unwrap();
        let stayed = simulation.state() == states[BESIDE as usize];
        simulation.step(transport, BESIDE + 1, false).unwrap();
        (stats.arrived, stayed, simulation.state() == states[BESIDE as usize + 1])
    });
    assert!(states.iter().all(|&result| result == (Some(false), true, true)), "{states:?}");
}
