//! Files as other programs write them, and what users ask of them: every one is read as it is meant, or named in a
//! sentence that says what would be right.

use std::path::{Path, PathBuf};

use loomtree::cli::check::{CheckArgs, check};
use loomtree::linear_system::read_system;
use loomtree::math::Vec3;
use loomtree::mesh::{MaterialSource, MeshOptions, TriangleMesh, parse_obj, read_obstacle};
use loomtree::output::{Existing, FrameFormat, FrameWriter, RunDirectory};
use loomtree::scene::{Overrides, Scene, load, load_untangled};

/// A folder of files for one test.
struct Folder(tempfile::TempDir);

impl Folder {
    fn new(files: &[(&str, &str)]) -> Folder {
        let folder = Folder(tempfile::tempdir().unwrap());
        files.iter().for_each(|(name, text)| folder.write(name, text.as_bytes()));
        folder
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn scene(&self, text: &str) -> Result<Scene, String> {
        self.write("s.toml", text.as_bytes());
        load(&self.path("s.toml"), &Overrides::default()).map_err(|error| error.to_string())
    }

    fn checked(&self, name: &str, change: impl FnOnce(&mut CheckArgs)) -> Result<String, String> {
        let mut args = CheckArgs {
            file: self.path(name),
            resolution: None,
            write_crossings: None,
            untangle: None,
            obstacle: false,
        };
        change(&mut args);
        let mut out = Vec::new();
        match check(&args, &mut out) {
            Ok(()) => Ok(String::from_utf8(out).unwrap()),
            Err(error) => {
                assert_eq!((error.exit_code, error.message.lines().count()), (2, 1), "{}", error.message);
                Err(error.message)
            }
        }
    }
}

/// `cells` x `cells` quads of a square sheet as OBJ; texture coordinates are `texture` times the place.
fn sheet_obj(size_m: f64, cells: usize, texture: Option<f64>) -> String {
    let mut text = String::new();
    let points: Vec<[f64; 2]> = (0..=cells)
        .flat_map(|row| (0..=cells).map(move |column| [column, row].map(|i| size_m * i as f64 / cells as f64)))
        .collect();
    points.iter().for_each(|[x, y]| text += &format!("v {x} {y} 0\n"));
    texture.iter().for_each(|t| points.iter().for_each(|[x, y]| text += &format!("vt {} {}\n", t * x, t * y)));
    for (column, row) in (0..cells).flat_map(|row| (0..cells).map(move |column| (column, row))) {
        let first = row * (cells + 1) + column + 1;
        let corner = |v: usize| if texture.is_some() { format!("{v}/{v}") } else { v.to_string() };
        let corners = [first, first + 1, first + cells + 2, first + cells + 1].map(corner);
        text += &format!("f {}\n", corners.join(" "));
    }
    text
}

fn rest_area(mesh: &TriangleMesh) -> f64 {
    mesh.material_uv.iter().map(|uv| f64::from((uv[1] - uv[0]).perp_dot(uv[2] - uv[0])) / 2.0).sum()
}

#[test]
fn texture_coordinates_of_a_picture_are_not_the_rest_shape() {
    let folder = Folder::new(&[("p.obj", &sheet_obj(2.0, 4, Some(0.5))), ("m.obj", &sheet_obj(2.0, 4, Some(1.1)))]);
    let scene = folder.scene("[[cloth]]\nmesh = \"p.obj\"").unwrap();
    assert!((rest_area(&scene.mesh) - 4.0).abs() < 1e-5);
    let [warning] = &scene.warnings[..] else { panic!("{:?}", scene.warnings) };
    assert!(
        warning.contains("cover 1 m^2 where the mesh has 4 m^2") && warning.contains("material = \"uv\""),
        "{warning}"
    );

    let scene = folder.scene("[[cloth]]\nmesh = \"p.obj\"\nmaterial = \"uv\"\nscale = 3").unwrap();
    assert!((rest_area(&scene.mesh) - 9.0).abs() < 1e-4);
    let warning = &scene.warnings[0];
    assert!(
        warning.contains("cover 9 m^2 where the mesh has 36 m^2") && warning.contains("material = \"shape\""),
        "{warning}"
    );

    let scene = folder.scene("[[cloth]]\nmesh = \"m.obj\"").unwrap();
    assert!((rest_area(&scene.mesh) - 4.84).abs() < 1e-4 && scene.warnings.is_empty(), "a pattern within 20 %");
    let summary = folder.checked("p.obj", |_| {}).unwrap();
    assert!(
        summary.contains("rest area   4.0000 m^2 (4.0000 m^2 in space)") && summary.contains("  warning "),
        "{summary}"
    );
}

#[test]
fn a_mesh_in_another_unit_is_named_with_the_scale_that_helps() {
    let folder = Folder::new(&[
        ("cm.obj", &sheet_obj(180.0, 3, None)),
        ("mm.obj", &sheet_obj(1800.0, 3, None)),
        ("m.obj", &sheet_obj(1.8, 3, None)),
        ("tiny.obj", &sheet_obj(0.0018, 3, None)),
    ]);
    let warnings =
        |file: &str| folder.scene(&format!("[[cloth]]\nname = \"cover\"\nmesh = \"{file}\"")).unwrap().warnings;
    assert_eq!(
        warnings("cm.obj"),
        [
            "`cover` is 180.0000 m large, 90000 times thickness_m = 0.002: if its file is in centimetres, `scale = 0.01` makes metres of them"
        ]
    );
    assert!(warnings("mm.obj")[0].contains("scale = 0.001") && warnings("tiny.obj")[0].contains("`scale` enlarges it"));
    assert!(warnings("m.obj").is_empty());
    assert!(folder.scene("[[cloth]]\nmesh = \"cm.obj\"\nscale = 0.01").unwrap().warnings.is_empty());
}

#[test]
fn the_notch_of_a_polygon_stays_open() {
    let points = [[-5, 5], [5, 5], [5, 2], [-2, 2], [-2, -2], [5, -2], [5, -5], [-5, -5]];
    let vertices: String = points.iter().map(|[x, z]| format!("v {x} 0 {z}\n")).collect();
    for face in ["f 1 2 3 4 5 6 7 8", "f 8 7 6 5 4 3 2 1", "f 4 5 6 7 8 1 2 3"] {
        let surface = parse_obj(format!("{vertices}{face}").as_bytes()).unwrap();
        let area: f64 = surface
            .triangles
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|v| surface.positions[v as usize].as_dvec3());
                (b - a).cross(c - a).length() / 2.0
            })
            .sum();
        // 10 x 10 without the notch of 7 x 4; a fan about corner 1 covers 100 and more.
        assert_eq!((area, surface.triangles.len()), (72.0, 6), "{face}");
    }
    let bow = parse_obj("v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\n# here\nf 1 2 3 4".as_bytes()).unwrap_err();
    assert!(bow.line == Some(6) && bow.what.contains("crosses itself"), "{bow:?}");
}

#[test]
fn a_missing_frame_is_named_and_the_first_number_is_free() {
    let ball = "v 0 0 0\nv 1 0 0\nv 0 0 1\nf 1 2 3\n";
    let names: Vec<String> = [1001, 1002, 1003, 1005].iter().map(|n| format!("b.{n}.obj")).collect();
    let folder = Folder::new(&names.iter().map(|name| (&name[..], ball)).collect::<Vec<_>>());
    let text = "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 8 }\norigin_m = [0, 5, 0]\n[[obstacle]]\nsequence = \"b.%04d.obj\"\nframes_per_s = 25\n";
    assert!(
        folder
            .scene(text)
            .unwrap_err()
            .ends_with("number 1004 is missing: there are `b.1003.obj` and `b.1005.obj`, but no `b.1004.obj`")
    );
    std::fs::remove_file(folder.path("b.1005.obj")).unwrap();
    let scene = folder.scene(text).unwrap();
    assert!(format!("{:?}", scene.obstacles[0].movement).matches("Vec3").count() == 6, "two frames after the first");
}

#[test]
fn a_needle_of_a_collider_is_left_out() {
    let ball = "v 0 0 0\nv 1 0 0\nv 0 0 1\nv 0.5 0 0\nf 1 2 3\nf 1 4 2\nf 3 2 4\n";
    let folder = Folder::new(&[
        ("b.obj", ball),
        ("only.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),
        ("q_0.obj", ball),
        ("q_1.obj", &ball.replace("v 0.5 0 0", "v 0.5 0 0.5")),
    ]);
    let (surface, line) = read_obstacle(&folder.path("b.obj"), 1.0).unwrap();
    assert_eq!(surface.triangles, [[0, 1, 2], [2, 1, 3]]);
    assert!(line.unwrap().ends_with("b.obj: triangle 2 has no area and is left out"));
    assert!(
        read_obstacle(&folder.path("only.obj"), 1.0)
            .unwrap_err()
            .to_string()
            .contains("triangle 1 has no area in space")
    );
    let cloth = "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 8 }\norigin_m = [0, 5, 0]\n[[obstacle]]\n";
    let scene = folder.scene(&format!("{cloth}mesh = \"b.obj\"")).unwrap();
    assert!(scene.obstacles[0].triangles.len() == 2 && scene.left_out[0].contains("triangle 2 has no area"));
    // In the second frame the third triangle is a line as well, and then all are.
    let sequence = format!("{cloth}sequence = \"q_%d.obj\"\nframes_per_s = 1");
    assert_eq!(folder.scene(&sequence).unwrap().obstacles[0].triangles, [[0, 1, 2]]);
    folder.write("q_2.obj", ball.replace("v 0 0 1", "v 0 0 0").as_bytes());
    assert!(folder.scene(&sequence).unwrap_err().contains("no triangle that has an area in every frame"));
    let summary = folder.checked("b.obj", |args| args.obstacle = true).unwrap();
    assert!(summary.starts_with("obstacle ") && summary.contains("left out"), "{summary}");
    assert!(
        folder.checked("b.obj", |_| {}).unwrap_err().ends_with("; as an obstacle it can be used (`check --obstacle`)")
    );
}

/// Two halves of a sheet that meet along x = 1 with their own vertices there.
const SPLIT: &str =
    "o left\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\no right\nv 1 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nf 5 6 7 8\n";

#[test]
fn a_split_seam_is_named_and_weld_m_joins_it() {
    let folder = Folder::new(&[("s.obj", SPLIT)]);
    let refused = folder.scene("[[cloth]]\nname = \"cover\"\nmesh = \"s.obj\"").unwrap_err();
    assert!(
        refused.contains("`cover` has 2 vertices at the place of others") && refused.contains("weld_m = 1e-6"),
        "{refused}"
    );
    let untangled = load_untangled(&folder.path("s.toml"), &Overrides::default());
    assert!(untangled.is_err_and(|error| error.to_string() == refused), "untangling would open the seam");
    assert!(folder.checked("s.obj", |_| {}).unwrap_err().contains("2 vertices lie at the place of others"));

    let scene = folder.scene("[[cloth]]\nmesh = \"s.obj\"\nweld_m = 1e-6\n[[pin]]\nvertices = [4, 7, 5]").unwrap();
    assert_eq!((scene.mesh.positions.len(), scene.mesh.triangles.len()), (6, 4));
    assert!(scene.warnings[0].contains("2 vertices are joined with others"), "{:?}", scene.warnings);
    let held: Vec<Vec3> = scene.pins.iter().map(|pin| scene.mesh.positions[pin.vertex as usize]).collect();
    assert_eq!(held, [Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::new(2.0, 0.0, 0.0)], "by their numbers in the file");
    assert!((rest_area(&scene.mesh) - 2.0).abs() < 1e-6);
    let collapsed = folder.scene("[[cloth]]\nmesh = \"s.obj\"\nweld_m = 1.2").unwrap_err();
    assert!(collapsed.contains("choose a smaller weld_m"), "{collapsed}");
    // The distance is in metres of the scene.
    assert!(folder.scene("[[cloth]]\nmesh = \"s.obj\"\nscale = 0.01\nweld_m = 0.012").is_err());
    assert_eq!(folder.scene("[[cloth]]\nmesh = \"s.obj\"\nweld_m = 0").unwrap().mesh.positions.len(), 6);
}

#[test]
fn triangles_wound_against_their_neighbors_are_turned_over_and_one_sided_surfaces_named() {
    let text = sheet_obj(1.0, 3, Some(1.0)).replacen("f 1/1 2/2 6/6 5/5", "f 5/5 6/6 2/2 1/1", 1);
    let folder = Folder::new(&[("t.obj", &text)]);
    let scene = folder.scene("[[cloth]]\nmesh = \"t.obj\"").unwrap();
    assert!(scene.warnings[0].ends_with("2 triangles were wound against their neighbors and are turned over"));
    let normals = scene.mesh.triangles.iter().map(|t| {
        let [a, b, c] = t.map(|v| scene.mesh.positions[v as usize]);
        (b - a).cross(c - a).z
    });
    assert!(normals.into_iter().all(|z| z > 0.0) && (rest_area(&scene.mesh) - 1.0).abs() < 1e-6);

    let mut strip = String::new();
    for i in 0..12 {
        let (turn, half) = (std::f64::consts::TAU * f64::from(i) / 12.0, std::f64::consts::PI * f64::from(i) / 12.0);
        for side in [-0.2, 0.2] {
            let radius = 1.0 + side * half.cos();
            strip += &format!("v {} {} {}\n", radius * turn.cos(), side * half.sin(), radius * turn.sin());
        }
    }
    let at = |i: usize, side: usize| if i < 12 { 2 * i + side + 1 } else { 2 - side };
    (0..12).for_each(|i| strip += &format!("f {} {} {} {}\n", at(i, 0), at(i + 1, 0), at(i + 1, 1), at(i, 1)));
    folder.write("m.obj", strip.as_bytes());
    let refused = folder.checked("m.obj", |_| {}).unwrap_err();
    assert!(refused.contains("one side only, as a Moebius strip has") && refused.contains("cut it"), "{refused}");
}

#[test]
fn pins_select_objects_and_groups_and_frames_keep_them() {
    let coat =
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 2 1 0\no Coat\ng body front\nf 1 2 3 4\ng sleeve\nf 2 5 6 3\n";
    let folder = Folder::new(&[("c.obj", coat)]);
    let held = |name: &str| {
        folder
            .scene(&format!("[[cloth]]\nname = \"coat\"\nmesh = \"c.obj\"\n[[pin]]\ngroup = \"{name}\""))
            .map(|scene| scene.pins.iter().map(|pin| pin.vertex).collect::<Vec<_>>())
    };
    assert_eq!(held("Coat"), Ok((0..6).collect()));
    assert_eq!(held("front"), Ok(vec![0, 1, 2, 3]));
    assert_eq!(held("body front"), Ok(vec![0, 1, 2, 3]));
    assert_eq!(held("sleeve"), Ok(vec![1, 2, 4, 5]));
    let refused = held("collar").unwrap_err();
    assert!(
        refused.ends_with(
            "field `pin.group`: `coat` has no object or group named `collar`; it has Coat, body front, sleeve"
        ),
        "{refused}"
    );

    let text =
        "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 2 }\norigin_m = [0, 0, 5]\n[[cloth]]\nmesh = \"c.obj\"";
    let scene = folder.scene(text).unwrap();
    let run = RunDirectory::create(&folder.path("run"), Existing::Refuse).unwrap();
    let formats = [FrameFormat::Obj, FrameFormat::Pc2];
    let mut writer = FrameWriter::with_parts(&run, &formats, &scene.mesh, &scene.parts, scene.origin_m, 0).unwrap();
    writer.write(0, &scene.mesh, &scene.mesh.positions).unwrap();
    for file in [run.frames().join("frame_000000.obj"), run.rest_mesh()] {
        let again = parse_obj(&std::fs::read(&file).unwrap()[..]).unwrap();
        assert_eq!((again.parts, again.triangles), (scene.parts.clone(), scene.mesh.triangles.clone()), "{file:?}");
    }
    assert!(folder.checked("c.obj", |_| {}).unwrap().contains("parts       Coat, body front, sleeve"));
}

#[test]
fn crossings_of_a_mesh_are_written() {
    let crossing = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.2 0.2 -1\nv 0.2 0.2 1\nv 0.3 0.9 1\nv 9 9 9\nv 9 8 9\nv 8 9 9\nf 1 2 3\nf 4 5 6\nf 7 8 9\n";
    let folder = Folder::new(&[("x.obj", crossing), ("fine.obj", &sheet_obj(1.0, 1, None))]);
    let out = folder.path("out.obj");
    let sentence = folder.checked("x.obj", |args| args.write_crossings = Some(out.clone())).unwrap_err();
    assert!(sentence.ends_with("out.obj holds a mesh of all that do"), "{sentence}");
    assert_eq!(parse_obj(&std::fs::read(&out).unwrap()[..]).unwrap().triangles.len(), 2);
    assert!(
        folder
            .checked("fine.obj", |args| args.resolution = Some(9))
            .unwrap_err()
            .contains("--resolution is for the sheets")
    );
}

#[test]
fn a_frame_of_film_gets_the_steps_that_fit() {
    let folder = Folder::new(&[]);
    let scene = |simulation: &str| {
        folder.scene(&format!("[simulation]\n{simulation}\n[[cloth]]\nsheet = {{ size_m = [1, 1], triangles = 2 }}"))
    };
    let film = scene("frame_s = 0.041666667").unwrap();
    assert_eq!(film.settings.steps_per_frame, 11);
    assert!((film.settings.step_s * 11.0 - 0.041666667).abs() < 1e-12 && film.warnings[0].contains("is 11 steps"));
    let refused = scene("frame_s = 0.041666667\nstep_s = 0.004").unwrap_err();
    assert!(
        refused.ends_with("must be a whole number of steps of 0.004 s; step_s = 0.003787879 makes it 11 steps"),
        "{refused}"
    );
    assert_eq!(scene("frame_s = 0.041666667\nstep_s = 0.003787879").unwrap().settings.steps_per_frame, 11);
    assert!(scene("frame_s = 0.04").unwrap().warnings.is_empty());
}

#[test]
fn scenes_meshes_and_matrices_may_be_utf_16_or_zipped() {
    use std::io::Write;
    let wide = |text: &str| {
        [0xff, 0xfe].into_iter().chain(text.encode_utf16().flat_map(u16::to_le_bytes)).collect::<Vec<u8>>()
    };
    let zipped = |bytes: &[u8]| {
        let mut out = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        out.write_all(bytes).unwrap();
        out.finish().unwrap()
    };
    let folder = Folder::new(&[]);
    folder.write("w.obj", &wide(&sheet_obj(1.0, 2, None)));
    folder.write("z.obj.gz", &zipped(sheet_obj(1.0, 2, None).as_bytes()));
    for mesh in ["w.obj", "z.obj.gz"] {
        folder.write("w.toml", &wide(&format!("[[cloth]]\nmesh = \"{mesh}\"\n")));
        assert_eq!(load(&folder.path("w.toml"), &Overrides::default()).unwrap().mesh.positions.len(), 9, "{mesh}");
    }
    assert!(folder.checked("z.obj.gz", |_| {}).is_ok());
    let market = "%%MatrixMarket matrix coordinate real symmetric\n3 3 4\n1 1 2.0D+00\n2 2 2d0\n3 3 2\n2 1 -1.0D-1\n";
    folder.write("m.mtx", market.as_bytes());
    folder.write("m.mtx.gz", &zipped(market.as_bytes()));
    for file in ["m.mtx", "m.mtx.gz"] {
        let (system, rhs) = read_system(&folder.path(file)).unwrap();
        assert_eq!((system.scalar_rows, rhs), (3, None), "{file}");
    }
}

#[test]
fn options_of_a_mesh_convert() {
    assert_eq!(
        MeshOptions::from(MaterialSource::Shape),
        MeshOptions { material: MaterialSource::Shape, weld: None, unit_m: 1.0 }
    );
    assert_eq!(MeshOptions::default().material, MaterialSource::Auto);
}

/// Cases from the collection of public questions, where it lies beside the other test data.
#[test]
fn cases_from_outside() {
    let Some(data) = std::env::var_os("LOOMTREE_TEST_DATA") else {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
        return;
    };
    let cases = Path::new(&data).join("../cases");
    if !cases.is_dir() {
        println!("skipped: no folder of cases beside the test data");
        return;
    }
    let summary = |name: &str| {
        let args = CheckArgs {
            file: cases.join(name),
            resolution: None,
            write_crossings: None,
            untangle: None,
            obstacle: false,
        };
        let mut out = Vec::new();
        check(&args, &mut out).map(|()| String::from_utf8(out).unwrap()).map_err(|error| error.message)
    };
    assert!(summary("uv01.toml").unwrap().contains("cover 1 m^2 where the mesh has 4 m^2"));
    assert!(summary("concave.toml").is_ok() && summary("latin1_comment.ply").is_ok());
    assert!(summary("seq_gap.toml").unwrap_err().contains("number 3 is missing"));
    assert!(summary("collider_needle.toml").unwrap().contains("triangle 9 has no area and is left out"));
    assert!(summary("moebius.obj").unwrap_err().contains("one side only"));
    assert!(summary("ply_hang.ply").unwrap_err().contains("end_header"));
    assert!(summary("seam_split.toml").unwrap_err().contains("weld_m = 1e-6"));
    let (system, _) = read_system(&cases.join("fortranD.mtx")).unwrap();
    assert_eq!(system.scalar_rows, 30);
}

#[test]
fn an_obstacle_in_another_unit_is_named_beside_the_cloth() {
    let body = |height: f64| format!("v 0 0 0\nv {0} 0 0\nv 0 {height} 0\nv 0 0 {0}\nf 1 2 3\nf 1 3 4\n", height / 5.0);
    let folder = Folder::new(&[("m.obj", &body(1.7)), ("cm.obj", &body(170.0)), ("mm.obj", &body(1700.0))]);
    let warnings = |file: &str, more: &str| {
        let cloth = "[[cloth]]\nsheet = { size_m = [1.0, 0.5] }\norigin_m = [0.0, 0.0, 5000.0]\n";
        folder.scene(&format!("{cloth}[[obstacle]]\nname = \"body\"\nmesh = \"{file}\"\n{more}")).unwrap().warnings
    };
    assert_eq!(
        warnings("cm.obj", ""),
        ["obstacle `body` is 170.0000 m large, the largest cloth 1.0000 m: if its file is in centimetres, \
          `scale = 0.01` of the obstacle makes metres of them"]
    );
    let [millimetres] = &warnings("mm.obj", "")[..] else { panic!("one warning") };
    assert!(millimetres.contains("is in millimetres, `scale = 0.001`"), "{millimetres}");
    let [small] = &warnings("m.obj", "scale = 0.01")[..] else { panic!("one warning") };
    assert!(small.contains("is 0.0170 m large") && small.contains("`scale` of the obstacle enlarges it"), "{small}");
    assert_eq!(warnings("m.obj", ""), [""; 0]);
    assert_eq!(warnings("cm.obj", "scale = 0.01"), [""; 0]);
    // A large plane says its size in meters.
    let plane = "[[cloth]]\nsheet = { size_m = [1.0, 1.0] }\norigin_m = [0.0, 0.0, 1.0]\n[[obstacle]]\n\
                 plane = { point_m = [0.0, -9.0, 0.0], normal = [0.0, 1.0, 0.0], size_m = [500.0, 500.0] }\n";
    assert_eq!(folder.scene(plane).unwrap().warnings, [""; 0]);
}
