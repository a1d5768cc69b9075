//! `[[obstacle]]` of the TOML scene format: shapes, meshes, sequences and bodies, with placement and motion.

use std::path::{Path, PathBuf};

use crate::math::{DQuat, DVec3, FAR_M, local_origin};
use crate::mesh::{Surface, check_obstacle, read_obstacle, shapes};

use super::alembic::read_alembic;
use super::body_file::{Body, cached, check_fields, file_body, gltf, point_cache, sequence_playback, units};
use super::cloth_file::Remarks;
use super::fields::{Fields, Value};
use super::files::find;
use super::keyframes::{motion, stays_finite};
use super::placement::Placement;
use super::sequence::{MOST_VALUES, Pattern, read_frames};
use super::usd::{UsdKind, read_usd};
use super::{Cache, Movement, Obstacle, SceneError};

pub(super) const OBSTACLE_FIELDS: [&str; 30] = [
    "name",
    "sphere",
    "plane",
    "box",
    "plate",
    "funnel",
    "mesh",
    "sequence",
    "frames_per_s",
    "first",
    "gltf",
    "usd",
    "abc",
    "body",
    "triangles",
    "pc2",
    "mdd",
    "clip",
    "node",
    "start_s",
    "rate",
    "loop",
    "lead_in_s",
    "origin_m",
    "rotate_deg",
    "scale",
    "units_m",
    "up",
    "friction",
    "motion",
];

/// Fields that give the geometry; an obstacle has exactly one of them.
const FORMS: [&str; 13] =
    ["sphere", "plane", "box", "plate", "funnel", "mesh", "sequence", "gltf", "usd", "abc", "body", "pc2", "mdd"];
/// Those whose geometry is in files.
const FILES: [&str; 7] = ["mesh", "sequence", "gltf", "usd", "abc", "pc2", "mdd"];
/// Triangles of a shape if the scene does not give a number.
const DEFAULT_TRIANGLES: u64 = 3_000;
/// Valid numbers of triangles of a shape.
const TRIANGLES: std::ops::RangeInclusive<u64> = 12..=5_000_000;

/// Reads an obstacle. `path` = the scene file, `friction` = default coefficient, `origin_m` = the scene's local origin.
/// `remarks` receives sentences about its files.
pub(super) fn obstacle(
    fields: &Fields,
    index: usize,
    friction: f64,
    path: &Path,
    origin_m: DVec3,
    remarks: &mut Remarks,
) -> Result<Obstacle, SceneError> {
    let given: Vec<&str> = FORMS.into_iter().filter(|form| fields.get(form).is_some()).collect();
    let [form] = given[..] else {
        let what = format!("an obstacle needs exactly one of {}, not {}", FORMS.join(", "), given.len());
        return Err(fields.error(what));
    };
    let value = fields.required(form)?;
    let name = fields.or("name", format!("{form} {index}"), |value| value.text().map(str::to_owned))?;
    let own: &[&str] = if form == "body" { &["units_m", "up"] } else { &["origin_m", "scale", "units_m", "up"] };
    if !FILES.contains(&form)
        && let Some(key) = own.iter().copied().find(|key| fields.get(key).is_some())
    {
        let what = format!("belongs to an obstacle with one of {}; a {form} has its place in itself", FILES.join(", "));
        return Err(fields.error_at(key, what));
    }
    check_fields(fields, form)?;
    let rotation = fields.or("rotate_deg", DQuat::IDENTITY, Value::rotation)?;
    let mut read = None;
    let mut own = (1.0, DQuat::IDENTITY);
    if matches!(form, "usd" | "abc") {
        let found = find(path, value.text()?).map_err(|what| value.error(what))?;
        let node = fields.optional("node", Value::text)?;
        let kind = if form == "usd" {
            let stage = read_usd(&found, node, MOST_VALUES / 3)?;
            own = (stage.unit_m, stage.up);
            if !stage.says_unit && fields.get("units_m").is_none() {
                let what = "does not say its unit, which is the centimeter then; `units_m` changes it";
                remarks.warnings.push(format!("{} {what}", found.display()));
            }
            stage.kind
        } else {
            UsdKind::Sampled(read_alembic(&found, node, MOST_VALUES / 3)?)
        };
        read = Some((kind, found));
    }
    let (unit_m, up) = units(fields, own)?;
    let placement = |center: DVec3| -> Result<Placement, SceneError> {
        let scale = fields.or("scale", 1.0, Value::positive)? * unit_m;
        Ok(Placement { translation_m: center, rotation: rotation * up, scale })
    };
    let mut movement = Movement::Still;
    // The point that positions before the motion are relative to.
    let mut base_m = origin_m;
    let motion = motion(fields)?;
    let moves = motion.is_some();
    let mut settle = |placement: &Placement, surface: &mut Surface| {
        base_m = base(placement.bounds(&surface.positions, surface.base), origin_m, moves);
        placement.about(base_m).move_surface(surface);
    };
    let surface = match form {
        "sequence" => {
            let placement = placement(fields.or("origin_m", DVec3::ZERO, Value::vector)?)?;
            let local = placement.about(origin_m);
            let files = sequence_files(fields, &value, path)?;
            let frames = read_frames(&files, placement.scale, |surface| local.move_surface(surface))?;
            let (surface, later) = (frames.first, frames.later);
            remarks.left_out.extend(frames.left_out);
            let frames_per_s = fields.required("frames_per_s")?.positive()?;
            match sequence_playback(fields, frames_per_s, later.len())? {
                None => {
                    movement = Movement::Sequence { frames_per_s, later: later.into() };
                    surface
                }
                Some(playback) => {
                    let times_s = (0..=later.len()).map(|frame| frame as f64 / frames_per_s).collect();
                    let first = surface.positions.clone();
                    let frames = [first.clone(), first].into_iter().chain(later).collect();
                    let (surface, moved) = cached(surface, Cache { playback, times_s, frames }, &name, remarks);
                    movement = moved;
                    surface
                }
            }
        }
        "pc2" | "mdd" => {
            let placement = placement(fields.or("origin_m", DVec3::ZERO, Value::vector)?)?;
            let (surface, moved) = point_cache(fields, &value, &name, path, &placement.about(origin_m), remarks)?;
            movement = moved;
            surface
        }
        "mesh" => {
            let found = find(path, value.text()?).map_err(|what| value.error(what))?;
            let placement = placement(fields.or("origin_m", DVec3::ZERO, Value::vector)?)?;
            let (mut surface, line) = read_obstacle(&found, placement.scale)?;
            remarks.left_out.extend(line);
            settle(&placement, &mut surface);
            surface
        }
        "gltf" | "body" | "usd" | "abc" => {
            let placement = placement(fields.or("origin_m", DVec3::ZERO, Value::vector)?)?;
            let local = placement.about(origin_m);
            let body = match read {
                Some((kind, file)) => file_body(fields, &value, kind, &file, &name, &local, remarks)?,
                None => gltf(fields, &value, &name, path, &local, remarks)?,
            };
            match body {
                Body::AtRest(mut surface) => {
                    settle(&placement, &mut surface);
                    surface
                }
                Body::Playing(surface, moved) => {
                    movement = moved;
                    surface
                }
            }
        }
        _ => {
            let (mut surface, center, own) = shape(form, &value)?;
            settle(&Placement { rotation: rotation * own, ..placement(center)? }, &mut surface);
            surface
        }
    };
    check_obstacle(&surface).map_err(|fault| value.error(format!("at its place in the scene: {fault}")))?;
    if let Some(motion) = motion {
        let motion = motion.relative_to(base_m, origin_m);
        if !stays_finite(&motion, &surface.positions) {
            return Err(fields.error_at("motion", "moves it to where no number can say"));
        }
        if motion.keyframes.iter().any(|key| key.scale == 0.0) {
            return Err(fields.error_at("motion", "scales to nothing; every `scale` of an obstacle must be above 0"));
        }
        movement = Movement::Keyframes(motion);
    }
    Ok(Obstacle {
        name,
        friction: fields.or("friction", friction, Value::not_negative)?,
        positions: surface.positions,
        triangles: surface.triangles,
        movement,
    })
}

/// True for an obstacle whose geometry is in files.
pub(super) fn is_from_file(fields: &Fields) -> bool {
    FILES.into_iter().any(|form| fields.get(form).is_some())
}

/// The point that positions of an obstacle before its motion are relative to: the scene's local origin, or, for an
/// obstacle that moves in from far away, its own.
pub(super) fn base((low, high): (DVec3, DVec3), origin_m: DVec3, moves: bool) -> DVec3 {
    let is_near = (low - origin_m).min_element() >= -FAR_M && (high - origin_m).max_element() <= FAR_M;
    if is_near || !moves { origin_m } else { local_origin(low, high, FAR_M) }
}

fn sequence_files(fields: &Fields, value: &Value, scene: &Path) -> Result<Vec<PathBuf>, SceneError> {
    let text = value.text()?;
    let pattern = Pattern::parse(text).ok_or_else(|| {
        value.error(format!("`{text}` must have one number in it, as in `frame_%04d.obj` or `frame_%d.obj`"))
    })?;
    let first = fields.optional("first", |value| value.whole(0..=u64::from(u32::MAX)))?;
    pattern.files(scene, first.map(|first| first as u32)).map_err(|what| match first {
        Some(_) => fields.error_at("first", what),
        None => value.error(what),
    })
}

/// The shape centered at the origin, the position of its center, and the rotation that its own directions require.
fn shape(form: &str, value: &Value) -> Result<(Surface, DVec3, DQuat), SceneError> {
    let known: &[&str] = match form {
        "sphere" => &["center_m", "radius_m", "triangles"],
        "plane" => &["point_m", "normal", "size_m", "triangles"],
        "box" => &["center_m", "size_m", "triangles"],
        "plate" => &["center_m", "normal", "size_m", "thickness_m", "triangles"],
        _ => &["center_m", "axis", "top_radius_m", "bottom_radius_m", "height_m", "spout_m", "triangles"],
    };
    let fields = value.table(known)?;
    let triangles = fields.or("triangles", DEFAULT_TRIANGLES, |value| value.whole(TRIANGLES))? as f64;
    let center = fields.required(if form == "plane" { "point_m" } else { "center_m" })?.vector()?;
    let towards = |key: &str| -> Result<DQuat, SceneError> {
        match fields.get(key) {
            None => Ok(DQuat::IDENTITY),
            Some(value) => {
                let direction = value.vector()?.try_normalize();
                let direction = direction.ok_or_else(|| value.error("must not be zero"))?;
                Ok(DQuat::from_rotation_arc(DVec3::Y, direction))
            }
        }
    };
    let (surface, turn) = match form {
        "sphere" => {
            let frequency = (triangles / 20.0).sqrt().round() as u32;
            (shapes::sphere(fields.required("radius_m")?.positive()?, frequency), DQuat::IDENTITY)
        }
        "plane" => {
            let size = sides(&fields.required("size_m")?)?;
            (shapes::rectangle(size, cells(size, triangles)), towards("normal")?)
        }
        "box" => (box_of(sides(&fields.required("size_m")?)?, triangles), DQuat::IDENTITY),
        "plate" => {
            let [x, z] = sides(&fields.required("size_m")?)?;
            let thickness = fields.or("thickness_m", 0.02, Value::positive)?;
            (box_of([x, thickness, z], triangles), towards("normal")?)
        }
        _ => (funnel(&fields, triangles)?, towards("axis")?),
    };
    Ok((surface, center, turn))
}

/// Side lengths, each above 0.
fn sides<const N: usize>(value: &Value) -> Result<[f64; N], SceneError> {
    let sides = value.numbers::<N>()?;
    let thin = || value.error("all sides must be above 0, and none more than 100000 times as long as another");
    let (least, most) = sides.iter().fold((f64::INFINITY, 0.0f64), |(least, most), &s| (least.min(s), most.max(s)));
    if least > 0.0 && most <= 1e5 * least { Ok(sides) } else { Err(thin()) }
}

/// Numbers of nearly square cells for about this many triangles, at least one cell per side.
fn cells(size: [f64; 2], triangles: f64) -> [u32; 2] {
    let side = (2.0 * size[0] * size[1] / triangles).sqrt();
    size.map(|length| (length / side).round().clamp(1.0, triangles) as u32)
}

fn box_of(size: [f64; 3], triangles: f64) -> Surface {
    let area = 2.0 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0]);
    let mut side = (2.0 * area / triangles).sqrt();
    let cells = |side: f64| size.map(|length| (length / side).round().clamp(1.0, triangles) as u32);
    // The rim of a thin plate is at least one cell high. The loop takes its triangles off the other sides.
    for _ in 0..3 {
        let [x, y, z] = cells(side).map(f64::from);
        side *= (4.0 * (x * y + y * z + z * x) / triangles).sqrt();
    }
    shapes::cuboid(size, cells(side))
}

/// A truncated cone with a spout below it. Its lower rim lies around the origin.
fn funnel(fields: &Fields, triangles: f64) -> Result<Surface, SceneError> {
    let bottom = fields.required("bottom_radius_m")?.positive()?;
    let height = fields.required("height_m")?.positive()?;
    let top = fields.required("top_radius_m")?;
    let spout = fields.or("spout_m", 0.0, Value::not_negative)?;
    if top.positive()? <= bottom {
        return Err(top.error(format!("must be above bottom_radius_m = {bottom}")));
    }
    let top = top.positive()?;
    let lengths = [bottom, top, height, if spout > 0.0 { spout } else { height }];
    let (least, most) = lengths.iter().fold((f64::INFINITY, 0.0f64), |(l, m), &x| (l.min(x), m.max(x)));
    if most > 1e5 * least {
        return Err(fields.error("none of its lengths may be more than 100000 times another"));
    }
    let slant = (top - bottom).hypot(height);
    let mean_round = std::f64::consts::PI * (top + bottom);
    let area = mean_round * slant + std::f64::consts::TAU * bottom * spout;
    let side = (2.0 * area / triangles).sqrt();
    let segments = (mean_round / side).round().clamp(8.0, triangles) as u32;
    let rings = |length: f64| (length / side).round().clamp(1.0, triangles) as u32;
    let mut profile = Vec::new();
    if spout > 0.0 {
        let n = rings(spout);
        profile.extend((0..n).map(|i| [bottom, spout * (f64::from(i) / f64::from(n) - 1.0)]));
    }
    let n = rings(slant);
    profile.extend((0..=n).map(|i| {
        let s = f64::from(i) / f64::from(n);
        [bottom + s * (top - bottom), s * height]
    }));
    Ok(shapes::revolution(&profile, segments))
}
