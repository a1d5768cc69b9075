//! CPU twin of `solve.wgsl`, in f64.

use super::problem::{IMMOVABLE, Row, ZoneSpan};
use super::solve::ZoneResult;

/// Descends one zone until no multiplier changes by more than the tolerance, or `iterations` times.
pub fn solve(zone: &ZoneSpan, tolerance: f64, inverse_masses: &[f64], rows: &[Row], iterations: u32) -> ZoneResult {
    let first_vertex = zone.first_vertex as usize;
    let count = zone.rows as usize;
    let rows = &rows[zone.row_range()];
    let mut held: Vec<f64> = rows.iter().map(|row| row.start).collect();
    let (mut tried, mut next) = (held.clone(), vec![0.0f64; count]);
    let mut displacements = vec![[0.0f64; 3]; zone.vertices as usize];
    // Row by row, which adds up in the order of the shader's lists: rows lie in the order they are read.
    let displace = |displacements: &mut [[f64; 3]], multipliers: &[f64]| {
        displacements.fill([0.0; 3]);
        for (row, multiplier) in rows.iter().zip(multipliers).filter(|(_, multiplier)| **multiplier != 0.0) {
            for (&v, w) in row.vertices.iter().zip(row.weights).filter(|(v, _)| **v != IMMOVABLE) {
                let factor = w * multiplier;
                let sum = &mut displacements[v as usize - first_vertex];
                for k in 0..3 {
                    sum[k] += factor * row.normal[k];
                }
            }
        }
        for (d, inverse_mass) in displacements.iter_mut().zip(&inverse_masses[zone.vertex_range()]) {
            *d = d.map(|sum| sum * inverse_mass);
        }
    };
    let mut momentum = 1.0f64;
    let mut result = ZoneResult::default();
    while result.iterations < iterations && !result.converged {
        displace(&mut displacements, &tried);
        let (mut change, mut turn) = (0.0f64, 0.0f64);
        for (i, row) in rows.iter().enumerate() {
            let mut gap = 0.0;
            for (&v, w) in row.vertices.iter().zip(row.weights) {
                if v != IMMOVABLE {
                    let d = displacements[v as usize - first_vertex];
                    gap += w * (row.normal[0] * d[0] + row.normal[1] * d[1] + row.normal[2] * d[2]);
                }
            }
            next[i] = (tried[i] + (row.target - gap) / row.bound).max(0.0);
            change = change.max(row.bound * (next[i] - tried[i]).abs());
            turn += row.bound * (tried[i] - next[i]) * (next[i] - held[i]);
        }
        result.iterations += 1;
        result.converged = change <= tolerance;
        // Momentum that points uphill is dropped.
        let following = if turn > 0.0 { 1.0 } else { 0.5 + (0.25 + momentum * momentum).sqrt() };
        let keep = if turn > 0.0 { 0.0 } else { (momentum - 1.0) / following };
        for i in 0..count {
            tried[i] = next[i] + keep * (next[i] - held[i]);
            held[i] = next[i];
        }
        momentum = following;
    }
    displace(&mut displacements, &held);
    result.displacements = displacements;
    result.multipliers = held;
    result
}
