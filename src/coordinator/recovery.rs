//! How a segment finds detail that the coarse run lacks, before its first step.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::seams::{Known, distances_m, kept_state};
use super::session::Way;
use super::shot::{FindWay, Prepare};
use super::time_job::Job;
use super::time_plan::TimePlan;
use crate::math::Vec3;
use crate::mesh::extent;
use crate::model::State;
use crate::step::Guidance;

/// Strength of a recovery: the cloth goes where the coarse run goes, and is free to find its folds on the way.
const RECOVERY: Guidance = Guidance { weight: 0.5, distance_left: 0.8 };
/// Change of the largest vertex over the size of the cloth below which [`Iterated`] stops [Liang and Lin 2018, Sec.
/// 5.3].
const SMALL_CHANGE: f64 = 1e-3;

/// Vectors of the coarse run at a fine step, between two of its states on a straight way [Liang and Lin 2018, Sec.
/// 5.4].
fn coarse_at(plan: &TimePlan, coarse: &Path, step: u32, vectors: fn(State) -> Vec<Vec3>) -> Result<Vec<Vec3>, String> {
    let (before, part) = (step / plan.step_ratio, step % plan.step_ratio);
    let mut at = vectors(kept_state(coarse, before)?);
    if part > 0 {
        let after = vectors(kept_state(coarse, before + 1)?);
        let share = part as f32 / plan.step_ratio as f32;
        at.iter_mut().zip(&after).for_each(|(x, after)| *x = x.lerp(*after, share));
    }
    Ok(at)
}

/// Leads the steps before a cut along the motion of the coarse run. A frozen pose, as in [Liang and Lin 2018, Alg. 2],
/// would leave the cloth with the velocities and the friction of a cloth at rest.
pub(super) struct WarmUp<'a> {
    plan: &'a TimePlan,
    coarse: PathBuf,
    start: u32,
    known: Mutex<Known>,
}

impl<'a> WarmUp<'a> {
    pub(super) fn new(plan: &'a TimePlan, run: &Path, start: u32) -> WarmUp<'a> {
        WarmUp { plan, coarse: Job::Coarse.folder(run), start, known: Mutex::new(None) }
    }

    fn at(&self, step: u32) -> Result<Arc<Vec<Vec3>>, String> {
        if let Some((of, positions)) = &*self.known.lock().unwrap_or_else(PoisonError::into_inner)
            && *of == step
        {
            return Ok(Arc::clone(positions));
        }
        let positions =
            Arc::new(self.plan.up.vectors(&coarse_at(self.plan, &self.coarse, step, |state| state.positions)?));
        *self.known.lock().unwrap_or_else(PoisonError::into_inner) = Some((step, Arc::clone(&positions)));
        Ok(positions)
    }
}

impl FindWay for WarmUp<'_> {
    fn way(&self, step: u32, _blocked: bool, _before: Option<&State>) -> Result<Way, String> {
        if step > self.start {
            return Ok(Way::Free);
        }
        Ok(Way::Guided { start: self.at(step - 1)?, end: self.at(step)?, guidance: RECOVERY })
    }
}

/// Iterative detail recovery [Liang and Lin 2018, Alg. 2]: from the refined coarse state at the cut one step back by
/// the motion of the coarse run, and forth by a step of the simulation that tracks it, until nothing changes any
/// more. A move back that would let triangles meet is not made; it ends the recovery.
pub(super) struct Iterated<'a> {
    plan: &'a TimePlan,
    start: u32,
    most: u32,
    /// The refined coarse run a step before the cut and at it: positions and velocities.
    before: [Arc<Vec<Vec3>>; 2],
    at: [Arc<Vec<Vec3>>; 2],
    /// Positions of the iteration before.
    last: Mutex<Known>,
}

impl<'a> Iterated<'a> {
    /// The recovery at the cut `start`, which is above 0.
    ///
    /// # Errors
    /// A state of the coarse run is missing.
    pub(super) fn new(plan: &'a TimePlan, run: &Path, start: u32) -> Result<Iterated<'a>, String> {
        let coarse = Job::Coarse.folder(run);
        let refined = |step: u32| -> Result<[Arc<Vec<Vec3>>; 2], String> {
            let vectors = |which: fn(State) -> Vec<Vec3>| {
                Ok::<_, String>(Arc::new(plan.up.vectors(&coarse_at(plan, &coarse, step, which)?)))
            };
            Ok([vectors(|state| state.positions)?, vectors(|state| state.velocities)?])
        };
        let [before, at] = [refined(start - 1)?, refined(start)?];
        Ok(Iterated { plan, start, most: plan.options.recovery_steps, before, at, last: Mutex::new(None) })
    }
}

impl Prepare for Iterated<'_> {
    fn next(&self, reached: &State, made: u32) -> Result<Option<(State, Way)>, String> {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, last)) = last.as_ref() {
            let change_m = distances_m(last, &reached.positions)[0];
            tracing::debug!("iteration {made} of the recovery before step {}: {:.3} mm", self.start, 1e3 * change_m);
            if change_m <= SMALL_CHANGE * extent(&reached.positions) {
                return Ok(None);
            }
        }
        if made == self.most {
            return Ok(None);
        }
        *last = Some((made, Arc::new(reached.positions.clone())));
        let back = |values: &[Vec3], which: usize| -> Vec<Vec3> {
            let change = self.before[which].iter().zip(self.at[which].iter());
            values.iter().zip(change).map(|(value, (before, at))| *value + (*before - *at)).collect()
        };
        let earlier = State {
            positions: back(&reached.positions, 0),
            velocities: back(&reached.velocities, 1),
            ..reached.clone()
        };
        if self.plan.first_crossing(&earlier, self.start - 1).is_some() {
            return Ok(None);
        }
        let [start, end] = [&self.before[0], &self.at[0]].map(Arc::clone);
        Ok(Some((earlier, Way::Guided { start, end, guidance: RECOVERY })))
    }
}
