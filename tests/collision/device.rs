//! Detection with kernels, on a device and with their native twins: brute force's candidates, and the contacts and
//! impacts of the native detection bit for bit, on any number of ranks.

use std::path::Path;
use std::sync::Arc;

use loomtree::collision::broad::{BroadError, BroadStats, DeviceBroad, Filter, Query, Search, Split, brute_force};
use loomtree::collision::{
    Candidate, ContactParams, Detector, RunsOn, merge_contacts, merge_impacts, smallest_altitudes,
};
use loomtree::gpu::{CpuExecutor, Executor};
use loomtree::math::Vec3;
use loomtree::scene::{Overrides, parse};
use loomtree::solver::ExchangeMode;
use support::collision::{Model, flat, folded, sphere};
use support::device;
use support::seeded::Seeded;
use support::{Outcome, simulate};

/// Twins, and the device if there is one.
fn executors() -> Vec<Executor> {
    std::iter::once(Executor::cpu(1)).chain(device::executor()).collect()
}

/// A folded sheet and another one through it, both moving, one lone large triangle of cloth, a finer and a coarser
/// obstacle, a floor of two triangles, and a piece far away.
fn scene(n: usize, seed: u64) -> Model {
    let mut random = Seeded::new(seed);
    let mut model = Model::default();
    model.sheet(n, n + 3, folded, |x| x + 0.01 * random.vector());
    let mut random = Seeded::new(seed + 1);
    model.sheet(
        n,
        n,
        |u, v| Vec3::new(0.4 * u - 0.2, v, 0.05 + 0.02 * (9.0 * u).sin()),
        |x| x + 0.03 * random.vector(),
    );
    model.sheet(2, 2, |u, v| Vec3::new(3.0 * u - 1.0, 2.0 * v - 0.5, 0.08 + 0.01 * u), |x| x - 0.05 * Vec3::Z);
    model.sheet(3, 3, |u, v| Vec3::new(500.0 + u, v, 300.0), |x| x);
    model.obstacles_follow();
    model.sheet(17, 13, sphere(Vec3::new(0.05, 0.4, 0.1), 0.2), |x| x + 0.02 * Vec3::Y);
    model.sheet(5, 4, sphere(Vec3::new(-0.05, 0.7, 0.0), 0.4), |x| x);
    model.sheet(2, 2, |u, v| Vec3::new(40.0 * u - 20.0, 40.0 * v - 20.0, 0.03), |x| x + 0.01 * Vec3::Z);
    model.shuffle(&mut Seeded::new(seed + 2));
    model
}

/// Candidates of all ranks, sorted.
fn candidates(
    executor: &Executor,
    model: &Model,
    query: &Query,
    filter: &Filter,
    ranks: usize,
    limit: Option<u64>,
) -> (Vec<Candidate>, Vec<BroadStats>) {
    let (mesh, mut all, mut stats) = (Arc::new(model.mesh()), Vec::new(), Vec::new());
    assert!(DeviceBroad::fits(&mesh));
    for rank in 0..ranks {
        // An executor's arrays each, as in a process each.
        let mut broad = DeviceBroad::new(executor, mesh.clone());
        let before = all.len();
        let emit = &mut |found: &[Candidate]| all.extend_from_slice(found);
        let (host, split) = (CpuExecutor::new(1), &mut Split::alone(rank, ranks));
        let search = Search { filter: *filter, memory_limit_bytes: limit, ..Search::all(*query) };
        let own = broad.search((executor, &host), &search, split, emit);
        let own = own.expect("a search").expect("few tests");
        assert_eq!(own.candidates, (all.len() - before) as u64);
        stats.push(own);
    }
    all.sort_unstable();
    (all, stats)
}

#[test]
fn every_number_of_ranks_finds_what_brute_force_finds_each_once() {
    for executor in executors() {
        for (n, radius_m) in [(4, 0.0), (13, 0.004), (26, 0.0)] {
            let model = scene(n, 3 + n as u64);
            let query = model.query(radius_m);
            let expected = brute_force(&model.mesh(), &query).expect("brute force");
            assert!(expected.len() > 500);
            for ranks in [1, 2, 3, 4, 7] {
                let (found, stats) = candidates(&executor, &model, &query, &Filter::Boxes, ranks, None);
                assert!(
                    found == expected,
                    "{} with {ranks} ranks: {} of {}",
                    executor.name(),
                    found.len(),
                    expected.len()
                );
                let tests = stats.iter().map(|s| s.tests).collect::<Vec<_>>();
                assert_eq!(tests.iter().sum::<u64>(), stats[0].tests_total);
                assert!(tests.iter().max().unwrap() - tests.iter().min().unwrap() <= 1, "an even split: {tests:?}");
            }
        }
    }
}

#[test]
fn a_cell_with_thousands_of_triangles_is_shared_by_ranks() {
    for executor in executors() {
        let mut model = Model::default();
        let mut random = Seeded::new(8);
        model.sheet(60, 60, |u, v| Vec3::new(u, v, 0.02), |x| x + 0.021 * random.vector());
        model.obstacles_follow();
        model.sheet(2, 2, |u, v| Vec3::new(30.0 * u - 9.0, 30.0 * v - 11.0, 0.0), |x| x);
        let query = model.query(0.0);
        let (expected, _) = candidates(&executor, &model, &query, &Filter::Boxes, 1, None);
        assert!(expected == brute_force(&model.mesh(), &query).expect("brute force"));
        for ranks in [2, 5] {
            assert!(candidates(&executor, &model, &query, &Filter::Boxes, ranks, None).0 == expected, "{ranks}");
        }
    }
}

#[test]
fn a_memory_limit_makes_batches_and_changes_nothing() {
    for executor in executors() {
        let model = scene(30, 5);
        let query = model.query(0.003);
        let (expected, free) = candidates(&executor, &model, &query, &Filter::Boxes, 1, None);
        assert_eq!(free[0].batches, 1);
        let refused = DeviceBroad::new(&executor, Arc::new(model.mesh())).search(
            (&executor, &CpuExecutor::new(1)),
            &Search { memory_limit_bytes: Some(1000), ..Search::all(query) },
            &mut Split::alone(0, 1),
            &mut |_| (),
        );
        let Err(BroadError::MemoryLimit { needs_bytes, limit_bytes: 1000 }) = refused else { panic!("{refused:?}") };
        assert!(needs_bytes < free[0].bytes);
        for ranks in [1, 3] {
            let (found, stats) = candidates(&executor, &model, &query, &Filter::Boxes, ranks, Some(needs_bytes));
            assert!(found == expected, "{ranks}");
            assert!(stats.iter().all(|s| s.bytes <= needs_bytes), "{needs_bytes} {stats:?}");
            assert!(ranks > 1 || stats[0].batches > 1);
        }
    }
}

fn params(model: &Model, thickness_m: f32, separation_m: f32) -> ContactParams {
    let (vertices, cloth) = (model.x0.len(), model.cloth.unwrap_or(model.x0.len()));
    let rest = |t: usize| model.triangles[t].map(|v| model.x0[v as usize]);
    ContactParams {
        thickness_m,
        separation_m,
        stiffness_ratio: 0.5,
        step_s: 0.005,
        friction: (0..vertices).map(|v| 0.1 + 0.01 * (v % 7) as f32).collect(),
        inverse_masses_per_kg: (0..vertices).map(|v| if v < cloth && v % 11 != 0 { 1000.0 } else { 0.0 }).collect(),
        smallest_altitudes_m: smallest_altitudes(vertices, &model.triangles, rest),
        friction_factors: Vec::new(),
        thickness_factors: Vec::new(),
    }
}

#[test]
fn contacts_and_impacts_have_the_bits_of_native_detection() {
    let host = CpuExecutor::new(2);
    for executor in executors() {
        for (n, thickness_m, separation_m) in [(9, 0.03, 0.0), (24, 0.006, 1e-4), (41, 0.02, 0.0)] {
            let model = scene(n, n as u64);
            let (x_t0, x_t1) = (flat(&model.x0), flat(&model.x1));
            let mut detector =
                Detector::new(model.mesh(), params(&model, thickness_m, separation_m)).expect("a detector");
            let (mut contacts, mut impacts) = (vec![], vec![]);
            let at_rest = detector.contacts(&host, x_t0, &mut Split::alone(0, 1), &mut contacts).expect("contacts");
            let moving =
                detector.impacts(&host, x_t0, x_t1, None, &mut Split::alone(0, 1), &mut impacts).expect("impacts");
            assert!(contacts.len() > 20 && impacts.len() > 20, "{} {}", contacts.len(), impacts.len());
            let on = RunsOn { host: &host, kernels: Some(&executor) };
            for ranks in [1, 2, 3, 4] {
                let (mut lists, mut moving_lists) = (vec![], vec![]);
                for rank in 0..ranks {
                    let (mut out, mut impacts) = (vec![], vec![]);
                    let split = &mut Split::alone(rank, ranks);
                    let stats = detector.contacts(on, x_t0, split, &mut out).expect("contacts");
                    // Most candidates never reach the host.
                    assert!(4 * stats.broad.candidates < at_rest.broad.candidates * 3, "{stats:?} {at_rest:?}");
                    let stats = detector.impacts(on, x_t0, x_t1, None, split, &mut impacts);
                    assert!(2 * stats.expect("impacts").broad.candidates < moving.broad.candidates);
                    lists.push(out);
                    moving_lists.push(impacts);
                }
                let found = merge_contacts(&lists.iter().map(Vec::as_slice).collect::<Vec<_>>());
                let bits = |list| bytemuck::cast_slice::<_, u8>(list).to_vec();
                assert!(bits(&found) == bits(&contacts), "{} of {}", found.len(), contacts.len());
                let found = merge_impacts(&moving_lists.iter().map(Vec::as_slice).collect::<Vec<_>>());
                assert!(found == impacts, "{} of {}", found.len(), impacts.len());
            }
        }
    }
}

#[test]
fn contacts_ahead_do_not_depend_on_the_number_of_ranks() {
    let host = CpuExecutor::new(2);
    for executor in executors() {
        let model = scene(24, 12);
        let (x, ahead) = (flat(&model.x0), flat(&model.x1));
        let mut detector = Detector::new(model.mesh(), params(&model, 0.006, 0.0)).expect("a detector");
        let on = RunsOn { host: &host, kernels: Some(&executor) };
        let mut merged = |ranks: usize| {
            let lists: Vec<_> = (0..ranks)
                .map(|rank| {
                    let mut out = vec![];
                    detector.contacts_ahead(on, x, ahead, &mut Split::alone(rank, ranks), &mut out).expect("contacts");
                    out
                })
                .collect();
            merge_contacts(&lists.iter().map(Vec::as_slice).collect::<Vec<_>>())
        };
        let one = merged(1);
        assert!([2, 3, 4].into_iter().all(|ranks| merged(ranks) == one), "{}", executor.name());
        let mut near = vec![];
        detector.contacts(&host, x, &mut Split::alone(0, 1), &mut near).expect("contacts");
        assert!(one.len() > near.len() + 20, "{} {}", one.len(), near.len());
        // A few pairs may be proven apart here and not there.
        let mut native = vec![];
        detector.contacts_ahead(&host, x, ahead, &mut Split::alone(0, 1), &mut native).expect("contacts");
        let differ =
            native.iter().filter(|c| !one.contains(c)).count() + one.iter().filter(|c| !native.contains(c)).count();
        assert!(1000 * differ <= native.len(), "{differ} of {}", native.len());
    }
}

#[test]
fn nothing_near_the_reach_is_dropped() {
    // Pairs around the reach within roundoffs, far from the origin and of bad shape: what the filter drops must be
    // apart.
    for executor in executors() {
        let mut random = Seeded::new(77);
        for case in 0..12 {
            let offset = random.vector() * [0.0, 1.0, 300.0][case % 3];
            let size = [1.0, 0.01, 1e-4][case / 4];
            let mut model = Model::default();
            for _ in 0..60 {
                let (place, flatness) = (offset + 30.0 * size * random.vector(), [1.0, 1e-3][case % 2]);
                let (u, v) = (random.vector() * size, random.vector() * size * flatness);
                let normal = u.cross(v).normalize_or_zero();
                let gap = size * 0.1 * (1.0 + 1e-6 * random.signed());
                model.sheet(2, 2, |a, b| place + a * u + b * v, |x| x);
                model.sheet(2, 2, |a, b| place + gap * normal + a * v + b * u, |x| x);
            }
            let x = flat(&model.x0);
            let mut detector = Detector::new(model.mesh(), params(&model, 0.1 * size, 0.0)).expect("a detector");
            let host = CpuExecutor::new(1);
            let (mut native, mut found) = (vec![], vec![]);
            detector.contacts(&host, x, &mut Split::alone(0, 1), &mut native).expect("contacts");
            let on = RunsOn { host: &host, kernels: Some(&executor) };
            detector.contacts(on, x, &mut Split::alone(0, 1), &mut found).expect("contacts");
            assert_eq!(found, native, "case {case}");
            assert!(native.len() > 10, "case {case}: {}", native.len());
        }
    }
}

#[test]
fn nothing_at_all_and_bad_positions() {
    for executor in executors() {
        let model = Model::default();
        assert!(candidates(&executor, &model, &model.query(0.1), &Filter::Boxes, 2, None).0.is_empty());
        let mut model = scene(5, 1);
        model.x1[3].y = f32::NAN;
        let mut broad = DeviceBroad::new(&executor, Arc::new(model.mesh()));
        let refused = broad.search(
            (&executor, &CpuExecutor::new(1)),
            &Search::all(model.query(0.1)),
            &mut Split::alone(0, 1),
            &mut |_| panic!("none"),
        );
        assert!(matches!(refused, Err(BroadError::Position { which: "end", vertex: 3, .. })), "{refused:?}");
    }
}

/// Two sheets fall on each other and on a ball that comes up at 2.5 m/s.
const FALLING: &str = r#"
name = "falling"
resolution = 500
[simulation]
step_s = 0.004
steps_per_frame = 1
frames = 30
thickness_m = 0.004
[[cloth]]
name = "lower"
sheet = { size_m = [0.3, 0.3] }
plane = "xz"
origin_m = [-0.15, 0.102, 0.15]
fabric = "cotton"
[[cloth]]
name = "upper"
sheet = { size_m = [0.3, 0.3] }
plane = "xz"
origin_m = [-0.14, 0.108, 0.143]
rotate_deg = [4.0, 0.0, 1.0, 0.0]
fabric = "cotton"
[[obstacle]]
name = "ball"
sphere = { center_m = [0.0, 0.0, 0.0], radius_m = 0.1, triangles = 300 }
friction = 0.3
motion = [{ time_s = 0.0 }, { time_s = 0.1, translate_m = [0.0, 0.25, 0.0] }]
"#;

#[test]
fn a_scene_with_contacts_has_the_same_bits_for_every_rank_count_on_devices() {
    if device::executor().is_none() {
        return;
    }
    let overrides = Overrides { resolution: None, frames: None };
    let scene = parse(FALLING, Path::new("falling.toml"), &overrides).expect("a scene");
    let gpu = |rank| Executor::gpu(None, rank).expect("a device");
    let bits = |outcome: &Outcome| {
        let values = outcome.positions.iter().chain(&outcome.velocities);
        values.map(|v| v.to_array().map(f32::to_bits)).collect::<Vec<_>>()
    };
    let one = simulate(&scene, 1, ExchangeMode::Halo, 25, gpu);
    let contacts = one.stats.iter().map(|s| s.contacts).max().unwrap();
    assert!(contacts > 100, "{contacts}");
    assert!(one.stats.iter().any(|s| s.zones.zones > 0), "some step needs impact zones");
    for ranks in [2, 4] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 25, gpu);
        assert!(bits(&many) == bits(&one), "{ranks} ranks");
    }
}
