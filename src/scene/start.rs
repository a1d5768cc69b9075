//! The state a scene starts in: no cloth may cross or touch itself, other cloth or an obstacle.

use std::fmt;
use std::path::Path;

use crate::math::Vec3;
use crate::mesh::{Group, GroupKind, TriangleMesh, crossings};

use super::{Cloth, Obstacle, Obstacles};

/// Pairs that meet, and where they are.
#[derive(Clone, Debug, PartialEq)]
pub struct Crossings {
    /// The triangles of the first pair, such as "triangle 1 of `flag`", counting from 1.
    pub first: [String; 2],
    /// Pairs that have been found; the search ends at about 10,000.
    pub pairs: usize,
    /// Positions of the triangles that meet, three each, metres.
    pub positions: Vec<Vec3>,
    /// The command that writes a mesh of them.
    pub command: String,
}

impl fmt::Display for Crossings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [one, other] = &self.first;
        write!(f, "{one} and {other} cross or touch at the start")?;
        match self.pairs {
            1 => {}
            2 => write!(f, ", and 1 more pair does")?,
            pairs => write!(f, ", and {} more pairs do", pairs - 1)?,
        }
        write!(f, "; move them apart (`{}` writes a mesh of them)", self.command)
    }
}

impl Crossings {
    /// The triangles that meet as vertex indices of [`Crossings::positions`].
    pub fn triangles(&self) -> Vec<[u32; 3]> {
        (0..self.positions.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect()
    }
}

/// Looks for crossings at time 0. `flat` = whether each cloth is a plane sheet.
pub(super) fn find_crossings(
    path: &Path,
    resolution: Option<u64>,
    mesh: &TriangleMesh,
    cloths: &[Cloth],
    flat: &[bool],
    obstacles: &[Obstacle],
) -> Option<Box<Crossings>> {
    let all = Obstacles::new(obstacles);
    let mut values = Vec::new();
    all.positions_at(0.0, &mut values);
    let mut groups: Vec<Group> = Vec::new();
    let mut names: Vec<&str> = Vec::new();
    for (cloth, &flat) in cloths.iter().zip(flat) {
        let kind = if flat { GroupKind::FlatCloth } else { GroupKind::Cloth };
        groups.push(Group { triangles: cloth.triangles.start as usize..cloth.triangles.end as usize, kind });
        names.push(&cloth.name);
    }
    let mut first = mesh.triangles.len();
    for obstacle in obstacles {
        let triangles = first..first + obstacle.triangles.len();
        first = triangles.end;
        groups.push(Group { triangles, kind: GroupKind::Obstacle });
        names.push(&obstacle.name);
    }
    // The arrays are joined for the search only where there is something to join.
    let (mut positions, mut triangles);
    let (positions, triangles) = if obstacles.is_empty() {
        (&mesh.positions, &mesh.triangles)
    } else {
        positions = mesh.positions.clone();
        positions.extend_from_slice(bytemuck::cast_slice(&values));
        triangles = mesh.triangles.clone();
        triangles.extend(all.triangles().iter().map(|corners| corners.map(|v| v + mesh.positions.len() as u32)));
        (&positions, &triangles)
    };
    let pairs = crossings(positions, triangles, &groups);
    let name_of = |t: u32| {
        let group = groups.partition_point(|group| group.triangles.end <= t as usize);
        let thing = if groups[group].kind == GroupKind::Obstacle { "obstacle " } else { "" };
        format!("triangle {} of {thing}`{}`", t as usize - groups[group].triangles.start + 1, names[group])
    };
    let mut meeting: Vec<u32> = pairs.iter().flatten().copied().collect();
    meeting.sort_unstable();
    meeting.dedup();
    let resolution = resolution.map(|triangles| format!(" --resolution {triangles}")).unwrap_or_default();
    pairs.first().map(|pair| {
        Box::new(Crossings {
            first: pair.map(name_of),
            pairs: pairs.len(),
            positions: meeting.iter().flat_map(|&t| triangles[t as usize].map(|v| positions[v as usize])).collect(),
            command: format!("loomtree check {}{resolution} --write-crossings crossings.obj", path.display()),
        })
    })
}
