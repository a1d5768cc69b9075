//! Self-collision culling leaves out nothing that comes near: what it drops is measured at many times of the step.

use std::collections::HashSet;

use loomtree::collision::Candidate;
use loomtree::collision::broad::{Broad, BroadStats, Choice, Query, Search, Sink, Split, brute_force};
use loomtree::collision::elementary::{CandidateKind, closest_points};
use loomtree::gpu::CpuExecutor;
use loomtree::math::Vec3;
use loomtree::transport::InProcessTransport;
use support::collision::{Model, folded, ordered, sphere};
use support::seeded::Seeded;

struct Found(Vec<Candidate>);

impl Sink for Found {
    fn take(&mut self, found: &[Candidate]) {
        self.0.extend_from_slice(found);
    }
}

fn search(broad: &mut Broad, query: &Query, choice: &Choice, split: &mut Split) -> (Vec<Candidate>, BroadStats) {
    let mut all = Vec::new();
    let mut finish = |sink: Found| all.extend(sink.0);
    let search = Search { choice: *choice, ..Search::all(*query) };
    let stats = broad.search(&CpuExecutor::new(1), &search, split, &|| Found(Vec::new()), &mut finish);
    let stats = stats.expect("a search");
    all.sort_unstable();
    (all, stats)
}

const CULL: Choice = Choice { touched: None, piece_radius_m: None, cull: true };

/// A sheet of n x m vertices, in order.
fn sheet(n: usize, m: usize, place: impl Fn(f32, f32) -> Vec3, motion: impl FnMut(Vec3) -> Vec3) -> Model {
    let mut model = Model::default();
    model.sheet(n, m, place, motion);
    ordered(&model, |v| Vec3::new((v % n) as f32, (v / n) as f32, 0.0))
}

/// Distance of the parts of a pair.
fn distance(candidate: &Candidate, x: impl Fn(u32) -> Vec3) -> f32 {
    let kind = if candidate.is_vertex_face() { CandidateKind::VertexFace } else { CandidateKind::EdgeEdge };
    closest_points(kind, candidate.vertices.map(x)).distance_squared.sqrt()
}

/// What culling dropped of all candidates; each must stay beyond the radius on the whole way.
fn dropped(model: &Model, radius_m: f32) -> (usize, usize) {
    let query = model.query(radius_m);
    let all = brute_force(&model.mesh(), &query).expect("an oracle");
    let (kept, stats) = search(&mut Broad::new(model.mesh()), &query, &CULL, &mut Split::alone(0, 1));
    assert!(stats.patches[0] <= stats.patches[1]);
    let set: HashSet<_> = kept.iter().collect();
    assert_eq!(set.len(), kept.len(), "each once");
    let known: HashSet<_> = all.iter().collect();
    assert!(kept.iter().all(|c| known.contains(c)), "culling finds nothing new");
    let mut count = 0;
    for candidate in all.iter().filter(|c| !set.contains(c)) {
        count += 1;
        for time in 0..=24 {
            let at = |v: u32| model.x0[v as usize].lerp(model.x1[v as usize], time as f32 / 24.0);
            let distance = distance(candidate, at);
            assert!(distance > radius_m, "{candidate:?} is {distance} m apart at time {time}/24, radius {radius_m}");
        }
    }
    (count, kept.len())
}

/// A turn about an axis through the origin.
fn turned(x: Vec3, axis: Vec3, angle: f32) -> Vec3 {
    let (axis, (sin, cos)) = (axis.normalize(), angle.sin_cos());
    x * cos + axis.cross(x) * sin + axis * axis.dot(x) * (1.0 - cos)
}

#[test]
fn a_waving_sheet_takes_no_part() {
    let wave = |u: f32, v: f32| Vec3::new(u, v, 0.05 * (9.0 * u + 2.0 * v).sin());
    // Falls by more than its triangles are large, and turns.
    let motion = |x: Vec3| turned(x, Vec3::new(1.0, 2.0, 3.0), 0.01) + Vec3::new(0.02, 0.0, -0.02);
    // 128 chunks of 32 vertices: no short last one, whose patch is too thin a strip to be proven apart.
    let model = sheet(64, 64, wave, motion);
    for radius_m in [0.0, 0.3 / 60.0] {
        let (_, stats) = search(&mut Broad::new(model.mesh()), &model.query(radius_m), &CULL, &mut Split::alone(0, 1));
        assert_eq!((stats.candidates, stats.tests_total, stats.patches[0]), (0, 0, 0), "{stats:?}");
        assert!(dropped(&model, radius_m).0 > 10_000);
    }
}

#[test]
fn what_comes_near_is_looked_at() {
    // Two sheets fall onto each other in one place; an obstacle comes from the side.
    let mut model = Model::default();
    model.sheet(41, 41, |u, v| Vec3::new(u, v, 0.3 * u * u), |x| x);
    model.sheet(21, 21, |u, v| Vec3::new(0.5 * u, 0.5 * v, 0.15 + 0.2 * u * v), |x| x - Vec3::Z * 0.2);
    let places = model.x0.clone();
    let mut model = ordered(&model, |v| places[v]);
    model.obstacles_follow();
    model.sheet(9, 9, sphere(Vec3::new(1.05, 0.5, 0.2), 0.1), |x| x - Vec3::X * 0.1);
    for radius_m in [0.0, 0.008] {
        let (count, kept) = dropped(&model, radius_m);
        assert!(count > 1000 && kept > 1000, "{count} dropped, {kept} kept");
        let obstacle = model.cloth.expect("obstacles") as u32;
        let with = |list: &[Candidate]| list.iter().filter(|c| c.vertices.iter().any(|&v| v >= obstacle)).count();
        let query = model.query(radius_m);
        let (kept, _) = search(&mut Broad::new(model.mesh()), &query, &CULL, &mut Split::alone(0, 1));
        assert_eq!(with(&kept), with(&brute_force(&model.mesh(), &query).expect("an oracle")), "pairs with obstacles");
    }
}

#[test]
fn normals_alone_do_not_do() {
    // A spiral staircase, `turns` turns around z with steps of `pitch`: every triangle faces z, and the turns come near.
    for (pitch, turns) in [(0.02, 1.3), (0.005, 2.0), (0.0005, 1.9), (0.02, 0.8)] {
        let place = move |u: f32, v: f32| {
            let angle = u * turns * std::f32::consts::TAU;
            Vec3::new((0.2 + 0.8 * v) * angle.cos(), (0.2 + 0.8 * v) * angle.sin(), pitch * u * turns)
        };
        for n in [9, 14, 25] {
            let model = sheet(n, 3, place, |x| x * Vec3::new(1.0, 1.0, 0.5));
            let radius_m = 0.011;
            let (count, kept) = dropped(&model, radius_m);
            let near = turns > 1.0 && kept == 0;
            assert!(!near, "turns above each other were left out ({count} dropped)");
        }
    }
}

#[test]
fn a_notch_that_closes() {
    // Flat all the time; the two sides of a slit move towards each other within the plane and overlap.
    for closing in [0.4, 0.9, 1.1, 1.6] {
        let n = 11;
        let mut model = Model::default();
        model.sheet(n, n, |u, v| Vec3::new(u, v, 0.0), |x| x);
        // The slit: no triangles with a vertex in the middle column beyond the middle row.
        let in_slit = |v: u32| v as usize % n == n / 2 && v as usize / n > n / 2;
        model.triangles.retain(|t| !t.iter().any(|&v| in_slit(v)));
        for (x0, x1) in model.x0.iter().zip(&mut model.x1) {
            let side = (x0.x - 0.5).signum() * f32::from(u8::from(x0.x != 0.5));
            x1.x -= closing * 0.1 * side * ((x0.y - 0.5) / 0.5).max(0.0);
        }
        let model = ordered(&model, |v| Vec3::new((v % n) as f32, (v / n) as f32, 0.0));
        for radius_m in [0.0, 0.02] {
            dropped(&model, radius_m);
        }
    }
}

#[test]
fn random_shapes_and_motions() {
    let (mut count, mut kept) = (0, 0);
    for seed in 0..150 {
        let mut random = Seeded::new(seed);
        let mut unit = || 0.5 + 0.5 * random.signed();
        let (bend, wave, lift, spin) = (unit() * 9.0, unit() * 0.2, unit() - 0.5, unit() * 2.0);
        let (noise, shake, radius) = (0.1f32.powf(1.0 + 3.0 * unit()), 0.1f32.powf(1.0 + 3.0 * unit()), unit());
        let (n, m) = (3 + (unit() * 16.0) as usize, 3 + (unit() * 12.0) as usize);
        let mut jitter = Seeded::new(seed + 1000);
        let axis = jitter.vector();
        // Rolled up by `bend`, waving, lifted into a spiral.
        let place = |u: f32, v: f32| {
            let (sin, cos) = (bend * u).sin_cos();
            Vec3::new((1.0 + lift * u) * sin, v + lift * u, (1.0 + lift * u) * cos + wave * (7.0 * v).sin())
                / bend.max(1.0)
        };
        let mut model = sheet(n, m, place, |x| x);
        model.x0.iter_mut().for_each(|x| *x += noise * jitter.vector() / n as f32);
        let shake = shake * if seed % 2 == 0 { 1.0 } else { 0.01 };
        model.x1 = model.x0.iter().map(|x| turned(*x, axis, spin) + shake * jitter.vector()).collect();
        let radius_m = if seed % 3 == 0 { 0.0 } else { radius / (n.max(m) as f32 * bend.max(1.0)) };
        let (more, less) = dropped(&model, radius_m);
        (count, kept) = (count + more, kept + less);
    }
    println!("{count} pairs dropped, {kept} kept");
    assert!(count > 20_000 && kept > 20_000, "{count} dropped, {kept} kept: both must occur");
}

#[test]
fn odd_meshes_are_left_alone() {
    // A third triangle on an edge, a triangle the wrong way round, two sheets joined in one vertex, a closed surface.
    let flat_sheet = || sheet(9, 9, |u, v| Vec3::new(u, v, 0.01 * (u - v)), |x| x);
    let mut fin = flat_sheet();
    fin.x0.push(Vec3::new(0.5, 0.5, 0.02));
    fin.x1.push(Vec3::new(0.5, 0.5, 0.001));
    let [a, b, _] = fin.triangles[30];
    fin.triangles.push([a, b, 81]);
    let mut wrong = flat_sheet();
    let turned_over = &mut wrong.triangles[40];
    turned_over.swap(0, 1);
    let mut joined = flat_sheet();
    let other = flat_sheet();
    joined.x0.extend(other.x0.iter().map(|x| *x + Vec3::new(0.0, 0.0, 0.004)));
    joined.x1 = joined.x0.clone();
    let at = |v: u32| if v == 40 { 40 } else { v + 81 };
    joined.triangles.extend(other.triangles.iter().map(|t| t.map(at)));
    let mut closed = Model::default();
    closed.sheet(9, 9, sphere(Vec3::ZERO, 0.5), |x| x);
    for (name, model) in [("fin", fin), ("wrong", wrong), ("joined", joined), ("closed", closed)] {
        for radius_m in [0.0, 0.02] {
            let (count, kept) = dropped(&model, radius_m);
            assert!(kept > 0, "{name}: {count} dropped, {kept} kept");
        }
    }
}

#[test]
fn ranks_together_find_what_they_find_alone_and_hold_their_share() {
    let place = |u: f32, v: f32| folded(u, v) + Vec3::new(0.0, 2.0 * v, 0.0);
    let mut random = Seeded::new(7);
    let mut model = sheet(90, 70, place, |x| x + 0.001 * random.vector());
    model.obstacles_follow();
    model.sheet(12, 12, sphere(Vec3::new(0.0, 1.0, 0.1), 0.4), |x| x);
    let radius_m = 0.002;
    for cull in [false, true] {
        let choice = Choice { cull, ..Choice::default() };
        let (alone, all) =
            search(&mut Broad::new(model.mesh()), &model.query(radius_m), &choice, &mut Split::alone(0, 1));
        for ranks in [2, 3, 8] {
            let mut lists = Vec::new();
            std::thread::scope(|scope| {
                let ranks: Vec<_> = InProcessTransport::group(ranks)
                    .into_iter()
                    .map(|mut transport| {
                        let (model, choice) = (&model, &choice);
                        scope.spawn(move || {
                            // Messages shorter than the lists.
                            transport.set_max_message_values(700);
                            let split = &mut Split::together(&mut transport);
                            search(&mut Broad::new(model.mesh()), &model.query(radius_m), choice, split)
                        })
                    })
                    .collect();
                lists.extend(ranks.into_iter().map(|rank| rank.join().expect("a rank")));
            });
            let mut found: Vec<Candidate> = lists.iter().flat_map(|(found, _)| found.iter().copied()).collect();
            found.sort_unstable();
            assert_eq!(found, alone, "{ranks} ranks, cull {cull}");
            let mean = all.tests_total as f64 / ranks as f64;
            for (_, own) in &lists {
                assert_eq!((own.tests_total, own.cells, own.patches), (all.tests_total, all.cells, all.patches));
                assert!(own.tests as f64 <= 1.05 * mean, "{} tests of {mean}", own.tests);
            }
            let bytes = lists.iter().map(|(_, own)| own.bytes).max().expect("ranks") as f64 / all.bytes as f64;
            println!("{ranks} ranks, cull {cull}: {bytes:.3} of the bytes of one");
            assert!(bytes <= 1.25 / ranks as f64 + 0.1, "{ranks} ranks hold {bytes} of what one holds");
        }
    }
}
