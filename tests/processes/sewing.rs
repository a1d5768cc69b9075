//! A run that sews, welds, refines and goes on: the same bits on any number of workers and across resumes, frames of
//! both meshes, and what the report says.

use std::fs;
use std::path::Path;

use loomtree::math::Vec3;
use loomtree::mesh::{Group, GroupKind, crossings};
use loomtree::model::Sewn;
use loomtree::output::Checkpoint;
use loomtree::scene::{Obstacles, Overrides, Scene, load};
use support::numpy::test_data;
use support::process::Place;

/// Two panels that face each other, sewn to a bag that hangs from a corner.
const BAG: &str = r#"
name = "bag"
resolution = 128
[simulation]
step_s = 0.005
steps_per_frame = 4
frames = 14
thickness_m = 0.001
[sewing]
close_s = 0.15
refine = 1
[[cloth]]
name = "front"
sheet = { size_m = [0.2, 0.16] }
origin_m = [0, 0, 0.02]
[[cloth]]
name = "back"
sheet = { size_m = [0.2, 0.16] }
rotate_deg = [180, 0, 1, 0]
origin_m = [0.2, 0, -0.02]
[[seam]]
name = "one side"
a = { cloth = "front", edge = "left" }
b = { cloth = "back", edge = "right" }
[[seam]]
name = "other side"
a = { cloth = "front", edge = "right" }
b = { cloth = "back", edge = "left" }
[[seam]]
name = "top"
a = { cloth = "front", edge = "top" }
b = { cloth = "back", edge = "top" }
[[pin]]
cloth = "front"
corners = ["top-left"]
"#;

#[test]
fn a_bag_is_sewn_welded_refined_and_hangs_with_the_same_bits_everywhere() {
    let place = Place::new();
    place.write("bag.toml", BAG);
    let run = |workers: u32, out: &str, more: &str| {
        place.run(&format!("run bag.toml --executor cpu --workers {workers} --out {out} {more}")).expect(0)
    };
    let ended = run(1, "one", "--format ply,pc2");
    assert!(ended.stderr.contains("the seams are closed after step"), "{}", ended.story);
    let report = place.report("one");
    let stage = report["stages"][0].clone();
    let (first_frame, step) = (stage["first_frame"].as_u64().unwrap(), stage["step"].as_u64().unwrap());
    assert_eq!((step, stage["triangles"].as_u64().unwrap()), (4 * (first_frame - 1), 4 * 128));
    assert!((4..=12).contains(&first_frame), "{first_frame}");
    for frame in report["frames"].as_array().unwrap() {
        let is_open = frame["seams"]["widest_m"].as_f64();
        assert_eq!(is_open.is_some(), frame["frame"].as_u64().unwrap() < first_frame, "{frame}");
    }
    let widest = |frame: u64| report["frames"][frame as usize]["seams"]["widest_m"].as_f64().unwrap();
    assert!(widest(first_frame - 1) <= 0.001 && widest(1) < widest(0) && widest(0) > 0.039);
    // Frames before and after have their own meshes.
    let triangles = |frame: u64| {
        let bytes = fs::read(place.path(&format!("one/frames/frame_{frame:06}.ply"))).unwrap();
        let head = String::from_utf8_lossy(&bytes[..400]).into_owned();
        let line = head.lines().find_map(|line| line.strip_prefix("element face ")).unwrap().to_owned();
        line.parse::<u64>().unwrap()
    };
    assert_eq!([triangles(first_frame - 1), triangles(first_frame), triangles(14)], [128, 512, 512]);
    assert_eq!(loomtree::output::pc2::start(&place.path("one/cloth_2.pc2")).unwrap() as u64, first_frame);
    assert_eq!(loomtree::output::pc2::samples(&place.path("one/cloth_2.pc2")).unwrap() as u64, 15 - first_frame);
    assert_eq!(loomtree::output::pc2::samples(&place.path("one/cloth.pc2")).unwrap() as u64, first_frame);
    let hashes = place.hashes("one");
    for workers in [2, 3] {
        run(workers, &format!("by{workers}"), "");
        assert_eq!(place.hashes(&format!("by{workers}")), hashes, "{workers} workers");
    }
    // Stopped before the seams close, at the frame where they do, and after it.
    for (i, frames) in [first_frame - 2, first_frame - 1, first_frame + 1].into_iter().enumerate() {
        let out = format!("stopped{i}");
        run(2, &out, &format!("--frames {frames} --format pc2"));
        place.run(&format!("run --resume --out {out} --workers {} --frames 14", 1 + i)).expect(0);
        assert_eq!(place.hashes(&out), hashes, "after frame {frames}");
        let again = place.report(&out);
        assert_eq!(again["stages"], report["stages"], "after frame {frames}");
        assert_eq!(
            loomtree::output::pc2::samples(&place.path(&format!("{out}/cloth_2.pc2"))).unwrap() as u64,
            15 - first_frame
        );
    }
    // Other commands read what such a run writes.
    place.run("compare one by2").expect(0).says(&[]);
    place.run("render one --size 64x64").expect(0);
    place.run("render stopped2 --size 64x64").expect(0);
}

#[test]
fn seams_that_do_not_close_are_said_and_a_split_shot_has_none() {
    let place = Place::new();
    place.write("bag.toml", BAG);
    let ended = place.run("run bag.toml --executor cpu --frames 2 --out out").expect(0);
    assert!(ended.stderr.contains("the seams are not sewn: "), "{}", ended.story);
    // One line says of every seam how many places are open, by how far, and why.
    let line = ended.stderr.lines().find(|line| line.starts_with("the seams are not sewn")).unwrap();
    for seam in ["one side", "other side", "top"] {
        assert!(line.contains(&format!("`{seam}` is open at ")) && line.contains("still closing"), "{line}");
    }
    let open = place.report("out")["open_seams"].clone();
    assert_eq!(open.as_array().map(Vec::len), Some(3), "{open}");
    assert_eq!((open[0]["open"].clone(), &open[0]["why"]), (open[0]["places"].clone(), &"closing".into()), "{open}");
    let said = place.run("run bag.toml --executor cpu --frames 1 --out said --json").expect(0);
    let said: serde_json::Value = serde_json::from_str(&said.stdout).unwrap();
    assert_eq!(said["open_seams"].as_array().map(Vec::len), Some(3), "{said}");
    let ended = place.run("run bag.toml --executor cpu --segments 2 --out split").expect(2);
    assert!(ended.error().contains("cloth that is sewn has no coarser level"), "{}", ended.story);
}

/// Checks that nothing crosses in a state of a scene.
pub(crate) fn assert_free(scene: &Scene, positions: &[Vec3], time_s: f64, what: &str) {
    let obstacles = Obstacles::new(&scene.obstacles);
    let mut values = Vec::new();
    obstacles.positions_at(time_s, &mut values);
    let (mut all, mut triangles) = (positions.to_vec(), scene.mesh.triangles.clone());
    let (first, cloth) = (all.len() as u32, triangles.len());
    all.extend_from_slice(bytemuck::cast_slice(&values));
    triangles.extend(obstacles.triangles().iter().map(|corners| corners.map(|v| v + first)));
    let groups = [
        Group { triangles: 0..cloth, kind: GroupKind::Cloth },
        Group { triangles: cloth..triangles.len(), kind: GroupKind::Obstacle },
    ];
    assert_eq!(crossings(&all, &triangles, &groups), [] as [[u32; 2]; 0], "{what}");
}

/// Checks all states that a run has kept, one after every step; says how many are of panels and of sewn cloth.
fn assert_free_in_all_states(scene: &Path, states: &Path) -> [usize; 2] {
    let panels = load(scene, &Overrides { resolution: None, frames: None }).unwrap();
    let (sewn, _) = Sewn::of(&panels).unwrap();
    let mut counts = [0; 2];
    let start = panels.mesh.positions.clone();
    assert_free(&panels, &start, 0.0, "the start");
    for entry in fs::read_dir(states).unwrap() {
        let path = entry.unwrap().path();
        let kept = Checkpoint::from_bytes(&fs::read(&path).unwrap()).unwrap();
        let stage = usize::from(kept.state.positions.len() != panels.mesh.positions.len());
        let scene = [&panels, &sewn][stage];
        assert_free(scene, &kept.state.positions, kept.time_s, &path.display().to_string());
        counts[stage] += 1;
    }
    counts
}

/// Panels that meet in a corner under the arm, in other people's files.
#[test]
fn shirts_are_sewn_around_bodies() {
    let Some(garments) = test_data("garments") else { return };
    let at = |file: &str| garments.join(file).display().to_string();
    let panels = |name: &str| {
        let [mesh, seams] = ["obj", "seams.json"].map(|end| at(&format!("panels/{name}.{end}")));
        let body = at("human/human_rest.obj");
        format!("mesh = \"{mesh}\"\nseams = \"{seams}\"\nmaterial = \"uv\"\n[[obstacle]]\nmesh = \"{body}\"")
    };
    let pattern = at("garmentcode/shirt_mean_specification.json");
    let generated = format!("mesh = \"{pattern}\"\norigin_m = [0, 0.1, 0]\n[[obstacle]]\nbody = \"person\"");
    for (name, resolution, cloth) in [
        ("shirt_1k", "", panels("shirt_1k")),
        ("shirt_5k_counts_differ", "", panels("shirt_5k_counts_differ")),
        ("pattern", "resolution = 1_200\n", generated),
    ] {
        let place = Place::new();
        let settings = "frames = 26\nframe_s = 0.04\nstep_s = 0.005";
        let text = format!("{resolution}[simulation]\n{settings}\n[sewing]\nclose_s = 0.6\n[[cloth]]\n{cloth}\n");
        place.write("shirt.toml", &text);
        let looks = name == "shirt_1k";
        let kept = if looks { "--keep-states 1" } else { "" };
        let ended = place.run(&format!("run shirt.toml --executor cpu --out out {kept}")).expect(0);
        assert!(ended.stderr.contains("the seams are closed after step"), "{name}: {}", ended.story);
        if looks {
            let [panels, sewn] = assert_free_in_all_states(&place.path("shirt.toml"), &place.path("out/states"));
            assert!(panels > 100 && sewn > 20 && panels + sewn == 209, "{panels} {sewn}");
        }
        let report = place.report("out");
        let stage = &report["stages"][0];
        assert!(report["open_seams"].is_null(), "{name}");
        let scene = load(&place.path("shirt.toml"), &Overrides { resolution: None, frames: None }).unwrap();
        let (sewn, _) = Sewn::of(&scene).unwrap();
        let counts = [sewn.mesh.positions.len(), sewn.mesh.triangles.len()];
        let said = ["vertices", "triangles"].map(|what| stage[what].as_u64().unwrap() as usize);
        assert_eq!(said, counts, "{name}");
        if let Some(straightened) = stage.get("straightened") {
            assert!(straightened["vertices"].as_u64() > Some(0) && straightened["farthest_m"].as_f64() < Some(0.03));
        }
        if looks {
            let truth = fs::read_to_string(garments.join("panels/shirt_1k.seams.json")).unwrap();
            let truth: serde_json::Value = serde_json::from_str(&truth).unwrap();
            assert_eq!(stage["vertices"], truth["truth"]["after_sewing"]["vertices"]);
        }
    }
}
