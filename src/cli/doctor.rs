//! `loomtree doctor`: resources of this machine, requirements of a run of a given size, and leftovers of dead runs.
//! Memory is estimated from a target per vertex. Only shared memory is known exactly enough to fail the check.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{CliError, print};
use crate::os::console::{is_json, note};
use crate::transport::{
    FoundRun, RANKS_MAX, RunState, SHARED_MEMORY_FOLDER, check_descriptors, check_shared_memory, cores, list_runs,
    required_descriptors, required_shared_memory_bytes, shared_memory_is_read_only, shared_memory_space,
};

/// Memory of a run over all workers, bytes per vertex. This is the target that the product is measured against.
const MEMORY_PER_VERTEX: u64 = 2500;

/// Arguments of `loomtree doctor`.
#[derive(Clone, Debug, clap::Args)]
pub struct DoctorArgs {
    /// Remove what dead runs have left; runs with a living process, or of which that cannot be told, are not touched
    #[arg(long)]
    pub clean: bool,
    /// How to print the report
    #[arg(long, value_enum, default_value_t = Format::Text)]
    pub format: Format,
    /// Size of the run to check for, triangles (scenes given: their own size)
    #[arg(long, value_name = "TRIANGLES", default_value_t = 1_200_000, value_parser = triangles)]
    pub resolution: usize,
    /// Workers of the run to check for
    #[arg(long, value_name = "N", default_value_t = 4)]
    pub workers: usize,
    /// Scenes to check for
    #[arg(value_name = "SCENE")]
    pub scenes: Vec<PathBuf>,
}

fn triangles(text: &str) -> Result<usize, String> {
    super::count(text).map(|count| count as usize)
}

/// Output format of a report.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Format {
    /// For people
    Text,
    /// For programs
    Json,
}

/// The report.
#[derive(Debug, Serialize)]
struct Report {
    cores: usize,
    /// Total and available memory; none if the system does not report it.
    memory_bytes: Option<(u64, u64)>,
    /// Total and free shared memory.
    shared_memory_bytes: (u64, u64),
    /// True if no run can start because the folder of the shared memory is mounted read-only.
    shared_memory_read_only: bool,
    adapters: Vec<String>,
    needs: Vec<Need>,
    runs: Vec<Run>,
}

/// Requirements of a run.
#[derive(Debug, Serialize, PartialEq)]
struct Need {
    /// Name of the scene, or the requested resolution.
    what: String,
    triangles: usize,
    vertices: usize,
    workers: usize,
    shared_memory_bytes: u64,
    memory_bytes: u64,
    /// Number of files that one process of the run opens.
    descriptors: u64,
    /// True if enough shared memory is free.
    fits: bool,
}

/// A run that was found on this machine.
#[derive(Debug, Serialize)]
struct Run {
    id: String,
    alive: bool,
    /// True if it is unknown whether the run lives. Such a run is not touched.
    unknown: bool,
    shared_memory_files: usize,
    shared_memory_bytes: u64,
    processes: Vec<String>,
    removed: bool,
}

/// Prints the report for `args`. `adapters` names the GPU adapters, `triangles_of` counts the triangles of a scene
/// file.
///
/// # Errors
/// A scene cannot be read, the machine has no shared memory, too little of it is free for the requested run, or
/// leftovers cannot be removed.
pub fn run(
    args: DoctorArgs,
    adapters: &[String],
    triangles_of: impl Fn(&Path) -> Result<usize, CliError>,
) -> Result<(), CliError> {
    if args.workers == 0 || args.workers > RANKS_MAX {
        let (workers, most) = (args.workers, RANKS_MAX);
        return Err(CliError::bad_input(format!("--workers {workers}: expected 1 to {most}")));
    }
    let space = shared_memory_space().map_err(|error| CliError::failed(error.to_string()))?;
    let mut needs = Vec::new();
    for scene in &args.scenes {
        needs.push(need_of(scene.display().to_string(), triangles_of(scene)?, args.workers, space.1));
    }
    if args.scenes.is_empty() {
        needs.push(need_of(format!("{} triangles", args.resolution), args.resolution, args.workers, space.1));
    }
    let (runs, clean_error) = examine(list_runs(), args.clean);
    let report = Report {
        cores: cores(),
        memory_bytes: memory(),
        shared_memory_bytes: space,
        shared_memory_read_only: shared_memory_is_read_only(),
        adapters: adapters.to_vec(),
        needs,
        runs,
    };
    let format = if is_json() { Format::Json } else { args.format };
    match format {
        Format::Text => print(&report.text())?,
        Format::Json => {
            let json = serde_json::to_string_pretty(&report);
            let json = json.map_err(|error| CliError::failed(format!("cannot print the report: {error}")))?;
            if is_json() {
                note(report.text().trim_end());
            }
            print(&(json + "\n"))?;
        }
    }
    if let Some(message) = clean_error {
        return Err(CliError::failed(message));
    }
    for need in &report.needs {
        check_shared_memory(need.workers, longest_message(need.vertices, need.workers), space.1)
            .map_err(|error| CliError::failed(format!("{}: {error}", need.what)))?;
    }
    check_descriptors(args.workers).map_err(CliError::failed)?;
    Ok(())
}

/// Values of the longest message: positions and velocities of the longest row block.
fn longest_message(vertices: usize, workers: usize) -> usize {
    vertices.div_ceil(workers).saturating_mul(6)
}

/// Requirements of a cloth of `triangles`. A large triangle mesh has half as many vertices as triangles, plus a few
/// along its border.
fn need_of(what: String, triangles: usize, workers: usize, free: u64) -> Need {
    let vertices = triangles.div_ceil(2) + (triangles as f64).sqrt().ceil() as usize + 1;
    let shared_memory_bytes = required_shared_memory_bytes(workers, longest_message(vertices, workers));
    let memory_bytes = MEMORY_PER_VERTEX.saturating_mul(vertices as u64);
    let descriptors = required_descriptors(workers);
    Need {
        what,
        triangles,
        vertices,
        workers,
        shared_memory_bytes,
        memory_bytes,
        descriptors,
        fits: shared_memory_bytes <= free,
    }
}

/// Describes the runs found and removes the dead ones if requested. The second value is the first error of a removal.
fn examine(found: Vec<FoundRun>, clean: bool) -> (Vec<Run>, Option<String>) {
    let mut first_error = None;
    let describe = |found: FoundRun| {
        let mut removed = false;
        if clean && found.state == RunState::Dead {
            // The check is repeated under a lock before the removal.
            match found.run.purge_if_last() {
                Ok(done) => removed = done,
                Err(error) => first_error = first_error.take().or_else(|| Some(format!("run {}: {error}", found.run))),
            }
        }
        // The processes of a living run in another pid namespace have other numbers here.
        let elsewhere = found.state == RunState::Alive && !found.members.iter().any(|member| member.is_alive());
        let process = |member: &crate::transport::Member| {
            let state = match (member.is_alive(), elsewhere) {
                (true, _) => "",
                (false, true) => ", in another pid namespace",
                (false, false) => ", ended",
            };
            format!("{} ({}{state})", member.pid, member.role)
        };
        Run {
            id: found.run.to_string(),
            alive: found.state == RunState::Alive,
            unknown: found.state == RunState::Unknown,
            shared_memory_files: found.shared_memory_files,
            shared_memory_bytes: found.shared_memory_bytes,
            processes: found.members.iter().map(process).collect(),
            removed,
        }
    };
    (found.into_iter().map(describe).collect(), first_error)
}

/// Total and available memory of the machine, bytes.
fn memory() -> Option<(u64, u64)> {
    parse_memory(&std::fs::read_to_string("/proc/meminfo").ok()?)
}

fn parse_memory(text: &str) -> Option<(u64, u64)> {
    let field = |name: &str| -> Option<u64> {
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        Some(line.trim_start_matches(':').split_whitespace().next()?.parse::<u64>().ok()? * 1024)
    };
    Some((field("MemTotal")?, field("MemAvailable")?))
}

fn size(bytes: u64) -> String {
    let mib = bytes as f64 / (1u64 << 20) as f64;
    if mib >= 1024.0 { format!("{:.1} GiB", mib / 1024.0) } else { format!("{mib:.1} MiB") }
}

impl Report {
    fn text(&self) -> String {
        let mut out = String::new();
        let mut line = |name: &str, text: String| {
            // Writing into a string cannot fail.
            let _ = writeln!(out, "{name:<16}{text}");
        };
        line("cores", self.cores.to_string());
        if let Some((total, available)) = self.memory_bytes {
            line("memory", format!("{}, {} available", size(total), size(available)));
        }
        let (total, free) = self.shared_memory_bytes;
        let read_only = if self.shared_memory_read_only { "; it is read-only, so no run can start" } else { "" };
        line("shared memory", format!("{SHARED_MEMORY_FOLDER}: {}, {} free{read_only}", size(total), size(free)));
        line("gpu adapters", if self.adapters.is_empty() { "none".to_string() } else { self.adapters.join("; ") });
        for need in &self.needs {
            let verdict = if need.fits { "fits" } else { "too little is free" };
            let (shared, memory) = (size(need.shared_memory_bytes), size(need.memory_bytes));
            let workers = need.workers;
            let text = format!(
                "{}: {workers} workers need {shared} of shared memory ({verdict}), about {memory} of memory, {} open files each",
                need.what, need.descriptors
            );
            line("needed", text);
        }
        if self.runs.is_empty() {
            line("runs", "none, and nothing left of dead ones".to_string());
        }
        for run in &self.runs {
            let state = match (run.alive, run.removed, run.unknown) {
                (true, ..) => "running",
                (false, true, _) => "dead, removed",
                (false, false, false) => "dead, its leftovers go with --clean",
                (false, false, true) => "without a lock that tells whether it lives: left alone, remove it by hand",
            };
            let (files, bytes) = (run.shared_memory_files, size(run.shared_memory_bytes));
            let processes = if run.processes.is_empty() { "none".to_string() } else { run.processes.join(", ") };
            line("run", format!("{}: {state}; {bytes} in {files} files; processes: {processes}", run.id));
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::RunName;

    fn args(scenes: Vec<PathBuf>, workers: usize) -> DoctorArgs {
        DoctorArgs { clean: false, format: Format::Json, resolution: 1000, workers, scenes }
    }

    #[test]
    fn needs_grow_with_the_scene() {
        let small = need_of("small".into(), 1000, 2, 100 << 20);
        let large = need_of("large".into(), 1_200_000, 2, 1 << 20);
        assert!(small.fits && !large.fits);
        assert!(large.vertices > 600_000 && large.vertices < 602_000);
        // Two ranks with three buffers of three floats for each of their vertices.
        assert!(large.shared_memory_bytes > 2 * 3 * 3 * 4 * 300_000);
        assert!(large.memory_bytes > small.memory_bytes);
    }

    #[test]
    fn memory_is_read() {
        let text = "MemTotal:       24000000 kB\nMemFree:  1 kB\nMemAvailable:   20000000 kB\n";
        assert_eq!(parse_memory(text), Some((24_000_000 * 1024, 20_000_000 * 1024)));
        assert_eq!(parse_memory("MemTotal: many kB\n"), None);
        assert_eq!(parse_memory(""), None);
    }

    #[test]
    fn bad_input_is_refused() {
        let nothing = |_: &Path| Ok(10);
        assert_eq!(run(args(vec![], 0), &[], nothing).unwrap_err().exit_code, 2);
        assert_eq!(run(args(vec![], 513), &[], nothing).unwrap_err().exit_code, 2);
        let missing = |path: &Path| Err(CliError::bad_input(format!("{}: no such file", path.display())));
        let error = run(args(vec!["nowhere.toml".into()], 1), &[], missing).unwrap_err();
        assert_eq!((error.exit_code, error.to_string().as_str()), (2, "nowhere.toml: no such file"));
    }

    #[test]
    fn a_run_that_cannot_fit_fails() {
        let huge = |_: &Path| Ok(usize::MAX);
        let error = run(args(vec!["huge.toml".into()], 1), &[], huge).unwrap_err();
        assert_eq!(error.exit_code, 1);
        assert!(error.message.starts_with("huge.toml: /dev/shm has"), "{error}");
    }

    #[test]
    fn dead_runs_are_removed() {
        let (run, member) = RunName::create("doctor test").unwrap();
        drop(member);
        // State after a killed process: the system has dropped its lock, but its entry remains.
        std::fs::create_dir_all(run.root().join("processes")).unwrap();
        std::fs::write(run.root().join("lock"), "").unwrap();
        std::fs::write(run.root().join("processes/1-0"), format!("{} 1 worker 0", std::process::id())).unwrap();
        let found = |run: &RunName| list_runs().into_iter().filter(|found| found.run == *run).collect::<Vec<_>>();
        let (runs, _) = examine(found(&run), false);
        assert!(!runs[0].alive && !runs[0].removed && runs[0].processes[0].ends_with("(worker 0, ended)"));
        let (runs, error) = examine(found(&run), true);
        assert!(runs[0].removed && error.is_none());
        assert!(!run.root().exists() && found(&run).is_empty());
    }

    #[test]
    fn living_runs_are_described_and_left_alone() {
        let (run, member) = RunName::create("doctor test").unwrap();
        let found: Vec<FoundRun> = list_runs().into_iter().filter(|found| found.run == run).collect();
        let (runs, error) = examine(found, true);
        assert!(error.is_none() && runs.len() == 1 && runs[0].alive && !runs[0].removed);
        assert!(runs[0].processes[0].ends_with("(doctor test)"));
        assert!(run.root().exists());
        let report = Report {
            cores: 2,
            memory_bytes: Some((1 << 34, 1 << 33)),
            shared_memory_bytes: (64 << 20, 32 << 20),
            shared_memory_read_only: true,
            adapters: vec!["a GPU".into()],
            needs: vec![need_of("flag".into(), 1000, 2, 32 << 20)],
            runs,
        };
        let text = report.text();
        for part in [
            "16.0 GiB, 8.0 GiB available",
            "/dev/shm: 64.0 MiB, 32.0 MiB free; it is read-only",
            "a GPU",
            "flag: 2 workers",
            "running",
        ] {
            assert!(text.contains(part), "'{part}' is missing in:\n{text}");
        }
        drop(member);
    }
}
