//! Stages of a run: panels that are sewn, then the sewn cloth; in a run that is changed while it goes on, one more
//! with every change. Each is a level of the same session. The change to sewn cloth is made at the first frame at which
//! the seams have closed and the way of their vertices to each other is free.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use super::live::merged;
use super::open_seams::open_seams;
use super::options::RunOptions;
use super::plan::{PlanError, RunPlan};
use super::welding::{Welded, welded};
use crate::model::{Cut, Sewn, State};
use crate::output::{Checkpoint, OpenSeam, SeamGap, Straightened, scene_fingerprint};
use crate::scene::{Change, Edit, Handles, RESOLUTIONS, SeamEnd};

/// A stage of a run.
pub(super) struct Stage {
    /// Number of its segment.
    pub number: usize,
    /// Number of its mesh among those of the run, from 0.
    pub mesh: usize,
    /// Its level.
    pub plan: Arc<RunPlan>,
    /// [`scene_fingerprint`].
    pub fingerprint: u64,
    /// How it came about, as the start of a sentence about a stage with another mesh.
    pub origin: &'static str,
    /// What changes name; nothing in a run that cannot be changed.
    pub handles: Handles,
    /// What was straightened when seams were welded into it.
    pub straightened: Option<Straightened>,
    /// The cloth that its seams make; none without seams.
    sewn: Option<Box<SewnCloth>>,
}

/// The stage after the seams of a stage are closed.
struct SewnCloth {
    way: Sewn,
    plan: Arc<RunPlan>,
    fingerprint: u64,
    handles: Handles,
}

/// The stages of a run.
pub(super) struct Stages {
    options: RunOptions,
    first: Arc<Stage>,
    /// Changes that are known when the run begins.
    changes: Vec<Change>,
    /// Those that somebody may still ask for, by number.
    known: Mutex<BTreeMap<usize, Arc<Stage>>>,
    next_number: AtomicUsize,
}

/// What a change makes.
pub(super) struct Changed {
    pub stage: Arc<Stage>,
    pub state: Option<Arc<State>>,
    /// Lengths with which the threads of all seams begin anew, meters; none if they do not.
    pub gaps_m: Option<Vec<f32>>,
}

/// What became of an attempt to sew.
pub(super) enum Attempt {
    /// The sewn cloth and its state.
    Sewn(Arc<Stage>, Box<State>),
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
        let steering = plan.steering.as_deref();
        let changes = steering.map_or(Vec::new(), |steering| merged(&steering.of_scene, &steering.recorded));
        let handles = steering.map_or(Handles::default(), |steering| steering.handles.clone());
        let next_number = AtomicUsize::new(1);
        let first = Arc::new(Stage::new(0, 0, plan, handles, "", options)?);
        let known = Mutex::new(BTreeMap::from([(0, Arc::clone(&first))]));
        Ok(Stages { options: options.clone(), first, changes, known, next_number })
    }

    /// The stage at the start.
    pub(super) fn first(&self) -> &Arc<Stage> {
        &self.first
    }

    /// The levels that are known before the run: the first one and what its seams make.
    pub(super) fn levels(&self) -> impl Iterator<Item = &RunPlan> {
        let sewn = self.first.sewn.iter().map(|sewn| &*sewn.plan);
        std::iter::once(&*self.first.plan).chain(sewn)
    }

    /// The stage of a segment. Those before it are then forgotten, because the news of segments come in order.
    pub(super) fn of_segment(&self, number: usize) -> Option<Arc<Stage>> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.retain(|&there, _| there >= number);
        known.get(&number).cloned()
    }

    /// Gives a stage its number.
    fn enter(&self, make: impl FnOnce(usize) -> Result<Stage, PlanError>) -> Result<Arc<Stage>, PlanError> {
        let number = self.next_number.fetch_add(1, Ordering::Relaxed);
        let stage = Arc::new(make(number)?);
        self.known.lock().unwrap_or_else(PoisonError::into_inner).insert(number, Arc::clone(&stage));
        Ok(stage)
    }

    /// What the seams of a stage make of it.
    fn sewn(&self, stage: &Stage, straightened: Option<Straightened>) -> Option<Arc<Stage>> {
        let sewn = stage.sewn.as_deref()?;
        let make = |number| {
            Ok(Stage {
                number,
                mesh: stage.mesh + 1,
                plan: Arc::clone(&sewn.plan),
                fingerprint: sewn.fingerprint,
                origin: "the seams are closed",
                handles: sewn.handles.clone(),
                straightened,
                sewn: None,
            })
        };
        self.enter(make).ok()
    }

    /// The stage that a checkpoint belongs to, by the changes that were made before it; none if it is of another run.
    pub(super) fn locate(&self, checkpoint: &Checkpoint) -> Option<Arc<Stage>> {
        let mut stage = Arc::clone(&self.first);
        for change in self.changes.iter().filter(|change| u64::from(change.step) < checkpoint.step) {
            stage = match change.edit {
                Edit::Welded => self.sewn(&stage, None)?,
                _ => self.changed(&stage, change, None).ok()?.stage,
            };
        }
        let fits = |stage: &Stage| {
            stage.fingerprint == checkpoint.fingerprint
                && stage.plan.scene.mesh.positions.len() == checkpoint.state.positions.len()
        };
        if fits(&stage) { Some(stage) } else { self.sewn(&stage, None).filter(|sewn| fits(sewn)) }
    }

    /// The stage that a change makes of another one, and the state there. Without a state it follows from what the
    /// record notes.
    ///
    /// # Errors
    /// A sentence.
    pub(super) fn changed(
        &self,
        stage: &Arc<Stage>,
        change: &Change,
        state: Option<Arc<State>>,
    ) -> Result<Changed, String> {
        let (mut scene, mut handles) = (stage.plan.scene.clone(), stage.handles.clone());
        let (mut mesh, mut state, mut origin) = (stage.mesh, state, stage.origin);
        let mut gaps_m = None;
        match &change.edit {
            Edit::Sew(seam) => {
                let added = scene.added_seam(&handles, seam)?;
                let cut = if added.cuts.is_empty() {
                    None
                } else {
                    let (after, cut) = Cut::of(&scene, &added.cuts);
                    handles.renumber(|v| cut.vertex(v), &[]);
                    (scene, mesh, origin) = (after, mesh + 1, "a side of a seam has more vertices");
                    state = state.map(|state| Arc::new(cut.state(&state)));
                    Some(cut)
                };
                let vertex = |end: SeamEnd| match (end, &cut) {
                    (SeamEnd::Vertex(v), Some(cut)) => cut.vertex(v),
                    (SeamEnd::Cut(number), Some(cut)) => cut.added(number),
                    (SeamEnd::Vertex(v), None) => v,
                    // Without cuts no end is one.
                    (SeamEnd::Cut(_), None) => 0,
                };
                let pairs = added.ends.iter().map(|ends| ends.map(vertex));
                let start_s = f64::from(change.step) * scene.settings.step_s;
                let positions = state.as_ref().map(|state| &state.positions[..]);
                scene.sew(seam, added.name.clone(), pairs, start_s, positions)?;
                gaps_m = scene.sewing.as_ref().and_then(|sewing| sewing.first_m.clone()).filter(|_| state.is_some());
            }
            Edit::Refine { times } => {
                if scene.sewing.is_some() {
                    return Err("seams are open: cloth can be divided when they are sewn or taken out".into());
                }
                let triangles = scene.mesh.triangles.len() << (2 * times);
                if triangles > *RESOLUTIONS.end() as usize {
                    return Err(format!("{triangles} triangles would be more than {}", RESOLUTIONS.end()));
                }
                let (after, way) =
                    Sewn::divided(&scene, *times).ok_or("the cloth cannot be divided: its mesh is not manifold")?;
                handles.renumber(|v| way.vertex(v), &way.halves());
                state = state.map(|state| Arc::new(way.state(&state, &state.positions)));
                (scene, mesh, origin) = (after, mesh + 1, "the triangles are divided");
            }
            edit => {
                if !scene.edit(&mut handles, edit)? {
                    return Err("only a run welds its seams".into());
                }
            }
        }
        let plan = stage.plan.with_scene(scene, &self.options).map_err(|error| error.to_string())?;
        let make = |number| Stage::new(number, mesh, plan, handles, origin, &self.options);
        let stage = self.enter(make).map_err(|error| error.to_string())?;
        Ok(Changed { stage, state, gaps_m })
    }

    /// Where a run goes on that has come to `state` (none: the start) of `stage` after `step`.
    ///
    /// # Errors
    /// A sentence, if detection fails.
    pub(super) fn begin(
        &self,
        stage: &Arc<Stage>,
        step: u32,
        last_step: u32,
        state: Option<State>,
    ) -> Result<Begin, String> {
        let scene = &stage.plan.scene;
        if stage.sewn.is_some() && step.is_multiple_of(scene.settings.steps_per_frame) && step < last_step {
            let start;
            let state = match &state {
                Some(state) => state,
                None => {
                    start = State::start_of(scene);
                    &start
                }
            };
            if let Attempt::Sewn(stage, sewn) = self.attempt(stage, state, step)? {
                return Ok((stage, step, Some(Arc::new(*sewn))));
            }
        }
        Ok((Arc::clone(stage), step, state.map(Arc::new)))
    }

    /// Sews a state of a stage after `step`, if its seams are closed.
    ///
    /// # Errors
    /// A sentence, if detection fails.
    pub(super) fn attempt(&self, stage: &Stage, state: &State, step: u32) -> Result<Attempt, String> {
        let Some(SewnCloth { way: sewn, plan, .. }) = stage.sewn.as_deref() else { return Ok(Attempt::Open) };
        let (state, straightened) = match welded(&stage.plan.scene, &plan.scene, sewn, state, step)? {
            Welded::Done(state, straightened) => (state, straightened),
            Welded::Open => return Ok(Attempt::Open),
            Welded::Blocked => return Ok(Attempt::Blocked),
        };
        Ok(self.sewn(stage, straightened).map_or(Attempt::Open, |stage| Attempt::Sewn(stage, Box::new(state))))
    }
}

impl Stage {
    fn new(
        number: usize,
        mesh: usize,
        plan: RunPlan,
        handles: Handles,
        origin: &'static str,
        options: &RunOptions,
    ) -> Result<Stage, PlanError> {
        let sewn = match Sewn::of(&plan.scene) {
            None => None,
            Some((scene, way)) => {
                let plan = RunPlan::of_scene(scene, options)?;
                let handles = if plan.steering.is_some() || !handles.cloths.is_empty() {
                    let mut handles = handles.clone();
                    handles.renumber(|v| way.vertex(v), &way.halves());
                    handles
                } else {
                    Handles::default()
                };
                let fingerprint = scene_fingerprint(&plan.scene);
                Some(Box::new(SewnCloth { way, plan: Arc::new(plan), fingerprint, handles }))
            }
        };
        let fingerprint = scene_fingerprint(&plan.scene);
        Ok(Stage { number, mesh, plan: Arc::new(plan), fingerprint, origin, handles, straightened: None, sewn })
    }

    /// Whether seams are still to be sewn.
    pub(super) fn has_seams(&self) -> bool {
        self.sewn.is_some()
    }

    /// How far the seams of a state are open; none without seams.
    pub(super) fn gap(&self, state: &State) -> Option<SeamGap> {
        let sewn = &self.sewn.as_deref()?.way;
        let (widest_m, ends) = sewn.ends(&state.positions);
        Some(SeamGap { widest_m, open: sewn.open(&state.positions, &ends).count() })
    }

    /// The seams that are open in a state after `step`, and why. `before`: a state of the stage before it, with its
    /// step.
    ///
    /// # Errors
    /// A sentence, if detection fails.
    pub(super) fn open_seams(
        &self,
        before: Option<(u32, &State)>,
        state: &State,
        step: u32,
    ) -> Result<Vec<OpenSeam>, String> {
        let Some(sewn) = self.sewn.as_deref() else { return Ok(Vec::new()) };
        open_seams(&self.plan.scene, &sewn.way, before, state, step)
    }
}

/// A stage that begins: its first step and its state there.
pub(super) type Begin = (Arc<Stage>, u32, Option<Arc<State>>);
