//! A shot split in time, played on a virtual clock: every process does one thing after the other, a segment waits for
//! its coarse state, and what a step costs is given. Times are modeled from these costs; none of them is measured here.
//!
//! The seconds of steps may come from recorded runs. Not modeled: processes that slow each other down by sharing a
//! machine.

use super::partition;

/// Costs of a shot, one entry per fine step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Costs {
    /// Seconds of every fine step.
    pub fine: Vec<f64>,
    /// Seconds of the coarse run for the same stretch of time, of every coarser level: the next coarser first.
    pub coarse: Vec<Vec<f64>>,
    /// Fine steps in a coarse step of the next coarser level; segments start on these.
    pub stride: u64,
}

/// How the shot is run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Method {
    /// Where it is cut.
    pub partition: Partition,
    /// Fine steps that recover detail at the start of every segment but the first.
    pub recovery_steps: u64,
    /// Steps at the start of every segment but the first that are made again from the end of the one before.
    pub handover_steps: u64,
    /// Seconds to hand a coarse state on to the process of a segment.
    pub coarse_state_s: f64,
    /// Seconds to hand a fine state on at a seam.
    pub fine_state_s: f64,
    /// Whether the coarse run goes to the end of the shot (a preview of all of it) or, as in the paper, to the last
    /// cut.
    pub coarse_to_end: bool,
}

/// A shot that has been cut.
#[derive(Clone, Debug, PartialEq)]
pub struct Cut {
    /// First steps of the segments.
    pub starts: Vec<u64>,
    /// Steps of the hand-over to every segment; 0 where there is none, as for the first one.
    pub handover_steps: Vec<u64>,
    /// Whether it is cut by what the whole coarse run has counted, so that no segment but the first begins before its
    /// end.
    pub waits_for_coarse: bool,
}

/// The rule for the cuts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Partition {
    /// Equal lengths [Liang and Lin 2018, Eq. 3].
    Uniform,
    /// Eq. 5 with the mean ratio of all steps.
    Static,
    /// Algorithm 1 with these costs. It balances the times at which segments start; a load that changes during the shot
    /// does not move its cuts, unless the ratio changes.
    Adaptive,
    /// Cuts for which all segments would end together if every fine step cost the mean ratio times its coarse one. The
    /// segments but the first start when the coarse run is done.
    Profile,
    /// Cuts for which all segments end together, which takes costs that are known beforehand: a bound for the others.
    Known,
}

/// What the clock showed.
#[derive(Clone, Debug, PartialEq)]
pub struct Played {
    /// First steps of the segments.
    pub starts: Vec<u64>,
    /// Seconds until everything is done.
    pub seconds: f64,
    /// Speed-up over making all fine steps one after another.
    pub speedup: f64,
    /// Share of the processes' time in which they do nothing.
    pub idle_share: f64,
    /// Processes that made the coarse run (more than one with a third level).
    pub coarse_processes: usize,
}

impl Costs {
    /// K: seconds of all fine steps over those of the next coarser level.
    pub fn ratio(&self) -> f64 {
        self.fine.iter().sum::<f64>() / self.coarse[0].iter().sum::<f64>()
    }

    /// Plays the shot on `processes` processes: with one coarser level, one of them makes the coarse run and then the
    /// last segment; with two, the coarse run is split in time itself, over the number of processes that is best.
    pub fn play(&self, processes: usize, method: &Method) -> Played {
        if processes < 2 {
            let seconds = self.fine.iter().sum();
            return Played { starts: vec![0], seconds, speedup: 1.0, idle_share: 0.0, coarse_processes: 0 };
        }
        let fine = Prefix::new(&self.fine);
        if self.coarse.len() > 1 {
            let most = (processes / 2).clamp(1, 64);
            let plans = (1..=most).map(|split| self.play_split(&fine, processes, split, method));
            return plans.min_by(|a, b| a.seconds.total_cmp(&b.seconds)).expect("at least one plan");
        }
        let coarse = Prefix::new(&self.coarse[0]);
        let steps = self.fine.len() as u64;
        let on_coarse_steps = |starts: Vec<u64>| {
            let mut starts: Vec<u64> = starts.into_iter().map(|start| start - start % self.stride).collect();
            starts.dedup();
            starts
        };
        let starts = match method.partition {
            Partition::Uniform => on_coarse_steps(partition::uniform(steps, processes)),
            Partition::Static => on_coarse_steps(partition::balanced_for_ratio(steps, processes, self.ratio())),
            Partition::Adaptive => {
                partition::adaptive(&self.fine, &self.coarse[0], processes, method.recovery_steps, self.stride)
            }
            Partition::Profile => {
                let ratio = self.ratio();
                let predicted = Prefix(coarse.0.iter().map(|seconds| ratio * seconds).collect());
                let coarse_run = CoarseRun { whole: true, ..CoarseRun::serial(coarse, steps) };
                let plan = Plan { run: &predicted, above: &coarse_run, processes, stride: self.stride, method };
                let (starts, _) = plan.best();
                return self.time(&fine, &coarse_run, starts, processes, method);
            }
            Partition::Known => return self.play_split(&fine, processes, 1, method),
        };
        let reach = if method.coarse_to_end { steps } else { starts.last().copied().unwrap_or(0) };
        self.time(&fine, &CoarseRun::serial(coarse, reach), starts, processes, method)
    }

    /// Plays the shot as `cut`, with a process per segment, one of which makes the coarse run first. Of `method`, cuts
    /// and hand-overs are not looked at.
    pub fn play_cut(&self, cut: &Cut, method: &Method) -> Played {
        let coarse = CoarseRun::serial(Prefix::new(&self.coarse[0]), self.fine.len() as u64);
        let coarse = CoarseRun { whole: cut.waits_for_coarse, ..coarse };
        let (fine, processes) = (Prefix::new(&self.fine), cut.starts.len());
        self.time_joined(&fine, &coarse, cut.starts.clone(), &cut.handover_steps, processes, method)
    }

    /// Cuts with known costs; `split` processes make the coarse run.
    fn play_split(&self, fine: &Prefix, processes: usize, split: usize, method: &Method) -> Played {
        let cost = Prefix::new(&self.coarse[0]);
        let steps = self.fine.len() as u64;
        let coarse_run = match self.coarse.get(1).filter(|_| split > 1) {
            None => CoarseRun::serial(cost, steps),
            Some(coarsest) => {
                // The coarsest run and the segments of the coarse one, on `split` processes: a shot of two levels.
                let above = CoarseRun::serial(Prefix::new(coarsest), steps);
                let plan = Plan { run: &cost, above: &above, processes: split, stride: self.stride, method };
                let (starts, begun) = plan.best();
                let ends = (0..starts.len())
                    .map(|j| begun[j] + cost.between(starts[j], starts.get(j + 1).copied().unwrap_or(steps)))
                    .collect();
                CoarseRun { starts, begun, cost, ends, whole: false }
            }
        };
        let plan = Plan { run: fine, above: &coarse_run, processes, stride: self.stride, method };
        let (starts, _) = plan.best();
        self.time(fine, &coarse_run, starts, processes, method)
    }

    /// The clock for given cuts, with as many steps in every hand-over.
    fn time(&self, fine: &Prefix, above: &CoarseRun, starts: Vec<u64>, processes: usize, method: &Method) -> Played {
        let handover_steps = vec![method.handover_steps; starts.len()];
        self.time_joined(fine, above, starts, &handover_steps, processes, method)
    }

    /// The clock for given cuts, and steps of the hand-over to every segment.
    fn time_joined(
        &self,
        fine: &Prefix,
        above: &CoarseRun,
        starts: Vec<u64>,
        handover_steps: &[u64],
        processes: usize,
        method: &Method,
    ) -> Played {
        let steps = self.fine.len() as u64;
        let mut free = above.free_at(processes);
        let mut ends: Vec<f64> = Vec::with_capacity(starts.len());
        let mut busy: f64 = above.work();
        for (j, &start) in starts.iter().enumerate() {
            let next = starts.get(j + 1).copied().unwrap_or(steps);
            let begun = begin(fine, above, &mut free, start, method);
            let work = fine.between(start, next);
            busy += work + if j > 0 { method.recovery_steps as f64 * fine.at(start) } else { 0.0 };
            ends.push(begun + work);
        }
        // All seams at once, when both segments beside a seam are done.
        let mut seconds = ends.iter().copied().fold(0.0, f64::max);
        for (j, &start) in starts.iter().enumerate().skip(1).filter(|(j, _)| handover_steps[*j] > 0) {
            let work = fine.between(start, (start + handover_steps[j]).min(steps));
            busy += work;
            seconds = f64::max(seconds, ends[j].max(ends[j - 1] + method.fine_state_s) + work);
        }
        let all: f64 = fine.upto(steps);
        let idle_share = 1.0 - busy / (processes as f64 * seconds);
        Played { starts, seconds, speedup: all / seconds, idle_share, coarse_processes: above.starts.len() }
    }
}

/// Sums of costs from the start.
struct Prefix(Vec<f64>);

impl Prefix {
    fn new(costs: &[f64]) -> Prefix {
        let mut sum = 0.0;
        let sums = costs.iter().map(|cost| {
            sum += cost;
            sum
        });
        Prefix([0.0].into_iter().chain(sums).collect())
    }

    fn steps(&self) -> u64 {
        self.0.len() as u64 - 1
    }

    fn upto(&self, step: u64) -> f64 {
        self.0[step as usize]
    }

    fn between(&self, from: u64, to: u64) -> f64 {
        self.upto(to) - self.upto(from)
    }

    /// Cost of the step after `start`.
    fn at(&self, start: u64) -> f64 {
        self.between(start, (start + 1).min(self.steps()))
    }

    /// The last step that is reached from `start` with this cost.
    fn reached(&self, start: u64, cost: f64) -> u64 {
        let limit = self.upto(start) + cost;
        (self.0.partition_point(|sum| *sum <= limit) as u64 - 1).max(start)
    }
}

/// A coarser run, itself in segments.
struct CoarseRun {
    starts: Vec<u64>,
    /// Seconds at which every segment begins its first step.
    begun: Vec<f64>,
    /// Seconds at which every segment's process is free.
    ends: Vec<f64>,
    cost: Prefix,
    /// Whether nobody starts before all of it is done.
    whole: bool,
}

impl CoarseRun {
    /// One process makes the steps up to `reach`.
    fn serial(cost: Prefix, reach: u64) -> CoarseRun {
        CoarseRun { starts: vec![0], begun: vec![0.0], ends: vec![cost.upto(reach)], cost, whole: false }
    }

    /// Seconds at which the coarse state after `step` steps can be used.
    fn has(&self, step: u64) -> f64 {
        if self.whole {
            return self.ends.iter().copied().fold(0.0, f64::max);
        }
        let j = self.starts.partition_point(|start| *start <= step) - 1;
        self.begun[j] + self.cost.between(self.starts[j], step)
    }

    /// Seconds at which the processes are free, ascending: those that do not make the coarse run at once.
    fn free_at(&self, processes: usize) -> Vec<f64> {
        let mut free = vec![0.0; processes.saturating_sub(self.ends.len())];
        free.extend(&self.ends);
        free.sort_by(f64::total_cmp);
        free
    }

    fn work(&self) -> f64 {
        self.begun.iter().zip(&self.ends).map(|(begun, end)| end - begun).sum()
    }
}

/// Seconds at which the segment from `start` begins its first step, on the process that is free last among those that
/// are free when its coarse state is there, or else on the one that is free first; it is taken from `free` (ascending).
fn begin(fine: &Prefix, above: &CoarseRun, free: &mut Vec<f64>, start: u64, method: &Method) -> f64 {
    let ready = if start == 0 { 0.0 } else { above.has(start) + method.coarse_state_s };
    let taken = free.partition_point(|at| *at <= ready).saturating_sub(1);
    let begun = ready.max(free.remove(taken));
    if start == 0 { begun } else { begun + method.recovery_steps as f64 * fine.at(start) }
}

/// The search for cuts that let all segments end together.
struct Plan<'a> {
    run: &'a Prefix,
    above: &'a CoarseRun,
    processes: usize,
    stride: u64,
    method: &'a Method,
}

impl Plan<'_> {
    /// First steps of the segments and the seconds at which they begin.
    fn best(&self) -> (Vec<u64>, Vec<f64>) {
        let (mut low, mut high) = (0.0, 2.0 * (self.run.upto(self.run.steps()) + self.above.ends.iter().sum::<f64>()));
        let mut best = None;
        // 60 halvings resolve the end to rounding.
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            match self.within(middle) {
                Some(plan) => (high, best) = (middle, Some(plan)),
                None => low = middle,
            }
        }
        best.unwrap_or_else(|| (vec![0], vec![0.0]))
    }

    /// Segments that all end within `seconds`, if the processes suffice.
    fn within(&self, seconds: f64) -> Option<(Vec<u64>, Vec<f64>)> {
        let mut free = self.above.free_at(self.processes);
        let (mut starts, mut begins) = (Vec::new(), Vec::new());
        let mut start = 0;
        while start < self.run.steps() {
            if free.is_empty() {
                return None;
            }
            let begun = begin(self.run, self.above, &mut free, start, self.method);
            let reached = self.run.reached(start, seconds - begun);
            let next = if reached < self.run.steps() { reached - reached % self.stride } else { reached };
            if next <= start {
                return None;
            }
            starts.push(start);
            begins.push(begun);
            start = next;
        }
        Some((starts, begins))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time_parallel::partition::{speedup_balanced, speedup_with_extra_steps};

    /// Two segments of 40 and 60 steps of a second; a coarse step takes 0.1 s. The process that is free at once makes
    /// the first one, and that of the coarse run, which ends after 10 s, the other one, after two steps of recovery.
    #[test]
    fn a_shot_that_has_been_cut_is_played_as_it_is() {
        let costs = Costs { fine: vec![1.0; 100], coarse: vec![vec![0.1; 100]], stride: 1 };
        let method = Method { recovery_steps: 2, coarse_state_s: 1.0, fine_state_s: 50.0, ..PLAIN };
        let cut = |handover: u64, waits_for_coarse: bool| {
            let cut = Cut { starts: vec![0, 40], handover_steps: vec![0, handover], waits_for_coarse };
            costs.play_cut(&cut, &Method { coarse_to_end: true, ..method }).seconds
        };
        // The state is there after 5 s, or a second after the end of the coarse run.
        assert!((cut(0, false) - 72.0).abs() < 1e-9 && (cut(0, true) - 73.0).abs() < 1e-9);
        // The hand-over waits for the end of the first segment, which comes after 40 + 50 s.
        assert!((cut(5, false) - 95.0).abs() < 1e-9, "{}", cut(5, false));
    }

    const PLAIN: Method = Method {
        partition: Partition::Static,
        recovery_steps: 0,
        handover_steps: 0,
        coarse_state_s: 0.0,
        fine_state_s: 0.0,
        coarse_to_end: false,
    };

    fn constant(steps: usize, ratio: f64) -> Costs {
        Costs { fine: vec![1.0; steps], coarse: vec![vec![1.0 / ratio; steps]], stride: 1 }
    }

    #[test]
    fn constant_costs_give_eq_6() {
        for (ratio, processes) in [(100.0, 8), (368.0, 64)] {
            let expected = speedup_balanced(ratio, processes);
            let costs = constant(200_000, ratio);
            for partition in [Partition::Static, Partition::Known] {
                let played = costs.play(processes, &Method { partition, ..PLAIN });
                let error = played.speedup / expected - 1.0;
                // The known partition lets the coarse run go to the end, which the last segment waits for.
                let margin = if partition == Partition::Known { 0.02 } else { 2e-3 };
                assert!(error.abs() < margin, "{partition:?}: {} instead of {expected}", played.speedup);
            }
        }
    }

    #[test]
    fn recovery_costs_what_eq_16_says() {
        let (steps, ratio, processes) = (200_000, 500.0, 32);
        let expected = speedup_with_extra_steps(steps as u64, 40, speedup_balanced(ratio, processes));
        let played = constant(steps, ratio).play(processes, &Method { recovery_steps: 40, ..PLAIN });
        assert!((played.speedup / expected - 1.0).abs() < 2e-3, "{} instead of {expected}", played.speedup);
    }

    #[test]
    fn one_process_makes_the_fine_steps_alone() {
        let played = constant(10, 5.0).play(1, &PLAIN);
        assert_eq!((played.seconds, played.speedup, played.starts), (10.0, 1.0, vec![0]));
    }

    #[test]
    fn two_processes_by_hand() {
        // 8 fine steps of 1 s, coarse 1/4 s each, cut at 4: the first segment ends at 4 s, the other one starts at 1 s
        // and ends at 5 s; then it makes two steps again. Busy: 4 + 1 + 4 + 2 of 2 * 7 s.
        let method = Method { partition: Partition::Uniform, handover_steps: 2, ..PLAIN };
        let played = constant(8, 4.0).play(2, &method);
        assert_eq!((played.starts, played.seconds), (vec![0, 4], 7.0));
        assert!((played.idle_share - (1.0 - 11.0 / 14.0)).abs() < 1e-12);
    }

    #[test]
    fn moving_states_is_counted() {
        let method = Method { partition: Partition::Uniform, coarse_state_s: 0.5, ..PLAIN };
        assert_eq!(constant(8, 4.0).play(2, &method).seconds, 5.5);
        let method = Method { partition: Partition::Uniform, handover_steps: 1, fine_state_s: 3.0, ..PLAIN };
        // The end of the first segment arrives at 4 + 3 s, after the second has ended at 5 s.
        assert_eq!(constant(8, 4.0).play(2, &method).seconds, 8.0);
    }

    #[test]
    fn a_coarse_run_to_the_end_delays_the_last_segment() {
        let method = Method { partition: Partition::Uniform, coarse_to_end: true, ..PLAIN };
        assert_eq!(constant(8, 4.0).play(2, &method).seconds, 6.0);
    }

    #[test]
    fn a_load_that_changes_needs_cuts_that_know_it() {
        // Fine and coarse cost between 1 and 3 units: the ratio is constant, so Algorithm 1 does not move its cuts.
        let wave = |scale: f64| (0..4000).map(|n| scale * (2.0 + (n as f64 * 0.004).sin())).collect::<Vec<_>>();
        let costs = Costs { fine: wave(1.0), coarse: vec![wave(0.004)], stride: 4 };
        let played = |partition| costs.play(16, &Method { partition, coarse_to_end: true, ..PLAIN });
        let [uniform, adaptive, profile, known] =
            [Partition::Uniform, Partition::Adaptive, Partition::Profile, Partition::Known].map(played);
        assert!((adaptive.seconds / uniform.seconds - 1.0).abs() < 0.05);
        assert!(profile.seconds < 0.8 * uniform.seconds, "{} {}", profile.seconds, uniform.seconds);
        assert!(known.seconds <= profile.seconds && known.idle_share < 0.05);
        assert!([&adaptive, &profile, &known].iter().all(|played| played.starts.iter().all(|start| start % 4 == 0)));
    }

    #[test]
    fn a_third_level_beats_the_bound_of_two() {
        let (steps, processes) = (10_000, 512);
        let mut costs = constant(steps, 368.0);
        let method = Method { partition: Partition::Known, recovery_steps: 5, ..PLAIN };
        let two = costs.play(processes, &method);
        costs.coarse.push(vec![1.0 / (368.0 * 60.0); steps]);
        let three = costs.play(processes, &method);
        assert!(two.speedup < speedup_balanced(368.0, processes));
        assert!(three.speedup > speedup_balanced(368.0, processes) && three.coarse_processes > 1, "{}", three.speedup);
    }
}
