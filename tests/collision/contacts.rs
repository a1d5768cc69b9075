//! Contacts: against brute force over all stencils, against distances in f64, and cases with known answers.

use std::collections::BTreeSet;

use loomtree::collision::broad::{CollisionMesh, Split};
use loomtree::collision::{Candidate, ContactParams, Detector, DetectorError, merge_contacts, smallest_altitudes};
use loomtree::forces::{ContactElement, NO_VERTEX};
use loomtree::gpu::CpuExecutor;
use loomtree::math::{DVec3, Vec3};
use support::collision::{Model, flat, folded, sphere};
use support::seeded::Seeded;

const STEP_S: f32 = 0.005;

fn params(model: &Model, thickness_m: f32) -> ContactParams {
    let (vertices, cloth) = (model.x0.len(), model.cloth.unwrap_or(model.x0.len()));
    let rest = |t: usize| model.triangles[t].map(|v| model.x0[v as usize]);
    ContactParams {
        thickness_m,
        separation_m: 0.0,
        stiffness_ratio: 0.5,
        step_s: STEP_S,
        friction: (0..vertices).map(|v| if v < cloth { 0.1 + 0.01 * (v % 7) as f32 } else { 0.9 }).collect(),
        inverse_masses_per_kg: (0..vertices).map(|v| if v < cloth && v % 11 != 0 { 1000.0 } else { 0.0 }).collect(),
        smallest_altitudes_m: smallest_altitudes(vertices, &model.triangles, rest),
        friction_factors: Vec::new(),
        thickness_factors: Vec::new(),
    }
}

/// All stencils of a mesh.
fn stencils(mesh: &CollisionMesh) -> Vec<Candidate> {
    let obstacle = |v: u32| v as usize >= mesh.cloth_vertices;
    let used: BTreeSet<u32> = mesh.triangles.iter().flatten().copied().collect();
    let mut all = Vec::new();
    for face in &mesh.triangles {
        let others = used.iter().filter(|v| !(face.contains(v) || obstacle(**v) && obstacle(face[0])));
        all.extend(others.map(|&v| Candidate::vertex_face(v, *face)));
    }
    for (i, a) in mesh.edges.iter().enumerate() {
        let others = mesh.edges[..i].iter().filter(|b| !a.contains(&b[0]) && !a.contains(&b[1]));
        all.extend(others.filter(|b| !(obstacle(a[0]) && obstacle(b[0]))).map(|b| Candidate::edge_edge(*a, *b)));
    }
    all
}

fn bits(contact: &ContactElement) -> &[u8] {
    bytemuck::bytes_of(contact)
}

/// What `ranks` ranks find together.
fn found(detector: &mut Detector, x: &[f32], ranks: usize, threads: usize, limit: Option<u64>) -> Vec<ContactElement> {
    let cpu = CpuExecutor::new(threads);
    let lists: Vec<Vec<ContactElement>> = (0..ranks)
        .map(|rank| {
            let mut out = vec![];
            detector.limit_memory(limit);
            let stats = detector.contacts(&cpu, x, &mut Split::alone(rank, ranks), &mut out).expect("contacts");
            assert_eq!(stats.found, out.len() as u64);
            assert!(out.windows(2).all(|w| w[0].key() < w[1].key()), "sorted, each once");
            assert!(limit.is_none() || stats.broad.batches > 1, "the limit makes batches");
            out
        })
        .collect();
    merge_contacts(&lists.iter().map(Vec::as_slice).collect::<Vec<_>>())
}

/// Every number of ranks and threads finds brute force's contacts, bit for bit; returns them.
fn check(model: &Model, thickness_m: f32) -> Vec<ContactElement> {
    let mut detector = Detector::new(model.mesh(), params(model, thickness_m)).expect("a detector");
    let x = flat(&model.x0);
    let mut expected: Vec<_> = stencils(detector.mesh()).iter().filter_map(|s| detector.contact(x, s)).collect();
    expected.sort_by_key(ContactElement::key);
    for pair in expected.windows(2).filter(|pair| pair[0].key() == pair[1].key()) {
        assert_eq!(bits(&pair[0]), bits(&pair[1]), "the same pair through two stencils");
    }
    expected.dedup_by_key(|contact| contact.key());
    for (ranks, threads) in [(1, 1), (2, 1), (3, 2), (4, 1), (8, 2)] {
        let all = found(&mut detector, x, ranks, threads, None);
        let keys = |list: &[ContactElement]| list.iter().map(ContactElement::key).collect::<BTreeSet<_>>();
        let (missed, extra): (Vec<_>, Vec<_>) = (
            keys(&expected).difference(&keys(&all)).copied().take(3).collect(),
            keys(&all).difference(&keys(&expected)).copied().take(3).collect(),
        );
        assert!(missed.is_empty() && extra.is_empty(), "{ranks} ranks: missed {missed:?}, extra {extra:?}");
        assert!(all.iter().zip(&expected).all(|(a, b)| bits(a) == bits(b)), "{ranks} ranks: other bits");
    }
    geometry(model, thickness_m, &expected);
    expected
}

/// Contacts say what they must, in f64: normals and distances are those of the weights, and weights are those of
/// closest points.
fn geometry(model: &Model, thickness_m: f32, contacts: &[ContactElement]) {
    for contact in contacts {
        let present = || (0..4).filter(|&i| contact.vertices[i] != NO_VERTEX);
        let x = |i: usize| model.x0[contact.vertices[i] as usize].as_dvec3();
        let size = present().map(|i| (x(i) - x(0)).length()).fold(0.0, f64::max);
        let sum: f32 = contact.weights.iter().sum();
        assert!(sum.abs() < 1e-6, "{contact:?}");
        let offset: DVec3 = present().map(|i| f64::from(contact.weights[i]) * x(i)).sum();
        let normal = Vec3::from_array(contact.normal).as_dvec3();
        assert!((normal.length() - 1.0).abs() < 1e-6, "{contact:?}");
        let error = (offset - f64::from(contact.distance_m) * normal).length();
        assert!(error <= 2e-5 * size, "{contact:?}: {offset:?} is off by {error}");
        assert!(contact.distance_m < contact.thickness_m && contact.thickness_m <= thickness_m, "{contact:?}");
        // The offset is perpendicular to what both closest points may move along.
        let second = if contact.kind == 0 { 1 } else { 2 };
        for i in present().filter(|&i| i != 0 && i != second) {
            let along = x(i) - if i < second { x(0) } else { x(second) };
            let slope = normal.dot(along) / along.length();
            assert!(slope.abs() < 2e-3, "{contact:?}: slope {slope}");
        }
        let mobility: f64 = present()
            .map(|i| {
                let cloth = model.cloth.unwrap_or(model.x0.len()) > contact.vertices[i] as usize;
                let free = cloth && contact.vertices[i] % 11 != 0;
                f64::from(contact.weights[i]).powi(2) * if free { 1000.0 } else { 0.0 }
            })
            .sum();
        // Edges that cross at less than 10 degrees fade.
        let edges = if contact.kind == 0 { [DVec3::X, DVec3::Y] } else { [x(1) - x(0), x(3) - x(2)] };
        let across = edges[0].normalize().cross(edges[1].normalize()).length();
        let stiffness = 0.5 * (across * across / 0.03).min(1.0) / (mobility * f64::from(STEP_S).powi(2));
        assert!((f64::from(contact.stiffness_n_m) / stiffness - 1.0).abs() < 1e-3, "{contact:?}: {stiffness}");
    }
}

/// A flat grid of squares of side 0.01 m at a height, all diagonals the same way or all the other way.
fn grid(model: &mut Model, n: u32, height: f32, other_way: bool) {
    let first = model.x0.len() as u32;
    for i in 0..n * n {
        let at = Vec3::new(0.01 * (i % n) as f32, 0.01 * (i / n) as f32, height);
        model.x0.push(at);
        model.x1.push(at);
    }
    for (i, j) in (0..n - 1).flat_map(|j| (0..n - 1).map(move |i| (i, j))) {
        let a = first + j * n + i;
        if other_way {
            model.triangles.extend([[a, a + 1, a + n], [a + 1, a + n + 1, a + n]]);
        } else {
            model.triangles.extend([[a, a + 1, a + n + 1], [a, a + n + 1, a + n]]);
        }
    }
}

#[test]
fn aligned_grids_push_vertically_at_every_vertex() {
    let n = 9;
    for other_way in [false, true] {
        let mut model = Model::default();
        grid(&mut model, n, 0.5, false);
        grid(&mut model, n, 0.5005, other_way);
        let contacts = check(&model, 0.001);
        let gap = 0.5005f32 - 0.5;
        for contact in &contacts {
            assert_eq!(contact.normal, [0.0, 0.0, -1.0], "{contact:?}");
            assert_eq!(contact.distance_m, gap, "{contact:?}");
        }
        // One contact per pair of vertices that is not pinned on both sides; diagonals that cross in flat sheets are
        // none.
        let vertices = contacts.iter().filter(|c| c.vertices[2] == NO_VERTEX).count() as u32;
        let both_pinned = (0..n * n).filter(|v| v % 11 == 0 && (v + n * n) % 11 == 0).count() as u32;
        assert_eq!(vertices, n * n - both_pinned);
        assert_eq!(contacts.len() as u32, vertices);
    }
}

#[test]
fn grids_shifted_by_half_a_square_and_tilted_ones_are_supported() {
    for tilt in [0.0f32, 0.01] {
        for (shift_x, shift_y) in [(0.005, 0.0), (0.005, 0.005), (0.0025, 0.001), (1e-7, 0.0)] {
            let mut model = Model::default();
            grid(&mut model, 9, 0.0, false);
            let lower = model.x0.len();
            grid(&mut model, 9, 0.0, true);
            for x in &mut model.x0[lower..] {
                *x = Vec3::new(x.x + shift_x, x.y + shift_y, 0.0004 + tilt * x.x);
            }
            model.x1 = model.x0.clone();
            let contacts = check(&model, 0.0015);
            for contact in &contacts {
                let up = contact.normal[2].abs();
                assert!(up > 0.9999 - tilt, "{contact:?}");
            }
            // Inner vertices above the other sheet all take part.
            let inner = |v: u32| (1..8).contains(&(v % 81 % 9)) && (1..8).contains(&(v % 81 / 9));
            let supported: BTreeSet<u32> = contacts.iter().flat_map(|c| c.vertices).collect();
            let missing: Vec<u32> = (0..162).filter(|&v| inner(v) && !supported.contains(&v)).collect();
            assert!(missing.is_empty(), "tilt {tilt}, shift {shift_x}, {shift_y}: {missing:?}");
        }
    }
}

#[test]
fn a_vertex_above_a_flat_sheet_has_one_contact_straight_below() {
    for (x, y) in [(0.0423, 0.0391), (0.04, 0.0437), (0.04, 0.04), (0.0455, 0.0455)] {
        let mut model = Model::default();
        grid(&mut model, 9, 0.0, false);
        let tip = model.x0.len() as u32;
        let at = Vec3::new(x, y, 0.004);
        model.x0.extend([at, at + Vec3::new(0.01, 0.0, 0.05), at + Vec3::new(0.0, 0.01, 0.05)]);
        model.x1 = model.x0.clone();
        model.triangles.push([tip, tip + 1, tip + 2]);
        let contacts = check(&model, 0.008);
        assert_eq!(contacts.len(), 1, "{contacts:?}");
        assert!((contacts[0].normal[2].abs() - 1.0).abs() < 1e-6 && (contacts[0].distance_m - 0.004).abs() < 1e-8);
    }
}

#[test]
fn rims_that_face_each_other_push_in_their_plane() {
    for shift in [0.0, 0.0025] {
        let mut model = Model::default();
        grid(&mut model, 5, 0.0, false);
        grid(&mut model, 5, 0.0, false);
        model.x0[25..].iter_mut().for_each(|x| *x += Vec3::new(0.0405, shift, 0.0));
        model.x1 = model.x0.clone();
        let contacts = check(&model, 0.001);
        let wanted = if shift == 0.0 { 5 } else { 8 };
        assert_eq!(contacts.len(), wanted, "{contacts:?}");
        for contact in &contacts {
            assert_eq!(contact.vertices[2] == NO_VERTEX, shift == 0.0, "vertices meet vertices, or edges: {contact:?}");
            assert!(contact.vertices[3] == NO_VERTEX && contact.normal[0].abs() > 0.999_999, "{contact:?}");
        }
    }
}

#[test]
fn a_fine_sheet_does_not_repel_itself() {
    let mut model = Model::default();
    model.sheet(31, 31, |u, v| Vec3::new(0.03 * u, 0.03 * v, 0.0), |x| x);
    // Edges of 1 mm, thickness 5 mm.
    assert_eq!(check(&model, 0.005), []);
    // Another piece above is repelled at the full thickness.
    let first = model.x0.len() as u32;
    model.x0.extend([Vec3::new(0.013, 0.0141, 0.004), Vec3::new(0.03, 0.01, 0.04), Vec3::new(0.01, 0.03, 0.04)]);
    model.x1 = model.x0.clone();
    model.triangles.push([first, first + 1, first + 2]);
    let contacts = check(&model, 0.005);
    assert!(!contacts.is_empty() && contacts.iter().all(|c| c.thickness_m == 0.005), "{contacts:?}");
}

#[test]
fn folded_layers_and_obstacles() {
    let mut random = Seeded::new(11);
    let mut model = Model::default();
    model.sheet(19, 13, folded, |x| x);
    model.sheet(13, 15, |u, v| folded(v, u) + Vec3::new(0.013, 0.011, 0.002), |x| x);
    let cloth = model.x0.len();
    model.obstacles_follow();
    model.sheet(12, 12, sphere(Vec3::new(0.0, 0.5, 0.1), 0.12), |x| x);
    model.sheet(2, 2, |u, v| Vec3::new(20.0 * (u - 0.5), 30.0 * (v - 0.4), 0.02), |x| x);
    model.x0.iter_mut().for_each(|x| *x += 1e-3 * random.vector());
    for thickness_m in [0.0, 0.004, 0.02] {
        let contacts = check(&model, thickness_m);
        let with_obstacle =
            contacts.iter().filter(|c| c.vertices.iter().any(|&v| v != NO_VERTEX && v as usize >= cloth));
        let with_obstacle: Vec<_> = with_obstacle.collect();
        assert!(with_obstacle.iter().all(|c| c.friction == 0.9), "the obstacle's coefficient");
        if thickness_m == 0.02 {
            assert!(
                with_obstacle.len() > 20 && contacts.len() > with_obstacle.len() + 50,
                "{} contacts",
                contacts.len()
            );
            assert!(contacts.iter().any(|c| c.kind == 1) && contacts.iter().any(|c| c.kind == 0));
        }
    }
}

#[test]
fn a_memory_limit_changes_nothing() {
    let mut model = Model::default();
    model.sheet(40, 40, folded, |x| x);
    let mut detector = Detector::new(model.mesh(), params(&model, 0.004)).expect("a detector");
    let x = flat(&model.x0);
    let cpu = CpuExecutor::new(1);
    let stats = detector.contacts(&cpu, x, &mut Split::alone(0, 1), &mut vec![]).expect("contacts");
    let free = found(&mut detector, x, 1, 1, None);
    let limit = stats.broad.bytes - 32 * stats.broad.entries * 3 / 4;
    let limited = found(&mut detector, x, 1, 2, Some(limit + 200_000));
    assert!(free.len() > 10 && free == limited);
    assert!(stats.smallest_gap_m <= free.iter().map(|c| c.distance_m).fold(f32::INFINITY, f32::min));
}

#[test]
fn coinciding_features_get_a_direction() {
    // A vertex in a vertex, on an edge and in a face of another sheet, and edges that cross in a point.
    for at in [Vec3::new(0.04, 0.04, 0.0), Vec3::new(0.045, 0.04, 0.0), Vec3::new(0.047, 0.043, 0.0)] {
        let mut model = Model::default();
        grid(&mut model, 9, 0.0, false);
        let tip = model.x0.len() as u32;
        model.x0.extend([at, at + Vec3::new(0.01, 0.0, 0.05), at + Vec3::new(0.0, 0.01, 0.05)]);
        model.x1 = model.x0.clone();
        model.triangles.push([tip, tip + 1, tip + 2]);
        let contacts = check(&model, 0.001);
        assert!(!contacts.is_empty(), "{at}");
        for contact in contacts {
            assert!(contact.distance_m < 1e-8 && contact.normal[2].abs() > 0.999, "{contact:?}");
        }
    }
}

#[test]
fn parameters_that_do_not_fit_are_refused() {
    let mut model = Model::default();
    model.sheet(4, 4, folded, |x| x);
    let good = params(&model, 0.01);
    let refused = |change: &dyn Fn(&mut ContactParams)| {
        let mut bad = good.clone();
        change(&mut bad);
        Detector::new(model.mesh(), bad).err().expect("a refusal")
    };
    assert!(matches!(refused(&|p| p.thickness_m = -1.0), DetectorError::Value { .. }));
    assert!(matches!(refused(&|p| p.separation_m = f32::NAN), DetectorError::Value { .. }));
    assert!(matches!(refused(&|p| p.friction[3] = f32::NAN), DetectorError::Value { .. }));
    assert_eq!(refused(&|p| p.step_s = 0.0), DetectorError::Step { step_s: 0.0 });
    let error = refused(&|p| p.inverse_masses_per_kg.truncate(5));
    assert_eq!(error.to_string(), "the list of inverse masses has 5 values, but the mesh has 16 vertices");
}
