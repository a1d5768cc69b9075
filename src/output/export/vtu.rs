//! VTK's unstructured grids (`.vtu`, raw appended data) and their list with times (`.pvd`), for ParaView.

use std::io::{self, Write};
use std::path::Path;

use super::{Animation, ExportError, Track};
use crate::math::{DIM, Vec2};
use crate::output::{FrameMesh, WriteError, principal_stretches, write_atomically};

/// VTK's number for a triangle.
const TRIANGLE: u8 = 5;

/// Writes all tracks in a frame as one grid. Cells have `piece` (the number of the track from 0), `obstacle` (0 or 1)
/// and, for cloth with a shape at rest, `stretch_max` and `stretch_min` (length / length at rest; 1 elsewhere). Points
/// have the further values of the animation; at obstacles they are -1, vectors 0.
pub fn write_vtu(path: &Path, animation: &Animation, frame: u32) -> Result<(), ExportError> {
    let mut grid = Grid::default();
    for (number, track) in animation.tracks.iter().enumerate() {
        grid.add(number as i32, track.obstacle, &animation.mesh(track, frame)?, &track.uv);
    }
    if let Some(values) = &animation.values {
        let cloth = animation.source.read(frame)?.positions;
        for (name, of_cloth) in values(frame, &cloth) {
            let width = if of_cloth.len() == DIM * cloth.len() { DIM } else { 1 };
            let elsewhere = if width == 1 { -1.0 } else { 0.0 };
            let own = |track: &Track| {
                let range = width * track.vertices.start..width * track.vertices.end;
                match of_cloth.get(range.clone()).filter(|_| !track.obstacle) {
                    Some(own) => own.to_vec(),
                    None => vec![elsewhere; range.len()],
                }
            };
            grid.values.push((name, width, animation.tracks.iter().flat_map(own).collect()));
        }
    }
    write_atomically(path, |out| grid.write(out)).map_err(ExportError::Write)
}

/// Writes the list of the frames' files, with their times. `name` = the file name of a frame, beside the list.
pub fn write_pvd(path: &Path, animation: &Animation, name: impl Fn(u32) -> String) -> Result<(), WriteError> {
    write_atomically(path, |out| {
        out.write_all(b"<?xml version=\"1.0\"?>\n<VTKFile type=\"Collection\" version=\"0.1\">\n  <Collection>\n")?;
        for frame in animation.frames() {
            let (time_s, file) = (animation.time_s(frame), name(frame));
            writeln!(out, "    <DataSet timestep=\"{time_s}\" part=\"0\" file=\"{file}\"/>")?;
        }
        out.write_all(b"  </Collection>\n</VTKFile>\n")
    })
}

#[derive(Default)]
struct Grid {
    points: Vec<f32>,
    corners: Vec<i32>,
    piece: Vec<i32>,
    obstacle: Vec<u8>,
    stretch: [Vec<f32>; 2],
    /// Of points: name, values per point, values.
    values: Vec<(&'static str, usize, Vec<f32>)>,
}

impl Grid {
    fn add(&mut self, number: i32, obstacle: bool, mesh: &FrameMesh, uv: &[[Vec2; 3]]) {
        let first = (self.points.len() / 3) as i32;
        self.points.extend(mesh.positions.iter().flat_map(|p| p.to_array()));
        for (t, corners) in mesh.triangles.iter().enumerate() {
            self.corners.extend(corners.map(|v| first + v as i32));
            self.piece.push(number);
            self.obstacle.push(u8::from(obstacle));
            let at = corners.map(|v| mesh.positions[v as usize]);
            let stretch = uv.get(t).map_or([1.0; 2], |uv| principal_stretches(at, *uv));
            self.stretch.iter_mut().zip(stretch).for_each(|(all, own)| all.push(own as f32));
        }
    }

    fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        let cells = self.piece.len();
        let ends: Vec<i32> = (1..=cells as i32).map(|cell| 3 * cell).collect();
        let kinds = vec![TRIANGLE; cells];
        let mut arrays: Vec<(&str, &str, &str, &[u8])> = vec![
            ("Points", "points", "Float32\" NumberOfComponents=\"3", bytemuck::cast_slice(&self.points)),
            ("Cells", "connectivity", "Int32", bytemuck::cast_slice(&self.corners)),
            ("Cells", "offsets", "Int32", bytemuck::cast_slice(&ends)),
            ("Cells", "types", "UInt8", &kinds),
            ("CellData", "piece", "Int32", bytemuck::cast_slice(&self.piece)),
            ("CellData", "obstacle", "UInt8", &self.obstacle),
            ("CellData", "stretch_max", "Float32", bytemuck::cast_slice(&self.stretch[0])),
            ("CellData", "stretch_min", "Float32", bytemuck::cast_slice(&self.stretch[1])),
        ];
        arrays.extend(self.values.iter().map(|(name, width, values)| {
            let kind = if *width == DIM { "Float32\" NumberOfComponents=\"3" } else { "Float32" };
            ("PointData", *name, kind, bytemuck::cast_slice(values))
        }));
        let points = self.points.len() / 3;
        write!(
            out,
            "<?xml version=\"1.0\"?>\n<VTKFile type=\"UnstructuredGrid\" version=\"1.0\" byte_order=\"LittleEndian\" \
             header_type=\"UInt64\">\n<UnstructuredGrid>\n\
             <Piece NumberOfPoints=\"{points}\" NumberOfCells=\"{cells}\">\n"
        )?;
        let mut offset = 0;
        for (i, (section, name, kind, bytes)) in arrays.iter().enumerate() {
            if i == 0 || arrays[i - 1].0 != *section {
                writeln!(out, "<{section}>")?;
            }
            writeln!(out, "<DataArray type=\"{kind}\" Name=\"{name}\" format=\"appended\" offset=\"{offset}\"/>")?;
            if arrays.get(i + 1).is_none_or(|next| next.0 != *section) {
                writeln!(out, "</{section}>")?;
            }
            offset += size_of::<u64>() + bytes.len();
        }
        out.write_all(b"</Piece>\n</UnstructuredGrid>\n<AppendedData encoding=\"raw\">\n_")?;
        for (_, _, _, bytes) in &arrays {
            out.write_all(&(bytes.len() as u64).to_le_bytes())?;
            out.write_all(bytes)?;
        }
        out.write_all(b"\n</AppendedData>\n</VTKFile>\n")
    }
}
