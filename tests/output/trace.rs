//! The trace file: valid at any time, on a common time axis, with tracks whose slices do not overlap.

use std::collections::HashMap;
use std::fs;
use std::path::Path;

use loomtree::output::{RankEvents, TraceWriter};
use loomtree::telemetry::{Activity, Event, EventName};
use serde_json::Value;

fn event(name: EventName, activity: Activity, span_ns: (u64, u64), route: (u32, u32, u32)) -> Event {
    Event { bytes: 64, flops: 7, ..support::event(name, activity, span_ns, route) }
}

fn load(path: &Path) -> Vec<Value> {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// Nanoseconds of a time in the file.
fn ns(value: &Value) -> i64 {
    (value.as_f64().unwrap() * 1000.0).round() as i64
}

fn write_two_ranks(path: &Path) {
    let names = ["cpu".to_string(), "odd \"name\"\\".to_string()];
    let mut writer = TraceWriter::create(path, &names, 1_000_000).unwrap();
    assert_eq!(load(path).len(), 4, "valid before the first step");
    let rank0 = [
        event(EventName::Step, Activity::Compute, (0, 9_000), (0, 0, 0)),
        event(EventName::Publish, Activity::Transfer, (100, 200), (1, 0, 0)),
        // Handed over out of order, nested and overlapping: each must find a track of its own.
        event(EventName::SpmvRemote, Activity::Compute, (3_000, 5_000), (0, 0, 0)),
        event(EventName::SpmvLocal, Activity::Compute, (200, 3_000), (0, 0, 0)),
        event(EventName::ValueFill, Activity::Compute, (2_000, 4_000), (0, 0, 0)),
        event(EventName::IndexFill, Activity::Compute, (2_500, 2_600), (0, 0, 0)),
        event(EventName::AllReduce, Activity::Wait, (5_000, 5_000), (0, 0, 0)),
    ];
    let rank1 = [
        event(EventName::Step, Activity::Compute, (0, 9_000), (0, 1, 1)),
        event(EventName::Publish, Activity::Transfer, (0, 0), (0, 0, 0)),
        event(EventName::Receive, Activity::Wait, (0, 1_500), (1, 0, 0)),
        event(EventName::Receive, Activity::Transfer, (1_500, 1_723), (1, 0, 0)),
    ];
    // Rank 1 started its clock 500 ns after rank 0.
    let both = [
        RankEvents { rank: 0, epoch_unix_ns: 1_000_000, events: &rank0 },
        RankEvents { rank: 1, epoch_unix_ns: 1_000_500, events: &rank1 },
    ];
    writer.append(&both).unwrap();
    load(path);
    writer.append(&[]).unwrap();
    // A step that began before the last one ended.
    writer.append(&[RankEvents { rank: 0, epoch_unix_ns: 1_000_000, events: &rank0[..3] }]).unwrap();
}

#[test]
fn another_session_has_tracks_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.json");
    let devices = ["cpu".to_string(), "cpu".to_string()];
    let mut writer = TraceWriter::create(&path, &devices, 1_000).unwrap();
    let events = [event(EventName::Step, Activity::Compute, (0, 9_000), (0, 0, 0))];
    writer.append(&[RankEvents { rank: 1, epoch_unix_ns: 1_000, events: &events }]).unwrap();
    writer.add_session(1, &devices).unwrap();
    // Its clock started before that of the first one.
    writer.append(&[RankEvents { rank: 3, epoch_unix_ns: 500, events: &events }]).unwrap();
    let entries = load(&path);
    let names: Vec<(u64, &str)> = entries
        .iter()
        .filter(|entry| entry["name"] == "process_name")
        .map(|entry| (entry["pid"].as_u64().unwrap(), entry["args"]["name"].as_str().unwrap()))
        .collect();
    let expected =
        [(0, "rank 0 (cpu)"), (1, "rank 1 (cpu)"), (2, "session 1 rank 0 (cpu)"), (3, "session 1 rank 1 (cpu)")];
    assert_eq!(names, expected);
    let steps: Vec<(u64, i64)> = entries
        .iter()
        .filter(|entry| entry["ph"] == "X")
        .map(|entry| (entry["pid"].as_u64().unwrap(), ns(&entry["ts"])))
        .collect();
    assert_eq!(steps, [(1, 0), (3, -500)]);
}

#[test]
fn slices_are_on_one_axis_and_do_not_overlap() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.json");
    write_two_ranks(&path);
    let entries = load(&path);
    let mut tracks: HashMap<(i64, i64), Vec<(i64, i64)>> = HashMap::new();
    for slice in entries.iter().filter(|e| e["ph"] == "X") {
        let start = ns(&slice["ts"]);
        let track = (slice["pid"].as_i64().unwrap(), slice["tid"].as_i64().unwrap());
        tracks.entry(track).or_default().push((start, start + ns(&slice["dur"])));
    }
    assert_eq!(tracks.values().map(Vec::len).sum::<usize>(), 14);
    for (track, mut slices) in tracks {
        let named = entries.iter().any(|e| e["name"] == "thread_name" && e["pid"] == track.0 && e["tid"] == track.1);
        assert!(named, "track {track:?} has no name");
        slices.sort();
        assert!(slices.windows(2).all(|pair| pair[0].1 <= pair[1].0), "track {track:?} overlaps: {slices:?}");
    }
    let receive = entries.iter().find(|e| e["name"] == "receive sub-vector" && e["cat"] == "transfer").unwrap();
    assert_eq!((ns(&receive["ts"]), ns(&receive["dur"])), (2_000, 223));
    assert_eq!(receive["pid"], 1);
    assert_eq!(
        receive["args"],
        serde_json::json!({"step": 1, "stage": 1, "source": 0, "vector": 0, "bytes": 64, "flops": 7})
    );
    let process = entries.iter().find(|e| e["name"] == "process_name" && e["pid"] == 1).unwrap();
    assert_eq!(process["args"]["name"], "rank 1 (odd \"name\"\\)");
}

#[test]
fn an_arrow_leads_from_the_publication_to_the_reception() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.json");
    write_two_ranks(&path);
    let entries = load(&path);
    let arrows: Vec<_> = entries.iter().filter(|e| e["ph"] == "s" || e["ph"] == "f").collect();
    assert_eq!(arrows.len(), 2);
    for (arrow, (pid, from_ns, to_ns)) in arrows.iter().zip([(0, 100, 200), (1, 2_000, 2_223)]) {
        assert_eq!(arrow["pid"], pid);
        assert!((from_ns..to_ns).contains(&ns(&arrow["ts"])), "{arrow} is outside its slice");
        let slice =
            |e: &&Value| e["ph"] == "X" && e["pid"] == pid && e["tid"] == arrow["tid"] && ns(&e["ts"]) == from_ns;
        assert!(entries.iter().any(|e| slice(&e)));
    }
    assert_eq!(arrows[0]["id"], arrows[1]["id"]);
}

/// Arrows of a step in which rank 0 begins `publications` exchanges and rank 1 begins and reads as `of_one` says.
fn arrows(publications: usize, of_one: &[(EventName, u64)]) -> Vec<(i64, i64)> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.json");
    let mut writer = TraceWriter::create(&path, &[], 0).unwrap();
    let transfer = |name: EventName, at: u64| event(name, Activity::Transfer, (at * 1000, at * 1000 + 500), (1, 0, 0));
    let zero: Vec<Event> = (0..publications).map(|i| transfer(EventName::Publish, 10 * i as u64)).collect();
    let one: Vec<Event> = of_one.iter().map(|&(name, at)| transfer(name, at)).collect();
    let ranks = [(0, &zero), (1, &one)].map(|(rank, events)| RankEvents { rank, epoch_unix_ns: 0, events });
    writer.append(&ranks).unwrap();
    let entries = load(&path);
    let ends =
        |phase: &str| entries.iter().filter(|e| e["ph"] == phase).map(|e| ns(&e["ts"]) / 1000).collect::<Vec<_>>();
    ends("s").into_iter().zip(ends("f")).collect()
}

#[test]
fn arrows_of_who_does_not_read_every_message() {
    use EventName::{Publish, Receive};
    // Rank 1 reads in the second and the last of four exchanges.
    let events = [(Publish, 1), (Publish, 11), (Receive, 12), (Publish, 21), (Publish, 31), (Receive, 32)];
    assert_eq!(arrows(4, &events), [(10, 12), (30, 32)]);
}

#[test]
fn no_arrow_is_drawn_when_an_event_is_missing() {
    use EventName::{Publish, Receive};
    let events = [(Publish, 1), (Receive, 2), (Publish, 11), (Receive, 12)];
    assert_eq!(arrows(2, &events).len(), 2);
    assert!(arrows(1, &events).is_empty() && arrows(3, &events).is_empty());
    assert!(arrows(1, &[(Receive, 2), (Publish, 3)]).is_empty());
}

#[test]
fn what_a_device_ran_later_is_read_back_in_the_order_in_which_it_was_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trace.json");
    // Asked for at 100, begun while the host already published.
    let mut kernel = event(EventName::VectorUpdate, Activity::Compute, (400, 900), (0, 0, 0));
    kernel.asked_ns = 100;
    let publish = event(EventName::Publish, Activity::Transfer, (200, 950), (0, 0, 0));
    let mut writer = TraceWriter::create(&path, &["gpu".to_string()], 0).unwrap();
    writer.append(&[RankEvents { rank: 0, epoch_unix_ns: 0, events: &[publish, kernel] }]).unwrap();
    let steps = loomtree::output::read_trace(&path).unwrap();
    let read: Vec<_> = steps[&1][0].iter().map(|e| (e.name, e.asked_ns, e.start_ns, e.end_ns)).collect();
    let (kernel, publish) = (EventName::VectorUpdate as u32, EventName::Publish as u32);
    assert_eq!(read, [(kernel, 100, 400, 900), (publish, 200, 200, 950)]);
}
