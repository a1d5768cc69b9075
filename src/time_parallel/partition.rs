//! Where a shot is cut in time, and what theory says a cut gains [Liang and Lin 2018, Sec. 4]. A partition is the
//! ascending list of the first steps of its segments; segment j makes the steps after `starts[j]` up to the next start.

/// Segments of equal length, s_j = floor(N j / p) [Liang and Lin 2018, Eq. 3]. Segments without a step are left out.
pub fn uniform(steps: u64, segments: usize) -> Vec<u64> {
    let start = |j: usize| (u128::from(steps) * j as u128 / segments as u128) as u64;
    distinct((0..segments).map(start), steps)
}

/// Segments that end together if every fine step costs `ratio` coarse ones: s_j = floor(N (1 - q^j) / (1 - q^p)),
/// q = 1 - 1/K [Liang and Lin 2018, Eq. 5]. Segments without a step are left out. An infinite ratio gives [`uniform`].
pub fn balanced_for_ratio(steps: u64, segments: usize, ratio: f64) -> Vec<u64> {
    distinct((0..segments).map(|j| start_for_ratio(steps, segments, j, ratio) as u64), steps)
}

/// s_j of Eq. 5 before it is rounded down.
fn start_for_ratio(steps: u64, segments: usize, j: usize, ratio: f64) -> f64 {
    let (n, share) = (steps as f64, j as f64 / segments as f64);
    if ratio.is_infinite() {
        return n * share;
    }
    // 1 - q^j without cancellation for large K.
    let covered = |j: usize| -(j as f64 * (-1.0 / ratio).ln_1p()).exp_m1();
    n * covered(j) / covered(segments)
}

fn distinct(starts: impl Iterator<Item = u64>, steps: u64) -> Vec<u64> {
    let mut starts: Vec<u64> = starts.filter(|&start| start == 0 || start < steps).collect();
    starts.dedup();
    starts
}

/// Speed-up of [`uniform`] segments that start when the coarse run is done: K p / (K + p - 1) [Liang and Lin 2018, Eq.
/// 4].
pub fn speedup_uniform(ratio: f64, processes: usize) -> f64 {
    let p = processes as f64;
    p / (1.0 + (p - 1.0) / ratio)
}

/// Speed-up of [`balanced_for_ratio`]: K - K (1 - 1/K)^p [Liang and Lin 2018, Eq. 6].
pub fn speedup_balanced(ratio: f64, processes: usize) -> f64 {
    if ratio.is_infinite() {
        return processes as f64;
    }
    -ratio * (processes as f64 * (-1.0 / ratio).ln_1p()).exp_m1()
}

/// Speed-up with `extra` steps per segment for recovery and hand-over: N / (R + N / eta) [Liang and Lin 2018, Eq. 16].
pub fn speedup_with_extra_steps(steps: u64, extra: u64, speedup: f64) -> f64 {
    steps as f64 / (extra as f64 + steps as f64 / speedup)
}

/// What is left to cut while the coarse run goes on [Liang and Lin 2018, Algorithm 1].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Remainder {
    /// Steps from the last cut to the end of the shot.
    pub steps: u64,
    /// Segments for them, the current one among them.
    pub segments: usize,
}

impl Remainder {
    /// Whether the current segment ends `reached` steps after the last cut: the first n for which n >= N / K~ + (1 - 1
    /// / K~) (N - s~_{p-1}) [Liang and Lin 2018, Eq. 9]. `ratio`: K~ of Eq. 7, infinite as long as the current segment
    /// has made no step.
    pub fn is_cut(&self, reached: u64, ratio: f64) -> bool {
        if self.segments < 2 {
            return false;
        }
        let n = self.steps as f64;
        let last_start = start_for_ratio(self.steps, self.segments, self.segments - 1, ratio);
        reached as f64 >= n / ratio + (1.0 - 1.0 / ratio) * (n - last_start)
    }

    /// What is left after a cut.
    pub fn after(&self, reached: u64) -> Remainder {
        Remainder { steps: self.steps - reached, segments: self.segments - 1 }
    }
}

/// Algorithm 1 on costs that are known afterwards: the cuts of a coarse run that decides while it goes on.
///
/// `fine` and `coarse`: cost of every fine step, and of the coarse run's way over the same step, both in one unit:
/// seconds as in the paper, or counted work, with which two runs cut alike. The first segment starts with the coarse
/// run, every other one where it is cut; each first spends `recovery` times the cost of its first step. Cuts are
/// multiples of `stride` steps, the length of a coarse step.
pub fn adaptive(fine: &[f64], coarse: &[f64], segments: usize, recovery: u64, stride: u64) -> Vec<u64> {
    let mut starts = vec![0];
    let mut left = Remainder { steps: fine.len() as u64, segments };
    let mut start = 0;
    // Of the current segment: steps made, their cost, and the cost of the coarse run since its start.
    let (mut made, mut spent, mut coarse_spent, mut coarse_of_made) = (0, recovery_cost(fine, 0, recovery), 0.0, 0.0);
    for n in 1..=fine.len() {
        coarse_spent += coarse[n - 1];
        // Steps that the fine segment has finished while the coarse run came here (Eq. 7).
        while start + made < n && spent + fine[start + made] <= coarse_spent {
            spent += fine[start + made];
            coarse_of_made += coarse[start + made];
            made += 1;
        }
        let ratio = if made == 0 { f64::INFINITY } else { spent / coarse_of_made };
        let reached = (n - start) as u64;
        if n < fine.len() && (n as u64).is_multiple_of(stride) && left.is_cut(reached, ratio) {
            starts.push(n as u64);
            left = left.after(reached);
            start = n;
            (made, spent, coarse_spent, coarse_of_made) = (0, recovery_cost(fine, n, recovery), 0.0, 0.0);
        }
    }
    starts
}

fn recovery_cost(fine: &[f64], start: usize, recovery: u64) -> f64 {
    recovery as f64 * fine.get(start).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uniform_cuts_are_eq_3() {
        assert_eq!(uniform(10, 4), [0, 2, 5, 7]);
        assert_eq!(uniform(2, 4), [0, 1], "segments without a step are left out");
        assert_eq!(uniform(0, 3), [0]);
    }

    #[test]
    fn balanced_cuts_make_all_segments_end_together() {
        // s_j + K (s_{j+1} - s_j) is the same for all j: the equation before Eq. 5, up to rounding down.
        let (steps, segments, ratio) = (1_000_000, 7, 20.0);
        let starts = balanced_for_ratio(steps, segments, ratio);
        let end = |j: usize| starts.get(j).copied().unwrap_or(steps) as f64;
        let first = ratio * end(1);
        for j in 0..segments {
            let finish = end(j) + ratio * (end(j + 1) - end(j));
            assert!((finish - first).abs() <= 2.0 * ratio, "segment {j} ends at {finish}, segment 0 at {first}");
        }
    }

    #[test]
    fn an_infinite_ratio_cuts_uniformly() {
        assert_eq!(balanced_for_ratio(1000, 8, f64::INFINITY), uniform(1000, 8));
        assert_eq!(speedup_balanced(f64::INFINITY, 12), 12.0);
    }

    #[test]
    fn speed_ups_are_eqs_4_6_and_16() {
        assert!((speedup_uniform(100.0, 2) - 200.0 / 101.0).abs() < 1e-12);
        // K - K (1 - 1/K)^p for K = 4, p = 2: 4 - 4 * 9/16.
        assert!((speedup_balanced(4.0, 2) - 1.75).abs() < 1e-12);
        assert!((speedup_balanced(1e9, 3) - 3.0).abs() < 1e-8, "p for a large ratio");
        // The notes of the paper's two-level bound: K = 368 and 512 processes.
        assert!((speedup_balanced(368.0, 512) - 276.6).abs() < 0.1);
        assert!((speedup_with_extra_steps(10_000, 10, 100.0) - 10_000.0 / 110.0).abs() < 1e-9);
    }

    #[test]
    fn the_bounds_of_eq_11_hold() {
        for (ratio, p) in [(30.0, 8), (368.0, 128), (1000.0, 512)] {
            let plain = ratio * p as f64 / (ratio + p as f64);
            let (uniform, balanced) = (speedup_uniform(ratio, p), speedup_balanced(ratio, p));
            assert!(plain < uniform && uniform <= balanced && balanced < ratio, "{ratio} {p}");
        }
    }

    #[test]
    fn constant_costs_are_cut_as_eq_5_cuts_them() {
        // K = 50: Algorithm 1 learns the ratio after its first step and then follows Eq. 5.
        let (steps, segments) = (5000, 6);
        let starts = adaptive(&vec![50.0; steps], &vec![1.0; steps], segments, 0, 1);
        let known = balanced_for_ratio(steps as u64, segments, 50.0);
        assert_eq!(starts.len(), known.len());
        for (found, known) in starts.iter().zip(&known) {
            assert!(found.abs_diff(*known) <= 5, "{starts:?} instead of {known:?}");
        }
    }

    #[test]
    fn costly_steps_get_shorter_segments() {
        // The second half costs three times as much, fine and coarse alike.
        let cost = |unit: f64| (0..2000).map(|n| if n < 1000 { unit } else { 3.0 * unit }).collect::<Vec<_>>();
        let starts = adaptive(&cost(100.0), &cost(1.0), 4, 0, 1);
        assert_eq!(starts.len(), 4);
        assert_eq!(starts[0], 0);
        assert!(starts.windows(2).all(|pair| pair[0] < pair[1]), "{starts:?}");
    }

    #[test]
    fn cuts_fall_on_coarse_steps() {
        let starts = adaptive(&vec![80.0; 1000], &vec![1.0; 1000], 5, 3, 8);
        assert!(starts.len() == 5 && starts.iter().all(|start| start % 8 == 0), "{starts:?}");
    }

    #[test]
    fn one_segment_is_never_cut() {
        assert_eq!(adaptive(&[1.0; 20], &[0.1; 20], 1, 0, 1), [0]);
        assert!(!Remainder { steps: 20, segments: 1 }.is_cut(19, 10.0));
    }
}
