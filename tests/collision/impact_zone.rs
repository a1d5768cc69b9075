//! Impact zones: single impacts with known answers, piles and random messes until nothing penetrates, the fail-safe, and
//! the same bits for any number of ranks.

use std::collections::{BTreeMap, BTreeSet};

use loomtree::collision::{Candidate, Impact};
use loomtree::gpu::Executor;
use loomtree::impact_zone::{FailSafes, ImpactZones, Row, Stage, StepPositions, ZoneBatch, ZoneSettings, solve};
use loomtree::math::{Mat3, Vec3};
use support::device;
use support::seeded::Seeded;
use support::zones::{World, settings};

fn v(x: f32, y: f32, z: f32) -> Vec3 {
    Vec3::new(x, y, z)
}

fn cpu() -> Executor {
    Executor::cpu(1)
}

fn vertex(x: &[f32], i: u32) -> Vec3 {
    Vec3::from_slice(&x[3 * i as usize..])
}

/// A small triangle that falls with one corner ahead onto a large one.
fn corner_onto_face(face_inverse_mass: f32) -> World {
    let mut world = World::default();
    let tip = [v(0.0, 0.0, 0.01), v(0.1, 0.0, 0.1), v(0.0, 0.1, 0.1)];
    world.triangle(tip, tip.map(|x| x - Vec3::Z * 0.03), 2.0);
    if face_inverse_mass == 0.0 {
        world.obstacles_from_here();
    }
    let face = [v(-1.0, -1.0, 0.0), v(2.0, -1.0, 0.0), v(-1.0, 2.0, 0.0)];
    world.triangle(face, face, face_inverse_mass);
    world
}

#[test]
fn one_impact_of_free_parts_keeps_momentum() {
    let world = corner_onto_face(1.0);
    let outcome = world.resolve(&cpu(), settings(), 1).unwrap();
    assert_eq!((outcome.counts.rounds, outcome.counts.zones, outcome.counts.impacts), (1, 1, 1));
    assert!(world.is_free(&outcome.x_t1) && !world.is_free(&world.x_t1));
    let change = world.momentum(&outcome.x_t1) - world.momentum(&world.x_t1);
    assert!(change.length() < 1e-7, "{change}");
    // The tip stays above the face by the margin of 0.1 mm, and nothing else moves but the four vertices.
    let face = (vertex(&outcome.x_t1, 3) + vertex(&outcome.x_t1, 4) + vertex(&outcome.x_t1, 5)) / 3.0;
    let gap = vertex(&outcome.x_t1, 0).z - face.z;
    assert!((gap - 1e-4).abs() < 1e-5, "{gap}");
    assert_eq!(outcome.x_t1[3..9], world.x_t1[3..9]);
}

#[test]
fn an_obstacle_is_not_moved() {
    let world = corner_onto_face(0.0);
    let outcome = world.resolve(&cpu(), settings(), 1).unwrap();
    assert!(outcome.counts.rounds == 1 && world.is_free(&outcome.x_t1));
    assert_eq!(outcome.x_t1[9..], world.x_t1[9..]);
    let tip = vertex(&outcome.x_t1, 0);
    assert!((tip - v(0.0, 0.0, 1e-4)).length() < 1e-5, "{tip}");
}

#[test]
fn crossing_edges_share_the_impulse() {
    let mut world = World::default();
    let below = [v(-1.0, 0.0, 0.0), v(1.0, 0.0, 0.0), v(0.0, -0.5, -1.0)];
    let above = [v(0.0, -1.0, 0.01), v(0.0, 1.0, 0.01), v(0.5, 0.0, 1.0)];
    world.triangle(below, below, 1.0);
    world.triangle(above, above.map(|x| x - Vec3::Z * 0.05), 1.0);
    let outcome = world.resolve(&cpu(), settings(), 1).unwrap();
    assert!(world.is_free(&outcome.x_t1) && outcome.counts.rounds == 1, "{:?}", outcome.counts);
    let change = world.momentum(&outcome.x_t1) - world.momentum(&world.x_t1);
    assert!(change.length() < 1e-7, "{change}");
    // Equal masses meet half way.
    let (low, high) = (vertex(&outcome.x_t1, 0).z, vertex(&outcome.x_t1, 3).z);
    assert!((low + 0.02).abs() < 1e-4 && (high - low - 1e-4).abs() < 1e-5, "{low} {high}");
}

/// `sheets` sheets of n x n vertices, 0.2 m wide, 5 mm apart; each falls by `fall_m` more than the one below, and all its
/// vertices by up to as much more, so that all end up crossed.
fn pile(sheets: u32, n: u32, fall_m: f32, seed: u64) -> World {
    let mut world = World::default();
    let mut random = Seeded::new(seed);
    for k in 0..sheets {
        let turn = Mat3::from_rotation_z(0.3 * k as f32);
        let place = |a: f32, b: f32| turn * v(0.2 * (a - 0.5), 0.2 * (b - 0.5), 0.0) + Vec3::Z * 0.005 * k as f32;
        world.sheet(n, 1.0, place, |x| {
            x - Vec3::Z * (fall_m * k as f32 + random.uniform(0.0, fall_m)) + v(random.uniform(-0.01, 0.01), 0.0, 0.0)
        });
    }
    world
}

#[test]
fn a_pile_of_sheets_is_clean_after_a_few_rounds() {
    let world = pile(5, 5, 0.012, 1);
    assert!(world.is_free(&world.x_t0) && !world.is_free(&world.x_t1));
    let outcome = world.resolve(&cpu(), settings(), 1).unwrap();
    println!("{:?}, {} iterations, {:.4} s", outcome.counts, outcome.iterations, outcome.solve_s);
    assert!(world.is_free(&outcome.x_t1));
    assert!(outcome.counts.rounds <= 8, "{:?}", outcome.counts);
    assert_eq!(outcome.counts.fail_safes, 0);
    let change = (world.momentum(&outcome.x_t1) - world.momentum(&world.x_t1)).length();
    assert!(change < 1e-5, "{change}");
}

/// Two thousand vertices in ten layers that all end up crossed: one zone with tens of thousands of impacts.
#[test]
fn a_large_pile_is_clean_after_a_few_rounds() {
    let world = pile(10, 14, 0.005, 2);
    let started = std::time::Instant::now();
    let outcome = world.resolve(&cpu(), settings(), 1).unwrap();
    let all_s = started.elapsed().as_secs_f64();
    println!("{:?}, {} iterations, {:.3} s of {all_s:.3} s", outcome.counts, outcome.iterations, outcome.solve_s);
    assert!(world.is_free(&outcome.x_t1));
    assert!(outcome.counts.largest > 1500, "{:?}", outcome.counts);
    assert_eq!(outcome.counts.fail_safes, 0);
    let change = (world.momentum(&outcome.x_t1) - world.momentum(&world.x_t1)).length();
    assert!(change < 1e-4, "{change}");
}

#[test]
fn results_do_not_depend_on_the_number_of_ranks() {
    // Three piles side by side: several zones.
    let mut world = World::default();
    for (k, seed) in [3, 4, 5].into_iter().enumerate() {
        let other = pile(2, 4, 0.012, seed);
        let first = world.vertices() as u32;
        for i in 0..other.vertices() as u32 {
            let shift = Vec3::X * k as f32;
            world.vertex(vertex(&other.x_t0, i) + shift, vertex(&other.x_t1, i) + shift, 1.0 + 0.01 * i as f32);
        }
        world.triangles.extend(other.triangles.iter().map(|t| t.map(|i| i + first)));
    }
    let executors = [Executor::cpu(1), Executor::cpu(3)].into_iter().map(|e| (e, "cpu"));
    let mut seen: BTreeMap<&str, (Vec<f32>, u64)> = BTreeMap::new();
    for (executor, name) in executors.chain(device::executor().map(|e| (e, "gpu"))) {
        for ranks in [1, 2, 3, 7] {
            let outcome = world.resolve(&executor, settings(), ranks).unwrap();
            assert!(outcome.counts.zones >= 3 && world.is_free(&outcome.x_t1));
            let found = (outcome.x_t1, outcome.iterations);
            assert!(seen.entry(name).or_insert_with(|| found.clone()) == &found, "{name}, {ranks} ranks");
        }
    }
}

#[test]
fn zones_are_the_components_over_movable_vertices() {
    let mut random = Seeded::new(11);
    for case in 0..50 {
        let vertices = 60u32;
        let x_t0: Vec<f32> = (0..3 * vertices).map(|_| random.uniform(-1.0, 1.0)).collect();
        let x_t1: Vec<f32> = x_t0.iter().map(|x| x + random.uniform(-0.1, 0.1)).collect();
        let inverse_masses: Vec<f32> = (0..vertices).map(|i| if i % 3 == 0 { 0.0 } else { 1.0 }).collect();
        let step = StepPositions { x_t0: &x_t0, x_t1: &x_t1, inverse_masses: &inverse_masses };
        let mut zones = ImpactZones::new(settings());
        let mut all: Vec<Impact> = Vec::new();
        // Two rounds: zones of the first grow together in the second.
        for _ in 0..2 {
            let mut impacts = Vec::new();
            for _ in 0..6 {
                let mut pick = BTreeSet::new();
                while pick.len() < 4 || pick.iter().all(|i| i % 3 == 0) {
                    pick.insert(random.below(vertices));
                    if pick.len() > 4 {
                        pick.clear();
                    }
                }
                let p: Vec<u32> = pick.into_iter().collect();
                impacts.push(Impact { candidate: Candidate::edge_edge([p[0], p[2]], [p[1], p[3]]), toi: 0.5 });
            }
            impacts.sort_by_key(Impact::key);
            zones.add(&step, &impacts).unwrap();
            all.extend(impacts);
        }
        // Oracle: labels spread until nothing changes.
        let movable = |i: &u32| inverse_masses[*i as usize] > 0.0;
        let mut label: BTreeMap<u32, u32> =
            all.iter().flat_map(|i| i.candidate.vertices).filter(movable).map(|i| (i, i)).collect();
        loop {
            let before = label.clone();
            for impact in &all {
                let members = impact.candidate.vertices.iter().filter(|i| movable(i));
                let least = members.clone().map(|i| label[i]).min().unwrap();
                members.for_each(|i| *label.get_mut(i).unwrap() = least);
            }
            if before == label {
                break;
            }
        }
        let mut expected: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        label.iter().for_each(|(&i, &l)| expected.entry(l).or_default().push(i));
        let found: Vec<&[u32]> = zones.zones().iter().map(|z| z.vertices()).collect();
        assert_eq!(found, expected.values().map(Vec::as_slice).collect::<Vec<_>>(), "case {case}");
        assert_eq!(zones.zones().iter().map(|z| z.impacts()).sum::<usize>(), all.len());
    }
}

/// A sheet between two plates that move by `down` and `up`.
fn between_plates(down: Vec3, up: Vec3) -> World {
    let mut world = World::default();
    world.sheet(4, 1.0, |a, b| v(0.1 * a, 0.1 * b, 0.0), |x| x);
    world.obstacles_from_here();
    for (height, by) in [(-0.01, up), (0.01, down)] {
        world.sheet(2, 0.0, |a, b| v(0.4 * a - 0.15, 0.4 * b - 0.15, height), |x| x + by);
    }
    world
}

#[test]
fn cloth_between_plates_goes_with_them() {
    for by in [v(0.0, 0.0, 0.05), v(0.02, 0.0, -0.3)] {
        let world = between_plates(by, by);
        let outcome = world.resolve(&cpu(), settings(), 1).unwrap();
        assert!(world.is_free(&outcome.x_t1));
        println!("{:?}", outcome.counts);
    }
    // Plates that leave 1 mm.
    let world = between_plates(-Vec3::Z * 0.0095, Vec3::Z * 0.0095);
    assert!(world.resolve(&cpu(), settings(), 1).is_ok());
}

#[test]
fn plates_that_close_are_named() {
    let world = between_plates(-Vec3::Z * 0.02, Vec3::Z * 0.02);
    let Err(verdict) = world.resolve(&cpu(), settings(), 2) else { panic!("resolved what cannot be") };
    assert!(!verdict.vertices.is_empty() && verdict.vertices.iter().all(|&i| i < 16), "{verdict:?}");
    assert!(!verdict.imposed.is_empty() && verdict.imposed.iter().all(|&i| i >= 16), "{verdict:?}");
    // A pin in the way of an obstacle: there is no movable vertex at all.
    let mut pinned = corner_onto_face(0.0);
    pinned.inverse_masses[0] = 0.0;
    let Err(verdict) = pinned.resolve(&cpu(), settings(), 1) else { panic!("resolved what cannot be") };
    assert_eq!((verdict.vertices, verdict.imposed), (vec![], vec![0, 3, 4, 5]));
}

#[test]
fn the_fail_safe_ends_free_of_penetration() {
    let no_descent = ZoneSettings { attempts: 0, ..settings() };
    let outcome = pile(3, 4, 0.012, 7).resolve(&cpu(), no_descent, 1).unwrap();
    assert!(outcome.fail_safes.rigid > 0, "{:?}", outcome.fail_safes);
    assert_eq!(outcome.iterations, 0);
    let mut stages = [outcome.fail_safes.rigid, outcome.fail_safes.scaled, outcome.fail_safes.still];
    // Onto a turning, moving obstacle: scaled down to its motion.
    let mut world = World::default();
    world.sheet(4, 1.0, |a, b| v(0.1 * a, 0.1 * b, 0.002), |x| x - Vec3::Z * 0.1);
    world.obstacles_from_here();
    let turn = Mat3::from_rotation_y(-0.4);
    world.sheet(2, 0.0, |a, b| v(0.4 * a - 0.15, 0.4 * b - 0.15, 0.0), |x| turn * x + Vec3::Z * 0.3);
    let outcome = world.resolve(&cpu(), no_descent, 1).unwrap();
    assert!(world.is_free(&outcome.x_t1));
    stages[1] += outcome.fail_safes.scaled;
    stages[2] += outcome.fail_safes.still;
    assert!(stages.iter().all(|&n| n > 0), "{stages:?}");
    let expected = turn * vertex(&world.x_t0, 5) + Vec3::Z * 0.3;
    assert!((vertex(&outcome.x_t1, 5) - expected).length() < 1e-5);
}

/// Triangles strewn in a cube, apart at the start, in random motion; some of infinite mass.
fn mess(seed: u64, obstacles: u32) -> World {
    let mut random = Seeded::new(seed);
    let mut world = World::default();
    let pieces = 24;
    for piece in 0..pieces {
        let fixed = piece >= pieces - obstacles;
        if piece == pieces - obstacles {
            world.obstacles_from_here();
        }
        loop {
            let mut near = |c: Vec3, r: f32| c + v(random.uniform(-r, r), random.uniform(-r, r), random.uniform(-r, r));
            let center = near(Vec3::ZERO, 0.15);
            let x_t0 = [near(center, 0.1), near(center, 0.1), near(center, 0.1)];
            let by = near(Vec3::ZERO, 0.15);
            let x_t1 = x_t0.map(|x| if fixed { x + by } else { near(x + by, 0.1) });
            let before = world.clone();
            let inverse_mass = if fixed { 0.0 } else { random.uniform(0.5, 20.0) };
            world.triangle(x_t0, x_t1, inverse_mass);
            if world.is_free(&world.x_t0) {
                break;
            }
            world = before;
        }
    }
    world
}

#[test]
fn any_mess_ends_clean() {
    let mut impossible = 0;
    let (mut rounds, mut failsafes) = (Vec::new(), 0);
    for seed in 0..60 {
        let obstacles = if seed % 3 == 2 { 6 } else { 0 };
        let world = mess(seed, obstacles);
        match world.resolve(&cpu(), settings(), 1) {
            Ok(outcome) => {
                assert!(world.is_free(&outcome.x_t1), "seed {seed}");
                rounds.push(outcome.counts.rounds);
                failsafes += outcome.counts.fail_safes;
            }
            Err(verdict) => {
                assert!(obstacles > 0 && !verdict.imposed.is_empty(), "seed {seed}: {verdict}");
                impossible += 1;
            }
        }
    }
    rounds.sort_unstable();
    println!("rounds {rounds:?}, fail-safes {failsafes}, impossible {impossible}");
    assert!(impossible < 10 && rounds[rounds.len() / 2] <= 5, "{rounds:?}, impossible {impossible}");
}

#[test]
fn stages_follow_each_other() {
    let world = corner_onto_face(0.0);
    let step = StepPositions { x_t0: &world.x_t0, x_t1: &world.x_t1, inverse_masses: &world.inverse_masses };
    let impacts = world.impacts(&world.mesh(), &world.x_t1);
    let mut zones = ImpactZones::new(ZoneSettings { attempts: 2, ..settings() });
    let mut stages = Vec::new();
    let verdict = loop {
        if let Err(verdict) = zones.add(&step, &impacts) {
            break verdict;
        }
        stages.push(zones.stage(&zones.zones()[0]));
    };
    let scaled = [0.5, 0.25, 0.125].map(Stage::Scaled);
    assert_eq!(stages, [vec![Stage::Descent(0), Stage::Descent(1)], scaled.to_vec(), vec![Stage::Still]].concat());
    assert_eq!((verdict.vertices, verdict.imposed), (vec![0], vec![3, 4, 5]));
}

#[test]
fn only_what_still_hits_goes_to_the_fail_safe() {
    let world = pile(3, 4, 0.012, 7);
    let step = StepPositions { x_t0: &world.x_t0, x_t1: &world.x_t1, inverse_masses: &world.inverse_masses };
    let impacts = world.impacts(&world.mesh(), &world.x_t1);
    let mut zones = ImpactZones::new(ZoneSettings { attempts: 4, ..settings() });
    zones.add(&step, &impacts).unwrap();
    assert_eq!((zones.zones().len(), zones.zones()[0].vertices().len()), (1, 48));
    let again = impacts[0];
    (0..4).for_each(|_| zones.add(&step, &[again]).unwrap());
    let mut stuck = again.candidate.vertices.to_vec();
    stuck.sort_unstable();
    let of = |zones: &ImpactZones| {
        let inside = zones.zones().iter().find(|zone| zone.vertices() == stuck).expect("a zone of what hits again");
        let outside = zones.zones().iter().find(|zone| zone.vertices() != stuck).expect("a zone of the rest");
        assert_eq!((zones.zones().len(), outside.vertices().len()), (2, 44));
        assert!(outside.vertices().iter().all(|v| !stuck.contains(v)));
        (zones.stage(inside), zones.stage(outside))
    };
    assert_eq!(of(&zones), (Stage::Rigid, Stage::Descent(1)));
    assert_eq!(zones.active().len(), 2);
    // Where the two meet, the rest gives way.
    let touches = |impact: &&Impact| impact.candidate.vertices.iter().filter(|v| stuck.contains(v)).count() == 2;
    let between = *impacts.iter().find(touches).expect("an impact of both");
    zones.add(&step, &[between]).unwrap();
    assert_eq!(of(&zones), (Stage::Rigid, Stage::Descent(2)));
    for stage in [Stage::Scaled(0.5), Stage::Scaled(0.25), Stage::Still] {
        zones.add(&step, &[again]).unwrap();
        assert_eq!(of(&zones), (stage, Stage::Descent(2)));
    }
    assert_eq!(zones.fail_safes(), FailSafes { rigid: 1, scaled: 2, still: 1 });
}

/// Random zones of a few and of many rows; the last one has more than a workgroup's invocations.
fn random_batch() -> ZoneBatch {
    let mut random = Seeded::new(21);
    let mut batch = ZoneBatch::new();
    for (vertices, rows) in [(1, 1), (4, 1), (7, 9), (40, 60), (300, 200)] {
        let masses: Vec<f64> = (0..vertices).map(|_| f64::from(random.uniform(0.5, 2.0))).collect();
        let mut row = || {
            let normal = v(random.uniform(-0.5, 0.5), random.uniform(-0.5, 0.5), 1.0).normalize();
            let s = f64::from(random.uniform(0.0, 1.0));
            let mut pick = [u32::MAX; 4];
            for i in 0..4 {
                let vertex = random.below(vertices);
                if !pick.contains(&vertex) && random.below(10) > 0 {
                    pick[i] = vertex;
                }
            }
            let target = f64::from(random.uniform(-0.005, 0.01));
            Row {
                normal: normal.to_array().map(f64::from),
                target,
                weights: [1.0, -s, s - 1.0, 0.0],
                vertices: pick,
                yielding: 0.0,
                start: 0.0,
            }
        };
        let rows: Vec<Row> = (0..rows).map(|_| row()).collect();
        batch.push(&masses, rows, 1e-6);
    }
    batch
}

#[test]
fn device_and_native_solve_agree() {
    let Some(gpu) = device::executor() else { return };
    let batch = random_batch();
    let (device, native) = (solve::solve(&gpu, &batch, 20_000), solve::solve(&cpu(), &batch, 20_000));
    assert_eq!(gpu.take_fault(), None);
    for (zone, (a, b)) in device.iter().zip(&native).enumerate() {
        assert!(a.converged && b.converged, "zone {zone}: {} and {} iterations", a.iterations, b.iterations);
        for (a, b) in a.displacements.iter().flatten().zip(b.displacements.iter().flatten()) {
            assert!((a - b).abs() < 2e-5, "zone {zone}: {a} {b}");
        }
    }
    // A zone alone gives the same bits as among others.
    let mut alone = ZoneBatch::new();
    let span = batch.zones[3];
    let local = |row: &Row| Row {
        vertices: row.vertices.map(|v| if v == u32::MAX { v } else { v - span.first_vertex }),
        ..*row
    };
    let mut rows: Vec<(u32, Row)> = span.row_range().map(|row| (batch.given[row], local(&batch.rows[row]))).collect();
    rows.sort_by_key(|&(given, _)| given);
    let rows = rows.into_iter().map(|(_, row)| row);
    alone.push(&batch.inverse_masses[span.vertex_range()], rows, 1e-6);
    assert_eq!(solve::solve(&gpu, &alone, 20_000)[0], device[3]);
}

#[test]
fn the_device_resolves_a_pile() {
    let Some(gpu) = device::executor() else { return };
    let world = pile(5, 5, 0.012, 1);
    let outcome = world.resolve(&gpu, settings(), 1).unwrap();
    println!("{:?}, {} iterations", outcome.counts, outcome.iterations);
    assert!(world.is_free(&outcome.x_t1) && outcome.counts.rounds <= 8);
}
