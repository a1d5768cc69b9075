//! Sessions: workers that are loaded, set and stepped in any order have the bits of a run that went through, on threads
//! of this process and over iceoryx2; sessions side by side have those of one alone; nothing is left behind.

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use loomtree::coordinator::session::{Next, StepDone, Watch};
use loomtree::coordinator::shot::{Ended, News, Segment, play};
use loomtree::coordinator::{Crew, CrewError};
use loomtree::coordinator::{Launch, RunOptions, RunPlan, Session, SessionError, SessionOptions, SessionPlace};
use loomtree::model::{PlasticCounts, State};
use loomtree::output::Checkpoint;
use loomtree::protocol::{CONNECTING, ExecutorChoice};
use loomtree::scene::PreconditionerKind;
use loomtree::transport::{ControlWorker, OneProcess, RunName, ThreadJob, ThreadLauncher, thread_channel};
use support::process::{Place, Running, flag};

const STEPS: u32 = 12;
const MIDDLE: u32 = 5;

fn options(workers: usize, triangles: u64) -> RunOptions {
    RunOptions {
        workers,
        resolution: Some(triangles),
        executor: ExecutorChoice::Cpu,
        threads: Some(1),
        preconditioner: Some(PreconditionerKind::Schwarz),
        heartbeat_s: 60.0,
        ..RunOptions::default()
    }
}

fn level(scene: &Path, workers: usize, triangles: u64) -> RunPlan {
    RunPlan::new(scene, &options(workers, triangles)).expect("a level")
}

/// Keeps every state.
#[derive(Default)]
struct Keep(Vec<(u32, State)>);

impl Watch for Keep {
    fn wants_events(&self, _step: u32) -> bool {
        false
    }
    fn step(&mut self, done: StepDone) -> Next {
        assert!(done.ranks.iter().all(|stats| stats.step == done.step && stats.converged));
        Next::State
    }
    fn state(&mut self, step: u32, state: State) -> ControlFlow<()> {
        self.0.push((step, state));
        ControlFlow::Continue(())
    }
}

fn advance(session: &mut Session, to: u32) -> Vec<String> {
    let mut kept = Keep::default();
    session.advance(to, &mut kept).expect("steps");
    kept.0.iter().map(|(_, state)| state.hash()).collect()
}

/// Loads, steps, sets and loads again; every way to the last step must lead to the same bits.
fn check(mut session: Session, fine: &RunPlan, coarse: &RunPlan) {
    assert!(matches!(session.set_state(&State::zeros(3, PlasticCounts::default()), 0), Err(SessionError::NotLoaded)));
    let start = State::start_of(&fine.scene);
    assert_eq!(session.load(fine).expect("loaded").len(), fine.partition.ranks());
    assert_eq!(session.state().expect("a state").hash(), start.hash());
    let mut kept = Keep::default();
    session.advance(STEPS, &mut kept).expect("steps");
    let middle = kept.0[MIDDLE as usize - 1].1.clone();
    let hashes: Vec<String> = kept.0.iter().map(|(_, state)| state.hash()).collect();
    let after_middle = &hashes[MIDDLE as usize..];
    assert_ne!(hashes[0], hashes[1]);

    // Back to the middle, on workers that have gone on.
    session.set_state(&middle, MIDDLE).expect("set");
    assert_eq!(session.state().expect("a state").hash(), middle.hash());
    assert_eq!(advance(&mut session, STEPS), after_middle, "set back");

    // A smaller mesh fits into the ports there are; the fine one again must come out the same.
    session.load(coarse).expect("loaded");
    let coarse_hashes = advance(&mut session, 3);
    session.load(fine).expect("loaded");
    session.set_state(&middle, MIDDLE).expect("set");
    assert_eq!(advance(&mut session, STEPS), after_middle, "after a smaller mesh");
    let refused = session.set_state(&State::start_of(&coarse.scene), 0);
    assert!(matches!(refused, Err(SessionError::Unfit { .. })), "{refused:?}");

    // From the start of the coarse one, as if it were the first.
    session.load(coarse).expect("loaded");
    assert_eq!(advance(&mut session, 3), coarse_hashes, "the smaller mesh again");
    session.dismiss();
}

/// As [`check`], from the smaller mesh to the larger: the first data ports are too small for the second mesh.
fn check_growing(mut session: Session, fine: &RunPlan, coarse: &RunPlan, ports: &dyn Fn() -> usize) {
    session.load(coarse).expect("loaded");
    advance(&mut session, 2);
    let first = ports();
    session.load(fine).expect("loaded");
    assert_eq!(ports(), first, "the ports of the smaller mesh are given up");
    let once = advance(&mut session, MIDDLE);
    session.load(fine).expect("loaded");
    assert_eq!(advance(&mut session, MIDDLE), once);
    assert_eq!(ports(), first);
    session.dismiss();
}

/// Two scenes: a flag, and a sheet that falls on a ball.
fn scenes(place: &Place) -> [std::path::PathBuf; 2] {
    place.write("flag.toml", flag(800, 4, 10));
    place.write("ball.toml", BALL);
    ["flag.toml", "ball.toml"].map(|name| place.path(name))
}

const BALL: &str = r#"
    resolution = 800
    [simulation]
    step_s = 0.004
    steps_per_frame = 4
    frames = 10
    [[cloth]]
    sheet = { size_m = [0.3, 0.3] }
    origin_m = [-0.15, -0.15, 0.004]
    velocity_m_s = [0, 0, -1]
    [[obstacle]]
    name = "ball"
    sphere = { center_m = [0, 0, -0.08], radius_m = 0.08, triangles = 400 }
"#;

#[test]
fn any_order_on_threads() {
    let place = Place::new();
    for scene in scenes(&place) {
        for workers in [1, 3] {
            let (fine, coarse) = (level(&scene, workers, 800), level(&scene, workers, 200));
            let assemble = || {
                Session::assemble(SessionPlace::ALONE, &options(workers, 0).session(), &Launch::Threads)
                    .expect("a session")
            };
            check(assemble(), &fine, &coarse);
            check_growing(assemble(), &fine, &coarse, &|| 0);
        }
    }
}

/// A session whose workers are processes.
fn over_iceoryx<'a>(place: &'a Place, options: &SessionOptions) -> (Session, RunName, Vec<Running<'a>>) {
    let session = Session::assemble(SessionPlace::ALONE, options, &Launch::Await).expect("a session");
    let run = session.run_name().expect("a run of processes").clone();
    let program = env!("CARGO_BIN_EXE_loomtree-worker");
    // The run lies where this process makes it, not where programs of the place would.
    let folder = std::env::temp_dir().display().to_string();
    let workers = (0..options.workers)
        .map(|rank| place.start_program(program, &format!("--run {run} --rank {rank}"), &[("TMPDIR", &folder)]))
        .collect();
    (session, run, workers)
}

#[test]
fn any_order_over_iceoryx() {
    let place = Place::new();
    for scene in scenes(&place) {
        let options = options(3, 0).session();
        let (fine, coarse) = (level(&scene, 3, 800), level(&scene, 3, 200));
        let (session, run, workers) = over_iceoryx(&place, &options);
        check(session, &fine, &coarse);
        workers.into_iter().for_each(|worker| drop(worker.wait().expect(0)));
        assert!(run.shared_memory_files().is_empty() && !run.root().exists(), "something of {run} is left");

        let (session, run, workers) = over_iceoryx(&place, &options);
        check_growing(session, &fine, &coarse, &|| run.shared_memory_files().len());
        workers.into_iter().for_each(|worker| drop(worker.wait().expect(0)));
        assert!(run.shared_memory_files().is_empty() && !run.root().exists(), "something of {run} is left");
    }
}

/// Hash of every state and the session that made it, by step.
fn played(segments: &[Segment], sessions: usize, workers: usize) -> (Vec<(u32, String)>, Vec<usize>) {
    let (mut hashes, mut used) = (Vec::new(), Vec::new());
    let options = SessionOptions { silence: Duration::from_secs(60), ..options(workers, 0).session() };
    let ended = play(segments, sessions, &options, &Launch::Threads, &mut |told| {
        match told.news {
            News::Ready(ready) => assert_eq!(ready.len(), workers),
            News::Step(_) => used.push(told.session),
            News::State { step, state } => hashes.push((step, state.hash())),
            News::Ended => {}
        }
        Ok::<(), ()>(())
    });
    assert_eq!(ended.expect("played"), Ended::Done);
    hashes.sort();
    used.sort_unstable();
    used.dedup();
    (hashes, used)
}

#[test]
fn sessions_side_by_side_have_the_bits_of_one() {
    let place = Place::new();
    let scene = &scenes(&place)[1];
    let level = level(scene, 2, 600);
    let all = |_| true;
    let whole = Segment { wants_state: Arc::new(all), ..Segment::plain(&level, 9) };
    let (through, used) = played(&[whole.clone()], 1, 2);
    assert_eq!((through.len(), &used[..]), (9, &[0][..]));

    // The states that the later segments start from, as a run kept them.
    let mut session =
        Session::assemble(SessionPlace::ALONE, &options(2, 0).session(), &Launch::Threads).expect("a session");
    session.load(&level).expect("loaded");
    let mut kept = Keep::default();
    session.advance(6, &mut kept).expect("steps");
    session.dismiss();
    let start = |step: u32| Some(Arc::new(kept.0[step as usize - 1].1.clone()));
    let parts = [(0, 3, None), (3, 6, start(3)), (6, 9, start(6))];
    let parts = parts.map(|(first_step, last_step, start)| Segment { first_step, last_step, start, ..whole.clone() });
    let (split, used) = played(&parts, 2, 2);
    assert_eq!(split, through);
    assert_eq!(used, [0, 1], "both sessions have worked");
}

#[test]
fn a_listener_that_has_had_enough_ends_the_shot() {
    let place = Place::new();
    let level = level(&scenes(&place)[0], 1, 200);
    let segment = Segment::plain(&level, 1_000_000);
    let options = options(1, 0).session();
    let ended = play(&[segment.clone(), segment], 2, &options, &Launch::Threads, &mut |told| match told.news {
        News::Step(done) if done.step == 3 => Err("enough"),
        _ => Ok(()),
    });
    assert!(matches!(ended, Err(loomtree::coordinator::shot::ShotError::Listener("enough"))));
}

#[test]
fn a_run_keeps_the_states_that_were_asked_for() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 3, 4));
    let states = |out: &str| {
        let mut kept: Vec<Checkpoint> = std::fs::read_dir(place.path(out).join("states"))
            .expect("states")
            .map(|entry| std::fs::read(entry.expect("an entry").path()).expect("a state"))
            .map(|bytes| Checkpoint::from_bytes(&bytes).expect("a checkpoint"))
            .collect();
        kept.sort_by_key(|kept| kept.step);
        kept
    };
    let steps = |out: &str| states(out).iter().map(|kept| kept.step).collect::<Vec<_>>();
    let run = "run flag.toml --executor cpu --threads 1";
    place.run(&format!("{run} --workers 2 --keep-states frames --out frames")).expect(0);
    assert_eq!(steps("frames"), [0, 3, 6, 9, 12]);
    let hashes: Vec<(u64, String)> =
        states("frames").iter().map(|kept| (u64::from(kept.frame), kept.state.hash())).collect();
    assert_eq!(hashes, place.hashes("frames"));
    // Without being asked again, a resumed run keeps on keeping; other steps than those of frames change no frame.
    place.run(&format!("{run} --workers 1 --keep-states 5 --frames 2 --out fives")).expect(0);
    assert_eq!(steps("fives"), [0, 5]);
    place.run("run --resume --out fives --frames 4").expect(0);
    assert_eq!(steps("fives"), [0, 5, 10]);
    assert_eq!(place.hashes("fives"), place.hashes("frames"));
    place.run(&format!("{run} --overwrite --frames 1 --out fives")).expect(0);
    assert!(!place.path("fives").join("states").join("step_00000005.ltc").exists());
    for bad in ["0", "-3", "every"] {
        let ended = place.run(&format!("{run} --keep-states={bad} --out bad")).expect(2);
        assert!(ended.stderr.contains("neither 'frames' nor a number of steps"), "{}", ended.story);
    }
}

/// Files of a run that were removed while it set up: all workers are alive, and each waits for a port that never comes.
#[test]
fn workers_that_do_not_reach_each_other_are_given_up() {
    let (control, seats) = thread_channel(3);
    let launcher = ThreadLauncher::new(seats, |_| -> ThreadJob {
        Box::new(|seat| {
            let worker = seat.connect();
            worker.progress(CONNECTING);
            while !worker.coordinator_has_ended() {
                worker.beat();
                std::thread::sleep(Duration::from_millis(5));
            }
        })
    });
    let patient = Duration::from_secs(60);
    let mut crew = Crew::start(Box::new(control), Box::new(launcher), Box::new(OneProcess), patient).expect("a crew");
    crew.limit_connecting(Duration::from_millis(200));
    let error = crew.collect(patient, |_, _, _| true).expect_err("nobody answers");
    assert!(matches!(error, CrewError::Unconnected { rank: 0, .. }), "{error}");
    assert!(error.to_string().contains("worker 0 did not connect to the others within 0 s"), "{error}");
}
