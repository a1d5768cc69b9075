//! `[[pin]]` of the TOML scene format.

use crate::math::DVec3;
use crate::mesh::FileMesh;

use super::cloth_source::{ClothSource, Shape};
use super::fields::{Fields, Value};
use super::keyframes::motion;
use super::pins::{self, PinSource, Selection, Spread};
use super::{Motion, Obstacle, SceneError};

pub(super) const PIN_FIELDS: [&str; 18] = [
    "name",
    "cloth",
    "corners",
    "edge",
    "every",
    "count",
    "vertices",
    "group",
    "property",
    "box_m",
    "sphere",
    "nearest",
    "start_s",
    "end_s",
    "motion",
    "follow",
    "attach",
    "stiffness_n_m",
];

/// What pins move with.
#[derive(Default)]
pub(super) struct Paths {
    pub motions: Vec<Motion>,
    /// Obstacles that pins follow.
    pub followed: Vec<u32>,
}

/// Reads a `[[pin]]` and appends what it moves with to `paths`. `origin_m`: the scene's local origin.
pub(super) fn pin(
    fields: &Fields,
    cloths: &[ClothSource],
    obstacles: &[Obstacle],
    origin_m: DVec3,
    paths: &mut Paths,
) -> Result<PinSource, SceneError> {
    let cloth = match fields.get("cloth") {
        None if cloths.len() == 1 => 0,
        None => {
            return Err(fields.error_at("cloth", "is missing; the scene has several cloths, so a pin must name one"));
        }
        Some(value) if value.is_text() => {
            let name = value.text()?;
            let missing = || value.error(format!("no cloth is named `{name}`"));
            cloths.iter().position(|cloth| cloth.name == name).ok_or_else(missing)?
        }
        Some(value) => value.whole(0..=cloths.len() as u64 - 1)? as usize,
    };
    let (select, value) = selection(fields, &cloths[cloth], origin_m)?;
    let start_s = fields.or("start_s", 0.0, Value::not_negative)?;
    let end_s = fields.or("end_s", f64::INFINITY, Value::positive)?;
    if end_s <= start_s {
        return Err(fields.error_at("end_s", format!("must be after start_s = {start_s}")));
    }
    let motion = motion(fields)?.map(|motion| {
        paths.motions.push(motion.relative_to(origin_m, origin_m));
        paths.motions.len() as u32 - 1
    });
    let follow = follow(fields, obstacles, &mut paths.followed)?;
    if follow.is_none() && matches!(select, Selection::Nearest(_)) {
        let what = "a number needs `follow`: it selects what is nearest to that obstacle; give \
                    `{ point_m = [x, y, z], count = n }` for what is nearest to a point";
        return Err(fields.error_at("nearest", what));
    }
    let stiffness_n_m = fields.optional("stiffness_n_m", Value::positive)?;
    let on_touch = fields.get("attach").is_some();
    let name = fields.optional("name", |value| value.text().map(str::to_owned))?;
    Ok(PinSource { name, cloth, select, motion, follow, start_s, end_s, stiffness_n_m, on_touch, at: value.place() })
}

/// The place in `followed` of the obstacle that a pin follows, and the obstacle.
fn follow(fields: &Fields, obstacles: &[Obstacle], followed: &mut Vec<u32>) -> Result<Option<(u32, u32)>, SceneError> {
    let value = match (fields.get("follow"), fields.get("attach")) {
        (Some(_), Some(_)) => return Err(fields.error_at("attach", "give either `follow` or `attach`")),
        (None, None) => return Ok(None),
        (Some(value), None) | (None, Some(value)) => value,
    };
    let name = value.text()?;
    let names: Vec<&str> = obstacles.iter().map(|obstacle| &obstacle.name[..]).collect();
    let Some(obstacle) = names.iter().position(|other| *other == name) else {
        let known = if names.is_empty() { "the scene has none".to_owned() } else { names.join(", ") };
        return Err(value.error(format!("no obstacle is named `{name}` ({known})")));
    };
    if fields.get("motion").is_some() {
        let other = if fields.get("follow").is_some() { "follow" } else { "attach" };
        return Err(fields.error_at("motion", format!("give either `motion` or `{other}`")));
    }
    let place = followed.iter().position(|&other| other as usize == obstacle).unwrap_or(followed.len());
    if place == followed.len() {
        followed.push(obstacle as u32);
    }
    Ok(Some((place as u32, obstacle as u32)))
}

/// The selection of a pin and the field that gives it.
fn selection<'a>(pin: &Fields<'a>, cloth: &ClothSource, origin_m: DVec3) -> Result<(Selection, Value<'a>), SceneError> {
    let ways = ["corners", "edge", "vertices", "group", "property", "box_m", "sphere", "nearest"];
    let given: Vec<&str> = ways.into_iter().filter(|way| pin.get(way).is_some()).collect();
    let [way] = given[..] else {
        return Err(pin.error(format!("a pin needs exactly one of {}, not {}", ways.join(", "), given.len())));
    };
    let value = pin.required(way)?;
    if way != "edge"
        && let Some(key) = ["every", "count"].into_iter().find(|key| pin.get(key).is_some())
    {
        return Err(pin.error_at(key, "belongs to a pin with an `edge`"));
    }
    if matches!(way, "corners" | "edge") && !matches!(cloth.shape, Shape::Sheet(_)) {
        let what = match cloth.shape {
            Shape::Mesh(_) => "mesh",
            Shape::Pattern(_) => "pattern",
            Shape::Sheet(_) | Shape::Garment(_) => "garment",
        };
        return Err(value.error(format!("`{}` is a {what}; only a sheet has corners and edges", cloth.name)));
    }
    let select = match way {
        "corners" => Selection::Corners(if value.is_text() {
            vec![value.choice(&pins::CORNERS)?]
        } else {
            value.array()?.iter().map(|v| v.choice(&pins::CORNERS)).collect::<Result<_, _>>()?
        }),
        "edge" => {
            let edge = value.choice(&pins::EDGES)?;
            let every = pin.optional("every", |value| value.whole(1..=1_000_000_000))?;
            let count = pin.optional("count", |value| value.whole(1..=1_000_000_000))?;
            let spread = match (every, count) {
                (Some(_), Some(_)) => return Err(pin.error_at("every", "give either `every` or `count`")),
                (Some(every), None) => Spread::Every(every as usize),
                (None, Some(count)) => Spread::Count(count as usize),
                (None, None) => Spread::Every(1),
            };
            Selection::Edge(edge, spread)
        }
        "vertices" => {
            let number = |value: &Value| Ok(value.whole(0..=u64::from(u32::MAX))? as u32);
            Selection::Vertices(value.array()?.iter().map(number).collect::<Result<_, SceneError>>()?)
        }
        "group" => {
            let name = value.text()?;
            let Shape::Mesh(mesh) = &cloth.shape else {
                return Err(value.error(format!("`{}` has no file; only a mesh has objects and groups", cloth.name)));
            };
            let vertices = mesh.vertices_of(name);
            if vertices.is_empty() {
                let what = format!("`{}` has no object or group named `{name}`", cloth.name);
                return Err(value.error(format!("{what}; {}", known_parts(mesh))));
            }
            Selection::MeshVertices(vertices)
        }
        "property" => {
            if matches!(cloth.shape, Shape::Sheet(_)) {
                let what = format!("`{}` is a sheet; only a mesh or a garment has properties", cloth.name);
                return Err(value.error(what));
            }
            Selection::Property(value.text()?.to_owned())
        }
        "box_m" => {
            let corners = value.array()?.iter().map(Value::vector).collect::<Result<Vec<DVec3>, _>>()?;
            let [low, high] = corners[..] else {
                return Err(value.error("must be two corners, `[[x, y, z], [x, y, z]]`"));
            };
            if low.cmpgt(high).any() {
                return Err(value.error("the first corner must be the lower one in x, y and z"));
            }
            Selection::Box { low: low - origin_m, high: high - origin_m }
        }
        "nearest" if value.is_table() => {
            let place = value.table(&["point_m", "count"])?;
            let count = place.required("count")?.whole(1..=1_000_000_000)? as usize;
            Selection::NearestTo { point: place.required("point_m")?.vector()? - origin_m, count }
        }
        "nearest" => Selection::Nearest(value.whole(1..=1_000_000_000)? as usize),
        _ => {
            let sphere = value.table(&["center_m", "radius_m"])?;
            let (center, radius_m) = (sphere.required("center_m")?.vector()?, sphere.required("radius_m")?.positive()?);
            Selection::Sphere { center: center - origin_m, radius_m }
        }
    };
    Ok((select, value))
}

/// Names that a pin can use, for a message.
fn known_parts(mesh: &FileMesh) -> String {
    /// Names that are listed.
    const LISTED: usize = 12;
    let mut names: Vec<&str> = mesh.parts.iter().flat_map(|part| [part.object.as_str(), part.group.as_str()]).collect();
    names.retain(|name| !name.is_empty());
    names.sort_unstable();
    names.dedup();
    let more = if names.len() > LISTED { ", .." } else { "" };
    names.truncate(LISTED);
    if names.is_empty() { "its file names none".into() } else { format!("it has {}{more}", names.join(", ")) }
}
