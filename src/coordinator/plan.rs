//! The inputs of a run before any process starts: scene, model, partition, schedule. All input that a run refuses is
//! refused here.

use std::path::Path;

use thiserror::Error;

use super::options::RunOptions;
use super::start_from::kept_start;
use super::steering::Steering;
use crate::interconnect::{Plan, RankLinks, ScheduleError, ScheduleKind, Topology, TopologyError, Traffic, plan};
use crate::math::DIM;
use crate::model::{GlobalModel, RankModel};
use crate::partition::{RowPartition, most_ranks};
use crate::scene::{Overrides, ParsedScene, Scene, SceneError, Untangling, blame, read, read_str, set_fields};
use crate::solver::ExchangeMode;
use crate::transport::{RANKS_MAX, STAMP_VALUES};

/// Bytes on a worker without collision tables, rounded up (ARCHITECTURE.md, "Memory per vertex").
const SOLVER_BYTES_PER_ROW: f64 = 2_500.0;

/// Error that refuses a run.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, Error)]
pub enum PlanError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The run that the cloth's start is from.
    #[error("{0}")]
    Start(String),
    /// The topology file.
    #[error(transparent)]
    Topology(#[from] TopologyError),
    /// The schedule cannot be made for this topology.
    #[error("--schedule: {0}")]
    Schedule(#[from] ScheduleError),
    /// There are no links to emulate.
    #[error("--emulate-links needs the links of a machine: --topology FILE")]
    NoLinks,
    /// A number out of range.
    #[error("--workers {workers}: {what}")]
    Workers { workers: usize, what: String },
    /// More steps than can be counted.
    #[error("{frames} frames of {steps_per_frame} steps each are too many: at most {} steps are possible", u32::MAX - 1)]
    Steps { frames: u32, steps_per_frame: u32 },
}

/// A level of a scene on the ranks of a session, checked and ready to run.
pub struct RunPlan {
    /// The scene.
    pub scene: Scene,
    /// Report of the untangling of the start state, if it was requested and needed.
    pub untangled: Option<Untangling>,
    /// A sentence about the run that the cloth's start is from, if it is from one.
    pub started: Option<String>,
    /// Byte limit of the collision tables of a worker: the requested one, or the memory of a GPU of the topology file
    /// without the solver's. None: no limit.
    pub table_bytes: Option<u64>,
    /// Exchange mode of SpMV.
    pub exchange: ExchangeMode,
    /// Rows and ranks.
    pub partition: RowPartition,
    /// Work queues and how they were chosen.
    pub transfers: Plan,
    /// Name of the topology, for the report.
    pub topology: String,
    /// The machine whose links are emulated.
    pub emulated: Option<Topology>,
    /// What changes while the run goes on ([`super::run`]); none: nothing.
    pub steering: Option<Box<Steering>>,
}

impl PlanError {
    /// The same error of a scene with the fields of `--set`, which names the flag instead of a line that the file
    /// does not have.
    pub fn blaming_set(self, scene_path: &Path, options: &RunOptions) -> PlanError {
        let PlanError::Scene(error) = self else { return self };
        let attempt = |set: &[String]| {
            let text = scene_text(scene_path, set).ok()?;
            let overrides = Overrides { resolution: options.resolution, frames: options.frames };
            match read_str(&text, scene_path) {
                Ok(parsed) => parsed.at(&overrides).err(),
                Err(error) => Some(error),
            }
        };
        PlanError::Scene(blame(error, &options.set, attempt))
    }
}

impl RunPlan {
    /// Reads and checks everything.
    pub fn new(scene_path: &Path, options: &RunOptions) -> Result<RunPlan, PlanError> {
        if !options.set.is_empty() {
            let made = RunPlan::of_text(&scene_text(scene_path, &options.set)?, scene_path, options);
            return made.map_err(|error| error.blaming_set(scene_path, options));
        }
        RunPlan::of_parsed(&read(scene_path)?, options, None)
    }

    /// As [`RunPlan::new`], for a text that was the file `scene_path`, which need not exist any more.
    pub fn of_text(text: &str, scene_path: &Path, options: &RunOptions) -> Result<RunPlan, PlanError> {
        RunPlan::of_parsed(&read_str(text, scene_path)?, options, None)
    }

    /// As [`RunPlan::new`], for a scene that was read. `kept`: the file with the start that a run has taken from
    /// another one, when it is resumed.
    pub fn of_parsed(parsed: &ParsedScene, options: &RunOptions, kept: Option<&Path>) -> Result<RunPlan, PlanError> {
        let overrides = Overrides { resolution: options.resolution, frames: options.frames };
        let (scene, untangled, started) = match (&options.start_from, kept) {
            (Some(_), Some(file)) => {
                let scene = parsed.unchecked_at(&overrides)?;
                let given = kept_start(file, scene.origin_m).map_err(PlanError::Start)?;
                let fits = given.positions.len() == scene.mesh.positions.len();
                if !fits {
                    let what = format!("{} belongs to another scene or resolution", file.display());
                    return Err(PlanError::Start(what));
                }
                // It was untangled when it was kept.
                (parsed.started_at(&overrides, &given, false)?.0, None, None)
            }
            (Some(from), None) => {
                let (given, line) = from.find(parsed, &overrides).map_err(PlanError::Start)?;
                let (scene, untangled) = parsed.started_at(&overrides, &given, options.untangle)?;
                (scene, untangled, Some(line))
            }
            (None, _) if options.untangle => {
                let (scene, untangled) = parsed.untangled_at(&overrides)?;
                (scene, untangled, None)
            }
            (None, _) => (parsed.at(&overrides)?, None, None),
        };
        let steering = match parsed.changes().is_empty() {
            true => None,
            false => Some(Box::new(Steering::new(parsed, &overrides)?)),
        };
        if let Some(steering) = &steering {
            steering.check(&scene).map_err(|what| SceneError::File { path: parsed.path().into(), what })?;
        }
        Ok(RunPlan { untangled, started, steering, ..RunPlan::of_scene(scene, options)? })
    }

    /// The same run with another scene, whose settings come from that of this plan.
    ///
    /// # Errors
    /// Those of [`RunPlan::of_scene`].
    pub fn with_scene(&self, scene: Scene, options: &RunOptions) -> Result<RunPlan, PlanError> {
        if scene.mesh.positions.len() != self.scene.mesh.positions.len() {
            return RunPlan::of_scene(scene, options);
        }
        let (transfers, topology, emulated) = (self.transfers.clone(), self.topology.clone(), self.emulated.clone());
        let (untangled, started, steering) = (self.untangled, None, None);
        let RunPlan { table_bytes, exchange, partition, .. } = *self;
        Ok(RunPlan {
            scene,
            untangled,
            started,
            table_bytes,
            exchange,
            partition,
            transfers,
            topology,
            emulated,
            steering,
        })
    }

    /// As [`RunPlan::new`], for a scene that was read before.
    pub fn of_scene(mut scene: Scene, options: &RunOptions) -> Result<RunPlan, PlanError> {
        scene.settings.preconditioner = options.preconditioner.unwrap_or(scene.settings.preconditioner);
        scene.settings.substeps = options.substeps.unwrap_or(scene.settings.substeps);
        let rows = scene.mesh.positions.len();
        let workers = options.workers;
        check_workers(workers, rows, &format!("the cloth has only {rows} vertices"))?;
        let (frames, steps_per_frame) = (scene.settings.frames, scene.settings.steps_per_frame);
        // The last number stays unused, so that counting past the last step cannot overflow.
        if frames.checked_mul(steps_per_frame).is_none_or(|steps| steps == u32::MAX) {
            return Err(PlanError::Steps { frames, steps_per_frame });
        }
        let partition = RowPartition::new(rows, workers);
        let file = options.topology.as_deref();
        let (transfers, mut topology) = plan_transfers(file, options.schedule, workers, partition.sub_vector_rows())?;
        // Memory of a GPU of the file without the solver's.
        let solver_bytes = SOLVER_BYTES_PER_ROW * partition.sub_vector_rows() as f64;
        let memory = |topology: Topology| topology.device().memory_gb * 1e9;
        let table_bytes = match file {
            None => None,
            Some(_) => {
                Some(memory(read_topology(file, workers)?)).map(|all| (all - solver_bytes).max(0.25 * all) as u64)
            }
        };
        let emulated = match (options.emulate_links, file) {
            (false, _) => None,
            (true, None) => return Err(PlanError::NoLinks),
            (true, Some(_)) => Some(read_topology(file, workers)?),
        };
        if emulated.is_some() {
            topology += " (links emulated)";
        }
        let (table_bytes, exchange) = (options.memory_limit_bytes.or(table_bytes), options.exchange);
        let stages = transfers.schedule.queues.iter().map(Vec::len).max().unwrap_or(0);
        tracing::debug!(
            "plan: {rows} rows on {workers} ranks, schedule {} of {stages} stages on {topology}, exchange {exchange:?}",
            transfers.kind.name()
        );
        let (untangled, started, steering) = (None, None, None);
        Ok(RunPlan {
            scene,
            untangled,
            started,
            table_bytes,
            exchange,
            partition,
            transfers,
            topology,
            emulated,
            steering,
        })
    }

    /// The model in global order.
    pub fn model(&self) -> GlobalModel {
        GlobalModel::new(&self.scene)
    }

    /// Longest message between ranks: positions and velocities of a whole row block. None with a single rank.
    pub fn message_values(&self) -> usize {
        let stamp = if self.emulated.is_some() { STAMP_VALUES } else { 0 };
        if self.partition.ranks() == 1 { 0 } else { self.partition.sub_vector_rows() * 2 * DIM + stamp }
    }

    /// The emulated links of every rank; none without emulation.
    pub fn links(&self, model: &GlobalModel) -> Option<Vec<RankLinks>> {
        let topology = self.emulated.as_ref()?;
        let sub_vector_bytes = self.partition.sub_vector_rows() as f64 * ROW_BYTES;
        Some(RankLinks::of(topology, &self.transfers, sub_vector_bytes, &halo_traffic(model, &self.partition)))
    }
}

/// The text of a scene file with the fields of `--set`.
///
/// # Errors
/// The file cannot be read, is no TOML, or has no place for a field.
pub fn scene_text(path: &Path, set: &[String]) -> Result<String, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    let text = std::fs::read_to_string(path).map_err(|error| fault(format!("cannot be read: {error}")))?;
    if !set.is_empty() && path.extension().is_none_or(|extension| !extension.eq_ignore_ascii_case("toml")) {
        return Err(fault("--set is for scenes in TOML".into()));
    }
    set_fields(&text, set).map_err(fault)
}

/// Refuses a number of workers that is out of range or exceeds the number of rows. `few` is the text before the
/// semicolon.
pub fn check_workers(workers: usize, rows: usize, few: &str) -> Result<(), PlanError> {
    if workers == 0 || workers > RANKS_MAX {
        return Err(PlanError::Workers { workers, what: format!("expected 1 to {RANKS_MAX}") });
    }
    if workers > rows {
        return Err(PlanError::Workers { workers, what: format!("{few}; use at most as many workers") });
    }
    if rows < usize::MAX && workers > most_ranks(rows) {
        let most = most_ranks(rows);
        let what = format!("{few}, which make {most} chunks, the least that a worker owns; use at most {most} workers");
        return Err(PlanError::Workers { workers, what });
    }
    Ok(())
}

const ROW_BYTES: f64 = 12.0;

/// Number of halo rows of one vector that the ranks of a cloth without contacts read of each other.
pub fn halo_traffic(model: &GlobalModel, partition: &RowPartition) -> Traffic {
    let plans = RankModel::halo_plans(model, partition);
    let bytes = |rows: usize| rows as f64 * ROW_BYTES;
    Traffic {
        published: plans.iter().map(|plan| bytes(plan.publish_rows.len())).collect(),
        received: (0..plans.len())
            .map(|owner| plans.iter().map(|plan| bytes(plan.sources[owner].rows())).collect())
            .collect(),
    }
}

/// Work queues for `workers` ranks: on the first GPUs of a topology file, or without one on a balanced binary tree.
pub fn plan_transfers(
    file: Option<&Path>,
    kind: ScheduleKind,
    workers: usize,
    sub_vector_rows: usize,
) -> Result<(Plan, String), PlanError> {
    let topology = read_topology(file, workers)?;
    let name = file.map_or_else(|| topology.name().to_string(), |path| path.display().to_string());
    Ok((plan(kind, &topology, sub_vector_rows as f64 * ROW_BYTES)?, name))
}

fn read_topology(file: Option<&Path>, workers: usize) -> Result<Topology, PlanError> {
    let Some(path) = file else { return Ok(Topology::default_for(workers)?) };
    let whole = Topology::read(path)?;
    if workers > whole.gpus() {
        let what = format!("{} has only {} GPUs", path.display(), whole.gpus());
        return Err(PlanError::Workers { workers, what });
    }
    Ok(whole.with_first_gpus(workers)?)
}
