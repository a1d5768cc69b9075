//! TOML scenes: the shipped ones, every field, and the sentence for every kind of mistake.

use std::path::Path;

use loomtree::math::{DVec3, Vec2, Vec3};
use loomtree::mesh::validate;
use loomtree::scene::{Overrides, Scene, StrainLimit, load, parse};

fn read(text: &str) -> Result<Scene, String> {
    parse(text, Path::new("scenes/x.toml"), &Overrides::default()).map_err(|error| error.to_string())
}

/// The sentence about a scene, without the file's name.
fn fault(text: &str) -> String {
    let sentence = read(text).expect_err("the scene is wrong");
    sentence
        .strip_prefix("scenes/x.toml")
        .expect("a message names its file")
        .trim_start_matches([',', ':', ' '])
        .to_owned()
}

#[test]
fn shipped_scenes_load_at_every_resolution() {
    for name in ["flag", "hanging", "curtain", "free_fall"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes").join(name).with_extension("toml");
        for triangles in [None, Some(1_000), Some(30_000), Some(1_200_000)] {
            let overrides = Overrides { resolution: triangles, frames: triangles.map(|_| 3) };
            let scene = load(&path, &overrides).unwrap();
            assert_eq!((scene.name.as_str(), validate(&scene.mesh)), (name, Ok(())));
            assert_eq!(scene.pins.is_empty(), name == "free_fall");
            assert_eq!(scene.velocities.len(), scene.mesh.positions.len());
            assert_eq!(scene.fabric_of_triangle.len(), scene.mesh.triangles.len());
            if let Some(wanted) = triangles {
                let off = scene.mesh.triangles.len() as f64 / wanted as f64 - 1.0;
                assert!(off.abs() < 0.03, "{name}: {} triangles for {wanted}", scene.mesh.triangles.len());
                assert_eq!(scene.settings.frames, 3);
            }
        }
    }
}

/// Everything of a scene that a run starts from, as text: every bit of a float is in it.
fn all_of(scene: &Scene) -> String {
    format!("{scene:?}")
}

#[test]
fn one_parsed_scene_gives_every_resolution_again_and_again() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes");
    for name in ["flag", "curtain", "sphere", "stack"] {
        let path = folder.join(name).with_extension("toml");
        let parsed = loomtree::scene::read(&path).unwrap();
        let at = |resolution| Overrides { resolution, frames: None };
        let fine = parsed.at(&at(Some(4_000))).unwrap();
        let coarse = parsed.at(&at(Some(500))).unwrap();
        assert!(coarse.mesh.triangles.len() < fine.mesh.triangles.len() / 4);
        for (scene, resolution) in [(fine, Some(4_000)), (coarse, Some(500)), (parsed.at(&at(None)).unwrap(), None)] {
            assert_eq!(all_of(&scene), all_of(&load(&path, &at(resolution)).unwrap()), "{name} at {resolution:?}");
        }
    }
}

#[test]
fn two_resolutions_of_a_scene_have_the_same_material_space() {
    let text = "[[cloth]]\nsheet = { size_m = [3, 2] }\norigin_m = [5, 0, 0]\n[[cloth]]\nsheet = { size_m = [1, 1] }";
    let parsed = loomtree::scene::read_str(text, Path::new("x.toml")).unwrap();
    for resolution in [100, 5_000] {
        let scene = parsed.at(&Overrides { resolution: Some(resolution), frames: None }).unwrap();
        for (cloth, size) in scene.cloths.iter().zip([[3.0, 2.0], [1.0, 1.0]]) {
            let corners =
                scene.mesh.material_uv[cloth.triangles.start as usize..cloth.triangles.end as usize].as_flattened();
            let high = corners.iter().fold(Vec2::ZERO, |high, &uv| high.max(uv));
            let low = corners.iter().fold(Vec2::INFINITY, |low, &uv| low.min(uv));
            assert_eq!((low, high), (Vec2::ZERO, Vec2::from(size)), "{} at {resolution}", cloth.name);
        }
    }
}

#[test]
fn coarser_scenes_hold_the_first_vertices_of_the_finer_one() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/sphere.toml");
    let parsed = loomtree::scene::read(&path).unwrap();
    let overrides = Overrides { resolution: Some(9_000), frames: None };
    let (fine, (coarse, refinements)) = (parsed.at(&overrides).unwrap(), parsed.coarser_at(&overrides, 2).unwrap());
    assert_eq!(fine.mesh.triangles.len(), 16 * coarse.mesh.triangles.len());
    for ((fine_cloth, coarse_cloth), refinement) in fine.cloths.iter().zip(&coarse.cloths).zip(&refinements) {
        let positions = |scene: &Scene, cloth: &loomtree::scene::Cloth| {
            scene.mesh.positions[cloth.vertices.start as usize..cloth.vertices.end as usize].to_vec()
        };
        let (fine, coarse) = (positions(&fine, fine_cloth), positions(&coarse, coarse_cloth));
        assert_eq!(fine[..coarse.len()], coarse);
        assert_eq!((refinement.parts, refinement.copies.len()), (16, coarse.len()));
        assert_eq!(refinement.middles.len(), fine.len() - coarse.len());
        for &[v, a, b] in &refinement.middles {
            let [v, a, b] = [v, a, b].map(|vertex| fine[vertex as usize]);
            assert!(v.distance((a + b) / 2.0) < 1e-6);
        }
    }
    let error = parsed.coarser_at(&overrides, 4).unwrap_err().to_string();
    assert!(error.contains("`cloth[0].sheet`: the sheet has no level that is 4 times coarser"), "{error}");
}

#[test]
fn a_sheet_is_irregular_unless_it_asks_for_a_grid() {
    let sheet = |fields: &str| {
        let text = format!("[[cloth]]\nsheet = {{ size_m = [3, 2], triangles = 1200{fields} }}");
        let mesh = read(&text).unwrap().mesh;
        (mesh.triangles.len(), mesh.positions[1])
    };
    assert_eq!(sheet(", mesh = \"grid\""), (1200, Vec3::new(0.1, 0.0, 0.0)));
    assert_eq!(sheet(", mesh = \"irregular\""), sheet(""));
    assert_eq!(sheet(""), (19 * 64, Vec3::new(3.0, 0.0, 0.0)));
    let error = read("[[cloth]]\nsheet = { size_m = [3, 2], mesh = \"round\" }").unwrap_err().to_string();
    assert!(error.contains("must be one of irregular, grid"), "{error}");
}

#[test]
fn a_round_sheet_has_a_radius_and_neither_corners_nor_a_grid() {
    let mesh = read("[[cloth]]\nsheet = { radius_m = 0.15, triangles = 4000 }\nplane = \"xz\"").unwrap().mesh;
    assert_eq!(mesh.triangles.len(), 4032);
    let farthest = mesh.positions.iter().map(|p| p.length()).fold(0.0, f32::max);
    assert!((farthest - 0.15).abs() < 1e-7 && mesh.positions.iter().all(|p| p.y == 0.0));
    for (sheet, what) in [
        ("{ radius_m = 1, mesh = \"grid\" }", "a round sheet has no grid"),
        ("{ radius_m = 1, size_m = [1, 1] }", "a sheet has either `size_m` or `radius_m`"),
        ("{ radius_m = 1 }\n[[pin]]\nedge = \"top\"", "`cloth 0` is round and has no corners and edges"),
        ("{ radius_m = 0 }", "must be"),
    ] {
        let error = read(&format!("[[cloth]]\nsheet = {sheet}")).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    }
}

#[test]
fn bending_is_four_times_the_flexural_rigidity() {
    let fabric = |bending: &str| {
        let text = format!(
            "[[fabric]]\nname = \"f\"\ndensity_kg_m2 = 1\nstretching_n_m = [1, 0, 1, 1]\n\
             {bending}\n{SHEET}fabric = \"f\""
        );
        read(&text).map(|scene| scene.fabrics[0].bending_n_m)
    };
    assert_eq!(fabric("flexural_rigidity_n_m = 0.25").unwrap(), [[1.0; 5]; 3]);
    let rows = "[[1, 2, 3, 4, 5], [1, 2, 3, 4, 5], [1, 2, 3, 4, 5]]";
    assert_eq!(fabric(&format!("flexural_rigidity_n_m = {rows}")).unwrap(), [[4.0, 8.0, 12.0, 16.0, 20.0]; 3]);
    let both = fabric("bending_n_m = 1\nflexural_rigidity_n_m = 0.25").unwrap_err().to_string();
    assert!(both.contains("`fabric.flexural_rigidity_n_m`: says the same as `bending_n_m`"), "{both}");
    assert!(fabric("").unwrap_err().to_string().contains("bending_n_m"));
}

#[test]
fn the_curtain_keeps_its_rings_and_slides_them() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/curtain.toml");
    for resolution in [1_000, 20_000] {
        let scene = load(&path, &Overrides { resolution: Some(resolution), frames: None }).unwrap();
        assert_eq!(scene.pins.len(), 17);
        let last = scene.pins.iter().map(|pin| scene.mesh.positions[pin.vertex as usize]).fold(Vec3::ZERO, Vec3::max);
        assert_eq!(last, Vec3::new(3.0, 2.5, 0.0));
        assert!(scene.motions[0].apply(3.5, last).distance(Vec3::new(1.2, 2.5, 0.0)) < 1e-6);
    }
}

#[test]
fn every_field_arrives() {
    let scene = read(
        r#"
        [simulation]
        step_s = 0.002
        frame_s = 0.04
        frames = 7
        gravity_m_s2 = [0, 0, -1]
        relative_tolerance = 1e-4
        max_iterations = 9
        thickness_m = 0.01
        friction = 0.5
        [air]
        wind_m_s = [1, 2, 3]
        drag_kg_m2_s = 0.25
        [[fabric]]
        name = "felt"
        density_kg_m2 = 0.5
        stretching_n_m = [100, 1, 90, 10]
        bending_n_m = [[1, 2, 3, 4, 5], [1, 2, 3, 4, 5], [1, 2, 3, 4, 5]]
        [[cloth]]
        name = "one"
        sheet = { size_m = [2, 1], triangles = 4, mesh = "grid" }
        fabric = "felt"
        thicken = 2
        damping_s = 0.5
        velocity_m_s = [0, 1, 0]
        [[cloth]]
        sheet = { size_m = [1, 1], triangles = 2, mesh = "grid" }
        plane = "xz"
        origin_m = [0, 5, 0]
        rotate_deg = [90, 0, 0, 1]
        [[pin]]
        cloth = "one"
        corners = ["top-left", "bottom-right"]
        end_s = 3
        [[pin]]
        cloth = 1
        sphere = { center_m = [0, 6, 0], radius_m = 0.1 }
        start_s = 1
        [[pin.motion]]
        time_s = 2
        translate_m = [1, 0, 0]
        "#,
    )
    .unwrap();
    let settings = &scene.settings;
    assert_eq!((settings.step_s, settings.steps_per_frame, settings.frames), (0.002, 20, 7));
    assert_eq!((settings.gravity_m_s2, settings.wind_m_s), (Vec3::NEG_Z, Vec3::new(1.0, 2.0, 3.0)));
    assert_eq!((settings.air_density_kg_m3, settings.air_drag_kg_m2_s), (1.2, 0.25));
    assert_eq!((settings.relative_tolerance, settings.max_iterations), (1e-4, 9));
    assert_eq!((settings.thickness_m, settings.friction), (0.01, 0.5));
    assert_eq!(scene.name, "x");
    assert_eq!(scene.mesh.triangles, [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [6, 7, 9], [6, 9, 8]]);
    assert_eq!(scene.fabric_of_triangle, [0, 0, 0, 0, 1, 1]);
    assert_eq!((scene.fabrics[0].density_kg_m2, scene.fabrics[0].damping_s), (1.0, 0.5));
    assert_eq!((scene.fabrics[0].stretching_n_m[5][2], scene.fabrics[0].bending_n_m[2][4]), (180.0, 10.0));
    assert_eq!(scene.fabrics[1].name, "cotton");
    assert_eq!((scene.velocities[5], scene.velocities[6]), (Vec3::Y, Vec3::ZERO));
    // The level sheet's warp x turned a quarter about z points up.
    assert!(scene.mesh.positions[7].distance(Vec3::new(0.0, 6.0, 0.0)) < 1e-6);
    let pins: Vec<_> = scene.pins.iter().map(|pin| (pin.vertex, pin.motion, pin.start_s, pin.end_s)).collect();
    assert_eq!(pins, [(2, None, 0.0, 3.0), (3, None, 0.0, 3.0), (7, Some(0), 1.0, f64::INFINITY)]);
}

const SHEET: &str = "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 8, mesh = \"grid\" }\n";

#[test]
fn strain_limits_are_a_list_or_a_table() {
    let limit = |limit: &str| {
        let text = format!("{SHEET}strain_limit = {limit}");
        read(&text).expect("a scene").fabrics[0].strain_limit
    };
    assert_eq!(limit("[0.9, 1.05]"), Some(StrainLimit::Every([0.9, 1.05])));
    let along = |warp, weft, shear_deg| Some(StrainLimit::Along { warp, weft, shear_deg });
    assert_eq!(limit("{ warp = [0.95, 1.02], shear_deg = 20 }"), along(Some([0.95, 1.02]), None, Some(20.0)));
    assert_eq!(limit("{ weft = [0, 1.1] }"), along(None, Some([0.0, 1.1]), None));
    let wrong = |limit: &str| fault(&format!("{SHEET}strain_limit = {limit}"));
    let range = "must be two stretches, the first from 0 to 1 and the second at least 1, such as [0.95, 1.05], not";
    for (text, sentence) in [
        ("[1.05, 1.1]", format!("`cloth.fabric`: the strain limit {range} [1.05, 1.1]")),
        ("{ warp = [0.9, 0.95] }", format!("`cloth.fabric`: the strain limit of the warp {range} [0.9, 0.95]")),
        ("{ weft = [1, 1] }", format!("`cloth.fabric`: the strain limit of the weft {range} [1, 1]")),
        ("{ weft = 1.1 }", "`cloth.strain_limit.weft`: must be an array of 2 numbers".into()),
        ("{ shear_deg = 90 }", "the limit of shear must be an angle above 0 and below 90 degrees, not 90".into()),
        ("{}", "the strain limit has none of `warp`, `weft` and `shear_deg`".into()),
        ("{ bias = 3 }", "`cloth.strain_limit.bias`: unknown field; known here: warp, weft, shear_deg".into()),
        ("1.05", "`cloth.strain_limit`: must be a table".into()),
    ] {
        let found = wrong(text);
        assert!(found.contains(&sentence), "{text}: {found}");
    }
}

#[test]
fn values_over_time_and_forces_arrive() {
    let scene = read(&format!(
        "{SHEET}[simulation]\n\
         gravity_m_s2 = [{{ time_s = 1, value = [0, -2, 0] }}, {{ time_s = 3, value = [4, -2, 0] }}]\n\
         friction_factor = 0.5\nstiffness_factor = [{{ time_s = 0, value = 1 }}, {{ time_s = 1, value = 3 }}]\n\
         [[force]]\nkind = \"radial\"\ncenter_m = [1, 2, 3]\nradius_m = 2\nstrength_m_s2 = -4\nend_s = 2\n\
         [[force]]\nkind = \"vortex\"\naxis = [0, 0, 2]\nstrength_m_s2 = [{{ time_s = 0, value = 5 }}]\n\
         [[force]]\nkind = \"turbulence\"\nstrength_m_s2 = 6\nscale_m = 0.5\nseed = 3"
    ))
    .unwrap();
    let mut settings = scene.settings;
    assert_eq!(settings.gravity_m_s2, Vec3::new(0.0, -2.0, 0.0), "the value at the start");
    settings.take_time(2.0);
    assert_eq!(settings.gravity_m_s2, Vec3::new(2.0, -2.0, 0.0));
    assert_eq!(settings.stiffness_factor_most(), 3.0);
    assert_eq!(settings.over_time.friction_factor.map(|factor| factor.at(7.0)), Some(0.5));
    let at = |force: usize, point: [f64; 3], time_s: f64| {
        settings.over_time.forces[force].acceleration_m_s2(DVec3::from(point), time_s)
    };
    assert_eq!(at(0, [1.0, 3.0, 3.0], 1.0), DVec3::new(0.0, -2.0, 0.0));
    assert_eq!(at(0, [1.0, 3.0, 3.0], 2.1), DVec3::ZERO);
    assert_eq!(at(1, [2.0, 0.0, 9.0], 1.0), DVec3::new(0.0, 5.0, 0.0));
    assert!(at(2, [0.3, 0.2, 0.1], 1.0) != at(2, [0.3, 0.2, 0.2], 1.0));
}

#[test]
fn mistakes_of_values_over_time_forces_and_pressure() {
    let with = |rest: &str| fault(&format!("{SHEET}{rest}"));
    assert_eq!(
        with("[air]\nwind_m_s = [{ time_s = 1, value = [0, 0, 0] }, { time_s = 1, value = [0, 0, 0] }]"),
        "line 4: field `air.wind_m_s[1].time_s`: must be later than that of the key before"
    );
    assert_eq!(
        with("[simulation]\nstiffness_factor = [{ time_s = 1, value = 0 }]"),
        "line 4: field `simulation.stiffness_factor.value`: must be a number above 0, not 0"
    );
    assert_eq!(
        with("[[force]]\nkind = \"radial\"\nstrength_m_s2 = 1\nseed = 3"),
        "line 6: field `force.seed`: does not belong to a force of the kind `radial`"
    );
    assert_eq!(
        with("[[force]]\nkind = \"wind\""),
        "line 4: field `force.kind`: must be one of radial, vortex, turbulence, not \"wind\""
    );
    assert_eq!(
        with("[[force]]\nkind = \"vortex\"\nstrength_m_s2 = 1\naxis = [0, 0, 0]"),
        "line 6: field `force.axis`: must have a length above 0"
    );
    assert_eq!(
        with("pressure_pa = 10"),
        "line 1: field `cloth`: `pressure_pa`: the part of `cloth 0` with triangle 0 has a border; pressure needs a \
         closed surface, or seams that close one"
    );
}

#[test]
fn mistakes_name_line_and_field() {
    let with = |rest: &str| fault(&format!("{SHEET}{rest}"));
    assert_eq!(fault(""), "field `cloth`: a scene needs at least one `[[cloth]]`");
    assert_eq!(fault("a = "), "line 1: string values must be quoted, expected literal string");
    assert_eq!(
        with("\ncolour = 1"),
        "line 4: field `cloth.colour`: unknown field; known here: name, sheet, garment, mesh, material, \
         weld_m, subdivide, seams, plane, origin_m, rotate_deg, scale, wrap, fabric, thicken, damping_s, \
         yield_curvature, yield_strain, hardening, weakening, strain_limit, velocity_m_s, friction, pressure_pa, maps"
    );
    assert_eq!(
        with("fabric = \"coton\""),
        "line 3: field `cloth.fabric`: `coton` is no known fabric; known: cotton, silk, denim, wool, nylon, membrane, or a .json file"
    );
    assert_eq!(with("fabric = 3"), "line 3: field `cloth.fabric`: must be a text, not 3");
    assert_eq!(
        with("fabric = \"no.json\""),
        "line 3: field `cloth.fabric`: no file `no.json` beside the scene or in the working directory"
    );
    assert_eq!(
        with("[simulation]\nthickness_m = -1"),
        "line 4: field `simulation.thickness_m`: must be a number above 0, not -1"
    );
    assert_eq!(with("[simulation]\nstep_s = 0"), "line 4: field `simulation.step_s`: must be a number above 0, not 0");
    assert_eq!(
        with("[simulation]\nstep_s = nan"),
        "line 4: field `simulation.step_s`: must be a number above 0, not nan"
    );
    assert_eq!(
        with("[simulation]\nframe_s = 0.0055\nstep_s = 0.004"),
        "line 4: field `simulation.frame_s`: must be a whole number of steps of 0.004 s; step_s = 0.002750000 makes it 2 steps"
    );
    assert_eq!(
        with("[simulation]\ngravity_m_s2 = [0, 1]"),
        "line 4: field `simulation.gravity_m_s2`: must be an array of 3 numbers, not a value of type array"
    );
    assert_eq!(
        with("[simulation]\nframes = -1"),
        "line 4: field `simulation.frames`: must be a whole number from 0 to 10000000, not -1"
    );
    assert_eq!(
        fault("[[cloth]]\nmesh = \"no.obj\""),
        "line 2: field `cloth.mesh`: no file `no.obj` beside the scene or in the working directory"
    );
    assert_eq!(
        fault("[[cloth]]\nname = \"a\""),
        "line 1: field `cloth`: a cloth needs one of `sheet = { size_m = [w, h] }`, \
         `garment = { kind = \"dress\" }` and `mesh = \"file.obj\"`"
    );
    assert_eq!(
        fault("[[cloth]]\nsheet = { size_m = [1, -1] }"),
        "line 2: field `cloth.sheet.size_m`: both sides must be above 0"
    );
    assert_eq!(
        with("[[cloth]]\nname = \"b\""),
        "line 3: field `cloth[1]`: a cloth needs one of `sheet = { size_m = [w, h] }`, \
         `garment = { kind = \"dress\" }` and `mesh = \"file.obj\"`"
    );
}

#[test]
fn mistakes_of_pins_name_line_and_field() {
    let with = |rest: &str| fault(&format!("{SHEET}[[pin]]\n{rest}"));
    assert_eq!(
        with(""),
        "line 3: field `pin`: a pin needs exactly one of corners, edge, vertices, group, property, box_m, sphere, \
         nearest, not 0"
    );
    assert_eq!(
        with("corners = \"middle\""),
        "line 4: field `pin.corners`: must be one of bottom-left, bottom-right, top-left, top-right, not \"middle\""
    );
    assert_eq!(
        with("vertices = [0, 9]"),
        "line 4: field `pin.vertices[1]`: `cloth 0` has no vertex 9 (they count from 0)"
    );
    assert_eq!(with("box_m = [[5, 5, 5], [6, 6, 6]]"), "line 4: field `pin.box_m`: selects no vertex of `cloth 0`");
    assert_eq!(with("corners = \"top-left\"\nevery = 2"), "line 5: field `pin.every`: belongs to a pin with an `edge`");
    assert_eq!(with("edge = \"top\"\nstart_s = 2\nend_s = 1"), "line 6: field `pin.end_s`: must be after start_s = 2");
    assert_eq!(
        with("edge = \"top\"\nmotion = [{ time_s = 1 }, { time_s = 1 }]"),
        "line 5: field `pin.motion[1].time_s`: must be later than that of the keyframe before"
    );
    assert_eq!(
        with(
            "edge = \"top\"\nmotion = [{ time_s = 1, rotate_deg = [10, 1, 0, 0] }, { time_s = 2, rotate_deg = [360, 0, 1, 0] }]"
        ),
        "line 5: field `pin.motion[1].rotate_deg`: turns by 180 degrees or more since the keyframe before, about another axis; add one between"
    );
    assert_eq!(
        with("nearest = 3"),
        "line 4: field `pin.nearest`: a number needs `follow`: it selects what is nearest to that obstacle; give \
         `{ point_m = [x, y, z], count = n }` for what is nearest to a point"
    );
    assert_eq!(with("nearest = { count = 3 }"), "line 4: field `pin.nearest.point_m`: is missing");
    assert_eq!(
        with("edge = \"top\"\nstiffness_n_m = 0"),
        "line 5: field `pin.stiffness_n_m`: must be a number above 0, not 0"
    );
    assert_eq!(
        with("edge = \"top\"\nattach = \"table\""),
        "line 5: field `pin.attach`: no obstacle is named `table` (the scene has none)"
    );
    let table = "[[obstacle]]\nname = \"table\"\nbox = { center_m = [5, 0, 0], size_m = [1, 1, 1] }";
    assert_eq!(
        with(&format!("edge = \"top\"\nattach = \"table\"\nfollow = \"table\"\n{table}")),
        "line 5: field `pin.attach`: give either `follow` or `attach`"
    );
    assert_eq!(
        with(&format!("edge = \"top\"\nattach = \"table\"\nmotion = [{{ time_s = 1 }}]\n{table}")),
        "line 6: field `pin.motion`: give either `motion` or `attach`"
    );
    assert_eq!(
        with("edge = \"top\"\n[[pin]]\ncorners = \"top-left\"\nmotion = [{ time_s = 1 }]"),
        "line 3: field `pin`: vertex 6 is held by two pins at the same time that move it differently"
    );
}

#[test]
fn cloths_that_cross_at_the_start_are_refused() {
    let crossing = "[[cloth]]\nname = \"b\"\nsheet = { size_m = [1, 1], triangles = 8, mesh = \"grid\" }\n\
        plane = \"xz\"\norigin_m = [0.2, 0.3, 0.1]\n";
    assert_eq!(
        fault(&format!("{SHEET}{crossing}")),
        "line 1: field `cloth`: triangle 1 of `cloth 0` and triangle 1 of `b` cross or touch at the start, and 6 more pairs do; \
         move them apart (`loomtree check scenes/x.toml --write-crossings crossings.obj` writes a mesh of them)"
    );
    read(&format!("{SHEET}{}", crossing.replace("0.1]", "-0.1]"))).unwrap();
}

#[test]
fn files_that_are_no_scene() {
    let refused = |path: &str| load(Path::new(path), &Overrides::default()).unwrap_err().to_string();
    assert_eq!(refused("no/such.toml"), "no/such.toml: cannot be read: No such file or directory (os error 2)");
    assert_eq!(
        refused("src"),
        "src: its name says no format: a scene ends in .toml (ARCSim's in .json), a mesh in .obj or .ply"
    );
    assert_eq!(
        refused("Cargo.lock"),
        "Cargo.lock: its name says no format: a scene ends in .toml (ARCSim's in .json), a mesh in .obj or .ply"
    );
    let overrides = Overrides { resolution: Some(1), frames: None };
    let error = parse(SHEET, Path::new("x.toml"), &overrides).unwrap_err().to_string();
    assert_eq!(error, "x.toml: the resolution must be from 2 to 20000000 triangles, not 1");
}
