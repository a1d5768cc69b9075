//! Broad phase against the oracle: the sets of candidates are equal, for any number of ranks, threads and batches.

use loomtree::collision::broad::{
    Broad, BroadError, BroadStats, CollisionMesh, CollisionMeshError, Query, brute_force,
};
use loomtree::collision::{Candidate, CandidateKind};
use loomtree::gpu::CpuExecutor;
use loomtree::math::Vec3;
use proptest::prelude::*;
use support::collision::{Model, folded, sphere};
use support::seeded::Seeded;

fn run(
    broad: &mut Broad,
    cpu: &CpuExecutor,
    query: &Query,
    rank: usize,
    ranks: usize,
    limit: Option<u64>,
) -> Result<(Vec<Candidate>, BroadStats), BroadError> {
    let mut found = Vec::new();
    let mut largest = 0;
    let stats = broad.candidates(cpu, query, rank, ranks, limit, &mut |batch| {
        largest = largest.max(batch.len());
        found.extend_from_slice(batch);
    })?;
    assert_eq!(stats.candidates, found.len() as u64);
    assert!(largest <= 4096, "the buffer is bounded");
    Ok((found, stats))
}

/// All ranks together find the oracle's list, each candidate once.
fn check(model: &Model, radius_m: f32, ranks: usize, threads: usize, limit: Option<u64>) -> Vec<BroadStats> {
    let query = model.query(radius_m);
    let mesh = model.mesh();
    let expected = brute_force(&mesh, &query).expect("an oracle");
    let cpu = CpuExecutor::new(threads);
    let mut broad = Broad::new(mesh);
    let (mut all, mut stats) = (Vec::new(), Vec::new());
    for rank in 0..ranks {
        let (found, own) = match run(&mut broad, &cpu, &query, rank, ranks, limit) {
            Err(BroadError::MemoryLimit { needs_bytes, limit_bytes }) => {
                assert_eq!(Some(limit_bytes), limit);
                assert!(needs_bytes > limit_bytes);
                let (found, own) =
                    run(&mut broad, &cpu, &query, rank, ranks, Some(needs_bytes)).expect("the limit it asked for");
                assert!(own.bytes <= needs_bytes, "{} of {needs_bytes} bytes", own.bytes);
                (found, own)
            }
            other => other.expect("candidates"),
        };
        if let Some(limit) = limit.filter(|&limit| own.bytes > limit) {
            let retry = run(&mut broad, &cpu, &query, rank, ranks, Some(limit));
            assert!(matches!(retry, Err(BroadError::MemoryLimit { .. })), "more than the limit was used");
        }
        all.extend(found);
        stats.push(own);
    }
    all.sort_unstable();
    let twice: Vec<_> = all.windows(2).filter(|w| w[0] == w[1]).map(|w| w[0]).take(3).collect();
    assert!(twice.is_empty(), "reported twice: {twice:?}");
    let missed: Vec<_> = expected.iter().filter(|c| all.binary_search(c).is_err()).take(3).collect();
    let extra: Vec<_> = all.iter().filter(|c| expected.binary_search(c).is_err()).take(3).collect();
    assert!(missed.is_empty() && extra.is_empty(), "{ranks} ranks: missed {missed:?}, extra {extra:?}");
    let tests: u64 = stats.iter().map(|s| s.tests).sum();
    assert!(stats.iter().all(|s| s.tests_total == tests && s.cells == stats[0].cells));
    stats
}

fn check_ranks(model: &Model, radius_m: f32) {
    for ranks in [1, 2, 3, 4, 8] {
        check(model, radius_m, ranks, 1, None);
    }
    check(model, radius_m, 3, 3, None);
    check(model, radius_m, 2, 1, Some(200_000));
    check(model, radius_m, 2, 2, Some(1));
}

#[test]
fn two_triangles_by_hand() {
    // One above the other: faces against vertices above, and edges that cross when seen from above.
    let mut model = Model::default();
    let up = |z: f32| [Vec3::new(0.0, 0.0, z), Vec3::new(1.0, 0.0, z), Vec3::new(0.0, 1.0, z)];
    model.x0 = [up(0.0), up(0.1)].concat();
    model.x1 = model.x0.clone();
    model.triangles = vec![[3, 5, 4], [1, 2, 0]];
    let mesh = model.mesh();
    assert_eq!(mesh.triangles, [[1, 2, 0], [3, 5, 4]], "sorted, corners as given");
    assert_eq!(mesh.edges, [[0, 1], [0, 2], [1, 2], [3, 4], [3, 5], [4, 5]]);
    assert_eq!(brute_force(&mesh, &model.query(0.05)).expect("an oracle"), [], "too far apart");
    let found = brute_force(&mesh, &model.query(0.11)).expect("an oracle");
    let vertex_face: Vec<_> = found.iter().filter(|c| c.is_vertex_face()).map(|c| c.vertices).collect();
    assert_eq!(vertex_face, [[0, 3, 5, 4], [1, 3, 5, 4], [2, 3, 5, 4], [3, 1, 2, 0], [4, 1, 2, 0], [5, 1, 2, 0]]);
    assert_eq!(found.len() - vertex_face.len(), 9, "all edges, their boxes touch");
    assert!(found.iter().all(|c| c.kind != CandidateKind::EdgeEdge as u32 || c.vertices[..2] < c.vertices[2..]));
    check_ranks(&model, 0.05);
    check_ranks(&model, 0.11);
    // Swept through each other.
    model.x1[3..].iter_mut().for_each(|x| x.z = -0.2);
    assert_eq!(brute_force(&model.mesh(), &model.query(0.0)).expect("an oracle").len(), 15);
    check_ranks(&model, 0.0);
}

#[test]
fn every_feature_has_one_owner() {
    let mut model = Model::default();
    model.sheet(9, 7, folded, |x| x);
    model.sheet(8, 8, sphere(Vec3::ZERO, 0.5), |x| x);
    // A third triangle on an edge.
    model.x0.push(Vec3::ONE);
    let last = model.x0.len() as u32 - 1;
    model.triangles.push([0, 1, last]);
    let mesh = model.mesh();
    let bits: u32 = mesh.owned.iter().map(|o| o.count_ones()).sum();
    assert_eq!(bits as usize, mesh.vertices + mesh.edges.len());
    assert!(mesh.owned.iter().all(|o| o.count_ones() <= 4), "spread evenly");
    assert!(mesh.edges.windows(2).all(|w| w[0] < w[1]));
}

#[test]
fn folded_sheets_moving() {
    let mut random = Seeded::new(1);
    for (n, m) in [(5, 3), (17, 13), (31, 23)] {
        let mut model = Model::default();
        model.sheet(n, m, folded, |x| x + 0.01 * random.vector());
        model.sheet(m, n, |u, v| folded(v, u) + Vec3::new(0.013, 0.011, 0.002), |x| x - Vec3::new(0.02, 0.0, 0.01));
        check_ranks(&model, 0.0);
        check_ranks(&model, 0.003);
    }
}

#[test]
fn proximity_of_layers_in_any_order_of_triangles() {
    let mut random = Seeded::new(2);
    let mut model = Model::default();
    for layer in 0..3 {
        model.sheet(19, 17, |u, v| Vec3::new(u, v, 0.002 * layer as f32 + 0.001 * (u * 30.0).sin()), |x| x);
    }
    model.shuffle(&mut random);
    check_ranks(&model, 0.0021);
}

#[test]
fn obstacles_of_all_sizes() {
    let mut model = Model::default();
    model.sheet(25, 25, |u, v| Vec3::new(u - 0.5, v - 0.5, 0.3 + 0.02 * (u * 50.0).sin()), |x| x - Vec3::Z * 0.01);
    model.obstacles_follow();
    // Finer than the cloth, coarser, and a floor of two huge tilted triangles far beyond the cloth.
    model.sheet(60, 60, sphere(Vec3::new(0.0, 0.0, 0.19), 0.1), |x| x + Vec3::Z * 0.02);
    model.sheet(6, 6, sphere(Vec3::new(0.2, 0.1, 0.0), 0.31), |x| x);
    model.sheet(2, 2, |u, v| Vec3::new(200.0 * (u - 0.5), 300.0 * (v - 0.4), 40.0 * (u - 0.5) + 0.2), |x| x);
    let obstacle = model.cloth.expect("obstacles") as u32;
    for radius_m in [0.0, 0.01] {
        check_ranks(&model, radius_m);
        let found = brute_force(&model.mesh(), &model.query(radius_m)).expect("an oracle");
        assert!(found.iter().all(|c| c.vertices.iter().any(|&v| v < obstacle)), "obstacles against obstacles");
        assert!(found.iter().filter(|c| c.vertices.iter().any(|&v| v >= obstacle)).count() > 100);
    }
}

#[test]
fn a_floor_of_two_triangles_costs_one_test_per_cloth_triangle_and_half() {
    let mut model = Model::default();
    model.sheet(60, 60, |u, v| Vec3::new(u, v, 0.001), |x| x);
    model.obstacles_follow();
    model.sheet(2, 2, |u, v| Vec3::new(1e4 * (u - 0.3), 1e4 * (v - 0.2), 3e3 * (u - 0.3)), |x| x);
    let alone = {
        let mut alone = model.clone();
        alone.cloth = None;
        alone.triangles.truncate(59 * 59 * 2);
        check(&alone, 0.0, 1, 1, None)[0]
    };
    let stats = check(&model, 0.0, 1, 1, None)[0];
    let triangles = 59 * 59 * 2;
    // At most 8 cells of the coarse grid, two residents each.
    assert!(stats.tests_total - alone.tests_total <= 2 * 8 * triangles, "{} tests", stats.tests_total);
    assert!(stats.entries - alone.entries <= 8 * (triangles + 2), "{} entries", stats.entries);
}

#[test]
fn cloth_triangles_of_very_different_sizes() {
    let mut model = Model::default();
    let squeeze = |u: f32| u.powi(6);
    model.sheet(33, 33, |u, v| Vec3::new(squeeze(u), squeeze(v), 0.01 * (u * 9.0).sin()), |x| x);
    model.sheet(5, 5, |u, v| Vec3::new(u, v, 0.004), |x| x + Vec3::splat(0.003));
    // One vertex shot far away: its triangles are huge.
    model.x1[400] = Vec3::new(30.0, 20.0, -5e4);
    check_ranks(&model, 0.001);
}

#[test]
fn degenerate_boxes_and_identical_positions() {
    // All vertices in one point: every pair is a candidate.
    let mut model = Model::default();
    model.sheet(7, 6, |_, _| Vec3::new(0.3, -0.1, 2.0), |x| x);
    check_ranks(&model, 0.0);
    // At the origin, where boxes have no extent at all.
    let mut model = Model::default();
    model.sheet(7, 6, |_, _| Vec3::ZERO, |x| x);
    check_ranks(&model, 0.0);
    // Flat in z, boxes without height; and a line.
    let mut model = Model::default();
    model.sheet(15, 15, |u, v| Vec3::new(u, v, 0.0), |x| x);
    model.sheet(9, 9, |u, v| Vec3::new(u + v, 0.5, 0.0), |x| x);
    check_ranks(&model, 0.0);
}

#[test]
fn all_triangles_in_one_cell() {
    // One triangle across everything sets no cell size, but a radius beyond the whole model does.
    let mut model = Model::default();
    model.sheet(9, 9, folded, |x| x);
    check_ranks(&model, 50.0);
    let stats = check(&model, 50.0, 8, 1, None);
    let (largest, total) = (stats.iter().map(|s| s.tests).max().expect("ranks"), stats[0].tests_total);
    assert!(largest <= total / 8 + 1, "a cell is split: {largest} of {total}");
}

#[test]
fn outliers_far_away_cost_no_resolution() {
    let mut model = Model::default();
    model.sheet(40, 40, |u, v| Vec3::new(u, v, 0.0), |x| x);
    let near = check(&model, 0.0, 1, 1, None)[0];
    for far in [1e3, 1e6, 1e12] {
        let mut model = model.clone();
        model.sheet(4, 4, |u, v| Vec3::new(u - far, v + far, far), |x| x);
        check_ranks(&model, 0.0);
        let stats = check(&model, 0.0, 1, 1, None)[0];
        assert!(
            stats.tests_total < 2 * near.tests_total,
            "{} tests at {far} m, {} before",
            stats.tests_total,
            near.tests_total
        );
    }
}

#[test]
fn clustered_tests_are_split_evenly_and_entries_shrink() {
    // Half of the triangles lie in a small spot, layer on layer as cloth in a funnel.
    let mut model = Model::default();
    model.sheet(61, 61, |u, v| Vec3::new(6.0 * u, 6.0 * v, 0.1 * (u * 40.0).sin()), |x| x);
    for layer in 0..24 {
        let lift = 0.004 * layer as f32;
        model.sheet(13, 13, move |u, v| Vec3::new(3.0 + 1.2 * u, 3.0 + 1.2 * v, 0.05 * (u * 7.0).sin() + lift), |x| x);
    }
    let mesh = model.mesh();
    let query = model.query(0.001);
    let cpu = CpuExecutor::new(1);
    let one = run(&mut Broad::new(mesh.clone()), &cpu, &query, 0, 1, None).expect("candidates").1;
    let stats: Vec<_> = (0..8)
        .map(|rank| run(&mut Broad::new(mesh.clone()), &cpu, &query, rank, 8, None).expect("candidates").1)
        .collect();
    let mean = one.tests_total as f64 / 8.0;
    let largest = stats.iter().map(|s| s.tests).max().expect("ranks") as f64;
    assert!(largest / mean <= 1.05, "{largest} over {mean}");
    assert_eq!(stats.iter().map(|s| s.tests).sum::<u64>(), one.tests);
    assert_eq!(stats.iter().map(|s| s.candidates).sum::<u64>(), one.candidates);
    // A cell that is split is held by the ranks that share it, so the sum grows a little.
    let entries = stats.iter().map(|s| s.entries).sum::<u64>() as f64;
    assert!(entries <= 1.2 * one.entries as f64, "{entries} entries on 8 ranks, {} on one", one.entries);
}

#[test]
fn a_memory_limit_makes_batches() {
    let mut model = Model::default();
    model.sheet(70, 70, folded, |x| x);
    let free = check(&model, 0.002, 1, 1, None)[0];
    assert_eq!(free.batches, 1);
    let mesh = model.mesh();
    let mut broad = Broad::new(mesh);
    let cpu = CpuExecutor::new(1);
    let query = model.query(0.002);
    run(&mut broad, &cpu, &query, 0, 1, None).expect("candidates");
    let tables = free.bytes - 32 * free.entries;
    let limit = tables + 32 * free.entries / 5;
    let (found, stats) = run(&mut broad, &cpu, &query, 0, 1, Some(limit)).expect("candidates in batches");
    assert!(stats.batches >= 5 && stats.bytes <= limit, "{stats:?}, limit {limit}");
    assert_eq!(found.len() as u64, free.candidates);
    assert_eq!(stats.entries, free.entries);
}

#[test]
fn nothing_to_do() {
    let mut broad = Broad::new(CollisionMesh::new(0, 0, vec![]).expect("an empty mesh"));
    let cpu = CpuExecutor::new(1);
    let query = Query { x_t0: &[], x_t1: &[], radius_m: 1.0 };
    assert_eq!(run(&mut broad, &cpu, &query, 0, 3, Some(1 << 20)).expect("no candidates").0, []);
    // Obstacles only, and vertices without triangles.
    let mut model = Model::default();
    model.x0 = vec![Vec3::ZERO; 2];
    model.x1 = model.x0.clone();
    model.obstacles_follow();
    model.sheet(4, 4, |u, v| Vec3::new(u, v, 0.0), |x| x);
    assert_eq!(check(&model, 0.1, 1, 1, None)[0].tests_total, 0);
}

#[test]
fn bad_input_is_refused() {
    let new = |triangles| CollisionMesh::new(4, 3, triangles).expect_err("a bad mesh");
    assert!(matches!(
        new(vec![[0, 1, 2], [0, 1, 4]]),
        CollisionMeshError::VertexOutOfRange { triangle: 1, vertex: 4, .. }
    ));
    assert!(matches!(new(vec![[0, 2, 2]]), CollisionMeshError::RepeatedVertex { triangle: 0, vertex: 2 }));
    assert!(matches!(new(vec![[1, 2, 3]]), CollisionMeshError::JoinsClothAndObstacle { triangle: 0, .. }));
    assert!(matches!(CollisionMesh::new(1, 2, vec![]), Err(CollisionMeshError::ClothVertices { .. })));

    let mut model = Model::default();
    model.sheet(4, 4, folded, |x| x);
    let mut broad = Broad::new(model.mesh());
    let cpu = CpuExecutor::new(1);
    let mut refused =
        |query: Query, rank| broad.candidates(&cpu, &query, rank, 2, None, &mut |_| ()).expect_err("a bad query");
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e19] {
        let mut broken = model.clone();
        broken.x1[7].y = bad;
        let error = refused(broken.query(0.0), 0);
        assert!(matches!(error, BroadError::Position { which: "end", vertex: 7, .. }), "{error}");
    }
    for bad in [f32::NAN, f32::INFINITY, -1e-3] {
        assert!(matches!(refused(model.query(bad), 0), BroadError::Radius { .. }));
    }
    assert_eq!(refused(model.query(0.0), 2), BroadError::Rank { rank: 2, ranks: 2 });
    let short = Query { x_t0: &[0.0; 5], ..model.query(0.0) };
    let error = refused(short, 0);
    assert_eq!(error.to_string(), "the start positions have 5 values, but 16 vertices need 48");
}

/// Distance between two segments or a point and a triangle, by sampling: never below the true one.
fn sampled_distance(candidate: &Candidate, at: impl Fn(u32) -> Vec3) -> f32 {
    let [a, b, c, d] = candidate.vertices.map(at);
    let steps = (0..=8).map(|i| i as f32 / 8.0);
    let mut least = f32::INFINITY;
    for (s, t) in steps.clone().flat_map(|s| steps.clone().map(move |t| (s, t))) {
        let distance = if candidate.is_vertex_face() {
            a.distance(b + (c - b) * s * (1.0 - t) + (d - b) * t * s)
        } else {
            (a + (b - a) * s).distance(c + (d - c) * t)
        };
        least = least.min(distance);
    }
    least
}

#[test]
fn no_pair_within_the_radius_is_left_out() {
    // Not through boxes: any pair that comes within the radius at a sampled time must be among the candidates.
    let mut random = Seeded::new(5);
    let mut model = Model::default();
    model.sheet(8, 7, folded, |x| x + 0.05 * random.vector());
    model.sheet(6, 7, |u, v| folded(u, v) + Vec3::splat(0.03), |x| x - Vec3::splat(0.04));
    let radius_m = 0.02;
    let mesh = model.mesh();
    let (found, _) = run(&mut Broad::new(mesh.clone()), &CpuExecutor::new(1), &model.query(radius_m), 0, 1, None)
        .expect("candidates");
    let found: std::collections::HashSet<_> = found.into_iter().collect();
    let mut pairs = Vec::new();
    for (i, a) in mesh.edges.iter().enumerate() {
        pairs.extend(
            mesh.edges[..i]
                .iter()
                .filter(|b| !b.contains(&a[0]) && !b.contains(&a[1]))
                .map(|b| Candidate::edge_edge(*a, *b)),
        );
    }
    for face in &mesh.triangles {
        pairs.extend((0..mesh.vertices as u32).filter(|v| !face.contains(v)).map(|v| Candidate::vertex_face(v, *face)));
    }
    let mut near = 0;
    for time in [0.0, 0.25, 0.5, 0.75, 1.0] {
        let at = |v: u32| model.x0[v as usize].lerp(model.x1[v as usize], time);
        for pair in pairs.iter().filter(|pair| sampled_distance(pair, at) <= radius_m) {
            assert!(found.contains(pair), "{pair:?} at time {time}");
            near += 1;
        }
    }
    assert!(near > 300, "{near} near pairs");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn random_soups(seed in any::<u64>(), vertices in 3usize..90, triangles in 0usize..140, obstacle in 0usize..40,
                    spread in -3i32..3, speed in -4i32..1, radius in -5i32..0, ranks in 1usize..9, threads in 1usize..3) {
        let mut random = Seeded::new(seed);
        let mut model = Model::default();
        let cloth = vertices + 3;
        let total = cloth + obstacle;
        for _ in 0..total {
            let x = random.vector() * if random.bits64().is_multiple_of(7) { 10f32.powi(spread) } else { 1.0 };
            model.x0.push(x);
            model.x1.push(x + random.vector() * 10f32.powi(speed));
        }
        model.cloth = Some(cloth);
        for _ in 0..triangles {
            let (start, len) = if obstacle >= 3 && random.bits64().is_multiple_of(3) { (cloth, obstacle) } else { (0, cloth) };
            let near = (random.bits64() % len as u64) as usize;
            let corners = [0, 1, 2].map(|k| (start + (near + k * (1 + random.bits64() as usize % 3)) % len) as u32);
            if !model.triangles.contains(&corners) && corners[0] != corners[1] && corners[1] != corners[2] && corners[0] != corners[2] {
                model.triangles.push(corners);
            }
        }
        check(&model, 10f32.powi(radius), ranks, threads, None);
    }
}
