//! Patches: a few dozen neighbouring triangles each, which passes over triangles look at first. Which triangles make a patch
//! depends on the mesh alone; a query finds the box of each and which of them have triangles that may be in a pair.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::Vec3A;

use super::CollisionMesh;
use super::boxes::Aabb;
use super::cull::{Cone, Culling};
use super::input::Input;
use super::split::{Split, even};
use crate::gpu::CpuExecutor;
use crate::mesh::middle;
use crate::transport::TransportError;

/// Most vertices whose triangles make a patch. In the locality order of vertices ([`crate::mesh::vertex_order`]) that many
/// consecutive ones, from one of its own cuts to the next, are neighbours.
const VERTICES: usize = 32;
/// Most boxes that stand for the triangles with touched vertices.
const REACHES: usize = 64;

/// Orders triangles, which are sorted by their smallest vertices, such that each patch is consecutive: the triangles of one
/// piece whose smallest vertex is in one of the parts into which `vertices` are cut as in their order. Adds the end of each to `ends`.
pub(super) fn cut(
    triangles: &mut [[u32; 3]],
    pieces: &[u32],
    vertices: Range<usize>,
    chunk: usize,
    ends: &mut Vec<u32>,
) {
    if vertices.len() > VERTICES {
        let middle = middle(&vertices, chunk);
        cut(triangles, pieces, vertices.start..middle, chunk, ends);
        cut(triangles, pieces, middle..vertices.end, chunk, ends);
        return;
    }
    let smallest = |t: &[u32; 3]| t[0].min(t[1]).min(t[2]) as usize;
    let start = triangles.partition_point(|t| smallest(t) < vertices.start);
    let end = start + triangles[start..].partition_point(|t| smallest(t) < vertices.end);
    let piece = |t: &[u32; 3]| pieces[t[0] as usize];
    triangles[start..end].sort_by_key(piece);
    let mut at = start;
    for patch in triangles[start..end].chunk_by(|a, b| piece(a) == piece(b)) {
        at += patch.len();
        ends.push(at as u32);
    }
}

/// What a query knows of a patch. The same bits whichever rank made it.
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
    /// Holds the boxes of all triangles that take part; overlaps nothing if there are none.
    pub fn aabb(&self) -> Aabb {
        Aabb { lo: Vec3A::from_array(self.lo), hi: Vec3A::from_array(self.hi) }
    }

    /// Whether there may be residents of coarser grids.
    pub fn is_large(&self) -> bool {
        self.large != 0
    }
}

/// The patches of a mesh, and what the present query knows of them.
pub(super) struct Patches {
    /// First triangle of every patch, and the end.
    firsts: Vec<u32>,
    /// Patches of cloth; the others are of obstacles.
    cloth: usize,
    pub states: Vec<PatchState>,
    /// Patches with triangles that may be in a pair, ascending.
    pub active: Vec<u32>,
    /// Made by the first query that culls.
    culling: Option<Culling>,
}

impl Patches {
    pub fn new(mesh: &CollisionMesh) -> Patches {
        let firsts = mesh.patches.clone();
        let cloth = firsts.partition_point(|&first| (first as usize) < mesh.cloth_triangles);
        let states = vec![PatchState::zeroed(); firsts.len() - 1];
        Patches { firsts, cloth, states, active: Vec::new(), culling: None }
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.firsts.len() - 1
    }

    /// How many of them are cloth.
    pub fn cloth(&self) -> usize {
        self.cloth
    }

    /// Triangles of a patch.
    #[inline(always)]
    pub fn triangles(&self, patch: usize) -> Range<usize> {
        self.firsts[patch] as usize..self.firsts[patch + 1] as usize
    }

    /// Finds boxes, and which patches are active. `large` says of a box that it may not reside in the finest grid. Between
    /// ranks: 48 bytes per patch, and at most 4 for what is proven of it.
    pub fn look(
        &mut self,
        cpu: &CpuExecutor,
        input: &Input,
        large: impl Fn(&Aabb) -> bool + Sync,
        split: &mut Split,
    ) -> Result<(), TransportError> {
        let (count, own) = (self.count(), split.part(self.count()));
        let mut states = std::mem::take(&mut self.states);
        cpu.for_ranges_mut(&mut states[own.clone()], 1, 4, |range, out| {
            for (patch, state) in (own.start + range.start..).zip(out) {
                *state = self.state(input, &large, patch);
            }
        });
        let (_, ranks) = split.place();
        split.share(&mut states, |rank| even(rank, ranks, count))?;
        self.states = states;
        self.active.clear();
        if input.choice.touched.is_some() {
            let reaches = self.reaches(input);
            let near = |patch: &usize| {
                let aabb = self.states[*patch].aabb();
                reaches.iter().any(|reach| aabb.overlaps(reach))
            };
            self.active = (0..count).filter(near).map(|patch| patch as u32).collect();
        } else if input.choice.cull {
            let mut culling = match self.culling.take() {
                Some(culling) => culling,
                None => Culling::new(input.mesh, self),
            };
            self.active = culling.active(cpu, input, self, split)?;
            self.culling = Some(culling);
        } else {
            self.active.extend(0..count as u32);
        }
        let states = &self.states;
        self.active.retain(|&patch| !states[patch as usize].aabb().is_empty());
        Ok(())
    }

    fn state(&self, input: &Input, is_large: &impl Fn(&Aabb) -> bool, patch: usize) -> PatchState {
        let (mut all, mut large) = (Aabb::EMPTY, false);
        for triangle in self.triangles(patch) {
            if let Some(aabb) = input.aabb(triangle) {
                all = all.join(aabb);
                large |= is_large(&aabb);
            }
        }
        let culls = input.choice.cull && input.choice.touched.is_none() && patch < self.cloth;
        let cone = if culls { Cone::new(input, self.triangles(patch)) } else { Cone::zeroed() };
        PatchState { lo: all.lo.to_array(), hi: all.hi.to_array(), cone, large: u32::from(large) }
    }

    /// Boxes that hold all triangles with touched vertices.
    fn reaches(&self, input: &Input) -> Vec<Aabb> {
        let mut reaches = Vec::new();
        for patch in 0..self.count() {
            let wanted = self.triangles(patch).filter(|&t| input.tag(t) != 0);
            let mut boxes = wanted.filter_map(|t| input.aabb(t)).peekable();
            if boxes.peek().is_some() {
                reaches.push(boxes.fold(Aabb::EMPTY, Aabb::join));
            }
        }
        let together = reaches.len().div_ceil(REACHES).max(1);
        reaches.chunks(together).map(|some| some.iter().fold(Aabb::EMPTY, |all, one| all.join(*one))).collect()
    }

    /// Bytes of what a query makes.
    pub fn bytes(&self) -> u64 {
        (size_of_val(&self.states[..]) + 4 * self.active.capacity()) as u64
    }

    /// Bytes of what the mesh alone decides.
    pub fn mesh_bytes(&self) -> u64 {
        size_of_val(&self.firsts[..]) as u64 + self.culling.as_ref().map_or(0, Culling::bytes)
    }
}
