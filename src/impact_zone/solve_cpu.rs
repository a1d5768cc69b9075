//! CPU twin of `solve.wgsl`, in f64.

use super::problem::{Row, ZoneBatch};
use super::solve::{MOST_INNER, ZoneResult};

/// Multipliers and displacements between two sweeps.
struct Descent<'a> {
    rows: &'a [Row],
    inverse_masses: Vec<f64>,
    first_vertex: u32,
    /// Multipliers: as they stand, and after the sweep before.
    now: Vec<f64>,
    held: Vec<f64>,
    /// Displacements of these multipliers; the last one stands for all vertices that cannot move.
    displaced: Vec<[f64; 3]>,
    displaced_held: Vec<[f64; 3]>,
}

/// Largest changes of a sweep.
#[derive(Default)]
struct Changes {
    /// Of the gap of a row at most, meters.
    largest: f64,
    /// Above 0 where the extrapolation pointed uphill.
    turn: f64,
}

/// Sweeps over the rows of a zone until a sweep over all of them changes no gap by more than the tolerance, or `iterations`
/// times.
pub(super) fn solve(batch: &ZoneBatch, zone: usize, iterations: u32) -> ZoneResult {
    let (tolerance, zone) = (batch.tolerances[zone], &batch.zones[zone]);
    let mut descent = Descent::new(batch, zone);
    let all: Vec<u32> = (0..zone.rows).collect();
    let mut working: Vec<u32> = Vec::new();
    let (mut momentum, mut inner) = (1.0f64, 0u32);
    let mut result = ZoneResult::default();
    while result.iterations < iterations && !result.converged {
        result.iterations += 1;
        if inner == 0 {
            let changes = descent.sweep(&all);
            result.converged = changes.largest <= tolerance;
            working.clear();
            working.extend(all.iter().filter(|&&row| descent.now[row as usize] > 0.0));
            descent.extrapolate(&all, 0.0);
            (momentum, inner) = (1.0, MOST_INNER);
        } else {
            let changes = descent.sweep(&working);
            inner = if changes.largest <= 0.5 * tolerance { 0 } else { inner - 1 };
            // Momentum that points uphill is dropped.
            let dropped = changes.turn > 0.0;
            let following = if dropped { 1.0 } else { 0.5 + (0.25 + momentum * momentum).sqrt() };
            let keep = if dropped || inner == 0 { 0.0 } else { (momentum - 1.0) / following };
            descent.extrapolate(&working, keep);
            momentum = following;
        }
    }
    result.displacements = batch.displacements(zone, &descent.held);
    result.multipliers = batch.as_given(zone, &descent.held);
    result
}

impl<'a> Descent<'a> {
    fn new(batch: &'a ZoneBatch, zone: &super::ZoneSpan) -> Descent<'a> {
        let rows = &batch.rows[zone.row_range()];
        let now: Vec<f64> = rows.iter().map(|row| row.start).collect();
        let mut displaced = batch.displacements(zone, &now);
        displaced.push([0.0; 3]);
        let mut inverse_masses = batch.inverse_masses[zone.vertex_range()].to_vec();
        inverse_masses.push(0.0);
        Descent {
            rows,
            inverse_masses,
            first_vertex: zone.first_vertex,
            held: now.clone(),
            now,
            displaced_held: displaced.clone(),
            displaced,
        }
    }

    /// Each row of `which` in turn takes the multiplier that closes its gap with the others as they are. Rows lie by
    /// color, so this is what the shader does a color at a time.
    fn sweep(&mut self, which: &[u32]) -> Changes {
        let mut changes = Changes::default();
        let fixed = self.inverse_masses.len() - 1;
        for &i in which {
            let row = &self.rows[i as usize];
            let places = row.vertices.map(|v| (v.wrapping_sub(self.first_vertex) as usize).min(fixed));
            let mut gap = 0.0;
            for (&v, w) in places.iter().zip(row.weights) {
                let d = self.displaced[v];
                gap += w * (row.normal[0] * d[0] + row.normal[1] * d[1] + row.normal[2] * d[2]);
            }
            let now = self.now[i as usize];
            if now == 0.0 && gap >= row.target {
                continue;
            }
            let next = (now + (row.target - gap) / row.yielding).max(0.0);
            let by = next - now;
            changes.largest = changes.largest.max(row.yielding * by.abs());
            changes.turn -= row.yielding * by * (next - self.held[i as usize]);
            self.now[i as usize] = next;
            for (&v, w) in places.iter().zip(row.weights) {
                let step = by * w * self.inverse_masses[v];
                let d = &mut self.displaced[v];
                for k in 0..3 {
                    d[k] += step * row.normal[k];
                }
            }
        }
        changes
    }

    /// Goes on by `keep` of what the last sweep and the extrapolation before it changed, in all rows of `which`.
    fn extrapolate(&mut self, which: &[u32], keep: f64) {
        for &i in which {
            let (now, held) = (&mut self.now[i as usize], &mut self.held[i as usize]);
            let next = *now;
            *now = next + keep * (next - *held);
            *held = next;
        }
        for (now, held) in self.displaced.iter_mut().zip(&mut self.displaced_held) {
            let next = *now;
            for k in 0..3 {
                now[k] = next[k] + keep * (next[k] - held[k]);
            }
            *held = next;
        }
    }
}
