//! The values of maps at the vertices of pieces of cloth.

use crate::math::Vec2;
use crate::mesh::FileMesh;

use super::cloth_source::Shape;
use super::maps::{MapSource, Quantity, Values};
use super::pieces::Piece;
use super::{Maps, SceneError};

/// The factors of the vertices of all pieces, in their order.
pub(super) fn merged_maps(pieces: &[Piece]) -> Result<Maps, SceneError> {
    let mut maps = Maps::default();
    let vertices = pieces.iter().map(|piece| piece.cloth.mesh.positions.len()).sum();
    let mut first = 0;
    for piece in pieces {
        for map in &piece.source.maps {
            let factors = factors(map, piece)?;
            let list = maps.of(map.quantity);
            list.resize(vertices, 1.0);
            list[first..first + factors.len()].copy_from_slice(&factors);
        }
        first += piece.cloth.mesh.positions.len();
    }
    Ok(maps)
}

/// Factors of the vertices of a piece.
///
/// # Errors
/// The piece has no such property or no texture coordinates, or a factor is out of range.
fn factors(map: &MapSource, piece: &Piece) -> Result<Vec<f32>, SceneError> {
    let name = &piece.source.name;
    let cloth = piece.selected_from();
    let values = match &map.values {
        Values::Property(property) => cloth.values_of(property).ok_or_else(|| {
            let known: Vec<&str> = cloth.properties.iter().map(|property| &property.name[..]).collect();
            let known = if known.is_empty() { "its file has none".to_owned() } else { known.join(", ") };
            map.at.error(format!("`{name}` has no vertex property named `{property}` ({known})"))
        })?,
        Values::Image(image) => {
            let uv = texture_of(piece, cloth).ok_or_else(|| {
                let what = "has no texture coordinates; an image needs a sheet, or a mesh with one at every corner";
                map.at.error(format!("`{name}` {what}"))
            })?;
            uv.iter().map(|uv| image.at(uv.as_dvec2())).collect()
        }
    };
    let [from, to] = map.factors;
    let [least, most] = map.quantity.range();
    let mut factors = Vec::with_capacity(values.len());
    for (vertex, value) in values.into_iter().enumerate() {
        let factor = from + (to - from) * value;
        if !(least..=most).contains(&factor) {
            let what = match map.quantity {
                Quantity::Thickness => "; simulation.thickness_m is the largest thickness",
                _ => "",
            };
            let vertex = cloth.file_vertex(vertex as u32);
            return Err(map.at.error(format!(
                "the factor of vertex {vertex} of `{name}` is {factor}; it must be from {least} to {most}{what}"
            )));
        }
        factors.push(factor as f32);
    }
    let is_coarser = factors.len() != piece.cloth.mesh.positions.len();
    let copies = &piece.refinement.copies;
    Ok(if is_coarser { copies.iter().map(|&vertex| factors[vertex as usize]).collect() } else { factors })
}

/// Texture coordinates of the vertices that pins are selected from, 0 to 1 over an image: of a sheet its width and
/// height.
fn texture_of(piece: &Piece, cloth: &FileMesh) -> Option<Vec<Vec2>> {
    match &piece.source.shape {
        Shape::Sheet(sheet) => {
            let [low, high] = sheet.outline.bounds();
            let mut uv = vec![Vec2::ZERO; cloth.mesh.positions.len()];
            for (corners, material) in cloth.mesh.triangles.iter().zip(&cloth.mesh.material_uv) {
                for (&corner, &place) in corners.iter().zip(material) {
                    uv[corner as usize] = ((place.as_dvec2() - low) / (high - low)).as_vec2();
                }
            }
            Some(uv)
        }
        Shape::Mesh(_) => cloth.texture(),
        Shape::Garment(_) | Shape::Pattern(_) => None,
    }
}
