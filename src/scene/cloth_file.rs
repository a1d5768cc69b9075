//! `[[cloth]]` and `[[fabric]]` of the TOML scene format.

use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use crate::math::{DQuat, DVec3};
use crate::mesh::{FileMesh, MaterialSource, Outline};

use super::cloth_source::{
    ClothSource, GarmentSource, PatternSource, Shape, SheetKind, SheetSource, StartVelocity, UnplacedCloth, Wrap,
};
use super::fields::{Fields, Value};
use super::files::find;
use super::map_file::maps;
use super::pattern::{Pattern, is_pattern};
use super::person::{Garment, KINDS};
use super::placement::{Placement, unplaced_mesh};
use super::seam_file::read_seams;
use super::{Fabric, Obstacle, Plasticity, RESOLUTIONS, SceneError, StrainLimit};

pub(super) const FABRIC_FIELDS: [&str; 11] = [
    "name",
    "density_kg_m2",
    "stretching_n_m",
    "bending_n_m",
    "flexural_rigidity_n_m",
    "damping_s",
    "yield_curvature",
    "yield_strain",
    "hardening",
    "weakening",
    "strain_limit",
];

/// Bending stiffness in ARCSim's form over flexural rigidity (docs/papers.md, D13).
const BENDING_OF_RIGIDITY: f64 = 4.0;

/// Reads `stretching_n_m`: four numbers, or six rows of them.
pub(super) fn stretching(value: &Value) -> Result<[[f64; 4]; 6], SceneError> {
    if value.array()?.first().is_some_and(Value::is_array) { rows(value) } else { Ok([value.numbers()?; 6]) }
}

/// Reads `bending_n_m`: a number, or three rows of five.
pub(super) fn bending(value: &Value) -> Result<[[f64; 5]; 3], SceneError> {
    if value.is_array() { rows(value) } else { Ok([[value.not_negative()?; 5]; 3]) }
}

/// Reads a `[[fabric]]`.
pub(super) fn fabric(fields: &Fields) -> Result<Fabric, SceneError> {
    let bending_n_m = match (fields.get("bending_n_m"), fields.get("flexural_rigidity_n_m")) {
        (Some(_), Some(rigidity)) => {
            let what = "says the same as `bending_n_m`, which is four times it; give one of them";
            return Err(rigidity.error(what));
        }
        (None, Some(rigidity)) => bending(&rigidity)?.map(|row| row.map(|rigidity| BENDING_OF_RIGIDITY * rigidity)),
        _ => bending(&fields.required("bending_n_m")?)?,
    };
    let fabric = Fabric {
        name: fields.required("name")?.text()?.to_owned(),
        density_kg_m2: fields.required("density_kg_m2")?.positive()?,
        stretching_n_m: stretching(&fields.required("stretching_n_m")?)?,
        bending_n_m,
        damping_s: fields.or("damping_s", 0.0, Value::not_negative)?,
        plasticity: plasticity(fields, None)?,
        strain_limit: strain_limit(fields)?,
    };
    fabric.check().map_err(|what| fields.error(what))?;
    Ok(fabric)
}

/// `yield_curvature`, `yield_strain`, `hardening` and `weakening`; what is absent is as in `before`.
fn plasticity(fields: &Fields, before: Option<Plasticity>) -> Result<Option<Plasticity>, SceneError> {
    let yields_at = fields.optional("yield_curvature", Value::positive)?;
    let stays_at = fields.optional("yield_strain", Value::positive)?;
    if yields_at.or(stays_at).is_none() && before.is_none() {
        let what = "needs a `yield_curvature` or a `yield_strain`; without one the fabric is elastic";
        return match ["hardening", "weakening"].into_iter().find(|key| fields.get(key).is_some()) {
            Some(key) => Err(fields.error_at(key, what)),
            None => Ok(None),
        };
    }
    let before = before.unwrap_or(Plasticity::NONE);
    Ok(Some(Plasticity {
        yield_curvature_1_m: yields_at.unwrap_or(before.yield_curvature_1_m),
        hardening: fields.or("hardening", before.hardening, Value::not_negative)?,
        weakening: fields.or("weakening", before.weakening, Value::not_negative)?,
        yield_strain: stays_at.unwrap_or(before.yield_strain),
    }))
}

/// `strain_limit`: two stretches, or a table of limits of their own.
fn strain_limit(fields: &Fields) -> Result<Option<StrainLimit>, SceneError> {
    let Some(value) = fields.get("strain_limit") else { return Ok(None) };
    if value.is_array() {
        return Ok(Some(StrainLimit::Every(value.numbers()?)));
    }
    let along = value.table(&["warp", "weft", "shear_deg"])?;
    Ok(Some(StrainLimit::Along {
        warp: along.optional("warp", Value::numbers)?,
        weft: along.optional("weft", Value::numbers)?,
        shear_deg: along.optional("shear_deg", Value::number)?,
    }))
}

fn rows<const R: usize, const C: usize>(value: &Value) -> Result<[[f64; C]; R], SceneError> {
    let rows = value.array()?.iter().map(Value::numbers::<C>).collect::<Result<Vec<_>, _>>()?;
    rows.try_into()
        .map_err(|rows: Vec<_>| value.error(format!("must have {R} rows of {C} numbers, not {} rows", rows.len())))
}

pub(super) const CLOTH_FIELDS: [&str; 25] = [
    "name",
    "sheet",
    "garment",
    "mesh",
    "material",
    "weld_m",
    "subdivide",
    "seams",
    "plane",
    "origin_m",
    "rotate_deg",
    "scale",
    "wrap",
    "fabric",
    "thicken",
    "damping_s",
    "yield_curvature",
    "yield_strain",
    "hardening",
    "weakening",
    "strain_limit",
    "velocity_m_s",
    "friction",
    "pressure_pa",
    "maps",
];

/// Most times that the triangles of a mesh are divided into four.
const SUBDIVIDE_MOST: u64 = 6;

pub(super) const SHEET_FIELDS: [&str; 4] = ["size_m", "radius_m", "triangles", "mesh"];

pub(super) const GARMENT_FIELDS: [&str; 8] =
    ["kind", "ease_m", "hem_m", "width_m", "pleats", "pleat_depth_m", "open", "triangles"];

/// Triangles of every cloth's sheet, garment or pattern (0 for a mesh). Without a count of its own, it gets a share of
/// the scene's resolution in proportion to its area.
pub(super) fn sheet_triangles(resolution: u64, cloths: &[Fields], path: &Path) -> Result<Vec<f64>, SceneError> {
    let mut areas = Vec::new();
    let mut given = Vec::new();
    for cloth in cloths {
        let sheet = cloth.table("sheet", &SHEET_FIELDS)?;
        let rectangle = sheet.optional("size_m", |value| Ok(value.numbers::<2>()?.iter().product::<f64>().abs()))?;
        let disc = sheet.optional("radius_m", |value| Ok(PI * value.positive()?.powi(2)))?;
        let worn = cloth.table("garment", &GARMENT_FIELDS)?;
        let count = |value: &Value| value.whole(RESOLUTIONS);
        let count = sheet.optional("triangles", count)?.or(worn.optional("triangles", count)?);
        // An area is worth measuring where it decides.
        let garment = match cloth.get("garment") {
            Some(_) if count.is_none() => garment(&worn)?.area(),
            _ => None,
        };
        let pattern = match cloth.get("mesh") {
            Some(file) if file.is_text() && is_pattern(file.text()?) => {
                let found = find(path, file.text()?).map_err(|what| file.error(what))?;
                Some(Pattern::read(&found)?.area_m2())
            }
            _ => None,
        };
        areas.push(rectangle.or(disc).or(garment).or(pattern).unwrap_or(0.0));
        given.push(count);
    }
    let area: f64 = areas.iter().sum();
    let share = |i: usize| {
        given[i].map_or_else(|| resolution as f64 * areas[i] / area.max(f64::MIN_POSITIVE), |given| given as f64)
    };
    Ok((0..cloths.len()).map(share).collect())
}

/// Reads `wrap`, which names an obstacle of the scene.
pub(super) fn wrap(fields: &Fields, obstacles: &[Obstacle]) -> Result<Option<Wrap>, SceneError> {
    let Some(value) = fields.get("wrap") else { return Ok(None) };
    let name = value.text()?;
    let obstacle = obstacles.iter().position(|obstacle| obstacle.name == name).ok_or_else(|| {
        let known: Vec<&str> = obstacles.iter().map(|obstacle| &obstacle.name[..]).collect();
        let known = if known.is_empty() { "the scene has none".to_owned() } else { known.join(", ") };
        value.error(format!("no obstacle is named `{name}` ({known})"))
    })?;
    Ok(Some(Wrap { obstacle, at: value.place() }))
}

/// Lists that collect sentences about files.
pub(super) struct Remarks<'a> {
    pub warnings: &'a mut Vec<String>,
    pub left_out: &'a mut Vec<String>,
}

/// Reads a `[[cloth]]`.
pub(super) fn cloth(
    fields: &Fields,
    index: usize,
    triangles: f64,
    fabrics: &[Fabric],
    path: &Path,
    remarks: &mut Remarks,
) -> Result<UnplacedCloth, SceneError> {
    let placement = Placement {
        translation_m: fields.or("origin_m", DVec3::ZERO, Value::vector)?,
        rotation: fields.or("rotate_deg", DQuat::IDENTITY, Value::rotation)?,
        scale: fields.or("scale", 1.0, Value::positive)?,
    };
    let mut found = None;
    let shape = match (fields.get("sheet"), fields.get("garment"), fields.get("mesh")) {
        (Some(_), None, None) => Shape::Sheet(sheet(fields, triangles, placement)?),
        (None, Some(_), None) => {
            if let Some(key) =
                ["material", "weld_m", "plane", "seams", "wrap"].into_iter().find(|key| fields.get(key).is_some())
            {
                return Err(fields.error_at(key, "does not belong to a cloth with a `garment`"));
            }
            let garment = garment(&fields.table("garment", &GARMENT_FIELDS)?)?;
            Shape::Garment(GarmentSource { garment, placement, triangles, at: fields.place_at("garment") })
        }
        (None, None, Some(file)) if file.is_text() && is_pattern(file.text()?) => {
            if let Some(key) =
                ["material", "weld_m", "subdivide", "plane"].into_iter().find(|key| fields.get(key).is_some())
            {
                return Err(fields.error_at(key, "does not belong to a cloth whose `mesh` is a pattern"));
            }
            let pattern = Pattern::read(&find(path, file.text()?).map_err(|what| file.error(what))?)?;
            if fields.or("seams", true, Value::boolean)? && !pattern.has_seams() && fields.get("seams").is_some() {
                return Err(fields.error_at("seams", "the pattern has no stitches"));
            }
            Shape::Pattern(PatternSource { pattern, placement, triangles, at: file.place() })
        }
        (None, None, Some(file)) => {
            let (mesh, path) = mesh(fields, &file, placement, path, remarks)?;
            found = Some(path);
            Shape::Mesh(mesh)
        }
        _ => {
            let what = "a cloth needs one of `sheet = { size_m = [w, h] }`, `garment = { kind = \"dress\" }` and \
                `mesh = \"file.obj\"`";
            return Err(fields.error(what));
        }
    };
    let mut fabric = match fields.get("fabric") {
        None => Fabric::preset("cotton").unwrap_or_else(|| Fabric::uniform("cotton", 0.15, [400.0; 4], 1e-5)),
        Some(value) => named_fabric(&value, fabrics, path)?,
    };
    if let Some(factor) = fields.optional("thicken", Value::positive)? {
        fabric = fabric.thickened(factor);
    }
    fabric.damping_s = fields.or("damping_s", fabric.damping_s, Value::not_negative)?;
    fabric.plasticity = plasticity(fields, fabric.plasticity)?;
    fabric.strain_limit = strain_limit(fields)?.or(fabric.strain_limit);
    fabric.check().map_err(|what| fields.error_at("fabric", what))?;
    let source = ClothSource {
        name: fields.or("name", format!("cloth {index}"), |value| value.text().map(str::to_owned))?,
        shape,
        velocity: StartVelocity::Same(fields.or("velocity_m_s", DVec3::ZERO, Value::vector)?.as_vec3()),
        fabric,
        friction: fields.optional("friction", Value::not_negative)?,
        pressure_pa: fields.or("pressure_pa", 0.0, Value::number)?,
        maps: maps(fields, path)?,
        wrap: None,
    };
    Ok(UnplacedCloth { source, placement, file: found })
}

fn mesh(
    fields: &Fields,
    file: &Value,
    placement: Placement,
    path: &Path,
    remarks: &mut Remarks,
) -> Result<(FileMesh, PathBuf), SceneError> {
    if fields.get("plane").is_some() {
        return Err(fields.error_at("plane", "belongs to a cloth with a `sheet`; this one has a `mesh`"));
    }
    let sources =
        [("auto", MaterialSource::Auto), ("uv", MaterialSource::TextureOrShape), ("shape", MaterialSource::Shape)];
    let source = fields.or("material", MaterialSource::Auto, |value| value.choice(&sources))?;
    let weld_m = fields.optional("weld_m", Value::not_negative)?;
    let found = find(path, file.text()?).map_err(|what| file.error(what))?;
    let times = fields.or("subdivide", 0, |value| value.whole(0..=SUBDIVIDE_MOST))? as u32;
    let mut mesh = unplaced_mesh(&found, source, weld_m, &placement)?;
    if (mesh.mesh.triangles.len() as u64) << (2 * times) > i32::MAX as u64 {
        return Err(fields.error_at("subdivide", format!("makes more than {} triangles of the mesh", i32::MAX)));
    }
    mesh.divide(times);
    take_seams(fields, &mut mesh, &found, path, remarks)?;
    remarks.left_out.extend(mesh.left_out(&found));
    remarks.warnings.extend(mesh.warnings(&found, placement.scale));
    if source == MaterialSource::TextureOrShape && mesh.fit.is_none() {
        let what =
            "not every corner has texture coordinates (or they have no area), so its shape in space is the rest shape";
        remarks.warnings.push(format!("{}: {what}", found.display()));
    }
    Ok((mesh, found))
}

/// Seams beside the mesh: those of a file, or those that the mesh's own file has.
fn take_seams(
    fields: &Fields,
    mesh: &mut FileMesh,
    found: &Path,
    path: &Path,
    remarks: &mut Remarks,
) -> Result<(), SceneError> {
    match fields.get("seams") {
        Some(value) if value.is_text() => {
            let file = find(path, value.text()?).map_err(|what| value.error(what))?;
            mesh.seams = read_seams(&file)?;
        }
        Some(value) => {
            let wanted = value.boolean()?;
            if wanted && mesh.seams.is_empty() {
                return Err(value.error(format!("{} has no seams (`stitch` records)", found.display())));
            }
            if !wanted {
                mesh.seams.clear();
            }
        }
        None if !mesh.seams.is_empty() => {
            let count = std::mem::take(&mut mesh.seams).len();
            let what = format!("{}: its {count} seams are not sewn; `seams = true` sews them", found.display());
            remarks.left_out.push(what);
        }
        None => {}
    }
    Ok(())
}

fn sheet(fields: &Fields, triangles: f64, placement: Placement) -> Result<SheetSource, SceneError> {
    if let Some(key) =
        ["material", "scale", "weld_m", "subdivide", "seams"].into_iter().find(|key| fields.get(key).is_some())
    {
        return Err(fields.error_at(key, "belongs to a cloth with a `mesh`; this one has a `sheet`"));
    }
    let sheet = fields.table("sheet", &SHEET_FIELDS)?;
    let kinds = [("irregular", SheetKind::Irregular), ("grid", SheetKind::Grid)];
    let kind = sheet.or("mesh", SheetKind::Irregular, |value| value.choice(&kinds))?;
    let outline = match (sheet.get("size_m"), sheet.get("radius_m")) {
        (Some(_), Some(radius)) => return Err(radius.error("a sheet has either `size_m` or `radius_m`")),
        (None, Some(radius)) if kind == SheetKind::Grid => return Err(radius.error("a round sheet has no grid")),
        (None, Some(radius)) => Outline::Disc(radius.positive()?),
        _ => {
            let size = sheet.required("size_m")?;
            let size_m = size.numbers::<2>()?;
            if size_m.iter().any(|&side| side <= 0.0) {
                return Err(size.error("both sides must be above 0"));
            }
            Outline::Rectangle(size_m)
        }
    };
    let planes = [("xy", [DVec3::X, DVec3::Y]), ("xz", [DVec3::X, DVec3::NEG_Z]), ("yz", [DVec3::Y, DVec3::Z])];
    let axes = fields.or("plane", planes[0].1, |value| value.choice(&planes))?;
    Ok(SheetSource { outline, axes, placement, triangles, kind, at: fields.place_at("sheet") })
}

/// Most pleats around a skirt.
const PLEATS: std::ops::RangeInclusive<u64> = 3..=200;

/// Reads a `garment`.
fn garment(fields: &Fields) -> Result<Garment, SceneError> {
    let kind = fields.required("kind")?.choice(&KINDS)?;
    let (hem_m, width_m) = kind.measures();
    if let Some(key) =
        ["pleats", "pleat_depth_m"].into_iter().find(|key| fields.get(key).is_some() && !kind.has_skirt())
    {
        return Err(fields.error_at(key, "belongs to a dress or skirt"));
    }
    let pleats = fields.or("pleats", 0, |value| value.whole(PLEATS))?;
    let depth = if pleats > 0 { 0.02 } else { 0.0 };
    let within = |key: &str, default: f64, [least, most]: [f64; 2]| {
        let number = fields.or(key, default, Value::number)?;
        match (least..=most).contains(&number) {
            true => Ok(number),
            false => Err(fields.error_at(key, format!("must be from {least} to {most} m, not {number}"))),
        }
    };
    Ok(Garment {
        kind,
        ease_m: within("ease_m", 0.012, [0.002, 0.1])?,
        hem_m: within("hem_m", hem_m, kind.hems())?,
        width_m: within("width_m", width_m, [0.05, 1.0])?,
        pleats,
        pleat_depth_m: within("pleat_depth_m", depth, [0.0, 0.1])?,
        open: fields.or("open", false, Value::boolean)?,
    })
}

fn named_fabric(value: &Value, fabrics: &[Fabric], path: &Path) -> Result<Fabric, SceneError> {
    known_fabric(value.text()?, fabrics, path, &|what| value.error(what))
}

/// The fabric of a name: one of `fabrics`, a preset, or a file beside the scene `path`. `fault`: an error at the field
/// that names it.
pub(super) fn known_fabric(
    name: &str,
    fabrics: &[Fabric],
    path: &Path,
    fault: &dyn Fn(String) -> SceneError,
) -> Result<Fabric, SceneError> {
    if let Some(fabric) = fabrics.iter().find(|fabric| fabric.name == name) {
        return Ok(fabric.clone());
    }
    if let Some(fabric) = Fabric::preset(name) {
        return Ok(fabric);
    }
    if name.ends_with(".json") {
        return super::load_fabric(&find(path, name).map_err(fault)?);
    }
    let known: Vec<String> =
        fabrics.iter().map(|fabric| fabric.name.clone()).chain(Fabric::preset_names().map(String::from)).collect();
    Err(fault(format!("`{name}` is no known fabric; known: {}, or a .json file", known.join(", "))))
}
