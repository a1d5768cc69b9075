//! Check of the start state: cloth must not cross or touch itself, other cloth or an obstacle.

use std::path::Path;

use crate::math::{DVec3, Vec3};
use crate::mesh::{Group, GroupKind, Tangle, TriangleMesh, crossings, first_at_place};

use super::crossings::{BestState, Crossings, Doubled, Untangling};
use super::pieces::Merged;
use super::{Obstacle, Obstacles, Pin, Settings};

/// Gap that untangling leaves between surfaces, as a fraction of the thickness. Contacts then act but still have room.
const GAP: f64 = 0.5;

/// Positions and velocities that cloth starts with in place of those of its scene, such as those of another run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GivenStart {
    /// Of every vertex of the scene, relative to `origin_m`, meters.
    pub positions: Vec<Vec3>,
    /// m/s.
    pub velocities: Vec<Vec3>,
    /// The local origin that the positions are relative to.
    pub origin_m: DVec3,
}

/// Requests for a start state, and the result of an untangling.
#[derive(Debug, Default)]
pub(super) struct StartState<'a> {
    /// Where the cloth starts; none: as the scene has it.
    pub given: Option<&'a GivenStart>,
    /// Take the start state as it is, because somebody has checked it before.
    pub trusted: bool,
    /// Untangle instead of refusing the scene.
    pub untangle: bool,
    /// Set if the start state was untangled.
    pub untangled: Option<Untangling>,
}

/// Input of the check: the parts of a scene at time 0.
pub(super) struct Start<'a> {
    pub path: &'a Path,
    pub resolution: Option<u64>,
    /// True for each cloth that is a plane sheet.
    pub flat: &'a [bool],
    pub obstacles: &'a [Obstacle],
    pub pins: &'a [Pin],
    pub origin_m: DVec3,
    pub settings: &'a Settings,
}

impl Start<'_> {
    /// Checks that nothing crosses, or moves the cloth apart if `state` asks for it.
    pub(super) fn settle(&self, merged: &mut Merged, state: &mut StartState) -> Result<(), Box<Crossings>> {
        if let Some(given) = state.given {
            let moved = |p: &Vec3| (p.as_dvec3() + given.origin_m - self.origin_m).as_vec3();
            match given.origin_m == self.origin_m {
                true => merged.mesh.positions.copy_from_slice(&given.positions),
                false => merged.mesh.positions = given.positions.iter().map(moved).collect(),
            }
            merged.velocities.copy_from_slice(&given.velocities);
        }
        if !self.settings.collisions || state.trusted {
            return Ok(());
        }
        let surface = self.surface(merged);
        let pairs = crossings(&surface.positions, &surface.triangles, &surface.groups);
        if pairs.is_empty() {
            return Ok(());
        }
        let refusal = self.refusal(merged, &surface, &surface.positions, &pairs);
        // Untangling would tear open a split seam.
        if !state.untangle || refusal.doubled.is_some() {
            return Err(refusal);
        }
        let cloth = merged.mesh.positions.len();
        let mut movable = vec![true; cloth];
        let is_held = |pin: &&Pin| pin.start_s <= 0.0 && pin.stiffness_n_m.is_none() && !pin.on_touch;
        self.pins.iter().filter(is_held).for_each(|pin| movable[pin.vertex as usize] = false);
        movable.resize(surface.positions.len(), false);
        let (triangles, groups, gap_m) = (&surface.triangles[..], &surface.groups[..], GAP * self.settings.thickness_m);
        let done = Tangle { triangles, groups, movable: &movable, gap_m }.untangle(&surface.positions);
        if !done.left.is_empty() {
            let mut refusal = self.refusal(merged, &surface, &done.positions, &done.left);
            let (positions, triangles) = (done.positions[..cloth].to_vec(), merged.mesh.triangles.clone());
            refusal.best = Some(BestState { pairs_before: done.pairs_before, positions, triangles, written: None });
            return Err(refusal);
        }
        let ways =
            merged.mesh.positions.iter().zip(&done.positions).map(|(from, to)| from.as_dvec3().distance(to.as_dvec3()));
        state.untangled = Some(Untangling {
            pairs: done.pairs_before,
            rounds: done.rounds,
            vertices_moved: ways.clone().filter(|&way| way > 0.0).count(),
            largest_m: ways.fold(0.0, f64::max),
        });
        merged.mesh.positions.copy_from_slice(&done.positions[..cloth]);
        Ok(())
    }

    /// Cloth and obstacles as one surface.
    fn surface(&self, merged: &Merged) -> Surface {
        let TriangleMesh { positions, triangles, .. } = &merged.mesh;
        let all = Obstacles::new(self.obstacles);
        let mut values = Vec::new();
        all.positions_at(0.0, &mut values);
        let mut surface = Surface {
            positions: positions.clone(),
            triangles: triangles.clone(),
            groups: Vec::new(),
            names: Vec::new(),
        };
        surface.positions.extend_from_slice(bytemuck::cast_slice(&values));
        surface.triangles.extend(all.triangles().iter().map(|corners| corners.map(|v| v + positions.len() as u32)));
        for (cloth, &flat) in merged.cloths.iter().zip(self.flat) {
            let kind = if flat { GroupKind::FlatCloth } else { GroupKind::Cloth };
            surface
                .groups
                .push(Group { triangles: cloth.triangles.start as usize..cloth.triangles.end as usize, kind });
            surface.names.push(format!("`{}`", cloth.name));
        }
        let mut first = triangles.len();
        for obstacle in self.obstacles {
            let triangles = first..first + obstacle.triangles.len();
            first = triangles.end;
            surface.groups.push(Group { triangles, kind: GroupKind::Obstacle });
            surface.names.push(format!("obstacle `{}`", obstacle.name));
        }
        surface
    }

    fn refusal(&self, merged: &Merged, surface: &Surface, positions: &[Vec3], pairs: &[[u32; 2]]) -> Box<Crossings> {
        let mut meeting: Vec<u32> = pairs.iter().flatten().copied().collect();
        meeting.sort_unstable();
        meeting.dedup();
        let corners = |&t: &u32| surface.triangles[t as usize].map(|v| positions[v as usize]);
        let resolution = self.resolution.map(|triangles| format!(" --resolution {triangles}")).unwrap_or_default();
        Box::new(Crossings {
            first: pairs[0].map(|t| surface.name_of(t)),
            pairs: pairs.len(),
            origin_m: self.origin_m,
            positions: meeting.iter().flat_map(corners).collect(),
            command: format!("loomtree check {}{resolution} --write-crossings crossings.obj", self.path.display()),
            written: None,
            doubled: doubled(merged, surface, positions, pairs),
            best: None,
        })
    }
}

/// The first split seam, if one of the pairs crosses there.
fn doubled(merged: &Merged, surface: &Surface, positions: &[Vec3], pairs: &[[u32; 2]]) -> Option<Doubled> {
    let first = first_at_place(positions);
    let apart = |corners: [u32; 3], other: [u32; 3]| {
        let same_place = |&v: &u32| other.iter().any(|&w| v != w && first[v as usize] == first[w as usize]);
        corners.iter().any(same_place)
    };
    let corners = |t: u32| surface.triangles[t as usize];
    let split = |&&[s, t]: &&[u32; 2]| surface.group_of(s) == surface.group_of(t) && apart(corners(s), corners(t));
    let (s, _) = pairs.iter().find(split).map(|&[s, t]| (s, t))?;
    let group = surface.group_of(s);
    let cloth = merged.cloths.get(group)?;
    Some(Doubled {
        cloth: cloth.name.clone(),
        vertices: cloth.vertices.clone().filter(|&v| (cloth.vertices.start..v).contains(&first[v as usize])).count(),
        pairs: pairs.iter().filter(split).filter(|&&[s, _]| surface.group_of(s) == group).count(),
    })
}

struct Surface {
    positions: Vec<Vec3>,
    triangles: Vec<[u32; 3]>,
    groups: Vec<Group>,
    /// Name of every group.
    names: Vec<String>,
}

impl Surface {
    fn group_of(&self, t: u32) -> usize {
        self.groups.partition_point(|group| group.triangles.end <= t as usize)
    }

    fn name_of(&self, t: u32) -> String {
        let group = self.group_of(t);
        format!("triangle {} of {}", t as usize - self.groups[group].triangles.start + 1, self.names[group])
    }
}
