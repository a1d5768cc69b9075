//! Selects the vertices of pins and checks that no vertex is held in two ways at once.

use crate::math::{DVec3, Vec3};
use crate::mesh::{NearestPoint, TriangleMesh};

use super::error::Place;
use super::pieces::Piece;
use super::sheet::SheetMesh;
use super::{Obstacle, Obstacles, Pin, SceneError};

/// A pin as the scene file gives it, before a resolution is chosen.
#[derive(Clone, Debug)]
pub(super) struct PinSource {
    /// By which a change lets it go; none: its number among the pins.
    pub name: Option<String>,
    /// Index of the piece.
    pub cloth: usize,
    pub select: Selection,
    /// Index into the scene's motions; none = the vertices stay in place.
    pub motion: Option<u32>,
    /// Index into the obstacles that pins of the scene follow, and the obstacle; in place of a motion.
    pub follow: Option<(u32, u32)>,
    pub start_s: f64,
    pub end_s: f64,
    /// N/m; none = positions are prescribed.
    pub stiffness_n_m: Option<f64>,
    /// True: takes hold of the followed obstacle where a vertex first touches it.
    pub on_touch: bool,
    /// The field that selects the vertices.
    pub at: Place,
}

/// Selection of vertices of a piece.
#[derive(Clone, Debug)]
pub(super) enum Selection {
    /// Corners of a sheet: (right, top).
    Corners(Vec<(bool, bool)>),
    /// An edge of a sheet.
    Edge(Edge, Spread),
    /// Vertices by their number in the piece's file, from 0.
    Vertices(Vec<u32>),
    /// Vertices of the mesh of a file.
    MeshVertices(Vec<u32>),
    /// Vertices at which a property of the piece is 0.5 or more.
    Property(String),
    /// All vertices that start in a box, relative to the scene's local origin.
    Box { low: DVec3, high: DVec3 },
    /// All vertices that start in a sphere, relative to the scene's local origin.
    Sphere { center: DVec3, radius_m: f64 },
    /// The vertices that start nearest to the obstacle that the pin follows.
    Nearest(usize),
    /// The vertices that start nearest to a point, relative to the scene's local origin.
    NearestTo { point: DVec3, count: usize },
}

/// Selection of vertices along an edge.
#[derive(Clone, Copy, Debug)]
pub(super) enum Spread {
    /// Every k-th vertex.
    Every(usize),
    /// This many vertices, evenly spread.
    Count(usize),
}

impl PinSource {
    /// The vertices of the piece that the pin selects. It is an error if there are none.
    pub(super) fn vertices(&self, piece: &Piece, obstacles: &[Obstacle]) -> Result<Vec<u32>, SceneError> {
        let name = &piece.source.name;
        let sheet = || match &piece.sheet {
            Some(sheet) if sheet.has_sides() => Ok(sheet),
            Some(_) => Err(self.at.error(format!("`{name}` is round and has no corners and edges"))),
            None => Err(self.at.error(format!("`{name}` is a mesh; only a sheet has corners and edges"))),
        };
        let cloth = piece.selected_from();
        let vertices: Vec<u32> = match &self.select {
            Selection::Corners(corners) => {
                let sheet = sheet()?;
                corners.iter().map(|&(right, top)| sheet.corner(right, top)).collect()
            }
            Selection::Edge(which, spread) => {
                let vertices = edge(sheet()?, *which);
                match *spread {
                    Spread::Every(every) => vertices.into_iter().step_by(every).collect(),
                    Spread::Count(count) => evenly(&vertices, count),
                }
            }
            Selection::Vertices(numbers) => {
                let vertex = |(i, &number): (usize, &u32)| {
                    cloth.vertex(number).ok_or_else(|| {
                        // The field name follows the reader of each format: JSON entries carry an index even if there
                        // is only one.
                        let indexed = numbers.len() > 1 || self.at.line.is_none();
                        let index = if indexed { format!("[{i}]") } else { String::new() };
                        let at = Place { field: format!("{}{index}", self.at.field), ..self.at.clone() };
                        at.error(format!("`{name}` has no vertex {number} (they count from 0)"))
                    })
                };
                numbers.iter().enumerate().map(vertex).collect::<Result<_, _>>()?
            }
            Selection::MeshVertices(vertices) => vertices.clone(),
            Selection::Property(property) => cloth.vertices_with(property).ok_or_else(|| {
                let known: Vec<&str> = cloth.properties.iter().map(|property| &property.name[..]).collect();
                let known = if known.is_empty() { "its file has none".to_owned() } else { known.join(", ") };
                self.at.error(format!("`{name}` has no vertex property named `{property}` ({known})"))
            })?,
            Selection::Box { low, high } => region(&cloth.mesh, |p| p.cmpge(*low).all() && p.cmple(*high).all()),
            Selection::Sphere { center, radius_m } => region(&cloth.mesh, |p| p.distance(*center) <= *radius_m),
            Selection::Nearest(count) => {
                let followed = self.follow.map(|(_, obstacle)| &obstacles[obstacle as usize]);
                followed.map_or(Vec::new(), |obstacle| nearest(&cloth.mesh, obstacle, *count))
            }
            Selection::NearestTo { point, count } => nearest_by(&cloth.mesh, |p| p.distance(*point), *count),
        };
        if vertices.is_empty() {
            return Err(self.at.error(format!("selects no vertex of `{name}`")));
        }
        // The sides of a sheet are those of its own level, meshes from files are selected from at their finest one.
        Ok(if piece.sheet.is_none() && !piece.refinement.is_none() {
            piece.refinement.coarse_of(&vertices)
        } else {
            vertices
        })
    }

    /// The pin of one vertex of the scene's mesh.
    /// `motions` = number of the scene's motions.
    pub(super) fn hold(&self, vertex: u32, motions: u32) -> Pin {
        let motion = self.motion.or(self.follow.map(|(followed, _)| motions + followed));
        let Self { start_s, end_s, stiffness_n_m, on_touch, .. } = *self;
        Pin { vertex, motion, start_s, end_s, stiffness_n_m, on_touch }
    }
}

/// A side of a sheet, seen with the warp pointing right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Edge {
    Left,
    Right,
    Bottom,
    Top,
}

/// Names of the corners in scene files, as (right, top).
pub(super) const CORNERS: [(&str, (bool, bool)); 4] = [
    ("bottom-left", (false, false)),
    ("bottom-right", (true, false)),
    ("top-left", (false, true)),
    ("top-right", (true, true)),
];

/// Names of the edges in scene files.
pub(super) const EDGES: [(&str, Edge); 4] =
    [("left", Edge::Left), ("right", Edge::Right), ("bottom", Edge::Bottom), ("top", Edge::Top)];

/// The vertices along an edge, from left to right or from bottom to top.
fn edge(sheet: &SheetMesh, edge: Edge) -> Vec<u32> {
    match edge {
        Edge::Left => sheet.side(0, false),
        Edge::Right => sheet.side(0, true),
        Edge::Bottom => sheet.side(1, false),
        Edge::Top => sheet.side(1, true),
    }
}

/// The vertices along the edge of this name; none if there is no such edge.
pub(super) fn sheet_edge(sheet: &SheetMesh, name: &str) -> Option<Vec<u32>> {
    let (_, which) = EDGES.into_iter().find(|(known, _)| *known == name).filter(|_| sheet.has_sides())?;
    Some(edge(sheet, which))
}

/// Selects `count` of the vertices, evenly spread and including the first and the last; all vertices if there are
/// fewer.
pub(super) fn evenly(vertices: &[u32], count: usize) -> Vec<u32> {
    let last = vertices.len() - 1;
    if count > last {
        return vertices.to_vec();
    }
    if count == 1 {
        return vec![vertices[0]];
    }
    // Rounded to the nearest vertex. The spacing is at least one vertex, so no vertex is chosen twice.
    (0..count).map(|i| vertices[(2 * i * last + count - 1) / (2 * (count - 1))]).collect()
}

/// Every vertex whose position satisfies `inside`.
pub(super) fn region(mesh: &TriangleMesh, inside: impl Fn(DVec3) -> bool) -> Vec<u32> {
    (0..).zip(&mesh.positions).filter(|(_, p)| inside(p.as_dvec3())).map(|(v, _)| v).collect()
}

/// The `count` vertices that are nearest to an obstacle at time 0, ascending; of equally near ones the first.
fn nearest(mesh: &TriangleMesh, obstacle: &Obstacle, count: usize) -> Vec<u32> {
    let mut values = Vec::new();
    Obstacles::new(std::slice::from_ref(obstacle)).positions_at(0.0, &mut values);
    let surface = NearestPoint::new(bytemuck::cast_slice(&values), &obstacle.triangles);
    nearest_by(mesh, |p| surface.to(p).map_or(f64::INFINITY, |point| point.distance_m), count)
}

/// The `count` vertices with the smallest `distance_m`, ascending; of equally near ones the first.
fn nearest_by(mesh: &TriangleMesh, distance_m: impl Fn(DVec3) -> f64, count: usize) -> Vec<u32> {
    let distance = |p: &Vec3| distance_m(p.as_dvec3());
    let mut by_distance: Vec<(f64, u32)> = mesh.positions.iter().map(distance).zip(0..).collect();
    by_distance.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    by_distance.truncate(count);
    let mut vertices: Vec<u32> = by_distance.into_iter().map(|(_, vertex)| vertex).collect();
    vertices.sort_unstable();
    vertices
}

/// Sorts the pins by vertex and start time and merges repetitions. An error is a vertex that two different pins hold at
/// once.
pub(super) fn without_conflicts(mut pins: Vec<Pin>) -> Result<Vec<Pin>, u32> {
    pins.sort_by(|a, b| {
        a.vertex.cmp(&b.vertex).then(a.start_s.total_cmp(&b.start_s)).then(b.end_s.total_cmp(&a.end_s))
    });
    let mut kept: Vec<Pin> = Vec::with_capacity(pins.len());
    for pin in pins {
        match kept.last_mut() {
            Some(last) if last.vertex == pin.vertex && pin.start_s <= last.end_s => {
                // Overlapping holds by the same motion (a corner and its edge) are merged.
                let as_the_last = Pin { start_s: last.start_s, end_s: last.end_s, ..pin };
                if as_the_last != *last {
                    return Err(pin.vertex);
                }
                last.end_s = last.end_s.max(pin.end_s);
            }
            _ => kept.push(pin),
        }
    }
    Ok(kept)
}

#[cfg(test)]
mod tests {
    use super::super::Sheet;
    use super::*;
    use crate::mesh::{NestedSheet, Outline};

    #[test]
    fn corners_and_edges_of_a_grid() {
        let sheet = SheetMesh::Grid { grid: Sheet { columns: 3, rows: 2 }, size_m: [3.0, 2.0] };
        assert_eq!(CORNERS.map(|(_, (right, top))| sheet.corner(right, top)), [0, 3, 8, 11]);
        assert_eq!(
            EDGES.map(|(_, which)| edge(&sheet, which)),
            [vec![0, 4, 8], vec![3, 7, 11], vec![0, 1, 2, 3], vec![8, 9, 10, 11]]
        );
    }

    #[test]
    fn corners_and_edges_of_an_irregular_sheet_agree() {
        let sheet = SheetMesh::Nested { sheet: NestedSheet::new(Outline::Rectangle([3.0, 2.0]), 1_000), level: 2 };
        let [left, right, bottom, top] = EDGES.map(|(_, which)| edge(&sheet, which));
        let ends = |side: &[u32]| [side[0], side[side.len() - 1]];
        let corners = CORNERS.map(|(_, (right, top))| sheet.corner(right, top));
        assert_eq!([ends(&bottom), ends(&top)].concat(), corners);
        assert_eq!([ends(&left), ends(&right)], [[corners[0], corners[2]], [corners[1], corners[3]]]);
    }

    #[test]
    fn evenly_spread_pins_contain_both_ends_once() {
        let vertices: Vec<u32> = (0..11).collect();
        assert_eq!(evenly(&vertices, 1), [0]);
        assert_eq!(evenly(&vertices, 2), [0, 10]);
        assert_eq!(evenly(&vertices, 5), [0, 3, 5, 8, 10]);
        for count in 2..=11 {
            let mut chosen = evenly(&vertices, count);
            chosen.dedup();
            assert_eq!((chosen.len(), chosen[0], chosen[count - 1]), (count, 0, 10));
        }
        assert_eq!(evenly(&vertices, 99), vertices);
    }

    #[test]
    fn overlapping_holds_are_joined_or_refused() {
        let pin = Pin::new;
        let two_times = vec![pin(4, None, 0.0, 1.0), pin(4, Some(0), 2.0, 3.0)];
        assert_eq!(without_conflicts(two_times.clone()), Ok(two_times));
        assert_eq!(
            without_conflicts(vec![pin(4, None, 0.5, 9.0), pin(4, None, 0.0, 1.0)]),
            Ok(vec![pin(4, None, 0.0, 9.0)])
        );
        assert_eq!(without_conflicts(vec![pin(4, None, 0.0, 1.0), pin(4, Some(0), 1.0, 3.0)]), Err(4));
        let soft = Pin { stiffness_n_m: Some(5.0), ..pin(4, None, 0.0, 1.0) };
        assert_eq!(without_conflicts(vec![pin(4, None, 0.0, 1.0), soft]), Err(4));
    }
}
