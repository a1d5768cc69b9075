//! Bodies from Alembic files (`.abc`): polygon meshes whose points have samples, below transforms that may move. The
//! reader is our own: of the crates there are, `ogawa-rs` 0.4.0 reads no transforms and panics on damaged files.

mod ogawa;
mod transform;

use std::path::Path;
use std::rc::Rc;

use crate::input::{Input, Streams};
use crate::math::{DAffine3, Vec3};
use crate::mesh::triangles_of_faces;

use super::SceneError;
use super::sampled::{SampledBody, SampledMesh, around, is_below, placed, sampled};
use ogawa::{Archive, Compound, F32, I32, Object, Property};
use transform::Transform;

/// Limit of the objects in a file, so that a damaged one that names itself as its child comes to an end.
const MOST_OBJECTS: usize = 100_000;
/// Limit of the objects above an object.
const DEEPEST: usize = 200;

/// A mesh with what stands above it.
struct Shape {
    /// Names from the top to the mesh, separated by `/`.
    path: String,
    properties: Compound,
    /// Transforms, the topmost first.
    above: Vec<Rc<Transform>>,
}

/// Reads the meshes of a file; `only` = those of the object with this name or path, and of those below it. At most
/// `most` positions are held.
pub(super) fn read_alembic(path: &Path, only: Option<&str>, most: usize) -> Result<SampledBody, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    let unreadable = |error: std::io::Error| fault(format!("cannot be read: {error}"));
    let mut input = Input::open(path, Streams::Refused).map_err(unreadable)?;
    let mut bytes = Vec::new();
    std::io::Read::read_to_end(&mut input.reader, &mut bytes).map_err(unreadable)?;
    let archive = Archive::new(bytes).map_err(fault)?;
    let shapes = shapes(&archive).map_err(fault)?;
    let all: Vec<&str> = shapes.iter().map(|shape| &shape.path[..]).collect();
    let chosen: Vec<&Shape> =
        shapes.iter().filter(|shape| only.is_none_or(|name| is_below(&shape.path, name))).collect();
    if let (Some(name), true) = (only, chosen.is_empty()) {
        return Err(fault(format!("has no mesh in `{name}`; its meshes are {}", all.join(", "))));
    }
    let meshes = chosen.into_iter().map(|shape| shape.mesh(&archive)).collect::<Result<Vec<SampledMesh>, String>>();
    let meshes = meshes.map_err(fault)?;
    if meshes.is_empty() {
        return Err(fault("has no mesh in it".into()));
    }
    sampled(meshes, most).map_err(fault)
}

/// All meshes of a file, in its order.
fn shapes(archive: &Archive) -> Result<Vec<Shape>, String> {
    let mut shapes = Vec::new();
    let mut waiting = vec![(archive.top()?, String::new(), Vec::new())];
    let mut seen = 0;
    while let Some((object, path, mut above)) = waiting.pop() {
        let properties = object.properties(archive)?;
        if is_of(&object, "AbcGeom_Xform") {
            let transform = Transform::read(archive, &properties, &path)?;
            if !transform.inherits {
                above.clear();
            }
            above.push(Rc::new(transform));
        } else if is_of(&object, "AbcGeom_PolyMesh") || is_of(&object, "AbcGeom_SubD") {
            let inner = properties.compound(archive, ".geom")?;
            let properties = inner.ok_or_else(|| format!("is damaged: `{path}` has no geometry"))?;
            shapes.push(Shape { path: path.clone(), properties, above: above.clone() });
        }
        let children = object.children(archive)?;
        seen += children.len();
        if seen > MOST_OBJECTS || path.matches('/').count() > DEEPEST {
            return Err(format!("has more than {MOST_OBJECTS} objects or more than {DEEPEST} below each other"));
        }
        // The first child is to be looked at next.
        for child in children.into_iter().rev() {
            let path = format!("{path}/{}", child.name);
            waiting.push((child, path, above.clone()));
        }
    }
    Ok(shapes)
}

fn is_of(object: &Object, schema: &str) -> bool {
    object.metadata.split(';').any(|entry| entry.strip_prefix("schema=").is_some_and(|name| name.starts_with(schema)))
}

impl Shape {
    fn mesh<'a>(&'a self, archive: &'a Archive) -> Result<SampledMesh<'a>, String> {
        let path = &self.path;
        let property = |name: &str| {
            let found = self.properties.property(archive, name).filter(|property| property.samples() > 0);
            found.ok_or_else(|| format!("has a mesh without `{name}`: `{path}`"))
        };
        let points = property("P")?;
        let frames = (0..points.samples()).map(|sample| vectors(&points, sample));
        let frames = frames.collect::<Result<Vec<Vec<Vec3>>, String>>()?;
        if let Some(sample) = frames.iter().position(|frame| frame.len() != frames[0].len()) {
            return Err(format!(
                "has a mesh whose points change in number: `{path}` has {}, and {} in sample {sample} (from 0)",
                frames[0].len(),
                frames[sample].len()
            ));
        }
        let constant = |property: &Property| -> Result<Vec<i32>, String> {
            let first = property.bytes(0, I32)?;
            for sample in 1..property.samples() {
                if !property.is_constant() && property.bytes(sample, I32)? != first {
                    let time_s = property.times_s()[sample];
                    return Err(format!(
                        "has a mesh whose faces change: `{path}` in sample {sample} (from 0, {time_s} s)"
                    ));
                }
            }
            Ok(first.as_chunks::<4>().0.iter().map(|word| i32::from_le_bytes(*word)).collect())
        };
        let (counts, corners) = (constant(&property(".faceCounts")?)?, constant(&property(".faceIndices")?)?);
        let mut triangles = clockwise(&counts, &corners, &frames[0]).map_err(|what| format!("`{path}`: {what}"))?;
        let start_s = points.times_s()[0];
        if self.above.iter().map(|transform| transform.at(start_s).matrix3.determinant()).product::<f64>() < 0.0 {
            triangles.iter_mut().for_each(|corners| corners.swap(1, 2));
        }
        let times_s = points.times_s();
        let moves = frames.iter().any(|frame| *frame != frames[0]);
        let turns = self.above.iter().any(|transform| transform.moves());
        let mut all = if moves { times_s.clone() } else { Vec::new() };
        all.extend(self.above.iter().filter(|transform| transform.moves()).flat_map(|transform| &transform.times_s));
        let at = move |time_s: f64| {
            let (before, after, share) = around(&times_s, time_s);
            let transform = self.above.iter().fold(DAffine3::IDENTITY, |all, one| all * one.at(time_s));
            Ok(placed(&frames[before], &frames[after], share, &transform))
        };
        Ok(SampledMesh { name: path.clone(), triangles, times_s: all, turns, rest: None, at: Box::new(at) })
    }
}

fn vectors(property: &Property, sample: usize) -> Result<Vec<Vec3>, String> {
    let words = property.bytes(sample, F32)?.as_chunks::<4>().0;
    if property.extent() != 3 {
        return Err(format!("has points of {} numbers instead of 3", property.extent()));
    }
    let vector =
        |[x, y, z]: &[[u8; 4]; 3]| Vec3::new(f32::from_le_bytes(*x), f32::from_le_bytes(*y), f32::from_le_bytes(*z));
    Ok(words.as_chunks::<3>().0.iter().map(vector).collect())
}

/// The triangles of Alembic's faces, whose corners go round clockwise, counter-clockwise.
fn clockwise(counts: &[i32], corners: &[i32], positions: &[Vec3]) -> Result<Vec<[u32; 3]>, String> {
    let negative = |_| "a face has a negative number".to_owned();
    let counts =
        counts.iter().map(|&count| usize::try_from(count)).collect::<Result<Vec<usize>, _>>().map_err(negative)?;
    let corners = corners.iter().map(|&v| u32::try_from(v)).collect::<Result<Vec<u32>, _>>().map_err(negative)?;
    let mut turned = Vec::with_capacity(corners.len());
    let mut rest = &corners[..];
    for &count in &counts {
        let Some((face, others)) = rest.split_at_checked(count) else { break };
        turned.extend(face.iter().rev());
        rest = others;
    }
    turned.extend(rest);
    triangles_of_faces(&counts, turned, positions)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn faces_are_turned() {
        let square = [Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y];
        let found = clockwise(&[4], &[3, 2, 1, 0], &square).unwrap();
        assert_eq!(found, triangles_of_faces(&[4], vec![0, 1, 2, 3], &square).unwrap());
        assert!(clockwise(&[-1], &[0], &square).unwrap_err().contains("negative"));
        assert!(clockwise(&[3, 4], &[0, 1, 2], &square).unwrap_err().contains("another number of corners"));
        assert!(clockwise(&[3], &[0, 1, 9], &square).unwrap_err().contains("vertex index 9"));
    }
}
