//! Start states that cross: refused with a mesh of what crosses, or untangled until no two triangles share a point. What
//! comes out is checked by brute force here, not by the search that the program uses.

use std::path::Path;

use loomtree::collision::elementary::{CandidateKind, ccd};
use loomtree::math::Vec3;
use loomtree::mesh::{
    Group, GroupKind, Tangle, TriangleMesh, crossings, edge_crosses_triangle, read_surface, unique_edges,
};
use loomtree::scene::{Obstacles, Overrides, Scene, SceneError, load, load_untangled};
use support::process::{Place, flag};

/// A level sheet and one that leans through it by a degree, as wide as a hand.
const LEANING: &str = r#"
[simulation]
step_s = 0.004
steps_per_frame = 3
frames = 6
thickness_m = 0.002
[[cloth]]
name = "level"
sheet = { size_m = [0.3, 0.2], triangles = 200 }
plane = "xz"
[[cloth]]
name = "leaning"
sheet = { size_m = [0.3, 0.2], triangles = 300 }
plane = "xz"
origin_m = [0.013, -0.0026, 0.005]
rotate_deg = [1, 0, 0, 1]
[[pin]]
cloth = "level"
corners = ["top-left", "top-right"]
motion = [{ time_s = 0.02 }, { time_s = 0.06, translate_m = [0, 0.01, 0] }]
"#;

const SPHERE: &str = r#"
[[cloth]]
sheet = { size_m = [1, 1], triangles = 1000 }
plane = "xz"
[[obstacle]]
name = "ball"
sphere = { center_m = [0.5, DEPTH, -0.5], radius_m = 0.3, triangles = 500 }
"#;

fn written(text: &str) -> (tempfile::TempDir, std::path::PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("s.toml");
    std::fs::write(&file, text).unwrap();
    (folder, file)
}

fn both(text: &str) -> (Scene, Scene, loomtree::scene::Untangling) {
    let (_folder, file) = written(text);
    assert!(matches!(load(&file, &Overrides::default()), Err(SceneError::Crossing { .. })));
    let (scene, done) = load_untangled(&file, &Overrides::default()).unwrap();
    // Without collisions nothing is looked at, so this is the start as the file has it.
    let at = text.find("[simulation]").map_or(0, |at| at + "[simulation]".len());
    let head = if at == 0 { "[simulation]\n" } else { "\n" };
    let as_written = format!("{}{head}collisions = false\n{}", &text[..at], &text[at..]);
    std::fs::write(&file, as_written).unwrap();
    (load(&file, &Overrides::default()).unwrap(), scene, done.unwrap())
}

/// Cloth and obstacles at time 0 as one mesh, and the number of cloth triangles.
fn whole(scene: &Scene) -> (TriangleMesh, usize) {
    let all = Obstacles::new(&scene.obstacles);
    let mut values = Vec::new();
    all.positions_at(0.0, &mut values);
    let mut mesh = TriangleMesh { material_uv: Vec::new(), ..scene.mesh.clone() };
    let (vertices, cloth) = (mesh.positions.len() as u32, mesh.triangles.len());
    mesh.positions.extend(values.chunks_exact(3).map(Vec3::from_slice));
    mesh.triangles.extend(all.triangles().iter().map(|t| t.map(|v| v + vertices)));
    (mesh, cloth)
}

/// Edges that meet a triangle with none of their vertices, where one of the two is of the cloth: all against all.
fn faults(mesh: &TriangleMesh, cloth: usize) -> usize {
    let vertices = mesh.triangles[..cloth].iter().flatten().max().map_or(0, |v| v + 1);
    let mut faults = 0;
    for [p, q] in unique_edges(mesh) {
        let [x, y] = [p, q].map(|v| mesh.positions[v as usize]);
        for (t, corners) in mesh.triangles.iter().enumerate() {
            let of_cloth = t < cloth || p < vertices;
            if of_cloth && !corners.contains(&p) && !corners.contains(&q) {
                let [a, b, c] = corners.map(|v| mesh.positions[v as usize]);
                faults += usize::from(edge_crosses_triangle(x, y, a, b, c));
            }
        }
    }
    faults
}

#[test]
fn two_sheets_that_cross_shallowly() {
    let (before, after, done) = both(LEANING);
    let (mesh, cloth) = whole(&before);
    assert!(faults(&mesh, cloth) > 0);
    let (mesh, cloth) = whole(&after);
    assert_eq!(faults(&mesh, cloth), 0);
    assert_eq!(after.mesh.material_uv, before.mesh.material_uv);
    assert!(done.pairs > 10 && done.rounds > 0 && done.vertices_moved > 0, "{done:?}");
    // The sheets are 2.6 mm through each other at their ends, and 1 mm of air comes on top.
    assert!(done.largest_m > 0.0 && done.largest_m < 0.01, "{done:?}");
    let moved = |v: usize| after.mesh.positions[v].distance(before.mesh.positions[v]);
    assert_eq!((0..before.mesh.positions.len()).filter(|&v| moved(v) > 0.0).count(), done.vertices_moved);
    assert!(done.vertices_moved < before.mesh.positions.len(), "all were moved");
    assert!(after.pins.iter().all(|pin| moved(pin.vertex as usize) == 0.0));
}

#[test]
fn a_sheet_through_a_sphere() {
    for (depth, farthest) in [("-0.28", 0.03), ("-0.2", 0.12), ("-0.1", 0.25), ("0.2", 0.12)] {
        let (_, after, done) = both(&SPHERE.replace("DEPTH", depth));
        let (mesh, cloth) = whole(&after);
        assert_eq!(faults(&mesh, cloth), 0, "{depth}");
        assert!(done.largest_m < farthest, "{depth}: {done:?}");
        // The corners of the ball lie on a sphere of 0.3 m and its faces well outside 0.28 m.
        let centre = Vec3::new(0.5, depth.parse().unwrap(), -0.5);
        let nearest = after.mesh.positions.iter().map(|p| p.distance(centre)).fold(f32::INFINITY, f32::min);
        assert!(nearest > 0.28, "{depth}: a vertex is {nearest} m from the centre");
        assert_eq!(after.mesh.positions[0], load_corner(depth), "far away nothing moves");
    }
}

fn load_corner(depth: &str) -> Vec3 {
    let text = format!("[simulation]\ncollisions = false\n{}", SPHERE.replace("DEPTH", depth));
    let (_folder, file) = written(&text);
    load(&file, &Overrides::default()).unwrap().mesh.positions[0]
}

/// A sheet of `n` x `n` cells, and what it is at any place.
fn sheet(n: u32, place: impl Fn(f32, f32) -> Vec3) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    let at = |i: u32| i as f32 / n as f32;
    for (i, j) in (0..=n).flat_map(|j| (0..=n).map(move |i| (i, j))) {
        mesh.positions.push(place(at(i), at(j)));
    }
    for (i, j) in (0..n).flat_map(|j| (0..n).map(move |i| (i, j))) {
        let v = j * (n + 1) + i;
        mesh.triangles.extend([[v, v + 1, v + n + 2], [v, v + n + 2, v + n + 1]]);
    }
    mesh
}

#[test]
fn a_sheet_folded_through_itself_and_the_same_on_any_number_of_threads() {
    // Rolled up once and a bit, so that the end passes through the beginning.
    let mesh = sheet(40, |u, v| {
        let turn = 7.0 * u;
        let radius = 0.3 - 0.02 * (2.0 * turn - 7.0).sin().abs() * v;
        Vec3::new(radius * turn.cos(), v, radius * turn.sin() + 0.004 * v)
    });
    let groups = [Group { triangles: 0..mesh.triangles.len(), kind: GroupKind::Cloth }];
    let movable = vec![true; mesh.positions.len()];
    let tangle = Tangle { triangles: &mesh.triangles, groups: &groups, movable: &movable, gap_m: 1e-3 };
    assert!(crossings(&mesh.positions, &mesh.triangles, &groups).len() > 20);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| tangle.untangle(&mesh.positions))
    };
    let done = with(1);
    assert_eq!(done, with(3));
    assert_eq!(done.left, [[0; 2]; 0], "{} pairs before", done.pairs_before);
    let after = TriangleMesh { positions: done.positions, ..mesh };
    assert_eq!(faults(&after, after.triangles.len()), 0);
}

#[test]
fn sheets_laid_onto_each_other_and_flat_folds_touch() {
    let twice = "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 50 }\n".repeat(2);
    let (_, after, done) = both(&twice);
    let (mesh, cloth) = whole(&after);
    assert_eq!(faults(&mesh, cloth), 0);
    assert!(done.largest_m < 0.1, "more than half a cell: {done:?}");
    let fold = |lift: f32| {
        let mut mesh = sheet(1, |u, v| Vec3::new(u, v, 0.0));
        mesh.positions[2] = mesh.positions[1] + Vec3::new(0.0, 0.0, lift);
        mesh.positions[2].x -= 0.3;
        let groups = [Group { triangles: 0..2, kind: GroupKind::Cloth }];
        crossings(&mesh.positions, &mesh.triangles, &groups).len()
    };
    assert_eq!((fold(0.0), fold(1e-6)), (1, 0));
}

/// Touching at the start is what a step takes for touching: whatever is accepted, standing still is free of impacts.
fn nothing_is_hit_standing_still(mesh: &TriangleMesh) {
    let at = |v: u32| mesh.positions[v as usize];
    let hit = |kind, x| ccd(kind, x, x, 0.0).toi.is_some();
    let mut used: Vec<u32> = mesh.triangles.iter().flatten().copied().collect();
    used.sort_unstable();
    used.dedup();
    for v in used {
        for corners in mesh.triangles.iter().filter(|corners| !corners.contains(&v)) {
            let [a, b, c] = corners.map(at);
            assert!(!hit(CandidateKind::VertexFace, [at(v), a, b, c]), "vertex {v}, face {corners:?}");
        }
    }
    let edges = unique_edges(mesh);
    for (i, one) in edges.iter().enumerate() {
        for other in edges[i + 1..].iter().filter(|other| !other.iter().any(|v| one.contains(v))) {
            let x = [at(one[0]), at(one[1]), at(other[0]), at(other[1])];
            assert!(!hit(CandidateKind::EdgeEdge, x), "edges {one:?} and {other:?}");
        }
    }
}

#[test]
fn an_accepted_start_is_no_impact() {
    let mut accepted = 0;
    for k in 0..24 {
        let gap = 10f32.powi(-(k % 8)) * 1e-1;
        let mut mesh = sheet(4, |u, v| Vec3::new(u, v, 0.1 * (5.0 * u + k as f32).sin() * (4.0 * v).cos()));
        let above = sheet(4, |u, v| Vec3::new(u, v, 0.1 * (5.0 * u + k as f32).sin() * (4.0 * v).cos() + gap));
        let vertices = mesh.positions.len() as u32;
        mesh.positions.extend(above.positions);
        mesh.triangles.extend(above.triangles.iter().map(|t| t.map(|v| v + vertices)));
        // Leaning, so that no axis tells the two apart.
        let turn = loomtree::math::Quat::from_rotation_x(0.7) * loomtree::math::Quat::from_rotation_y(0.4);
        mesh.positions.iter_mut().for_each(|p| *p = turn * *p);
        let groups = [Group { triangles: 0..mesh.triangles.len(), kind: GroupKind::Cloth }];
        if crossings(&mesh.positions, &mesh.triangles, &groups).is_empty() {
            accepted += 1;
            nothing_is_hit_standing_still(&mesh);
        }
    }
    assert!(accepted >= 18, "only {accepted} were accepted");
}

#[test]
fn an_accepted_start_is_no_impact_on_meshes_of_others() {
    let Ok(data) = std::env::var("LOOMTREE_TEST_DATA") else {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
        return;
    };
    for (name, accepted) in [
        ("ipc-toolkit-tests/two-cubes-close.ply", true),
        ("ipc-toolkit-tests/two-cubes-far.ply", true),
        ("ipc-toolkit-tests/two-cubes-intersecting.ply", false),
        ("hostile-meshes/self_intersecting.obj", false),
    ] {
        let surface = read_surface(&Path::new(&data).join(name)).unwrap();
        let mesh = TriangleMesh { positions: surface.positions, triangles: surface.triangles, material_uv: Vec::new() };
        let groups = [Group { triangles: 0..mesh.triangles.len(), kind: GroupKind::Cloth }];
        assert_eq!(crossings(&mesh.positions, &mesh.triangles, &groups).is_empty(), accepted, "{name}");
        if accepted {
            nothing_is_hit_standing_still(&mesh);
        }
        let movable = vec![true; mesh.positions.len()];
        let done = Tangle { triangles: &mesh.triangles, groups: &groups, movable: &movable, gap_m: 1e-3 }
            .untangle(&mesh.positions);
        let after = TriangleMesh { positions: done.positions, ..mesh };
        assert_eq!(faults(&after, after.triangles.len()), 0, "{name}");
    }
}

fn names(place: &Place) -> Vec<String> {
    let entries = std::fs::read_dir(place.path("")).unwrap().flatten();
    let mut names: Vec<String> = entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    // Where the output of the programs themselves goes.
    names.retain(|name| !name.starts_with("output-"));
    names.sort();
    names
}

#[test]
fn a_refused_run_leaves_a_mesh_of_what_crosses_and_nothing_else() {
    let place = Place::new();
    place.write("s.toml", LEANING);
    let before = names(&place);
    let ended = place.run("run s.toml --executor cpu --out out").expect(2);
    for word in ["s.toml, line ", "of `level` and triangle ", "out.crossings.obj holds a mesh", "`--untangle`"] {
        assert!(ended.error().contains(word), "{}", ended.story);
    }
    let new = |place: &Place| names(place).into_iter().filter(|name| !before.contains(name)).collect::<Vec<_>>();
    assert_eq!(new(&place), ["out.crossings.obj"]);
    assert!(read_surface(&place.path("out.crossings.obj")).unwrap().triangles.len() > 10);
    // The default directory out/s has no place yet.
    place.run("run s.toml --executor cpu").expect(2).says(&["(s.crossings.obj holds a mesh"]);
    assert_eq!(new(&place), ["out.crossings.obj", "s.crossings.obj"]);
}

#[test]
fn what_cannot_be_untangled_is_refused_with_numbers_and_its_best_state() {
    let place = Place::new();
    let pinned = |cloth| format!("[[pin]]\ncloth = \"{cloth}\"\nbox_m = [[-9, -9, -9], [9, 9, 9]]\n");
    let free = LEANING.split("[[pin]]").next().unwrap();
    place.write("s.toml", format!("{free}{}{}", pinned("level"), pinned("leaning")));
    let before = names(&place);
    let ended = place.run("run s.toml --executor cpu --untangle --out out").expect(2);
    let error = ended.error().to_owned();
    let numbers = error.split("untangling did not end, ").nth(1).and_then(|rest| rest.split(" pairs").next()).unwrap();
    let (left, of) = numbers.split_once(" of ").unwrap();
    assert_eq!(left, of, "nothing may move: {error}");
    assert!(of.parse::<u32>().unwrap() > 10, "{error}");
    for word in ["out.crossings.obj holds a mesh of them", "out.untangled.obj the best state of the cloth"] {
        assert!(error.contains(word), "{error}");
    }
    let new: Vec<String> = names(&place).into_iter().filter(|name| !before.contains(name)).collect();
    assert_eq!(new, ["out.crossings.obj", "out.untangled.obj"]);
    assert_eq!(read_surface(&place.path("out.untangled.obj")).unwrap().triangles.len(), whole_size(&place));
    place.run("check s.toml --untangle best.obj").expect(2).says(&["best.obj the best state of the cloth"]);
    assert!(place.path("best.obj").exists());
}

fn whole_size(place: &Place) -> usize {
    let text = std::fs::read_to_string(place.path("s.toml")).unwrap();
    place.write("free.toml", text.replacen("[simulation]", "[simulation]\ncollisions = false", 1));
    load(&place.path("free.toml"), &Overrides::default()).unwrap().mesh.triangles.len()
}

#[test]
fn an_untangled_run_says_so_and_goes_on_with_the_same_bits() {
    let place = Place::new();
    place.write("s.toml", LEANING);
    let ended = place.run("run s.toml --executor cpu --untangle --out straight --format obj").expect(0);
    assert!(ended.stderr.contains("untangled: "), "{}", ended.story);
    let record = place.report("straight")["untangled"].clone();
    assert!(record["largest_m"].as_f64().unwrap() > 0.0 && record["pairs"].as_u64().unwrap() > 10, "{record}");
    let checked = place.run("check s.toml --untangle start.obj").expect(0);
    assert!(checked.stdout.contains("written to start.obj"), "{}", checked.story);
    let (start, frame) = ("start.obj", "straight/frames/frame_000000.obj");
    let [start, frame] = [start, frame].map(|file| read_surface(&place.path(file)).unwrap());
    assert_eq!(start.positions, frame.positions);
    for last in [0, 6] {
        let surface = read_surface(&place.path(&format!("straight/frames/frame_{last:06}.obj"))).unwrap();
        let mesh = TriangleMesh { positions: surface.positions, triangles: surface.triangles, material_uv: Vec::new() };
        assert_eq!(faults(&mesh, mesh.triangles.len()), 0, "frame {last}");
    }
    // Two pieces and a pin that moves: nothing of the start may be taken from the state that a run goes on from.
    place.run("run s.toml --executor cpu --untangle --out out --frames 3 --workers 2").expect(0);
    place.run("run --resume --out out --frames 6 --workers 3").expect(0);
    assert_eq!(place.hashes("out"), place.hashes("straight"));
    assert_eq!(place.report("out")["untangled"], record);
}

#[test]
fn there_may_be_nothing_to_untangle() {
    let place = Place::new();
    place.write("flag.toml", flag(200, 2, 1));
    place.run("run flag.toml --executor cpu --untangle --out out").expect(0);
    assert!(place.report("out").get("untangled").is_none());
    let ended = place.run("check flag.toml --untangle out.obj").expect(0);
    assert!(ended.stdout.contains("nothing to untangle") && !place.path("out.obj").exists(), "{}", ended.story);
    place.write("m.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    assert!(place.run("check m.obj --untangle out.obj").expect(2).error().contains("--untangle needs a scene"));
}
