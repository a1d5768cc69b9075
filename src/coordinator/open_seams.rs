//! Which seams of panels are open, and why: they still close, something lies in the way, or the cloth beside them is
//! too tight.

use std::collections::{BTreeMap, BTreeSet};

use super::time_plan::surface;
use super::welding::{FIRST_SHARE, features, flat, way};
use crate::math::Vec3;
use crate::model::{Sewn, State};
use crate::output::{OpenBecause, OpenSeam};
use crate::scene::{Obstacles, Scene};

/// What lies in the way where it is no obstacle.
const CLOTH: &str = "cloth";

/// The seams of `panels` that are open in `state` after `step`, in the order of the scene. `before`: an earlier state
/// with its step, against which their speed is taken.
///
/// # Errors
/// A sentence, if detection fails.
pub(super) fn open_seams(
    panels: &Scene,
    sewn: &Sewn,
    before: Option<(u32, &State)>,
    state: &State,
    step: u32,
) -> Result<Vec<OpenSeam>, String> {
    let Some(sewing) = &panels.sewing else { return Ok(Vec::new()) };
    let (_, ends) = sewn.ends(&state.positions);
    let gaps_before = before.map(|(step, state)| (step, gaps_m(sewn, state, &sewn.ends(&state.positions).1)));
    let gaps = gaps_m(sewn, state, &ends);
    let seams_of = seams_of_places(sewn, &sewing.pairs, &sewing.seam_of_pair);
    let between = between(panels, sewn, state, &ends, step)?;
    let step_s = panels.settings.step_s;
    let shortens = f64::from(step) * step_s < sewing.closing.start_s + sewing.closing.close_s;
    let mut seams: BTreeMap<u32, OpenSeam> = BTreeMap::new();
    let mut widest_before: BTreeMap<u32, f64> = BTreeMap::new();
    for (place, &gap_m) in &gaps {
        for &number in seams_of.get(place).into_iter().flatten() {
            let name = || sewing.names[number as usize].clone();
            let seam = seams.entry(number).or_insert_with(|| OpenSeam { seam: name(), ..OpenSeam::default() });
            seam.places += 1;
            seam.widest_m = seam.widest_m.max(gap_m);
            if let Some((_, gaps)) = &gaps_before {
                let widest_m = widest_before.entry(number).or_default();
                *widest_m = widest_m.max(gaps[place]);
            }
            if gap_m > sewn.weld_m() {
                seam.open += 1;
                let things = between.get(place).into_iter().flatten();
                seam.between.extend(things.cloned());
            }
        }
    }
    for (number, seam) in &mut seams {
        seam.between.sort_unstable();
        seam.between.dedup();
        // At its speed since the state before.
        let closes_soon = gaps_before.as_ref().is_some_and(|(step_before, _)| {
            let time_s = f64::from(step - step_before) * step_s;
            let way_m = widest_before[number] - seam.widest_m;
            way_m * sewing.closing.close_s > (seam.widest_m - sewn.weld_m()) * time_s
        });
        seam.why = match seam.between.is_empty() {
            _ if shortens || closes_soon => OpenBecause::Closing,
            true => OpenBecause::Taut,
            false => OpenBecause::Blocked,
        };
    }
    Ok(seams.into_values().filter(|seam| seam.open > 0).collect())
}

/// How far the vertices of every place have to go to each other, meters, by the vertex that they become.
fn gaps_m(sewn: &Sewn, state: &State, ends: &[Vec3]) -> BTreeMap<u32, f64> {
    let way_m = |v: u32| state.positions[v as usize].as_dvec3().distance(ends[v as usize].as_dvec3());
    let gap = |members: &[u32]| {
        let farthest_m = members.iter().fold(0.0, |most: f64, &v| most.max(way_m(v)));
        (sewn.joined_vertex(members[0]), 2.0 * farthest_m)
    };
    sewn.places().map(gap).collect()
}

/// The seams that join vertices of every place, ascending.
fn seams_of_places(sewn: &Sewn, pairs: &[[u32; 2]], seam_of_pair: &[u32]) -> BTreeMap<u32, BTreeSet<u32>> {
    let mut seams: BTreeMap<u32, BTreeSet<u32>> = BTreeMap::new();
    for (&[a, _], &seam) in pairs.iter().zip(seam_of_pair) {
        seams.entry(sewn.joined_vertex(a)).or_default().insert(seam);
    }
    seams
}

/// What lies between the vertices of a place, by the vertex that they become: names of obstacles, or cloth.
fn between(
    panels: &Scene,
    sewn: &Sewn,
    state: &State,
    ends: &[Vec3],
    step: u32,
) -> Result<BTreeMap<u32, BTreeSet<String>>, String> {
    let mut things: BTreeMap<u32, BTreeSet<String>> = BTreeMap::new();
    if !panels.settings.collisions {
        return Ok(things);
    }
    let cloth = state.positions.len() as u32;
    let obstacles = Obstacles::new(&panels.obstacles);
    let open: BTreeSet<u32> = sewn.open(&state.positions, ends).flatten().copied().collect();
    let (positions, triangles, _) = surface(panels, state, step);
    let mut near = positions.clone();
    open.iter().for_each(|&v| near[v as usize] = near[v as usize].lerp(ends[v as usize], FIRST_SHARE));
    for impact in way(panels, state, &triangles).touching(flat(&positions), flat(&near))? {
        let (one, other) = features(&impact);
        for (own, others) in [(one, other), (other, one)] {
            let obstacle = others.iter().find(|&&v| v >= cloth);
            let name = match obstacle {
                Some(&v) => obstacles.name(obstacles.obstacle_of_vertex((v - cloth) as usize)).to_string(),
                None => CLOTH.to_string(),
            };
            for v in own.iter().filter(|v| open.contains(v)) {
                things.entry(sewn.joined_vertex(*v)).or_default().insert(name.clone());
            }
        }
    }
    Ok(things)
}
