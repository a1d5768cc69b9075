//! `loomtree predict`: re-times a recorded run on the machine of a topology file. All times it prints are modelled,
//! unless they are called measured.

mod pictures;
mod recorded_run;
mod split_shot;

use std::io::{self, Write};
use std::path::PathBuf;

use clap::ValueEnum;
use serde_json::json;

use super::{CliError, print_to};
use crate::interconnect::{
    KernelTimes, Plan, ProductExchange, Replay, ReplayedStep, STAGES, ScheduleKind, Topology, plan,
};
use crate::os::console::{is_json, note};
use crate::output::{Report, write_timeline};
use recorded_run::BetweenHosts;
pub(super) use recorded_run::RecordedRun;
use split_shot::SplitShot;

/// Arguments of `loomtree predict`.
#[derive(Clone, Debug, clap::Args)]
pub struct PredictArgs {
    /// Directory of a run that recorded events (`loomtree run --trace-steps N`), or of a solve (`loomtree solve
    /// --trace DIR`)
    pub run: PathBuf,
    /// Machine to predict (topology file)
    #[arg(long)]
    pub topology: PathBuf,
    /// How transfers are scheduled there
    #[arg(long, default_value = "auto")]
    pub schedule: ScheduleKind,
    /// What products exchange there [default: as recorded]
    #[arg(long)]
    pub exchange: Option<PredictExchange>,
    /// Where kernel times come from: the topology's device, or as measured in the recorded run
    #[arg(long, default_value = "device")]
    pub kernels: PredictKernels,
    /// A run that was really made in the predicted configuration, to state the error
    #[arg(long, value_name = "RUN_DIR")]
    pub measured: Option<PathBuf>,
    /// Print JSON instead of tables
    #[arg(long)]
    pub json: bool,
    /// Also write the modelled first step as a trace for ui.perfetto.dev
    #[arg(long, value_name = "FILE")]
    pub trace: Option<PathBuf>,
    /// Also draw a modelled product of the first step (the paper's Fig. 3) into this SVG file
    #[arg(long, value_name = "FILE")]
    pub svg: Option<PathBuf>,
}

/// Exchange mode of products.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PredictExchange {
    /// Only the rows that are read
    Halo,
    /// Whole sub-vectors, multiplied block by block as they arrive
    Full,
    /// Whole sub-vectors, all of them before the first multiplication
    GatherFirst,
}

/// Where kernel times come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PredictKernels {
    /// Bytes and flops over the rates of the topology's device
    Device,
    /// Durations measured in the recorded run
    Recorded,
}

/// Runs the command; the result goes to stdout.
pub fn run(args: PredictArgs) -> Result<(), CliError> {
    write_prediction(&args, &mut io::stdout().lock())
}

/// Runs the command; the result goes to `out`. A reader that went away is no error.
pub fn write_prediction(args: &PredictArgs, out: &mut impl Write) -> Result<(), CliError> {
    let prediction = Prediction::make(args)?;
    if let Some(path) = &args.trace {
        prediction.write_trace(path)?;
    }
    if let Some(path) = &args.svg {
        write_timeline(path, &prediction.timeline()).map_err(|error| CliError::failed(format!("--svg: {error}")))?;
    }
    let mut text = Vec::new();
    if is_json() {
        let mut lines = Vec::new();
        prediction.write_text(&mut lines).map_err(CliError::failed)?;
        note(String::from_utf8_lossy(&lines).trim_end());
    }
    let written = match args.json || is_json() {
        true => writeln!(text, "{:#}", prediction.json()),
        false => prediction.write_text(&mut text),
    };
    written.map_err(|error| CliError::failed(format!("cannot write the prediction: {error}")))?;
    print_to(out, &String::from_utf8_lossy(&text))
}

/// A measured run of the predicted configuration.
struct Measured {
    /// Where it comes from.
    what: String,
    /// Mean step over the steps of the prediction, seconds.
    step_s: f64,
}

struct Prediction {
    report: Report,
    topology: Topology,
    plan: Plan,
    exchange: ProductExchange,
    kernels: KernelTimes,
    steps: Vec<ReplayedStep>,
    /// Largest memory of every rank, bytes.
    memory: Vec<u64>,
    measured: Option<Measured>,
    between_hosts: Option<BetweenHosts>,
    /// The shot as it was split in time.
    shot: Option<SplitShot>,
    assumptions: Vec<String>,
}

impl Prediction {
    fn make(args: &PredictArgs) -> Result<Prediction, CliError> {
        let recorded = RecordedRun::read_any(&args.run)?;
        let whole = Topology::read(&args.topology).map_err(CliError::bad_input)?;
        let topology = whole.with_first_gpus(recorded.ranks).map_err(CliError::bad_input)?;
        let (ranks, rows) = (recorded.ranks, recorded.rows()?);
        let plan = plan(args.schedule, &topology, rows.div_ceil(ranks) as f64 * 12.0)
            .map_err(|error| CliError::bad_input(format!("{}: {error}", args.topology.display())))?;
        let exchange = match args.exchange {
            Some(PredictExchange::Halo) => ProductExchange::Halo,
            Some(PredictExchange::Full) => ProductExchange::Full,
            Some(PredictExchange::GatherFirst) => ProductExchange::GatherFirst,
            None => recorded.exchange(),
        };
        let kernels = match args.kernels {
            PredictKernels::Device => KernelTimes::Device,
            PredictKernels::Recorded => KernelTimes::Recorded,
        };
        let how = Replay { topology: &topology, plan: &plan, exchange, kernels, rows };
        let steps = recorded.replay(&how)?;
        let between_hosts = recorded.between(topology.hosts(), exchange)?;
        let is_split = !recorded.report.segments.is_empty();
        let shot = if is_split { Some(SplitShot::play(&args.run, &recorded, &steps, &whole, &how)?) } else { None };
        let report = recorded.report;
        let mut memory = vec![0u64; ranks];
        for record in &report.steps {
            for (most, bytes) in memory.iter_mut().zip(&record.memory_bytes_per_rank) {
                *most = (*most).max(*bytes);
            }
        }
        let mut prediction = Prediction {
            report,
            topology,
            plan,
            exchange,
            kernels,
            steps,
            memory,
            measured: None,
            between_hosts,
            shot,
            assumptions: Vec::new(),
        };
        prediction.measured = prediction.find_measured(args)?;
        prediction.assumptions = prediction.assume();
        Ok(prediction)
    }

    /// The run named by `--measured`, or the recorded run itself if it was made in this very configuration.
    fn find_measured(&self, args: &PredictArgs) -> Result<Option<Measured>, CliError> {
        let mean = |report: &Report| {
            let wanted = |step: u64| self.steps.iter().any(|replayed| u64::from(replayed.step) == step);
            let seconds: Vec<f64> =
                report.steps.iter().filter(|s| wanted(s.step)).map(|s| s.stage_seconds.total).collect();
            (!seconds.is_empty()).then(|| seconds.iter().sum::<f64>() / seconds.len() as f64)
        };
        if let Some(path) = &args.measured {
            let report = Report::load(&path.join("report.json")).map_err(CliError::bad_input)?;
            if report.header.workers != self.topology.gpus() {
                return Err(CliError::bad_input(format!(
                    "--measured {}: it had {} workers, the prediction is for {}",
                    path.display(),
                    report.header.workers,
                    self.topology.gpus()
                )));
            }
            let what = path.display().to_string();
            return Ok(mean(&report).map(|step_s| Measured { what, step_s }));
        }
        let header = &self.report.header;
        let same = header.exchange == exchange_name(self.exchange)
            && header.schedule == self.plan.kind.name()
            && header.devices.iter().all(|device| device.contains(&self.topology.device().name));
        Ok(mean(&self.report)
            .filter(|_| same)
            .map(|step_s| Measured { what: "the recorded run, same configuration".into(), step_s }))
    }

    fn assume(&self) -> Vec<String> {
        let device = self.topology.device();
        let mut all = vec![match self.kernels {
            KernelTimes::Device => format!(
                "kernels last max(bytes / {} GB/s, flops / {} Gflop/s) + {} us ({}, from the topology file)",
                device.bandwidth_gb_s, device.gflops, device.launch_us, device.name
            ),
            KernelTimes::Recorded => "kernels last as long as they were measured in the recorded run".to_string(),
        }];
        all.push("links are shared max-min fairly; bandwidths and latencies are those of the topology file".into());
        all.push(
            "what collisions tell all ranks travels like whole sub-vectors, and waits for it are modelled anew".into(),
        );
        if self.between_hosts.is_some() {
            all.push(
                "between hosts: rows to each reader, whole-cloth lists once per host; packets of TCP over Ethernet: \
                 40 B before a message, 66 B before each segment of 1448 B, every second one acknowledged; orders, \
                 reports and states of frames not counted"
                    .into(),
            );
        }
        all.push("transfers run beside kernels; no protocol overhead, no host work between kernels".into());
        if self.shot.is_some() {
            all.push(SplitShot::ASSUMPTION.into());
        }
        all.push("one GPU: the same kernels added up over the ranks, border elements counted on both sides".into());
        let recorded = self.report.header.exchange.as_str();
        if self.exchange == ProductExchange::Halo {
            all.push("halo rows shared by several readers are not recorded: each reader gets its own copy".into());
            if recorded == "full" {
                all.push(
                    "recorded with full: rows with halo columns = rows that others read (symmetric pattern)".into(),
                );
            }
        } else if recorded == "halo" {
            all.push("recorded with halo: a block A_ij is taken to hold three 3x3 blocks per halo row".into());
        }
        all
    }

    fn mean_s(&self) -> f64 {
        self.total_s() / self.steps.len() as f64
    }

    fn total_s(&self) -> f64 {
        self.steps.iter().map(|step| step.total_s).sum()
    }

    fn speed_up(&self) -> f64 {
        self.steps.iter().map(|step| step.one_gpu_s).sum::<f64>() / self.total_s()
    }

    fn idle_share(&self) -> f64 {
        let busy_s: f64 = self.steps.iter().flat_map(|step| &step.busy_s).sum();
        1.0 - busy_s / (self.total_s() * self.topology.gpus() as f64)
    }

    /// Name and share of time of the link direction that is busiest.
    fn busiest_link(&self) -> Option<(String, f64)> {
        let busy_s = |link: usize, way: usize| self.steps.iter().map(|step| step.link_s[link][way]).sum::<f64>();
        let all = (0..self.topology.links().len()).flat_map(|link| [(link, 0), (link, 1)]);
        let (link, way) = all.max_by(|a, b| busy_s(a.0, a.1).total_cmp(&busy_s(b.0, b.1)))?;
        let [mut a, mut b] = self.topology.links()[link].ends.map(|node| self.topology.node_name(node));
        if way == 1 {
            std::mem::swap(&mut a, &mut b);
        }
        Some((format!("{a} to {b}"), busy_s(link, way) / self.total_s()))
    }

    fn stage_s(&self, stage: usize) -> f64 {
        self.steps.iter().map(|step| step.stage_s[stage]).sum::<f64>() / self.steps.len() as f64
    }

    fn title(&self) -> String {
        let header = &self.report.header;
        let size = match header.triangles {
            0 => format!("{} block rows", header.vertices),
            triangles => format!("{triangles} triangles"),
        };
        format!(
            "{} ({size}) on {}: {} x {}, exchange {}, schedule {}",
            header.scene,
            self.topology.name(),
            self.topology.gpus(),
            self.topology.device().name,
            exchange_name(self.exchange),
            self.plan.kind
        )
    }

    fn write_text(&self, out: &mut impl Write) -> io::Result<()> {
        writeln!(out, "{}", self.title())?;
        writeln!(out, "\nmodelled, not measured:")?;
        writeln!(out, "  {:>6} {:>12} {:>12} {:>9} {:>6}", "step", "ms", "1 GPU ms", "speed-up", "idle")?;
        for step in &self.steps {
            let idle = 1.0 - step.busy_s.iter().sum::<f64>() / (step.total_s * step.busy_s.len() as f64);
            writeln!(
                out,
                "  {:>6} {:>12.3} {:>12.3} {:>9.2} {:>5.0}%",
                step.step,
                step.total_s * 1e3,
                step.one_gpu_s * 1e3,
                step.one_gpu_s / step.total_s,
                idle * 100.0
            )?;
        }
        writeln!(
            out,
            "  {:>6} {:>12.3} {:>12.3} {:>9.2} {:>5.0}%",
            "mean",
            self.mean_s() * 1e3,
            self.mean_s() * self.speed_up() * 1e3,
            self.speed_up(),
            self.idle_share() * 100.0
        )?;
        writeln!(out, "\n  {:<12} {:>12} {:>7}", "stage", "ms per step", "share")?;
        for (stage, name) in STAGES.iter().enumerate().filter(|(stage, _)| self.stage_s(*stage) > 0.0) {
            let seconds = self.stage_s(stage);
            writeln!(out, "  {name:<12} {:>12.3} {:>6.1}%", seconds * 1e3, seconds / self.mean_s() * 100.0)?;
        }
        if let Some((link, share)) = self.busiest_link() {
            writeln!(out, "\nbusiest link: {link}, busy {:.1} % of the time", share * 100.0)?;
        }
        if let Some(between) = &self.between_hosts {
            writeln!(out, "between hosts: {}", between.sentence())?;
        }
        writeln!(out, "{}", self.memory_sentence())?;
        if let Some(shot) = &self.shot {
            shot.write_text(out)?;
        }
        match &self.measured {
            Some(measured) => writeln!(
                out,
                "measured ({}): {:.3} ms per step; the model is off by {:+.1} %",
                measured.what,
                measured.step_s * 1e3,
                (self.mean_s() / measured.step_s - 1.0) * 100.0
            )?,
            None => writeln!(out, "no measured run of this configuration to compare with (--measured RUN_DIR)")?,
        }
        writeln!(out, "assumptions:")?;
        self.assumptions.iter().try_for_each(|text| writeln!(out, "  - {text}"))
    }

    fn memory_sentence(&self) -> String {
        if self.memory.iter().all(|bytes| *bytes == 0) {
            return "memory: the report of the recorded run does not count it".to_string();
        }
        let limit_gb = self.topology.device().memory_gb;
        let most_gb = self.memory.iter().copied().max().unwrap_or(0) as f64 / 1e9;
        let sum_gb = self.memory.iter().sum::<u64>() as f64 / 1e9;
        let fits = |gb: f64| if gb <= limit_gb { "fits" } else { "does not fit" };
        format!(
            "memory (counted in the recorded run): {most_gb:.3} GB per GPU on {} ({}), about {sum_gb:.3} GB on 1 ({}), of \
             {limit_gb} GB",
            self.topology.gpus(),
            fits(most_gb),
            fits(sum_gb)
        )
    }

    fn json(&self) -> serde_json::Value {
        let stages = |seconds: &dyn Fn(usize) -> f64| {
            STAGES
                .iter()
                .enumerate()
                .map(|(i, name)| (name.to_string(), json!(seconds(i))))
                .collect::<serde_json::Map<_, _>>()
        };
        let steps: Vec<_> = self
            .steps
            .iter()
            .map(|step| {
                json!({
                    "step": step.step,
                    "modelled_s": step.total_s,
                    "one_gpu_modelled_s": step.one_gpu_s,
                    "speed_up": step.one_gpu_s / step.total_s,
                    "idle_share": 1.0 - step.busy_s.iter().sum::<f64>() / (step.total_s * step.busy_s.len() as f64),
                    "stage_modelled_s": stages(&|i| step.stage_s[i]),
                    "busy_modelled_s_per_rank": step.busy_s,
                })
            })
            .collect();
        let busiest = self.busiest_link().map(|(link, share)| json!({"link": link, "share": share}));
        let measured = self.measured.as_ref().map(|measured| {
            let error = self.mean_s() / measured.step_s - 1.0;
            json!({"run": measured.what, "step_s": measured.step_s, "relative_error": error})
        });
        json!({
            "modelled": true,
            "scene": self.report.header.scene,
            "topology": self.topology.name(),
            "device": self.topology.device(),
            "gpus": self.topology.gpus(),
            "exchange": exchange_name(self.exchange),
            "schedule": self.plan.kind.name(),
            "mean_modelled_s": self.mean_s(),
            "speed_up": self.speed_up(),
            "idle_share": self.idle_share(),
            "stage_modelled_s": stages(&|i| self.stage_s(i)),
            "busiest_link": busiest,
            "between_hosts": self.between_hosts,
            "memory_bytes_per_gpu": self.memory,
            "memory_limit_bytes": self.topology.device().memory_gb * 1e9,
            "measured": measured,
            "shot": self.shot.as_ref().map(SplitShot::json),
            "assumptions": self.assumptions,
            "steps": steps,
        })
    }
}

fn exchange_name(exchange: ProductExchange) -> &'static str {
    match exchange {
        ProductExchange::Halo => "halo",
        ProductExchange::Full => "full",
        ProductExchange::GatherFirst => "gather-first",
    }
}
