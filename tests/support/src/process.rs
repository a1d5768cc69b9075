//! Runs of the real programs for tests: a place of its own for every test, a watchdog, and a look at what is left on the
//! machine afterwards. What a failed test needs to be understood (command, folder, stderr) is printed. Linux only.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

pub use rustix::process::Signal;
use rustix::process::{Pid, kill_process};

/// Generous: it only turns a hang into a failure.
const WATCHDOG: Duration = Duration::from_secs(120);
/// Between two looks at a run.
const LOOK: Duration = Duration::from_millis(3);
/// In the environment of every process of a place, workers too.
const MARK: &str = "LOOMTREE_TEST_PLACE";

/// A folder for one test, and everything that its processes may leave behind.
pub struct Place {
    folder: tempfile::TempDir,
}

/// A program that was started.
pub struct Running<'a> {
    place: &'a Place,
    child: Child,
    what: String,
    output: PathBuf,
    /// Runs that were seen in the temp directory.
    runs: BTreeSet<String>,
}

/// A program that has ended, with nothing of it left on the machine.
pub struct Ended {
    /// Exit code; none if a signal ended it.
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
    /// Command, folder and output, for messages.
    pub story: String,
}

/// A flag of about `triangles` triangles, `steps_per_frame` short steps a frame.
pub fn flag(triangles: u32, steps_per_frame: u32, frames: u32) -> String {
    format!(
        r#"
        name = "flag"
        resolution = {triangles}
        [simulation]
        step_s = 0.004
        steps_per_frame = {steps_per_frame}
        frames = {frames}
        [air]
        wind_m_s = [9.0, 0.5, 3.5]
        [[cloth]]
        sheet = {{ size_m = [3.0, 2.0] }}
        fabric = "nylon"
        damping_s = 0.001
        [[pin]]
        edge = "left"
        "#
    )
}

/// Path of one of the package's programs. Cargo builds them for every test binary, into the folder above the binary's
/// own.
pub fn program(name: &str) -> String {
    let own = std::env::current_exe().expect("the path of this test");
    let folder = own.parent().and_then(Path::parent).expect("target/PROFILE/deps/NAME");
    folder.join(name).display().to_string()
}

/// A file of the package.
pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(path)
}

impl Place {
    /// A new empty place; its path is short enough for the sockets of a run.
    pub fn new() -> Place {
        let folder = tempfile::Builder::new().prefix("lt-").tempdir_in("/tmp").expect("a folder for the test");
        fs::create_dir(folder.path().join("tmp")).expect("a temp folder");
        Place { folder }
    }

    /// The folder in which commands run.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a file.
    pub fn write(&self, name: &str, content: impl AsRef<[u8]>) {
        fs::write(self.path(name), content).expect("a file of the test");
    }

    /// Starts `loomtree` with words separated by blanks.
    pub fn start(&self, words: &str) -> Running<'_> {
        self.start_program(&program("loomtree"), words, &[])
    }

    /// Runs `loomtree` to its end.
    pub fn run(&self, words: &str) -> Ended {
        self.start(words).wait()
    }

    /// Starts a program.
    pub fn start_program(&self, program: &str, words: &str, environment: &[(&str, &str)]) -> Running<'_> {
        let output = self.path(&format!("output-{}", fs::read_dir(self.folder.path()).expect("the place").count()));
        let file = |ending: &str| File::create(output.with_extension(ending)).expect("a file for the output");
        let child = self
            .command_of(program, words)
            .envs(environment.iter().copied())
            .stdout(file("stdout"))
            .stderr(file("stderr"))
            .spawn()
            .unwrap_or_else(|error| panic!("cannot start {program}: {error}"));
        let what = format!("{program} {words}");
        Running { place: self, child, what, output, runs: BTreeSet::new() }
    }

    /// `loomtree` with words separated by blanks, not yet started: for tests that choose its streams.
    pub fn command(&self, words: &str) -> Command {
        self.command_of(&program("loomtree"), words)
    }

    fn command_of(&self, program: &str, words: &str) -> Command {
        // A test that runs in the background of a shell inherits an ignored SIGINT; the programs of the tests must hear
        // it.
        let mut command = Command::new("env");
        command.args(["--default-signal=INT,TERM,HUP", program]);
        command.args(words.split_whitespace()).current_dir(self.folder.path()).stdin(Stdio::null());
        command.env(MARK, self.folder.path()).env("TMPDIR", self.path("tmp"));
        command
    }

    /// Living processes that were started here, directly or not: number and command line.
    fn processes(&self) -> Vec<(i32, String)> {
        let mark = format!("{MARK}={}\0", self.folder.path().display());
        let entries = fs::read_dir("/proc").expect("/proc").flatten();
        entries
            .filter_map(|entry| {
                let pid: i32 = entry.file_name().to_str()?.parse().ok()?;
                // A zombie's environment is empty: it counts as ended.
                let environment = fs::read(entry.path().join("environ")).ok()?;
                let ours = environment.windows(mark.len()).any(|window| window == mark.as_bytes());
                let line = String::from_utf8_lossy(&fs::read(entry.path().join("cmdline")).ok()?).replace('\0', " ");
                ours.then_some((pid, line))
            })
            .collect()
    }

    fn leftovers(&self, runs: &BTreeSet<String>) -> Vec<String> {
        let mut found: Vec<String> =
            self.processes().into_iter().map(|(pid, line)| format!("process {pid}: {line}")).collect();
        let named = |folder: &Path| -> Vec<String> {
            fs::read_dir(folder)
                .into_iter()
                .flatten()
                .flatten()
                .map(|entry| entry.file_name().to_string_lossy().into_owned())
                .collect()
        };
        found.extend(named(&self.path("tmp")).into_iter().map(|name| format!("temp folder: {name}")));
        let shared = named(Path::new("/dev/shm")).into_iter();
        found.extend(
            shared
                .filter(|name| runs.iter().any(|run| name.contains(run.as_str())))
                .map(|name| format!("shared memory: {name}")),
        );
        found
    }

    /// Frames and hashes in `report.json` of a run directory.
    pub fn hashes(&self, out: &str) -> Vec<(u64, String)> {
        let report = self.report(out);
        let frames = report["frames"].as_array().expect("frames in the report");
        frames
            .iter()
            .map(|f| (f["frame"].as_u64().expect("a number"), f["state_hash"].as_str().expect("a hash").to_string()))
            .collect()
    }

    /// `report.json` of a run directory.
    pub fn report(&self, out: &str) -> serde_json::Value {
        let path = self.path(out).join("report.json");
        let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
    }

    /// The newest checkpoint of a run directory, which must be whole: its file, frame and step.
    pub fn newest_checkpoint(&self, out: &str) -> (PathBuf, u32, u64) {
        let latest = loomtree::output::checkpoint::latest(&self.path(out).join("checkpoint"));
        assert!(latest.notes.is_empty(), "{:?}", latest.notes);
        let (path, checkpoint) = latest.found.expect("a checkpoint");
        assert!(checkpoint.state.first_not_finite().is_none());
        (path, checkpoint.frame, checkpoint.step)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        // Only after a failed test: a good one has seen that there are none.
        for (pid, _) in self.processes() {
            signal(pid, Signal::KILL);
        }
    }
}

/// Sends a signal; a process that is gone needs none.
pub fn signal(pid: i32, signal: Signal) {
    if let Some(pid) = Pid::from_raw(pid) {
        let _ = kill_process(pid, signal);
    }
}

impl Running<'_> {
    /// Process number of the started program.
    pub fn pid(&self) -> i32 {
        self.child.id() as i32
    }

    /// What it has written to stdout so far.
    pub fn stdout(&self) -> String {
        self.text("stdout")
    }

    /// What it has written to stderr so far.
    pub fn stderr(&self) -> String {
        self.text("stderr")
    }

    fn text(&self, ending: &str) -> String {
        String::from_utf8_lossy(&fs::read(self.output.with_extension(ending)).unwrap_or_default()).into_owned()
    }

    fn story(&self) -> String {
        let mut story = format!("command: {}\nfolder: {}\n", self.what, self.place.folder.path().display());
        let _ = write!(story, "stdout: {}\nstderr: {}", self.text("stdout"), self.text("stderr"));
        story
    }

    fn look(&mut self) {
        let entries = fs::read_dir(self.place.path("tmp")).into_iter().flatten().flatten();
        self.runs.extend(
            entries.filter_map(|entry| entry.file_name().to_str()?.strip_prefix("loomtree-").map(str::to_string)),
        );
    }

    /// Waits until `find` finds something while the program runs.
    pub fn wait_for<T>(&mut self, what: &str, mut find: impl FnMut(&Running) -> Option<T>) -> T {
        let start = Instant::now();
        loop {
            self.look();
            if let Some(found) = find(self) {
                return found;
            }
            let ended = self.child.try_wait().expect("the program's state");
            assert!(ended.is_none(), "it ended ({ended:?}) before {what}\n{}", self.story());
            assert!(start.elapsed() < WATCHDOG, "the watchdog bit: no {what}\n{}", self.story());
            std::thread::sleep(LOOK);
        }
    }

    /// Waits until frame `frame` of the run directory `out` is written (as PLY).
    pub fn wait_for_frame(&mut self, out: &str, frame: u32) {
        let file = self.place.path(out).join(format!("frames/frame_{frame:06}.ply"));
        self.wait_for(&format!("frame {frame}"), |_| file.exists().then_some(()));
    }

    /// Process number of worker `rank`.
    pub fn worker(&mut self, rank: usize) -> i32 {
        let ending = format!(" --rank {rank} ");
        self.wait_for(&format!("worker {rank}"), |running| {
            let processes = running.place.processes();
            processes
                .into_iter()
                .find(|(_, line)| line.contains("--run") && line.ends_with(&ending))
                .map(|(pid, _)| pid)
        })
    }

    /// Waits until the started program itself has ended; its workers may live on.
    pub fn wait_for_own_end(&mut self) {
        let start = Instant::now();
        while self.child.try_wait().expect("the program's state").is_none() {
            self.look();
            assert!(start.elapsed() < WATCHDOG, "the watchdog bit: it does not end\n{}", self.story());
            std::thread::sleep(LOOK);
        }
    }

    /// Waits until the program has ended and nothing of it is left: no process, no shared memory, no temp file.
    pub fn wait(mut self) -> Ended {
        let start = Instant::now();
        let status = loop {
            self.look();
            if let Some(status) = self.child.try_wait().expect("the program's state") {
                break status;
            }
            assert!(start.elapsed() < WATCHDOG, "the watchdog bit: it does not end\n{}", self.story());
            std::thread::sleep(LOOK);
        };
        // Workers of a killed coordinator notice that by themselves, which takes them a moment.
        let start = Instant::now();
        loop {
            let left = self.place.leftovers(&self.runs);
            if left.is_empty() {
                break;
            }
            assert!(start.elapsed() < WATCHDOG / 2, "left behind: {left:#?}\n{}", self.story());
            std::thread::sleep(LOOK);
        }
        Ended { code: status.code(), stdout: self.text("stdout"), stderr: self.text("stderr"), story: self.story() }
    }
}

impl Ended {
    /// Checks the exit code.
    pub fn expect(self, code: i32) -> Ended {
        assert_eq!(self.code, Some(code), "exit code\n{}", self.story);
        assert!(!self.stderr.contains("panicked"), "{}", self.story);
        self
    }

    /// Checks that stderr holds each of `words`.
    pub fn says(self, words: &[&str]) -> Ended {
        for word in words {
            assert!(self.stderr.contains(word), "stderr lacks '{word}'\n{}", self.story);
        }
        self
    }

    /// The one sentence that starts with `error: `.
    pub fn error(&self) -> &str {
        let errors: Vec<&str> = self.stderr.lines().filter(|line| line.starts_with("error: ")).collect();
        let [error] = errors[..] else { panic!("one error expected, not {}\n{}", errors.len(), self.story) };
        error
    }
}
