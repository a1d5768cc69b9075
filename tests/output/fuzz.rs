//! Every reader of files from outside on mutated files: a value or one sentence, never a panic, never a hang.
//!
//! Seeds are small valid files of every format. An input is made from a number alone, so that a failure names the
//! number and can be had again; [`KEPT`] holds the ones that once broke a reader. `.ci/campaign` runs millions of them.

use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::mpsc;
use std::time::Duration;

use loomtree::cli::ccd::{parse_queries, parse_truth};
use loomtree::coordinator::RunOptions;
use loomtree::input::Input;
use loomtree::interconnect::Topology;
use loomtree::linear_system::{parse_block_csr, parse_matrix_market, parse_right_hand_side};
use loomtree::math::{DVec3, Vec2, Vec3};
use loomtree::mesh::{MaterialSource, MeshOptions, TriangleMesh, first_intersection, parse_obj, parse_ply, validate};
use loomtree::model::{LetGo, State};
use loomtree::output::export::{Animation, Track, write_abc, write_usda, write_usdc};
use loomtree::output::pc2::{self, Pc2Writer};
use loomtree::output::{
    Checkpoint, Existing, FrameFormat, FrameSource, FrameWriter, Report, RunDirectory, RunManifest, checkpoint, obj,
    ply, read_trace,
};
use loomtree::scene::{self, Hold, Obstacles, Overrides, parse, parse_fabric};
use support::seeded::Seeded;

/// Far above what any of these inputs needs (milliseconds), far below a hang.
const LIMIT: Duration = Duration::from_secs(60);
/// Inputs of every seed in the normal suite.
const INPUTS: u64 = 150;
/// Seed and number of inputs that broke a reader once.
const KEPT: [(usize, u64); 0] = [];

/// What reads an input; `Err` is the sentence of the refusal.
type Reader = fn(&[u8]) -> Result<(), String>;

struct Seed {
    name: &'static str,
    bytes: Vec<u8>,
    read: Reader,
}

fn mesh(surface: Result<loomtree::mesh::Surface, loomtree::mesh::ParseFault>) -> Result<(), String> {
    let surface = surface.map_err(|fault| fault.to_string())?;
    for options in
        [MaterialSource::Auto.into(), MeshOptions { material: MaterialSource::Shape, weld: Some(0.1), unit_m: 1.0 }]
    {
        let file = surface.clone().into_mesh(options).map_err(|fault| fault.to_string())?;
        assert_eq!(validate(&file.mesh), Ok(()));
        first_intersection(&file.mesh);
        let triangles = file.mesh.triangles.len() as u32;
        assert!(file.parts.iter().all(|part| part.triangles.end <= triangles));
        file.warnings(Path::new("a.obj"), 1.0).iter().for_each(|line| assert_eq!(line.lines().count(), 1));
    }
    Ok(())
}

fn scene(bytes: &[u8], name: &str) -> Result<(), String> {
    let text = String::from_utf8_lossy(bytes);
    let overrides = Overrides { resolution: None, frames: Some(1) };
    parse(&text, Path::new(name), &overrides).map(|_| ()).map_err(|error| error.to_string())
}

/// Reads an input that its reader takes from a path.
fn from_file(name: &str, bytes: &[u8], read: impl Fn(&Path) -> Result<(), String>) -> Result<(), String> {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).expect("the input");
    // Refusals name the path, which differs from call to call.
    read(&path).map_err(|sentence| sentence.replace(&folder.path().display().to_string(), "."))
}

/// A checkpoint, read as it is and with the checksum of its content, which a reader verifies last.
fn checkpoint(bytes: &[u8]) -> Result<(), String> {
    let read = |bytes: &[u8]| Checkpoint::from_bytes(bytes).map(|_| ()).map_err(|error| error.to_string());
    let mut mended = bytes[..bytes.len().saturating_sub(8)].to_vec();
    mended.extend(xxhash_rust::xxh3::xxh3_64(&mended).to_le_bytes());
    read(&mended).and(read(bytes))
}

fn checkpoint_seed() -> Vec<u8> {
    let positions = vec![Vec3::ZERO, Vec3::X, Vec3::new(0.5, -1.0, 2.0)];
    let let_go = vec![LetGo { vertex: 1, obstacle: 2, inside: 0 }];
    let (creases, stretches) = (vec![[0.5, 2.0]; 2], vec![[1.5, 0.75, 0.25, 0.5]]);
    let holds = vec![Hold { vertex: 2, corners: [0, 1, 2], weights: [0.5, 0.5, 0.0], offset_m: [0.0; 3] }];
    let state = State { velocities: vec![Vec3::Y; positions.len()], positions, creases, stretches, let_go, holds };
    let whole = Checkpoint { frame: 2, step: 20, time_s: 0.08, fingerprint: 0x1234_5678_9abc_def0, state };
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::read(checkpoint::keep(folder.path(), &whole).expect("a checkpoint")).expect("its bytes")
}

/// ARCSim's `.mot` file as a scene reads it.
fn motion_file(bytes: &[u8]) -> Result<(), String> {
    const SCENE: &str = "{frame_time: 0.04, duration: 1, cloths: [{mesh: 'a.obj', materials: [{data: 'f.json'}]}],
        obstacles: [{mesh: 'a.obj', motion: 0}], motions: {motfile: 'a.mot', fps: 30}}";
    from_file("a.mot", bytes, |path| {
        let beside = |name: &str| path.with_file_name(name);
        std::fs::write(beside("a.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("a mesh");
        std::fs::write(beside("f.json"), FABRIC).expect("a fabric");
        scene::read_str(SCENE, &beside("a.json")).map(|_| ()).map_err(|error| error.to_string())
    })
}

/// A point cache of one triangle, as a run reads it again.
fn point_cache(bytes: &[u8]) -> Result<(), String> {
    from_file("cloth.pc2", bytes, |path| {
        let samples = pc2::samples(path).map_err(|error| error.to_string())?;
        pc2::read(path, samples.saturating_sub(1)).map_err(|error| error.to_string())?;
        Pc2Writer::open(path, 3, samples.clamp(1, 2)).map(|_| ()).map_err(|error| error.to_string())
    })
}

fn recipe(bytes: &[u8]) -> Result<(), String> {
    from_file("run.toml", bytes, |path| {
        let folder = path.parent().expect("its folder");
        std::fs::write(folder.join("run_scene.toml"), "").expect("a scene");
        let directory = RunDirectory::open(folder).map_err(|error| error.to_string())?;
        let recipe = RunManifest::load(&directory).map_err(|error| error.to_string())?;
        recipe.flags::<RunOptions>().map(|_| ()).map_err(|error| error.to_string())
    })
}

const FABRIC: &str = "{\"density\": 0.2, \"stretching\": [[1,0,1,1],[1,0,1,1],[1,0,1,1],[1,0,1,1],[1,0,1,1],\
    [1,0,1,1]],\n\"bending\": [[1,1,1,1,1],[1,1,1,1,1],[1,1,1,1,1]]}";
const RECIPE: &str = "version = \"0.1.0\"\nscene_path = \"/a/s.toml\"\nscene_file = \"run_scene.toml\"\ninputs = []\n\n\
    [flags]\ncheckpoint_every = 10\nexchange = \"halo\"\nformats = \"ply,pc2\"\nheartbeat_s = 10.0\n\
    keep_states = \"frames\"\nworkers = 2\n";
const REPORT: &str = r#"{
  "scene": "s", "version": "0.1.0", "workers": 1, "executor": "cpu", "devices": ["cpu, 1 thread"], "exchange": "halo",
  "schedule": "direct", "preconditioner": "schwarz", "topology": "t", "triangles": 60, "vertices": 42, "step_s": 0.004,
  "steps_per_frame": 10, "frames_wanted": 2, "gravity_m_s2": [0.0, -9.8, 0.0], "up_axis": "y",
  "machine": {"cores": 2, "cpu": "a", "memory_bytes": 25276502016, "system": "linux x86_64"},
  "started_unix_s": 1795991449, "ended_unix_s": 1795991450, "status": "done", "resumed": [],
  "frames": [
    {"frame":0,"time_s":0.0,"state_hash":"bab1c4bd27aeeb7d"}
  ],
  "steps": [
    {"step":1,"frame":1,"time_s":0.004,"iterations":5,"residual":0.0036,"converged":true,"stage_seconds":{"total":0.01},
     "bytes_moved":2616,"bytes_per_spmv":264,"contacts":0,"zones":0,"impacts":0,"smallest_gap_m":null}
  ]
}
"#;
const TRACE: &str = r#"[
{"ph":"M","name":"process_name","pid":0,"tid":0,"args":{"name":"rank 0 (cpu, 1 thread)"}},
{"ph":"X","name":"read state","cat":"transfer","pid":0,"tid":8,"ts":73.7,"dur":3,"args":{"step":1,"bytes":5,"flops":0}},
{"ph":"X","name":"all-reduce","cat":"wait","pid":1,"ts":7.5,"dur":2,"args":{"step":1,"asked_ts":7,"bytes":8,"flops":0}}
]
"#;

/// A body: its nodes, its clip, and where it is at some times.
fn body(name: &str, bytes: &[u8]) -> Result<(), String> {
    const SCENE: &str = "[simulation]\ncollisions = false\n[[cloth]]\nsheet = { size_m = [1, 1], triangles = 8 }\n\
        [[obstacle]]\nclip = \"0\"\nloop = true\ngltf = ";
    from_file(name, bytes, |path| {
        let scene = parse(&format!("{SCENE}\"{name}\""), &path.with_file_name("a.toml"), &Overrides::default());
        let obstacles = Obstacles::new(&scene.map_err(|error| error.to_string())?.obstacles);
        let mut out = Vec::new();
        [0.0, 0.3, 7.0].iter().for_each(|&time_s| obstacles.positions_at(time_s, &mut out));
        assert_eq!(out.len(), 3 * obstacles.vertices());
        Ok(())
    })
}

/// The obstacle in a stage or an archive.
fn moving(form: &str, name: &'static str, bytes: &[u8]) -> Result<(), String> {
    from_file(name, bytes, |path| {
        let text = format!(
            "[simulation]\ncollisions = false\n[[cloth]]\nsheet = {{ size_m = [1, 1], triangles = 8 }}\n\
             [[obstacle]]\nloop = true\n{form} = \"{name}\"\n"
        );
        let scene = parse(&text, &path.with_file_name("a.toml"), &Overrides::default());
        let obstacles = Obstacles::new(&scene.map_err(|error| error.to_string())?.obstacles);
        let mut out = Vec::new();
        [0.0, 0.3, 7.0].iter().for_each(|&time_s| obstacles.positions_at(time_s, &mut out));
        assert_eq!(out.len(), 3 * obstacles.vertices());
        Ok(())
    })
}

/// A triangle in three frames, as stages and an archive.
fn moving_seeds() -> Vec<Seed> {
    let folder = tempfile::tempdir().expect("a folder");
    let directory = RunDirectory::create(&folder.path().join("run"), Existing::Refuse).expect("a run");
    let mesh = TriangleMesh {
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
        triangles: vec![[0, 1, 2]],
        material_uv: vec![[Vec2::ZERO, Vec2::X, Vec2::Y]],
    };
    let mut writer = FrameWriter::new(&directory, &[FrameFormat::Ply], &mesh, 0).expect("a writer");
    for frame in 0..3u8 {
        let moved: Vec<Vec3> = mesh.positions.iter().map(|p| *p + Vec3::splat(f32::from(frame))).collect();
        writer.write(frame.into(), &mesh, &moved).expect("a frame");
    }
    let track =
        Track { name: "t".into(), obstacle: false, vertices: 0..3, triangles: 0..1, uv: mesh.material_uv.clone() };
    let animation = Animation {
        source: FrameSource::open(&directory).expect("frames"),
        folder: folder.path().into(),
        frames_per_s: 10.0,
        z_up: false,
        tracks: vec![track],
        values: None,
    };
    let at = |name: &str| folder.path().join(name);
    write_usda(&at("t.usda"), &animation).expect("a stage");
    write_usdc(&at("t.usdc"), &animation).expect("a stage");
    write_abc(&at("t.abc"), &animation).expect("an archive");
    let seed = |name: &'static str, read: Reader| Seed { name, bytes: std::fs::read(at(name)).expect("bytes"), read };
    vec![
        seed("t.usda", |bytes| moving("usd", "t.usda", bytes)),
        seed("t.usdc", |bytes| moving("usd", "t.usdc", bytes)),
        seed("t.abc", |bytes| moving("abc", "t.abc", bytes)),
    ]
}

/// A point cache of a triangle as an obstacle.
fn obstacle_cache(form: &str, bytes: &[u8]) -> Result<(), String> {
    from_file("c.cache", bytes, |path| {
        std::fs::write(path.with_file_name("r.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("a mesh");
        let rate = if form == "pc2" { "frames_per_s = 2\n" } else { "" };
        let text = format!(
            "[simulation]\ncollisions = false\n[[cloth]]\nsheet = {{ size_m = [1, 1], triangles = 8 }}\n\
             [[obstacle]]\nlead_in_s = 0.5\n{rate}{form} = {{ rest = \"r.obj\", cache = \"c.cache\" }}\n"
        );
        let scene = parse(&text, &path.with_file_name("a.toml"), &Overrides::default());
        let obstacles = Obstacles::new(&scene.map_err(|error| error.to_string())?.obstacles);
        let mut out = Vec::new();
        [0.0, 0.6, 7.0].iter().for_each(|&time_s| obstacles.positions_at(time_s, &mut out));
        assert!(out.len() == 9 && out.iter().all(|x| x.is_finite()));
        Ok(())
    })
}

fn mdd_seed() -> Vec<u8> {
    let mut bytes: Vec<u8> = [2i32, 3].iter().flat_map(|x| x.to_be_bytes()).collect();
    bytes.extend([0.0f32, 0.5].iter().flat_map(|x| x.to_be_bytes()));
    bytes.extend((0..18).flat_map(|i| ((i * i) as f32).to_be_bytes()));
    bytes
}

/// A triangle that hangs on two joints and has a morph target; `uri` = where its bytes are.
fn body_text(uri: &str) -> String {
    format!(
        r#"{{"asset": {{"version": "2.0"}}, "scenes": [{{"nodes": [0, 1]}}],
        "nodes": [{{"mesh": 0, "skin": 0, "weights": [0.5]}}, {{"children": [2]}}, {{"translation": [0, 1, 0]}}],
        "meshes": [{{"primitives": [{{"attributes": {{"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}}, "indices": 1,
            "targets": [{{"POSITION": 0}}]}}]}}], "skins": [{{"joints": [1, 2]}}],
        "animations": [{{"samplers": [{{"input": 4, "output": 3, "interpolation": "CUBICSPLINE"}}],
            "channels": [{{"sampler": 0, "target": {{"node": 2, "path": "rotation"}}}}]}}],
        "accessors": [
            {{"bufferView": 0, "count": 3, "componentType": 5126, "type": "VEC3"}},
            {{"bufferView": 0, "byteOffset": 36, "count": 3, "componentType": 5121, "type": "SCALAR"}},
            {{"bufferView": 0, "byteOffset": 40, "count": 3, "componentType": 5121, "type": "VEC4"}},
            {{"bufferView": 0, "byteOffset": 52, "count": 3, "componentType": 5126, "type": "VEC4"}},
            {{"bufferView": 0, "byteOffset": 0, "count": 1, "componentType": 5126, "type": "SCALAR",
                "sparse": {{"count": 1, "indices": {{"bufferView": 0, "byteOffset": 36, "componentType": 5121}},
                    "values": {{"bufferView": 0, "byteOffset": 12}}}}}}],
        "bufferViews": [{{"buffer": 0, "byteLength": 100}}], "buffers": [{{"byteLength": 100{uri}}}]}}"#
    )
}

fn body_bytes() -> Vec<u8> {
    let floats = |values: &[f32]| values.iter().flat_map(|x| x.to_le_bytes()).collect::<Vec<u8>>();
    let joints = [0, 1, 2, 0, 0, 1, 0, 0, 0, 1, 0, 0, 1, 0, 0, 0];
    let weights = [0.25, 0.75, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0];
    [floats(&[0., 0., 0., 1., 0., 0., 0., 1., 0.]), joints.to_vec(), floats(&weights)].concat()
}

fn body_seeds() -> [Seed; 2] {
    let bytes = body_bytes();
    let text = body_text("");
    let padded = format!("{text:<width$}", width = text.len().next_multiple_of(4));
    let length = |bytes: usize| (bytes as u32).to_le_bytes();
    let whole = 12 + 8 + padded.len() + 8 + bytes.len();
    let head = [&b"glTF"[..], &2u32.to_le_bytes(), &length(whole), &length(padded.len()), b"JSON"].concat();
    let binary = [&head[..], padded.as_bytes(), &length(bytes.len()), b"BIN\0", &bytes].concat();
    let alphabet = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let encoded: String =
        [&bytes[..], &[0; 2]].concat().as_chunks::<3>().0.iter().fold(String::new(), |text, three| {
            let bits = u32::from_be_bytes([0, three[0], three[1], three[2]]);
            [18, 12, 6, 0]
                .iter()
                .fold(text, |text, shift| text + &char::from(alphabet[(bits >> shift) as usize & 63]).to_string())
        });
    let uri = format!(", \"uri\": \"data:application/octet-stream;base64,{encoded}\"");
    [
        Seed { name: "glb", bytes: binary, read: |bytes| body("b.glb", bytes) },
        Seed { name: "gltf", bytes: body_text(&uri).into_bytes(), read: |bytes| body("b.gltf", bytes) },
    ]
}

/// Readers of the files that a run leaves and takes up again.
fn run_seeds() -> Vec<Seed> {
    let mut seeds = Vec::new();
    let mut add = |name, bytes: &[u8], read| seeds.push(Seed { name, bytes: bytes.to_vec(), read });
    add("checkpoint", &checkpoint_seed(), checkpoint);
    add("motion file", b"NumFrames: 2\na position\n0 1 2\n3 4 5\n\na\n1 0 0 0\n0 0 0 2\n\n", motion_file);
    add("run.toml", RECIPE.as_bytes(), recipe);
    add("report", REPORT.as_bytes(), |bytes| {
        from_file("report.json", bytes, |path| Report::load(path).map(|_| ()).map_err(|error| error.to_string()))
    });
    add("trace", TRACE.as_bytes(), |bytes| {
        from_file("trace.json", bytes, |path| read_trace(path).map(|_| ()).map_err(|error| error.to_string()))
    });
    let mut cache = b"POINTCACHE2\0".to_vec();
    [1i32, 3].iter().for_each(|x| cache.extend(x.to_le_bytes()));
    [0f32, 1.0].iter().for_each(|x| cache.extend(x.to_le_bytes()));
    cache.extend(2i32.to_le_bytes());
    (0..18).for_each(|i| cache.extend((i as f32).to_le_bytes()));
    add("point cache", &cache, point_cache);
    // Points that are not on one line.
    cache.truncate(32);
    (0..18).for_each(|i| cache.extend(((i * i) as f32).to_le_bytes()));
    add("pc2 obstacle", &cache, |bytes| obstacle_cache("pc2", bytes));
    add("mdd obstacle", &mdd_seed(), |bytes| obstacle_cache("mdd", bytes));
    seeds
}

fn seeds() -> Vec<Seed> {
    let mut seeds = Vec::new();
    let mut add = |name, bytes: &[u8], read| seeds.push(Seed { name, bytes: bytes.to_vec(), read });
    let obj_text = b"# a quad\\\no Coat\ng left arm\nv 0 0 0\nv 1 0 0\nv 1 1 0.1\nv 0 1 0\nv 2 0 0\nv .2e1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n\
        vt 0 1\nf 1/1 2/2 3/3 4/4\ng right\nf 2/2 -2/2 \\\n 6/3 3/3\n";
    add("obj", obj_text, |bytes| mesh(parse_obj(bytes)));
    let wide: Vec<u8> = [0xff, 0xfe].into_iter().chain(obj_text.iter().flat_map(|&c| [c, 0])).collect();
    add("input", &wide, |bytes| {
        let input =
            Input::decoded(Cursor::new(bytes.to_vec()), bytes.len() as u64).map_err(|error| error.to_string())?;
        mesh(parse_obj(input.reader))
    });
    let ply_text = "ply\nformat ascii 1.0\ncomment x\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty float s\n\
        property float t\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n0 1 0 0 1\n3 0 1 2\n3 0 2 3\n";
    add("ply", ply_text.as_bytes(), |bytes| mesh(parse_ply(bytes, bytes.len() as u64)));
    let strips = "ply\nformat ascii 1.0\nelement tristrips 1\nproperty list int int vertex_indices\nelement vertex 4\nproperty double x\n\
        property double y\nproperty double z\nend_header\n7 0 1 2 3 -1 0 1\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n";
    add("strips", strips.as_bytes(), |bytes| mesh(parse_ply(bytes, bytes.len() as u64)));
    let mut binary =
        ply_text[..ply_text.find("end_header").unwrap()].replace("ascii", "binary_little_endian").into_bytes();
    binary.extend(b"end_header\n");
    [[0.0f32, 0., 0.], [1., 0., 0.], [1., 1., 0.], [0., 1., 0.]].iter().for_each(|p| {
        p.iter().chain(&p[..2]).for_each(|x| binary.extend(x.to_le_bytes()));
    });
    for face in [[0u32, 1, 2], [0, 2, 3]] {
        binary.push(3);
        face.iter().for_each(|v| binary.extend(v.to_le_bytes()));
    }
    add("binary ply", &binary, |bytes| mesh(parse_ply(bytes, bytes.len() as u64)));
    add("frame ply", &binary, |bytes| ply::read(bytes).map(|_| ()).map_err(|error| error.to_string()));
    add("frame obj", obj_text, |bytes| obj::read(bytes, DVec3::ZERO).map(|_| ()).map_err(|error| error.to_string()));
    let toml = "resolution = 40\n[simulation]\nframe_s = 0.04\nthickness_m = 0.01\n[air]\nwind_m_s = [1, 0, 0]\n[[fabric]]\nname = \"a\"\ndensity_kg_m2 = 0.2\n\
        stretching_n_m = [1, 0, 1, 1]\nbending_n_m = 1e-5\n[[cloth]]\nname = \"b\"\nsheet = { size_m = [1, 2] }\nfabric = \"a\"\nrotate_deg = [9, 0, 1, 0]\n\
        [[pin]]\nedge = \"top\"\ncount = 3\nmotion = [{ time_s = 1, translate_m = [0, 1, 0] }]\n[[obstacle]]\n\
        sphere = { center_m = [0, 0, 9], radius_m = 1, triangles = 20 }\n";
    add("scene", toml.as_bytes(), |bytes| scene(bytes, "a.toml"));
    let json = "{ // comment\n frame_time: 0.04, frame_steps: 8, duration: 2,\n cloths: [{mesh: 'none.obj', transform: {translate: [0, 0, 1], scale: 2},\n\
        materials: [{data: 'none.json', thicken: 2}]}],\n handles: [{nodes: [0, 1], motion: 0}],\n motions: [[{time: 0}, {time: 1, transform: {rotate: [90, 0, 0, 1]}}]],\n\
        obstacles: 'body%04d.obj', gravity: [0, 0, -9.8], wind: {density: 1}, magic: {repulsion_thickness: 0.005}, disable: ['remeshing'] }";
    add("arcsim", json.as_bytes(), |bytes| scene(bytes, "a.json"));
    add("fabric", FABRIC.as_bytes(), |bytes| {
        parse_fabric(&String::from_utf8_lossy(bytes), Path::new("f.json"))
            .map(|_| ())
            .map_err(|error| error.to_string())
    });
    let market = "%%MatrixMarket matrix coordinate real symmetric\n% \u{e9}\n4 4 6\n1 1 4.0D+00\n2 2 4\n2 1 -1\n3 3 4e0\n4 4 4\n4 3 -1.5-1\n";
    add("matrix", market.as_bytes(), |bytes| {
        parse_matrix_market(bytes, bytes.len() as u64, "a.mtx").map(|_| ()).map_err(|error| error.to_string())
    });
    let mut bsr = b"CLTHBSR1".to_vec();
    [2u64, 2].iter().for_each(|x| bsr.extend(x.to_le_bytes()));
    [3u32, 8].iter().for_each(|x| bsr.extend(x.to_le_bytes()));
    [0u64, 1, 2].iter().for_each(|x| bsr.extend(x.to_le_bytes()));
    [0u32, 1].iter().for_each(|x| bsr.extend(x.to_le_bytes()));
    (0..18).for_each(|i| bsr.extend(if i % 9 % 4 == 0 { 2.0f64 } else { 0.0 }.to_le_bytes()));
    (0..6).for_each(|i| bsr.extend(f64::from(i).to_le_bytes()));
    add("block csr", &bsr, |bytes| {
        parse_block_csr(bytes, bytes.len() as u64, "a.bsr").map(|_| ()).map_err(|error| error.to_string())
    });
    add("right-hand side", b"%%MatrixMarket matrix array real general\n3 1\n1\n2.5d0\n-3e2\n", |bytes| {
        parse_right_hand_side(bytes, 3, "b.mtx").map(|_| ()).map_err(|error| error.to_string())
    });
    let queries = "0,1,1,2,-3,4,1\n".repeat(8);
    add("queries", queries.as_bytes(), |bytes| parse_queries(bytes).map(|_| ()).map_err(|fault| fault.to_string()));
    add("truth", b"i,hit_f32,toi_f32\n0,1,0.5\n1,0,\n", |bytes| {
        parse_truth(bytes).map(|_| ()).map_err(|fault| fault.to_string())
    });
    let topology = include_bytes!("../../topology/pcie_8.toml");
    add("topology", topology, |bytes| Topology::parse(bytes, "t.toml").map(|_| ()).map_err(|error| error.to_string()));
    seeds.extend(run_seeds());
    seeds.extend(body_seeds());
    seeds.extend(moving_seeds());
    seeds
}

/// What a mutation may write in place of a word.
const WORDS: [&str; 26] = [
    "0",
    "-1",
    "1",
    "4294967295",
    "99999999999999999999",
    "-2147483649",
    "nan",
    "inf",
    "1e39",
    "1e-45",
    "1e308",
    "\n",
    "\r",
    "\\\n",
    "#",
    "\"",
    "[",
    "{",
    "]]",
    "end_header\n",
    "element vertex 4000000000\n",
    "%",
    "\u{feff}",
    "\0",
    "o \\\n",
    "1D400",
];

/// The input with a number: one to eight changes of the seed.
fn mutated(seed: &[u8], number: u64, salt: u64) -> Vec<u8> {
    let mut seeded = Seeded::new(number ^ salt.rotate_left(32));
    let mut random = |end: usize| seeded.below(end as u32) as usize;
    let mut bytes = seed.to_vec();
    for _ in 0..1 + random(8) {
        let at = random(bytes.len() + 1);
        let length = random(12).min(bytes.len() - at);
        match random(8) {
            0 => bytes.truncate(at),
            1 if at < bytes.len() => bytes[at] ^= 1 << random(8),
            2 if at < bytes.len() => bytes[at] = random(256) as u8,
            3 => drop(bytes.drain(at..at + length)),
            4 => {
                let copy = bytes[at..at + length].to_vec();
                let to = random(bytes.len() + 1);
                bytes.splice(to..to, copy);
            }
            5 => {
                // A whole word in place of a word.
                let end = bytes[at..].iter().position(u8::is_ascii_whitespace).map_or(bytes.len(), |n| at + n);
                let start = bytes[..at].iter().rposition(u8::is_ascii_whitespace).map_or(0, |n| n + 1);
                bytes.splice(start..end.max(start), WORDS[random(WORDS.len())].bytes());
            }
            6 => drop(bytes.splice(at..at, WORDS[random(WORDS.len())].bytes())),
            _ => {
                // A line goes elsewhere.
                let start = bytes[..at].iter().rposition(|&c| c == b'\n').map_or(0, |n| n + 1);
                let end = bytes[at..].iter().position(|&c| c == b'\n').map_or(bytes.len(), |n| at + n + 1);
                let line: Vec<u8> = bytes.drain(start..end).collect();
                let to = random(bytes.len() + 1);
                bytes.splice(to..to, line);
            }
        }
    }
    bytes
}

/// Reads every input on a thread of its own, which says what it begins: one that hangs is named.
fn survive(inputs: impl Iterator<Item = (usize, u64)> + Send + 'static) -> u64 {
    let (began, beginnings) = mpsc::channel();
    std::thread::spawn(move || {
        let seeds = seeds();
        for (seed, number) in inputs {
            let Seed { name, bytes, read } = &seeds[seed % seeds.len()];
            let input = mutated(bytes, number, seed as u64);
            let _ = began.send(Some((*name, seed, number)));
            let result = catch_unwind(AssertUnwindSafe(|| read(&input)));
            let fault = match &result {
                Ok(Ok(())) => None,
                Ok(Err(sentence)) if sentence.is_empty() || sentence.lines().count() != 1 => {
                    Some("its refusal is not one line")
                }
                Ok(Err(_)) => None,
                Err(_) => Some("panicked"),
            };
            if let Some(fault) = fault {
                let shown = String::from_utf8_lossy(&input).into_owned();
                panic!("{name}, input ({seed}, {number}): {fault}: {result:?}\n{shown}");
            }
        }
        let _ = began.send(None);
    });
    let (mut count, mut last) = (0, None);
    loop {
        match beginnings.recv_timeout(LIMIT) {
            Ok(Some(input)) => (count, last) = (count + 1, Some(input)),
            Ok(None) => return count,
            Err(mpsc::RecvTimeoutError::Timeout) => panic!("hangs: {last:?}"),
            Err(mpsc::RecvTimeoutError::Disconnected) => panic!("failed: {last:?}, see above"),
        }
    }
}

#[test]
fn every_seed_is_a_good_file() {
    for seed in seeds().iter().filter(|seed| !["arcsim", "frame obj", "frame ply"].contains(&seed.name)) {
        assert_eq!((seed.read)(&seed.bytes), Ok(()), "{}", seed.name);
    }
}

/// `LOOMTREE_FUZZ_INPUTS` for every seed, from number `LOOMTREE_FUZZ_FIRST` on.
#[test]
fn readers_survive_mutated_files() {
    let number = |name: &str, default: u64| std::env::var(name).map_or(default, |text| text.parse().expect("a number"));
    let (first, count) = (number("LOOMTREE_FUZZ_FIRST", 0), number("LOOMTREE_FUZZ_INPUTS", INPUTS));
    let seeds = seeds().len();
    let inputs = (first..first + count).flat_map(move |number| (0..seeds).map(move |seed| (seed, number)));
    assert_eq!(survive(KEPT.into_iter().chain(inputs)), count * seeds as u64 + KEPT.len() as u64);
}
