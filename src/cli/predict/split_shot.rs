//! A recorded shot that was split in time, as it would run on another machine: every segment on workers of its own. All
//! times are modelled.

use std::io::{self, Write};
use std::path::Path;

use serde_json::json;

use super::recorded_run::RecordedRun;
use crate::cli::CliError;
use crate::coordinator::{PartitionRule, RunOptions};
use crate::interconnect::{Replay, ReplayedStep, Topology, plan};
use crate::output::{Report, RunDirectory, RunManifest};
use crate::time_parallel::partition::{speedup_balanced, speedup_with_extra_steps};
use crate::time_parallel::{Costs, Cut, Method, Partition, Played};

/// Bytes of a vertex's state: position and velocity.
const STATE_BYTES: f64 = 24.0;
/// Bytes of a sub-vector's row on a link.
const ROW_BYTES: f64 = 12.0;

/// The shot on the virtual clock.
pub(super) struct SplitShot {
    played: Played,
    /// Workers of a segment.
    workers: usize,
    /// Mean fine and coarse step, seconds.
    fine_s: f64,
    coarse_s: f64,
    /// K: a fine step over the coarse run for the same stretch of time.
    ratio: f64,
    /// The bound of Eq. 16 for this K, the steps of recovery and the longest hand-over.
    bound: f64,
}

impl SplitShot {
    pub(super) const ASSUMPTION: &str = "the shot: steps of a level that were not recorded last as long as measured, \
                                         times the mean of modelled over measured of those that were; a process per \
                                         segment, cut and handed over as recorded; states move alone between the two \
                                         GPUs that are farthest apart";

    /// Plays the shot of the run directory `run`, `fine`, whose recorded steps last as long as `steps` says on the
    /// machine of `how`; `machine`: all of it.
    pub(super) fn play(
        run: &Path,
        fine: &RecordedRun,
        steps: &[ReplayedStep],
        machine: &Topology,
        how: &Replay<'_>,
    ) -> Result<SplitShot, CliError> {
        let refuse = |what: String| CliError::bad_input(format!("{}: {what}", run.display()));
        let directory = RunDirectory::open(run).map_err(CliError::bad_input)?;
        let manifest = RunManifest::load(&directory).map_err(CliError::bad_input)?;
        let time = manifest.flags::<RunOptions>().map_err(CliError::bad_input)?.time;
        if time.sweeps > 0 || time.levels > 2 {
            return Err(refuse("shots with --sweeps or more than two --levels are not modelled".into()));
        }
        let segments = &fine.report.segments;
        let (count, workers) = (segments.len(), fine.ranks);
        if machine.gpus() < count * workers {
            let what = format!("{count} segments of {workers} workers need {} GPUs", count * workers);
            return Err(refuse(format!("{what}, {} has {}", machine.name(), machine.gpus())));
        }
        let coarse = RecordedRun::read_any(&directory.preview())?;
        let rows = coarse.rows()?;
        let queues = plan(how.plan.kind, how.topology, rows.div_ceil(coarse.ranks) as f64 * ROW_BYTES)
            .map_err(CliError::bad_input)?;
        let coarse_steps = coarse.replay(&Replay { plan: &queues, rows, ..*how })?;

        let [fine_s, each_s] = [(&fine.report, steps), (&coarse.report, &coarse_steps)].map(|of| seconds(of.0, of.1));
        let [fine_s, each_s] = [fine_s, each_s].map(|all| all.ok_or_else(|| refuse("no measured steps".into())));
        let (fine_s, each_s) = (fine_s?, each_s?);
        let stride = (coarse.report.header.step_s / fine.report.header.step_s).round() as usize;
        if each_s.len() * stride != fine_s.len() {
            let what = format!("{} of {} steps are there: end it first", fine_s.len(), each_s.len() * stride);
            return Err(refuse(format!("the shot is not finished, {what} (--resume)")));
        }
        let spread = each_s.iter().flat_map(|seconds| vec![seconds / stride as f64; stride]).collect();
        let costs = Costs { fine: fine_s, coarse: vec![spread], stride: stride as u64 };
        let state_s = |report: &Report| machine.farthest_s(STATE_BYTES * report.header.vertices as f64);
        let recovery = segments.iter().map(|segment| u64::from(segment.recovery_steps)).max().unwrap_or(0);
        let method = Method {
            partition: Partition::Known,
            recovery_steps: recovery,
            handover_steps: 0,
            coarse_state_s: state_s(&coarse.report),
            fine_state_s: state_s(&fine.report),
            coarse_to_end: true,
        };
        let cut = Cut {
            starts: segments.iter().map(|segment| u64::from(segment.first_step)).collect(),
            handover_steps: segments.iter().map(|segment| u64::from(segment.handover_steps)).collect(),
            waits_for_coarse: time.partition == PartitionRule::Counted,
        };
        let ratio = costs.ratio();
        let extra = recovery + cut.handover_steps.iter().copied().max().unwrap_or(0);
        let mean = |seconds: &[f64]| seconds.iter().sum::<f64>() / seconds.len() as f64;
        Ok(SplitShot {
            played: costs.play_cut(&cut, &method),
            workers,
            fine_s: mean(&costs.fine),
            coarse_s: mean(&each_s),
            ratio,
            bound: speedup_with_extra_steps(costs.fine.len() as u64, extra, speedup_balanced(ratio, count)),
        })
    }

    pub(super) fn write_text(&self, out: &mut impl Write) -> io::Result<()> {
        let SplitShot { played, workers, fine_s, coarse_s, ratio, bound } = self;
        writeln!(
            out,
            "\nthe shot, modelled: {} segments of {workers} workers, {:.3} s; its steps one after the other {:.3} s, \
             {:.2} times as long (Eq. 16: {bound:.2}); {:.0} % idle",
            played.starts.len(),
            played.seconds,
            played.seconds * played.speedup,
            played.speedup,
            played.idle_share * 100.0
        )?;
        writeln!(out, "a step {:.3} ms, a coarse step {:.3} ms: K = {ratio:.1}", fine_s * 1e3, coarse_s * 1e3)
    }

    pub(super) fn json(&self) -> serde_json::Value {
        json!({
            "segments": self.played.starts.len(),
            "workers_per_segment": self.workers,
            "starts": self.played.starts,
            "modelled_s": self.played.seconds,
            "speed_up": self.played.speedup,
            "eq16": self.bound,
            "k": self.ratio,
            "idle_share": self.played.idle_share,
            "step_modelled_s": self.fine_s,
            "coarse_step_modelled_s": self.coarse_s,
        })
    }
}

/// Modelled seconds of all steps of `report`, of which `steps` are recorded. None without a measured step among them.
fn seconds(report: &Report, steps: &[ReplayedStep]) -> Option<Vec<f64>> {
    let measured = |step: u32| report.steps.iter().find(|record| record.step == u64::from(step));
    let both = steps.iter().filter_map(|step| Some((step.total_s, measured(step.step)?.stage_seconds.total)));
    let [modelled, taken] = both.fold([0.0; 2], |[a, b], (c, d)| [a + c, b + d]);
    (taken > 0.0).then(|| report.steps.iter().map(|step| step.stage_seconds.total * modelled / taken).collect())
}
