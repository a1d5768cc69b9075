//! Ranks as threads of this process, for benchmarks that need single products of a scene's matrix: a state in which
//! contacts act, and its matrix split over any number of ranks.

use std::time::Instant;

use super::common::{Common, median};
use crate::cli::CliError;
use crate::interconnect::QueueNode;
use crate::model::{GlobalModel, RankModel, RankState};
use crate::partition::RowPartition;
use crate::scene::PreconditionerKind;
use crate::solver::ExchangeMode;
use crate::step::{ExchangePlan, Simulation};
use crate::transport::{InProcessTransport, SoloTransport, Transport, cores};

/// A scene in a state, and the step that comes next.
pub(super) struct ModelState {
    /// The cloth in that state; its preconditioner is block Jacobi.
    pub model: GlobalModel,
    /// Number of the step.
    pub step: u32,
    /// Contacts in the matrix of that step.
    pub contacts: u64,
}

impl ModelState {
    /// Advances `model` until at least `contacts_per_vertex` act, or by `steps_max` steps, with all cores: threads
    /// change no bit.
    pub(super) fn in_contact(
        mut model: GlobalModel,
        common: &Common,
        contacts_per_vertex: f64,
        steps_max: u32,
    ) -> Result<ModelState, CliError> {
        let failed = |error: &dyn std::fmt::Display| CliError::failed(error.to_string());
        let mut transport = SoloTransport::new(Box::new(|| false));
        let all_cores = Common { threads: u16::try_from(cores()).unwrap_or(u16::MAX), ..common.clone() };
        let mut simulation = alone(&model, &all_cores)?;
        let enough = contacts_per_vertex * model.rows() as f64;
        let mut step = 0;
        while step < steps_max {
            step += 1;
            let contacts = simulation.step(&mut transport, step, false).map_err(|error| failed(&error))?.contacts;
            if contacts > 0 && contacts as f64 >= enough {
                break;
            }
        }
        let RankState { positions, velocities, creases, stretches, let_go: _, holds: _ } = simulation.state();
        (model.positions, model.velocities, model.stretches) = (positions, velocities, stretches);
        // One rank holds all elements in the order of the model.
        model.hinges.iter_mut().zip(creases).for_each(|(hinge, crease)| hinge.set_crease(crease));
        let contacts = simulation.assemble(&mut transport, step + 1).map_err(|error| failed(&error))?;
        model.settings.preconditioner = PreconditionerKind::Jacobi;
        Ok(ModelState { model, step: step + 1, contacts })
    }

    /// One rank that holds everything, in this state.
    pub(super) fn one_rank(&self, common: &Common) -> Result<Simulation, CliError> {
        alone(&self.model, common)
    }

    /// Assembles the matrix of the step on `queues.len()` ranks and calls `with` on each of them, all at once. Results
    /// in the order of the ranks.
    pub(super) fn on_ranks<T: Send>(
        &self,
        common: &Common,
        mode: ExchangeMode,
        queues: &[Vec<QueueNode>],
        with: impl Fn(&mut Simulation, &mut dyn Transport) -> Result<T, String> + Sync,
    ) -> Result<Vec<T>, CliError> {
        let ranks = queues.len();
        let parts = split(&self.model, ranks)?;
        let with = &with;
        let results: Vec<Result<T, String>> = std::thread::scope(|scope| {
            let threads: Vec<_> = parts
                .into_iter()
                .zip(InProcessTransport::group(ranks))
                .zip(queues)
                .map(|((part, mut transport), queue)| {
                    scope.spawn(move || {
                        let executor = common.executor().map_err(|error| error.to_string())?;
                        let plan = ExchangePlan { mode, queue: queue.clone() };
                        let mut simulation = Simulation::new(executor, part, &plan).map_err(|e| e.to_string())?;
                        simulation.assemble(&mut transport, self.step).map_err(|error| error.to_string())?;
                        with(&mut simulation, &mut transport)
                    })
                })
                .collect();
            threads.into_iter().map(|rank| rank.join().unwrap_or_else(|_| Err("a rank panicked".to_string()))).collect()
        });
        results.into_iter().collect::<Result<Vec<T>, String>>().map_err(CliError::failed)
    }
}

fn alone(model: &GlobalModel, common: &Common) -> Result<Simulation, CliError> {
    let mut parts = split(model, 1)?;
    let part = parts.pop().ok_or_else(|| CliError::failed("the model has no part"))?;
    let plan = ExchangePlan { mode: ExchangeMode::Halo, queue: Vec::new() };
    Simulation::new(common.executor()?, part, &plan).map_err(|error| CliError::failed(error.to_string()))
}

fn split(model: &GlobalModel, ranks: usize) -> Result<Vec<RankModel>, CliError> {
    let mut parts = Vec::with_capacity(ranks);
    RankModel::split(model, &RowPartition::new(model.rows(), ranks), |_, own| {
        parts.push(own);
        Ok::<(), CliError>(())
    })?;
    Ok(parts)
}

/// Length of what began and ended.
pub(super) fn seconds_of((start, end): &(Instant, Instant)) -> f64 {
    (*end - *start).as_secs_f64()
}

/// Median seconds from the earliest start to the latest end over the ranks.
pub(super) fn median_s(times: &[Vec<(Instant, Instant)>]) -> f64 {
    let rounds = times.iter().map(Vec::len).min().unwrap_or(0);
    let mut seconds: Vec<f64> = (0..rounds)
        .filter_map(|round| {
            let start = times.iter().map(|rank| rank[round].0).min()?;
            let end = times.iter().map(|rank| rank[round].1).max()?;
            Some((end - start).as_secs_f64())
        })
        .collect();
    median(&mut seconds)
}
