//! A whole run inside one process, its workers threads: the same bits, the same sentences as with processes.

use loomtree::coordinator::{Launch, RunError, RunOptions, RunPlaces, RunPlan, RunSummary, run};
use loomtree::output::Existing;
use loomtree::protocol::ExecutorChoice;
use support::process::{Place, flag};

fn on_threads(place: &Place, scene: &str, workers: usize, out: &str) -> Result<RunSummary, RunError> {
    let options = RunOptions { workers, executor: ExecutorChoice::Cpu, threads: Some(1), ..RunOptions::default() };
    let places = RunPlaces { scene: place.path(scene), out: place.path(out), existing: Existing::Refuse };
    let plan = RunPlan::new(&places.scene, &options).expect("a plan");
    run(plan, &options, &places, &Launch::Threads)
}

#[test]
fn threads_give_the_bits_of_processes() {
    let place = Place::new();
    place.write("flag.toml", flag(600, 2, 4));
    for workers in [1, 3] {
        let words = format!("run flag.toml --executor cpu --threads 1 --workers {workers} --out processes{workers}");
        place.run(&words).expect(0);
        let out = format!("threads{workers}");
        let summary = on_threads(&place, "flag.toml", workers, &out).expect("a run");
        assert_eq!((summary.frames, summary.steps, summary.stopped), (5, 8, false));
        assert_eq!(place.hashes(&out), place.hashes(&format!("processes{workers}")));
        assert_eq!(place.report(&out)["workers"], workers);
    }
}

/// A worker that cannot go on is heard, and the others leave: no thread of the run is waited for in vain.
#[test]
fn a_failure_of_a_thread_ends_the_run_in_words() {
    let place = Place::new();
    place.write(
        "apart.toml",
        r#"
        resolution = 200
        [simulation]
        collisions = false
        steps_per_frame = 1
        frames = 50
        [[cloth]]
        sheet = { size_m = [1, 1] }
        velocity_m_s = [0, 0, 1e25]
        [[pin]]
        edge = "left"
        "#,
    );
    match on_threads(&place, "apart.toml", 3, "out") {
        Err(RunError::Failed(text)) => {
            assert!(text.contains("is not finite") && text.contains("continue with --resume"), "{text}")
        }
        other => panic!("{other:?}"),
    }
    place.newest_checkpoint("out");
}
