//! The inputs of a shot that is split in time: the level of the shot, its coarse level, and the way between both.

use std::num::NonZeroU32;
use std::path::Path;

use thiserror::Error;

use super::options::{KeepStates, RunOptions};
use super::plan::{PlanError, RunPlan};
use super::time_options::{PartitionRule, Recovery, TimeOptions};
use crate::mesh::{Group, GroupKind, Refinement, crossings};
use crate::model::State;
use crate::output::StepRecord;
use crate::scene::{Obstacles, Overrides, ParsedScene, Scene, read_str};
use crate::time_parallel::{Costs, Method, Partition, Upsampling, partition};

/// Longest step that the program chooses for a coarse run, seconds: contacts hold at it in all shipped scenes.
const COARSE_STEP_MOST_S: f64 = 0.005;
/// Most seconds of a hand-over unless the user says otherwise.
const HANDOVER_MOST_S: f64 = 0.5;

/// Error that refuses to split a shot.
#[derive(Debug, Error)]
pub enum TimeError {
    /// One of the levels.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// The options do not fit the scene.
    #[error("{0}")]
    Unfit(String),
}

/// A shot with its coarse level.
pub struct TimePlan {
    /// The level of the shot, which is that of an ordinary run.
    pub fine: RunPlan,
    /// The coarse level, with longer steps and as many frames.
    pub coarse: RunPlan,
    /// From states of the coarse level to those of the fine one.
    pub up: Upsampling,
    /// Fine steps in a coarse one.
    pub step_ratio: u32,
    /// How the coarse run is split in time itself, if it is: its level of the shot is the coarse one here.
    pub upper: Option<Box<TimePlan>>,
    /// The options.
    pub options: TimeOptions,
}

/// The options of a coarse run that is split in time itself: the next level needs the states of all its steps.
pub(super) fn options_of_coarse(options: &RunOptions) -> RunOptions {
    let time = TimeOptions {
        levels: options.time.levels - 1,
        coarse_steps: None,
        sweeps: 0,
        start_states: None,
        cuts: Vec::new(),
        ..options.time.clone()
    };
    RunOptions { keep_states: Some(KeepStates::Every(NonZeroU32::MIN)), time, ..options.clone() }
}

impl TimePlan {
    /// Reads and checks everything. `text`: the scene, which was the file `scene_path`.
    ///
    /// # Errors
    /// One of the levels, or a scene without a coarse level.
    pub fn new(text: &str, scene_path: &Path, options: &RunOptions) -> Result<TimePlan, TimeError> {
        if options.untangle {
            return Err(TimeError::Unfit(
                "--untangle and --segments do not go together: the coarse level would start crossed".into(),
            ));
        }
        if options.start_from.is_some() {
            return Err(TimeError::Unfit(
                "--start-from and --segments do not go together: the coarse level starts from the scene".into(),
            ));
        }
        if options.topology.is_some() {
            return Err(TimeError::Unfit(
                "--topology and --segments do not go together: sessions have their links in common".into(),
            ));
        }
        let parsed = read_str(text, scene_path).map_err(PlanError::from)?;
        let wanted = Overrides { resolution: options.resolution, frames: options.frames };
        let fine = parsed.at(&wanted).map_err(PlanError::from)?;
        TimePlan::under(&parsed, &wanted, (fine, Vec::new()), 0, options)
    }

    /// The plan whose level of the shot is `level`: a scene that is `coarsenings` levels coarser than the finest, with
    /// the way from it to the finest; none for the finest itself.
    fn under(
        parsed: &ParsedScene,
        wanted: &Overrides,
        level: (Scene, Vec<Refinement>),
        coarsenings: usize,
        options: &RunOptions,
    ) -> Result<TimePlan, TimeError> {
        let time = &options.time;
        let (scene, to_finest) = level;
        let fine = RunPlan::of_scene(scene, options)?;
        let coarser = coarsenings + time.coarse.ilog2() as usize;
        let (mut scene, refinements) = parsed.coarser_at(wanted, coarser).map_err(PlanError::from)?;
        let between: Vec<Refinement> = match to_finest.is_empty() {
            true => refinements.clone(),
            false => refinements.iter().zip(&to_finest).map(|(all, lower)| all.down_to(lower)).collect(),
        };
        if between.iter().all(Refinement::is_none) {
            return Err(TimeError::Unfit(format!(
                "--segments needs a coarse level: sheets of irregular triangles have one, and meshes that divide the \
                 triangles of a coarser one into {} (docs/scene.md, `subdivide`)",
                1 << (2 * coarser)
            )));
        }
        let step_ratio = step_ratio(&fine.scene, time)?;
        scene.settings.step_s = fine.scene.settings.step_s * f64::from(step_ratio);
        scene.settings.steps_per_frame = fine.scene.settings.steps_per_frame / step_ratio;
        let up = Upsampling::new(&scene, &fine.scene, &between);
        let upper = if time.levels > 2 {
            let level = (scene.clone(), refinements);
            Some(Box::new(TimePlan::under(parsed, wanted, level, coarser, &options_of_coarse(options))?))
        } else {
            None
        };
        let coarse = RunPlan::of_scene(scene, options)?;
        Ok(TimePlan { fine, coarse, up, step_ratio, upper, options: time.clone() })
    }

    /// Steps of the shot.
    pub fn steps(&self) -> u32 {
        self.fine.scene.settings.frames * self.fine.scene.settings.steps_per_frame
    }

    /// Most steps of a hand-over.
    pub fn handover_most(&self) -> u32 {
        let of_time = (HANDOVER_MOST_S / self.fine.scene.settings.step_s).round() as u32;
        self.options.handover_steps.unwrap_or(of_time).max(1)
    }

    /// States after a cut that a segment keeps for the hand-over: those of its steps, of some late ones, and the next.
    pub fn handover_kept(&self) -> u32 {
        self.handover_most() + self.handover_most() / 5 + 3
    }

    /// Steps of the recovery of the segment from `start`: whole coarse steps, as far as there are any.
    pub fn recovery_of(&self, start: u32) -> u32 {
        match self.options.recovery {
            _ if self.options.start_states.is_some() => 0,
            Recovery::None | Recovery::Paper => 0,
            Recovery::WarmUp => (self.options.recovery_steps.div_ceil(self.step_ratio) * self.step_ratio).min(start),
        }
    }

    /// Whether detail is recovered at the cut `start` itself.
    pub fn iterates(&self, start: u32) -> bool {
        start > 0 && self.options.recovery == Recovery::Paper && self.options.start_states.is_none()
    }

    /// Steps that the recovery before a late cut costs at most.
    pub fn recovery_most(&self) -> u32 {
        if self.iterates(u32::MAX) { self.options.recovery_steps } else { self.recovery_of(u32::MAX) }
    }

    /// Fine over coarse work that is expected before anything is measured: rows times steps times iterations, which
    /// grow with the number of cells along the cloth.
    pub fn expected_ratio(&self) -> f64 {
        f64::from(self.options.coarse).powi(2) * f64::from(self.step_ratio)
    }

    /// First steps of the segments, all at the ends of coarse steps. `work`: [`Counts::work`] of every coarse step, as
    /// far as the rule asks for it.
    pub fn cuts(&self, work: &[f64]) -> Vec<u32> {
        let (steps, segments, stride) = (u64::from(self.steps()), self.options.segments as usize, self.step_ratio);
        let on_coarse_steps = |starts: Vec<u64>| {
            let mut starts: Vec<u32> = starts.into_iter().map(|start| start as u32 / stride * stride).collect();
            starts.dedup();
            starts
        };
        match self.options.partition {
            PartitionRule::Uniform => on_coarse_steps(partition::uniform(steps, segments)),
            PartitionRule::Static => {
                on_coarse_steps(partition::balanced_for_ratio(steps, segments, self.expected_ratio()))
            }
            PartitionRule::Counted => {
                let of_fine = work.iter().flat_map(|&work| (0..stride).map(move |_| work / f64::from(stride)));
                let coarse: Vec<f64> = of_fine.take(steps as usize).collect();
                let fine = coarse.iter().map(|work| work * self.expected_ratio()).collect();
                let costs = Costs { fine, coarse: vec![coarse], stride: u64::from(stride) };
                let method = Method {
                    partition: Partition::Profile,
                    recovery_steps: u64::from(self.recovery_most()),
                    handover_steps: 0,
                    coarse_state_s: 0.0,
                    fine_state_s: 0.0,
                    coarse_to_end: true,
                };
                on_coarse_steps(costs.play(segments, &method).starts)
            }
        }
    }

    /// The state of the shot on the surface of the coarse state of fine step `step`.
    ///
    /// # Errors
    /// A sentence: rounding has made triangles touch.
    pub fn upsampled(&self, coarse: &State, step: u32) -> Result<State, String> {
        let state = self.up.state(coarse);
        match self.first_crossing(&state, step) {
            None => Ok(state),
            Some([s, t]) => Err(format!(
                "the coarse state of step {step} touches itself when it is refined (triangles {s} and {t}); another \
                 number of --segments or another --coarse cuts elsewhere"
            )),
        }
    }

    /// The first two triangles of a state of the shot after `step` that meet, if the scene has collisions and nothing
    /// is let go.
    pub(super) fn first_crossing(&self, state: &State, step: u32) -> Option<[u32; 2]> {
        let scene = &self.fine.scene;
        if !scene.settings.collisions || !state.let_go.is_empty() {
            return None;
        }
        let (positions, triangles, groups) = surface(scene, state, step);
        crossings(&positions, &triangles, &groups).first().copied()
    }
}

/// Cloth and obstacles of a state as one surface.
pub(super) fn surface(scene: &Scene, state: &State, step: u32) -> (Vec<crate::math::Vec3>, Vec<[u32; 3]>, Vec<Group>) {
    let (mut positions, mut triangles) = (state.positions.clone(), scene.mesh.triangles.clone());
    let cloth = |range: std::ops::Range<u32>| Group {
        triangles: range.start as usize..range.end as usize,
        kind: GroupKind::Cloth,
    };
    let mut groups: Vec<Group> = scene.cloths.iter().map(|piece| cloth(piece.triangles.clone())).collect();
    let obstacles = Obstacles::new(&scene.obstacles);
    let mut values = Vec::new();
    obstacles.positions_at(f64::from(step) * scene.settings.step_s, &mut values);
    let first = positions.len() as u32;
    positions.extend_from_slice(bytemuck::cast_slice(&values));
    let mut next = triangles.len();
    triangles.extend(obstacles.triangles().iter().map(|corners| corners.map(|v| v + first)));
    for obstacle in &scene.obstacles {
        let triangles = next..next + obstacle.triangles.len();
        next = triangles.end;
        groups.push(Group { triangles, kind: GroupKind::Obstacle });
    }
    (positions, triangles, groups)
}

/// Fine steps in a coarse one: those asked for, or the most that divide a frame and are not too long together.
fn step_ratio(fine: &Scene, time: &TimeOptions) -> Result<u32, TimeError> {
    let (per_frame, step_s) = (fine.settings.steps_per_frame, fine.settings.step_s);
    match time.coarse_steps {
        Some(ratio) if per_frame.is_multiple_of(ratio) => Ok(ratio),
        Some(ratio) => Err(TimeError::Unfit(format!(
            "--coarse-steps {ratio}: a frame has {per_frame} steps, which is no multiple of it"
        ))),
        None => {
            let fits = |&ratio: &u32| {
                per_frame.is_multiple_of(ratio) && f64::from(ratio) * step_s <= COARSE_STEP_MOST_S * (1.0 + 1e-9)
            };
            Ok((1..=per_frame).rev().find(fits).unwrap_or(1))
        }
    }
}

/// Counts of a step that its cost depends on. They are the same in every run of a scene.
#[derive(Clone, Copy, Debug)]
pub struct Counts {
    /// Rows of the system.
    pub rows: usize,
    /// Sub-steps and halvings.
    pub parts: u32,
    /// Iterations of all solves.
    pub iterations: u32,
    /// Tests of pairs of triangles.
    pub tests: u64,
    /// Iterations of impact zones.
    pub zone_iterations: u64,
}

impl Counts {
    /// Those of a recorded step.
    pub fn of(record: &StepRecord, rows: usize) -> Counts {
        Counts {
            rows,
            parts: record.substeps + record.zones.halvings,
            iterations: record.iterations,
            tests: record.proximity.total.tests + record.continuous.total.tests,
            zone_iterations: record.zones.iterations,
        }
    }

    /// Work in units of one row in one iteration. The weights are rounded from profiles on native code: elements,
    /// matrix and preconditioner of a part cost a row about 20 iterations, a pair of triangles costs about 2 rows, an
    /// iteration of a zone about 20.
    pub fn work(&self) -> f64 {
        let solves = f64::from(self.iterations) + 20.0 * f64::from(self.parts);
        self.rows as f64 * solves + 2.0 * self.tests as f64 + 20.0 * self.zone_iterations as f64
    }
}
