//! Welding: the state of the sewn cloth that follows from one of panels whose seams have closed.
//!
//! First the way of the paired vertices to each other is proven free. Where panels meet in a corner, sides can have
//! come to lie on each other, or the tip of one behind the border of another: drawn to each other they do not come
//! apart. The cloth there is straightened, that is, the vertices of triangles that would cross move toward the middle
//! of their neighbors until the exact check finds no crossing. Near a seam's vertices, within a few rings, cloth may
//! pass cloth on this way, since it is one surface at the end wherever its sides lay; all else is proven free, and
//! obstacles are.

use std::collections::BTreeSet;

use super::time_plan::surface;
use crate::collision::{Impact, LeftOut, StraightWay};
use crate::math::{DVec3, Vec3};
use crate::mesh::{Group, GroupKind, crossings};
use crate::model::{LetGo, Sewn, State};
use crate::output::Straightened;
use crate::scene::{Obstacles, Scene};

/// Share of the way to each other that vertices go first, all pairs of features being proven apart on it; on the rest
/// features that get a common vertex are not looked at.
pub(super) const FIRST_SHARE: f32 = 15.0 / 16.0;
/// How far along the cloth tangled corners are straightened, beyond two rings of a seam's vertices, over the thickness:
/// the first of these that is enough.
const REACHES: [f64; 3] = [0.0, 4.0, 12.0];
/// Rounds in which tangled corners are straightened, at most.
const ROUNDS: usize = 60;
/// Rounds after which the vertices one ring farther from what is tangled are moved, too.
const ROUNDS_ALONE: usize = 10;

/// What became of panels.
pub(super) enum Welded {
    /// The state of the sewn cloth, and what was straightened for it.
    Done(State, Option<Straightened>),
    /// The seams are open.
    Open,
    /// The seams are closed, but something is in the way.
    Blocked,
}

/// The state of `cloth` that follows from that of `panels` after `step`, if its seams are closed: if no vertex has more
/// than half of [`Sewn::weld_m`] to go. Where something lies between, half of the thickness is added, and everywhere
/// once the threads are at their firmest: nothing would close the seams farther then.
///
/// # Errors
/// A sentence, if detection fails.
pub(super) fn welded(panels: &Scene, cloth: &Scene, sewn: &Sewn, state: &State, step: u32) -> Result<Welded, String> {
    let (widest_m, ends) = sewn.ends(&state.positions);
    let is_closed = widest_m <= sewn.weld_m();
    let settings = &panels.settings;
    if !settings.collisions {
        return Ok(if is_closed { Welded::Done(sewn.state(state, &ends), None) } else { Welded::Open });
    }
    if !is_closed {
        if widest_m > sewn.weld_m() + settings.thickness_m {
            return Ok(Welded::Open);
        }
        let time_s = f64::from(step) * settings.step_s;
        let is_at_rest = panels.sewing.as_ref().is_some_and(|sewing| sewing.closing.is_firm(time_s));
        let free = if is_at_rest { 0 } else { not_held(panels, sewn, state, &ends, step)? };
        if free > 0 {
            tracing::debug!("step {step}: {free} open places of seams have nothing in their way");
            return Ok(Welded::Open);
        }
    } else if is_free(panels, sewn, state, &ends, step)? {
        let welded = sewn.state(state, &ends);
        if !crosses(cloth, &welded, step) {
            return Ok(Welded::Done(welded, None));
        }
    }
    let mut straight = None;
    for reach in REACHES {
        let near = sewn.near_seams(&panels.mesh, reach * settings.thickness_m);
        straight = straightened_within(panels, sewn, state, &ends, &near, step)?;
        if straight.is_some() {
            break;
        }
    }
    let Some(straight) = straight else { return Ok(Welded::Blocked) };
    let welded = sewn.state(state, &straight);
    if crosses(cloth, &welded, step) {
        return Ok(Welded::Blocked);
    }
    let ways = ends.iter().zip(&straight).map(|(end, straight)| end.distance(*straight)).filter(|&way_m| way_m > 0.0);
    let (vertices, farthest_m) = ways.fold((0, 0.0f32), |(moved, most_m), way_m| (moved + 1, most_m.max(way_m)));
    let straightened = Straightened { vertices, farthest_m: f64::from(farthest_m) };
    Ok(Welded::Done(welded, Some(straightened).filter(|one| one.vertices > 0)))
}

/// The places of the panels' vertices at which the cloth that meets near `ends` crosses nothing, if they can be gone to
/// and only cloth near seams passes cloth on the way. `near`: [`Sewn::near_seams`].
fn straightened_within(
    panels: &Scene,
    sewn: &Sewn,
    state: &State,
    ends: &[Vec3],
    near: &[Vec<u32>],
    step: u32,
) -> Result<Option<Vec<Vec3>>, String> {
    let straight = match straightened(panels, sewn, state, ends, near, step) {
        Ok(straight) => straight,
        Err(pairs) => {
            tracing::debug!("step {step}: {pairs} pairs of triangles at seams would cross and cannot be straightened");
            return Ok(None);
        }
    };
    let met = met_beyond_seams(panels, state, &straight, near, step)?;
    if met > 0 {
        tracing::debug!("step {step}: on the way that welds the seams {met} pairs of features meet beyond them");
        return Ok(None);
    }
    Ok(Some(straight))
}

/// Number of places whose vertices have farther to go than half of [`Sewn::weld_m`] with nothing in the way.
fn not_held(panels: &Scene, sewn: &Sewn, state: &State, ends: &[Vec3], step: u32) -> Result<usize, String> {
    let (positions, triangles, _) = surface(panels, state, step);
    let mut near = positions.clone();
    near.iter_mut().zip(ends).for_each(|(at, end)| *at = at.lerp(*end, FIRST_SHARE));
    let touching = way(panels, state, &triangles).touching(flat(&positions), flat(&near))?;
    let held: BTreeSet<u32> = touching.iter().flat_map(|impact| impact.candidate.vertices).collect();
    Ok(sewn.open(&state.positions, ends).filter(|members| !members.iter().any(|v| held.contains(v))).count())
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

/// The places of the panels' vertices at which the cloth that meets at `ends` crosses nothing.
///
/// # Errors
/// The number of pairs of triangles that still cross, if that cannot be had by moving vertices near seams. `near`:
/// [`Sewn::near_seams`].
fn straightened(
    panels: &Scene,
    sewn: &Sewn,
    state: &State,
    ends: &[Vec3],
    near: &[Vec<u32>],
    step: u32,
) -> Result<Vec<Vec3>, usize> {
    let (all, mut triangles, groups) = surface(panels, state, step);
    let (cloth, of_cloth) = (ends.len(), panels.mesh.triangles.len());
    let vertices = (0..cloth as u32).map(|v| 1 + sewn.joined_vertex(v)).max().unwrap_or_default();
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
    let mut left = 0;
    for round in 0..ROUNDS {
        let found = crossing(&positions, &triangles, &groups, of_cloth, &let_go);
        if found.is_empty() {
            return Ok((0..cloth as u32).map(|v| positions[sewn.joined_vertex(v) as usize]).collect());
        }
        let tangled: BTreeSet<u32> = found.iter().flatten().flat_map(|&t| triangles[t as usize]).collect();
        left = found.len();
        if tangled.iter().any(|&v| v >= vertices) {
            break;
        }
        // What does not come apart by itself does with more cloth around it.
        let mut smoothed = tangled;
        for _ in 0..round / ROUNDS_ALONE {
            let touching = |corners: &&[u32; 3]| corners.iter().any(|v| smoothed.contains(v));
            let wider: BTreeSet<u32> = triangles[..of_cloth].iter().filter(touching).flatten().copied().collect();
            smoothed = wider;
        }
        let moved: Vec<(u32, Vec3)> = smoothed
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
            break;
        }
        moved.into_iter().for_each(|(v, at)| positions[v as usize] = at);
    }
    Err(left)
}

/// Number of pairs of features that touch on the way of the vertices of `state` to `ends`, but for cloth near the same
/// vertex of a seam. `near`: [`Sewn::near_seams`].
fn met_beyond_seams(
    panels: &Scene,
    state: &State,
    ends: &[Vec3],
    near: &[Vec<u32>],
    step: u32,
) -> Result<usize, String> {
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
    Ok(touching.iter().filter(|impact| !is_at_seam(impact)).count())
}

/// The features of an impact, as vertices.
pub(super) fn features(impact: &Impact) -> (&[u32], &[u32]) {
    let candidate = &impact.candidate;
    candidate.vertices.split_at(if candidate.is_vertex_face() { 1 } else { 2 })
}

pub(super) fn flat(points: &[Vec3]) -> &[f32] {
    bytemuck::cast_slice(points)
}

/// A motion of the surface of `panels` and obstacles, with what `state` has let go left out.
pub(super) fn way<'a>(panels: &Scene, state: &State, triangles: &'a [[u32; 3]]) -> StraightWay<'a> {
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
