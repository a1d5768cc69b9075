//! Input of the passes of a query: mesh, paths, grids, and boxes of triangles. The same on every rank.

use super::boxes::{Aabb, Trajectories};
use super::grid::{Grid, WANTED};
use super::mesh::CollisionMesh;
use super::query::Choice;

/// Mesh, paths and grids of one query.
pub(super) struct Input<'a> {
    pub mesh: &'a CollisionMesh,
    pub paths: Trajectories<'a>,
    pub grid: Grid,
    /// Pairs that the query leaves out.
    pub choice: Choice<'a>,
    /// Obstacles are cut to these bounds.
    cloth: Aabb,
}

impl<'a> Input<'a> {
    pub(super) fn new(mesh: &'a CollisionMesh, paths: Trajectories<'a>, choice: Choice<'a>) -> Input<'a> {
        let grid = Grid::new(mesh, &paths);
        let cloth = paths.cloth_bounds(mesh);
        Input { mesh, paths, grid, choice, cloth }
    }

    /// [`WANTED`], or 0 for a triangle that is of interest only as partner of such a one.
    #[inline(always)]
    pub(super) fn tag(&self, triangle: usize) -> u32 {
        let Some(touched) = self.choice.touched else { return WANTED };
        let [a, b, c] = self.mesh.triangles[triangle];
        if touched[a as usize] | touched[b as usize] | touched[c as usize] { WANTED } else { 0 }
    }

    /// Box of a triangle; that of an obstacle is cut to the cloth's bounds, which changes no intersection with cloth.
    /// None for an obstacle's triangle that cannot meet cloth.
    #[inline(always)]
    pub(super) fn aabb(&self, triangle: usize) -> Option<Aabb> {
        let aabb = self.paths.triangle(self.mesh.triangles[triangle]);
        if triangle < self.mesh.cloth_triangles {
            return Some(aabb);
        }
        aabb.overlaps(&self.cloth).then(|| aabb.clip(&self.cloth))
    }

    /// Bounds of the cloth.
    pub(super) fn cloth_bounds(&self) -> Aabb {
        self.cloth
    }

    /// 0 for cloth, 1 for obstacles.
    #[inline(always)]
    pub(super) fn role(&self, triangle: usize) -> usize {
        usize::from(triangle >= self.mesh.cloth_triangles)
    }
}
