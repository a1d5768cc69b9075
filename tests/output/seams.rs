//! Seams: what panels become once they are sewn, against counts that were made by merging their lists of pairs; sides
//! of different counts and lengths; other people's formats; and the sentence for every kind of mistake.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use loomtree::math::DVec3;
use loomtree::mesh::{TriangleMesh, closed_parts, validate};
use loomtree::model::{GlobalModel, Sewn, State};
use loomtree::scene::{Overrides, Scene, load, parse};
use support::numpy::test_data;

fn scene_of(text: &str, resolution: Option<u64>) -> Result<Scene, String> {
    let overrides = Overrides { resolution, frames: None };
    parse(text, Path::new("scenes/x.toml"), &overrides).map_err(|error| error.to_string())
}

/// The panels of the test data as a scene.
fn panels(folder: &Path, name: &str, sewing: &str) -> Scene {
    let [mesh, seams] = ["obj", "seams.json"].map(|end| folder.join(format!("{name}.{end}")).display().to_string());
    let text = format!("[sewing]\n{sewing}\n[[cloth]]\nmesh = \"{mesh}\"\nseams = \"{seams}\"\nmaterial = \"uv\"\n");
    scene_of(&text, None).unwrap()
}

/// Vertices, edges, triangles, Euler number and the lengths of the boundary loops.
fn counts(mesh: &TriangleMesh) -> (usize, usize, usize, i64, Vec<usize>) {
    let mut directed: BTreeMap<[u32; 2], usize> = BTreeMap::new();
    for t in &mesh.triangles {
        for i in 0..3 {
            *directed.entry([t[i], t[(i + 1) % 3]]).or_default() += 1;
        }
    }
    assert!(directed.values().all(|&count| count == 1), "an oriented manifold");
    let mut next: BTreeMap<u32, u32> = BTreeMap::new();
    let mut edges = 0;
    for &[a, b] in directed.keys() {
        let is_border = !directed.contains_key(&[b, a]);
        edges += usize::from(is_border || a < b);
        if is_border {
            assert_eq!(next.insert(a, b), None, "one border at a vertex");
        }
    }
    let mut loops = Vec::new();
    while let Some((&start, _)) = next.iter().next() {
        let (mut at, mut length) = (start, 0);
        while let Some(to) = next.remove(&at) {
            (at, length) = (to, length + 1);
        }
        assert_eq!(at, start);
        loops.push(length);
    }
    loops.sort_unstable();
    let (vertices, triangles) = (mesh.positions.len(), mesh.triangles.len());
    (vertices, edges, triangles, vertices as i64 - edges as i64 + triangles as i64, loops)
}

/// Two panels that are sewn along all their edges close a volume at every resolution, whatever triangles lie in their
/// corners.
#[test]
fn a_cushion_is_a_closed_surface_at_every_resolution() {
    let cushion = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/cushion.toml")).unwrap();
    let grid = cushion.replace("size_m = [0.45, 0.45]", "size_m = [0.45, 0.45], mesh = \"grid\"");
    assert!(grid.len() > cushion.len());
    for text in [cushion, grid] {
        for resolution in [100, 256, 700, 1500, 2300, 3000, 6000, 9000] {
            let scene = scene_of(&text, Some(resolution)).unwrap();
            let (sewn, _) = Sewn::of(&scene).unwrap();
            assert_eq!(validate(&sewn.mesh), Ok(()), "{resolution}");
            let (_, _, _, euler, loops) = counts(&sewn.mesh);
            assert_eq!((euler, loops), (2, vec![]), "{resolution}");
            let model = GlobalModel::new(&sewn);
            let outward = closed_parts(&sewn.mesh.triangles, &sewn.mesh.positions);
            let pressed = model.triangles.iter().filter(|triangle| triangle.pressure_pa.abs() == 40.0).count();
            // Flat on each other they hold no volume yet.
            let closed = outward.iter().filter(|outward| **outward != 0.0).count();
            assert_eq!(pressed, closed, "{resolution}");
            assert!(GlobalModel::new(&scene).triangles.iter().all(|triangle| triangle.pressure_pa == 0.0));
        }
    }
}

#[test]
fn sewn_panels_have_the_counts_of_their_truth() {
    let Some(folder) = test_data("garments/panels") else { return };
    for name in ["shirt_1k", "shirt_5k", "shirt_20k", "skirt_1k", "skirt_5k", "skirt_20k", "skirt_5k_gather"] {
        let scene = panels(&folder, name, "");
        let (sewn, _) = Sewn::of(&scene).unwrap();
        assert_eq!(validate(&sewn.mesh), Ok(()), "{name}");
        let truth: serde_json::Value =
            serde_json::from_str(&fs::read_to_string(folder.join(format!("{name}.seams.json"))).unwrap()).unwrap();
        let mut pairs: Vec<[u32; 2]> = serde_json::from_value(truth["pairs"].clone()).unwrap();
        pairs.iter_mut().for_each(|pair| pair.sort_unstable());
        pairs.sort_unstable();
        assert_eq!(scene.sewing.as_ref().unwrap().pairs, pairs, "{name}");
        let after = &truth["truth"]["after_sewing"];
        let (vertices, edges, triangles, euler, loops) = counts(&sewn.mesh);
        let number = |key: &str| after[key].as_i64().unwrap();
        assert_eq!(
            [vertices as i64, edges as i64, triangles as i64, euler],
            [number("vertices"), number("edges"), number("triangles"), number("euler")],
            "{name}"
        );
        let mut expected: Vec<usize> = serde_json::from_value(after["boundary_loop_lengths"].clone()).unwrap();
        expected.sort_unstable();
        assert_eq!(loops, expected, "{name}");
    }
}

#[test]
fn sides_of_different_counts_get_vertices_and_become_a_shirt() {
    let Some(folder) = test_data("garments/panels") else { return };
    let scene = panels(&folder, "shirt_5k_counts_differ", "");
    let file = fs::read_to_string(folder.join("shirt_5k_counts_differ.obj")).unwrap();
    let vertices = file.lines().filter(|line| line.starts_with("v ")).count();
    assert_eq!(vertices, 2849);
    assert!(scene.mesh.positions.len() > vertices + 30);
    let area: f32 = scene.mesh.material_uv.iter().map(|[a, b, c]| (*b - *a).perp_dot(*c - *a) / 2.0).sum();
    assert!((area - 0.639819).abs() < 1e-5, "the pattern stays: {area}");
    let (sewn, _) = Sewn::of(&scene).unwrap();
    assert_eq!(validate(&sewn.mesh), Ok(()));
    let (_, _, _, euler, loops) = counts(&sewn.mesh);
    assert_eq!((euler, loops.len()), (-2, 4));
}

#[test]
fn refining_keeps_the_shape_and_divides_into_four() {
    let Some(folder) = test_data("garments/panels") else { return };
    let scene = panels(&folder, "skirt_1k", "refine = 2");
    let (sewn, _) = Sewn::of(&scene).unwrap();
    assert_eq!(validate(&sewn.mesh), Ok(()));
    let (_, _, triangles, euler, loops) = counts(&sewn.mesh);
    assert_eq!((triangles, euler, loops), (16 * 1202, 0, vec![4 * 24, 4 * 38]));
}

fn momentum(model: &GlobalModel, velocities: &[f32]) -> (f64, DVec3) {
    let of = |(mass, v): (&f32, &[f32; 3])| DVec3::from_array(v.map(f64::from)) * f64::from(*mass);
    let sum = model.masses.iter().zip(velocities.as_chunks::<3>().0).map(of).sum();
    (model.masses.iter().map(|&mass| f64::from(mass)).sum(), sum)
}

#[test]
fn merging_and_refining_keep_mass_and_momentum() {
    let Some(folder) = test_data("garments/panels") else { return };
    for refine in 0..3 {
        let scene = panels(&folder, "shirt_1k", &format!("refine = {refine}"));
        let (after, sewn) = Sewn::of(&scene).unwrap();
        let mut state = State::start_of(&scene);
        for (i, v) in state.velocities.iter_mut().enumerate() {
            let turn = i as f32 * 0.37;
            *v = loomtree::math::Vec3::new(turn.sin() + 0.3, (1.3 * turn).cos(), (0.7 * turn).sin() - 0.2);
        }
        let (_, ends) = sewn.ends(&state.positions);
        let fine = sewn.state(&state, &ends);
        let (mut before_model, mut after_model) = (GlobalModel::new(&scene), GlobalModel::new(&after));
        before_model.set_state(&state);
        after_model.set_state(&fine);
        let (mass, p) = momentum(&before_model, &before_model.velocities);
        let (mass_after, p_after) = momentum(&after_model, &after_model.velocities);
        assert!((mass_after / mass - 1.0).abs() < 1e-6, "{mass} {mass_after}");
        assert!((p_after - p).length() < 1e-6 * p.length(), "{refine}: {p} {p_after}");
        // Vertices that no seam touches stay, and so do those of refined edges.
        assert!(fine.positions.iter().all(|p| p.is_finite()));
        let far = |x: &loomtree::math::Vec3| fine.positions.contains(x);
        let free = (0..state.positions.len()).filter(|&v| ends[v] == state.positions[v]);
        assert!(free.step_by(37).all(|v| far(&state.positions[v])));
    }
}

/// Two sheets side by side, sewn along their sides.
fn two_sheets(seam: &str, sewing: &str, fabric: &str) -> Scene {
    let sheet = |name: &str, x: f64| {
        format!(
            "[[cloth]]\nname = \"{name}\"\nsheet = {{ size_m = [0.2, 0.2], triangles = 128, mesh = \"grid\" }}\n\
             origin_m = [{x}, 0, 0]\n{fabric}"
        )
    };
    let sides = "a = { cloth = \"one\", edge = \"right\" }\nb = { cloth = \"other\", edge = \"left\" }\n";
    let text = format!("[sewing]\n{sewing}{}{}[[seam]]\n{sides}{seam}", sheet("one", 0.0), sheet("other", 0.25));
    scene_of(&text, None).unwrap()
}

/// The edges of a seam, and no others, have its angle at rest, on all parts once they are divided; the field of a seam
/// counts before that of `[sewing]`.
#[test]
fn edges_of_seams_have_their_angle_at_rest() {
    let plastic = "yield_curvature = 30.0\n";
    for (seam, sewing, fabric, degrees) in [
        ("angle_deg = 90.0\n", "", "", 90.0f32),
        ("", "angle_deg = -60.0\nrefine = 1\n", "", -60.0),
        ("angle_deg = 45.0\n", "angle_deg = 10.0\nrefine = 2\n", plastic, 45.0),
        ("", "", "", 0.0),
    ] {
        let panels = two_sheets(seam, sewing, fabric);
        let (sewn, way) = Sewn::of(&panels).unwrap();
        // 8 edges of a side of a grid of 8 x 8 cells.
        let parts = 8 << panels.sewing.as_ref().unwrap().refine;
        let at_rest: Vec<f32> = GlobalModel::new(&sewn).hinges.iter().map(|hinge| hinge.rest_angle).collect();
        let folded = at_rest.iter().filter(|angle| (**angle - degrees.to_radians()).abs() < 1e-6).count();
        let flat = at_rest.iter().filter(|angle| **angle == 0.0).count();
        match degrees {
            0.0 => assert_eq!(flat, at_rest.len()),
            _ => assert_eq!((folded, flat), (parts, at_rest.len() - parts), "{seam}{sewing}"),
        }
        for fold in &sewn.folds {
            let [a, b] = fold.edge.map(|v| sewn.mesh.positions[v as usize]);
            assert!((a.x - 0.225).abs() < 1e-6 && (b.x - 0.225).abs() < 1e-6, "{a} {b}");
        }
        // Of a plastic fabric the state holds them.
        let start = State::start_of(&sewn);
        let reached = way.state(&State::start_of(&panels), &panels.mesh.positions);
        for state in [start, reached] {
            let folded = state.creases.iter().filter(|crease| (crease[0] - degrees.to_radians()).abs() < 1e-6).count();
            assert_eq!(folded, if fabric.is_empty() { 0 } else { parts });
        }
    }
}

/// The panels of the T-shirt bent about the person: none crosses anything, triangles keep their shape, sleeves lie
/// around the arms, and the gaps that threads have to close are shorter.
#[test]
fn panels_are_bent_about_the_limbs_of_a_body() {
    let text = fs::read_to_string("scenes/tshirt.toml").unwrap();
    let wrapped = text.replace("fabric = \"cotton\"", "fabric = \"cotton\"\nwrap = \"person\"");
    assert_ne!(text, wrapped);
    let [flat, bent] = [&text, &wrapped].map(|text| scene_of(text, Some(1_200)).unwrap());
    assert_eq!(flat.mesh.triangles, bent.mesh.triangles);
    let gaps = |scene: &Scene| -> f64 {
        let at = |v: u32| scene.mesh.positions[v as usize].as_dvec3();
        let pairs = &scene.sewing.as_ref().unwrap().pairs;
        pairs.iter().map(|&[a, b]| at(a).distance(at(b))).sum::<f64>() / pairs.len() as f64
    };
    assert!(gaps(&bent) < 0.9 * gaps(&flat), "{} m, {} m without", gaps(&bent), gaps(&flat));
    for [a, b, c] in &bent.mesh.triangles {
        for [p, q] in [[a, b], [b, c], [c, a]] {
            let length = |scene: &Scene| scene.mesh.positions[*p as usize].distance(scene.mesh.positions[*q as usize]);
            let ratio = length(&bent) / length(&flat);
            assert!((0.98..1.0001).contains(&ratio), "{ratio}");
        }
    }
    for (field, sentence) in [
        ("wrap = \"nobody\"", "field `cloth.wrap`: no obstacle is named `nobody` (person)"),
        ("wrap = \"person\"\norigin_m = [2, 0, 0]", "field `cloth.wrap`: no part of obstacle `person` lies before or"),
    ] {
        let fault = scene_of(&wrapped.replace("wrap = \"person\"", field), Some(1_200)).unwrap_err();
        assert!(fault.contains(sentence), "{fault}");
    }
}

/// The limits of the angle, and its sentence.
#[test]
fn a_seam_is_not_folded_onto_itself() {
    let text = "[[cloth]]\nsheet = { size_m = [0.2, 0.2], triangles = 128 }\n[[seam]]\na = { edge = \"left\" }\n\
                b = { edge = \"right\" }\nangle_deg = 180\n";
    let fault = scene_of(text, None).unwrap_err();
    assert!(fault.contains("field `seam.angle_deg`: must be above -180 and below 180 degrees, not 180"), "{fault}");
}

#[test]
fn a_codim_ipc_garment_brings_its_seams() {
    let Some(folder) = test_data("garments/codim_ipc_dress") else { return };
    let file = folder.join("stage.obj").display().to_string();
    let text = format!(
        "[sewing]\nclose_s = 1.0\n[[cloth]]\nname = \"dress\"\nmesh = \"{file}\"\nmaterial = \"uv\"\nseams = true\n"
    );
    let scene = scene_of(&text, None).unwrap();
    let sewing = scene.sewing.as_ref().unwrap();
    // Four of its 94 seams tuck the inside of a panel, some are there twice, and pleats have three layers in one seam:
    // those are left out by name.
    let left_out = |word: &str| scene.left_out.iter().filter(|line| line.contains(word)).count();
    assert_eq!(left_out("is not on a border"), 4, "{:?}", scene.left_out);
    assert!((1..=22).contains(&left_out("is in two seams")), "{:?}", scene.left_out);
    assert!(
        scene.left_out.iter().all(|line| line.starts_with("seam `")) && scene.left_out.len() < 40,
        "{:?}",
        scene.left_out
    );
    let seams: std::collections::BTreeSet<u32> = sewing.seam_of_pair.iter().copied().collect();
    assert!(seams.len() + scene.left_out.len() >= 92 && seams.len() > 50, "{} {:?}", seams.len(), scene.left_out);
    let (sewn, _) = Sewn::of(&scene).unwrap();
    assert_eq!(validate(&sewn.mesh), Ok(()));
    // Without the field they are a note.
    let plain = scene_of(&text.replace("seams = true\n", "").replace("[sewing]\nclose_s = 1.0\n", ""), None).unwrap();
    assert!(plain.sewing.is_none() && plain.left_out[0].contains("its 92 seams are not sewn"), "{:?}", plain.left_out);
}

#[test]
fn a_garmentcode_pattern_is_meshed_at_any_resolution() {
    let Some(folder) = test_data("garments/garmentcode") else { return };
    let file = folder.join("shirt_mean_specification.json").display().to_string();
    let text = format!("[sewing]\n[[cloth]]\nname = \"shirt\"\nmesh = \"{file}\"\n");
    let truth: serde_json::Value =
        serde_json::from_str(&fs::read_to_string(folder.join("truth.json")).unwrap()).unwrap();
    let panels = truth["shirt_mean"]["panels"].as_object().unwrap();
    let area: f64 = panels.values().map(|panel| panel["signed_area_cm2"].as_f64().unwrap().abs()).sum::<f64>() * 1e-4;
    for triangles in [1_000, 5_000, 20_000] {
        let scene = scene_of(&text, Some(triangles)).unwrap();
        let off = scene.mesh.triangles.len() as f64 / triangles as f64 - 1.0;
        assert!(off.abs() < 0.15, "{} for {triangles}", scene.mesh.triangles.len());
        let found: f32 = scene.mesh.material_uv.iter().map(|[a, b, c]| (*b - *a).perp_dot(*c - *a) / 2.0).sum();
        assert!((f64::from(found) / area - 1.0).abs() < 2e-3, "{found} {area}");
        // The halves of front and back hang edge to edge, so two of its 18 seams are closed already.
        assert_eq!((scene.parts.len(), scene.sewing.as_ref().unwrap().names.len()), (8, 16));
        let (sewn, _) = Sewn::of(&scene).unwrap();
        assert_eq!(validate(&sewn.mesh), Ok(()));
        let (_, _, _, euler, loops) = counts(&sewn.mesh);
        assert_eq!((euler, loops.len()), (-2, 4), "{triangles}");
    }
}

const TWO: &str = "[[cloth]]\nname = \"front\"\nsheet = { size_m = [0.2, 0.2], triangles = 8, mesh = \"grid\" }\n\
    [[cloth]]\nname = \"back\"\nsheet = { size_m = [0.2, 0.2], triangles = 8, mesh = \"grid\" }\n\
    rotate_deg = [180, 0, 1, 0]\norigin_m = [0.2, 0, -0.05]\n";

fn fault(text: &str) -> String {
    scene_of(text, None).expect_err("the scene is wrong")
}

#[test]
fn mistakes_of_seams_name_panel_and_edge() {
    let seam = |fields: &str| format!("{TWO}[[seam]]\n{fields}\n");
    let side = |cloth: &str, edge: &str| format!("{{ cloth = \"{cloth}\", edge = \"{edge}\" }}");
    let good = seam(&format!("a = {}\nb = {}", side("front", "left"), side("back", "right")));
    let scene = scene_of(&good, None).unwrap();
    assert_eq!(scene.sewing.unwrap().pairs, [[0, 11], [3, 14], [6, 17]]);
    for (text, words) in [
        (
            format!("{good}[[seam]]\nname = \"other\"\na = {}\nb = {}\n", side("front", "left"), side("back", "top")),
            "`seam[1].a`: the edge of vertices 0 and 3 of `front` is in two seams, seam `0` and seam `other`",
        ),
        (
            seam(&format!("a = {0}\nb = {0}", side("front", "left"))),
            "seam `0` is sewn onto itself: the edge of vertices 3 and 6 of `front` is there twice",
        ),
        (
            seam(&format!("a = {}\nb = {}", side("front", "middle"), side("back", "left"))),
            "a sheet has the edges left, right, bottom and top, not `middle`",
        ),
        (seam(&format!("a = {}", side("front", "left"))), "`seam.b`: is missing"),
        (seam("a = { vertices = [0, 1] }\nb = { vertices = [0, 1] }"), "a seam must say which"),
        (seam(&format!("a = {}\nb = \"hem\"", side("front", "left"))), "no cloth has an edge named `hem`"),
        (seam("cloths = [\"front\", \"back\"]\npairs = [[0, 2], [3, 5], [6, 9]]"), "`back` has no vertex 9"),
        // Upside down: the outside of one to the inside of the other.
        (seam("cloths = [\"front\", \"back\"]\npairs = [[0, 8], [3, 5], [6, 2]]"), "run the wrong way"),
        (seam("cloths = [\"front\", \"front\"]\npairs = [[0, 3]]"), "which are corners of one triangle"),
        (format!("{TWO}[sewing]\nclose_s = 1\n"), "`sewing`: the scene has no seam"),
        (format!("{good}[sewing]\nclose_s = 1\nclose_speed_m_s = 1\n"), "give either `close_s` or `close_speed_m_s`"),
        (format!("{good}[sewing]\nrefine = 9\n"), "`sewing.refine`: must be a whole number from 0 to 5"),
        (
            format!("{good}[[pin]]\ncloth = \"front\"\nedge = \"left\"\n[[pin]]\ncloth = \"back\"\nedge = \"right\"\n"),
            "seam `0` joins vertex 0 of `front` and vertex 2 of `back`, but pins hold both, 0.050 m apart",
        ),
    ] {
        let error = fault(&text);
        assert!(error.contains(words), "{text}\n{error}");
    }
    // A third panel on the same edge.
    let third = "[[cloth]]\nname = \"third\"\nsheet = { size_m = [0.2, 0.2], triangles = 8, mesh = \"grid\" }\n\
        origin_m = [-0.3, 0, 0]\n";
    let text = format!(
        "{TWO}{third}[[seam]]\nname = \"one\"\ncloths = [\"front\", \"back\"]\npairs = [[0, 2], [3, 5], [6, 8]]\n\
         [[seam]]\nname = \"two\"\ncloths = [\"front\", \"third\"]\npairs = [[0, 2], [3, 5], [6, 8]]\n"
    );
    let error = fault(&text);
    assert!(error.contains("3 triangles; at most two may share an edge") && error.contains("`front`"), "{error}");
}

#[test]
fn lists_and_named_edges_of_a_mesh_make_the_same_seam() {
    let folder = tempfile::tempdir().unwrap();
    let obj = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 1.2 0 0\nv 2 0 0\nv 2 1 0\nv 1.2 1 0\nv 1.2 0.3 0\ng left\n\
        f 1 2 3 4\nl 2 3\ng right\nf 5 6 7 9\nf 9 7 8\nl 5 9 8\n";
    let mesh = folder.path().join("two.obj");
    fs::write(&mesh, obj).unwrap();
    let cloth = format!("[[cloth]]\nname = \"two\"\nmesh = \"{}\"\n", mesh.display());
    let list: PathBuf = folder.path().join("two.seams.json");
    fs::write(&list, r#"{ "seams": [{ "a": [1, 2], "b": [4, 8, 7] }] }"#).unwrap();
    let by_file = scene_of(&format!("{cloth}seams = \"{}\"\n", list.display()), None).unwrap();
    let by_list = "[[seam]]\na = { vertices = [1, 2] }\nb = { vertices = [4, 7] }\n";
    let by_list = scene_of(&format!("{cloth}{by_list}"), None).unwrap();
    let by_name = scene_of(&format!("{cloth}[[seam]]\na = \"right\"\nb = \"left\"\n"), None).unwrap();
    // The left side lacks a vertex at 0.3 of its length.
    for scene in [&by_file, &by_list, &by_name] {
        assert_eq!(scene.sewing.as_ref().unwrap().pairs, [[1, 4], [2, 7], [8, 9]]);
        assert!(scene.mesh.positions[9].distance(loomtree::math::Vec3::new(1.0, 0.3, 0.0)) < 1e-6);
        assert_eq!(counts(&Sewn::of(scene).unwrap().0.mesh).4, [6]);
    }
    let wrong = "[[seam]]\na = { vertices = [1, 2] }\nb = { vertices = [7, 4] }\n";
    assert!(fault(&format!("{cloth}{wrong}")).contains("run the wrong way"), "{}", fault(&format!("{cloth}{wrong}")));
    let inside = fault(&format!("{cloth}[[seam]]\na = {{ vertices = [0, 5] }}\nb = {{ vertices = [7, 4] }}\n"));
    assert!(inside.contains("vertices 0 and 5 of `two` do not lie on one border"), "{inside}");
}

#[test]
fn weld_m_joins_what_lies_at_one_place() {
    let folder = tempfile::tempdir().unwrap();
    let obj = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 1 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nf 1 2 3 4\nf 5 6 7 8\n";
    let mesh = folder.path().join("doubled.obj");
    fs::write(&mesh, obj).unwrap();
    let cloth = format!("[[cloth]]\nmesh = \"{}\"\n", mesh.display());
    let refused = fault(&cloth);
    assert!(refused.contains("`weld_m = 1e-6` in its [[cloth]] joins them"), "{refused}");
    let scene = scene_of(&format!("{cloth}weld_m = 1e-6\n"), None).unwrap();
    assert_eq!((scene.mesh.positions.len(), counts(&scene.mesh).4), (6, vec![6]));
    let _ = load;
}
