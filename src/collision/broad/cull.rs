//! Self-collision culling [Tang et al. 2018a; Volino and Magnenat-Thalmann 1994]: patches of cloth that provably touch
//! neither themselves nor the patches around them take no part in a query, unless something else comes near.
//!
//! What is proven is about the union of a patch and all patches that share a vertex with it. Seen along one fixed direction
//! d, at every time of the step:
//!
//! 1. **Normals.** Every triangle faces d, and its altitudes, seen along d, exceed a margin m. A triangle's normal is
//!    quadratic in time, so it lies in the cone of its three Bernstein coefficients [Tang et al. 2009]; one cone per patch.
//! 2. **Contour.** The boundary of the union is one closed polygon in which edges without a common vertex stay farther apart
//!    than m, and so do, of two that share one, the far end of each and the other. "Apart" means that both ends of the step
//!    have them on the same sides of one fixed axis, farther apart than m: along an axis, distances are linear in time.
//!
//! By 2 the contour winds around no point more than once; by 1 every triangle covers the points it is projected to once and
//! with the same sign. The number of triangles over a point is the winding number of the contour (the boundary of a sum of
//! triangles is the sum of their boundaries), hence at most 1: the projection is a planar triangulation without overlap.
//! Normals alone do not do: a strip that winds like a helix faces its axis everywhere.
//!
//! In such a triangulation a vertex v and a face or edge without v are farther apart than m. The shortest way between them
//! leaves the triangles around v through an edge opposite v, that is by an altitude of one of them; or it leaves the union
//! through its contour and comes back through another part of it. Two edges without a common vertex are closest at an end of
//! one. Distances in space are no shorter than seen along d. With m the query's radius within pieces this serves proximity;
//! with radius 0 m is what rounding takes and it serves continuous detection.
//!
//! A patch is left out if all pairs of its triangles with triangles that are near are proven apart in this way. Says nothing
//! of patches that are not left out.

use glam::Vec3A;

use super::cone::ROUNDING;
use super::contour::{Contour, outline, polygon};
use super::input::Input;
use super::mesh::CollisionMesh;
use super::patches::Patches;
use super::split::{Split, even};
use crate::gpu::CpuExecutor;
use crate::transport::TransportError;

/// In place of a second patch: the first one is active whatever the second is.
const ALONE: u32 = u32::MAX;

/// Tables that depend on the mesh alone: the patches around every patch of cloth, and the contour of their union.
pub(super) struct Culling {
    /// First of `around` of every patch, and the end.
    firsts: Vec<u32>,
    /// Patches that share a vertex with the patch, itself among them, ascending.
    around: Vec<u32>,
    /// First of `contours` of every patch, and the end. Empty where the union has no contour of one closed polygon.
    contour_firsts: Vec<u32>,
    contours: Vec<u32>,
    /// Patches whose unions together hold every patch together with each one around it, ascending.
    chosen: Vec<u32>,
    /// All patches in the order of the last query along its axis, which nearly sorts them for the next one.
    order: Vec<u32>,
}

impl Culling {
    pub(super) fn new(mesh: &CollisionMesh, patches: &Patches) -> Culling {
        let mut culling = Culling {
            firsts: vec![0],
            around: vec![],
            contour_firsts: vec![0],
            contours: vec![],
            chosen: vec![],
            order: (0..patches.count() as u32).collect(),
        };
        // Pairs (vertex, patch that has it), each once.
        let mut users: Vec<(u32, u32)> = Vec::with_capacity(mesh.vertices);
        for patch in 0..patches.cloth() {
            let from = users.len();
            let corners = mesh.triangles[patches.triangles(patch)].as_flattened();
            users.extend(corners.iter().map(|&vertex| (vertex, patch as u32)));
            users[from..].sort_unstable();
            let kept = from + dedup(&mut users[from..]);
            users.truncate(kept);
        }
        users.sort_unstable();
        let mut pairs: Vec<(u32, u32)> = Vec::new();
        for same in users.chunk_by(|a, b| a.0 == b.0) {
            for (_, one) in same {
                pairs.extend(same.iter().map(|(_, other)| (*one, *other)));
            }
        }
        pairs.sort_unstable();
        pairs.dedup();
        let outlines: Vec<_> = (0..patches.cloth()).map(|p| outline(&mesh.triangles[patches.triangles(p)])).collect();
        for same in pairs.chunk_by(|a, b| a.0 == b.0) {
            culling.around.extend(same.iter().map(|(_, other)| *other));
            culling.firsts.push(culling.around.len() as u32);
            let parts = same.iter().map(|(_, other)| outlines[*other as usize].as_deref());
            culling.contours.extend(polygon(parts));
            culling.contour_firsts.push(culling.contours.len() as u32);
        }
        culling.chosen = culling.choose(patches.cloth());
        culling
    }

    /// Chooses unions greedily: on a grid of patches every other one in every other row, and more where that leaves
    /// gaps.
    fn choose(&self, count: usize) -> Vec<u32> {
        let mut chosen = vec![0u32; count];
        for patch in 0..count {
            chosen[patch] = u32::from(self.one_ring(patch).iter().all(|&p| chosen[p as usize] == 0));
        }
        for patch in 0..count {
            let covered = |&other: &u32| self.is_covered(patch as u32, other, &chosen);
            if !self.one_ring(patch).iter().all(covered) {
                chosen[patch] = 1;
            }
        }
        (0..count as u32).filter(|&patch| chosen[patch as usize] != 0).collect()
    }

    fn one_ring(&self, patch: usize) -> &[u32] {
        &self.around[self.firsts[patch] as usize..self.firsts[patch + 1] as usize]
    }

    fn contour(&self, patch: usize) -> &[u32] {
        &self.contours[self.contour_firsts[patch] as usize..self.contour_firsts[patch + 1] as usize]
    }

    /// True if features of the union around a patch that share no vertex stay farther apart than the query's radius for
    /// the whole step.
    fn is_free(&self, input: &Input, patches: &Patches, patch: usize, contour: &mut Contour) -> bool {
        let vertices = self.contour(patch);
        if vertices.is_empty() {
            return false;
        }
        let cones = || self.one_ring(patch).iter().map(|&p| &patches.states[p as usize].cone);
        let sum: Vec3A = cones().map(|cone| Vec3A::from_array(cone.axis)).sum();
        let Some(view) = sum.try_normalize() else { return false };
        let altitude_m = cones().map(|cone| cone.altitude_along(view)).fold(f32::INFINITY, f32::min);
        let radius_m = input.paths.within_piece_m;
        if altitude_m <= radius_m {
            return false;
        }
        let rounding_m = contour.project(&input.paths, vertices, view);
        // A relative margin, too, as the query's radius is a rounded number.
        let margin_m = radius_m * (1.0 + ROUNDING) + rounding_m;
        altitude_m > margin_m && contour.is_apart(margin_m)
    }

    /// Patches that may have a pair, ascending.
    pub(super) fn active(
        &mut self,
        cpu: &CpuExecutor,
        input: &Input,
        patches: &Patches,
        split: &mut Split,
    ) -> Result<Vec<u32>, TransportError> {
        let mut free = vec![0u32; patches.cloth()];
        self.sort(input, patches);
        let this = &*self;
        let prove = |split: &mut Split, list: &[u32], free: &mut [u32]| {
            let mut found = vec![0u32; list.len()];
            let own = split.part(list.len());
            cpu.for_ranges_mut(&mut found[own.clone()], 1, 4, |range, out| {
                let mut contour = Contour::default();
                for (at, free) in (own.start + range.start..).zip(out) {
                    *free = u32::from(this.is_free(input, patches, list[at] as usize, &mut contour));
                }
            });
            let (_, ranks) = split.place();
            split.share(&mut found, |rank| even(rank, ranks, list.len()))?;
            list.iter().zip(&found).for_each(|(&patch, &found)| free[patch as usize] = found);
            Ok::<(), TransportError>(())
        };
        prove(split, &this.chosen, &mut free)?;
        let (mut active, mut open) = (vec![false; patches.count()], Vec::new());
        for [one, other] in split.gather(this.sweep(input, patches, &free, split))? {
            match other {
                ALONE => active[one as usize] = true,
                _ => open.push([one, other]),
            }
        }
        open.retain(|&[one, other]| !(active[one as usize] && active[other as usize]));
        // Unions that were not chosen may settle the pairs that are still open.
        let untried = |p: &u32| this.chosen.binary_search(p).is_err();
        let mut others: Vec<u32> =
            open.iter().flat_map(|&[one, other]| this.common(one, other)).filter(untried).collect();
        others.sort_unstable();
        others.dedup();
        if !others.is_empty() {
            prove(split, &others, &mut free)?;
        }
        for [one, other] in open {
            if !this.is_covered(one, other, &free) {
                (active[one as usize], active[other as usize]) = (true, true);
            }
        }
        Ok((0..active.len() as u32).filter(|&patch| active[patch as usize]).collect())
    }

    /// Sorts the patches along the axis of the sweep.
    fn sort(&mut self, input: &Input, patches: &Patches) {
        let (axis, states) = (input.grid.longest(), &patches.states);
        let key = |patch: u32| states[patch as usize].aabb().lo[axis];
        self.order.sort_by(|&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
    }

    /// This rank's part of all pairs of patches with overlapping boxes: patches with a pair of which nothing can be proven
    /// (as `[patch, ALONE]`), and pairs that are open: not proven apart, but within one union.
    fn sweep(&self, input: &Input, patches: &Patches, free: &[u32], split: &Split) -> Vec<[u32; 2]> {
        let (axis, states) = (input.grid.longest(), &patches.states);
        // A patch has one piece.
        let piece = |patch: usize| {
            let corner = input.mesh.triangles[patches.triangles(patch).start][0];
            input.mesh.pieces[corner as usize]
        };
        let mut active = vec![false; states.len()];
        let own = split.part(free.len());
        let mut open: Vec<[u32; 2]> =
            own.map(|p| [p as u32; 2]).filter(|&[p, _]| !self.is_covered(p, p, free)).collect();
        for place in split.every(self.order.len()) {
            let one = self.order[place] as usize;
            let aabb = states[one].aabb();
            if aabb.is_empty() {
                continue;
            }
            for &other in &self.order[place + 1..] {
                let other = other as usize;
                let beside = states[other].aabb();
                if beside.lo[axis] > aabb.hi[axis] {
                    break;
                }
                let known = active[one] && active[other];
                if known || one.min(other) >= free.len() || beside.is_empty() || !aabb.overlaps(&beside) {
                    continue;
                }
                let within_piece = input.paths.within_piece.filter(|_| piece(one) == piece(other));
                if within_piece.is_some_and(|by| !aabb.shrink(by).overlaps(&beside)) {
                    continue;
                }
                let pair = [one as u32, other as u32];
                if one.max(other) >= free.len() || self.common(pair[0], pair[1]).next().is_none() {
                    (active[one], active[other]) = (true, true);
                } else if !self.is_covered(pair[0], pair[1], free) {
                    open.push(pair);
                }
            }
        }
        open.retain(|&[one, other]| !(active[one as usize] && active[other as usize]));
        open.extend((0..active.len()).filter(|&patch| active[patch]).map(|patch| [patch as u32, ALONE]));
        open
    }

    /// Patches whose unions hold two patches.
    fn common(&self, one: u32, other: u32) -> impl Iterator<Item = u32> {
        let others = self.one_ring(other as usize);
        self.one_ring(one as usize).iter().copied().filter(|p| others.binary_search(p).is_ok())
    }

    /// True if two patches lie in one union that is free.
    fn is_covered(&self, one: u32, other: u32, free: &[u32]) -> bool {
        self.common(one, other).any(|p| free[p as usize] != 0)
    }

    /// Bytes of the lists; they depend on the mesh alone.
    pub(super) fn bytes(&self) -> u64 {
        let lists = [&self.firsts, &self.around, &self.contour_firsts, &self.contours, &self.chosen];
        let lists = lists.into_iter().chain([&self.order]);
        lists.map(|list| size_of_val(&list[..]) as u64).sum()
    }
}

/// Moves the first of equal neighbors to the front and returns the number of distinct ones.
fn dedup(sorted: &mut [(u32, u32)]) -> usize {
    let mut kept = 0;
    for at in 0..sorted.len() {
        if at == 0 || sorted[at] != sorted[kept - 1] {
            sorted[kept] = sorted[at];
            kept += 1;
        }
    }
    kept
}
