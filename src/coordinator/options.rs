//! The options of `loomtree run` in one list: their command-line form, their defaults, and their form in `run.toml`.

use std::num::NonZeroU32;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use clap::builder::RangedU64ValueParser;
use clap::parser::ValueSource;
use clap::{ArgMatches, Args, Command, FromArgMatches, Id};
use serde::{Deserialize, Serialize};

use super::start_from::StartFrom;
use super::time_options::TimeOptions;
use crate::interconnect::ScheduleKind;
use crate::output::FormatList;
use crate::protocol::{BindCores, ExecutorChoice};
use crate::scene::{PreconditionerKind, Substeps};
use crate::solver::ExchangeMode;
use crate::transport::Machine;

/// All command-line options of a run, as stored in `run.toml`. Doc comments are the texts of `--help`.
#[derive(Clone, Debug, PartialEq, Args, Serialize, Deserialize)]
#[serde(default)]
pub struct RunOptions {
    /// Worker processes, each with its own device and row block (with --resume: as before, unless given; so for all
    /// options)
    #[arg(long, short = 'n', value_name = "N", default_value_t = 1)]
    pub workers: usize,
    /// Topology file; workers sit on its first GPUs [default: a balanced binary tree]
    #[arg(long, value_name = "FILE")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub topology: Option<PathBuf>,
    /// Hold messages back until the clock says that they have arrived over the links of --topology: a run as slow as
    /// there
    #[arg(long)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub emulate_links: bool,
    /// Executor of the kernels
    #[arg(long, value_enum, default_value_t)]
    pub executor: ExecutorChoice,
    /// Adapter of the gpu executor (numbers: loomtree doctor) [default: rank modulo adapters]
    #[arg(long, value_name = "I")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub adapter: Option<usize>,
    /// Threads of each worker on the cpu executor [default: cores / workers]
    #[arg(long, value_name = "T", value_parser = RangedU64ValueParser::<usize>::new().range(1..=65_535))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub threads: Option<usize>,
    /// Whether workers that share cores are pinned to one core each
    #[arg(long, value_enum, default_value_t)]
    pub bind_cores: BindCores,
    /// Frames to write after frame 0 [default: the scene's]
    #[arg(long, value_name = "N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub frames: Option<u32>,
    /// Triangles of the scene's procedural sheets (for example 30000, 500K or 1.2M) [default: the scene's]
    #[arg(long, value_name = "TRIANGLES", value_parser = count)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub resolution: Option<u64>,
    /// Set a field of the scene, as often as needed: simulation.friction=0.5, cloth.0.fabric=silk
    #[arg(long, value_name = "FIELD=VALUE")]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub set: Vec<String>,
    /// Start with the positions and velocities that the cloth of another run has at a frame, or at its newest state;
    /// the scene may have other physics, pins, obstacles and another resolution
    #[arg(long, value_name = "RUN[:FRAME]")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start_from: Option<StartFrom>,
    /// Untangle a start state that crosses, as far as possible, instead of refusing it
    #[arg(long)]
    pub untangle: bool,
    /// Rows that a matrix-vector product exchanges
    #[arg(long, value_enum, default_value_t)]
    pub exchange: ExchangeMode,
    /// Order of the transfers
    #[arg(long, value_enum, default_value_t)]
    pub schedule: ScheduleKind,
    /// Memory for the collision tables of each worker; larger tables are built in batches (for example 500M, 2G)
    /// [default: the memory of --topology's GPUs without the solver's]
    #[arg(long = "memory-limit", value_name = "BYTES", value_parser = bytes)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub memory_limit_bytes: Option<u64>,
    /// Preconditioner of the solver [default: the scene's, which is auto]
    #[arg(long, value_enum)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub preconditioner: Option<PreconditionerKind>,
    /// Sub-steps of a step: auto (as many as the motion asks for) or a number [default: the scene's, which is auto]
    #[arg(long, value_name = "auto|N")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub substeps: Option<Substeps>,
    /// Write a checkpoint every K frames (one is always left at the end, at Ctrl-C and after a failure); 0 = only then
    #[arg(long, value_name = "K", default_value_t = 10)]
    pub checkpoint_every: u32,
    /// Keep states for good, as states/step_%08d.ltc: that of every frame, or of every K
    /// steps
    #[arg(long, value_name = "frames|K")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub keep_states: Option<KeepStates>,
    /// Frame files: any of obj, ply, pc2, separated by commas; and caches that are made from them at the end, in the
    /// folder export: usd, usdc, abc, mdd, vtu, glb (as loomtree convert)
    #[arg(long = "format", value_name = "LIST", default_value = "ply")]
    pub formats: FormatList,
    /// Seconds without a sign of life after which a worker counts as hung
    #[arg(long = "heartbeat", value_name = "S", value_parser = positive_seconds, default_value = "10")]
    pub heartbeat_s: f64,
    /// Steps whose events are kept in trace.json, from the first one of this start; of a shot that is split in time,
    /// those of its first segment, in trace_steps.json, and of its coarse run
    #[arg(long, value_name = "N", default_value_t = 20)]
    pub trace_steps: u32,
    /// A shot that is split in time.
    #[command(flatten)]
    #[serde(flatten)]
    pub time: TimeOptions,
}

impl Default for RunOptions {
    /// Defaults of a run.
    fn default() -> RunOptions {
        let matches = RunOptions::augment_args(Command::new("run")).try_get_matches_from(["run"]);
        let options = matches.and_then(|matches| RunOptions::from_arg_matches(&matches));
        options.unwrap_or_else(|error| unreachable!("an option without a default: {error}"))
    }
}

impl RunOptions {
    /// [`RunOptions::heartbeat_s`]. A value that no clock can represent (a run.toml may be edited) counts as infinite.
    pub fn heartbeat(&self) -> Duration {
        let forever = Duration::from_secs(1_000_000_000);
        Duration::try_from_secs_f64(self.heartbeat_s).unwrap_or(forever).min(forever)
    }

    /// Executor and number of the workers.
    pub fn session(&self) -> SessionOptions {
        SessionOptions {
            workers: self.workers,
            executor: self.executor,
            adapter: self.adapter,
            threads: self.threads,
            bind_cores: self.bind_cores,
            silence: self.heartbeat(),
        }
    }
}

/// Number and setup of the workers of a session.
#[derive(Clone, Debug)]
pub struct SessionOptions {
    /// Number of workers.
    pub workers: usize,
    /// Executor of the workers.
    pub executor: ExecutorChoice,
    /// Adapter of the gpu executor; with none the ranks of all sessions are assigned to the adapters in turn.
    pub adapter: Option<usize>,
    /// Threads of each worker on the cpu executor; with none an equal share of the cores.
    pub threads: Option<usize>,
    /// Whether workers that share cores are pinned to one core each.
    pub bind_cores: BindCores,
    /// Time without a sign of life after which a worker counts as hung.
    pub silence: Duration,
}

impl Default for SessionOptions {
    /// Setup of a run without options.
    fn default() -> SessionOptions {
        RunOptions::default().session()
    }
}

impl SessionOptions {
    /// Threads of each worker of `sessions` sessions side by side on `machine`.
    pub fn threads_of(&self, sessions: usize, machine: &dyn Machine) -> usize {
        self.threads.unwrap_or_else(|| machine.threads_per_worker(sessions * self.workers))
    }
}

/// Options of a command line, with the set of those that it gave.
#[derive(Clone, Debug)]
pub struct GivenOptions {
    /// All options, defaults filled in.
    pub options: RunOptions,
    /// Those that stood on the command line, by their names in [`RunOptions`].
    given: Vec<String>,
}

impl GivenOptions {
    /// Those of a command line without options.
    pub fn none() -> GivenOptions {
        GivenOptions { options: RunOptions::default(), given: Vec::new() }
    }

    /// Whether the command line gave the option of this name in [`RunOptions`].
    pub fn gives(&self, name: &str) -> bool {
        self.given.iter().any(|given| given == name)
    }

    /// `base` with the options that the command line gave.
    ///
    /// # Errors
    /// A value that TOML cannot hold.
    pub fn over(&self, base: &RunOptions) -> Result<RunOptions, String> {
        let table = |options: &RunOptions| toml::Table::try_from(options).map_err(|error| error.to_string());
        let (mut merged, own) = (table(base)?, table(&self.options)?);
        merged.extend(own.into_iter().filter(|(name, _)| self.given.contains(name)));
        merged.try_into().map_err(|error: toml::de::Error| error.message().to_string())
    }
}

impl FromArgMatches for GivenOptions {
    fn from_arg_matches(matches: &ArgMatches) -> Result<GivenOptions, clap::Error> {
        let given =
            matches.ids().map(Id::as_str).filter(|&id| matches.value_source(id) == Some(ValueSource::CommandLine));
        Ok(GivenOptions { given: given.map(str::to_string).collect(), options: RunOptions::from_arg_matches(matches)? })
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = GivenOptions::from_arg_matches(matches)?;
        Ok(())
    }
}

impl Args for GivenOptions {
    fn augment_args(command: Command) -> Command {
        RunOptions::augment_args(command)
    }

    fn augment_args_for_update(command: Command) -> Command {
        RunOptions::augment_args_for_update(command)
    }
}

pub(crate) fn positive_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds > 0.0 && seconds <= 1e9 => Ok(seconds),
        _ => Err("expected a number of seconds above 0, at most 1e9".to_string()),
    }
}

/// A count on the command line: `30000`, `30_000`, or with K, M or G (powers of 1000) behind it, as `1.2M`.
pub(crate) fn count(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let unit = match &text[digits.len()..] {
        "" => 1.0,
        "K" | "k" => 1e3,
        "M" => 1e6,
        "G" => 1e9,
        _ => f64::NAN,
    };
    let number = digits.replace('_', "").parse::<f64>().unwrap_or(f64::NAN) * unit;
    // Rounded, because 1.2 * 1e6 need not be whole in binary.
    let count = number.round();
    if (0.0..=1e15).contains(&count) && (number - count).abs() < 1e-6 * count.max(1.0) {
        Ok(count as u64)
    } else {
        Err("expected a whole number, for example 30000, 500K or 1.2M".into())
    }
}

/// A [`count`] of bytes, whose unit may end in B.
fn bytes(text: &str) -> Result<u64, String> {
    match count(text.strip_suffix('B').unwrap_or(text)) {
        Ok(bytes) if bytes >= 1_000_000 => Ok(bytes),
        _ => Err("expected at least 1M, for example 500M or 2G".into()),
    }
}

/// States that a run keeps permanently, that of step 0 included: `frames`, or a number of steps.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum KeepStates {
    /// The state of every frame.
    Frames,
    /// The state of every multiple of this number of steps.
    Every(NonZeroU32),
}

impl KeepStates {
    /// Whether the state after `step` is kept.
    pub fn wants(self, step: u32, steps_per_frame: u32) -> bool {
        match self {
            KeepStates::Frames => step.is_multiple_of(steps_per_frame),
            KeepStates::Every(steps) => step.is_multiple_of(steps.get()),
        }
    }
}

impl FromStr for KeepStates {
    type Err = String;

    fn from_str(text: &str) -> Result<KeepStates, String> {
        match (text, text.parse()) {
            ("frames", _) => Ok(KeepStates::Frames),
            (_, Ok(steps)) => Ok(KeepStates::Every(steps)),
            _ => Err(format!("'{text}' is neither 'frames' nor a number of steps from 1 on")),
        }
    }
}

impl TryFrom<String> for KeepStates {
    type Error = String;

    fn try_from(text: String) -> Result<KeepStates, String> {
        text.parse()
    }
}

impl From<KeepStates> for String {
    fn from(keep: KeepStates) -> String {
        match keep {
            KeepStates::Frames => "frames".into(),
            KeepStates::Every(steps) => steps.to_string(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(words: &str) -> GivenOptions {
        let command = GivenOptions::augment_args(Command::new("run"));
        let matches = command.try_get_matches_from(format!("run {words}").split_whitespace()).expect("good words");
        GivenOptions::from_arg_matches(&matches).expect("options")
    }

    #[test]
    fn counts_may_have_a_unit() {
        for (text, value) in
            [("0", 0), ("30_000", 30_000), ("500K", 500_000), ("1.2M", 1_200_000), ("1G", 1_000_000_000)]
        {
            assert_eq!(count(text), Ok(value));
        }
        for text in ["", "M", "-1", "1.5", "1e", "1MB", "nan", "inf", "1 M", "99999999999G"] {
            assert!(count(text).is_err(), "{text}");
        }
    }

    #[test]
    fn what_was_not_given_stays_as_it_was() {
        let first =
            parse("--workers 3 --exchange full --format obj,pc2 --emulate-links --memory-limit 500M --heartbeat 2.5");
        let recorded = first.over(&RunOptions::default()).unwrap();
        assert_eq!(recorded, first.options);
        let text = toml::to_string(&recorded).unwrap();
        assert!(text.contains("formats = \"obj,pc2\"") && text.contains("exchange = \"full\""), "{text}");
        assert_eq!(toml::from_str::<RunOptions>(&text).unwrap(), recorded);
        // A default value that is given replaces the base value; an option that is not given does not.
        let second = parse("--workers 1 --frames 7").over(&recorded).unwrap();
        assert_eq!(second, RunOptions { workers: 1, frames: Some(7), ..recorded });
        assert_eq!(parse("").over(&second).unwrap(), second);
    }

    #[test]
    fn a_recipe_of_an_older_version_is_filled_up() {
        let old: RunOptions = toml::from_str("workers = 2\nschedule = \"fat-tree\"").unwrap();
        assert_eq!(old, RunOptions { workers: 2, schedule: ScheduleKind::FatTree, ..RunOptions::default() });
    }
}
