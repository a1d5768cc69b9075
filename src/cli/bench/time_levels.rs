//! The measured steps that `loomtree bench time` plays.

use std::path::Path;

use crate::cli::CliError;
use crate::interconnect::Topology;
use crate::output::{Report, RunDirectory};
use crate::time_parallel::Costs;

/// The recorded steps of a level.
pub(super) struct Level {
    pub(super) report: Report,
    pub(super) place: String,
}

impl Level {
    pub(super) fn read(run: &Path) -> Result<Level, CliError> {
        let directory = RunDirectory::open(run).map_err(CliError::bad_input)?;
        let report = Report::load(&directory.report()).map_err(CliError::bad_input)?;
        let level = Level { report, place: run.display().to_string() };
        if level.report.steps.is_empty() || level.report.steps.iter().any(|step| !(step.stage_seconds.total > 0.0)) {
            return Err(CliError::bad_input(format!("{}/report.json holds no steps with times", level.place)));
        }
        Ok(level)
    }

    /// Seconds of every step.
    fn seconds(&self) -> impl Iterator<Item = f64> {
        self.report.steps.iter().map(|step| step.stage_seconds.total)
    }

    /// Fine steps in a step of this level.
    fn stride(&self, fine: &Level) -> Result<usize, CliError> {
        let (ours, theirs) = (self.report.header.step_s, fine.report.header.step_s);
        let ratio = ours / theirs;
        if !(ratio >= 0.999 && (ratio - ratio.round()).abs() < 1e-6 * ratio) {
            let text =
                format!("{}: a step of {ours} s is no whole multiple of the {theirs} s of {}", self.place, fine.place);
            return Err(CliError::bad_input(text));
        }
        let (have, need) = (self.report.steps.len() * ratio.round() as usize, fine.report.steps.len());
        if have != need {
            let text = format!("{} ends after {have} fine steps and {} after {need}", self.place, fine.place);
            return Err(CliError::bad_input(text));
        }
        Ok(ratio.round() as usize)
    }

    fn state_bytes(&self) -> f64 {
        24.0 * self.report.header.vertices as f64
    }
}

/// Costs as recorded, and the seconds for moving a coarse and a fine state.
#[derive(Clone)]
pub(super) struct Recorded {
    pub(super) costs: Costs,
    pub(super) coarse_state_s: f64,
    pub(super) fine_state_s: f64,
    pub(super) title: String,
    /// Triangles of the fine mesh.
    pub(super) triangles: u64,
}

impl Recorded {
    pub(super) fn of(levels: &[Level], machine: &Topology) -> Result<Recorded, CliError> {
        let (fine, coarser) = levels.split_first().expect("a fine run");
        let mut costs = Costs { fine: fine.seconds().collect(), ..Costs::default() };
        for level in coarser {
            let stride = level.stride(fine)?;
            costs.stride = costs.stride.max(stride as u64);
            let spread = level.seconds().flat_map(|seconds| vec![seconds / stride as f64; stride]);
            costs.coarse.push(spread.collect());
        }
        let sizes: Vec<String> = levels.iter().map(|level| level.report.header.triangles.to_string()).collect();
        let title = format!(
            "{}: {} triangles, {} recorded steps on {}",
            fine.report.header.scene,
            sizes.join(" / "),
            costs.fine.len(),
            fine.report.header.machine.cpu,
        );
        let [fine_state_s, coarse_state_s] =
            [fine.state_bytes(), coarser[0].state_bytes()].map(|bytes| machine.farthest_s(bytes));
        let triangles = fine.report.header.triangles as u64;
        Ok(Recorded { costs, coarse_state_s, fine_state_s, title, triangles })
    }

    /// The costs repeated to `steps` fine steps; a coarse step is as long as `stretch` recorded ones, at the cost of
    /// one.
    pub(super) fn shot(&self, steps: u64, stretch: f64) -> Costs {
        let repeated = |costs: &[f64], scale: f64| -> Vec<f64> {
            costs.iter().cycle().take(steps as usize).map(|cost| cost * scale).collect()
        };
        Costs {
            fine: repeated(&self.costs.fine, 1.0),
            coarse: self.costs.coarse.iter().map(|costs| repeated(costs, 1.0 / stretch)).collect(),
            stride: ((self.costs.stride as f64 * stretch) as u64).max(1),
        }
    }
}
