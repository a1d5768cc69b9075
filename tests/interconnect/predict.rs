//! `loomtree predict`: a recorded step re-timed by hand, a real small run, what is refused.

use std::path::{Path, PathBuf};

use loomtree::cli::predict::{PredictArgs, PredictExchange, PredictKernels, write_prediction};
use loomtree::interconnect::ScheduleKind;
use loomtree::output::{RankEvents, Report, TraceWriter, read_trace};
use loomtree::telemetry::{Activity, Event, EventName};
use serde_json::Value;
use support::process::{Place, repository};

/// Two GPUs: 1 GB/s and 2 us between them, kernels of 100 GB/s and 1 us.
const PAIR: &str = "name='pair'\nswitches=['s']\ngpus=[{id=0,name='a'},{id=1,name='b'}]\nlinks=[
    {between=['s','a'],bandwidth_gb_s=1,latency_us=1,duplex='full'},
    {between=['s','b'],bandwidth_gb_s=1,latency_us=1,duplex='full'}]
    device={name='toy',memory_gb=0.001,bandwidth_gb_s=100,gflops=1e6,launch_us=1}";

fn event(name: EventName, activity: Activity, at_us: u64, route: (u32, u32, u32), bytes: u64) -> Event {
    let span_ns = (at_us * 1000, at_us * 1000 + 500);
    Event { bytes, flops: 10, ..support::event(name, activity, span_ns, route) }
}

/// Elements, one product of halo rows, one reduction, advance: the same on both ranks.
fn events_of(rank: u32) -> Vec<Event> {
    let own = (0, rank, rank);
    let other = (1, 1 - rank, 1 - rank);
    vec![
        event(EventName::Elements, Activity::Compute, 0, own, 1_000_000),
        event(EventName::Publish, Activity::Transfer, 10, own, 1200),
        event(EventName::SpmvLocal, Activity::Compute, 20, own, 2_000_000),
        event(EventName::Receive, Activity::Wait, 30, other, 0),
        event(EventName::Receive, Activity::Transfer, 40, other, 1200),
        event(EventName::SpmvRemote, Activity::Compute, 50, own, 100_000),
        event(EventName::AllReduce, Activity::Wait, 60, own, 24),
        event(EventName::Advance, Activity::Compute, 70, own, 100_000),
    ]
}

struct Recorded {
    folder: tempfile::TempDir,
}

impl Recorded {
    fn new(second: &[Event]) -> Recorded {
        Recorded::of(&events_of(0), second)
    }

    fn of(first: &[Event], second: &[Event]) -> Recorded {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("pair.toml"), PAIR).unwrap();
        let mut report = Report::default();
        (report.header.vertices, report.header.workers) = (200, 2);
        report.header.exchange = "halo".into();
        report.save(&folder.path().join("report.json")).unwrap();
        let trace = folder.path().join("trace.json");
        let mut writer = TraceWriter::create(&trace, &["a".into(), "b".into()], 0).unwrap();
        let ranks = [
            RankEvents { rank: 0, epoch_unix_ns: 0, events: first },
            RankEvents { rank: 1, epoch_unix_ns: 0, events: second },
        ];
        writer.append(&ranks).unwrap();
        Recorded { folder }
    }

    fn args(&self, exchange: Option<PredictExchange>) -> PredictArgs {
        PredictArgs {
            run: self.folder.path().into(),
            topology: self.folder.path().join("pair.toml"),
            schedule: ScheduleKind::Direct,
            exchange,
            kernels: PredictKernels::Device,
            measured: None,
            json: true,
            trace: None,
            svg: None,
        }
    }
}

fn predicted(args: &PredictArgs) -> Value {
    let mut out = Vec::new();
    write_prediction(args, &mut out).unwrap_or_else(|error| panic!("{error}"));
    serde_json::from_slice(&out).unwrap()
}

fn us(value: &Value) -> f64 {
    value.as_f64().unwrap() * 1e6
}

fn close(found: f64, expected: f64) {
    assert!((found - expected).abs() < 1e-6 * expected.max(1.0), "{found} is not {expected}");
}

#[test]
fn a_step_re_timed_by_hand() {
    let run = Recorded::new(&events_of(1));
    let found = predicted(&run.args(None));
    // Elements 11, pack 1.024, then the local rows 21 (the halo is there after 1.2 + 2), remote rows 2, reduction
    // 2 + 0.864, advance 2.
    close(us(&found["mean_modelled_s"]), 11.0 + 1.024 + 21.0 + 2.0 + 2.864 + 2.0);
    let stages = &found["stage_modelled_s"];
    close(us(&stages["elements"]), 11.0);
    close(us(&stages["solve"]), 1.024 + 21.0 + 2.0 + 2.864);
    // One GPU: 21 + 43 + 3.
    close(us(&found["steps"][0]["one_gpu_modelled_s"]), 67.0);
    close(us(&found["steps"][0]["busy_modelled_s_per_rank"][1]), 11.0 + 1.024 + 21.0 + 2.0 + 2.0);
    close(found["speed_up"].as_f64().unwrap(), 67.0 / 39.888);
    assert_eq!((&found["modelled"], &found["exchange"]), (&Value::from(true), &Value::from("halo")));
}

#[test]
fn waits_within_a_query_are_modelled_anew() {
    let [first, second] = [0, 1].map(|rank: u32| {
        let (own, other) = ((0, rank, rank), (0, 1 - rank, 1 - rank));
        // What a query takes besides its bytes: of the ranks' lists, 1000 and 3000 bytes, and of a wait of 0.5 s.
        let (query, share) = (EventName::ProximityQuery, EventName::ShareQuery);
        let mut events = vec![
            event(query, Activity::Compute, 0, own, 0),
            event(share, Activity::Wait, 10, own, 8),
            event(query, Activity::Compute, 20, own, 0),
            event(share, Activity::Transfer, 30, own, 1000 + 2000 * u64::from(rank)),
            event(share, Activity::Wait, 40, other, 0),
            event(share, Activity::Transfer, 500_040, other, 3000 - 2000 * u64::from(rank)),
            event(query, Activity::Compute, 500_050, own, 1_000_000),
        ];
        (events[4].end_ns, events[0].flops, events[2].flops) = (500_040_000, 0, 0);
        events.extend(events_of(rank).into_iter().map(|event| Event {
            asked_ns: event.asked_ns + 500_060_000,
            start_ns: event.start_ns + 500_060_000,
            end_ns: event.end_ns + 500_060_000,
            ..event
        }));
        events
    });
    let run = Recorded::of(&first, &second);
    let found = predicted(&run.args(None));
    // An all-gather of 2.864, 3 kB at 1 GB/s and 2 us, a kernel of 11; the rest as without a query.
    close(us(&found["stage_modelled_s"]["collisions"]), 2.864 + 5.0 + 11.0);
    close(us(&found["mean_modelled_s"]), 18.864 + 39.888);
    close(us(&found["steps"][0]["busy_modelled_s_per_rank"][0]), 11.0 + 37.024);
    // As recorded: three parts of 0.5 us.
    let recorded = predicted(&PredictArgs { kernels: PredictKernels::Recorded, ..run.args(None) });
    close(us(&recorded["stage_modelled_s"]["collisions"]), 2.864 + 5.0 + 1.5);
    // The halo of products is that of the products, not of what was told before.
    let full = predicted(&run.args(Some(PredictExchange::Full)));
    close(us(&full["mean_modelled_s"]), 18.864 + 11.0 + 21.88 + 1.12 + 2.864 + 2.0);
}

#[test]
fn the_other_exchanges_of_the_same_step_by_hand() {
    let run = Recorded::new(&events_of(1));
    // 100 halo rows = 12,000 bytes of A_01: A_00 is there after 11 + 21.88, A_01 takes 1.12; then 2.864 and 2.
    let full = predicted(&run.args(Some(PredictExchange::Full)));
    close(us(&full["mean_modelled_s"]), 11.0 + 21.88 + 1.12 + 2.864 + 2.0);
    // All-gather first: 1.2 + 2, then everything at once.
    let first = predicted(&run.args(Some(PredictExchange::GatherFirst)));
    close(us(&first["mean_modelled_s"]), 11.0 + 3.2 + 22.0 + 2.864 + 2.0);
    // Kernel times as recorded: 0.5 us each; the reduction and the halo remain.
    let recorded = predicted(&PredictArgs { kernels: PredictKernels::Recorded, ..run.args(None) });
    close(us(&recorded["mean_modelled_s"]), 0.5 + 3.2 + 0.5 + 2.864 + 0.5);
}

#[test]
fn a_trace_whose_ranks_differ_is_refused() {
    let mut second = events_of(1);
    second.remove(0);
    let run = Recorded::new(&second);
    let error = write_prediction(&run.args(None), &mut Vec::new()).unwrap_err();
    assert_eq!(error.exit_code, 2);
    assert!(error.message.contains("step 1: ranks 0 and 1 recorded different things (1. in order)"), "{error}");
}

#[test]
fn what_is_missing_is_named() {
    let run = Recorded::new(&events_of(1));
    let three = predicted_error(&PredictArgs { topology: repository("topology/no_such.toml"), ..run.args(None) });
    assert!(three.contains("no_such.toml"), "{three}");
    std::fs::write(run.folder.path().join("trace.json"), "[\n]\n").unwrap();
    let empty = predicted_error(&run.args(None));
    assert!(empty.contains("holds no events") && empty.contains("--trace-steps"), "{empty}");
    std::fs::write(run.folder.path().join("trace.json"), "[\n{\"ph\":\"X\",\"name\":1}\n]\n").unwrap();
    let broken = predicted_error(&run.args(None));
    assert!(broken.contains("trace.json, line 2"), "{broken}");
}

fn predicted_error(args: &PredictArgs) -> String {
    let error = write_prediction(args, &mut Vec::new()).unwrap_err();
    assert_eq!(error.exit_code, 2, "{error}");
    error.to_string()
}

#[test]
fn a_cut_off_trace_is_read_up_to_there() {
    let run = Recorded::new(&events_of(1));
    let path = run.folder.path().join("trace.json");
    let whole = read_trace(&path).unwrap();
    assert_eq!(whole[&1].iter().map(Vec::len).collect::<Vec<_>>(), [8, 8]);
    let text = std::fs::read_to_string(&path).unwrap();
    let last = text.rfind("\"name\":\"advance state\"").unwrap();
    std::fs::write(&path, &text[..last + 30]).unwrap();
    assert_eq!(read_trace(&path).unwrap()[&1].iter().map(Vec::len).collect::<Vec<_>>(), [8, 7]);
}

#[test]
fn a_real_run_is_predicted_on_the_papers_machine() {
    let place = Place::new();
    let scene = repository("scenes/flag.toml");
    let flags = "--resolution 2000 --frames 1 --executor cpu --threads 1 --trace-steps 3";
    for exchange in ["halo", "full"] {
        let out = format!("{exchange}-run");
        place
            .run(&format!(
                "run {} --workers 4 {flags} --exchange {exchange} --schedule best --out {out}",
                scene.display()
            ))
            .expect(0);
        assert_eq!(place.report(&out)["schedule"], "best");
        let folder: PathBuf = place.path(&out);
        check_queries(&folder);
        let args = |exchange| PredictArgs {
            run: folder.clone(),
            topology: repository("topology/titan_xp_4.toml"),
            schedule: ScheduleKind::Best,
            exchange: Some(exchange),
            kernels: PredictKernels::Device,
            measured: Some(folder.clone()),
            json: true,
            trace: Some(folder.join("modelled.json")),
            svg: Some(folder.join("modelled.svg")),
        };
        for exchange in [PredictExchange::Halo, PredictExchange::Full, PredictExchange::GatherFirst] {
            let found = predicted(&args(exchange));
            assert_eq!(found["steps"].as_array().unwrap().len(), 3);
            let speed_up = found["speed_up"].as_f64().unwrap();
            assert!(speed_up > 0.05 && speed_up <= 4.0, "{found:#}");
            let idle = found["idle_share"].as_f64().unwrap();
            assert!((0.0..1.0).contains(&idle), "{found:#}");
            assert!(found["measured"]["relative_error"].as_f64().unwrap() > -1.0, "{found:#}");
            check_pictures(&folder);
        }
    }
}

/// Ranks wait for each other in queries of a real run, and no work of a query is under way meanwhile.
fn check_queries(folder: &Path) {
    let mut waits_seen = 0;
    for (step, ranks) in read_trace(&folder.join("trace.json")).unwrap() {
        for (rank, events) in ranks.iter().enumerate() {
            let named = |event: &&Event, names: &[EventName]| names.iter().any(|name| *name as u32 == event.name);
            let queries = [EventName::ProximityQuery, EventName::ContinuousQuery, EventName::LocalContacts];
            let is_share = |event: &&Event| EventName::from_number(event.name).is_some_and(EventName::is_share);
            let work: Vec<&Event> = events.iter().filter(|event| named(event, &queries)).collect();
            let shares: Vec<&Event> = events.iter().filter(is_share).collect();
            assert!(work.iter().all(|event| event.activity == Activity::Compute as u32));
            assert!(!work.is_empty() && shares.len() >= 6, "step {step}, rank {rank}");
            waits_seen += shares.iter().filter(|event| event.activity == Activity::Wait as u32).count();
            for (work, share) in work.iter().flat_map(|work| shares.iter().map(move |share| (work, share))) {
                let apart = work.end_ns <= share.start_ns || share.end_ns <= work.start_ns;
                assert!(apart, "step {step}, rank {rank}: {work:?} and {share:?}");
            }
        }
    }
    assert!(waits_seen > 0);
}

/// The trace is one that other tools and `read_trace` take; the picture shows every rank.
fn check_pictures(folder: &Path) {
    let modelled = read_trace(&folder.join("modelled.json")).unwrap();
    assert_eq!(modelled[&1].len(), 4);
    let svg = std::fs::read_to_string(folder.join("modelled.svg")).unwrap();
    assert!(svg.contains("rank 3") && svg.matches("<title>").count() >= 8, "{svg}");
}
