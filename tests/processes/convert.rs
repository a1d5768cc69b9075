//! `loomtree convert`: every format read back, with the positions of the frames of the run.

use loomtree::output::{FrameSource, RunDirectory, ply};
use loomtree::scene::{Obstacles, Overrides, parse};
use support::process::{Place, Signal, signal};

const SCENE: &str = r#"
[simulation]
steps_per_frame = 5
frames = 3
[[cloth]]
name = "left sleeve"
sheet = { size_m = [0.4, 0.4], triangles = 64 }
plane = "xz"
origin_m = [-0.5, 0.3, 0.2]
[[cloth]]
name = "right"
sheet = { size_m = [0.4, 0.4], triangles = 64 }
plane = "xz"
origin_m = [0.1, 0.3, 0.2]
[[obstacle]]
name = "ball"
sphere = { center_m = [0, 0, 0], radius_m = 0.25, triangles = 80 }
motion = [{ time_s = 0 }, { time_s = 0.06, translate_m = [0, 0.02, 0] }]
"#;

fn place() -> Place {
    let place = Place::new();
    place.write("scene.toml", SCENE);
    place.run("run scene.toml --executor cpu --workers 2 --out run").expect(0);
    place
}

/// Positions of the two cloths and of the obstacle in a frame.
fn frame(place: &Place, frame: u32) -> [Vec<f32>; 3] {
    let source = FrameSource::open(&RunDirectory::open(&place.path("run")).unwrap()).unwrap();
    let cloth = source.read(frame).unwrap().positions;
    let half = cloth.len() / 2;
    let values = |points: &[loomtree::math::Vec3]| points.iter().flat_map(|p| p.to_array()).collect();
    [values(&cloth[..half]), values(&cloth[half..]), values(&source.read_obstacle(frame).unwrap().unwrap().positions)]
}

/// Positions of an obstacle of a scene at the time of a frame.
fn obstacle_at(place: &Place, fields: &str, time_s: f64) -> Vec<f32> {
    let text = format!(
        "[simulation]\ncollisions = false\n[[cloth]]\nsheet = {{ size_m = [1, 1], triangles = 18 }}\n\
         [[obstacle]]\n{fields}\n"
    );
    let scene = parse(&text, &place.path("x.toml"), &Overrides::default()).unwrap();
    let mut out = Vec::new();
    Obstacles::new(&scene.obstacles).positions_at(time_s, &mut out);
    out
}

#[test]
fn caches_and_meshes_read_back_with_the_positions_of_the_frames() {
    let place = place();
    let ended = place.run("convert run --to mdd,pc2,ply,glb --out exported").expect(0);
    for name in ["left_sleeve.obj", "left_sleeve.mdd", "right.pc2", "ball.mdd", "ball_%06d.ply", "run.glb"] {
        assert!(ended.stdout.contains(&format!("exported/{name}\n")), "{name}: {}", ended.story);
    }
    for k in 0..=3 {
        let frames = frame(&place, k);
        let time_s = f64::from(k) * 0.02;
        for (name, expected) in ["left_sleeve", "right", "ball"].iter().zip(&frames) {
            let mesh = ply::read(&std::fs::read(place.path(&format!("exported/{name}_{k:06}.ply"))).unwrap()).unwrap();
            let values: Vec<f32> = mesh.positions.iter().flat_map(|p| p.to_array()).collect();
            assert_eq!(values, *expected, "{name}, frame {k}");
            let rest = format!("rest = \"exported/{name}.obj\"");
            let pc2 = format!("pc2 = {{ {rest}, cache = \"exported/{name}.pc2\" }}\nframes_per_s = 50");
            assert_eq!(obstacle_at(&place, &pc2, time_s), *expected, "{name}, frame {k}");
            // The times of MDD are rounded to f32.
            let mdd = format!("mdd = {{ {rest}, cache = \"exported/{name}.mdd\" }}");
            let got = obstacle_at(&place, &mdd, f64::from(time_s as f32));
            assert_eq!(got, *expected, "{name}, frame {k}");
        }
        let got = obstacle_at(&place, "gltf = \"exported/run.glb\"\nclip = \"run\"", f64::from(time_s as f32));
        let expected = frames.concat();
        assert_eq!(got.len(), expected.len());
        assert!(got.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6), "glb, frame {k}");
    }
}

/// The three files hold all meshes, in the order of the scene, with the bits of the frames at their times.
#[test]
fn stages_and_archives_read_back_with_the_bits_of_the_frames() {
    let place = place();
    place.run("convert run --to usd,usdc,abc --out exported").expect(0);
    for k in 0..=3 {
        let frames = frame(&place, k);
        let time_s = f64::from(k) / 50.0;
        for fields in ["usd = \"exported/run.usda\"", "usd = \"exported/run.usdc\"", "abc = \"exported/run.abc\""] {
            assert_eq!(obstacle_at(&place, fields, time_s), frames.concat(), "{fields}, frame {k}");
            let node = format!("{fields}\nnode = \"right\"");
            assert_eq!(obstacle_at(&place, &node, time_s), frames[1], "{node}, frame {k}");
        }
    }
    let triangles = |fields: &str| {
        let text = format!("{SCENE}\n[[obstacle]]\norigin_m = [0, 9, 0]\n{fields}\n");
        let scene = parse(&text, &place.path("x.toml"), &Overrides::default()).unwrap();
        scene.obstacles[1].triangles.clone()
    };
    let expected = triangles("usd = \"exported/run.usda\"");
    assert_eq!(triangles("usd = \"exported/run.usdc\""), expected);
    assert_eq!(triangles("abc = \"exported/run.abc\""), expected, "clockwise in the file");
    // Of a run whose z points up a stage says so, and an archive is turned; both are read with y up.
    place.write("up.toml", &SCENE.replace("[simulation]\n", "[simulation]\ngravity_m_s2 = [0, 0, -9.81]\n"));
    place.run("run up.toml --executor cpu --out up").expect(0);
    place.run("convert up --to usd,usdc,abc --out turned").expect(0);
    let [text, binary, archive] =
        ["usd = \"turned/run.usda\"", "usd = \"turned/run.usdc\"", "abc = \"turned/run.abc\""]
            .map(|fields| obstacle_at(&place, fields, 0.06));
    assert_eq!(text, binary);
    assert!(text.iter().zip(&archive).all(|(a, b)| (a - b).abs() < 1e-6));
    let plain = obstacle_at(&place, "usd = \"turned/run.usda\"\nup = \"y\"", 0.06);
    let turned = plain.as_chunks::<3>().0.iter().flat_map(|&[x, y, z]| [x, z, -y]);
    assert!(turned.eq(archive), "exactly");
}

#[test]
fn a_stage_has_a_mesh_per_piece_and_obstacle_with_all_frames() {
    let place = place();
    place.run("convert run --to usd").expect(0);
    let text = std::fs::read_to_string(place.path("run/export/run.usda")).unwrap();
    for line in [
        "#usda 1.0\n",
        "    endTimeCode = 3\n",
        "    timeCodesPerSecond = 50\n",
        "    metersPerUnit = 1\n",
        "    upAxis = \"Y\"\n",
        "    def Mesh \"left_sleeve\"\n",
        "    def Mesh \"right\"\n",
        "    def Mesh \"ball\"\n",
    ] {
        assert!(text.contains(line), "{line}");
    }
    // Cloth has its material coordinates, one per corner.
    assert_eq!(text.matches("texCoord2f[] primvars:st").count(), 2);
    let meshes: Vec<&str> = text.split("def Mesh").skip(1).collect();
    for k in 0..=3u32 {
        for (mesh, expected) in meshes.iter().zip(frame(&place, k)) {
            let (_, points) = mesh.split_once("points.timeSamples").unwrap();
            let line = points.lines().find(|line| line.trim_start().starts_with(&format!("{k}: "))).unwrap();
            let (_, numbers) = line.split_once(": ").unwrap();
            let number = |word: &str| word.trim_matches(|c: char| !c.is_ascii_digit() && c != '-').parse::<f32>().ok();
            let got: Vec<f32> = numbers.split(',').filter_map(number).collect();
            assert_eq!(got, expected, "frame {k}");
        }
    }
}

/// The bytes of an array of a grid.
fn array_of<'a>(bytes: &'a [u8], name: &str) -> &'a [u8] {
    let text = String::from_utf8_lossy(bytes);
    let start = bytes.windows(2).position(|two| two == b"\n_").unwrap() + 2;
    let (_, rest) = text.split_once(&format!("Name=\"{name}\" format=\"appended\" offset=\"")).unwrap();
    let offset: usize = rest.split('"').next().unwrap().parse().unwrap();
    let at = start + offset;
    let length = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap()) as usize;
    &bytes[at + 8..at + 8 + length]
}

fn floats_of(bytes: &[u8], name: &str) -> Vec<f32> {
    array_of(bytes, name).as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

#[test]
fn contact_forces_of_a_cloth_at_rest_carry_its_weight() {
    let place = Place::new();
    place.write(
        "scene.toml",
        r#"
[simulation]
step_s = 0.004
steps_per_frame = 50
frames = 3
[[cloth]]
sheet = { size_m = [0.2, 0.2], triangles = 256 }
plane = "xz"
origin_m = [-0.1, 0.00199, 0.1]
[[obstacle]]
plane = { point_m = [0, 0, 0], normal = [0, 1, 0], size_m = [1, 1], triangles = 18 }
"#,
    );
    place.run("run scene.toml --executor cpu --out run").expect(0);
    place.run("convert run --to vtu --out grids").expect(0);
    let forces = floats_of(&std::fs::read(place.path("grids/run_000003.vtu")).unwrap(), "contact_force");
    let forces = forces.as_chunks::<3>().0;
    let sum = |axis: usize| forces.iter().map(|force| f64::from(force[axis])).sum::<f64>();
    // Cotton of 150 g/m^2.
    let weight_n = 0.2 * 0.2 * 0.15 * 9.81;
    assert!((sum(1) / weight_n - 1.0).abs() < 0.02, "{} N for a weight of {weight_n} N", sum(1));
    assert!(sum(0).abs() < 0.01 * weight_n && sum(2).abs() < 0.01 * weight_n);
    // Obstacles have none.
    assert!(forces.len() > 137 && forces[forces.len() - 9..].iter().all(|force| *force == [0.0; 3]));
}

#[test]
fn grids_hold_points_triangles_and_stretch() {
    let place = place();
    place.run("convert run --to vtu --out grids").expect(0);
    let list = std::fs::read_to_string(place.path("grids/run.pvd")).unwrap();
    assert_eq!(list.matches("<DataSet ").count(), 4);
    assert!(list.contains("timestep=\"0.06\" part=\"0\" file=\"run_000003.vtu\""), "{list}");
    let bytes = std::fs::read(place.path("grids/run_000003.vtu")).unwrap();
    let array = |name: &str| array_of(&bytes, name);
    let floats = |name: &str| floats_of(&bytes, name);
    assert_eq!(floats("points"), frame(&place, 3).concat());
    let cells = array("types").len();
    assert!(array("types").iter().all(|&kind| kind == 5) && array("connectivity").len() == 12 * cells);
    assert_eq!(array("obstacle").iter().filter(|&&is| is == 1).count(), cells - 128);
    let stretch = floats("stretch_max");
    assert!(stretch.len() == cells && stretch.iter().all(|s| (0.9..1.2).contains(s)));
    // Of vertices: two workers, a ball that owns nothing and that some of the cloth may touch.
    let [first, second, ball] = frame(&place, 3).map(|values| values.len() / 3);
    let (ranks, contact, strain) = (floats("rank"), floats("contact"), floats("strain"));
    let (cloth, obstacle) = ranks.split_at(first + second);
    assert!(cloth.contains(&0.0) && cloth.contains(&1.0) && cloth.iter().all(|rank| [0.0, 1.0].contains(rank)));
    assert!(obstacle.len() == ball && obstacle.iter().all(|rank| *rank == -1.0));
    assert!(contact[..first + second].iter().all(|c| (0.0..=1.0).contains(c)) && contact.len() == ranks.len());
    assert!(strain.len() == ranks.len() && strain[..first + second].iter().all(|s| s.abs() < 0.2));
}

/// `run --format` with caches: the files of `convert`, at the end of the run, also of one that is stopped or goes on.
#[test]
fn a_run_makes_the_caches_that_it_is_asked_for() {
    let place = Place::new();
    place.write("scene.toml", SCENE);
    let ended = place.run("run scene.toml --executor cpu --frames 1 --format usdc,abc,mdd --out run").expect(0);
    assert!(ended.stderr.contains("written: run/export/run.usdc"), "{}", ended.story);
    let names = ["run.usdc", "run.abc", "right.mdd", "ball.obj"];
    let bytes = |folder: &str| names.map(|name| std::fs::read(place.path(&format!("{folder}/{name}"))).unwrap());
    let first = bytes("run/export");
    place.run("run --resume --frames 3 --executor cpu --out run").expect(0);
    place.run("convert run --to usdc,abc,mdd --out again").expect(0);
    assert!(bytes("run/export") == bytes("again") && bytes("again") != first, "made anew, with all frames");
    for k in 0..=3 {
        let got = obstacle_at(&place, "abc = \"run/export/run.abc\"", f64::from(k) / 50.0);
        assert_eq!(got, frame(&place, k).concat(), "frame {k}");
    }
    // Stopped in the middle.
    let mut running = place.start("run scene.toml --executor cpu --frames 100000 --format usdc --out long");
    running.wait_for_frame("long", 2);
    signal(running.pid(), Signal::TERM);
    running.wait().expect(143);
    let source = FrameSource::open(&RunDirectory::open(&place.path("long")).unwrap()).unwrap();
    let last = *source.numbers().last().unwrap();
    let expected = source.read(last).unwrap().positions;
    let got = obstacle_at(&place, "usd = \"long/export/run.usdc\"", f64::from(last) / 50.0);
    assert_eq!(
        got[..3 * expected.len()],
        expected.iter().flat_map(|p| p.to_array()).collect::<Vec<f32>>()[..],
        "all frames until the stop"
    );
}

#[test]
fn what_cannot_be_converted_is_named() {
    let place = place();
    for (words, code, expected) in [
        ("convert run --to bmp", 2, "usd, usdc, abc, mdd, pc2, vtu, glb and ply"),
        ("convert run", 2, "--to"),
        ("convert nowhere --to usd", 2, "nowhere"),
    ] {
        let ended = place.run(words).expect(code);
        assert!(ended.stderr.contains(expected), "{words}: {}", ended.story);
    }
    // Without the scene's files the cloth is one mesh.
    std::fs::write(place.path("run/run_scene.toml"), "nonsense").unwrap();
    let ended = place.run("convert run --to ply --out plain").expect(0);
    assert!(ended.stderr.contains("all cloth is one mesh"), "{}", ended.story);
    assert!(place.path("plain/cloth_000003.ply").exists() && place.path("plain/obstacles_000003.ply").exists());
}
