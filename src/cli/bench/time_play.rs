//! A shot that `loomtree bench time` plays on a virtual clock, and the figures of its tables.

use clap::ValueEnum;

use super::time_levels::Recorded;
use crate::time_parallel::partition::{speedup_balanced, speedup_with_extra_steps};
use crate::time_parallel::{Costs, Method, Partition, Played};

/// The shot, and how it is split.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct ShotArgs {
    /// Fine steps of the shot that is played; the recorded costs are repeated to its end
    #[arg(long, value_name = "N", default_value_t = 10_000,
        value_parser = clap::value_parser!(u32).range(2..=1_000_000))]
    pub(super) steps: u32,
    /// Numbers of processes
    #[arg(long, value_delimiter = ',', default_value = "2,4,8,16,32,64,128,256,512", value_parser = processes)]
    pub(super) processes: Vec<usize>,
    /// Rule for the cuts
    #[arg(long, value_enum, default_value = "profile")]
    pub(super) partition: Rule,
    /// Steps that recover detail at the start of every segment
    #[arg(long, value_name = "R", default_value_t = 5)]
    pub(super) recovery_steps: u32,
    /// Steps at the start of every segment that are made again from the end of the one before
    #[arg(long, value_name = "B", default_value_t = 5)]
    pub(super) handover_steps: u32,
}

/// Rules for cuts, by their names on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(super) enum Rule {
    /// Equal lengths (Eq. 3)
    Uniform,
    /// Eq. 5 with the mean ratio
    Static,
    /// Algorithm 1 with the seconds of the steps
    Clock,
    /// All segments end together if fine steps cost what the finished coarse run says
    Profile,
    /// All segments end together, from fine costs that nobody knows beforehand: the bound
    Known,
}

impl Rule {
    fn partition(self) -> Partition {
        match self {
            Rule::Uniform => Partition::Uniform,
            Rule::Static => Partition::Static,
            Rule::Clock => Partition::Adaptive,
            Rule::Profile => Partition::Profile,
            Rule::Known => Partition::Known,
        }
    }
}

fn processes(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(n) if (1..=4096).contains(&n) => Ok(n),
        _ => Err("expected numbers of processes from 1 to 4096, separated by commas".to_string()),
    }
}

/// Columns of the tables.
pub(super) const COLUMNS: [&str; 10] = [
    "processes",
    "segments",
    "workers",
    "levels",
    "speedup",
    "eq6",
    "eq16",
    "idle_share",
    "recovery_steps",
    "handover_steps",
];

impl ShotArgs {
    /// How the shot is split, by the rule of the command line.
    pub(super) fn method(&self, recorded: &Recorded) -> Method {
        self.method_with(recorded, self.partition)
    }

    /// The same with another rule for the cuts.
    pub(super) fn method_with(&self, recorded: &Recorded, rule: Rule) -> Method {
        Method {
            partition: rule.partition(),
            recovery_steps: u64::from(self.recovery_steps),
            handover_steps: u64::from(self.handover_steps),
            coarse_state_s: recorded.coarse_state_s,
            fine_state_s: recorded.fine_state_s,
            coarse_to_end: true,
        }
    }

    /// The figures of [`COLUMNS`] for a shot.
    pub(super) fn row(&self, costs: &Costs, processes: usize, method: &Method) -> (Played, Vec<f64>) {
        let played = costs.play(processes, method);
        let balanced = speedup_balanced(costs.ratio(), processes);
        let extra = method.recovery_steps + method.handover_steps;
        let eq16 = speedup_with_extra_steps(costs.fine.len() as u64, extra, balanced);
        let row = vec![
            processes as f64,
            played.starts.len() as f64,
            1.0,
            1.0 + costs.coarse.len() as f64,
            played.speedup,
            balanced,
            eq16,
            played.idle_share,
            method.recovery_steps as f64,
            method.handover_steps as f64,
        ];
        (played, row)
    }

    /// Title of a table of shots with these costs.
    pub(super) fn title(&self, recorded: &Recorded, costs: &Costs) -> String {
        format!(
            "modelled, not measured: a shot of {} steps split in time, from measured steps of {}; K = {:.1}, \
             cuts: {:?}",
            costs.fine.len(),
            recorded.title,
            costs.ratio(),
            self.partition,
        )
    }
}
