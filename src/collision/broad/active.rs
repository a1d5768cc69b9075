//! Which patches take part in a query: those near touched vertices, those that culling cannot leave out, or all.
//! Promises the same to every rank.

use bytemuck::Zeroable;

use super::boxes::Aabb;
use super::cone::Cone;
use super::cull::Culling;
use super::input::Input;
use super::mesh::CollisionMesh;
use super::patches::{PatchState, Patches};
use super::split::{Split, even};
use crate::gpu::CpuExecutor;
use crate::transport::TransportError;

/// Largest number of boxes that cover the triangles with touched vertices.
const REACHES: usize = 64;

/// The patches of a mesh and what chooses among them.
pub(super) struct ActivePatches {
    pub patches: Patches,
    /// Made by the first query that culls.
    culling: Option<Culling>,
}

impl ActivePatches {
    pub(super) fn new(mesh: &CollisionMesh) -> ActivePatches {
        ActivePatches { patches: Patches::new(mesh), culling: None }
    }

    /// Computes the boxes of patches and chooses the active ones. `large(box)` is true for a triangle that may not
    /// reside in the finest grid. Moves 48 bytes per patch between ranks, and at most 4 for the result of culling.
    ///
    /// # Errors
    /// Another rank is not heard.
    pub(super) fn find(
        &mut self,
        cpu: &CpuExecutor,
        input: &Input,
        large: impl Fn(&Aabb) -> bool + Sync,
        split: &mut Split,
    ) -> Result<(), TransportError> {
        let ActivePatches { patches, culling } = self;
        let (count, own) = (patches.count(), split.part(patches.count()));
        let mut states = std::mem::take(&mut patches.states);
        cpu.for_ranges_mut(&mut states[own.clone()], 1, 4, |range, out| {
            for (patch, state) in (own.start + range.start..).zip(out) {
                *state = state_of(patches, input, &large, patch);
            }
        });
        let (_, ranks) = split.place();
        split.share(&mut states, |rank| even(rank, ranks, count))?;
        patches.states = states;
        patches.active.clear();
        if input.choice.touched.is_some() {
            let reaches = reaches(patches, input);
            let near = |patch: &usize| {
                let aabb = patches.states[*patch].aabb();
                reaches.iter().any(|reach| aabb.overlaps(reach))
            };
            patches.active = (0..count).filter(near).map(|patch| patch as u32).collect();
        } else if input.choice.cull {
            let culling = culling.get_or_insert_with(|| Culling::new(input.mesh, patches));
            patches.active = culling.active(cpu, input, patches, split)?;
        } else {
            patches.active.extend(0..count as u32);
        }
        let states = &patches.states;
        patches.active.retain(|&patch| !states[patch as usize].aabb().is_empty());
        Ok(())
    }

    /// Bytes that depend on the mesh alone.
    pub(super) fn mesh_bytes(&self) -> u64 {
        self.patches.mesh_bytes() + self.culling.as_ref().map_or(0, Culling::bytes)
    }
}

fn state_of(patches: &Patches, input: &Input, is_large: &impl Fn(&Aabb) -> bool, patch: usize) -> PatchState {
    let (mut all, mut large) = (Aabb::EMPTY, false);
    for triangle in patches.triangles(patch) {
        if let Some(aabb) = input.aabb(triangle) {
            all = all.join(aabb);
            large |= is_large(&aabb);
        }
    }
    let culls = input.choice.cull && input.choice.touched.is_none() && patch < patches.cloth();
    let cone = if culls { Cone::new(input, patches.triangles(patch)) } else { Cone::zeroed() };
    PatchState::new(&all, cone, large)
}

/// Boxes that together contain all triangles with touched vertices.
fn reaches(patches: &Patches, input: &Input) -> Vec<Aabb> {
    let mut reaches = Vec::new();
    for patch in 0..patches.count() {
        let wanted = patches.triangles(patch).filter(|&t| input.tag(t) != 0);
        let mut boxes = wanted.filter_map(|t| input.aabb(t)).peekable();
        if boxes.peek().is_some() {
            reaches.push(boxes.fold(Aabb::EMPTY, Aabb::join));
        }
    }
    let together = reaches.len().div_ceil(REACHES).max(1);
    reaches.chunks(together).map(|some| some.iter().fold(Aabb::EMPTY, |all, one| all.join(*one))).collect()
}
