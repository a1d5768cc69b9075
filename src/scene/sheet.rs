//! Rectangular sheets of any resolution: irregular with nested levels, or a grid.

use crate::math::Vec2;
use crate::mesh::{NestedSheet, Refinement};

/// Mesh of a sheet.
#[derive(Clone, Debug)]
pub(super) enum SheetMesh {
    /// Irregular triangles, at one level of the sheet.
    Nested { sheet: NestedSheet, level: usize },
    /// A regular grid, which has no levels.
    Grid { grid: Sheet, size_m: [f64; 2] },
}

impl SheetMesh {
    /// Material coordinates of the vertices: x = warp to the right, y = weft upwards, origin at the bottom left corner.
    pub(super) fn coordinates(&self) -> Vec<Vec2> {
        match self {
            SheetMesh::Nested { sheet, level } => sheet.coordinates(*level),
            SheetMesh::Grid { grid, size_m } => grid.coordinates(*size_m),
        }
    }

    /// The triangles, counter-clockwise.
    pub(super) fn triangle_corners(&self) -> Vec<[u32; 3]> {
        match self {
            SheetMesh::Nested { sheet, level } => sheet.triangles(*level).to_vec(),
            SheetMesh::Grid { grid, .. } => grid.triangle_corners(),
        }
    }

    /// To the finest level.
    pub(super) fn refinement(&self) -> Refinement {
        match self {
            SheetMesh::Nested { sheet, level } => sheet.refinement(*level),
            SheetMesh::Grid { grid, .. } => {
                let vertices = (grid.columns as usize + 1) * (grid.rows as usize + 1);
                Refinement::none(vertices, grid.triangles() as usize)
            }
        }
    }

    /// True if the sheet has corners and sides; a round one has none.
    pub(super) fn has_sides(&self) -> bool {
        match self {
            SheetMesh::Nested { sheet, .. } => sheet.is_rectangle(),
            SheetMesh::Grid { .. } => true,
        }
    }

    /// The vertex at a corner of a sheet that has them.
    pub(super) fn corner(&self, right: bool, top: bool) -> u32 {
        match self {
            SheetMesh::Nested { .. } => u32::from(right) + 2 * u32::from(top),
            SheetMesh::Grid { grid, .. } => {
                grid.vertex(if right { grid.columns } else { 0 }, if top { grid.rows } else { 0 })
            }
        }
    }

    /// The vertices along the left side (`axis` 0) or the bottom (1), or those opposite if `far`; from left to right or
    /// from bottom to top.
    pub(super) fn side(&self, axis: usize, far: bool) -> Vec<u32> {
        match self {
            SheetMesh::Nested { sheet, level } => sheet.side(*level, axis, far),
            SheetMesh::Grid { grid, .. } if axis == 0 => {
                (0..=grid.rows).map(|row| grid.vertex(if far { grid.columns } else { 0 }, row)).collect()
            }
            SheetMesh::Grid { grid, .. } => {
                (0..=grid.columns).map(|column| grid.vertex(column, if far { grid.rows } else { 0 })).collect()
            }
        }
    }
}

/// A grid of `columns` x `rows` cells of two triangles each. Vertices are numbered row by row from the bottom left
/// corner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sheet {
    /// Cells along the first side (u, warp).
    pub columns: u32,
    /// Cells along the second side (v, weft).
    pub rows: u32,
}

/// The grid for a sheet of this size that has nearly square cells and about `triangles` triangles.
pub fn sheet_cells(size_m: [f64; 2], triangles: u64) -> Sheet {
    let cells = (triangles as f64 / 2.0).max(1.0);
    let most = u32::MAX / 4;
    // There are never more rows than cells; otherwise a narrow sheet would exceed the requested number of triangles.
    let rows = (cells * size_m[1] / size_m[0]).sqrt().clamp(1.0, cells.min(f64::from(most)));
    // Of the two nearest numbers of rows, the one whose best number of columns is closer to the requested number of
    // cells is taken.
    let complete = |rows: f64| {
        let rows = rows.max(1.0);
        Sheet { columns: (cells / rows).round().clamp(1.0, f64::from(most)) as u32, rows: rows as u32 }
    };
    let miss = |sheet: &Sheet| (f64::from(sheet.columns) * f64::from(sheet.rows) - cells).abs();
    let (fewer, more) = (complete(rows.floor()), complete(rows.ceil()));
    if miss(&more) < miss(&fewer) { more } else { fewer }
}

impl Sheet {
    /// Number of triangles.
    pub fn triangles(&self) -> u64 {
        2 * u64::from(self.columns) * u64::from(self.rows)
    }

    /// Index of the vertex at a grid point.
    pub fn vertex(&self, column: u32, row: u32) -> u32 {
        row * (self.columns + 1) + column
    }

    /// Material coordinates of the vertices: x = warp to the right, y = weft upwards, origin at the bottom left corner.
    pub fn coordinates(&self, size_m: [f64; 2]) -> Vec<Vec2> {
        let at = |i: u32, n: u32, size: f64| (size * f64::from(i) / f64::from(n)) as f32;
        let points = (0..=self.rows).flat_map(|row| (0..=self.columns).map(move |column| (column, row)));
        points
            .map(|(column, row)| Vec2::new(at(column, self.columns, size_m[0]), at(row, self.rows, size_m[1])))
            .collect()
    }

    /// The triangles. The direction of the diagonals alternates from row to row: every inner vertex has six neighbors
    /// (so matrix rows have equal length), yet the sheet has no stiffer diagonal direction.
    pub fn triangle_corners(&self) -> Vec<[u32; 3]> {
        let mut triangles = Vec::with_capacity(self.triangles() as usize);
        for row in 0..self.rows {
            for column in 0..self.columns {
                let (a, b) = (self.vertex(column, row), self.vertex(column + 1, row));
                let (d, c) = (self.vertex(column, row + 1), self.vertex(column + 1, row + 1));
                triangles.extend(if row % 2 == 0 { [[a, b, c], [a, c, d]] } else { [[a, b, d], [b, c, d]] });
            }
        }
        triangles
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_narrowest_strips_have_the_triangles_asked_for() {
        for size_m in [[1e-30, 1e30], [1e30, 1e-30], [1.0, 1e9]] {
            let triangles = sheet_cells(size_m, 10_000).triangles();
            assert!((9_000..=11_000).contains(&triangles), "{size_m:?}: {triangles}");
        }
    }

    #[test]
    fn two_by_two_cells() {
        let sheet = Sheet { columns: 2, rows: 2 };
        assert_eq!(
            sheet.triangle_corners(),
            [[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [3, 4, 6], [4, 7, 6], [4, 5, 7], [5, 8, 7]]
        );
        assert_eq!(sheet.coordinates([4.0, 2.0])[5], Vec2::new(4.0, 1.0));
    }

    #[test]
    fn the_number_of_triangles_is_met_and_cells_are_nearly_square() {
        for triangles in [1_000, 1_234, 10_000, 77_777, 500_000, 1_200_000] {
            for size_m in [[3.0, 2.0], [1.0, 1.0], [2.0, 5.0]] {
                let sheet = sheet_cells(size_m, triangles);
                let error = sheet.triangles() as f64 / triangles as f64 - 1.0;
                assert!(error.abs() < 0.03, "{triangles} {size_m:?}: {sheet:?} is off by {error}");
                let aspect = size_m[0] / f64::from(sheet.columns) / (size_m[1] / f64::from(sheet.rows));
                assert!((aspect - 1.0).abs() < 0.1, "{triangles} {size_m:?}: {sheet:?}");
            }
        }
        assert_eq!(sheet_cells([1.0, 1.0], 2), Sheet { columns: 1, rows: 1 });
        assert_eq!(sheet_cells([100.0, 0.01], 200), Sheet { columns: 100, rows: 1 });
    }
}
