//! The hand-over after a cut, and the figures of seams.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::session::Way;
use super::shot::FindWay;
use super::time_job::Job;
use super::time_plan::TimePlan;
use crate::math::Vec3;
use crate::model::State;
use crate::output::Checkpoint;
use crate::step::Guidance;

/// alpha = w / (1 - w) at the start of a hand-over and at its end, between which it grows exponentially: internal
/// forces let go only where it is far above what stops a mass in a step.
const PULL: [f64; 2] = [0.1, 999.0];
/// Second differences of positions that a hand-over may add to those inside the segment: a share of their median.
const JUMP_MOST: f64 = 0.2;
/// Distance over the median second difference from which a step may lead straight to the state of the later segment.
const CLOSE_ENOUGH: f64 = 0.1;
/// Steps that a hand-over may take beyond those planned, over those.
const LATE_MOST: f64 = 0.2;
/// Steps of a segment whose second differences are looked at.
const SAMPLES: u32 = 20;

/// A state that a job has kept.
///
/// # Errors
/// A sentence: it is missing or damaged.
pub(super) fn kept_state(folder: &Path, step: u32) -> Result<State, String> {
    let path = folder.join("states").join(format!("step_{step:08}.ltc"));
    let bytes = fs::read(&path).map_err(|error| format!("cannot read {}: {error}", path.display()))?;
    let kept = Checkpoint::from_bytes(&bytes).map_err(|error| format!("{}: {error}", path.display()))?;
    Ok(kept.state)
}

/// Largest and root mean square distance of the vertices of two states of one mesh, meters.
pub(super) fn distances_m(a: &[Vec3], b: &[Vec3]) -> [f64; 2] {
    let squares = || a.iter().zip(b).map(|(a, b)| a.as_dvec3().distance_squared(b.as_dvec3()));
    [squares().fold(0.0, f64::max).sqrt(), (squares().sum::<f64>() / a.len().max(1) as f64).sqrt()]
}

/// Largest and root mean square length of a - 2 b + c over the vertices, meters.
pub(super) fn second_differences_m(a: &[Vec3], b: &[Vec3], c: &[Vec3]) -> [f64; 2] {
    let (mut most, mut sum) = (0.0_f64, 0.0);
    for ((a, b), c) in a.iter().zip(b).zip(c) {
        let square = (a.as_dvec3() - 2.0 * b.as_dvec3() + c.as_dvec3()).length_squared();
        (most, sum) = (most.max(square), sum + square);
    }
    [most.sqrt(), (sum / a.len().max(1) as f64).sqrt()]
}

/// [`second_differences_m`] of up to `samples` steps of a segment from the third one on, from the states that it has
/// kept. Its first two steps come from the start, where the coarse run was bent into it.
pub(super) fn inner_jumps_m(folder: &Path, cut: u32, samples: u32) -> Vec<[f64; 2]> {
    let mut all = Vec::new();
    let mut window: Vec<Vec<Vec3>> = Vec::new();
    for step in cut + 2..cut + 4 + samples {
        let Ok(state) = kept_state(folder, step) else { break };
        window.push(state.positions);
        if let [a, b, c] = &window[..] {
            all.push(second_differences_m(a, b, c));
            window.remove(0);
        }
    }
    all
}

/// The median of each of both figures; none without any.
pub(super) fn medians(figures: &[[f64; 2]]) -> Option<[f64; 2]> {
    let median = |which: usize| {
        let mut values: Vec<f64> = figures.iter().map(|pair| pair[which]).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied()
    };
    Some([median(0)?, median(1)?])
}

/// Positions at a step.
pub(super) type Known = Option<(u32, Arc<Vec<Vec3>>)>;

/// Leads the first steps of a segment, made again from the true end of the one before, to the states of the segment.
/// The distance is closed along a smooth curve, so slowly that its second differences stay below [`JUMP_MOST`]; then a
/// last step leads straight to a state of the segment, whose own steps follow it.
pub(super) struct HandOver {
    folder: PathBuf,
    cut: u32,
    /// Steps of the hand-over.
    steps: u32,
    /// The last state of the segment that was kept for it.
    last_kept: u32,
    close_m: f64,
    known: Mutex<Known>,
}

impl HandOver {
    /// The hand-over to segment `j`, which starts at step `cut` and ends at `last_step`, from `end`.
    ///
    /// # Errors
    /// A state of the segment is missing.
    pub(super) fn new(
        plan: &TimePlan,
        run: &Path,
        j: usize,
        cut: u32,
        last_step: u32,
        end: &State,
    ) -> Result<HandOver, String> {
        let folder = Job::Segment(j).folder(run);
        let distances_m = distances_m(&end.positions, &kept_state(&folder, cut)?.positions);
        let inner_m = medians(&inner_jumps_m(&folder, cut, SAMPLES)).unwrap_or([f64::MIN_POSITIVE; 2]);
        let last_kept = (cut + plan.handover_kept()).min(last_step);
        let planned = handover_steps(distances_m, inner_m).clamp(2, plan.handover_most());
        // Room for steps beyond the planned ones must be within the segment, too.
        let room = (f64::from(last_kept - cut) / (1.0 + LATE_MOST)) as u32;
        let steps = planned.min(room.max(2));
        let close_m = CLOSE_ENOUGH * inner_m[0];
        Ok(HandOver { folder, cut, steps, last_kept, close_m, known: Mutex::new(None) })
    }

    fn state(&self, step: u32) -> Result<State, String> {
        kept_state(&self.folder, step)
    }

    /// Share of the first distance that is left after `k` steps.
    fn left(&self, k: u32) -> f64 {
        let t = (f64::from(k) / f64::from(self.steps)).min(1.0);
        1.0 - t * t * (3.0 - 2.0 * t)
    }
}

/// Steps over which distances (largest, root mean square) can be closed without a jump that is seen beside the second
/// differences `inner_m`: those of 1 - 3 t^2 + 2 t^3 are at most 6 / B^2.
fn handover_steps(distances_m: [f64; 2], inner_m: [f64; 2]) -> u32 {
    let steps = |(distance, inner): (f64, f64)| (6.0 * distance / (JUMP_MOST * inner)).sqrt().ceil();
    distances_m.into_iter().zip(inner_m).map(steps).fold(0.0, f64::max).min(1e6) as u32
}

impl FindWay for HandOver {
    fn way(&self, step: u32, blocked: bool, before: Option<&State>) -> Result<Way, String> {
        let k = step - self.cut;
        if step > self.last_kept {
            return Ok(Way::Free);
        }
        let target = self.state(step)?;
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let start = match known.take() {
            Some((of, positions)) if of == step - 1 => positions,
            _ => Arc::new(self.state(step - 1)?.positions),
        };
        let distance_m = before.map_or(f64::INFINITY, |state| distances_m(&state.positions, &start)[0]);
        tracing::debug!("step {k} of {} of a hand-over: {:.3} mm from its guide", self.steps, 1e3 * distance_m);
        if !blocked && distance_m <= self.close_m {
            *known = Some((step - 1, start));
            return Ok(Way::Straight(Arc::new(target)));
        }
        let end = Arc::new(target.positions);
        *known = Some((step, Arc::clone(&end)));
        let pull = PULL[0] * (PULL[1] / PULL[0]).powf((f64::from(k) / f64::from(self.steps)).min(1.0));
        let weight = pull / (1.0 + pull);
        let distance_left = if k < self.steps { self.left(k) / self.left(k - 1) } else { 0.0 };
        Ok(Way::Guided { start, end, guidance: Guidance { weight, distance_left } })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_chooses_the_steps() {
        // 1 cm beside second differences of 0.16 mm, those of free fall in 4 ms: sqrt(6 * 0.01 / (0.2 * 0.00016)).
        let inner_m = [1.6e-4, 1.6e-4];
        assert_eq!(handover_steps([0.01, 0.002], inner_m), 44);
        assert_eq!(handover_steps([0.01, 0.002], [1.6e-4, 1.6e-5]), 62);
        assert_eq!(handover_steps([0.0, 0.0], inner_m), 0);
        let over = HandOver {
            folder: PathBuf::new(),
            cut: 0,
            steps: 44,
            last_kept: 60,
            close_m: 0.0,
            known: Mutex::new(None),
        };
        let left: Vec<f64> = (0..=44).map(|k| 0.01 * over.left(k)).collect();
        assert_eq!((left[0], left[44]), (0.01, 0.0));
        let most = left.windows(3).map(|w| (w[0] - 2.0 * w[1] + w[2]).abs()).fold(0.0, f64::max);
        assert!(most <= 0.2 * inner_m[0], "{most}");
    }
}
