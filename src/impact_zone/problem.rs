//! The quadratic problems of zones as flat arrays, which kernels run on: rows (constraints) over displacements from the
//! positions that the zone would have without impacts.

use std::ops::Range;

use crate::math::DVec3;

/// In place of a vertex that cannot move.
pub const IMMOVABLE: u32 = u32::MAX;

/// A constraint `normal . sum(weights[i] * d[vertices[i]]) >= target` on displacements d.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Unit vector.
    pub normal: [f64; 3],
    /// What is missing to the margin without displacements, metres; negative if it is kept.
    pub target: f64,
    /// Weights of the vertices; 0 for those that cannot move.
    pub weights: [f64; 4],
    /// Vertices of the batch; [`IMMOVABLE`] for those that cannot move.
    pub vertices: [u32; 4],
    /// Sum of the magnitudes of the row's couplings, 1/(unit of mass): steps of 1 / bound never overshoot.
    pub bound: f64,
    /// Multiplier to begin with, in units of its own, 0 or more.
    pub start: f64,
}

/// Where a zone's parts lie in the batch's arrays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ZoneSpan {
    /// First vertex.
    pub first_vertex: u32,
    /// Number of vertices.
    pub vertices: u32,
    /// First row.
    pub first_row: u32,
    /// Number of rows.
    pub rows: u32,
}

impl ZoneSpan {
    /// Its vertices in the batch.
    pub fn vertex_range(&self) -> Range<usize> {
        self.first_vertex as usize..(self.first_vertex + self.vertices) as usize
    }

    /// Its rows in the batch.
    pub fn row_range(&self) -> Range<usize> {
        self.first_row as usize..(self.first_row + self.rows) as usize
    }
}

/// Zones to be solved, each on its own: nothing of one depends on which others are in the batch.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// Zones, in order.
    pub zones: Vec<ZoneSpan>,
    /// Per zone: error of a constraint that ends its descent, metres.
    pub tolerances: Vec<f64>,
    /// Per vertex, in units of the largest one of the zone.
    pub inverse_masses: Vec<f64>,
    /// Per vertex and one more: where its entries begin in `gather`.
    pub gather_offsets: Vec<u32>,
    /// Per vertex, ascending: 4 * row + place of the vertex in it.
    pub gather: Vec<u32>,
    /// Constraints.
    pub rows: Vec<Row>,
}

impl Batch {
    /// Nothing to solve.
    pub fn new() -> Batch {
        Batch { gather_offsets: vec![0], ..Batch::default() }
    }

    /// Adds a zone. `inverse_masses` are those of its vertices, all above 0; rows count vertices from 0 within the zone,
    /// their bounds are filled here. A row that moves nothing is left out.
    pub fn push(&mut self, inverse_masses: &[f64], rows: impl IntoIterator<Item = Row>, tolerance_m: f64) {
        let (first_vertex, first_row) = (self.inverse_masses.len() as u32, self.rows.len() as u32);
        let largest = inverse_masses.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        self.inverse_masses.extend(inverse_masses.iter().map(|m| m / largest));
        self.rows.extend(rows.into_iter().filter(Row::moves));
        let mut entries: Vec<Vec<u32>> = vec![Vec::new(); inverse_masses.len()];
        let mut weight_sums = vec![0.0f64; inverse_masses.len()];
        for (i, row) in self.rows.iter_mut().enumerate().skip(first_row as usize) {
            for k in 0..4 {
                if row.vertices[k] == IMMOVABLE {
                    row.weights[k] = 0.0;
                } else {
                    let local = row.vertices[k] as usize;
                    weight_sums[local] += row.weights[k].abs();
                    entries[local].push(4 * i as u32 + k as u32);
                    row.vertices[k] += first_vertex;
                }
            }
        }
        for row in &mut self.rows[first_row as usize..] {
            let coupling = |(&v, w): (&u32, f64)| match v {
                IMMOVABLE => 0.0,
                v => w.abs() * self.inverse_masses[v as usize] * weight_sums[(v - first_vertex) as usize],
            };
            row.bound = row.vertices.iter().zip(row.weights).map(coupling).sum();
        }
        for list in entries {
            self.gather.extend(list);
            self.gather_offsets.push(self.gather.len() as u32);
        }
        self.zones.push(ZoneSpan {
            first_vertex,
            vertices: inverse_masses.len() as u32,
            first_row,
            rows: self.rows.len() as u32 - first_row,
        });
        self.tolerances.push(tolerance_m);
    }
}

impl Row {
    /// The row of a pair: `positions` without displacements, places in the zone (or [`IMMOVABLE`]).
    pub(super) fn new(
        normal: DVec3,
        weights: [f64; 4],
        vertices: [u32; 4],
        positions: [DVec3; 4],
        margin_m: f64,
    ) -> Row {
        let offset: DVec3 = positions.iter().zip(weights).map(|(&x, w)| x * w).sum();
        Row {
            normal: normal.to_array(),
            target: margin_m - normal.dot(offset),
            weights,
            vertices,
            bound: 0.0,
            start: 0.0,
        }
    }

    /// Whether any displacement changes it.
    pub(super) fn moves(&self) -> bool {
        self.vertices.iter().zip(self.weights).any(|(&v, w)| v != IMMOVABLE && w != 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zones_lie_one_behind_the_other() {
        let row = |vertices| Row {
            normal: [0.0, 0.0, 1.0],
            target: 1.0,
            weights: [1.0, -0.5, -0.25, -0.25],
            vertices,
            bound: 0.0,
            start: 0.0,
        };
        let mut batch = Batch::new();
        batch.push(&[2.0, 1.0], [row([0, 1, IMMOVABLE, IMMOVABLE]), row([1, 0, IMMOVABLE, IMMOVABLE])], 1e-6);
        batch.push(&[4.0], [row([IMMOVABLE; 4]), row([IMMOVABLE, IMMOVABLE, 0, IMMOVABLE])], 1e-6);
        assert_eq!(batch.inverse_masses, [1.0, 0.5, 1.0]);
        assert_eq!(batch.gather_offsets, [0, 2, 4, 5]);
        assert_eq!(batch.gather, [0, 5, 1, 4, 10]);
        let second = ZoneSpan { first_vertex: 2, vertices: 1, first_row: 2, rows: 1 };
        assert_eq!(batch.zones, [ZoneSpan { first_vertex: 0, vertices: 2, first_row: 0, rows: 2 }, second]);
        assert_eq!(batch.rows[2].weights, [0.0, 0.0, -0.25, 0.0]);
        let bounds: Vec<f64> = batch.rows.iter().map(|r| r.bound).collect();
        assert_eq!(bounds, [1.0 * 1.5 + 0.5 * 0.5 * 1.5, 0.5 * 1.5 + 0.5 * 1.5, 0.25 * 0.25]);
    }
}
