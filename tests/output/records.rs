//! Records of a run: state hash, scene fingerprint, report and recipe.

use std::fs;
use std::path::Path;

use loomtree::impact_zone::ZoneCounts;
use loomtree::math::{DVec3, Vec2, Vec3};
use loomtree::mesh::TriangleMesh;
use loomtree::model::{LetGo, PlasticCounts, State};
use loomtree::output::*;
use loomtree::scene::{Cloth, Fabric, Pin, Scene, Settings};
use loomtree::step::{QueryStats, StageSeconds};
use proptest::prelude::*;

fn run_directory(folder: &tempfile::TempDir) -> RunDirectory {
    RunDirectory::create(&folder.path().join("run"), Existing::Refuse).unwrap()
}

#[test]
fn state_hash_has_a_known_value_and_feels_every_bit() {
    // xxh3_64 of no bytes is the published 2d06800538d394c2.
    assert_eq!(State::default().hash(), "2d06800538d394c2");
    let state = State {
        positions: vec![Vec3::new(1.0, 2.0, 3.0), Vec3::new(-4.0, 0.5, 0.0)],
        velocities: vec![Vec3::ZERO, Vec3::new(0.0, 0.0, 9.0)],
        ..State::default()
    };
    let hash = state.hash();
    assert_eq!(hash, "4ce35b4d826ae86d");
    let State { positions, velocities, .. } = state.clone();
    assert_ne!(hash, State { positions: velocities, velocities: positions, ..State::default() }.hash());
    assert_ne!(hash, State { let_go: vec![LetGo { vertex: 0, obstacle: 0, inside: 0 }], ..state.clone() }.hash());
    assert_ne!(hash, State { creases: vec![[0.0; 2]], ..state.clone() }.hash());
    assert_ne!(hash, State { stretches: vec![[0.0; 4]], ..state.clone() }.hash());
    for (vertex, bit) in (0..2).flat_map(|vertex| (0..96).map(move |bit| (vertex, bit))) {
        for field in 0..2 {
            let mut changed = state.clone();
            let values = if field == 0 { &mut changed.positions } else { &mut changed.velocities };
            let component = &mut values[vertex][bit / 32];
            *component = f32::from_bits(component.to_bits() ^ 1 << (bit % 32));
            assert_ne!(changed.hash(), hash, "bit {bit} of vertex {vertex}, field {field}");
        }
    }
    let zeros = State::zeros(1, PlasticCounts::default());
    assert_ne!(zeros.hash(), State { velocities: vec![-Vec3::ZERO], ..zeros.clone() }.hash());
}

fn step_record(step: u64) -> StepRecord {
    let stage_seconds = StageSeconds { solve: 0.25, total: 0.5, ..StageSeconds::default() };
    let memory_bytes_per_rank = vec![1000, 2000];
    StepRecord {
        step,
        frame: step as u32,
        iterations: 31,
        residual: 0.0098,
        stage_seconds,
        memory_bytes_per_rank,
        ..StepRecord::default()
    }
}

/// Programs read these names.
#[test]
fn the_fields_of_a_step_keep_their_names() {
    let ranks = [QueryStats { tests: 5, pairs: 2, batches: 1, ..QueryStats::default() }; 2];
    let proximity = QueryRecord::of(ranks.iter().zip([700, 900]));
    let zones = ZoneCounts { zones: 1, impacts: 2, rounds: 3, largest: 4, iterations: 5, fail_safes: 6, halvings: 7 };
    let record = StepRecord { proximity, zones, ..step_record(3) };
    let json = serde_json::to_value(&record).unwrap();
    assert_eq!(serde_json::from_value::<StepRecord>(json.clone()).unwrap(), record);
    let keys = |value: &serde_json::Value| {
        let mut keys: Vec<&str> = value.as_object().unwrap().keys().map(String::as_str).collect();
        keys.sort_unstable();
        keys.join(" ")
    };
    assert_eq!(
        keys(&json),
        "bytes_moved bytes_per_spmv collision_mesh_bytes_per_rank contacts continuous converged fail_safes frame halvings \
         impacts iterations largest_zone memory_bytes_per_rank proximity resident_bytes_per_rank residual smallest_gap_m \
         stage_seconds step substeps time_s zone_iterations zone_rounds zones"
    );
    assert_eq!(
        keys(&json["proximity"]),
        "batches broad_s bytes_per_rank found narrow_s pairs patches tests tests_per_rank"
    );
    assert_eq!(
        keys(&json["stage_seconds"]),
        "advance contacts continuous elements exchange index_fill positions proximity solve total value_fill zones"
    );
    let counts = ["zones", "impacts", "zone_rounds", "largest_zone", "zone_iterations", "fail_safes", "halvings"];
    assert_eq!(counts.map(|key| json[key].as_u64().unwrap()), [1, 2, 3, 4, 5, 6, 7]);
    assert_eq!((&json["proximity"]["tests"], &json["proximity"]["batches"]), (&10.into(), &1.into()));
    assert_eq!(json["proximity"]["tests_per_rank"], serde_json::json!([5, 5]));
    assert_eq!(json["proximity"]["bytes_per_rank"], serde_json::json!([700, 900]));
}

fn frame_record(frame: u32) -> FrameRecord {
    FrameRecord { frame, time_s: f64::from(frame) / 250.0, state_hash: "00ff".to_string(), ..FrameRecord::default() }
}

#[test]
fn a_report_takes_frames_and_steps_in_any_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report.json");
    let mut writer = ReportWriter::create(&path, ReportHeader::now()).unwrap();
    for number in [3, 1, 4, 2] {
        writer.step(StepRecord { session: number as usize % 2, ..step_record(number) });
        writer.frame(frame_record(number as u32)).unwrap();
    }
    let report = writer.finish(Status::Done).unwrap();
    assert_eq!(Report::load(&path).unwrap(), report);
    assert_eq!(report.frames.iter().map(|record| record.frame).collect::<Vec<_>>(), [1, 2, 3, 4]);
    assert_eq!(report.steps.iter().map(|record| record.step).collect::<Vec<_>>(), [1, 2, 3, 4]);
    // Only who is not on the first session says so: other readers know no sessions.
    let sessions = report.steps.iter().map(|record| serde_json::to_value(record).unwrap()["session"].clone());
    assert_eq!(
        sessions.collect::<Vec<_>>(),
        [serde_json::json!(1), serde_json::Value::Null, 1.into(), serde_json::Value::Null]
    );
}

#[test]
fn a_report_is_valid_from_the_start_and_resumes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("report.json");
    let mut header = ReportHeader { scene: "flag \"x\"".to_string(), workers: 2, ..ReportHeader::now() };
    header.set_gravity([0.0, 0.0, -9.8]);
    let mut writer = ReportWriter::create(&path, header.clone()).unwrap();
    let started = Report::load(&path).unwrap();
    assert_eq!(started, Report { header: header.clone(), ..Report::default() });
    assert_eq!((started.header.status, started.header.up_axis.as_str()), (Status::Running, "z"));
    assert!(started.header.machine.cores > 0);

    for step in 1..=4 {
        writer.step(step_record(step));
        writer.frame(frame_record(step as u32)).unwrap();
    }
    let finished = writer.finish(Status::Failed("rank 1 stopped answering".to_string())).unwrap();
    assert_eq!(Report::load(&path).unwrap(), finished);
    let json: serde_json::Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    assert_eq!(json["status"], "failed: rank 1 stopped answering");
    assert_eq!(json["steps"][3]["stage_seconds"]["solve"], 0.25);
    assert_eq!(json["frames"][0], serde_json::json!({"frame": 1, "time_s": 0.004, "state_hash": "00ff"}));

    let again = ReportHeader { workers: 8, ..ReportHeader::now() };
    let mut writer = ReportWriter::resume(&path, again, 2, 2).unwrap();
    writer.step(StepRecord { residual: f64::NAN, ..step_record(3) });
    writer.finish(Status::Done).unwrap();
    let resumed = Report::load(&path).unwrap();
    assert_eq!(resumed.frames, [frame_record(1), frame_record(2)]);
    assert_eq!(resumed.steps[..2], [step_record(1), step_record(2)]);
    assert!(resumed.steps[2].residual.is_nan());
    assert_eq!(resumed.header.started_unix_s, header.started_unix_s);
    assert_eq!((resumed.header.workers, resumed.header.resumed[0].workers, resumed.header.resumed[0].step), (8, 8, 2));

    fs::write(&path, b"{\"scene\": 3}").unwrap();
    let error = Report::load(&path).unwrap_err().to_string();
    assert!(error.contains("is not a report of a run: invalid type: integer `3`, expected a string"), "{error}");
}

#[test]
fn the_fingerprint_covers_what_decides_the_future() {
    let mut base = scene();
    base.cloths =
        vec![Cloth { name: "sheet".to_string(), vertices: 0..4, triangles: 0..2, friction: 0.3, pressure_pa: 0.0 }];
    let hash = scene_fingerprint(&base);
    let changed = |change: fn(&mut Scene)| {
        let mut scene = base.clone();
        change(&mut scene);
        scene_fingerprint(&scene)
    };
    assert_eq!(changed(|s| s.settings.frames = 900), hash, "a run may be prolonged");
    assert_eq!(changed(|s| s.name = "other".to_string()), hash);
    let changes: [fn(&mut Scene); 8] = [
        |s| s.settings.step_s *= 1.0 + f64::EPSILON,
        |s| s.mesh.triangles[1] = [2, 3, 0],
        |s| s.mesh.material_uv[0][1].x = 1.5,
        |s| s.fabrics[0].stretching_n_m[5][3] = 1.0,
        |s| s.fabric_of_triangle[1] = 1,
        |s| s.pins[0].end_s = 2.0,
        |s| s.cloths[0].friction = 0.2,
        |s| s.cloths[0].pressure_pa = 5.0,
    ];
    for (i, change) in changes.into_iter().enumerate() {
        assert_ne!(changed(change), hash, "change {i} is not noticed");
    }
}

fn scene() -> Scene {
    let fabric = Fabric {
        name: "plain".to_string(),
        density_kg_m2: 0.2,
        stretching_n_m: [[50.0; 4]; 6],
        bending_n_m: [[1e-5; 5]; 3],
        damping_s: 0.0,
        plasticity: None,
        strain_limit: None,
    };
    let settings = Settings {
        step_s: 0.004,
        substeps: Default::default(),
        steps_per_frame: 1,
        frames: 100,
        gravity_m_s2: Vec3::new(0.0, 0.0, -9.8),
        wind_m_s: Vec3::ZERO,
        air_density_kg_m3: 1.2,
        air_drag_kg_m2_s: 0.0,
        relative_tolerance: 0.01,
        max_iterations: 500,
        preconditioner: Default::default(),
        thickness_m: 0.001,
        friction: 0.3,
        collisions: true,
        contact_stiffness: 8.0,
        over_time: Default::default(),
    };
    Scene {
        name: "two triangles".to_string(),
        origin_m: DVec3::ZERO,
        mesh: TriangleMesh {
            positions: vec![Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            material_uv: vec![[Vec2::ZERO, Vec2::X, Vec2::ONE], [Vec2::ZERO, Vec2::ONE, Vec2::Y]],
        },
        velocities: vec![Vec3::ZERO; 4],
        fabrics: vec![fabric],
        fabric_of_triangle: vec![0, 0],
        pins: vec![Pin::new(0, None, 0.0, f64::INFINITY)],
        motions: Vec::new(),
        followed: Vec::new(),
        cloths: Vec::new(),
        obstacles: Vec::new(),
        settings,
        maps: Default::default(),
        parts: Vec::new(),
        folds: Vec::new(),
        sewing: None,
        warnings: Vec::new(),
        left_out: Vec::new(),
    }
}

#[derive(Debug, PartialEq, serde::Serialize, serde::Deserialize)]
struct Flags {
    workers: usize,
    out: Option<String>,
    format: Vec<FrameFormat>,
}

#[test]
fn a_recipe_gives_back_flags_and_notices_changed_files() {
    let folder = tempfile::tempdir().unwrap();
    let directory = run_directory(&folder);
    let mesh = folder.path().join("sheet.obj");
    fs::write(&mesh, b"v 0 0 0").unwrap();
    let flags = Flags { workers: 4, out: None, format: vec![FrameFormat::Ply] };
    let mut manifest = RunManifest::new(Path::new("/scenes/flag.JSON"), "{ // a scene\r\n}", &flags).unwrap();
    manifest.add_input(&mesh).unwrap();
    manifest.save(&directory).unwrap();
    let loaded = RunManifest::load(&directory).unwrap();
    assert_eq!(loaded, manifest);
    assert_eq!(loaded.scene_file, "run_scene.json");
    assert_eq!(loaded.flags::<Flags>().unwrap(), flags);
    assert_eq!(loaded.changed_inputs(), Vec::<String>::new());
    fs::write(&mesh, b"v 0 0 1").unwrap();
    assert!(loaded.changed_inputs()[0].ends_with("sheet.obj has changed since the run was started"));

    let text = fs::read_to_string(directory.manifest()).unwrap();
    fs::write(directory.manifest(), text.replace("[flags]", "[falgs]")).unwrap();
    let error = RunManifest::load(&directory).unwrap_err().to_string();
    assert!(error.contains("run.toml, line ") && error.contains("unknown field `falgs`"), "{error}");
    fs::write(directory.manifest(), text.replace("run_scene.json", "../../etc/passwd")).unwrap();
    assert!(RunManifest::load(&directory).unwrap_err().to_string().contains("must be the name of a file"));
}

proptest! {
    #[test]
    fn a_recipe_keeps_the_scene_word_for_word(text in any::<String>()) {
        let folder = tempfile::tempdir().unwrap();
        let directory = run_directory(&folder);
        let mut manifest = RunManifest::new(Path::new("/scenes/flag.toml"), &text, &toml::Table::new()).unwrap();
        manifest.save(&directory).unwrap();
        prop_assert_eq!(RunManifest::load(&directory).unwrap(), manifest);
    }
}
