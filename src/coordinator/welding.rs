//! Welding: the state of the sewn cloth that follows from one of panels whose seams have closed.
//!
//! First the way of the paired vertices to each other is proven free. Where panels meet in a corner, sides can have
//! come to lie on each other, or the tip of one behind the border of another: drawn to each other they do not come
//! apart. The cloth there is straightened, that is, the vertices of triangles that would cross move toward the middle
//! of their neighbors until the exact check finds no crossing. Within two rings of a seam's vertices cloth may pass
//! cloth on this way, since it is one surface at the end wherever its sides lay; all else is proven free, and
//! obstacles are.

use std::collections::BTreeSet;

use super::time_plan::surface;
use crate::collision::{Impact, LeftOut, StraightWay};
use crate::math::{DVec3, Vec3};
use crate::mesh::{Group, GroupKind, crossings};
use crate::model::{LetGo, Sewn, State};
use crate::scene::{Obstacles, Scene};

/// Share of the way to each other that vertices go first, all pairs of features being proven apart on it; on the rest
/// features that get a common vertex are not looked at.
const FIRST_SHARE: f32 = 15.0 / 16.0;
/// Rounds in which tangled corners are straightened, at most.
const ROUNDS: usize = 20;

/// What became of panels.
pub(super) enum Welded {
    /// The state of the sewn cloth.
    Done(State),
    /// The seams are open.
    Open,
    /// The seams are closed, but something is in the way.
    Blocked,
}

/// The state of `cloth` that follows from that of `panels` after `step`, if its seams are closed: if no vertex has more
/// than half of [`Sewn::weld_m`] to go. Where something lies between, half of the thickness is added.
///
/// # Errors
/// A sentence, if detection fails.
pub(super) fn welded(panels: &Scene, cloth: &Scene, sewn: &Sewn, state: &State, step: u32) -> Result<Welded, String> {
    let (widest_m, ends) = sewn.ends(&state.positions);
    let is_closed = widest_m <= sewn.weld_m();
    let settings = &panels.settings;
    if !settings.collisions {
        return Ok(if is_closed { Welded::Done(sewn.state(state, &ends)) } else { Welded::Open });
    }
    if !is_closed {
        if widest_m > sewn.weld_m() + settings.thickness_m || !is_held_open(panels, sewn, state, &ends, step)? {
            return Ok(Welded::Open);
        }
    } else if is_free(panels, sewn, state, &ends, step)? {
        let welded = sewn.state(state, &ends);
        if !crosses(cloth, &welded, step) {
            return Ok(Welded::Done(welded));
        }
    }
    let near = sewn.near_seams(&panels.mesh.triangles);
    let Some(straight) = straightened(panels, sewn, state, &ends, &near, step) else { return Ok(Welded::Blocked) };
    if !is_free_beyond_seams(panels, state, &straight, &near, step)? {
        return Ok(Welded::Blocked);
    }
    let welded = sewn.state(state, &straight);
    if crosses(cloth, &welded, step) {
        return Ok(Welded::Blocked);
    }
    let ways = ends.iter().zip(&straight).map(|(end, straight)| end.distance(*straight)).filter(|&way_m| way_m > 0.0);
    let (moved, farthest_m) = ways.fold((0, 0.0f32), |(moved, most_m), way_m| (moved + 1, most_m.max(way_m)));
    if moved > 0 {
        let farthest_mm = farthest_m * 1e3;
        tracing::info!(
            "{moved} vertices of tangled corners were straightened while welding, by up to {farthest_mm:.1} mm"
        );
    }
    Ok(Welded::Done(welded))
}

/// Whether something is in the way wherever vertices have farther to go than half of [`Sewn::weld_m`].
fn is_held_open(panels: &Scene, sewn: &Sewn, state: &State, ends: &[Vec3], step: u32) -> Result<bool, String> {
    let (positions, triangles, _) = surface(panels, state, step);
    let mut near = positions.clone();
    near.iter_mut().zip(ends).for_each(|(at, end)| *at = at.lerp(*end, FIRST_SHARE));
    let touching = way(panels, state, &triangles).touching(flat(&positions), flat(&near))?;
    let held: BTreeSet<u32> = touching.iter().flat_map(|impact| impact.candidate.vertices).collect();
    Ok(sewn.open(&state.positions, ends).all(|members| members.iter().any(|v| held.contains(v))))
}

/// Whether the vertices of `state` can go to `ends` without touching anything else.
fn is_free(panels: &Scene, sewn: &Sewn, state: &State, ends: &[Vec3], step: u32) -> Result<bool, String> {
    let (positions, triangles, _) = surface(panels, state, step);
    let cloth = state.positions.len();
    let way = way(panels, state, &triangles);
    let mut near = positions.clone();
    let mut there = positions.clone();
    for (v, &end) in ends.iter().enumerate() {
        near[v] = positions[v].lerp(end, FIRST_SHARE);
        there[v] = end;
        // A vertex that stays keeps its bits.
        if end == positions[v] {
            near[v] = end;
        }
    }
    if !way.touching(flat(&positions), flat(&near))?.is_empty() {
        return Ok(false);
    }
    let last = way.touching(flat(&near), flat(&there))?;
    let is_shared = |impact: &Impact| {
        let (one, other) = features(impact);
        let of_cloth = |vertices: &[u32]| vertices.iter().all(|&v| (v as usize) < cloth);
        of_cloth(one) && of_cloth(other) && sewn.joins(one, other)
    };
    Ok(last.iter().all(is_shared))
}

/// The places of the panels' vertices at which the cloth that meets at `ends` crosses nothing. None if that cannot be
/// had by moving vertices within two rings of seams. `near`: [`Sewn::near_seams`].
fn straightened(
    panels: &Scene,
    sewn: &Sewn,
    state: &State,
    ends: &[Vec3],
    near: &[Vec<u32>],
    step: u32,
) -> Option<Vec<Vec3>> {
    let (all, mut triangles, groups) = surface(panels, state, step);
    let (cloth, of_cloth) = (ends.len(), panels.mesh.triangles.len());
    let vertices = 1 + (0..cloth as u32).map(|v| sewn.joined_vertex(v)).max()?;
    let mut positions = vec![Vec3::ZERO; vertices as usize];
    let mut can_move = vec![false; vertices as usize];
    for (v, &end) in (0u32..).zip(ends) {
        let joined = sewn.joined_vertex(v) as usize;
        (positions[joined], can_move[joined]) = (end, !near[v as usize].is_empty());
    }
    panels.pins.iter().for_each(|pin| can_move[sewn.joined_vertex(pin.vertex) as usize] = false);
    positions.extend_from_slice(&all[cloth..]);
    let joined = |&v: &u32| if (v as usize) < cloth { sewn.joined_vertex(v) } else { v - cloth as u32 + vertices };
    triangles.iter_mut().for_each(|corners| *corners = corners.each_ref().map(joined));
    let let_go: Vec<u32> = state.let_go.iter().map(|one| sewn.joined_vertex(one.vertex)).collect();
    let groups = whole(of_cloth, groups);
    for _ in 0..ROUNDS {
        let found = crossing(&positions, &triangles, &groups, of_cloth, &let_go);
        if found.is_empty() {
            return Some((0..cloth as u32).map(|v| positions[sewn.joined_vertex(v) as usize]).collect());
        }
        let tangled: BTreeSet<u32> = found.iter().flatten().flat_map(|&t| triangles[t as usize]).collect();
        if tangled.iter().any(|&v| v >= vertices) {
            return None;
        }
        let moved: Vec<(u32, Vec3)> = tangled
            .into_iter()
            .filter(|&v| can_move[v as usize])
            .map(|v| {
                let around = triangles[..of_cloth].iter().filter(|corners| corners.contains(&v)).flatten();
                let neighbors: BTreeSet<u32> = around.copied().filter(|&other| other != v).collect();
                let at = |v: u32| positions[v as usize].as_dvec3();
                let mean = neighbors.iter().map(|&v| at(v)).sum::<DVec3>() / neighbors.len() as f64;
                (v, at(v).midpoint(mean).as_vec3())
            })
            .collect();
        if moved.is_empty() {
            return None;
        }
        moved.into_iter().for_each(|(v, at)| positions[v as usize] = at);
    }
    None
}

/// Whether the vertices of `state` can go to `ends` and nothing touches on the way but cloth within two rings of the
/// same vertex of a seam. `near`: [`Sewn::near_seams`].
fn is_free_beyond_seams(
    panels: &Scene,
    state: &State,
    ends: &[Vec3],
    near: &[Vec<u32>],
    step: u32,
) -> Result<bool, String> {
    let (positions, triangles, _) = surface(panels, state, step);
    let mut there = positions.clone();
    there[..ends.len()].copy_from_slice(ends);
    let touching = way(panels, state, &triangles).touching(flat(&positions), flat(&there))?;
    let is_at_seam = |impact: &Impact| {
        let (one, other) = features(impact);
        let of_cloth = |vertices: &[u32]| vertices.iter().all(|&v| (v as usize) < ends.len());
        let seams = |feature: &[u32]| -> BTreeSet<u32> {
            feature.iter().flat_map(|&v| near[v as usize].iter().copied()).collect()
        };
        of_cloth(one) && of_cloth(other) && !seams(one).is_disjoint(&seams(other))
    };
    Ok(touching.iter().all(is_at_seam))
}

/// The features of an impact, as vertices.
fn features(impact: &Impact) -> (&[u32], &[u32]) {
    let candidate = &impact.candidate;
    candidate.vertices.split_at(if candidate.is_vertex_face() { 1 } else { 2 })
}

fn flat(points: &[Vec3]) -> &[f32] {
    bytemuck::cast_slice(points)
}

/// A motion of the surface of `panels` and obstacles, with what `state` has let go left out.
fn way<'a>(panels: &Scene, state: &State, triangles: &'a [[u32; 3]]) -> StraightWay<'a> {
    let cloth = state.positions.len();
    let ranges = Obstacles::new(&panels.obstacles).ranges();
    let vertices = |obstacle: u32| {
        let [vertices, _] = &ranges[obstacle as usize];
        (cloth + vertices.start) as u32..(cloth + vertices.end) as u32
    };
    let left_out = |one: &LetGo| LeftOut { vertex: one.vertex, obstacle: vertices(one.obstacle) };
    let left_out = state.let_go.iter().map(left_out).collect();
    StraightWay { triangles, cloth_vertices: cloth, left_out }
}

/// All cloth as one group, then the obstacles.
fn whole(of_cloth: usize, groups: Vec<Group>) -> Vec<Group> {
    let cloth = Group { triangles: 0..of_cloth, kind: GroupKind::Cloth };
    let obstacles = groups.into_iter().filter(|group| group.triangles.start >= of_cloth);
    std::iter::once(cloth).chain(obstacles).collect()
}

/// The pairs of triangles that cross, but not those of cloth around the vertices `let_go` with obstacles.
fn crossing(
    positions: &[Vec3],
    triangles: &[[u32; 3]],
    groups: &[Group],
    of_cloth: usize,
    let_go: &[u32],
) -> Vec<[u32; 2]> {
    let is_let_go = |t: u32| (t as usize) < of_cloth && triangles[t as usize].iter().any(|v| let_go.contains(v));
    let mut found = crossings(positions, triangles, groups);
    found.retain(|&[s, t]| (t as usize) < of_cloth || !is_let_go(s));
    found
}

/// Whether the sewn cloth crosses itself or an obstacle that it has not let go.
fn crosses(cloth: &Scene, state: &State, step: u32) -> bool {
    let (positions, triangles, groups) = surface(cloth, state, step);
    let of_cloth = cloth.mesh.triangles.len();
    let let_go: Vec<u32> = state.let_go.iter().map(|one| one.vertex).collect();
    !crossing(&positions, &triangles, &whole(of_cloth, groups), of_cloth, &let_go).is_empty()
}
