//! Turns the content of a mesh file into a mesh for simulation: rest shape, welding, winding, unused vertices.

use std::path::Path;

use crate::math::{DVec3, Vec2, Vec3};

use super::{
    FileSeam, MeshFault, Part, Refinement, Surface, TextureFit, TriangleMesh, VertexProperty, coarser,
    flatten_triangles, material, validate, weld, winding,
};

/// Source of the material (rest) coordinates of a mesh file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MaterialSource {
    /// The file's texture coordinates, in meters, if every corner has one and they preserve the lengths of the mesh in
    /// space ([`TextureFit::is_isometric`]). Otherwise its 3D shape, because texture coordinates of images run from 0
    /// to 1.
    #[default]
    Auto,
    /// The file's texture coordinates, in meters, if every corner has one, else its 3D shape.
    TextureOrShape,
    /// Always the 3D shape.
    Shape,
}

/// Options for the conversion of a mesh file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshOptions {
    /// Source of the rest shape.
    pub material: MaterialSource,
    /// Vertices within this distance are joined, in the unit of the file; none = all vertices are kept.
    pub weld: Option<f64>,
    /// Meters per unit of the file.
    pub unit_m: f64,
}

impl Default for MeshOptions {
    fn default() -> MeshOptions {
        MeshOptions { material: MaterialSource::default(), weld: None, unit_m: 1.0 }
    }
}

impl From<MaterialSource> for MeshOptions {
    fn from(material: MaterialSource) -> MeshOptions {
        MeshOptions { material, ..MeshOptions::default() }
    }
}

/// Marks a vertex that is not in the mesh, in [`FileMesh::mesh_vertices`].
const NONE: u32 = u32::MAX;

impl Surface {
    /// Builds and validates the mesh. Vertices in no triangle are dropped. Triangles wound against their neighbors are
    /// flipped if that makes the winding consistent.
    pub fn into_mesh(self, options: impl Into<MeshOptions>) -> Result<FileMesh, MeshFault> {
        let options = options.into();
        let Surface { base, mut positions, mut triangles, mut texture_uv, parts, properties, edges, seams } = self;
        let mut joined = None;
        if let Some(distance) = options.weld {
            validate::check_triangles(&positions, &triangles)?;
            let first = weld::joined(&positions, distance);
            triangles.iter_mut().flatten().for_each(|v| *v = first[*v as usize]);
            let collapsed = |t: &[u32; 3]| t[0] == t[1] || t[1] == t[2] || t[2] == t[0];
            if let Some(t) = triangles.iter().position(collapsed) {
                return Err(MeshFault::Collapsed(t + 1));
            }
            joined = Some(first);
        }
        let mut turned = 0;
        let used = match validate::check_surface(&positions, &triangles) {
            Err(MeshFault::MixedOrientation { .. }) => {
                // Edges with too many triangles must be found before any triangle is flipped.
                let over = winding::turn_over(&triangles)?;
                turned = over.iter().filter(|&&over| over).count();
                (0..).zip(&over).filter(|(_, over)| **over).for_each(|(t, _): (usize, _)| {
                    triangles[t].swap(1, 2);
                    texture_uv.get_mut(t).into_iter().for_each(|uv| uv.swap(1, 2));
                });
                validate::check_surface(&positions, &triangles)?
            }
            other => other?,
        };
        let welded = joined.iter().flatten().zip(0..).filter(|&(&first, vertex)| first != vertex).count();
        let mut mesh_vertices = None;
        let in_file = used.len();
        if used.contains(&false) {
            let mut numbers = vec![NONE; in_file];
            let mut kept = Vec::new();
            (0..in_file).filter(|&vertex| used[vertex]).for_each(|vertex| {
                numbers[vertex] = kept.len() as u32;
                kept.push(positions[vertex]);
            });
            triangles.iter_mut().flatten().for_each(|v| *v = numbers[*v as usize]);
            positions = kept;
            if let Some(first) = &joined {
                // A joined vertex gets the number of the vertex that it was joined with.
                numbers = first.iter().map(|&first| numbers[first as usize]).collect();
            }
            mesh_vertices = Some(numbers);
        }
        // If all texture triangles have zero area (exporters write `vt 0 0` for "none"), the coordinates do not
        // describe a rest shape.
        let is_a_map = texture_uv.iter().any(|uv| material::doubled_area(uv) != 0.0);
        let fit = is_a_map.then(|| TextureFit::new(&positions, &triangles, &texture_uv));
        let from_texture = match (options.material, &fit) {
            (MaterialSource::Auto, Some(fit)) => fit.is_isometric(),
            (MaterialSource::TextureOrShape, Some(_)) => true,
            _ => false,
        };
        let texture = if is_a_map { of_corners(positions.len(), &triangles, &texture_uv) } else { Vec::new() };
        let mut material_uv = if from_texture { texture_uv } else { flatten_triangles(&positions, &triangles) };
        material::mirror_clockwise(&mut material_uv);
        let dropped = in_file - positions.len() - welded;
        let mesh = TriangleMesh { positions, triangles, material_uv };
        validate::check_material(&mesh)?;
        let material = options.material;
        Ok(FileMesh {
            base,
            mesh,
            parts,
            properties,
            edges,
            seams,
            mesh_vertices,
            added: Vec::new(),
            texture,
            dropped,
            welded,
            turned,
            fit,
            material,
            from_texture,
        })
    }
}

/// A mesh from a file, with a record of its repairs.
#[derive(Clone, Debug, PartialEq)]
pub struct FileMesh {
    /// Point that the positions of `mesh` are relative to: that of its file, zero once it is placed.
    pub(crate) base: DVec3,
    /// The mesh. Its vertices keep the order of the file.
    pub mesh: TriangleMesh,
    /// Objects and groups of the file.
    pub parts: Vec<Part>,
    /// Further numbers of the vertices of the file.
    pub properties: Vec<VertexProperty>,
    /// Edges that the file names: vertices of the file from end to end.
    pub edges: Vec<(String, Vec<u32>)>,
    /// Seams of the file: name, and the vertices of the file along both sides.
    pub seams: Vec<FileSeam>,
    /// The mesh vertex of every vertex of the file; none if they are equal.
    mesh_vertices: Option<Vec<u32>>,
    /// The ends of the edge of each vertex that was added after those of the file ([`FileMesh::divide`],
    /// [`FileMesh::cut_edges`]).
    added: Vec<[u32; 2]>,
    /// Texture coordinates of the vertices of the file that are in the mesh, of the last one of their corners; empty if
    /// it has none.
    texture: Vec<Vec2>,
    /// Vertices of the file in no triangle. They are dropped, because they have no mass.
    pub dropped: usize,
    /// Vertices that were joined with an earlier vertex.
    pub welded: usize,
    /// Triangles that were flipped.
    pub turned: usize,
    /// Fit of the file's texture coordinates, if it has any.
    pub fit: Option<TextureFit>,
    material: MaterialSource,
    from_texture: bool,
}

impl From<TriangleMesh> for FileMesh {
    fn from(mesh: TriangleMesh) -> FileMesh {
        FileMesh {
            base: DVec3::ZERO,
            mesh,
            parts: Vec::new(),
            properties: Vec::new(),
            edges: Vec::new(),
            seams: Vec::new(),
            mesh_vertices: None,
            added: Vec::new(),
            texture: Vec::new(),
            dropped: 0,
            welded: 0,
            turned: 0,
            fit: None,
            material: MaterialSource::Shape,
            from_texture: false,
        }
    }
}

impl FileMesh {
    /// The mesh vertex with this number (from 0) in the file; none if it was dropped or does not exist.
    pub fn vertex(&self, file_vertex: u32) -> Option<u32> {
        match &self.mesh_vertices {
            None => ((file_vertex as usize) < self.mesh.positions.len() - self.added.len()).then_some(file_vertex),
            Some(numbers) => numbers.get(file_vertex as usize).copied().filter(|&vertex| vertex != NONE),
        }
    }

    /// Number of vertices in the file.
    pub fn file_vertices(&self) -> u32 {
        let kept = self.mesh.positions.len() - self.added.len();
        self.mesh_vertices.as_ref().map_or(kept, Vec::len) as u32
    }

    /// The number in the file of a mesh vertex; of several joined ones the first. Vertices that were added have the
    /// numbers after those of the file.
    pub fn file_vertex(&self, vertex: u32) -> u32 {
        match &self.mesh_vertices {
            None => vertex,
            Some(numbers) => {
                let first = self.mesh.positions.len() - self.added.len();
                let after = || numbers.len() + (vertex as usize).saturating_sub(first);
                numbers.iter().position(|&number| number == vertex).unwrap_or_else(after) as u32
            }
        }
    }

    /// The vertices of the file along a named edge, from end to end.
    pub fn edge_named(&self, name: &str) -> Option<Vec<u32>> {
        self.edges.iter().find(|(known, _)| known == name).map(|(_, vertices)| vertices.clone())
    }

    /// Names of all edges.
    pub fn edge_names(&self) -> Vec<String> {
        self.edges.iter().map(|(name, _)| name.clone()).collect()
    }

    /// The group, or without one the object, of a triangle.
    pub fn part_of(&self, triangle: u32) -> Option<&str> {
        let part = self.parts.iter().find(|part| part.triangles.contains(&triangle))?;
        Some(if part.group.is_empty() { &part.object } else { &part.group })
    }

    /// Divides every triangle into four flat ones, this many times. The vertices of the file stay the first ones.
    pub(crate) fn divide(&mut self, times: u32) {
        for _ in 0..times {
            self.added.extend(self.mesh.halved_edges());
            self.mesh = self.mesh.divided();
            for part in &mut self.parts {
                part.triangles = 4 * part.triangles.start..4 * part.triangles.end;
            }
        }
    }

    /// Notes that a vertex was added on the edge with these ends.
    pub(super) fn note_added(&mut self, ends: [u32; 2]) {
        self.added.push(ends);
    }

    /// The mesh whose triangles are divided into four in this one, if there is one.
    pub fn coarser(&self) -> Option<(FileMesh, Refinement)> {
        let (mesh, refinement) = coarser(&self.mesh, !self.from_texture)?;
        // Coarse triangles have the order of those in their middles, so those of a part stay together.
        let centers: Vec<u32> = refinement.triangles.iter().skip(3).step_by(4).copied().collect();
        let coarse = |fine: u32| centers.partition_point(|&center| center < fine) as u32;
        let own =
            |part: &Part| Part { triangles: coarse(part.triangles.start)..coarse(part.triangles.end), ..part.clone() };
        let parts = self.parts.iter().map(own).collect();
        Some((FileMesh { parts, from_texture: self.from_texture, ..FileMesh::from(mesh) }, refinement))
    }

    /// The vertices at which a property of the file is 0.5 or more, ascending; none if the file has no such property.
    /// An added vertex has it if both ends of its edge do.
    pub fn vertices_with(&self, name: &str) -> Option<Vec<u32>> {
        let property = self.properties.iter().find(|property| property.name == name)?;
        let chosen = (0u32..).zip(&property.values).filter(|(_, value)| **value >= 0.5);
        let mut vertices: Vec<u32> = chosen.filter_map(|(vertex, _)| self.vertex(vertex)).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let first = self.mesh.positions.len() - self.added.len();
        let mut has = vec![false; first];
        vertices.iter().for_each(|&vertex| has[vertex as usize] = true);
        for &[a, b] in &self.added {
            has.push(has[a as usize] && has[b as usize]);
        }
        vertices.extend((first..has.len()).filter(|&vertex| has[vertex]).map(|vertex| vertex as u32));
        Some(vertices)
    }

    /// The values of a property of the file at all vertices; none if the file has no such property. Of joined vertices
    /// the first one counts, and an added vertex has the mean of the ends of its edge.
    pub fn values_of(&self, name: &str) -> Option<Vec<f64>> {
        let property = self.properties.iter().find(|property| property.name == name)?;
        let mut values = vec![0.0; self.mesh.positions.len() - self.added.len()];
        for (vertex, &value) in (0..property.values.len() as u32).zip(&property.values).rev() {
            if let Some(vertex) = self.vertex(vertex) {
                values[vertex as usize] = f64::from(value);
            }
        }
        for &[a, b] in &self.added {
            values.push(0.5 * (values[a as usize] + values[b as usize]));
        }
        Some(values)
    }

    /// Texture coordinates of all vertices; none if the file has none. Of a vertex with several the last one counts,
    /// and an added vertex has the mean of the ends of its edge.
    pub fn texture(&self) -> Option<Vec<Vec2>> {
        let mut uv = self.texture.clone();
        for &[a, b] in &self.added {
            uv.push(uv.get(a as usize)?.midpoint(*uv.get(b as usize)?));
        }
        (uv.len() == self.mesh.positions.len()).then_some(uv)
    }

    /// The vertices of the triangles in an object or group, ascending; none if the file has no such name.
    pub fn vertices_of(&self, name: &str) -> Vec<u32> {
        let named = self.parts.iter().filter(|part| part.is_named(name));
        let triangles =
            named.flat_map(|part| &self.mesh.triangles[part.triangles.start as usize..part.triangles.end as usize]);
        let mut vertices: Vec<u32> = triangles.flatten().copied().collect();
        vertices.sort_unstable();
        vertices.dedup();
        vertices
    }

    /// A sentence about dropped vertices, if there are any.
    pub fn left_out(&self, path: &Path) -> Option<String> {
        let what = match self.dropped {
            0 => return None,
            1 => "1 vertex belongs to no triangle and is left out".to_owned(),
            count => format!("{count} vertices belong to no triangle and are left out"),
        };
        Some(format!("{}: {what}", path.display()))
    }

    /// Sentences about repairs.
    pub fn repairs(&self, path: &Path) -> Vec<String> {
        let mut lines = Vec::new();
        let mut say = |what: String| lines.push(format!("{}: {what}", path.display()));
        match self.turned {
            0 => {}
            1 => say("1 triangle was wound against its neighbors and is turned over".into()),
            count => say(format!("{count} triangles were wound against their neighbors and are turned over")),
        }
        match self.welded {
            0 => {}
            1 => say("1 vertex is joined with another one within weld_m".into()),
            count => say(format!("{count} vertices are joined with others within weld_m")),
        }
        lines
    }

    /// Areas of the texture coordinates and of the mesh in space as half a sentence, if the coordinates do not keep the
    /// lengths of the mesh. `scale` = meters per unit of the file.
    pub fn texture_areas(&self, scale: f64) -> Option<String> {
        let fit = self.fit.filter(|fit| !fit.is_isometric())?;
        let [texture, space] = [fit.texture_m2, fit.space_m2].map(|area| shown(area * scale * scale));
        let kept = (100.0 * fit.isometric).floor();
        Some(format!(
            "its texture coordinates, taken as metres, cover {texture} m^2 where the mesh has {space} m^2 in space \
             ({kept} % of it keeps its lengths within 20 %)"
        ))
    }

    /// The sentences of [`FileMesh::repairs`] and further ones about probable mistakes. `scale` = meters per unit of
    /// the file.
    pub fn warnings(&self, path: &Path, scale: f64) -> Vec<String> {
        let mut lines = self.repairs(path);
        let mut say = |what: String| lines.push(format!("{}: {what}", path.display()));
        if let Some(areas) = self.texture_areas(scale) {
            match self.material {
                MaterialSource::Auto => say(format!(
                    "{areas}, so its shape in space is the rest shape; `material = \"uv\"` takes the texture coordinates all the same"
                )),
                MaterialSource::TextureOrShape if self.from_texture => say(format!(
                    "{areas}: the cloth will spring to that size; `material = \"shape\"` takes its shape in space as the rest shape"
                )),
                _ => {}
            }
        }
        lines
    }

    /// The longest side of the bounding box.
    pub fn extent(&self) -> f64 {
        extent(&self.mesh.positions)
    }
}

/// Values of vertices from those of the corners of triangles; that of the last corner counts.
fn of_corners(vertices: usize, triangles: &[[u32; 3]], of_corner: &[[Vec2; 3]]) -> Vec<Vec2> {
    let mut values = vec![Vec2::ZERO; vertices];
    for (corners, uv) in triangles.iter().zip(of_corner) {
        corners.iter().zip(uv).for_each(|(&corner, &uv)| values[corner as usize] = uv);
    }
    values
}

/// The longest side of the bounding box of points.
pub fn extent(points: &[Vec3]) -> f64 {
    let (low, high) = points.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(l, h), &p| (l.min(p), h.max(p)));
    if points.is_empty() { 0.0 } else { (high.as_dvec3() - low.as_dvec3()).max_element() }
}

/// The number with four significant digits.
fn shown(value: f64) -> String {
    if (1e-3..1e6).contains(&value) {
        let digits = (3.0 - value.log10().floor()).clamp(0.0, 6.0) as usize;
        let text = format!("{value:.digits$}");
        if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
    } else {
        format!("{value:.3e}")
    }
}
