//! `loomtree bench assembly`, `scaling`, `spmv`, `matrix-free`, `interconnect` and `time` on tiny cloth: tables as
//! valid JSON with their pictures, and measured figures never under the name of modelled ones. What the figures are is
//! the machine's affair; only what must hold anywhere is asked for.

use loomtree::partition::RowPartition;
use serde_json::Value;
use support::process::{Place, flag, repository};

/// A place with a small flag.
fn place() -> Place {
    let place = Place::new();
    place.write("flag.toml", flag(400, 1, 1));
    place
}

/// Table `name` that a benchmark has written to `out`, after checking what all tables share.
fn table(place: &Place, name: &str, kind: &str) -> Vec<Value> {
    let text = std::fs::read_to_string(place.path("out").join(format!("{name}.json"))).expect("a table");
    let document: Value = serde_json::from_str(&text).expect("valid JSON");
    assert_eq!((document["benchmark"].as_str(), document["kind"].as_str()), (Some(name), Some(kind)), "{text}");
    assert!(document["machine"]["cores"].as_u64() > Some(0), "{text}");
    let rows = document["rows"].as_array().expect("rows").clone();
    assert!(!rows.is_empty(), "{text}");
    rows
}

fn number(row: &Value, column: &str) -> f64 {
    row[column].as_f64().unwrap_or_else(|| panic!("no {column} in {row}"))
}

fn positive(row: &Value, columns: &[&str]) {
    columns.iter().for_each(|column| assert!(number(row, column) > 0.0, "{column} in {row}"));
}

fn picture(place: &Place, name: &str) -> String {
    let svg = std::fs::read_to_string(place.path("out").join(format!("{name}.svg"))).expect("a picture");
    assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"), "{name}");
    svg
}

#[test]
fn assembly_measures_every_number_of_workers() {
    let place = place();
    let flags = "--scene flag.toml --resolution 400 --workers 1,2 --steps 3 --rounds 1 --out out";
    place.run(&format!("bench assembly {flags}")).expect(0);
    let rows = table(&place, "assembly", "measured");
    assert_eq!(rows.iter().map(|row| number(row, "workers")).collect::<Vec<_>>(), [1.0, 2.0]);
    for row in &rows {
        positive(row, &["elements_ms", "value_fill_ms", "assembly_ms", "speedup"]);
        assert!(number(row, "assembly_ms") >= number(row, "value_fill_ms") && number(row, "contacts") == 0.0);
    }
    assert_eq!(number(&rows[0], "speedup"), 1.0);
    picture(&place, "assembly");
}

#[test]
fn several_scenes_have_tables_and_pictures_of_their_own() {
    let place = place();
    sphere(&place);
    let flags = "--resolution 400 --workers 1,2 --steps 2 --rounds 1 --out out";
    let scenes = "--scene flag.toml --scene sphere.toml --skip 1,2";
    for (command, tables) in
        [("collision", vec!["collision", "zones"]), ("step", vec!["step", "stages"]), ("memory", vec!["memory"])]
    {
        let ended = place.run(&format!("bench {command} {scenes} {flags}")).expect(0);
        for scene in ["flag", "sphere"] {
            assert!(ended.stdout.contains(&format!("{scene}.toml: ")), "{}", ended.story);
            for name in &tables {
                let rows = table(&place, &format!("{name}_{scene}"), "measured");
                assert!(*name == "zones" || rows.len() == 2, "{name}_{scene}: {rows:?}");
            }
            picture(&place, &format!("{command}_{scene}"));
        }
    }
    let lengths = |scene: &str| {
        let rows = table(&place, &format!("zones_{scene}"), "measured");
        rows.iter().map(|row| number(row, "steps")).sum::<f64>()
    };
    assert_eq!((lengths("flag"), lengths("sphere")), (2.0, 2.0), "the steps that count, after those of --skip");
    place.run(&format!("bench step --scene flag.toml {flags}")).expect(0);
    assert_eq!(table(&place, "step", "measured").len(), 2);
}

#[test]
fn scaling_keeps_measured_and_modelled_columns_apart() {
    let place = place();
    place.write("pair.toml", std::fs::read_to_string(repository("topology/pcie_2.toml")).expect("the shipped file"));
    let flags =
        "--scene flag.toml --resolution 400 --workers 1,2,3 --steps 3 --rounds 1 --topology pair.toml --out out";
    place.run(&format!("bench scaling {flags}")).expect(0);
    for (name, curve) in [("scaling_strong", "modelled_speedup"), ("scaling_weak", "modelled_efficiency_per_iteration")]
    {
        let rows = table(&place, name, "measured and modelled");
        assert_eq!(rows.iter().map(|row| number(row, "workers")).collect::<Vec<_>>(), [1.0, 2.0, 3.0]);
        for row in &rows {
            positive(row, &["measured_step_ms", "measured_efficiency", "iterations"]);
            let unlabelled = ["workers", "triangles", "iterations"];
            for column in row.as_object().expect("a row").keys() {
                let labelled = column.starts_with("measured_") || column.starts_with("modelled_");
                assert!(labelled || unlabelled.contains(&column.as_str()), "{column}");
            }
        }
        for row in &rows[..2] {
            positive(row, &["modelled_step_ms", "modelled_efficiency", curve]);
        }
        assert!(rows[2]["modelled_step_ms"].is_null(), "three workers on a machine of two GPUs: {}", rows[2]);
        assert!(picture(&place, name).contains(curve));
    }
    // The machine of the file does the same whatever runs here.
    let steps = || table(&place, "scaling_strong", "measured and modelled");
    let modelled = |rows: &[Value]| rows[..2].iter().map(|row| number(row, "modelled_step_ms")).collect::<Vec<_>>();
    let first = modelled(&steps());
    place.run(&format!("bench scaling {flags}")).expect(0);
    assert_eq!(modelled(&steps()), first);
}

/// The shipped scene with the ball close to the cloths.
fn sphere(place: &Place) {
    let scene = std::fs::read_to_string(repository("scenes/sphere.toml")).expect("the shipped scene");
    let at = "center_m = [0.05, 1.0, 0.45]";
    assert!(scene.contains(at), "the scene has changed");
    place.write("sphere.toml", scene.replace(at, "center_m = [0.05, 1.0, 0.28]"));
}

#[test]
fn spmv_multiplies_matrices_in_contact() {
    let place = place();
    sphere(&place);
    place.write("four.toml", std::fs::read_to_string(repository("topology/pcie_4.toml")).expect("the shipped file"));
    let flags = "--resolution 1000 --workers 1,2,4,8 --repeat 3 --rounds 2 --topology four.toml --out out";
    place.run(&format!("bench spmv --scene sphere.toml,flag.toml --steps 3 {flags}")).expect(0);
    for scene in ["sphere", "flag"] {
        positive(&table(&place, &format!("spmv_{scene}"), "measured")[0], &["rows", "median_ms", "bytes"]);
    }
    let ended = place.run(&format!("bench spmv --scene sphere.toml --contacts 0.01 --steps 200 {flags}")).expect(0);
    let contacts =
        ended.stdout.lines().find_map(|line| line.split(" contacts").next()?.rsplit(' ').next()?.parse().ok());
    assert!(contacts > Some(4u32), "{}", ended.stdout);

    let modelled = table(&place, "spmv_sphere_modelled", "modelled");
    assert_eq!(modelled.iter().map(|row| number(row, "ranks")).collect::<Vec<_>>(), [1.0, 2.0, 4.0], "no eight GPUs");
    for row in &modelled {
        let whole = ["gather_first", "full_fat_tree", "full_ring", "full_direct", "full_best", "halo_best"];
        positive(row, &whole);
        assert!(row.get("one_rank_ms").is_none() && number(row, "one_gpu_ms") > 0.0);
    }
    assert!(number(&modelled[2], "gather_first_best") >= number(&modelled[2], "gather_first"));
    let measured = table(&place, "spmv_sphere_measured", "measured");
    assert_eq!(measured.len(), 4);
    measured
        .iter()
        .for_each(|row| positive(row, &["one_rank_ms", "gather_first", "full_fat_tree", "full_best", "halo"]));
    let bytes = table(&place, "spmv_sphere_bytes", "measured");
    for row in &bytes {
        let ranks = number(row, "ranks");
        // Every rank receives all other sub-vectors, padded to equal length.
        let rows = number(&table(&place, "spmv_sphere", "measured")[0], "rows");
        let sub_vector = RowPartition::new(rows as usize, ranks as usize).sub_vector_rows();
        assert!(sub_vector as f64 <= 1.05 * rows / ranks);
        assert_eq!(number(row, "full_bytes"), ranks * (ranks - 1.0) * sub_vector as f64 * 12.0);
        assert!(number(row, "halo_bytes") > 0.0 && number(row, "halo_over_full") <= 1.0);
    }
    picture(&place, "spmv_sphere_modelled");
    picture(&place, "spmv_sphere_measured");
}

#[test]
fn matrix_free_needs_less_memory_and_moves_more_bytes() {
    let place = place();
    sphere(&place);
    let flags = "--scene sphere.toml --resolution 500,1000 --contacts 0.01 --skip 200 --steps 2 --repeat 3 --out out";
    place.run(&format!("bench matrix-free {flags}")).expect(0);
    let rows = table(&place, "matrix_free", "measured");
    assert_eq!(rows.len(), 2);
    for row in &rows {
        positive(row, &["contacts", "stored_product_ms", "free_product_ms", "stored_step_ms", "free_step_ms"]);
        assert!(number(row, "memory_ratio") < 1.0 && number(row, "free_iterations") >= 1.0, "{row}");
    }
    let modelled = table(&place, "matrix_free_modelled", "modelled");
    modelled.iter().for_each(|row| assert!(number(row, "product_ratio") >= 1.0, "{row}"));
    picture(&place, "matrix_free");
}

#[test]
fn interconnect_is_modelled_alone() {
    let place = place();
    let topology = repository("topology/titan_xp_4.toml");
    let ended =
        place.run(&format!("bench interconnect --efficiency 0.333 --topology {} --out out", topology.display()));
    let ended = ended.expect(0);
    assert!(ended.stdout.contains("modelled, not measured"), "{}", ended.stdout);
    let rows = table(&place, "interconnect_titan_xp_4_33", "modelled");
    let four = rows.last().expect("a row");
    let of = |column| number(four, column);
    assert!(of("gather_first_best") > of("gather_first") && of("full_best") >= of("full_fat_tree"), "{four}");
    assert!(of("full_best") >= of("gather_first_best"), "{four}");
}

#[test]
fn drape_is_measured_for_every_cloth_of_a_run() {
    let place = place();
    place.write("cusick.toml", std::fs::read_to_string(repository("scenes/cusick.toml")).unwrap());
    place.run("run cusick.toml --resolution 1200 --frames 1 --workers 1 --out run").expect(0);
    place.run("bench drape run --out out").expect(0);
    let rows = table(&place, "drape", "measured");
    assert_eq!(rows.iter().map(|row| number(row, "piece")).collect::<Vec<_>>(), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    // After 0.04 s the skirts have hardly begun to fall.
    for row in &rows {
        assert!((0.9..1.001).contains(&number(row, "drape_coefficient")), "{row}");
        assert!((0.14..0.1501).contains(&number(row, "rim_most_m")), "{row}");
    }
}

/// Two panels that are sewn side by side and divided once.
const PANELS: &str = r#"
resolution = 400
[sewing]
close_s = 0.04
refine = 1
[simulation]
step_s = 0.004
steps_per_frame = 2
frames = 4
[[cloth]]
name = "one"
sheet = { size_m = [0.2, 0.2], mesh = "grid" }
[[cloth]]
name = "other"
sheet = { size_m = [0.2, 0.2], mesh = "grid" }
origin_m = [0.21, 0, 0]
[[seam]]
a = { cloth = "one", edge = "right" }
b = { cloth = "other", edge = "left" }
"#;

/// A benchmark that cannot start costs its own row alone, and one with seams is measured as the garment.
#[test]
fn table_1_has_a_row_for_every_benchmark() {
    let place = place();
    place.write("ruffles.toml", PANELS);
    // A sheet through another.
    let sheet = "[[cloth]]\nsheet = { size_m = [1, 1] }\n";
    place.write("kimono.toml", format!("{sheet}{sheet}plane = \"xz\"\norigin_m = [0, 0.5, 0.5]\n"));
    let flags = "--scenes . --resolution 400 --workers 1,2 --steps 2 --skip 1 --out out";
    let ended = place.run(&format!("bench table1 --only Miku,flag,Kimono {flags}")).expect(1);
    assert!(ended.error().contains("1 of 3 benchmarks have no figures (Kimono)"), "{}", ended.story);
    assert!(ended.story.contains("Kimono: no figures: ") && ended.story.contains("cross"), "{}", ended.story);
    let rows = table(&place, "table1", "measured and modelled");
    assert_eq!(
        rows.iter().map(|row| row["benchmark"].as_str().unwrap()).collect::<Vec<_>>(),
        ["Miku", "Flag", "Kimono"]
    );
    for row in &rows[..2] {
        positive(row, &["triangles", "measured_fps_1", "measured_fps_2", "modelled_fps_1", "modelled_fps_2"]);
        assert!(row["measured_fps_4"].is_null() && number(row, "paper_fps_4") > 0.0, "{row}");
    }
    assert_eq!(number(&rows[0], "triangles") as usize % 4, 0, "divided once: {}", rows[0]);
    assert!(
        rows[2]["triangles"].is_null()
            && rows[2]["measured_fps_1"].is_null()
            && number(&rows[2], "paper_fps_1") == 0.24
    );
    // Nothing is measured when a file cannot be read.
    let ended = place.run(&format!("bench table1 --only Flag,Sphere {flags}")).expect(2);
    assert!(ended.error().contains("sphere.toml"), "{}", ended.story);
}

#[test]
fn a_split_in_time_is_played_for_meshes_of_several_sizes() {
    let place = place();
    let flags =
        "bench time --scene flag.toml --resolution 2048 --measured-steps 8 --steps 1000 --processes 2,8 --out out";
    let ended = place.run(&format!("{flags} --sweep resolution --json")).expect(0);
    let rows = table(&place, "time_resolution", "modelled");
    let sizes: Vec<f64> = rows.iter().map(|row| number(row, "triangles")).collect();
    assert!(sizes.len() == 3 && sizes.windows(2).all(|pair| (3.0..5.0).contains(&(pair[1] / pair[0]))), "{sizes:?}");
    for row in &rows {
        positive(row, &["segments", "workers", "levels", "speedup", "eq6", "eq16"]);
        assert_eq!(number(row, "processes"), 8.0);
        // Eq. 6 bounds what is played, and the extra steps and the moving of states only cost.
        assert!(number(row, "speedup") < 8.0, "{row}");
    }
    picture(&place, "time_resolution");
    // The object on stdout has the rows by processes, and the swept ones under the name of their table.
    let answer: Value = serde_json::from_str(&ended.stdout).expect("valid JSON");
    assert_eq!(answer["rows"].as_array().map(Vec::len), Some(2));
    assert_eq!(answer["time_resolution"]["rows"].as_array(), Some(&rows));
    place.run("run flag.toml --frames 1 --out run").expect(0);
    let ended = place.run(&format!("{flags} --fine run --coarse run --sweep resolution")).expect(2);
    assert!(ended.error().contains("--sweep resolution makes its runs itself"), "{}", ended.story);
}

#[test]
fn what_cannot_be_measured_is_said_in_one_sentence() {
    let place = place();
    for (command, wanted) in [
        ("bench spmv --scene flag.toml --resolution 20 --workers 64", "has only"),
        ("bench spmv --scene flag.toml --topology nowhere.toml", "nowhere.toml"),
        ("bench matrix-free --scene nowhere.toml", "nowhere.toml"),
        ("bench scaling --scene flag.toml --topology nowhere.toml", "nowhere.toml"),
        ("bench step --scene flag.toml,nowhere.toml --skip 1,2,3", "--skip: 3 numbers for 2 scene(s)"),
        ("bench drape nowhere", "nowhere"),
        ("bench memory --scene flag.toml --scene elsewhere/flag.toml", "two scenes are called 'flag'"),
    ] {
        let ended = place.run(command).expect(2);
        assert!(ended.error().contains(wanted), "{}", ended.story);
    }
}
