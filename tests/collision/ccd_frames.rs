//! `loomtree ccd --frames`: every true pair is found between two frames, and bad input gets one sentence.

use std::path::{Path, PathBuf};

use clap::Parser;
use loomtree::cli::ccd::{CcdArgs, write_ccd};
use serde_json::Value;

#[derive(Parser)]
struct Command {
    #[command(flatten)]
    args: CcdArgs,
}

fn scratch(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("ccd_{name}_{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder for the test");
    folder
}

fn ask(arguments: &[&str]) -> (Option<Value>, Option<(u8, String)>) {
    let args = Command::try_parse_from([&["ccd"], arguments].concat()).expect("arguments").args;
    let mut out = Vec::new();
    let error = write_ccd(&args, &mut out).err().map(|error| (error.exit_code, error.message));
    (serde_json::from_slice(&out).ok(), error)
}

/// Two crossed triangles, one above the other, at a height.
fn frame(height: f32) -> String {
    format!(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0.25 0.25 {height}\nv 0.25 -1 {height}\nv 2 -1 {height}\nv 9 9 9\nf 1 2 3\nf 4 5 6\n"
    )
}

struct Files {
    start: String,
    end: String,
    pairs: PathBuf,
}

impl Files {
    fn new(name: &str) -> Files {
        let folder = scratch(name);
        let write = |name: &str, text: String| {
            let path = folder.join(name);
            std::fs::write(&path, text).expect("a file");
            path.display().to_string()
        };
        Files { start: write("a.obj", frame(0.5)), end: write("b.obj", frame(-0.5)), pairs: folder.join("pairs.csv") }
    }

    fn ask(&self, pairs: &str, more: &[&str]) -> (Option<Value>, Option<(u8, String)>) {
        std::fs::write(&self.pairs, pairs).expect("a table");
        let pairs = self.pairs.display().to_string();
        ask(&[&["--frames", &self.start, &self.end, "--pairs", &pairs], more].concat())
    }
}

#[test]
fn true_pairs_are_found_and_kinds_are_recognised() {
    let files = Files::new("frames");
    // Corners of the face in another order; a row that is no contact.
    let (report, error) = files.ask("i0,i1,i2,i3,hit_f32,toi_f32\n3,2,0,1,1,0.5\n5,0,1,2,0,\n", &[]);
    let report = report.expect("a report");
    assert_eq!(error, None);
    let counts =
        ["pairs", "hits", "found", "missed", "late", "false_hits"].map(|name| report[name].as_u64().expect("a count"));
    assert_eq!((counts, &report["kind"]), ([2, 1, 1, 0, 0, 0], &"vf".into()));
    let (report, error) = files.ask("i0,i1,i2,i3,hit\n4,3,1,0,1\n", &[]);
    let report = report.expect("a report");
    assert_eq!(
        (error, &report["kind"], &report["found"], &report["truth"]),
        (None, &"ee".into(), &1.into(), &"unrounded".into())
    );
    // A contact that there is none of, and one that is later than the truth: exit code 1.
    let (report, error) = files.ask("i0,i1,i2,i3,hit_f32,toi_f32\n5,0,1,2,1,\n3,0,1,2,1,0.25\n", &["--kind", "vf"]);
    let report = report.expect("a report");
    let error = error.expect("a miss");
    assert_eq!((&report["missed"], &report["late"], error.0), (&1.into(), &1.into(), 1));
    assert!(error.1.contains("1 contacts missed, 1 found later"), "{}", error.1);
}

#[test]
fn bad_input_gets_one_sentence() {
    let files = Files::new("bad_frames");
    let header = "i0,i1,i2,i3,hit_f32\n";
    for (pairs, more, wanted) in [
        ("i0,i1,i2,hit_f32\n".to_string(), &[][..], "line 1: no column i3"),
        ("i0,i1,i2,i3\n".to_string(), &[], "line 1: no column hit_f32"),
        (format!("{header}0,1,2,x,1\n"), &[], "line 2: \"x\" is no vertex"),
        (format!("{header}3,0,1,2,2\n"), &[], "line 2: \"2\" is no truth"),
        (format!("{header}3,0,1,2,1\n4,0,1,5,1\n"), &[], "neither a vertex and a face nor two edges"),
        (format!("{header}3,0,1,99,1\n"), &["--kind", "vf"], "line 2: [3, 0, 1, 99] is not a vertex and the corners"),
        (format!("{header}3,0,1,2,1\n"), &["--kind", "ee"], "line 2: [3, 0, 1, 2] is not two edges"),
        (header.to_string(), &[], "say which with --kind"),
    ] {
        let (report, error) = files.ask(&pairs, more);
        let (code, message) = error.expect("an error");
        assert!(
            report.is_none() && code == 2 && message.contains(wanted) && message.contains("pairs.csv"),
            "{message}"
        );
        assert!(!message.contains('\n'));
    }
    let good = format!("{header}3,0,1,2,1\n");
    for (end, wanted) in [
        (frame(0.1) + "v 1 1 1\n", "8 vertices, but"),
        (frame(0.1).replace("f 4 5 6", "f 4 6 5"), "its triangles are not those of"),
        (frame(0.1).replace("f 4 5 6", "f 4 5 77"), "b.obj"),
        (frame(f32::NAN), "b.obj"),
    ] {
        std::fs::write(&files.end, end).expect("a file");
        let (code, message) = files.ask(&good, &[]).1.expect("an error");
        assert!(code == 2 && message.contains(wanted) && !message.contains('\n'), "{message}");
    }
    std::fs::remove_file(&files.end).expect("a file");
    assert!(matches!(files.ask(&good, &[]).1, Some((2, message)) if message.contains("b.obj: cannot be read")));
    assert!(Command::try_parse_from(["ccd", "--frames", "a.ply", "b.ply"]).is_err(), "frames without pairs");
    assert!(Command::try_parse_from(["ccd", "q.csv"]).is_err(), "queries without a kind");
}

#[test]
fn public_frames() {
    let Ok(data) = std::env::var("LOOMTREE_TEST_DATA") else {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
        return;
    };
    let scenes = std::fs::read_dir(Path::new(&data).join("scalable-ccd")).expect("the data");
    let mut asked = 0;
    for scene in scenes.map(|entry| entry.expect("an entry").path()).filter(|path| path.join("frames").is_dir()) {
        let frames = std::fs::read_dir(scene.join("frames")).expect("frames");
        let mut frames: Vec<String> =
            frames.map(|entry| entry.expect("a frame").path().display().to_string()).collect();
        frames.sort();
        for table in ["vf_pairs.csv", "ee_pairs.csv"] {
            let pairs = scene.join(table).display().to_string();
            let (report, error) = ask(&["--frames", &frames[0], &frames[1], "--pairs", &pairs]);
            println!("{pairs}: {}", report.expect("a report"));
            assert_eq!(error, None);
            asked += 1;
        }
    }
    assert!(asked >= 4, "{asked} tables");
}
