//! Import of ARCSim scenes and fabrics: a scene made here in all its fields, and every file of the third-party data
//! (found through `LOOMTREE_TEST_DATA`).

use std::path::{Path, PathBuf};

use loomtree::math::Vec3;
use loomtree::scene::{Obstacles, Overrides, Plasticity, Scene, StrainLimit, load, load_fabric};

const OBJ: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n";
const HALF_UV: &str =
    "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt .5 0\nvt .5 .5\nvt 0 .5\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n";
const FABRIC: &str = "// measured\n{\"density\": 0.2, \"stretching\": [[10,1,20,5],[10,1,20,5],[10,1,20,5],[10,1,20,5],[10,1,20,5],[10,1,20,5]],
    \"bending\": [[1e-6,2e-6,3e-6,4e-6,5e-6],[1e-6,2e-6,3e-6,4e-6,5e-6],[1e-6,2e-6,3e-6,4e-6,5e-6]]}";

/// Writes ARCSim's folders with a scene of this text and loads it.
fn import(scene: &str) -> Result<Scene, String> {
    let folder = tempfile::tempdir().unwrap();
    for (name, text) in
        [("conf/s.json", scene), ("meshes/m.obj", OBJ), ("meshes/half_uv.obj", HALF_UV), ("materials/f.json", FABRIC)]
    {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }
    let path = folder.path().join("conf/s.json");
    let place = format!("{}/", folder.path().display());
    load(&path, &Overrides::default()).map_err(|error| error.to_string().replace(&place, ""))
}

#[test]
fn every_field_arrives() {
    let scene = import(
        r#"{
        // comments and trailing commas are fine
        "frame_time": 0.04, "frame_steps": 8, "end_time": 2, "end_frame": 40,
        "cloths": [{
            "mesh": "meshes/m.obj",
            "transform": {"translate": [0, 0, 1], "rotate": [90, 0, 0, 1], "scale": 2},
            "velocity": {"linear": [0, 0, 1], "angular": [0, 0, 1]},
            "materials": [{"data": "materials/f.json", "thicken": 2, "bending_mult": 3, "damping": 0.01,
                           "strain_limits": [0.9, 1.1], "yield_curv": 200, "weakening": 0.5}],
            "remeshing": {"size": [1, 2]},
        }],
        "motions": [[{"time": 0, "transform": {"translate": [1, 0, 0]}}, {"time": 1, "transform": {"translate": [2, 0, 0]}}]],
        "handles": [{"nodes": [0]}, {"nodes": [3], "motion": 0, "end_time": 1.5}, {"type": "circle"}],
        "gravity": [0, 0, -9.8], "wind": {"velocity": [5, 0, 0], "drag": 0.5},
        "disable": ["popfilter"],
        "obstacles": [{"mesh": "meshes/none.obj"},
            {"mesh": "meshes/m.obj", "transform": {"translate": [9, 0, 0], "scale": 3}, "motion": 0, "end_time": 3}],
        "obs_friction": 0.2,
        "magic": {"repulsion_thickness": 5e-3, "collision_stiffness": 1e6},
        "colour": "red",
        }"#,
    )
    .unwrap();
    let settings = &scene.settings;
    assert_eq!((settings.step_s, settings.steps_per_frame, settings.frames), (0.005, 8, 40));
    assert_eq!((settings.gravity_m_s2, settings.wind_m_s), (Vec3::new(0.0, 0.0, -9.8), Vec3::new(5.0, 0.0, 0.0)));
    assert_eq!((settings.air_density_kg_m3, settings.air_drag_kg_m2_s), (1.0, 0.5));
    assert_eq!((settings.thickness_m, settings.friction), (5e-3, 0.6));

    let fabric = &scene.fabrics[0];
    assert_eq!((fabric.name.as_str(), fabric.density_kg_m2, fabric.damping_s), ("f", 0.4, 0.01));
    assert_eq!((fabric.stretching_n_m[0], fabric.bending_n_m[0][0]), ([20.0, 2.0, 40.0, 10.0], 6e-6));

    assert_eq!(fabric.strain_limit, Some(StrainLimit::Every([0.9, 1.1])));
    let plasticity = Plasticity { yield_curvature_1_m: 200.0, hardening: 0.0, weakening: 0.5, ..Plasticity::NONE };
    assert_eq!(fabric.plasticity, Some(plasticity));

    assert!(scene.mesh.positions[1].distance(Vec3::new(0.0, 2.0, 1.0)) < 1e-6);
    assert_eq!(scene.mesh.material_uv[0][1].distance(scene.mesh.material_uv[0][0]), 2.0);
    assert!(scene.velocities[1].distance(Vec3::new(-2.0, 0.0, 1.0)) < 1e-6);

    let pins: Vec<_> = scene.pins.iter().map(|pin| (pin.vertex, pin.motion, pin.end_s)).collect();
    assert_eq!(pins, [(0, None, f64::INFINITY), (3, Some(0), 1.5)]);
    assert!(scene.motions[0].apply(1.0, Vec3::Z).distance(Vec3::new(1.0, 0.0, 1.0)) < 1e-6);

    let [obstacle] = &scene.obstacles[..] else { panic!("one obstacle") };
    assert_eq!((obstacle.name.as_str(), obstacle.friction, obstacle.moving()), ("obstacles[1]", 0.2, true));
    assert_eq!(obstacle.positions[1], Vec3::new(12.0, 0.0, 0.0));
    let (obstacles, mut positions) = (Obstacles::new(&scene.obstacles), Vec::new());
    for (time_s, x) in [(0.0, 10.0), (1.0, 11.0)] {
        obstacles.positions_at(time_s, &mut positions);
        assert_eq!(positions[..3], [x, 0.0, 0.0], "the motion puts it into the world, at {time_s} s");
    }
    assert_eq!((settings.collisions, settings.contact_stiffness), (true, 8.0));

    assert_eq!(
        scene.left_out,
        [
            "remeshing: left out, the mesh keeps its triangles",
            "obstacles[0]: left out, there is no file `meshes/none.obj`",
            "obstacles[1].end_time: left out, an obstacle is there all the time",
            "handles[2]: left out, only handles with a list of `nodes` are known here",
            "colour: left out, this importer does not know it",
            "collision_stiffness: left out, a number of ARCSim's own methods (magic)",
        ]
    );
}

#[test]
fn limits_and_plasticity_can_be_disabled_and_must_make_sense() {
    let fabric = |material: &str, rest: &str| {
        let cloth = format!("{{mesh: 'meshes/m.obj', materials: [{{data: 'materials/f.json', {material}}}]}}");
        import(&format!("{{frame_time: 1, duration: 1, cloths: [{cloth}], {rest}}}"))
            .map(|mut scene| scene.fabrics.remove(0))
    };
    let both = "strain_limits: [0.95, 1.05], yield_curv: 200";
    let off = fabric(both, "disable: ['strainlimiting', 'plasticity']").unwrap();
    assert_eq!((off.strain_limit, off.plasticity), (None, None));
    assert!(fabric(both, "").unwrap().plasticity.is_some_and(|plasticity| plasticity.weakening == 0.0));
    assert_eq!(fabric("weakening: 1", "").unwrap().plasticity, None, "without a yield curvature nothing yields");
    let stretches = fabric("yield_stretch: 1.25, weakening: 2", "").unwrap().plasticity;
    let expected = Plasticity { yield_strain: 0.25, weakening: 2.0, ..Plasticity::NONE };
    assert_eq!(stretches, Some(expected));
    for (material, what) in [
        ("strain_limits: [1.05]", "field `cloths[0].materials[0].strain_limits`: must be an array of 2 numbers"),
        ("strain_limits: [1.05, 0.95]", "the strain limit must be two stretches"),
        (
            "yield_stretch: 1",
            "field `cloths[0].materials[0].yield_stretch`: must be a stretch (length / length at rest) above",
        ),
        ("yield_curv: 0", "field `cloths[0].materials[0].yield_curv`: must be a number above 0"),
    ] {
        let error = fabric(material, "").unwrap_err();
        assert!(error.contains(what), "{error}");
    }
}

#[test]
fn texture_coordinates_of_another_size_are_named() {
    let scene = |mesh: &str, scale: f64| {
        let cloth = format!(
            "{{mesh: 'meshes/{mesh}', transform: {{scale: {scale}}}, materials: [{{data: 'materials/f.json'}}]}}"
        );
        import(&format!("{{frame_time: 1, duration: 1, cloths: [{cloth}]}}")).unwrap().warnings
    };
    assert_eq!(scene("m.obj", 2.0), [""; 0]);
    let [warning] = &scene("half_uv.obj", 2.0)[..] else { panic!("one warning") };
    assert!(warning.contains("cover 1 m^2 where the mesh has 4 m^2 in space"), "{warning}");
    assert!(warning.contains("as in ARCSim") && warning.contains("`material = \"shape\"`"), "{warning}");
}

#[test]
fn mistakes_name_the_field() {
    let cloth = r#"{"mesh": "meshes/m.obj", "materials": [{"data": "materials/f.json"}]}"#;
    let with = |rest: &str| import(&format!("{{\"frame_time\": 1, \"cloths\": [{cloth}], {rest}}}")).unwrap_err();
    assert_eq!(import("{").unwrap_err(), "conf/s.json, line 1: EOF parsing object");
    assert_eq!(import("{}").unwrap_err(), "conf/s.json: field `cloths`: is missing");
    assert_eq!(import("{cloths: []}").unwrap_err(), "conf/s.json: field `cloths`: a scene needs at least one cloth");
    assert_eq!(
        import("{cloths: [{mesh: 'meshes/no.obj'}]}").unwrap_err(),
        "conf/s.json: field `cloths[0].mesh`: no file `meshes/no.obj` beside the scene, in the folder above or in the working directory"
    );
    assert_eq!(import(&format!("{{cloths: [{cloth}]}}")).unwrap_err(), "conf/s.json: field `frame_time`: is missing");
    assert_eq!(with("frame_steps: 0"), "conf/s.json: field `frame_steps`: must be a whole number of at least 1");
    assert_eq!(
        with("magic: {repulsion_thickness: -1}"),
        "conf/s.json: field `magic.repulsion_thickness`: must be a number above 0"
    );
    assert_eq!(
        with("handles: [{nodes: [4]}]"),
        "conf/s.json: field `handles[0].nodes[0]`: `cloths[0]` has no vertex 4 (they count from 0)"
    );
    assert_eq!(
        with("handles: [{nodes: [1], motion: 3}], motions: {motfile: 'meshes/gone.mot', fps: 25}"),
        "conf/s.json: field `handles[0].motion`: its motion is in `meshes/gone.mot`, which is neither beside the scene, in the \
         folder above nor in the working directory"
    );
    assert_eq!(
        with("obstacles: [{mesh: 'meshes/m.obj', transform: {translate: [5, 0, 0]}, motion: 2}]"),
        "conf/s.json: field `obstacles[0].motion`: the scene has no `motions`"
    );
    assert_eq!(
        with("obstacles: [{mesh: 'meshes/m.obj', transform: {scale: 0}}]"),
        "conf/s.json: field `obstacles[0].mesh`: at its place in the scene: triangle 1 has no area in space: its corners lie on one line"
    );
    assert_eq!(
        with("obstacles: 'meshes/body.obj'"),
        "conf/s.json: field `obstacles`: `meshes/body.obj` must have one number in it, as in `body%04d.obj`"
    );
    assert_eq!(
        with("obstacles: [{mesh: 'meshes/m.obj'}]"),
        "conf/s.json: field `cloths`: triangle 1 of `cloths[0]` and triangle 1 of obstacle `obstacles[0]` cross or touch at the \
         start, and 3 more pairs do; move them apart (`loomtree check conf/s.json --write-crossings crossings.obj` writes a mesh \
         of them)"
    );
    assert!(
        import(&format!(
            "{{frame_time: 1, cloths: [{cloth}], disable: ['collision'], obstacles: [{{mesh: 'meshes/m.obj'}}]}}"
        ))
        .is_ok_and(|scene| !scene.settings.collisions)
    );
}

#[test]
fn body_parts_follow_the_motions_of_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let mot = "NumFrames: 3\nbody[0] position\n0 0 0\n0 0 1\n0 0 2\n\nbody[0] orientation\n1 0 0 0\n1 0 0 0\n1 0 0 0\n\n\
        body[1] position\n0 0 0\n0 0 0\n0 0 0\n\nbody[1] orientation\n1 0 0 0\n0 0 0 1\n0 0 0 1\n";
    let scene = r#"{"frame_time": 1, "end_time": 1, "cloths": [{"mesh": "m.obj", "materials": [{"data": "f.json"}]}],
        "obstacles": "body%02d.obj", "motions": {"motfile": "parts.mot", "fps": 2, "transform": {"translate": [0, 0, 5]}},
        "handles": [{"nodes": [2], "motion": 0}]}"#;
    let files = [
        ("s.json", scene),
        ("m.obj", OBJ),
        ("f.json", FABRIC),
        ("body00.obj", OBJ),
        ("body01.obj", OBJ),
        ("parts.mot", mot),
    ];
    for (name, text) in files {
        std::fs::write(folder.path().join(name), text).unwrap();
    }
    let scene = load(&folder.path().join("s.json"), &Overrides::default()).unwrap();
    let names: Vec<&str> = scene.obstacles.iter().map(|obstacle| obstacle.name.as_str()).collect();
    assert_eq!(names, ["body00.obj", "body01.obj"]);
    let (obstacles, mut positions) = (Obstacles::new(&scene.obstacles), Vec::new());
    let mut second_corner = |part: usize, time_s: f64| {
        obstacles.positions_at(time_s, &mut positions);
        Vec3::from_slice(&positions[12 * part + 3..])
    };
    for (part, time_s, expected) in
        [(0, 0.0, [1.0, 0.0, 5.0]), (0, 0.5, [1.0, 0.0, 6.0]), (1, 0.5, [-1.0, 0.0, 5.0]), (0, 9.0, [1.0, 0.0, 7.0])]
    {
        let found = second_corner(part, time_s);
        assert!(found.distance(Vec3::from(expected)) < 1e-6, "part {part} at {time_s} s: {found}");
    }
    // The handle moves by the change since it took hold.
    assert!(scene.motions[0].apply(0.5, Vec3::ONE).distance(Vec3::new(1.0, 1.0, 2.0)) < 1e-6);
}

#[test]
fn the_sphere_conf_keeps_its_obstacle() {
    let Some(root) = std::env::var_os("LOOMTREE_TEST_DATA") else {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
        return;
    };
    let scene = load(&Path::new(&root).join("arcsim/conf/sphere.json"), &Overrides::default()).unwrap();
    let obstacles = Obstacles::new(&scene.obstacles);
    assert_eq!((obstacles.len(), obstacles.triangles().len(), obstacles.friction(0)), (1, 1280, 0.3));
    assert!(obstacles.moving() && scene.left_out.iter().all(|line| !line.contains("obstacle")));
    let mut positions = Vec::new();
    for (time_s, y) in [(0.0, 0.0), (3.0, -1.5), (5.0, 1.5), (9.0, -0.4)] {
        obstacles.positions_at(time_s, &mut positions);
        for p in positions.chunks_exact(3).map(Vec3::from_slice) {
            let radius = p.distance(Vec3::new(0.0, y, 0.0));
            assert!((radius - 0.1).abs() < 1e-3, "{radius} at {time_s} s");
        }
    }
}

fn files(folder: &str) -> Vec<PathBuf> {
    let Some(root) = std::env::var_os("LOOMTREE_TEST_DATA") else {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
        return Vec::new();
    };
    let folder = Path::new(&root).join(folder);
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "json"));
    assert!(!files.is_empty());
    files
}

#[test]
fn every_conf_loads_or_says_why_not() {
    for path in files("arcsim/conf") {
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        match load(&path, &Overrides::default()) {
            Ok(scene) => {
                assert!(!name.starts_with("dress"));
                assert!(
                    scene.left_out.iter().any(|line| line.starts_with("remeshing")),
                    "{name}: {:?}",
                    scene.left_out
                );
                assert_eq!(scene.velocities.len(), scene.mesh.positions.len());
            }
            // The meshes of the dresses are not among the data.
            Err(error) => assert!(
                name.starts_with("dress") && error.to_string().contains("no file `meshes/dress"),
                "{name}: {error}"
            ),
        }
    }
}

#[test]
fn every_fabric_loads() {
    for path in files("arcsim/materials") {
        let fabric = load_fabric(&path).unwrap();
        assert_eq!(fabric.name, path.file_stem().unwrap().to_string_lossy());
        assert!(fabric.density_kg_m2 > 0.05 && fabric.density_kg_m2 < 0.5);
    }
}
