//! Impacts: the whole pipeline against the continuous test on every pair of features, and searches among touched
//! vertices.

use glam::Vec4;
use loomtree::collision::broad::{CollisionMesh, Split, brute_force};
use loomtree::collision::elementary::lanes::{Lanes, undecided, undecided_at_rest};
use loomtree::collision::elementary::{CandidateKind, ccd, proximity};
use loomtree::collision::{Candidate, ContactParams, Detector, Impact, merge_impacts};
use loomtree::gpu::CpuExecutor;
use loomtree::math::Vec3;
use proptest::prelude::*;
use support::collision::{Model, flat, folded, sphere};
use support::seeded::Seeded;

fn detector(model: &Model, separation_m: f32) -> Detector {
    let vertices = model.x0.len();
    let params = ContactParams {
        thickness_m: 0.001,
        separation_m,
        stiffness_ratio: 1.0,
        step_s: 0.005,
        friction: vec![0.0; vertices],
        inverse_masses_per_kg: vec![1.0; vertices],
        smallest_altitudes_m: vec![1.0; vertices],
        friction_factors: Vec::new(),
        thickness_factors: Vec::new(),
    };
    Detector::new(model.mesh(), params).expect("a detector")
}

/// The continuous test on all pairs of features whose swept boxes meet.
fn oracle(mesh: &CollisionMesh, model: &Model, separation_m: f32) -> Vec<Impact> {
    let all = brute_force(mesh, &model.query(separation_m * 1.001)).expect("an oracle");
    let at = |x: &[Vec3], c: &Candidate| c.vertices.map(|v| x[v as usize]);
    let kind = |c: &Candidate| if c.is_vertex_face() { CandidateKind::VertexFace } else { CandidateKind::EdgeEdge };
    all.into_iter()
        .filter_map(|candidate| {
            let toi = ccd(kind(&candidate), at(&model.x0, &candidate), at(&model.x1, &candidate), separation_m).toi?;
            Some(Impact { candidate, toi })
        })
        .collect()
}

fn found(
    detector: &mut Detector,
    model: &Model,
    touched: Option<&[bool]>,
    (ranks, threads): (usize, usize),
    limit: Option<u64>,
) -> Vec<Impact> {
    let cpu = CpuExecutor::new(threads);
    let mut lists = vec![];
    for rank in 0..ranks {
        let mut out = vec![];
        let (x_t0, x_t1) = (flat(&model.x0), flat(&model.x1));
        detector.limit_memory(limit);
        let stats =
            detector.impacts(&cpu, x_t0, x_t1, touched, &mut Split::alone(rank, ranks), &mut out).expect("impacts");
        assert_eq!(stats.found, out.len() as u64);
        assert!(stats.tested <= stats.broad.candidates && limit.is_none_or(|limit| stats.broad.bytes <= limit));
        lists.push(out);
    }
    let count: usize = lists.iter().map(Vec::len).sum();
    let all = merge_impacts(&lists.iter().map(Vec::as_slice).collect::<Vec<_>>());
    assert_eq!(all.len(), count, "found by one rank each");
    all
}

/// All ranks and threads find what the oracle finds, and subsets of touched vertices the right subsets of it.
fn check(model: &Model, separation_m: f32) -> Vec<Impact> {
    let mut detector = detector(model, separation_m);
    let expected = oracle(detector.mesh(), model, separation_m);
    for split in [(1, 1), (2, 1), (3, 2), (4, 1), (8, 2)] {
        assert_eq!(found(&mut detector, model, None, split, None), expected, "{split:?}");
    }
    let vertices = model.x0.len();
    let subsets: [&dyn Fn(usize) -> bool; 5] =
        [&|_| false, &|_| true, &|v| v == vertices / 2, &|v| v % 97 == 5, &|v| {
            v > vertices / 3 && v < vertices / 3 + 40
        }];
    for subset in subsets {
        let touched: Vec<bool> = (0..vertices).map(subset).collect();
        let hit = |i: &&Impact| i.candidate.vertices.iter().any(|&v| touched[v as usize]);
        let expected: Vec<Impact> = expected.iter().filter(hit).copied().collect();
        for split in [(1, 1), (3, 2)] {
            assert_eq!(found(&mut detector, model, Some(&touched), split, None), expected, "{split:?}");
        }
    }
    expected
}

fn crumpled(seed: u64, speed: f32) -> Model {
    let mut random = Seeded::new(seed);
    let mut model = Model::default();
    model.sheet(17, 13, folded, |x| x + speed * random.vector());
    model.sheet(13, 17, |u, v| folded(v, u) + Vec3::new(0.013, 0.011, 0.002), |x| x - Vec3::new(0.02, 0.0, 0.01));
    model.obstacles_follow();
    model.sheet(12, 12, sphere(Vec3::new(0.0, 0.5, 0.1), 0.12), |x| x + Vec3::X * 0.03);
    model.sheet(2, 2, |u, v| Vec3::new(20.0 * (u - 0.5), 30.0 * (v - 0.4), 0.03), |x| x + Vec3::Z * 0.01);
    model
}

#[test]
fn crumpled_cloth_and_obstacles() {
    let impacts = check(&crumpled(3, 0.02), 0.0);
    assert!(impacts.len() > 100, "{} impacts", impacts.len());
    assert!(check(&crumpled(4, 0.001), 0.0005).len() > 10);
    assert_eq!(
        check(
            &{
                let mut still = Model::default();
                still.sheet(21, 21, folded, |x| x);
                still
            },
            0.0
        ),
        []
    );
}

#[test]
fn few_touched_vertices_need_few_tests() {
    let mut model = Model::default();
    model.sheet(100, 100, folded, |x| x + Vec3::new(0.0, 0.0, 1e-4));
    let mut detector = detector(&model, 0.0);
    let cpu = CpuExecutor::new(1);
    let touched: Vec<bool> = (0..10_000).map(|v| v % 1000 == 17).collect();
    let mut ask = |touched| {
        let (x_t0, x_t1) = (flat(&model.x0), flat(&model.x1));
        detector.impacts(&cpu, x_t0, x_t1, touched, &mut Split::alone(0, 1), &mut vec![]).expect("impacts").broad
    };
    let (all, few) = (ask(None), ask(Some(&touched)));
    assert!(few.tests_total * 20 < all.tests_total, "{} of {} tests", few.tests_total, all.tests_total);
    assert!(few.entries * 20 < all.entries, "{} of {} entries", few.entries, all.entries);
}

#[test]
fn a_rank_holds_its_share_only() {
    let mut model = Model::default();
    model.sheet(150, 150, folded, |x| x + Vec3::new(0.0, 0.0, 1e-4));
    let cpu = CpuExecutor::new(1);
    // A detector each, as in a process each: buffers keep their size from query to query.
    let bytes = |rank, ranks| {
        let (x_t0, x_t1) = (flat(&model.x0), flat(&model.x1));
        let stats = detector(&model, 0.0).impacts(&cpu, x_t0, x_t1, None, &mut Split::alone(rank, ranks), &mut vec![]);
        stats.expect("impacts").bytes as f64
    };
    for rank in 0..4 {
        let share = bytes(rank, 4) / bytes(0, 1);
        assert!(share <= 0.35, "rank {rank} of 4 holds {share} of what one rank holds alone");
    }
}

#[test]
fn a_memory_limit_changes_nothing() {
    let model = crumpled(5, 0.01);
    let mut detector = detector(&model, 0.0);
    let free = found(&mut detector, &model, None, (1, 1), None);
    let cpu = CpuExecutor::new(1);
    let stats = detector
        .impacts(&cpu, flat(&model.x0), flat(&model.x1), None, &mut Split::alone(0, 1), &mut vec![])
        .expect("impacts");
    let limit = stats.broad.bytes - 32 * stats.broad.entries / 2;
    assert_eq!(found(&mut detector, &model, None, (1, 1), Some(limit)), free);
    assert_eq!(found(&mut detector, &model, None, (3, 1), Some(limit)), free);
}

/// Lanes from one stencil and three that are far apart.
fn lanes(x: [Vec3; 4]) -> [Lanes; 4] {
    let far = |i: usize| Vec3::splat(100.0 * i as f32);
    std::array::from_fn(|i| {
        std::array::from_fn(|axis| Vec4::new(x[i][axis], far(i)[axis], far(i + 1)[axis], x[i][axis]))
    })
}

fn random_stencil(random: &mut Seeded) -> ([Vec3; 4], [Vec3; 4]) {
    let scale = 10f32.powi((random.bits64() % 9) as i32 - 4);
    let flatten = if random.bits64().is_multiple_of(3) { Vec3::new(1.0, 1.0, 1e-4) } else { Vec3::ONE };
    let shift = random.vector() * if random.bits64().is_multiple_of(2) { 1.0 } else { 0.0 };
    let x_t0 = std::array::from_fn(|_| (shift + random.vector() * flatten) * scale);
    let speed = 10f32.powi((random.bits64() % 5) as i32 - 4) * scale;
    (x_t0, x_t0.map(|x| x + speed * random.vector()))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    /// What four lanes reject, the tests proper (in f64, and rounded closest points) reject.
    #[test]
    fn lanes_reject_only_what_is_apart(seed in any::<u64>()) {
        let mut random = Seeded::new(seed);
        let mut rejected = [0; 2];
        for kind in [CandidateKind::VertexFace, CandidateKind::EdgeEdge] {
            for _ in 0..200 {
                let (x_t0, x_t1) = random_stencil(&mut random);
                let separation = if random.bits64().is_multiple_of(2) { 0.0 } else { 0.1 * random.signed().abs() };
                let left = undecided(kind, &lanes(x_t0), &lanes(x_t1), Vec4::splat(separation));
                prop_assert_eq!(left & 1, left >> 3 & 1);
                if left & 1 == 0 {
                    rejected[0] += 1;
                    prop_assert_eq!(ccd(kind, x_t0, x_t1, separation).toi, None, "{:?} {:?} {:?}", kind, x_t0, x_t1);
                }
                let left = undecided_at_rest(kind, &lanes(x_t0), Vec4::splat(separation));
                if left & 1 == 0 {
                    rejected[1] += 1;
                    prop_assert_eq!(proximity(kind, x_t0, separation), None, "{:?} {:?}", kind, x_t0);
                }
            }
        }
        prop_assert!(rejected.iter().all(|&count| count > 100), "{:?} of 400 rejected", rejected);
    }
}
