//! `--json` has one meaning: one JSON value on stdout (one a table for benchmarks), everything else on stderr.

use serde_json::Value;
use support::process::{Place, flag, repository};

/// The JSON values of stdout, which holds nothing else.
fn values(place: &Place, words: &str, code: i32) -> Vec<Value> {
    let ended = place.run(&format!("{words} --json")).expect(code);
    let values: Result<Vec<Value>, _> = serde_json::Deserializer::from_str(&ended.stdout).into_iter().collect();
    let values = values.unwrap_or_else(|error| panic!("{error}\n{}", ended.story));
    assert!(values.iter().all(Value::is_object), "{}", ended.story);
    values
}

fn value(place: &Place, words: &str) -> Value {
    let mut values = values(place, words, 0);
    assert_eq!(values.len(), 1, "{words}: {values:?}");
    values.remove(0)
}

#[test]
fn every_command_that_has_a_result_prints_it_as_one_object() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 2));
    place.write("wrong.toml", "[[cloth]]\nsheet = 1\n");
    place.write("eye.mtx", "%%MatrixMarket matrix coordinate real symmetric\n3 3 3\n1 1 1\n2 2 1\n3 3 1\n");
    let of = "--executor cpu --threads 1";
    let run = value(&place, &format!("run flag.toml --workers 2 {of} --out a"));
    assert_eq!((&run["status"], &run["frames"], &run["steps"]), (&"done".into(), &3.into(), &6.into()));
    assert_eq!(run["state_hash"].as_str(), Some(&place.hashes("a")[2].1[..]));
    let sweep = value(&place, &format!("run flag.toml {of} --set simulation.friction=[0.1,0.2] --frames 1 --out s"));
    assert_eq!(sweep["runs"][1]["set"]["simulation.friction"], "0.2");
    value(&place, &format!("run flag.toml {of} --segments 2 --frames 4 --out split"));
    assert_eq!(value(&place, "join a")["status"], "whole");
    assert_eq!(value(&place, "render a --executor cpu --size 64x48")["pictures"].as_array().unwrap().len(), 3);
    assert_eq!(value(&place, "report a --executor cpu --pictures 1")["file"], "a/report.html");
    assert_eq!(value(&place, "convert a --to glb")["files"].as_array().unwrap().len(), 1);
    assert!(value(&place, "compare a a")["frames"].is_array());
    assert_eq!(value(&place, "check flag.toml")["valid"], true);
    let refused = values(&place, "check wrong.toml", 2);
    assert!(refused[0]["valid"] == false && refused[0]["error"].as_str().unwrap().contains("wrong.toml, line 2"));
    assert!(value(&place, "doctor")["cores"].is_number());
    let topology = repository("topology/titan_v_8.toml").canonicalize().unwrap().display().to_string();
    value(&place, &format!("schedule {topology}"));
    value(&place, &format!("predict a --topology {topology}"));
    assert_eq!(value(&place, "topology detect --bandwidth 10 --gflops 10 --memory 1 --out t.toml")["file"], "t.toml");
    assert_eq!(value(&place, "solve eye.mtx --workers 1")["converged"], true);
    assert_eq!(value(&place, "init scene.toml")["file"], "scene.toml");
    value(&place, "schema");
    place.write("q.csv", "0,1,0,1,0,1\n".repeat(8));
    assert_eq!(value(&place, "ccd q.csv --kind vf")["queries"], 1);
    // A benchmark prints a line for every table.
    let tables = values(&place, "bench strain a", 0);
    assert!(!tables.is_empty() && tables.iter().all(|table| table["rows"].is_array()), "{tables:?}");
    // What is a text for another program is refused; failures leave stdout empty.
    let ended = place.run("completions bash --json").expect(2);
    assert!(ended.error().contains("leave out --json") && ended.stdout.is_empty(), "{}", ended.story);
    let ended = place.run("render nowhere --json").expect(2);
    assert!(ended.stdout.is_empty(), "{}", ended.story);
}

#[test]
fn people_read_the_same_on_stderr() {
    let place = Place::new();
    place.write("flag.toml", flag(256, 3, 1));
    let text = place.run("check flag.toml").expect(0).stdout;
    let ended = place.run("check flag.toml --json").expect(0);
    assert_eq!(ended.stderr, text);
    assert_eq!(ended.stdout.lines().count(), 1);
    assert_eq!(place.run("check flag.toml --json -q").expect(0).stderr, "");
}
