//! Pieces of cloth and their merge into one mesh.

use std::borrow::Cow;

use crate::math::{DVec2, DVec3, Vec3};
use crate::mesh::{EdgeCut, FileMesh, NestedSheet, Outline, Part, Refinement, TriangleMesh, validate};

use super::cloth_source::{ClothSource, GarmentSource, PatternSource, Shape, SheetKind, SheetSource, StartVelocity};
use super::seam_fault::panel_of;
use super::sheet::SheetMesh;
use super::wrap::{Body, wrap};
use super::{Cloth, Fabric, Obstacle, Obstacles, SceneError, sheet_cells};

/// One piece of cloth in its start state.
pub(super) struct Piece<'a> {
    pub source: &'a ClothSource,
    /// The placed mesh. Pins name vertices by their number in the file.
    pub cloth: Cow<'a, FileMesh>,
    /// Present if the piece is a generated sheet.
    pub sheet: Option<SheetMesh>,
    /// True if seams have added vertices.
    is_cut: bool,
    /// True if its panels are bent about a body.
    is_bent: bool,
    /// From this piece to the one that no coarsening was asked for.
    pub refinement: Refinement,
}

impl<'a> Piece<'a> {
    /// Makes the piece. A sheet has `factor` times the triangles that its scene states. Then the piece is taken
    /// `coarsenings` levels coarser; a mesh that does not divide a coarser one so many times stays as it is.
    pub(super) fn new(source: &'a ClothSource, factor: f64, coarsenings: usize) -> Result<Piece<'a>, SceneError> {
        let (cloth, sheet, refinement) = match &source.shape {
            Shape::Mesh(mesh) => {
                let same = Refinement::none(mesh.mesh.positions.len(), mesh.mesh.triangles.len());
                let (cloth, refinement) = coarser_mesh(mesh, coarsenings)
                    .map_or((Cow::Borrowed(mesh), same), |(mesh, refinement)| (Cow::Owned(mesh), refinement));
                (cloth, None, refinement)
            }
            Shape::Garment(source) => unnested(garment_mesh(source, factor)?),
            Shape::Pattern(source) => unnested(pattern_mesh(source, factor)?),
            Shape::Sheet(sheet) => {
                let cells = sheet_mesh(sheet, factor, coarsenings)?;
                let uv = cells.coordinates();
                let in_space = |uv: DVec2| sheet.axes[0] * uv.x + sheet.axes[1] * uv.y;
                let corners = cells.triangle_corners();
                let mut mesh = TriangleMesh {
                    positions: uv.iter().map(|uv| in_space(uv.as_dvec2()).as_vec3()).collect(),
                    material_uv: corners.iter().map(|t| t.map(|v| uv[v as usize])).collect(),
                    triangles: corners,
                };
                sheet.placement.place(&mut mesh, DVec3::ZERO);
                validate(&mesh).map_err(|fault| sheet.at.error(fault.to_string()))?;
                let refinement = cells.refinement();
                (Cow::Owned(FileMesh::from(mesh)), Some(cells), refinement)
            }
        };
        Ok(Piece { source, cloth, sheet, is_cut: false, is_bent: false, refinement })
    }

    /// A mesh that is there already.
    pub(super) fn of_mesh(source: &'a ClothSource, mesh: FileMesh) -> Piece<'a> {
        let refinement = Refinement::none(mesh.mesh.positions.len(), mesh.mesh.triangles.len());
        Piece { source, cloth: Cow::Owned(mesh), sheet: None, is_cut: false, is_bent: false, refinement }
    }

    /// Adds vertices on edges of the piece, which has no coarser level from then on.
    pub(super) fn cut_edges(&mut self, cuts: &[EdgeCut]) -> Vec<u32> {
        let added = self.cloth.to_mut().cut_edges(cuts);
        let mesh = &self.cloth.mesh;
        self.refinement = Refinement::none(mesh.positions.len(), mesh.triangles.len());
        self.is_cut = true;
        added
    }

    /// Bends its panels about the limbs of an obstacle where that is at the start. They keep two thicknesses from it.
    ///
    /// # Errors
    /// Half a sentence: a panel is not flat, or does not hang before the obstacle.
    pub(super) fn wrap(&mut self, obstacle: &Obstacle, thickness_m: f64) -> Result<(), String> {
        let alone = Obstacles::new(std::slice::from_ref(obstacle));
        let mut values = Vec::new();
        alone.positions_at(0.0, &mut values);
        let body = Body {
            name: &obstacle.name,
            positions: bytemuck::cast_slice(&values),
            triangles: alone.triangles(),
            gap_m: 2.0 * thickness_m,
        };
        let FileMesh { mesh, parts, .. } = self.cloth.to_mut();
        self.is_bent = true;
        let name = |triangle: u32| match parts.iter().any(|part| part.triangles.contains(&triangle)) {
            true => panel_of(parts, &[], triangle),
            false => format!("`{}`", self.source.name),
        };
        wrap(mesh, &body, name)
    }

    /// True for a sheet of which every vertex lies exactly in one plane.
    pub(super) fn is_flat(&self) -> bool {
        self.sheet.is_some() && !self.is_cut && !self.is_bent
    }

    /// The mesh that pins select vertices of: a mesh from a file as the file has it, however coarse the piece is.
    pub(super) fn selected_from(&self) -> &FileMesh {
        match &self.source.shape {
            Shape::Mesh(mesh) if !self.is_cut && !self.is_bent => mesh,
            Shape::Mesh(_) | Shape::Sheet(_) | Shape::Garment(_) | Shape::Pattern(_) => &self.cloth,
        }
    }
}

/// A mesh whose triangles are nested in no coarser ones.
fn unnested<'a>(mesh: FileMesh) -> (Cow<'a, FileMesh>, Option<SheetMesh>, Refinement) {
    let same = Refinement::none(mesh.mesh.positions.len(), mesh.mesh.triangles.len());
    (Cow::Owned(mesh), None, same)
}

/// The mesh that `fine` divides into four, `coarsenings` times; none if there is none.
fn coarser_mesh(fine: &FileMesh, coarsenings: usize) -> Option<(FileMesh, Refinement)> {
    let mut found: Option<(FileMesh, Refinement)> = None;
    for _ in 0..coarsenings {
        let (mesh, lower) = found.as_ref().map_or(fine, |(mesh, _)| mesh).coarser()?;
        validate(&mesh.mesh).ok()?;
        let refinement = found.as_ref().map_or(lower.clone(), |(_, upper)| lower.then(upper));
        found = Some((mesh, refinement));
    }
    found
}

/// Meshes a garment with `factor` times its triangles.
fn garment_mesh(source: &GarmentSource, factor: f64) -> Result<FileMesh, SceneError> {
    let few = || source.at.error("cannot be made with so few triangles; give more, or a higher resolution");
    let mut mesh = source.garment.mesh(source.triangles * factor).ok_or_else(few)?;
    source.placement.place(&mut mesh.mesh, DVec3::ZERO);
    validate(&mesh.mesh).map_err(|fault| source.at.error(fault.to_string()))?;
    Ok(mesh)
}

/// Meshes the panels of a pattern with `factor` times its triangles.
fn pattern_mesh(source: &PatternSource, factor: f64) -> Result<FileMesh, SceneError> {
    let mut mesh = source.pattern.mesh(source.triangles * factor).map_err(|what| source.at.error(what))?;
    source.placement.place(&mut mesh.mesh, DVec3::ZERO);
    validate(&mesh.mesh).map_err(|fault| source.at.error(fault.to_string()))?;
    Ok(mesh)
}

/// Meshes a sheet with `factor` times its triangles, `coarsenings` levels above its finest one.
fn sheet_mesh(source: &SheetSource, factor: f64, coarsenings: usize) -> Result<SheetMesh, SceneError> {
    let triangles = (source.triangles * factor).round().max(2.0) as u64;
    let mesh = match (source.kind, source.outline) {
        (SheetKind::Grid, Outline::Rectangle(size_m)) => {
            SheetMesh::Grid { grid: sheet_cells(size_m, triangles), size_m }
        }
        _ => {
            let sheet = NestedSheet::new(source.outline, triangles);
            SheetMesh::Nested { level: sheet.finest(), sheet }
        }
    };
    match mesh {
        SheetMesh::Nested { sheet, level } if coarsenings <= level => {
            Ok(SheetMesh::Nested { sheet, level: level - coarsenings })
        }
        mesh if coarsenings == 0 => Ok(mesh),
        _ => Err(source.at.error(format!("the sheet has no level that is {coarsenings} times coarser"))),
    }
}

/// Above this many thicknesses the extent is probably not in meters: 40 m for a cloth of 2 mm.
const EXTENT_MOST: f64 = 2e4;
/// Below this many thicknesses a mesh is too small to be cloth.
const EXTENT_LEAST: f64 = 10.0;

/// A warning about a mesh whose size is implausible for the thickness of the cloth, most likely because its unit is not
/// the meter. `extent_m` = longest side of its bounding box.
pub fn size_warning(name: &str, extent_m: f64, thickness_m: f64) -> Option<String> {
    let ratio = extent_m / thickness_m;
    let what = if ratio > EXTENT_MOST {
        let (unit, scale) = if extent_m < 1e3 { ("centimetres", "0.01") } else { ("millimetres", "0.001") };
        format!("if its file is in {unit}, `scale = {scale}` makes metres of them")
    } else if ratio < EXTENT_LEAST {
        "`scale` enlarges it, `thickness_m` is for the thickness".to_owned()
    } else {
        return None;
    };
    Some(format!("{name} is {extent_m:.4} m large, {ratio:.0} times thickness_m = {thickness_m}: {what}"))
}

/// Above this ratio of their extents a cloth and an obstacle from a file are probably in different units.
const UNEQUAL: f64 = 50.0;

/// A warning about an obstacle from a file that is far larger or smaller than the largest cloth (`cloth_m`), most
/// likely because its unit is not the meter. `extent_m`, `cloth_m` = longest sides of their bounding boxes.
pub(super) fn obstacle_warning(name: &str, extent_m: f64, cloth_m: f64) -> Option<String> {
    let what = if extent_m > UNEQUAL * cloth_m {
        let (unit, scale) =
            if extent_m < 10.0 * UNEQUAL * cloth_m { ("centimetres", 0.01) } else { ("millimetres", 0.001) };
        format!("if its file is in {unit}, `scale = {scale}` of the obstacle makes metres of them")
    } else if extent_m > 0.0 && cloth_m > UNEQUAL * extent_m {
        "`scale` of the obstacle enlarges it, `scale` of the cloth makes metres of a mesh in other units".to_owned()
    } else {
        return None;
    };
    Some(format!("obstacle `{name}` is {extent_m:.4} m large, the largest cloth {cloth_m:.4} m: {what}"))
}

/// The pieces as one mesh, with the data of each vertex and triangle.
pub(super) struct Merged {
    pub mesh: TriangleMesh,
    pub velocities: Vec<Vec3>,
    pub fabrics: Vec<Fabric>,
    pub fabric_of_triangle: Vec<u16>,
    pub cloths: Vec<Cloth>,
    pub parts: Vec<Part>,
}

/// Merges pieces in their order. `friction` = coefficient of pieces without one of their own. An error is half a
/// sentence.
pub(super) fn merge(pieces: &[Piece], friction: f64) -> Result<Merged, String> {
    let mut merged = Merged {
        mesh: TriangleMesh::default(),
        velocities: Vec::new(),
        fabrics: Vec::new(),
        fabric_of_triangle: Vec::new(),
        cloths: Vec::new(),
        parts: Vec::new(),
    };
    for piece in pieces {
        let (mesh, source) = (&piece.cloth.mesh, piece.source);
        let first = merged.mesh.positions.len();
        if first + mesh.positions.len() > i32::MAX as usize {
            return Err("the cloths have more than 2147483647 vertices together".into());
        }
        let known = merged.fabrics.iter().position(|fabric| *fabric == source.fabric);
        let fabric = known.unwrap_or(merged.fabrics.len());
        if known.is_none() {
            merged.fabrics.push(source.fabric.clone());
        }
        let fabric = u16::try_from(fabric).map_err(|_| "there are more than 65536 different fabrics".to_owned())?;
        let first_triangle = merged.mesh.triangles.len() as u32;
        merged.mesh.positions.extend(&mesh.positions);
        merged.mesh.material_uv.extend(&mesh.material_uv);
        merged.mesh.triangles.extend(mesh.triangles.iter().map(|t| t.map(|v| v + first as u32)));
        match &source.velocity {
            StartVelocity::Same(velocity) => merged.velocities.resize(merged.mesh.positions.len(), *velocity),
            StartVelocity::PerVertex(velocities) => {
                merged.velocities.extend(piece.refinement.copies.iter().map(|&vertex| velocities[vertex as usize]));
            }
        }
        merged.parts.extend(piece.cloth.parts.iter().map(|part| Part {
            triangles: first_triangle + part.triangles.start..first_triangle + part.triangles.end,
            ..part.clone()
        }));
        merged.fabric_of_triangle.resize(merged.mesh.triangles.len(), fabric);
        merged.cloths.push(Cloth {
            name: source.name.clone(),
            vertices: first as u32..merged.mesh.positions.len() as u32,
            triangles: first_triangle..merged.mesh.triangles.len() as u32,
            friction: source.friction.unwrap_or(friction),
            pressure_pa: source.pressure_pa,
        });
    }
    Ok(merged)
}
