//! Which cores workers keep to: one each where they share cores evenly, any with `--bind-cores never`.

use support::process::{Place, flag};

/// Cores that the main thread of a process may run on.
fn cores_of(pid: i32) -> Option<usize> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let list = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"))?;
    let count = |range: &str| {
        let mut ends = range.split('-').map(|end| end.trim().parse::<usize>().ok());
        let first = ends.next().flatten()?;
        Some(ends.next().flatten().unwrap_or(first) - first + 1)
    };
    list.split(',').map(count).sum()
}

#[test]
fn workers_that_share_cores_keep_to_one_each_unless_told_otherwise() {
    let own = cores_of(std::process::id() as i32).expect("the cores of this process");
    if !(2..=16).contains(&own) {
        println!("skipped: needs 2 to 16 cores, not {own}");
        return;
    }
    let workers = 2 * own;
    let place = Place::new();
    place.write("flag.toml", flag(500, 5, 1_000_000));
    for (choice, expected) in [("auto", 1), ("never", own)] {
        let words = "run flag.toml --executor cpu --threads 1";
        let mut running = place.start(&format!("{words} --workers {workers} --bind-cores {choice} --out {choice}"));
        // The first frame is written once every worker has chosen its cores.
        running.wait_for_frame(choice, 1);
        for rank in [0, workers - 1] {
            let pid = running.worker(rank);
            assert_eq!(cores_of(pid), Some(expected), "--bind-cores {choice}, rank {rank}");
        }
        support::process::signal(running.pid(), support::process::Signal::INT);
        running.wait().expect(130);
        let recipe = std::fs::read_to_string(place.path(choice).join("run.toml")).expect("the recipe");
        assert!(recipe.contains(&format!("bind_cores = \"{choice}\"")), "{recipe}");
    }
}

#[test]
fn a_choice_that_does_not_exist_is_refused() {
    let place = Place::new();
    place.write("flag.toml", flag(500, 5, 1));
    place.run("run flag.toml --bind-cores always").expect(2).says(&["--bind-cores", "always", "auto, never"]);
}
