//! Obstacles of TOML scenes: every form, motions, sequences, the start-state check, and the sentence for every
//! mistake.

use std::path::Path;

use loomtree::cli::check::{CheckArgs, check};
use loomtree::math::Vec3;
use loomtree::mesh::read_surface;
use loomtree::scene::{Obstacles, Overrides, Scene, SceneError, parse};

const SHEET: &str = "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 8 }\n";

fn read(rest: &str) -> Result<Scene, SceneError> {
    parse(&format!("{SHEET}{rest}"), Path::new("scenes/x.toml"), &Overrides::default())
}

/// The scene's refusal after the file's name.
fn fault(rest: &str) -> String {
    let sentence = read(rest).expect_err("the scene is wrong").to_string();
    sentence.strip_prefix("scenes/x.toml, ").expect("a message names its file and line").to_owned()
}

/// Lowest and highest corner at a time.
fn extent(scene: &Scene, time_s: f64) -> [Vec3; 2] {
    let mut positions = Vec::new();
    Obstacles::new(&scene.obstacles).positions_at(time_s, &mut positions);
    let points = positions.chunks_exact(3).map(Vec3::from_slice);
    points.fold([Vec3::INFINITY, Vec3::NEG_INFINITY], |[low, high], p| [low.min(p), high.max(p)])
}

fn assert_extent(rest: &str, time_s: f64, low: [f32; 3], high: [f32; 3]) {
    let found = extent(&read(rest).unwrap(), time_s);
    let off = found[0].distance(Vec3::from(low)).max(found[1].distance(Vec3::from(high)));
    assert!(off < 1e-2, "{rest}: {found:?}");
}

#[test]
fn every_form_has_its_place_and_size() {
    let cases = [
        ("sphere = { center_m = [0, 0, 5], radius_m = 2 }", [-2., -2., 3.], [2., 2., 7.]),
        ("plane = { point_m = [1, 2, 3], size_m = [4, 6] }", [-1., 2., 0.], [3., 2., 6.]),
        ("plane = { point_m = [0, 0, 3], normal = [0, 0, 2], size_m = [4, 6] }", [-2., -3., 3.], [2., 3., 3.]),
        ("box = { center_m = [1, 2, 3], size_m = [2, 4, 3] }", [0., 0., 1.5], [2., 4., 4.5]),
        (
            "box = { center_m = [1, 2, 3], size_m = [2, 4, 3] }\nrotate_deg = [90, 0, 0, 1]",
            [-1., 1., 1.5],
            [3., 3., 4.5],
        ),
        (
            "plate = { center_m = [0, 0, 3], normal = [0, 0, -1], size_m = [4, 6], thickness_m = 0.5 }",
            [-2., -3., 2.75],
            [2., 3., 3.25],
        ),
        (
            "funnel = { center_m = [0, 0, 9], top_radius_m = 3, bottom_radius_m = 1, height_m = 2, spout_m = 4, triangles = 90000 }",
            [-3., -4., 6.],
            [3., 2., 12.],
        ),
        (
            "funnel = { center_m = [0, 0, 9], axis = [0, 0, 1], top_radius_m = 3, bottom_radius_m = 1, height_m = 2 }",
            [-3., -3., 9.],
            [3., 3., 11.],
        ),
    ];
    for (form, low, high) in cases {
        assert_extent(&format!("[[obstacle]]\n{form}"), 0.0, low, high);
    }
}

#[test]
fn shapes_have_about_the_triangles_asked_for() {
    for form in [
        "sphere = { center_m = [0, 0, 5], radius_m = 2",
        "plane = { point_m = [1, 2, 3], size_m = [4, 6]",
        "box = { center_m = [1, 2, 3], size_m = [2, 4, 3]",
        "plate = { center_m = [0, 0, 3], size_m = [4, 6]",
        "funnel = { center_m = [0, 0, 9], top_radius_m = 3, bottom_radius_m = 1, height_m = 2, spout_m = 1",
    ] {
        for (option, wanted) in [("", 3_000), (", triangles = 200", 200), (", triangles = 40_000", 40_000)] {
            let scene = read(&format!("[simulation]\ncollisions = false\n[[obstacle]]\n{form}{option} }}")).unwrap();
            let got = scene.obstacles[0].triangles.len() as f64;
            assert!((got / f64::from(wanted) - 1.0).abs() < 0.3, "{form}: {got} triangles for {wanted}");
        }
    }
}

#[test]
fn every_field_arrives() {
    let scene = read(
        r#"friction = 0.7
        [simulation]
        friction = 0.4
        contact_stiffness = 3
        [[cloth]]
        sheet = { size_m = [1, 1], triangles = 8 }
        origin_m = [0, 0, 1]
        [[obstacle]]
        name = "ball"
        sphere = { center_m = [0, 0, 5], radius_m = 0.5 }
        friction = 0.1
        motion = [{ time_s = 1, translate_m = [0, 0, 1] }, { time_s = 2, rotate_deg = [720, 0, 1, 0], pivot_m = [0, 0, 5] }]
        [[obstacle]]
        box = { center_m = [0, 0, -5], size_m = [1, 1, 1] }
        "#,
    )
    .unwrap();
    assert_eq!((scene.settings.collisions, scene.settings.contact_stiffness), (true, 3.0));
    assert_eq!([0, 8, 9, 17].map(|v| scene.friction_of_vertex(v)), [0.7, 0.7, 0.4, 0.4]);
    assert_eq!((&scene.cloths[1].vertices, &scene.cloths[1].triangles), (&(9..18), &(8..16)));
    assert_eq!(scene.vertex_name(10), format!("vertex 1 of `{}`", scene.cloths[1].name));
    assert_eq!(read("").unwrap().vertex_name(5), "vertex 5");
    let obstacles = Obstacles::new(&scene.obstacles);
    assert_eq!([0, 1].map(|i| (obstacles.name(i), obstacles.friction(i))), [("ball", 0.1), ("box 1", 0.4)]);
    assert_eq!(scene.obstacles.iter().map(|o| o.moving()).collect::<Vec<_>>(), [true, false]);
    assert!(read("[simulation]\ncollisions = false").is_ok_and(|scene| !scene.settings.collisions));
}

#[test]
fn a_ball_turns_many_times_about_its_pivot() {
    let box_of = "[[obstacle]]\nbox = { center_m = [0, 9, 0], size_m = [4, 1, 2] }\nmotion = [{ time_s = 0 }, \
        { time_s = 4, rotate_deg = [1440, 0, 0, 1], pivot_m = [0, 9, 0] }]";
    for (time_s, x, y) in [(0.0, 2.0, 0.5), (0.25, 0.5, 2.0), (1.0, 2.0, 0.5), (2.75, 0.5, 2.0), (9.0, 2.0, 0.5)] {
        // The pivot of the first keyframe is the origin: it counts as long as nothing turns, so give it to both.
        let both = box_of.replace("{ time_s = 0 }", "{ time_s = 0, pivot_m = [0, 9, 0] }");
        assert_extent(&both, time_s, [-x, 9.0 - y, -1.0], [x, 9.0 + y, 1.0]);
    }
}

#[test]
fn mistakes_name_line_and_field() {
    let with = |rest: &str| fault(&format!("[[obstacle]]\n{rest}"));
    assert_eq!(
        with(""),
        "line 3: field `obstacle`: an obstacle needs exactly one of sphere, plane, box, plate, funnel, mesh, sequence, \
         gltf, usd, abc, body, pc2, mdd, not 0"
    );
    assert_eq!(
        with("sphere = { center_m = [0, 0, 0], radius_m = 1 }\nmesh = \"a.obj\""),
        "line 3: field `obstacle`: an obstacle needs exactly one of sphere, plane, box, plate, funnel, mesh, sequence, \
         gltf, usd, abc, body, pc2, mdd, not 2"
    );
    let sphere = "sphere = { center_m = [0, 0, 5], radius_m = 1 }\n";
    let then = |rest: &str| with(&format!("{sphere}{rest}"));
    assert_eq!(
        then("colour = 1"),
        "line 5: field `obstacle.colour`: unknown field; known here: name, sphere, plane, box, plate, funnel, mesh, sequence, \
         frames_per_s, first, gltf, usd, abc, body, triangles, pc2, mdd, clip, node, start_s, rate, loop, lead_in_s, \
         origin_m, rotate_deg, scale, units_m, up, friction, motion"
    );
    assert_eq!(
        then("origin_m = [0, 0, 0]"),
        "line 5: field `obstacle.origin_m`: belongs to an obstacle with one of mesh, sequence, gltf, usd, abc, pc2, \
         mdd; a sphere has its place in itself"
    );
    assert_eq!(then("friction = -0.1"), "line 5: field `obstacle.friction`: must be a number of at least 0, not -0.1");
    assert_eq!(
        then("frames_per_s = 24"),
        "line 5: field `obstacle.frames_per_s`: belongs to an obstacle with a `sequence` or `pc2`"
    );
    assert_eq!(
        then("motion = [{ time_s = 1, scale = 0 }]"),
        "line 5: field `obstacle.motion`: scales to nothing; every `scale` of an obstacle must be above 0"
    );
    assert_eq!(
        then("motion = [{ time_s = 1, scale = 1e30, pivot_m = [1e30, 0, 0] }]"),
        "line 5: field `obstacle.motion`: moves it to where no number can say"
    );
    assert_eq!(
        then("motion = [{ time_s = 1, rotate_deg = [1e12, 0, 1, 0] }]"),
        "line 5: field `obstacle.motion.rotate_deg`: turns by more than 1000000 full turns"
    );
    assert_eq!(
        with("sphere = { center_m = [0, 0, 5], radius_m = nan }"),
        "line 4: field `obstacle.sphere.radius_m`: must be a number above 0, not nan"
    );
    assert_eq!(with("sphere = { radius_m = 1 }"), "line 4: field `obstacle.sphere.center_m`: is missing");
    assert_eq!(
        with("sphere = { center_m = [0, 0, 5], radius_m = 1, triangles = 3 }"),
        "line 4: field `obstacle.sphere.triangles`: must be a whole number from 12 to 5000000, not 3"
    );
    assert_eq!(
        with("sphere = { center_m = [1, 1, 5], radius_m = 1e-30 }"),
        "line 4: field `obstacle.sphere`: at its place in the scene: triangle 1 has no area in space: its corners lie on one line"
    );
    assert_eq!(
        with("plane = { point_m = [0, 0, 5], size_m = [1, 1], normal = [0, 0, 0] }"),
        "line 4: field `obstacle.plane.normal`: must not be zero"
    );
    assert_eq!(
        with("box = { center_m = [0, 0, 5], size_m = [1, 0, 1] }"),
        "line 4: field `obstacle.box.size_m`: all sides must be above 0, and none more than 100000 times as long as another"
    );
    assert_eq!(
        with("funnel = { center_m = [0, 0, 5], top_radius_m = 1, bottom_radius_m = 1, height_m = 1 }"),
        "line 4: field `obstacle.funnel.top_radius_m`: must be above bottom_radius_m = 1"
    );
    assert_eq!(
        with("mesh = \"no.obj\""),
        "line 4: field `obstacle.mesh`: no file `no.obj` beside the scene or in the working directory"
    );
    assert_eq!(
        with("sequence = \"no.obj\"\nframes_per_s = 24"),
        "line 4: field `obstacle.sequence`: `no.obj` must have one number in it, as in `frame_%04d.obj` or `frame_%d.obj`"
    );
    assert_eq!(
        with("sequence = \"no_%03d.obj\"\nframes_per_s = 24"),
        "line 4: field `obstacle.sequence`: there is no file such as `no_001.obj` beside the scene or in the working directory"
    );
}

#[test]
fn mistakes_of_contact_numbers_name_line_and_field() {
    let with = |rest: &str| fault(&format!("[simulation]\n{rest}"));
    assert_eq!(with("collisions = 1"), "line 4: field `simulation.collisions`: must be true or false, not 1");
    assert_eq!(
        with("contact_stiffness = 0"),
        "line 4: field `simulation.contact_stiffness`: must be a number above 0, not 0"
    );
    assert_eq!(with("thickness_m = nan"), "line 4: field `simulation.thickness_m`: must be a number above 0, not nan");
    assert_eq!(with("friction = -1"), "line 4: field `simulation.friction`: must be a number of at least 0, not -1");
    assert_eq!(fault("friction = inf"), "line 3: field `cloth.friction`: must be a number of at least 0, not inf");
}

#[test]
fn an_obstacle_in_the_cloth_is_refused_with_its_triangles() {
    let ball =
        "[[obstacle]]\nname = \"ball\"\nsphere = { center_m = [0.5, 0.5, 0.3], radius_m = 0.29, triangles = 80 }\n";
    read(ball).unwrap();
    let error = read(&ball.replace("0.29", "0.31")).unwrap_err();
    let SceneError::Crossing { crossings, .. } = &error else { panic!("{error}") };
    assert!(crossings.first[0].starts_with("triangle ") && crossings.first[0].ends_with(" of `cloth 0`"));
    assert!(crossings.first[1].ends_with(" of obstacle `ball`"), "{}", crossings.first[1]);
    assert_eq!(crossings.triangles().len() * 3, crossings.positions.len());
    assert!(error.to_string().contains("`loomtree check scenes/x.toml --write-crossings crossings.obj`"), "{error}");
    // Where the motion has it at time 0 counts; and nothing counts without collisions.
    read(&format!("{}motion = [{{ time_s = 0, translate_m = [0, 0, 1] }}]", ball.replace("0.29", "0.31"))).unwrap();
    assert!(read(&format!("{ball}motion = [{{ time_s = 0, translate_m = [0, 0, -0.2] }}]")).is_err());
    read(&format!("[simulation]\ncollisions = false\n{}", ball.replace("0.29", "0.31"))).unwrap();
    // Obstacles may stand in each other.
    read(&format!("{ball}{ball}")).unwrap();
}

#[test]
fn check_writes_a_mesh_of_the_crossings() {
    let folder = tempfile::tempdir().unwrap();
    let (file, mesh) = (folder.path().join("s.toml"), folder.path().join("c.obj"));
    let floor = "[[obstacle]]\nname = \"floor\"\nplane = { point_m = [0, 0.25, 0], size_m = [9, 9], triangles = 12 }\n";
    std::fs::write(&file, format!("{SHEET}{floor}")).unwrap();
    let args = CheckArgs {
        file: file.clone(),
        resolution: None,
        write_crossings: Some(mesh.clone()),
        untangle: None,
        obstacle: false,
    };
    let error = check(&args, &mut Vec::new()).unwrap_err();
    assert_eq!(error.exit_code, 2);
    assert!(error.message.contains("of obstacle `floor`"), "{error}");
    assert!(error.message.contains(&format!("({} holds a mesh of them)", mesh.display())), "{error}");
    let written = read_surface(&mesh).unwrap();
    // The lower four triangles of the sheet and at least one of the floor.
    assert!(written.triangles.len() >= 5);
    let lower = written.triangles.iter().filter(|t| t.iter().all(|&v| written.positions[v as usize].z == 0.0)).count();
    assert_eq!(lower, 4);
    let unwritable = CheckArgs { write_crossings: Some(folder.path().join("no/such.obj")), ..args };
    let error = check(&unwritable, &mut Vec::new()).unwrap_err();
    assert!(error.exit_code == 2 && error.message.contains("cannot write "), "{error}");
}

#[test]
fn a_sequence_is_read_placed_and_interpolated() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
    let frame = |x: f32| format!("v {x} 0 0\nv {} 0 0\nv {x} 1 0\nv 7 7 7\nf 1 2 3\n", x + 1.0);
    for (i, x) in [0.0, 2.0, 3.0].into_iter().enumerate() {
        write(&format!("body_{:02}.obj", i + 1), &frame(x));
    }
    let path = folder.path().join("s.toml");
    let scene = |text: &str| parse(text, &path, &Overrides::default());
    let text = format!(
        "{SHEET}[[obstacle]]\nsequence = \"body_%02d.obj\"\nframes_per_s = 10\norigin_m = [0, 0, 5]\nscale = 2\n"
    );
    let obstacles = Obstacles::new(&scene(&text).unwrap().obstacles);
    assert_eq!((obstacles.name(0), obstacles.vertices(), obstacles.moving()), ("sequence 0", 4, true));
    let mut positions = Vec::new();
    for (time_s, x) in [(0.0, 0.0), (0.05, 2.0), (0.1, 4.0), (0.15, 5.0), (0.2, 6.0), (3.0, 6.0)] {
        obstacles.positions_at(time_s, &mut positions);
        let off = (Vec3::from_slice(&positions) - Vec3::new(x, 0.0, 5.0)).length();
        assert!(off < 1e-5, "{:?} at {time_s} s", &positions[..3]);
        assert_eq!(positions[9..], [14.0, 14.0, 19.0], "a vertex in no triangle keeps its number");
    }
    let fault = |text: &str| scene(text).unwrap_err().to_string().replace(&format!("{}/", folder.path().display()), "");
    assert_eq!(
        fault(&text.replace("frames_per_s = 10\n", "")),
        "s.toml, line 3: field `obstacle.frames_per_s`: is missing"
    );
    assert_eq!(
        fault(&format!("{text}motion = [{{ time_s = 1 }}]")),
        "s.toml, line 8: field `obstacle.motion`: give either `motion` or a `sequence`"
    );
    write("body_03.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n");
    assert_eq!(
        fault(&text),
        format!(
            "body_03.obj: has other vertices or triangles (3, 1) than the first of its sequence, {} (4, 1)",
            "body_01.obj"
        )
    );
    write("body_03.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 0 0 0\nf 1 2 3\n");
    assert_eq!(fault(&text), "body_01.obj: the sequence has no triangle that has an area in every frame");
}
