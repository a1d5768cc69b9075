//! Stages of a run: panels that are sewn, then the sewn cloth. Each has a mesh of its own and is a level of the same
//! session; the change is made at the first frame at which the seams have closed and the way of their vertices to each
//! other is free.

use std::sync::{Arc, Mutex};

use super::options::RunOptions;
use super::plan::{PlanError, RunPlan};
use super::shot::{Segment, Source};
use super::time_plan::surface;
use crate::collision::{LeftOut, StraightWay};
use crate::math::Vec3;
use crate::mesh::{Group, GroupKind, crossings};
use crate::model::{Sewn, State};
use crate::output::SeamGap;
use crate::scene::{Obstacles, Scene};

/// Share of the way to each other that vertices go first, all pairs of features being proven apart on it; on the rest
/// features that get a common vertex are not looked at.
const FIRST_SHARE: f32 = 15.0 / 16.0;

/// The stages of a run.
pub(super) struct Stages {
    /// The level of every stage.
    pub plans: Vec<RunPlan>,
    /// From the first to the second.
    sewn: Option<Sewn>,
}

/// What became of an attempt to sew.
pub(super) enum Attempt {
    /// The state of the sewn cloth.
    Sewn(Box<State>),
    /// The seams are open.
    Open,
    /// The seams are closed, but the way to each other is not free.
    Blocked,
}

impl Stages {
    /// The stages that begin with `plan`.
    ///
    /// # Errors
    /// Those of a level.
    pub(super) fn new(plan: RunPlan, options: &RunOptions) -> Result<Stages, PlanError> {
        let mut stages = Stages { sewn: None, plans: vec![plan] };
        if let Some((scene, sewn)) = Sewn::of(&stages.plans[0].scene) {
            stages.plans.push(RunPlan::of_scene(scene, options)?);
            stages.sewn = Some(sewn);
        }
        Ok(stages)
    }

    /// Where a run goes on that has come to `state` (none: the start) of `stage` after `step`.
    ///
    /// # Errors
    /// A sentence, if detection fails.
    pub(super) fn begin(&self, stage: usize, step: u32, last_step: u32, state: Option<State>) -> Result<Begin, String> {
        let scene = &self.plans[stage].scene;
        if stage == 0 && self.sewn.is_some() && step.is_multiple_of(scene.settings.steps_per_frame) && step < last_step
        {
            let start;
            let state = match &state {
                Some(state) => state,
                None => {
                    start = State::start_of(scene);
                    &start
                }
            };
            if let Attempt::Sewn(sewn) = self.attempt(state, step)? {
                return Ok((1, step, Some(Arc::new(*sewn))));
            }
        }
        Ok((stage, step, state.map(Arc::new)))
    }

    /// How far the seams of a state of the first stage are open; none without seams.
    pub(super) fn gap(&self, stage: usize, state: &State) -> Option<SeamGap> {
        let sewn = self.sewn.as_ref().filter(|_| stage == 0)?;
        let (widest_m, ends) = sewn.ends(&state.positions);
        Some(SeamGap { widest_m, open: sewn.open(&state.positions, &ends) })
    }

    /// Sews a state of the first stage after `step`, if its seams are closed.
    ///
    /// # Errors
    /// A sentence, if detection fails.
    pub(super) fn attempt(&self, state: &State, step: u32) -> Result<Attempt, String> {
        let Some(sewn) = &self.sewn else { return Ok(Attempt::Open) };
        let (widest_m, ends) = sewn.ends(&state.positions);
        if widest_m > sewn.weld_m() {
            return Ok(Attempt::Open);
        }
        let [panels, cloth] = [&self.plans[0].scene, &self.plans[1].scene];
        if panels.settings.collisions && !is_free(panels, sewn, state, &ends, step)? {
            return Ok(Attempt::Blocked);
        }
        let state = sewn.state(state, &ends);
        if panels.settings.collisions && crosses(cloth, &state, step) {
            return Ok(Attempt::Blocked);
        }
        Ok(Attempt::Sewn(Box::new(state)))
    }
}

/// Whether the vertices of `state` can go to `ends` without touching anything else.
fn is_free(panels: &Scene, sewn: &Sewn, state: &State, ends: &[Vec3], step: u32) -> Result<bool, String> {
    let (positions, triangles, _) = surface(panels, state, step);
    let cloth = state.positions.len();
    let ranges = Obstacles::new(&panels.obstacles).ranges();
    let vertices = |obstacle: u32| {
        let [vertices, _] = &ranges[obstacle as usize];
        (cloth + vertices.start) as u32..(cloth + vertices.end) as u32
    };
    let left_out = |one: &crate::model::LetGo| LeftOut { vertex: one.vertex, obstacle: vertices(one.obstacle) };
    let left_out = state.let_go.iter().map(left_out).collect();
    let way = StraightWay { triangles: &triangles, cloth_vertices: cloth, left_out };
    let mut near = positions.clone();
    let mut there = positions.clone();
    for (v, &end) in ends.iter().enumerate() {
        near[v] = positions[v].lerp(end, FIRST_SHARE);
        there[v] = end;
        // A vertex that stays keeps its bits.
        if end == positions[v] {
            near[v] = end;
        }
    }
    let flat = |points: &[Vec3]| bytemuck::cast_slice::<Vec3, f32>(points).to_vec();
    if !way.touching(&flat(&positions), &flat(&near))?.is_empty() {
        return Ok(false);
    }
    let last = way.touching(&flat(&near), &flat(&there))?;
    let is_shared = |impact: &crate::collision::Impact| {
        let candidate = impact.candidate;
        let (one, other) = candidate.vertices.split_at(if candidate.is_vertex_face() { 1 } else { 2 });
        let of_cloth = |vertices: &[u32]| vertices.iter().all(|&v| (v as usize) < cloth);
        of_cloth(one) && of_cloth(other) && sewn.joins(one, other)
    };
    Ok(last.iter().all(is_shared))
}

/// Whether the sewn cloth crosses itself or an obstacle that it has not let go.
fn crosses(cloth: &Scene, state: &State, step: u32) -> bool {
    let (positions, triangles, groups) = surface(cloth, state, step);
    let of_cloth = cloth.mesh.triangles.len();
    let whole = Group { triangles: 0..of_cloth, kind: GroupKind::Cloth };
    let obstacles: Vec<Group> = groups.into_iter().filter(|group| group.triangles.start >= of_cloth).collect();
    let groups: Vec<Group> = std::iter::once(whole).chain(obstacles).collect();
    let is_let_go = |t: u32| {
        let lets = |one: &crate::model::LetGo| triangles[t as usize].contains(&one.vertex);
        (t as usize) < of_cloth && state.let_go.iter().any(lets)
    };
    crossings(&positions, &triangles, &groups).iter().any(|&[s, t]| {
        let with_obstacle = t as usize >= of_cloth;
        !(with_obstacle && is_let_go(s))
    })
}

/// A stage that begins: its number, its first step and its state there.
pub(super) type Begin = (usize, u32, Option<Arc<State>>);

/// The stages of a run one after another, as segments of one session.
pub(super) struct StageSource<'a> {
    stages: &'a Stages,
    last_step: u32,
    trace_until: u32,
    wants_state: Arc<dyn Fn(u32) -> bool + Send + Sync + 'a>,
    next: Arc<Mutex<Option<Begin>>>,
}

impl<'a> StageSource<'a> {
    /// Begins with `begin`; a stage goes on to `last_step` or until it is sewn.
    pub(super) fn new(
        stages: &'a Stages,
        begin: Begin,
        last_step: u32,
        trace_steps: u32,
        wants_state: Arc<dyn Fn(u32) -> bool + Send + Sync + 'a>,
    ) -> StageSource<'a> {
        let trace_until = begin.1.saturating_add(trace_steps);
        StageSource { stages, last_step, trace_until, wants_state, next: Arc::new(Mutex::new(Some(begin))) }
    }
}

impl<'a> Source<'a> for StageSource<'a> {
    fn next(&self, _session: usize, _halt: &std::sync::atomic::AtomicBool) -> Option<(usize, Segment<'a>)> {
        let (stage, first_step, start) = self.next.lock().ok()?.take()?;
        let level: &'a RunPlan = &self.stages.plans[stage];
        let mut segment = Segment {
            start,
            first_step,
            trace_steps: self.trace_until.saturating_sub(first_step),
            wants_state: Arc::clone(&self.wants_state),
            ..Segment::plain(level, self.last_step)
        };
        if stage + 1 < self.stages.plans.len() {
            let (stages, next, last_step) = (self.stages, Arc::clone(&self.next), self.last_step);
            let per_frame = level.scene.settings.steps_per_frame;
            segment.ends_at = Some(Arc::new(move |step: u32, state: &State| {
                if !step.is_multiple_of(per_frame) || step >= last_step {
                    return Ok(false);
                }
                let Attempt::Sewn(state) = stages.attempt(state, step)? else { return Ok(false) };
                *next.lock().map_err(|error| error.to_string())? = Some((stage + 1, step, Some(Arc::new(*state))));
                Ok(true)
            }));
        }
        Some((stage, segment))
    }
}
