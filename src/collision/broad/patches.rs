//! Patches: a few dozen neighboring triangles each, which passes over triangles look at first. Which triangles make a
//! patch depends on the mesh alone; `active` fills in their state in a query.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::Vec3A;

use super::boxes::Aabb;
use super::cone::Cone;
use super::mesh::CollisionMesh;

/// Box and cone of a patch in the present query. The same bits whichever rank made it.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
pub(super) struct PatchState {
    lo: [f32; 3],
    hi: [f32; 3],
    pub cone: Cone,
    /// 1 if a triangle may not reside in the finest grid.
    large: u32,
}

impl PatchState {
    /// A patch whose triangles take part within `aabb`.
    pub(super) fn new(aabb: &Aabb, cone: Cone, is_large: bool) -> PatchState {
        PatchState { lo: aabb.lo.to_array(), hi: aabb.hi.to_array(), cone, large: u32::from(is_large) }
    }

    /// Box around the boxes of all triangles that take part; overlaps nothing if there are none.
    pub(super) fn aabb(&self) -> Aabb {
        Aabb { lo: Vec3A::from_array(self.lo), hi: Vec3A::from_array(self.hi) }
    }

    /// True if a triangle of the patch may reside in a coarser grid.
    pub(super) fn is_large(&self) -> bool {
        self.large != 0
    }
}

/// The patches of a mesh, and their state in the present query.
pub(super) struct Patches {
    /// First triangle of every patch, and the end.
    firsts: Vec<u32>,
    /// Patches of cloth; the others are of obstacles.
    cloth: usize,
    pub states: Vec<PatchState>,
    /// Patches with triangles that may be in a pair, ascending.
    pub active: Vec<u32>,
}

impl Patches {
    pub(super) fn new(mesh: &CollisionMesh) -> Patches {
        let firsts = mesh.patches.clone();
        let cloth = firsts.partition_point(|&first| (first as usize) < mesh.cloth_triangles);
        let states = vec![PatchState::zeroed(); firsts.len() - 1];
        Patches { firsts, cloth, states, active: Vec::new() }
    }

    /// Number of patches.
    pub(super) fn count(&self) -> usize {
        self.firsts.len() - 1
    }

    /// Number of cloth patches; they come first.
    pub(super) fn cloth(&self) -> usize {
        self.cloth
    }

    /// Triangles of a patch.
    #[inline(always)]
    pub(super) fn triangles(&self, patch: usize) -> Range<usize> {
        self.firsts[patch] as usize..self.firsts[patch + 1] as usize
    }

    /// Bytes that a query makes.
    pub(super) fn bytes(&self) -> u64 {
        (size_of_val(&self.states[..]) + 4 * self.active.capacity()) as u64
    }

    /// Bytes that depend on the mesh alone.
    pub(super) fn mesh_bytes(&self) -> u64 {
        size_of_val(&self.firsts[..]) as u64
    }
}
