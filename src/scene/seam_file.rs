//! `[[seam]]` and `[sewing]` of the TOML scene format, and files with lists of seams.

use std::path::Path;

use super::SceneError;
use super::cloth_source::{ClothSource, Shape};
use super::fields::{Fields, Value};
use super::files::read_text;
use super::json::{Json, parse_json};
use super::seam::{SeamShape, SeamSource, SideSelection, SideSource};

pub(super) const SEAM_FIELDS: [&str; 6] = ["name", "a", "b", "cloths", "pairs", "angle_deg"];
pub(super) const SIDE_FIELDS: [&str; 3] = ["cloth", "vertices", "edge"];
pub(super) const SEWING_FIELDS: [&str; 6] = ["close_s", "close_speed_m_s", "weld_m", "refine", "gravity", "angle_deg"];

/// Most times that the triangles of sewn cloth are divided into four.
const REFINE_MOST: u64 = 5;

/// How seams are sewn.
#[derive(Clone, Copy, Debug)]
pub(super) struct SewingSource {
    pub close_s: f64,
    /// In place of `close_s`: the speed of the longest thread.
    pub close_speed_m_s: Option<f64>,
    pub weld_m: f64,
    pub refine: u32,
    /// Whether panels have weight while they are sewn.
    pub gravity: bool,
    /// Dihedral angle at rest of seams that have none of their own, radians.
    pub angle: f64,
}

impl Default for SewingSource {
    fn default() -> SewingSource {
        SewingSource { close_s: 0.6, close_speed_m_s: None, weld_m: 0.001, refine: 0, gravity: false, angle: 0.0 }
    }
}

/// Reads `[sewing]`. `any`: whether the scene has seams.
pub(super) fn sewing(root: &Fields, any: bool) -> Result<SewingSource, SceneError> {
    let fields = root.table("sewing", &SEWING_FIELDS)?;
    if root.get("sewing").is_some() && !any {
        return Err(fields.error("the scene has no seam; add a `[[seam]]`, or a cloth whose file has seams"));
    }
    if fields.get("close_s").is_some() && fields.get("close_speed_m_s").is_some() {
        return Err(fields.error_at("close_speed_m_s", "give either `close_s` or `close_speed_m_s`"));
    }
    let default = SewingSource::default();
    Ok(SewingSource {
        close_s: fields.or("close_s", default.close_s, Value::positive)?,
        close_speed_m_s: fields.optional("close_speed_m_s", Value::positive)?,
        weld_m: fields.or("weld_m", default.weld_m, Value::positive)?,
        refine: fields.or("refine", 0, |value| value.whole(0..=REFINE_MOST))? as u32,
        gravity: fields.or("gravity", default.gravity, Value::boolean)?,
        angle: fields.or("angle_deg", default.angle, angle)?,
    })
}

/// A dihedral angle in degrees, as radians. A seam that is folded by half a turn would lie on itself.
pub(super) fn angle(value: &Value) -> Result<f64, SceneError> {
    let degrees = value.number()?;
    match degrees.abs() < 180.0 {
        true => Ok(degrees.to_radians()),
        false => Err(value.error(format!("must be above -180 and below 180 degrees, not {degrees}"))),
    }
}

/// The seams that the file of a cloth has.
pub(super) fn seams_of_cloth(
    fields: &Fields,
    index: usize,
    cloth: &ClothSource,
) -> Result<Option<SeamSource>, SceneError> {
    let any = match &cloth.shape {
        Shape::Mesh(mesh) => !mesh.seams.is_empty(),
        Shape::Pattern(source) => source.pattern.has_seams() && fields.or("seams", true, Value::boolean)?,
        Shape::Sheet(_) | Shape::Garment(_) => false,
    };
    let at = fields.place_at(if fields.get("seams").is_some() { "seams" } else { "mesh" });
    // The stitches of a garment may also make pleats, which no mesh without seams can show.
    let lenient = matches!(cloth.shape, Shape::Mesh(_)) && fields.get("seams").is_some_and(|value| !value.is_text());
    let of_cloth =
        SeamSource { name: cloth.name.clone(), shape: SeamShape::OfCloth { cloth: index, lenient }, angle: None, at };
    Ok(any.then_some(of_cloth))
}

/// Names of the edges of a cloth.
fn edge_names(cloth: &ClothSource) -> Vec<String> {
    match &cloth.shape {
        Shape::Mesh(mesh) => mesh.edge_names(),
        Shape::Pattern(source) => source.pattern.edge_names(),
        Shape::Sheet(_) | Shape::Garment(_) => Vec::new(),
    }
}

/// Reads a `[[seam]]`.
pub(super) fn seam(fields: &Fields, index: usize, cloths: &[ClothSource]) -> Result<SeamSource, SceneError> {
    let name = fields.or("name", format!("{index}"), |value| value.text().map(str::to_owned))?;
    let at = fields.place_at(if fields.get("pairs").is_some() { "pairs" } else { "a" });
    let shape = match fields.get("pairs") {
        Some(pairs) => {
            if let Some(key) = ["a", "b"].into_iter().find(|key| fields.get(key).is_some()) {
                return Err(fields.error_at(key, "give either `pairs` or both sides, `a` and `b`"));
            }
            let named = match fields.get("cloths") {
                None => vec![cloth(None, fields, cloths)?; 2],
                Some(value) => {
                    value.array()?.iter().map(|value| cloth(Some(value), fields, cloths)).collect::<Result<_, _>>()?
                }
            };
            let &[one, other] = &named[..] else {
                return Err(fields.error_at("cloths", "must be an array of 2 cloths"));
            };
            let pair = |value: &Value| -> Result<[u32; 2], SceneError> {
                let ends = value.array()?.iter().map(vertex).collect::<Result<Vec<u32>, _>>()?;
                ends.try_into().map_err(|_| value.error("must be an array of 2 vertices"))
            };
            let list = pairs.array()?.iter().map(pair).collect::<Result<Vec<_>, _>>()?;
            SeamShape::Pairs([one, other], list)
        }
        None => {
            if fields.get("cloths").is_some() {
                return Err(fields.error_at("cloths", "belongs to a seam with `pairs`; a side names its own cloth"));
            }
            SeamShape::Sides([side(&fields.required("a")?, cloths)?, side(&fields.required("b")?, cloths)?])
        }
    };
    Ok(SeamSource { name, shape, angle: fields.optional("angle_deg", angle)?, at })
}

fn vertex(value: &Value) -> Result<u32, SceneError> {
    Ok(value.whole(0..=i32::MAX as u64)? as u32)
}

/// The cloth that a value names; without a value the only one.
fn cloth(value: Option<&Value>, fields: &Fields, cloths: &[ClothSource]) -> Result<usize, SceneError> {
    match value {
        None if cloths.len() == 1 => Ok(0),
        None => {
            Err(fields.error("the scene has several cloths, so a seam must say which: `cloth` of a side, or `cloths`"))
        }
        Some(value) if value.is_text() => {
            let name = value.text()?;
            let missing = || value.error(format!("no cloth is named `{name}`"));
            cloths.iter().position(|cloth| cloth.name == name).ok_or_else(missing)
        }
        Some(value) => Ok(value.whole(0..=cloths.len() as u64 - 1)? as usize),
    }
}

/// Reads a side: the name of an edge, or a table.
fn side(value: &Value, cloths: &[ClothSource]) -> Result<SideSource, SceneError> {
    if value.is_text() {
        let edge = value.text()?.to_owned();
        let found: Vec<usize> = (0..cloths.len()).filter(|&i| edge_names(&cloths[i]).contains(&edge)).collect();
        return match found[..] {
            [cloth] => Ok(SideSource { cloth, select: SideSelection::Named(edge) }),
            [] => {
                let known: Vec<String> = cloths.iter().flat_map(edge_names).collect();
                let known = if known.is_empty() { "their files name none".to_owned() } else { known.join(", ") };
                Err(value.error(format!("no cloth has an edge named `{edge}` ({known})")))
            }
            _ => Err(value.error(format!(
                "several cloths have an edge named `{edge}`; write {{ cloth = \"..\", edge = \"{edge}\" }}"
            ))),
        };
    }
    let fields = value.table(&SIDE_FIELDS)?;
    let cloth = cloth(fields.get("cloth").as_ref(), &fields, cloths)?;
    let select = match (fields.get("vertices"), fields.get("edge")) {
        (Some(list), None) => {
            SideSelection::Vertices(list.array()?.iter().map(vertex).collect::<Result<Vec<u32>, _>>()?)
        }
        (None, Some(edge)) => SideSelection::Named(edge.text()?.to_owned()),
        _ => return Err(fields.error("a side needs either `vertices` or `edge`")),
    };
    match (&cloths[cloth].shape, &select) {
        (Shape::Mesh(_) | Shape::Pattern(_), _) | (Shape::Sheet(_), SideSelection::Named(_)) => {}
        (Shape::Sheet(_), _) => return Err(value.error("a side of a sheet is an `edge`: left, right, bottom or top")),
        (Shape::Garment(_), _) => {
            return Err(value.error(format!("`{}` is a garment, which is sewn already", cloths[cloth].name)));
        }
    }
    Ok(SideSource { cloth, select })
}

/// Reads a list of seams beside a mesh: `{ "seams": [{ "name": .., "a": [vertices], "b": [vertices] }, ..] }`. Other
/// fields are for other readers.
pub(super) fn read_seams(path: &Path) -> Result<Vec<(String, [Vec<u32>; 2])>, SceneError> {
    let value = parse_json(&read_text(path)?, path)?;
    let root = Json::root(path, &value);
    let mut seams = Vec::new();
    for (i, seam) in root.required("seams")?.array()?.iter().enumerate() {
        let name = seam.or("name", format!("{i}"), |value| value.text().map(str::to_owned))?;
        let side = |key: &str| -> Result<Vec<u32>, SceneError> {
            seam.required(key)?.array()?.iter().map(|vertex| vertex.whole(0)).collect()
        };
        seams.push((name, [side("a")?, side("b")?]));
    }
    if seams.is_empty() {
        return Err(root.required("seams")?.error("lists no seam"));
    }
    Ok(seams)
}
