//! `loomtree ccd`: its file formats, exit codes, and the public query sets where `LOOMTREE_TEST_DATA` names them.

use std::path::{Path, PathBuf};

use loomtree::cli::ccd::{CcdArgs, CcdKind, parse_queries, parse_truth, write_ccd};
use proptest::prelude::*;
use serde_json::Value;

/// A vertex that falls through a face, once with and once without the truth.
const FALLS: &str =
    "1,4,1,4,1,1\n0,1,0,1,0,1\n1,1,0,1,0,1\n0,1,1,1,0,1\n1,4,1,4,-1,1\n0,1,0,1,0,1\n1,1,0,1,0,1\n0,1,1,1,0,1\n";

fn with_truth(truth: u8) -> String {
    FALLS.lines().map(|line| format!("{line},{truth}\n")).collect()
}

fn scratch(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("ccd_{name}_{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder for the test");
    folder
}

fn ask(queries: PathBuf, kind: CcdKind, truth: Option<PathBuf>) -> (Option<Value>, Option<(u8, String)>) {
    let args =
        CcdArgs { queries: Some(queries), kind: Some(kind), frames: None, pairs: None, minimum_separation: 0.0, truth };
    let mut out = Vec::new();
    let error = write_ccd(&args, &mut out).err().map(|error| (error.exit_code, error.message));
    (serde_json::from_slice(&out).ok(), error)
}

#[test]
fn the_truth_comes_from_the_rounded_table_first() {
    let folder = scratch("truth");
    let file = folder.join("data.csv");
    std::fs::write(&file, with_truth(0)).unwrap();
    let (report, error) = ask(file.clone(), CcdKind::Vf, None);
    let report = report.expect("a report");
    assert_eq!(
        (&report["queries"], &report["hits"], &report["missed"], &report["false_hits"]),
        (&1.into(), &1.into(), &0.into(), &1.into())
    );
    assert_eq!((&report["truth"], error), (&"unrounded".into(), None));

    std::fs::write(folder.join("data.exact.csv"), "hit,toi,hit_f32,toi_f32\n0,,1,0.5\n").unwrap();
    let report = ask(file.clone(), CcdKind::Vf, None).0.expect("a report");
    assert_eq!((&report["truth"], &report["false_hits"], &report["late"]), (&"rounded".into(), &0.into(), &0.into()));

    // A truth that is earlier than what was found, and one that is not found: exit code 1.
    let early = folder.join("early.csv");
    std::fs::write(&early, "toi_f32,hit_f32\n0.25,1\n").unwrap();
    let (report, error) = ask(file.clone(), CcdKind::Vf, Some(early));
    assert_eq!((&report.unwrap()["late"], error.unwrap().0), (&1.into(), 1));
    let apart: String = with_truth(1).replace("1,4,1,4,-1,1", "1,4,1,4,1,2");
    let missed = scratch("missed").join("data.csv");
    std::fs::write(&missed, apart).unwrap();
    let (report, error) = ask(missed, CcdKind::Vf, None);
    let error = error.expect("a miss");
    assert_eq!((&report.unwrap()["missed"], error.0), (&1.into(), 1));
    assert!(error.1.contains("1 contacts missed"), "{}", error.1);

    std::fs::write(&file, FALLS).unwrap();
    std::fs::remove_file(folder.join("data.exact.csv")).unwrap();
    let (report, error) = ask(file, CcdKind::Vf, None);
    let report = report.expect("a report");
    assert_eq!((&report["truth"], &report["missed"], error), (&"none".into(), &Value::Null, None));
}

#[test]
fn malformed_files_get_one_sentence_with_the_line() {
    let folder = scratch("malformed");
    let file = folder.join("bad.csv");
    let mut cases = vec![
        (FALLS.replacen("1,4,1,4,1,1", "1,4,1,4,1", 1).into_bytes(), "line 1: 5 columns"),
        (FALLS.replacen("0,1,1,1,0,1", "0,1,1,0,0,1", 1).into_bytes(), "line 4: \"0\" is no denominator"),
        (FALLS.replacen("1,4,1,4,-1,1", "1,4,1,4,x,1", 1).into_bytes(), "line 5: \"x\" is no integer"),
        (
            FALLS.lines().take(7).map(|l| format!("{l}\n")).collect::<String>().into_bytes(),
            "line 7: the file ends after 7 rows",
        ),
        (with_truth(1).replacen("0,1,0,1,0,1,1", "0,1,0,1,0,1,2", 1).into_bytes(), "line 2: \"2\" is no truth"),
        (with_truth(1).replacen("0,1,0,1,0,1,1", "0,1,0,1,0,1,0", 1).into_bytes(), "line 2: the truth differs"),
        (b"\xff\xfe,1,1,1,1,1\n".to_vec(), "line 1: not text"),
    ];
    cases.push((
        format!("{}{},1,0,1,0,1\n", FALLS, "9".repeat(300)).into_bytes(),
        "line 9: the coordinate is too large",
    ));
    for (bytes, wanted) in cases {
        std::fs::write(&file, bytes).unwrap();
        let (report, error) = ask(file.clone(), CcdKind::Ee, None);
        let (code, message) = error.expect("an error");
        assert!(report.is_none() && code == 2 && message.contains(wanted) && message.contains("bad.csv"), "{message}");
        assert!(!message.contains('\n'));
    }
    let (_, error) = ask(folder.join("absent.csv"), CcdKind::Vf, None);
    assert!(matches!(error, Some((2, message)) if message.contains("absent.csv")));
    std::fs::write(&file, FALLS).unwrap();
    for (truth, wanted) in [
        ("hit\n1\n", "no column hit_f32"),
        ("hit_f32\n", "0 rows of truth"),
        ("hit_f32\n7\n", "line 2: \"7\" is no truth"),
    ] {
        let table = folder.join("truth.csv");
        std::fs::write(&table, truth).unwrap();
        let (_, error) = ask(file.clone(), CcdKind::Vf, Some(table));
        assert!(matches!(&error, Some((2, message)) if message.contains(wanted)), "{error:?}");
    }
}

#[test]
fn quotients_are_rounded_once() {
    let parse = |n: &str, d: &str| {
        let text: String = (0..8).map(|_| format!("{n},{d},0,1,0,1\n")).collect();
        parse_queries(text.as_bytes()).map(|queries| queries[0].x_t0[0].x)
    };
    // Half an ulp above 1 (tie to even), a little more, and a little less: the last two need more than f64.
    assert_eq!(parse("16777217", "16777216"), Ok(1.0));
    assert_eq!(parse("100000005960464478", "100000000000000000"), Ok(1.0 + f32::EPSILON));
    assert_eq!(parse("100000005960464477", "100000000000000000"), Ok(1.0));
    assert_eq!(parse("-1", "3"), Ok(-1.0 / 3.0));
    assert_eq!(parse("0", "7"), Ok(0.0));
    assert_eq!(parse("999999999999999999", "1"), Ok(1e18));
    assert_eq!(parse("1", "999999999999999999"), Ok(1e-18));
    assert_eq!(
        parse("-6589603590721879", "162259276829213363391578010288128"),
        Ok((-6589603590721879.0f64 / 2f64.powi(107)) as f32)
    );
}

proptest! {
    #[test]
    fn any_bytes_are_read_without_panic(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let _ = parse_queries(&bytes);
        let _ = parse_truth(&bytes);
    }

    #[test]
    fn any_rows_are_read_without_panic(rows in proptest::collection::vec("[-0-9x]{0,20}(,[-0-9]{0,25}){4,7}\r?", 0..20)) {
        let _ = parse_queries(rows.join("\n").as_bytes());
        let _ = parse_truth(format!("hit_f32,toi_f32\n{}", rows.join("\n")).as_bytes());
    }

    #[test]
    fn quotients_are_within_half_an_ulp(n in any::<i32>(), d in 1..i32::MAX) {
        let text: String = (0..8).map(|_| format!("{n},{d},0,1,0,1\n")).collect();
        let ours = parse_queries(text.as_bytes()).expect("a query")[0].x_t0[0].x;
        // f64 holds the quotient of two 32-bit integers well enough to round to f32, but for ties that cannot occur here.
        prop_assert_eq!(ours, (f64::from(n) / f64::from(d)) as f32);
    }
}

/// Query files of the public sets: zero misses on each, false hits below 1 % of the queries of the real scenes.
#[test]
fn public_query_sets() {
    let Ok(data) = std::env::var("LOOMTREE_TEST_DATA") else {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
        return;
    };
    let data = Path::new(&data);
    let mut files = Vec::new();
    let mut open = vec![data.join("ccd-sample-queries"), data.join("scalable-ccd")];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten() {
            let path = entry.expect("an entry").path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let holds_queries = folder.ends_with("queries") || name.starts_with("data_");
            if path.is_dir() {
                open.push(path);
            } else if name.ends_with(".csv") && !name.ends_with(".exact.csv") && holds_queries {
                files.push(path);
            }
        }
    }
    files.sort();
    assert!(!files.is_empty(), "no queries below {}", data.display());
    for file in files {
        let vertex_face =
            file.parent().is_some_and(|f| f.ends_with("vertex-face")) || file.to_string_lossy().ends_with("vf.csv");
        let real = file.starts_with(data.join("scalable-ccd"));
        let (report, error) = ask(file.clone(), if vertex_face { CcdKind::Vf } else { CcdKind::Ee }, None);
        assert_eq!(error, None);
        let report = report.expect("a report");
        println!("{}: {report}", file.display());
        let count = |name: &str| report[name].as_u64().expect("a count");
        assert_eq!((count("missed"), count("late"), &report["truth"]), (0, 0, &"rounded".into()), "{}", file.display());
        let limit = if real { count("queries") / 100 } else { count("queries") / 5 };
        assert!(count("false_hits") <= limit, "{}: {report}", file.display());
    }
}
