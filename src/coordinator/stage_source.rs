//! The stages of a run one after another, as segments of one session, and what is done between two steps of a run that
//! is changed while it goes on.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde_json::{Value, json};

use super::live::{Desk, Record, Turn};
use super::shot::{Segment, Source};
use super::stages::{Attempt, Begin, Changed, Stage, Stages};
use crate::model::State;
use crate::os::console::note;
use crate::scene::{Change, Scene};

/// Whether the state after a step is wanted.
type WantsState<'a> = dyn Fn(u32) -> bool + Send + Sync + 'a;

/// The stages of a run as segments of one session.
pub(super) struct StageSource<'a> {
    shared: Arc<Shared<'a>>,
}

/// What a run needs that is changed while it goes on.
pub(super) struct Steered {
    /// What was changed and is to be changed.
    pub record: Arc<Mutex<Record>>,
    /// Where clients ask for more; none if they cannot.
    pub desk: Option<Arc<Desk>>,
}

struct Shared<'a> {
    stages: &'a Stages,
    last_step: u32,
    trace_until: u32,
    wants_state: Arc<WantsState<'a>>,
    next: Mutex<Option<Begin>>,
    record: Option<Arc<Mutex<Record>>>,
    desk: Option<Arc<Desk>>,
    is_loaded: AtomicBool,
    fault: Mutex<Option<String>>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl<'a> StageSource<'a> {
    /// Begins with `begin`; a stage goes on to `last_step`, until it is sewn or until it is changed.
    pub(super) fn new(
        stages: &'a Stages,
        begin: Begin,
        last_step: u32,
        trace_steps: u32,
        wants_state: Arc<WantsState<'a>>,
        steered: Option<Steered>,
    ) -> StageSource<'a> {
        let trace_until = begin.1.saturating_add(trace_steps);
        let (record, desk) = steered.map_or((None, None), |one| (Some(one.record), one.desk));
        let (next, is_loaded, fault) = (Mutex::new(Some(begin)), AtomicBool::new(false), Mutex::new(None));
        let shared = Shared { stages, last_step, trace_until, wants_state, next, record, desk, is_loaded, fault };
        StageSource { shared: Arc::new(shared) }
    }

    /// Why the run cannot go on, if a change that was known before could not be made.
    pub(super) fn fault(&self) -> Option<String> {
        lock(&self.shared.fault).take()
    }
}

impl Shared<'_> {
    /// Whether something may have to be done between the step `step` and the next one.
    fn is_due(&self, step: u32) -> bool {
        // Both look at every step: a desk counts them.
        let recorded = self.record.as_ref().is_some_and(|record| lock(record).is_due(step));
        let asked = self.desk.as_ref().is_some_and(|desk| desk.is_due(step));
        recorded || asked
    }

    /// Sews, if the seams are closed.
    fn sew(&self, stage: &Stage, step: u32, state: &State) -> Result<Option<Begin>, String> {
        let Attempt::Sewn(stage, state) = self.stages.attempt(stage, state, step)? else { return Ok(None) };
        if let Some(record) = &self.record {
            lock(record).add(Change::welded(step))?;
        }
        Ok(Some((stage, step, Some(Arc::new(*state)))))
    }

    /// Makes all changes that act after a step; none if the run ends there.
    ///
    /// # Errors
    /// A sentence: a change that was known before cannot be made.
    fn steer(&self, begin: Begin, halt: &AtomicBool) -> Result<Option<Begin>, String> {
        let (mut stage, step, mut state) = begin;
        let Some(record) = &self.record else { return Ok(Some((stage, step, state))) };
        loop {
            let due = lock(record).take_due(step);
            let Some(change) = due else { break };
            let made = self.stages.changed(&stage, &change, self.state(&stage, &state));
            let what = change.table.get("do").and_then(toml::Value::as_str).unwrap_or_default();
            let made = made.map_err(|why| format!("the change `{what}` of step {step} cannot be made: {why}"))?;
            self.note_threads(step, &made)?;
            (stage, state) = (made.stage, made.state);
            note(format_args!("after step {step}: {what}"));
        }
        let Some(desk) = &self.desk else { return Ok(Some((stage, step, state))) };
        desk.summarize(summary(&stage, self.last_step));
        loop {
            let asked = match desk.wait(step, halt) {
                Turn::Go => return Ok(Some((stage, step, state))),
                Turn::Stop => return Ok(None),
                Turn::Change(asked) => asked,
            };
            let made = Change::of_request(asked.table.clone(), step).and_then(|change| {
                let made = self.stages.changed(&stage, &change, self.state(&stage, &state))?;
                lock(record).add(change)?;
                self.note_threads(step, &made)?;
                Ok(made)
            });
            match made {
                Ok(made) => {
                    (stage, state) = (made.stage, made.state);
                    desk.summarize(summary(&stage, self.last_step));
                    let what = asked.table.get("do").and_then(toml::Value::as_str).unwrap_or_default();
                    note(format_args!("after step {step}: {what}"));
                    asked.answer(Ok(step));
                }
                Err(why) => asked.answer(Err(&why)),
            }
        }
    }

    /// Notes with which lengths threads begin anew, because they follow from the state of now.
    fn note_threads(&self, step: u32, made: &Changed) -> Result<(), String> {
        match (&self.record, &made.gaps_m) {
            (Some(record), Some(gaps_m)) => lock(record).add(Change::threads(step, gaps_m.clone())),
            _ => Ok(()),
        }
    }

    /// The state of now, which is that of the scene if there is no other one.
    fn state(&self, stage: &Stage, state: &Option<Arc<State>>) -> Option<Arc<State>> {
        Some(state.clone().unwrap_or_else(|| Arc::new(State::start_of(&stage.plan.scene))))
    }
}

impl<'a> Source<'a> for StageSource<'a> {
    fn next(&self, _session: usize, halt: &AtomicBool) -> Option<(usize, Segment<'a>)> {
        let shared = &self.shared;
        let mut begin = lock(&shared.next).take()?;
        let mut last_step = shared.last_step;
        if shared.desk.is_some() && !shared.is_loaded.swap(true, Ordering::Relaxed) {
            // The workers are loaded and the first frame is written before anybody is waited for.
            *lock(&shared.next) = Some(begin.clone());
            last_step = begin.1;
        } else {
            match shared.steer(begin, halt) {
                Ok(Some(steered)) => begin = steered,
                Ok(None) => return None,
                Err(why) => {
                    *lock(&shared.fault) = Some(why);
                    return None;
                }
            }
        }
        let (stage, first_step, start) = begin;
        let mut segment = Segment {
            start,
            first_step,
            trace_steps: shared.trace_until.saturating_sub(first_step),
            wants_state: Arc::clone(&shared.wants_state),
            ..Segment::plain(Arc::clone(&stage.plan), last_step)
        };
        let number = stage.number;
        if shared.record.is_some() {
            let (shared, wants_state) = (Arc::clone(shared), Arc::clone(&shared.wants_state));
            segment.wants_state = Arc::new(move |step| {
                let is_due = step < shared.last_step && shared.is_due(step);
                is_due || wants_state(step)
            });
        }
        if stage.has_seams() || shared.record.is_some() {
            let shared = Arc::clone(shared);
            let per_frame = stage.plan.scene.settings.steps_per_frame;
            segment.ends_at = Some(Arc::new(move |step: u32, state: &State| {
                if step >= shared.last_step {
                    return Ok(false);
                }
                let sewn = if step.is_multiple_of(per_frame) { shared.sew(&stage, step, state)? } else { None };
                let here = || (Arc::clone(&stage), step, Some(Arc::new(state.clone())));
                let next = sewn.or_else(|| shared.is_due(step).then(here));
                let ends = next.is_some();
                if ends {
                    *lock(&shared.next) = next;
                }
                Ok(ends)
            }));
        }
        Some((number, segment))
    }
}

/// What can be changed of a stage, for clients.
fn summary(stage: &Stage, last_step: u32) -> Value {
    let scene: &Scene = &stage.plan.scene;
    let settings = &scene.settings;
    let cloth = |(number, cloth): (usize, &crate::scene::Cloth)| {
        let fabric = scene.fabric_of_triangle.get(cloth.triangles.start as usize);
        let fabric = fabric.and_then(|&fabric| scene.fabrics.get(usize::from(fabric)));
        let edges = stage.handles.cloths.get(number).map(|cloth| cloth.edges.iter().map(|(name, _)| name.clone()));
        json!({
            "name": cloth.name,
            "friction": cloth.friction,
            "fabric": fabric.map(|fabric| &fabric.name),
            "density_kg_m2": fabric.map(|fabric| fabric.density_kg_m2),
            "edges": edges.map(Iterator::collect::<Vec<_>>),
        })
    };
    let seams = scene.sewing.as_ref().map(|sewing| {
        let pairs = |seam: usize| sewing.seam_of_pair.iter().filter(|&&of| of as usize == seam).count();
        let names = sewing.names.iter().enumerate().map(|(seam, name)| (name, pairs(seam)));
        names.filter(|(_, pairs)| *pairs > 0).map(|(name, pairs)| json!({ "name": name, "pairs": pairs })).collect()
    });
    let obstacles = scene.obstacles.iter().map(|one| json!({ "name": one.name, "friction": one.friction }));
    let pins = stage.handles.pins.iter().map(|pin| json!({ "name": pin.name, "vertices": pin.vertices.len() }));
    json!({
        "last_step": last_step,
        "step_s": settings.step_s,
        "steps_per_frame": settings.steps_per_frame,
        "triangles": scene.mesh.triangles.len(),
        "vertices": scene.mesh.positions.len(),
        "gravity_m_s2": settings.gravity_m_s2,
        "wind_m_s": settings.wind_m_s,
        "air_density_kg_m3": settings.air_density_kg_m3,
        "air_drag_kg_m2_s": settings.air_drag_kg_m2_s,
        "friction": settings.friction,
        "cloths": scene.cloths.iter().enumerate().map(cloth).collect::<Vec<_>>(),
        "obstacles": obstacles.collect::<Vec<_>>(),
        "pins": pins.collect::<Vec<_>>(),
        "seams": seams.unwrap_or_else(Vec::new),
    })
}
