//! A run as pictures show it: its frames without what is hidden, in its colors.

use std::ops::Range;

use super::options::Coloring;
use super::palette::{self, Scale};
use crate::math::Vec3;
use crate::mesh::pieces;
use crate::output::{FrameMesh, FrameSource, FramesError};

/// What is known of the vertices of a run besides its frames.
pub trait VertexValues: Sync {
    /// A value for every vertex of a frame; `positions` as [`FrameSource::read`] gives them.
    ///
    /// # Errors
    /// One sentence: why there are none.
    fn values(&self, coloring: Coloring, frame: u32, positions: &[Vec3]) -> Result<Vec<f32>, String>;
}

/// A run that is drawn.
pub struct Subject<'a> {
    /// Its frames.
    pub source: &'a FrameSource,
    /// Name below the picture where there are several.
    pub name: String,
    /// Hidden vertices of the cloth.
    pub hidden: Vec<Range<usize>>,
    /// Hidden triangles of the obstacles.
    pub hidden_obstacles: Vec<Range<usize>>,
    /// Steps at which segments of a split shot begin, in frames; the first is not among them.
    pub cuts: Vec<f64>,
    /// For colors that need it.
    pub known: Option<&'a dyn VertexValues>,
}

impl<'a> Subject<'a> {
    /// A run of which everything is shown.
    pub fn new(source: &'a FrameSource) -> Subject<'a> {
        Subject {
            source,
            name: String::new(),
            hidden: Vec::new(),
            hidden_obstacles: Vec::new(),
            cuts: Vec::new(),
            known: None,
        }
    }

    /// The cloth of a frame without what is hidden. All positions stay, because values belong to them.
    pub(super) fn cloth(&self, frame: u32) -> Result<FrameMesh, FramesError> {
        let mut mesh = self.source.read(frame)?;
        // A coarse frame has other vertices.
        if !self.hidden.is_empty() && !self.source.is_coarse(frame) {
            let is_hidden = |v: &u32| self.hidden.iter().any(|range| range.contains(&(*v as usize)));
            mesh.triangles.retain(|triangle| !triangle.iter().any(is_hidden));
        }
        Ok(mesh)
    }

    /// Positions of the cloth that is shown.
    pub(super) fn shown(&self, frame: u32, mesh: &FrameMesh) -> Vec<Vec3> {
        if self.hidden.is_empty() || self.source.is_coarse(frame) {
            return mesh.positions.clone();
        }
        let is_hidden = |v: usize| self.hidden.iter().any(|range| range.contains(&v));
        (0..mesh.positions.len()).filter(|v| !is_hidden(*v)).map(|v| mesh.positions[v]).collect()
    }

    /// The obstacles of a frame without what is hidden, if there are any.
    pub(super) fn obstacle(&self, frame: u32) -> Result<Option<FrameMesh>, FramesError> {
        let Some(mut mesh) = self.source.read_obstacle(frame)? else { return Ok(None) };
        if !self.hidden_obstacles.is_empty() {
            let triangles = std::mem::take(&mut mesh.triangles).into_iter().enumerate();
            let is_hidden = |t: usize| self.hidden_obstacles.iter().any(|range| range.contains(&t));
            mesh.triangles = triangles.filter(|(t, _)| !is_hidden(*t)).map(|(_, triangle)| triangle).collect();
        }
        Ok(Some(mesh))
    }

    /// The segment of a split shot that a frame belongs to.
    fn segment(&self, frame: u32) -> usize {
        self.cuts.partition_point(|cut| f64::from(frame) > *cut)
    }

    /// Front and back of every vertex. `values`: those of a scale, with their range.
    pub(super) fn colors(
        &self,
        coloring: Coloring,
        frame: u32,
        mesh: &FrameMesh,
        up: Vec3,
        range: [f32; 2],
    ) -> Result<Vec<[Vec3; 2]>, String> {
        let count = mesh.positions.len();
        let of_scale = |scale: &Scale, values: &mut dyn Iterator<Item = f32>| {
            let [low, high] = range;
            values.map(|x| palette::on_scale(scale, (x - low) / (high - low).max(1e-9))).collect()
        };
        let coarse = self.source.is_coarse(frame);
        match coloring {
            Coloring::Height => Ok(of_scale(&palette::HEIGHT, &mut mesh.positions.iter().map(|p| p.dot(up)))),
            Coloring::Piece => Ok(piece_colors(mesh, 0)),
            Coloring::Shaded => Ok(piece_colors(mesh, 1)),
            Coloring::Segment if !coarse => Ok(vec![palette::category(self.segment(frame)); count]),
            Coloring::Rank | Coloring::Strain | Coloring::Contact if !coarse => {
                let values = self.known.map_or_else(
                    || Err("its scene is not known".into()),
                    |known| known.values(coloring, frame, &mesh.positions),
                )?;
                if values.len() != count {
                    return Err(format!("the frame has {count} vertices and the scene {}", values.len()));
                }
                Ok(match coloring {
                    Coloring::Strain => of_scale(&palette::STRAIN, &mut values.into_iter()),
                    Coloring::Contact => of_scale(&palette::CONTACT, &mut values.into_iter()),
                    _ => values.into_iter().map(|rank| palette::category(rank as usize)).collect(),
                })
            }
            _ => Ok(vec![palette::fabric(); count]),
        }
    }
}

/// A color per vertex by piece, in the order of the pieces' first triangles; as a fabric where there are no more than
/// `alike` pieces.
fn piece_colors(mesh: &FrameMesh, alike: usize) -> Vec<[Vec3; 2]> {
    let root = pieces(mesh.positions.len(), &mesh.triangles);
    const NONE: usize = usize::MAX;
    let mut piece_of_root = vec![NONE; root.len()];
    let mut count = 0;
    for triangle in &mesh.triangles {
        let piece = &mut piece_of_root[root[triangle[0] as usize] as usize];
        if *piece == NONE {
            *piece = count;
            count += 1;
        }
    }
    let color = |root: &u32| match piece_of_root[*root as usize] {
        piece if count > alike && piece != NONE => palette::category(piece),
        _ => palette::fabric(),
    };
    root.iter().map(color).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_numbered_by_their_first_triangles() {
        let mesh = |vertices: usize, triangles: &[[u32; 3]]| FrameMesh {
            positions: vec![Vec3::ZERO; vertices],
            triangles: triangles.to_vec(),
        };
        assert_eq!(piece_colors(&mesh(5, &[[0, 1, 2], [2, 3, 4]]), 1), [palette::fabric(); 5]);
        // Vertices 0, 4, 5 and 1, 2, 3 are two pieces, 6 belongs to none.
        let [one, other] = [palette::category(0), palette::category(1)];
        let fabric = palette::fabric();
        let colors = piece_colors(&mesh(7, &[[3, 2, 1], [0, 4, 5]]), 1);
        assert_eq!(colors, [other, one, one, one, other, other, fabric]);
        assert_eq!(piece_colors(&mesh(3, &[[0, 1, 2]]), 0), [one; 3]);
    }
}
