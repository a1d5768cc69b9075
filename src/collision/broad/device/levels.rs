//! Nested grids as the shader has them: cells are numbered in the finest grid, and those of a coarser one are shifts of
//! these.

use glam::UVec3;

/// Cells per axis and direction, as in the shader.
pub(super) const REACH: f32 = (1 << 20) as f32;
/// Grids; in the last one everything covers at most two cells per axis.
pub(super) const LEVELS: usize = 11;

/// The cells of the grid `level` that hold cells of the finest one.
pub(super) fn coarser(cell: UVec3, level: usize) -> UVec3 {
    cell >> (2 * level as u32)
}

/// Finest grid in which cells lo..hi are at most two per axis.
pub(super) fn home_of(lo: UVec3, hi: UVec3) -> usize {
    let fits = |level: &usize| (coarser(hi, *level) - coarser(lo, *level)).cmple(UVec3::ONE).all();
    (0..LEVELS - 1).find(fits).unwrap_or(LEVELS - 1)
}
