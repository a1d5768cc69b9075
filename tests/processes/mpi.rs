//! Runs as the ranks of `mpirun`: the transport, the same bits as on one machine, refusals, killed ranks, and two hosts
//! made of network namespaces where this machine allows it.
//!
//! The suite of the transport runs in processes that `mpirun` starts from this test binary: every process runs every
//! test, and takes part in the groups that are large enough for it.

use std::any::Any;
use std::cell::{Cell, RefCell};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

use loomtree::transport::{Connection, Counts, Inside, Membership, Transport};
use support::process::{Place, flag, program, repository};

use crate::groups::{Group, MAX_LEN, PATIENT};
use crate::{transport_conformance, transport_patterns};

/// What a process of the suite is to do: way inside a host, and hosts by process.
const SUITE: &str = "LOOMTREE_TEST_MPI";

thread_local! {
    static MEMBER: RefCell<Option<Member>> = const { RefCell::new(None) };
}

/// This process of the suite.
struct Member {
    membership: Membership,
    hosts: Vec<usize>,
    crews: Cell<u32>,
}

impl Member {
    /// Connects the first `ranks` processes; none in the others.
    fn connect(&self, ranks: usize, deadline: Duration) -> Option<Box<dyn Transport>> {
        let crew = self.crews.get();
        self.crews.set(crew + 1);
        let (rank, _) = self.membership.rank();
        let connection =
            Connection { rank, ranks, epoch: 0, max_len: MAX_LEN, deadline, on_wait: Box::new(|| false), links: None };
        (rank < ranks).then(|| self.membership.group(crew, &self.hosts).connect(connection).expect("connect"))
    }

    /// What all ranks returned, in every process.
    fn gather<T: 'static>(&self, own: Option<T>) -> Vec<T> {
        let (_, processes) = self.membership.rank();
        let own = own.map_or(Vec::new(), |own| numbers(&own));
        let mut all = Vec::new();
        self.connect(processes, PATIENT).expect("a member").all_gather(&own, &mut all).expect("gather");
        all.iter().filter(|values| !values.is_empty()).map(|values| *value::<T>(values)).collect()
    }
}

/// A result as numbers. The first one only says that there is a result.
fn numbers(result: &dyn Any) -> Vec<f64> {
    if let Some(Counts { published, bytes_published, received, bytes_received }) = result.downcast_ref() {
        let counts = [published, bytes_published, received, bytes_received];
        return std::iter::once(1.0).chain(counts.map(|&count| count as f64)).collect();
    }
    match result.downcast_ref::<f64>() {
        Some(&value) => vec![1.0, value],
        None => vec![1.0],
    }
}

fn value<T: 'static>(numbers: &[f64]) -> Box<T> {
    let value: Box<dyn Any> = match *numbers {
        [_, published, bytes_published, received, bytes_received] => {
            let [published, bytes_published, received, bytes_received] =
                [published, bytes_published, received, bytes_received].map(|count| count as u64);
            Box::new(Counts { published, bytes_published, received, bytes_received })
        }
        [_, value] => Box::new(value),
        _ => Box::new(()),
    };
    value.downcast().expect("a result that can be sent")
}

/// Processes of a world.
struct Processes;

impl Group for Processes {
    fn run<T: Send + 'static>(
        ranks: usize,
        deadline: Duration,
        program: impl Fn(&mut dyn Transport) -> T + Clone + Send + 'static,
    ) -> Vec<T> {
        MEMBER.with_borrow(|member| {
            let member = member.as_ref().expect("this process has joined");
            let own = member.connect(ranks, deadline).map(|mut transport| program(transport.as_mut()));
            member.gather(own)
        })
    }
}

/// Not a test of its own: one process of the suite.
#[test]
fn child() {
    let Ok(role) = std::env::var(SUITE) else {
        println!("skipped: only runs as a child of the other tests");
        return;
    };
    let words: Vec<&str> = role.split(' ').collect();
    let inside = if words[0] == "mpi" { Inside::Mpi } else { Inside::SharedMemory };
    let hosts = words[1..].iter().map(|host| host.parse().expect("a number")).collect();
    let membership = Membership::join(None, inside).expect("a world");
    let member = Member { membership, hosts, crews: Cell::new(1000) };
    MEMBER.set(Some(member));
    transport_conformance::order_and_contents::<Processes>();
    transport_conformance::whole_lists::<Processes>();
    transport_conformance::ready_tells::<Processes>();
    transport_conformance::gathering::<Processes>();
    transport_conformance::mixed_rounds::<Processes>();
    transport_conformance::wrong_calls::<Processes>();
    transport_patterns::patterns_change_from_exchange_to_exchange::<Processes>();
    transport_patterns::a_rare_reader_gets_the_right_message_out_of_many::<Processes>();
    transport_patterns::two_halves_of_a_group_go_their_own_ways::<Processes>();
    transport_patterns::a_third_exchange_before_the_first_is_finished_is_refused::<Processes>();
    MEMBER.take().expect("joined above").membership.leave(0);
}

/// Only one of these tests at a time starts processes: eight ranks on a small machine are enough.
static ALONE: Mutex<()> = Mutex::new(());

/// `mpirun -n ranks`, also as root and with more ranks than cores, for both families of MPI.
fn mpirun(ranks: usize) -> Command {
    let mut command = Command::new("mpirun");
    command.args(["-n", &ranks.to_string()]);
    command.env("OMPI_ALLOW_RUN_AS_ROOT", "1").env("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1");
    command.env("OMPI_MCA_rmaps_base_oversubscribe", "1").env("OMPI_MCA_mpi_yield_when_idle", "1");
    // Looked for even where it is not used, and a bare machine has no ssh.
    command.env("OMPI_MCA_plm_rsh_agent", "sh");
    command.env("PRTE_MCA_rmaps_default_mapping_policy", ":oversubscribe");
    command.env("OMPI_MCA_btl_vader_single_copy_mechanism", "none").env("OMPI_MCA_hwloc_base_binding_policy", "none");
    command.stdin(Stdio::null());
    command
}

/// Keeps the other tests from starting processes; none, said in a line, where `mpirun` cannot start any here.
fn alone() -> Option<MutexGuard<'static, ()>> {
    let guard = ALONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    let starts = mpirun(2).arg("true").output().is_ok_and(|ended| ended.status.success());
    if !starts {
        println!("skipped: mpirun does not start two processes on this machine");
    }
    starts.then_some(guard)
}

/// What a command printed, and its exit code.
fn output(command: &mut Command) -> (i32, String) {
    let ended = command.output().expect("mpirun starts");
    let text = [ended.stdout, ended.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    (ended.status.code().unwrap_or(-1), text)
}

fn suite(inside: &str, hosts: &[usize]) {
    let Some(_alone) = alone() else { return };
    suite_under(mpirun(hosts.len()), inside, hosts);
}

/// The suite under `command`, which starts as many processes as `hosts` has numbers.
fn suite_under(mut command: Command, inside: &str, hosts: &[usize]) {
    let hosts: Vec<String> = hosts.iter().map(usize::to_string).collect();
    command.arg(std::env::current_exe().expect("the test binary"));
    command.args(["mpi::child", "--exact", "--nocapture", "--test-threads=1"]);
    command.env(SUITE, format!("{inside} {}", hosts.join(" ")));
    let (code, text) = output(&mut command);
    assert_eq!(code, 0, "{text}");
    assert_eq!(text.matches("1 passed").count(), hosts.len(), "{text}");
}

#[test]
fn the_transport_suite_passes_within_a_host() {
    suite("mpi", &[0; 8]);
}

#[test]
fn the_transport_suite_passes_between_hosts() {
    suite("mpi", &[0, 1, 2, 3, 4, 5, 6, 7]);
    // Two hosts whose ranks come in turn; and hosts of two, three, one and two ranks.
    suite("mpi", &[0, 1, 0, 1, 0, 0, 0, 1]);
    suite("shared-memory", &[0, 0, 2, 2, 4, 2, 6, 6]);
}

/// A run of `words` on `ranks` ranks, which must end well.
fn run(place: &Place, ranks: usize, words: &str) {
    let (code, text) =
        output(mpirun(ranks).arg(program("loomtree")).args(words.split(' ')).current_dir(place.path("")));
    assert_eq!(code, 0, "{ranks} ranks: {words}\n{text}");
}

/// The shipped scene `name` with `triangles` triangles, as a file of the place.
fn shipped(place: &Place, name: &str) {
    let text = std::fs::read_to_string(repository(&format!("scenes/{name}.toml"))).expect("a shipped scene");
    place.write(&format!("{name}.toml"), text);
}

#[test]
fn any_number_of_ranks_gives_the_bits_of_one_worker() {
    let Some(_alone) = alone() else { return };
    let place = Place::new();
    place.write("flag.toml", flag(1500, 3, 8));
    shipped(&place, "sphere");
    shipped(&place, "stack");
    let shots = [
        ("flag", "run flag.toml --executor cpu"),
        ("sphere", "run sphere.toml --executor cpu --resolution 1000 --frames 8"),
        ("stack", "run stack.toml --executor cpu --resolution 1000 --frames 3"),
    ];
    for (name, words) in shots {
        place.run(&format!("{words} --workers 2 --out one_{name}")).expect(0);
        let expected = place.hashes(&format!("one_{name}"));
        assert!(expected.len() > 3, "{expected:?}");
        for (ranks, way) in [(1, "auto"), (2, "mpi"), (2, "auto"), (4, "mpi"), (8, "auto")] {
            let out = format!("{name}_{ranks}_{way}");
            run(&place, ranks, &format!("{words} --transport {way} --out {out}"));
            assert_eq!(place.hashes(&out), expected, "{name}: {ranks} ranks, {way}");
        }
    }
    let split = "run flag.toml --executor cpu --segments 2";
    place.run(&format!("{split} --sessions 2 --workers 1 --out split")).expect(0);
    for (ranks, words) in [(2, ""), (4, " --workers 2"), (4, " --sessions 2")] {
        let out = format!("split_{ranks}{}", words.trim().replace([' ', '-'], ""));
        run(&place, ranks, &format!("{split}{words} --out {out}"));
        assert_eq!(place.hashes(&out), place.hashes("split"), "{ranks} ranks{words}");
    }
}

#[test]
fn solves_topologies_and_benchmarks_run_on_ranks() {
    let Some(_alone) = alone() else { return };
    let place = Place::new();
    let entries: String = (1..=300).map(|i| format!("{i} {i} 4\n")).collect();
    let beside: String = (2..=300).map(|i| format!("{i} {} -1\n", i - 1)).collect();
    let head = "%%MatrixMarket matrix coordinate real symmetric\n300 300 599\n";
    place.write("chain.mtx", format!("{head}{entries}{beside}"));
    let one = place.run("solve chain.mtx --solution one.mtx").expect(0);
    assert!(one.story.contains("\"converged\": true"), "{}", one.story);
    run(&place, 3, "solve chain.mtx --solution three.mtx");
    let read = |name: &str| std::fs::read(place.path(name)).expect("a solution");
    assert!(read("one.mtx") == read("three.mtx"), "the solutions differ");

    run(&place, 3, "topology detect --bandwidth 20 --out found.toml");
    let found = loomtree::interconnect::Topology::read(&place.path("found.toml")).expect("a topology");
    assert_eq!((found.gpus(), found.hosts()), (3, &[0, 0, 0][..]));
    assert!(found.links().iter().all(|link| link.bandwidth_gb_s > 0.01 && link.latency_us < 1e5));

    place.write("flag.toml", flag(500, 2, 2));
    let words = "bench step --scene flag.toml --resolution 500 --steps 2 --rounds 1 --workers 1,2,8";
    let (code, text) = output(mpirun(2).arg(program("loomtree")).args(words.split(' ')).current_dir(place.path("")));
    assert!(code == 0 && text.contains("2 processes were started, so [8] workers are left out"), "{text}");
}

/// Two hosts made of network namespaces, as long as it lives.
struct TwoHosts {
    script: std::path::PathBuf,
}

impl TwoHosts {
    /// Those of a script; none where this machine does not allow them, which needs `what`.
    fn new(script: &str, what: &str) -> Option<TwoHosts> {
        let script = repository(script);
        let call =
            |what: &str| Command::new(&script).arg(what).stderr(Stdio::null()).status().is_ok_and(|s| s.success());
        // What an earlier test has left.
        call("down");
        let made = call("up").then_some(TwoHosts { script });
        if made.is_none() {
            println!("skipped: two hosts need root, {what} and the right to make network namespaces");
        }
        made
    }

    fn call(&self, words: &[&str]) -> Command {
        let mut command = Command::new(&self.script);
        command.args(words).stdin(Stdio::null());
        command
    }
}

impl Drop for TwoHosts {
    fn drop(&mut self) {
        let _ = self.call(&["down"]).status();
    }
}

#[test]
fn the_transport_suite_passes_on_two_hosts() {
    let Some(_alone) = alone() else { return };
    let Some(hosts) = TwoHosts::new("scripts/two_hosts.sh", "iproute2") else { return };
    for inside in ["shared-memory", "mpi"] {
        suite_under(hosts.call(&["run", "8", "-x", SUITE]), inside, &[0, 0, 0, 0, 4, 4, 4, 4]);
    }
}

#[test]
fn two_hosts_give_the_bits_of_one_and_survive_a_cut_cable() {
    let Some(_alone) = alone() else { return };
    let Some(hosts) = TwoHosts::new("scripts/two_hosts.sh", "iproute2") else { return };
    let place = Place::new();
    place.write("flag.toml", flag(1500, 3, 40));
    shipped(&place, "sphere");
    shipped(&place, "stack");
    let loomtree = program("loomtree");
    let shots = [
        ("flag", "run flag.toml --executor cpu --frames 8", &[("2", "mpi"), ("8", "auto")][..]),
        (
            "sphere",
            "run sphere.toml --executor cpu --resolution 1000 --frames 8",
            &[("2", "auto"), ("4", "auto"), ("3", "mpi"), ("8", "mpi")],
        ),
        ("stack", "run stack.toml --executor cpu --resolution 1000 --frames 3", &[("4", "auto"), ("8", "auto")]),
        ("split", "run flag.toml --executor cpu --frames 8 --segments 2", &[("2", "auto"), ("8", "auto")]),
    ];
    for (name, words, worlds) in shots {
        place.run(&format!("{words} --workers 2 --out one_{name}")).expect(0);
        for (ranks, way) in worlds {
            let out = format!("{name}_{ranks}_{way}");
            let words = format!("{words} --transport {way} --out {out}");
            let mut command = hosts.call(&["run", ranks, &loomtree]);
            let (code, text) = output(command.args(words.split(' ')).current_dir(place.path("")));
            assert_eq!(code, 0, "{text}");
            assert_eq!(place.hashes(&out), place.hashes(&format!("one_{name}")), "{name}: {ranks} ranks, {way}");
        }
    }

    place.run("run flag.toml --executor cpu --workers 1 --out whole").expect(0);
    let out = place.path("cut");
    let mut command = hosts.call(&["run", "4", &loomtree, "run", "flag.toml", "--executor", "cpu"]);
    command.args(["--checkpoint-every", "1", "--out"]).arg(&out).current_dir(place.path(""));
    let log = std::fs::File::create(place.path("cut.log")).expect("a log");
    let mut child = command.stdout(Stdio::null()).stderr(log).spawn().expect("mpirun starts");
    wait_for_frame(&out, 5, &mut child);
    assert!(hosts.call(&["cut"]).status().expect("ip").success());
    let cut = Instant::now();
    while !ranks_of(&out).is_empty() {
        assert!(cut.elapsed() < Duration::from_secs(15), "ranks are left: {:?}", ranks_of(&out));
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(hosts.call(&["join"]).status().expect("ip").success());
    let status = child.wait().expect("mpirun ends");
    let log = std::fs::read_to_string(place.path("cut.log")).expect("a log");
    assert!(!status.success() && log.contains("nothing was heard from it for 5 s"), "{log}");
    assert!(log.contains("on loomhost2") && log.contains("this rank ends"), "{log}");
    resume(&place, &out);
    assert_eq!(place.hashes("cut").last(), place.hashes("whole").last());
}

#[test]
fn srun_starts_ranks_on_two_hosts() {
    let Some(_alone) = alone() else { return };
    let Some(hosts) = TwoHosts::new("scripts/two_hosts_slurm.sh", "iproute2, slurm-wlm, munge") else { return };
    let place = Place::new();
    place.write("flag.toml", flag(1500, 3, 40));
    let loomtree = program("loomtree");
    let srun = |ranks: &str, options: &str, words: &str| {
        let mut command = hosts.call(&["run", "-N", "2", "-n", ranks, "--mpi=pmix"]);
        command.args(options.split_whitespace()).arg(&loomtree).args(words.split(' ')).current_dir(place.path(""));
        command
    };
    let words = "run flag.toml --executor cpu";
    place.run(&format!("{words} --frames 8 --workers 1 --out one")).expect(0);
    place.run(&format!("{words} --frames 8 --segments 2 --workers 1 --out split")).expect(0);
    for (ranks, more, same) in [("4", "", "one"), ("3", " --transport mpi", "one"), ("4", " --segments 2", "split")] {
        let out = format!("{ranks}{}", more.replace([' ', '-'], "_"));
        let (code, text) = output(&mut srun(ranks, "", &format!("{words} --frames 8{more} --out {out}")));
        assert_eq!(code, 0, "{text}");
        assert_eq!(place.hashes(&out), place.hashes(same), "{ranks} ranks{more}");
    }
    // The first rank has nothing to serve here and writes while the others are done: none may be gone before it.
    let (code, text) = output(&mut srun("4", "", "topology detect --out hosts.toml"));
    assert_eq!(code, 0, "{text}");
    let detected = std::fs::read_to_string(place.path("hosts.toml")).expect("a topology");
    assert!(detected.contains("loomhost1") && detected.contains("loomhost2"), "{detected}");
    let (code, text) = output(&mut srun("4", "", "run missing.toml"));
    assert!(code == 2 && text.matches("missing.toml").count() == 1, "{code} {text}");

    place.run(&format!("{words} --workers 1 --out whole")).expect(0);
    for (options, killed) in [("--kill-on-bad-exit=1", 1), ("", 3), ("", 0)] {
        let out = place.path(&format!("killed_{killed}"));
        let mut command = srun("4", options, &format!("{words} --checkpoint-every 1 --out {}", out.display()));
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("srun starts");
        wait_for_frame(&out, 5, &mut child);
        let mut ranks = ranks_of(&out);
        ranks.sort_by_key(|rank| variable_of(*rank, "SLURM_PROCID"));
        assert_eq!(ranks.len(), 4, "rank {killed}");
        support::process::signal(ranks[killed], support::process::Signal::KILL);
        let begun = Instant::now();
        while !ranks_of(&out).is_empty() {
            assert!(begun.elapsed() < Duration::from_secs(15), "rank {killed}: {:?} are left", ranks_of(&out));
            std::thread::sleep(Duration::from_millis(10));
        }
        assert!(!child.wait().expect("srun ends").success(), "rank {killed}");
        resume(&place, &out);
        assert_eq!(place.hashes(&format!("killed_{killed}")).last(), place.hashes("whole").last(), "rank {killed}");
    }
}

/// A variable of the environment that a process was started with.
fn variable_of(pid: i32, name: &str) -> Option<String> {
    let variables = std::fs::read(format!("/proc/{pid}/environ")).ok()?;
    let variables = String::from_utf8_lossy(&variables).into_owned();
    variables.split('\0').find_map(|variable| Some(variable.strip_prefix(name)?.strip_prefix('=')?.to_owned()))
}

/// Goes on with a run whose ranks were killed. The last of them may hold its folder for a moment longer.
fn resume(place: &Place, out: &Path) {
    let begun = Instant::now();
    loop {
        let ended = place.run(&format!("run --resume --workers 2 --out {}", out.display()));
        let is_held = ended.stderr.contains("in use by another run");
        if !is_held || begun.elapsed() > Duration::from_secs(10) {
            ended.expect(0);
            return;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Waits until a run under `child` has written a frame, or has ended.
fn wait_for_frame(out: &Path, frame: u32, child: &mut std::process::Child) {
    let begun = Instant::now();
    while !out.join(format!("frames/frame_{frame:06}.ply")).exists() {
        assert!(begun.elapsed() < PATIENT, "no frame {frame} in {}", out.display());
        if child.try_wait().expect("a child").is_some() {
            break;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn what_does_not_fit_a_world_is_refused_in_words() {
    let Some(_alone) = alone() else { return };
    let place = Place::new();
    place.write("flag.toml", flag(500, 2, 2));
    let refused = |ranks: usize, words: &str, sentence: &str| {
        let mut command = mpirun(ranks);
        let (code, text) = output(command.arg(program("loomtree")).args(words.split(' ')).current_dir(place.path("")));
        assert_eq!(code, 2, "{words}\n{text}");
        assert_eq!(text.matches(sentence).count(), 1, "{words}: once\n{text}");
    };
    refused(2, "run flag.toml --workers 3", "3 workers, and 2 processes were started");
    refused(2, "run missing.toml", "missing.toml: cannot be read");
    refused(3, "run flag.toml --emulate-links", "models links on one machine");
    refused(2, "run flag.toml --segments 2 --sessions 3", "3 workers, and 2 processes were started");
    // A launcher whose processes do not find each other.
    let mut alone = Command::new(program("loomtree"));
    alone.args(["run", "flag.toml"]).current_dir(place.path(""));
    alone.env("SLURM_STEP_NUM_TASKS", "4").env("SLURM_PROCID", "0");
    let (code, text) = output(&mut alone);
    assert_eq!(code, 2, "{text}");
    assert!(text.contains("was to start 4 processes, and this one sees 1") && text.contains("--mpi=pmix"), "{text}");
    let (code, text) =
        output(Command::new(program("loomtree")).args(["run", "x", "--launcher", "processes", "--transport", "mpi"]));
    assert!(code == 2 && text.contains("--transport mpi needs the ranks"), "{text}");
}

/// Process numbers of the ranks that run `out`.
fn ranks_of(out: &Path) -> Vec<i32> {
    let out = out.to_string_lossy().into_owned();
    let entries = std::fs::read_dir("/proc").into_iter().flatten().flatten();
    let pids = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    let is_rank = |pid: &i32| {
        let line = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let line = String::from_utf8_lossy(&line).into_owned();
        line.split('\0').next().is_some_and(|name| name.ends_with("loomtree")) && line.contains(&out)
    };
    pids.filter(is_rank).collect()
}

#[test]
fn a_killed_rank_ends_all_and_the_run_can_be_resumed() {
    let Some(_alone) = alone() else { return };
    let place = Place::new();
    place.write("flag.toml", flag(1500, 3, 40));
    place.run("run flag.toml --executor cpu --workers 1 --out whole").expect(0);
    for (number, way) in ["mpi", "auto"].into_iter().enumerate() {
        let out = place.path(&format!("killed_{way}"));
        let mut command = mpirun(3);
        command.arg(program("loomtree")).args(["run", "flag.toml", "--executor", "cpu", "--checkpoint-every", "1"]);
        command.args(["--transport", way, "--out"]).arg(&out).current_dir(place.path(""));
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("mpirun starts");
        wait_for_frame(&out, 5, &mut child);
        let ranks = ranks_of(&out);
        assert_eq!(ranks.len(), 3, "{way}");
        support::process::signal(ranks[number + 1], support::process::Signal::KILL);
        let killed = Instant::now();
        let status = child.wait().expect("mpirun ends");
        while !ranks_of(&out).is_empty() {
            assert!(killed.elapsed() < Duration::from_secs(10), "{way}: ranks are left");
            std::thread::sleep(Duration::from_millis(10));
        }
        assert!(!status.success());
        resume(&place, &out);
        assert_eq!(place.hashes(&format!("killed_{way}")).last(), place.hashes("whole").last(), "{way}");
    }
}
