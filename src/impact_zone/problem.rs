//! The quadratic problems of zones as flat arrays, which kernels run on: rows (constraints) over displacements from the
//! positions that the zone would have without impacts.

use std::ops::Range;

use crate::math::DVec3;

/// In place of a vertex that cannot move.
pub(super) const IMMOVABLE: u32 = u32::MAX;

/// A constraint `normal . sum(weights[i] * d[vertices[i]]) >= target` on displacements d.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Row {
    /// Unit vector from the second part of the pair to the first.
    pub normal: [f64; 3],
    /// Distance that the pair lacks to its margin without displacements, meters; negative if the margin is kept.
    pub target: f64,
    /// Weights of the vertices; 0 for those that cannot move.
    pub weights: [f64; 4],
    /// Vertices of the batch; `IMMOVABLE` for those that cannot move.
    pub vertices: [u32; 4],
    /// Change of the row's own gap per unit of its multiplier, 1/(unit of mass). It is set larger for rows whose
    /// vertices have hardly any weight, so that one update does not throw them far.
    pub yielding: f64,
    /// Initial multiplier, 0 or more.
    pub start: f64,
}

/// Lower bound of a row's `yielding`, relative to a row with weights of 1.
const LEAST_YIELDING: f64 = 1e-6;

/// Places of a zone's parts in the batch's arrays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ZoneSpan {
    /// Place of the zone's first vertex in the batch.
    pub first_vertex: u32,
    /// Movable vertices of the zone.
    pub vertices: u32,
    /// Place of the zone's first row in the batch.
    pub first_row: u32,
    /// Constraints of the zone that move anything.
    pub rows: u32,
    /// First entry in the batch's list of colors.
    pub first_color: u32,
    /// Number of colors; the list has an entry for each and one more.
    pub colors: u32,
}

impl ZoneSpan {
    /// Places of its vertices in the batch.
    pub fn vertex_range(&self) -> Range<usize> {
        self.first_vertex as usize..(self.first_vertex + self.vertices) as usize
    }

    /// Places of its rows in the batch.
    pub fn row_range(&self) -> Range<usize> {
        self.first_row as usize..(self.first_row + self.rows) as usize
    }
}

/// Zones to be solved. The result of a zone does not depend on the others in the batch.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ZoneBatch {
    /// Per zone, in the order of [`ZoneBatch::push`]: its parts of the other lists.
    pub zones: Vec<ZoneSpan>,
    /// Per zone: error of a constraint that ends its descent, meters.
    pub tolerances: Vec<f64>,
    /// Per vertex, in units of the largest one of the zone.
    pub inverse_masses: Vec<f64>,
    /// Constraints, per zone by color: those of one color have no movable vertex in common.
    pub rows: Vec<Row>,
    /// Per row: its number among the rows that its zone was given and that move anything.
    pub given: Vec<u32>,
    /// Per zone and color the first of its rows, and per zone the end of its rows.
    pub colors: Vec<u32>,
}

impl ZoneBatch {
    /// A batch without zones.
    pub fn new() -> ZoneBatch {
        ZoneBatch::default()
    }

    /// Adds a zone. `inverse_masses` are those of its vertices, all above 0; rows count vertices from 0 within the zone,
    /// what they yield is filled here. A row that moves nothing is left out.
    pub fn push(&mut self, inverse_masses: &[f64], rows: impl IntoIterator<Item = Row>, tolerance_m: f64) {
        let (first_vertex, first_row) = (self.inverse_masses.len() as u32, self.rows.len() as u32);
        let largest = inverse_masses.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        self.inverse_masses.extend(inverse_masses.iter().map(|m| m / largest));
        let mut rows: Vec<Row> = rows.into_iter().filter(Row::moves).collect();
        let (order, ends) = by_color(inverse_masses.len(), &rows);
        for row in &mut rows {
            row.yielding = 0.0;
            let mut least = 0.0f64;
            for (v, w) in row.vertices.iter_mut().zip(&mut row.weights) {
                if *v == IMMOVABLE {
                    *w = 0.0;
                } else {
                    *v += first_vertex;
                    row.yielding += *w * *w * self.inverse_masses[*v as usize];
                    least = least.max(LEAST_YIELDING * self.inverse_masses[*v as usize]);
                }
            }
            row.yielding = row.yielding.max(least);
        }
        self.zones.push(ZoneSpan {
            first_vertex,
            vertices: inverse_masses.len() as u32,
            first_row,
            rows: rows.len() as u32,
            first_color: self.colors.len() as u32,
            colors: ends.len() as u32,
        });
        self.rows.extend(order.iter().map(|&i| rows[i as usize]));
        self.given.extend(order);
        self.colors.push(first_row);
        self.colors.extend(ends.iter().map(|end| first_row + end));
        self.tolerances.push(tolerance_m);
    }

    /// Displacements of a zone's vertices that belong to `multipliers` of its rows, in their order here: M^-1 A^T y, a sum of
    /// internal forces.
    pub(super) fn displacements(&self, zone: &ZoneSpan, multipliers: &[f64]) -> Vec<[f64; 3]> {
        let mut displacements = vec![[0.0f64; 3]; zone.vertices as usize];
        let rows = &self.rows[zone.row_range()];
        for (row, multiplier) in rows.iter().zip(multipliers).filter(|(_, multiplier)| **multiplier != 0.0) {
            for (&v, w) in row.vertices.iter().zip(row.weights).filter(|(v, _)| **v != IMMOVABLE) {
                let sum = &mut displacements[(v - zone.first_vertex) as usize];
                for k in 0..3 {
                    sum[k] += w * multiplier * row.normal[k];
                }
            }
        }
        for (d, inverse_mass) in displacements.iter_mut().zip(&self.inverse_masses[zone.vertex_range()]) {
            *d = d.map(|sum| sum * inverse_mass);
        }
        displacements
    }

    /// Values per row in the order in which the zone was given its rows.
    pub(super) fn as_given(&self, zone: &ZoneSpan, of_rows: &[f64]) -> Vec<f64> {
        let mut given = vec![0.0; of_rows.len()];
        for (&place, &value) in self.given[zone.row_range()].iter().zip(of_rows) {
            given[place as usize] = value;
        }
        given
    }
}

/// The smallest color, row by row, that none of the row's vertices has yet: rows by color, each color ascending, and
/// the ends of the colors.
fn by_color(vertices: usize, rows: &[Row]) -> (Vec<u32>, Vec<u32>) {
    // Colors of every vertex, 64 to a word.
    let mut taken: Vec<Vec<u64>> = vec![Vec::new(); vertices];
    let mut ends: Vec<u32> = Vec::new();
    let mut colors = Vec::with_capacity(rows.len());
    for row in rows {
        let own = || row.vertices.into_iter().filter(|&v| v != IMMOVABLE).map(|v| v as usize);
        let of_word = |taken: &[Vec<u64>], word: usize| {
            own().map(|v| taken[v].get(word).copied().unwrap_or(0)).fold(0, std::ops::BitOr::bitor)
        };
        let (mut word, mut used) = (0, of_word(&taken, 0));
        while used == u64::MAX {
            word += 1;
            used = of_word(&taken, word);
        }
        for v in own() {
            let words = taken[v].len().max(word + 1);
            taken[v].resize(words, 0);
            taken[v][word] |= 1 << used.trailing_ones();
        }
        let color = 64 * word + used.trailing_ones() as usize;
        if color == ends.len() {
            ends.push(0);
        }
        ends[color] += 1;
        colors.push(color);
    }
    let mut next: Vec<u32> = Vec::with_capacity(ends.len());
    let mut end = 0;
    for count in &mut ends {
        next.push(end);
        end += *count;
        *count = end;
    }
    let mut order = vec![0; rows.len()];
    for (i, color) in colors.into_iter().enumerate() {
        order[next[color] as usize] = i as u32;
        next[color] += 1;
    }
    (order, ends)
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
            yielding: 0.0,
            start: 0.0,
        }
    }

    /// True if any displacement changes it.
    pub(super) fn moves(&self) -> bool {
        self.vertices.iter().zip(self.weights).any(|(&v, w)| v != IMMOVABLE && w != 0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(vertices: [u32; 4]) -> Row {
        Row {
            normal: [0.0, 0.0, 1.0],
            target: 1.0,
            weights: [1.0, -0.5, -0.25, -0.25],
            vertices,
            yielding: 0.0,
            start: 0.0,
        }
    }

    const NO: u32 = IMMOVABLE;

    #[test]
    fn zones_lie_one_behind_the_other() {
        let mut batch = ZoneBatch::new();
        batch.push(&[2.0, 1.0], [row([0, 1, NO, NO]), row([1, 0, NO, NO])], 1e-6);
        batch.push(&[4.0], [row([NO; 4]), row([NO, NO, 0, NO])], 1e-6);
        assert_eq!(batch.inverse_masses, [1.0, 0.5, 1.0]);
        let first = ZoneSpan { first_vertex: 0, vertices: 2, first_row: 0, rows: 2, first_color: 0, colors: 2 };
        let second = ZoneSpan { first_vertex: 2, vertices: 1, first_row: 2, rows: 1, first_color: 3, colors: 1 };
        assert_eq!(batch.zones, [first, second]);
        assert_eq!(batch.colors, [0, 1, 2, 2, 3]);
        assert_eq!(batch.rows[2].weights, [0.0, 0.0, -0.25, 0.0]);
        let yielding: Vec<f64> = batch.rows.iter().map(|r| r.yielding).collect();
        assert_eq!(yielding, [1.0 + 0.25 * 0.5, 0.5 + 0.25, 0.0625]);
        let light = Row { weights: [1e-9, -1.0, 0.0, 0.0], ..row([0, NO, NO, NO]) };
        batch.push(&[4.0], [light], 1e-6);
        assert_eq!(batch.rows[3].yielding, 1e-6);
        let pushed = batch.displacements(&first, &[4.0, 1.0]);
        assert_eq!(pushed, [[0.0, 0.0, 4.0 - 0.5], [0.0, 0.0, 0.5 * (1.0 - 2.0)]]);
    }

    #[test]
    fn rows_of_a_color_share_no_vertex() {
        let mut batch = ZoneBatch::new();
        // Two that could go together, one that touches both, and so many of one vertex that a word of colors is too
        // small.
        let mut rows = vec![row([0, 1, NO, NO]), row([1, 2, NO, NO]), row([2, 3, NO, NO])];
        rows.extend(std::iter::repeat_n(row([4, NO, NO, NO]), 70));
        batch.push(&[1.0; 5], rows, 1e-6);
        assert_eq!(batch.zones[0].colors, 70);
        assert_eq!(batch.colors[..4], [0, 3, 5, 6]);
        assert_eq!(batch.given[..5], [0, 2, 3, 1, 4]);
        assert_eq!(batch.rows[3].vertices, [1, 2, NO, NO]);
        let numbers: Vec<f64> = batch.given.iter().map(|&i| f64::from(i)).collect();
        let given = batch.as_given(&batch.zones[0], &numbers);
        assert_eq!(given, (0..73).map(f64::from).collect::<Vec<_>>());
    }
}
