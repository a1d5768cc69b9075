//! The transport between real processes: this test binary starts itself again as the ranks of a run, lets them work,
//! kills one of them, and looks at what is left on the machine.
//!
//! With `LOOMTREE_TRANSPORT_TIMES=1` (and `--nocapture`) it also prints how long a round takes.

use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use loomtree::transport::{
    IceoryxOptions, IceoryxTransport, Neighbor, Pattern, ProcessWatch, Rows, RunName, RunState, Transport,
    TransportError, list_runs,
};

/// Generous: it only turns a deadlock into a failure.
const WATCHDOG: Duration = Duration::from_secs(300);

/// What a child process finds in its environment.
const ROLE: &str = "LOOMTREE_TEST_ROLE";

/// The children of one test; those still running are killed when a test fails.
struct Children(Vec<Child>);

impl Drop for Children {
    fn drop(&mut self) {
        for child in &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Children {
    fn start(run: &RunName, program: &str, ranks: usize) -> Children {
        let executable = std::env::current_exe().expect("the test binary");
        let child = |rank: usize| {
            Command::new(&executable)
                .args(["transport_processes::child_process", "--exact", "--nocapture", "--test-threads=1"])
                .env(ROLE, format!("{run} {program} {rank} {ranks}"))
                .stdout(Stdio::piped())
                .stderr(Stdio::inherit())
                .spawn()
                .expect("a child process")
        };
        Children((0..ranks).map(child).collect())
    }

    /// Waits until every child has ended by itself; (rank, success, text it printed).
    fn join(&mut self) -> Vec<(bool, String)> {
        let start = Instant::now();
        while self.0.iter_mut().any(|child| child.try_wait().expect("a child's state").is_none()) {
            assert!(start.elapsed() < WATCHDOG, "the watchdog bit: children hang");
            std::thread::sleep(Duration::from_millis(5));
        }
        let end = |child: &mut Child| {
            let mut text = String::new();
            child.stdout.take().expect("piped").read_to_string(&mut text).expect("text");
            (child.wait().expect("an exit status").success(), text)
        };
        self.0.iter_mut().map(end).collect()
    }
}

fn connect(run: &RunName, rank: usize, ranks: usize, max_len: usize, deadline: Duration) -> IceoryxTransport {
    let options = IceoryxOptions { rank, ranks, epoch: 0, max_len, deadline, on_wait: Box::new(|| false) };
    IceoryxTransport::connect(run, options).expect("connect")
}

/// Not a test of its own: the program of a child process.
#[test]
fn child_process() {
    let Ok(role) = std::env::var(ROLE) else {
        println!("skipped: only runs as a child of the other tests");
        return;
    };
    let words: Vec<&str> = role.split(' ').collect();
    let [run, program, rank, ranks] = words[..] else { panic!("bad role '{role}'") };
    let (run, rank, ranks): (RunName, usize, usize) =
        (run.parse().unwrap(), rank.parse().unwrap(), ranks.parse().unwrap());
    let _member = run.join(&format!("rank {rank}")).expect("the run");
    match program {
        "rounds" => println!("sum {}", rounds(&mut connect(&run, rank, ranks, 3000, WATCHDOG), 200).expect("rounds")),
        "endless" => {
            let mut transport = connect(&run, rank, ranks, 3000, Duration::from_secs(2));
            rounds(&mut transport, 20).expect("all are alive");
            std::fs::write(run.root().join(format!("at-work-{rank}")), "").expect("a mark");
            println!("error {}", rounds(&mut transport, usize::MAX).expect_err("a peer was killed"));
        }
        "times" => times(&mut connect(&run, rank, ranks, 1 << 18, WATCHDOG)),
        other => panic!("unknown program {other}"),
    }
}

/// `count` rounds of what a solver does; the sum of everything this rank saw.
fn rounds(transport: &mut IceoryxTransport, count: usize) -> Result<f64, TransportError> {
    let (rank, ranks) = (transport.rank(), transport.ranks());
    let (mut sum, mut out) = (0.0, Vec::new());
    for round in 0..count {
        let lens: Vec<usize> = (0..ranks).map(|rank| (rank * 977 + round * 131) % 3000).collect();
        let pattern = Pattern::whole(rank, &lens);
        transport.start(&pattern, 1, &mut |buffer| buffer.fill((rank + round % 100) as f32))?;
        let mut seen = lens[rank] as f64 * (rank + round % 100) as f64;
        for source in pattern.sources().iter().map(|source| source.rank) {
            transport.finish(source, &mut |message| seen += message.values().iter().map(|&v| v as f64).sum::<f64>())?;
        }
        // A border of one row with the ranks before and after.
        let neighbors = || {
            let beside = [rank.checked_sub(1), Some(rank + 1).filter(|&next| next < ranks)];
            let rows = || Rows::At(vec![round as u32 % 5]);
            beside.into_iter().flatten().map(|rank| Neighbor { rank, message_rows: 5, rows: rows() }).collect()
        };
        let border = Pattern::new(5, neighbors(), neighbors());
        transport.start(&border, 3, &mut |buffer| buffer.fill(rank as f32))?;
        for source in border.sources().iter().map(|source| source.rank) {
            transport.finish(source, &mut |message| assert_eq!(message.row(0), [source as f32; 3]))?;
        }
        transport.all_gather(&[seen, rank as f64], &mut out)?;
        assert!(out.iter().all(|values| values[0] == seen), "ranks saw different messages in round {round}");
        sum += seen + out.iter().map(|values| values[1]).sum::<f64>();
    }
    Ok(sum)
}

/// The sum that [`rounds`] must give.
fn expected_sum(ranks: usize, count: usize) -> f64 {
    let message = |rank: usize, round: usize| (((rank * 977 + round * 131) % 3000) * (rank + round % 100)) as f64;
    let round_sum = |round: usize| (0..ranks).map(|rank| message(rank, round) + rank as f64).sum::<f64>();
    (0..count).map(round_sum).sum()
}

fn assert_nothing_left(run: &RunName) {
    assert!(!run.root().exists(), "{} is left", run.root().display());
    assert_eq!(run.shared_memory_files(), [], "shared memory is left");
    assert!(list_runs().iter().all(|found| found.run != *run));
}

/// Returns once all ranks of the "endless" program are connected and have done some rounds.
fn wait_until_at_work(run: &RunName, ranks: usize) {
    let start = Instant::now();
    while !(0..ranks).all(|rank| run.root().join(format!("at-work-{rank}")).exists()) {
        assert!(start.elapsed() < WATCHDOG, "the ranks do not start");
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn ranks_agree(ranks: usize) {
    let (run, member) = RunName::create("coordinator").unwrap();
    let mut children = Children::start(&run, "rounds", ranks);
    for (rank, (success, text)) in children.join().into_iter().enumerate() {
        assert!(success, "rank {rank} failed: {text}");
        let sum = text.lines().find_map(|line| line.split_once("sum ")).expect("a sum").1;
        assert_eq!(sum.parse::<f64>().unwrap(), expected_sum(ranks, 200), "rank {rank}");
    }
    drop(member);
    assert_nothing_left(&run);
}

#[test]
fn two_processes_agree() {
    ranks_agree(2);
}

#[test]
fn four_processes_agree() {
    ranks_agree(4);
}

#[test]
fn eight_processes_agree() {
    ranks_agree(8);
}

#[test]
fn the_others_notice_a_killed_rank_and_nothing_is_left() {
    let (run, member) = RunName::create("coordinator").unwrap();
    let mut children = Children::start(&run, "endless", 4);
    wait_until_at_work(&run, 4);
    let start = Instant::now();
    let watch = ProcessWatch::new(children.0[2].id());
    assert!(!watch.has_ended());
    children.0[2].kill().unwrap();
    while !watch.has_ended() {
        assert!(start.elapsed() < WATCHDOG, "the killed process does not end");
        std::thread::sleep(Duration::from_millis(1));
    }
    let ends = children.join();
    for (rank, (success, text)) in ends.iter().enumerate() {
        if rank == 2 {
            assert!(!success);
        } else {
            assert!(*success && text.contains("error rank"), "rank {rank}: {text}");
        }
    }
    assert!(run.root().exists(), "the coordinator is still a member");
    drop(member);
    assert_nothing_left(&run);
}

/// Nobody purges for a coordinator that was killed, except the last rank that leaves.
#[test]
fn the_last_rank_cleans_up_when_the_coordinator_is_gone() {
    let (run, member) = RunName::create("coordinator").unwrap();
    let mut children = Children::start(&run, "endless", 2);
    wait_until_at_work(&run, 2);
    // As if this process had been killed: its membership ends, the run goes on.
    drop(member);
    assert!(run.root().exists());
    children.0[0].kill().unwrap();
    let ends = children.join();
    assert!(ends[1].0, "{}", ends[1].1);
    assert_nothing_left(&run);
}

#[test]
fn a_killed_run_is_found_and_purged() {
    let (run, member) = RunName::create("coordinator").unwrap();
    let mut children = Children::start(&run, "endless", 2);
    wait_until_at_work(&run, 2);
    assert!(list_runs().iter().any(|found| found.run == run && found.state == RunState::Alive));
    drop(member);
    for child in &mut children.0 {
        child.kill().unwrap();
    }
    children.join();
    let found = list_runs().into_iter().find(|found| found.run == run).expect("the dead run is found");
    assert!(found.state == RunState::Dead && found.shared_memory_files > 0 && found.shared_memory_bytes > 0);
    assert!(run.purge_if_last().unwrap());
    assert_nothing_left(&run);
}

/// Prints medians; only a report, so it never fails on a slow machine.
fn times(transport: &mut IceoryxTransport) {
    let (rank, ranks) = (transport.rank(), transport.ranks());
    let median = |mut times: Vec<Duration>| {
        times.sort();
        (times[times.len() / 2].as_secs_f64() * 1e6, times[times.len() * 99 / 100].as_secs_f64() * 1e6)
    };
    let mut out = Vec::new();
    let gather = (0..5000).map(|round| {
        let start = Instant::now();
        transport.all_gather(&[round as f64, 1.0], &mut out).unwrap();
        start.elapsed()
    });
    let gather = median(gather.collect());
    let whole = Pattern::whole(rank, &vec![1 << 18; ranks]);
    let exchange = (0..300).map(|_| {
        let start = Instant::now();
        transport.start(&whole, 1, &mut |buffer| buffer.fill(1.0)).unwrap();
        for source in (1..ranks).map(|step| (rank + step) % ranks) {
            // Every cache line is read and little is computed.
            let mut sum = 0.0;
            transport.finish(source, &mut |m| sum = m.values().iter().step_by(16).sum::<f32>()).unwrap();
            assert_eq!(sum, (1 << 14) as f32);
        }
        start.elapsed()
    });
    let exchange = median(exchange.collect());
    println!(
        "times {ranks} ranks: all_gather median {:.1} us (p99 {:.0}), 1 MiB published and {} read: median {:.0} us (p99 {:.0})",
        gather.0,
        gather.1,
        ranks - 1,
        exchange.0,
        exchange.1
    );
}

#[test]
fn prints_times_on_request() {
    if std::env::var_os("LOOMTREE_TRANSPORT_TIMES").is_none() {
        println!("skipped: LOOMTREE_TRANSPORT_TIMES is not set");
        return;
    }
    for ranks in [2, 4, 8] {
        let (run, _member) = RunName::create("coordinator").unwrap();
        for (success, text) in Children::start(&run, "times", ranks).join() {
            let line = text.lines().find_map(|line| line.split_once("times ")).expect("times").1;
            println!("{line}");
            assert!(success && !line.is_empty());
        }
    }
}
