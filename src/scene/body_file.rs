//! `[[obstacle]]` with a body from a file: `gltf`, `usd`, `abc`, `pc2`, `mdd`, and the fields that say when it plays
//! its clip.

use std::path::Path;
use std::sync::Arc;

use bytemuck::cast_slice;

use crate::math::{DAffine3, DQuat, Vec3};
use crate::mesh::{Surface, needles, read_file};

use super::alembic::read_alembic;
use super::cache_file::{CacheFormat, Samples, read_cache};
use super::cloth_file::Remarks;
use super::fields::{Fields, Value};
use super::files::find;
use super::gltf::{BodyFile, read_body};
use super::person::person;
use super::placement::Placement;
use super::sequence::MOST_VALUES;
use super::usd::{UsdKind, read_usd};
use super::{Cache, Movement, Playback, Rig, SceneError};

/// Fields of an obstacle that plays a clip.
pub(super) const PLAY_FIELDS: [&str; 4] = ["start_s", "rate", "loop", "lead_in_s"];
/// Triangles of a body that is made, if the scene does not give a number.
const DEFAULT_TRIANGLES: u64 = 12_000;
/// Valid numbers of triangles of a body that is made. With less, fingers and ankles are thinner than a triangle.
const TRIANGLES: std::ops::RangeInclusive<u64> = 4_000..=2_000_000;
/// Poses at which the triangles of a body are looked at, besides the first: none may be without area in one of them.
const LOOKS: u32 = 16;
/// A body that starts its clip over and is then this far from where it was jumps.
const JUMP_M: f32 = 0.01;

/// A body as the obstacle's fields choose it.
pub(super) enum Body {
    /// In its rest pose, in the coordinates of the file.
    AtRest(Surface),
    /// At time 0 in the coordinates of the scene, and how it moves.
    Playing(Surface, Movement),
}

/// Refuses fields that belong to other forms of an obstacle.
pub(super) fn check_fields(fields: &Fields, form: &str) -> Result<(), SceneError> {
    let given = |keys: &[&'static str]| keys.iter().copied().find(|key| fields.get(key).is_some());
    let of_bodies: &[&'static str] = match form {
        "gltf" => &["triangles"],
        "usd" | "abc" => &["clip", "triangles"],
        "body" => &["node"],
        _ => &["clip", "node", "triangles"],
    };
    if let Some(key) = given(of_bodies) {
        let owner = match key {
            "clip" => "`gltf` or `body`",
            "node" => "`gltf`, `usd` or `abc`",
            _ => "`body`",
        };
        return Err(fields.error_at(key, format!("belongs to an obstacle with a {owner}")));
    }
    let moved_by = match form {
        "gltf" | "body" => fields.get("clip").map(|_| "clip"),
        "sequence" | "pc2" | "mdd" | "usd" | "abc" => Some(form),
        _ => None,
    };
    match (moved_by, given(&PLAY_FIELDS)) {
        (None, Some(key)) => {
            let what =
                "belongs to an obstacle with a `sequence`, `pc2`, `mdd`, `usd`, `abc` or a `clip` of `gltf` or `body`";
            return Err(fields.error_at(key, what));
        }
        (Some("sequence"), Some(_)) if fields.get("lead_in_s").is_some() => {
            return Err(fields.error_at("lead_in_s", "needs a rest shape, which a `sequence` does not have"));
        }
        _ => {}
    }
    // What is in a stage or an archive may stand still.
    let moved_by = moved_by.filter(|way| !matches!(*way, "usd" | "abc"));
    if let (Some(way), true) = (moved_by, fields.get("motion").is_some()) {
        return Err(fields.error_at("motion", format!("give either `motion` or a `{way}`")));
    }
    if form != "sequence" && fields.get("first").is_some() {
        return Err(fields.error_at("first", "belongs to an obstacle with a `sequence`"));
    }
    if !matches!(form, "sequence" | "pc2") && fields.get("frames_per_s").is_some() {
        return Err(fields.error_at("frames_per_s", "belongs to an obstacle with a `sequence` or `pc2`"));
    }
    Ok(())
}

/// Meters per unit of an obstacle's file, and the rotation that brings its up axis to y. `own`: what the file says.
pub(super) fn units(fields: &Fields, own: (f64, DQuat)) -> Result<(f64, DQuat), SceneError> {
    let up = [
        ("y", DQuat::IDENTITY),
        ("z", DQuat::from_rotation_x(-std::f64::consts::FRAC_PI_2)),
        ("x", DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2)),
    ];
    Ok((fields.or("units_m", own.0, Value::positive)?, fields.or("up", own.1, |value| value.choice(&up))?))
}

/// When a clip of this length is played.
fn playback(fields: &Fields, length_s: f64) -> Result<Playback, SceneError> {
    Ok(Playback {
        start_s: fields.or("start_s", 0.0, Value::number)?,
        rate: fields.or("rate", 1.0, Value::positive)?,
        repeats: fields.or("loop", false, Value::boolean)?,
        lead_in_s: fields.or("lead_in_s", 0.0, Value::not_negative)?,
        length_s,
    })
}

/// Reads the body of a `gltf`, or makes that of a `body`. `name` = the obstacle's, `placement` = relative to the
/// scene's local origin.
pub(super) fn gltf(
    fields: &Fields,
    value: &Value,
    name: &str,
    scene: &Path,
    placement: &Placement,
    remarks: &mut Remarks,
) -> Result<Body, SceneError> {
    let (path, file) = match value.is_named("body") {
        false => {
            let path = find(scene, value.text()?).map_err(|what| value.error(what))?;
            let file = read_body(&path)?;
            (path, file)
        }
        true => {
            value.choice(&[("person", ())])?;
            let triangles = fields.or("triangles", DEFAULT_TRIANGLES, |value| value.whole(TRIANGLES))?;
            let made = person(triangles as f64);
            (scene.into(), made.ok_or_else(|| value.error("cannot be made with so few triangles; give more"))?)
        }
    };
    let node = fields.optional("node", Value::text)?;
    let no_node = |what: String| fields.error_at("node", what);
    let Some(clip) = fields.get("clip") else {
        if !file.clips.is_empty() && value.is_named("gltf") {
            let clips = clip_names(&file);
            remarks.left_out.push(format!("{}: `{name}` plays none of its clips ({clips})", path.display()));
        }
        let (rig, triangles) = file.rig(node, None, DAffine3::IDENTITY).map_err(no_node)?;
        let mut surface = surface(&rig, triangles);
        let flat = needles(&surface.positions, &surface.triangles);
        remarks.left_out.extend(leave_out(&mut surface, &flat, &path)?);
        return Ok(Body::AtRest(surface));
    };
    let played = file.clip(clip.text()?).map_err(|what| clip.error(what))?;
    let playback = playback(fields, played.length_s)?;
    let (rig, triangles) = file.rig(node, Some((played, playback)), placement.affine()).map_err(no_node)?;
    playing(rig, triangles, playback, &clip, &path, name, remarks)
}

/// A rig that plays its clip. `blame`: the field that names what is played.
fn playing(
    rig: Rig,
    triangles: Vec<[u32; 3]>,
    playback: Playback,
    blame: &Value,
    path: &Path,
    name: &str,
    remarks: &mut Remarks,
) -> Result<Body, SceneError> {
    let mut surface = surface(&rig, triangles);
    let mut flat = needles(&surface.positions, &surface.triangles);
    for look in 0..=LOOKS {
        let time_s = playback.run_time(playback.length_s * f64::from(look) / f64::from(LOOKS));
        let positions = rig.positions_at(time_s);
        if let Some(vertex) = positions.iter().position(|x| !x.is_finite()) {
            return Err(blame.error(format!("moves vertex {} to where no number can say", vertex / 3 + 1)));
        }
        let points: &[Vec3] = cast_slice(&positions);
        flat.iter_mut().zip(needles(points, &surface.triangles)).for_each(|(flat, needle)| *flat |= needle);
    }
    remarks.left_out.extend(leave_out(&mut surface, &flat, path)?);
    let poses = |time_s| cast_slice(&rig.positions_at(time_s)).to_vec();
    remarks.warnings.extend(jump(poses, playback, name));
    Ok(Body::Playing(surface, Movement::Rigged(Arc::new(rig))))
}

/// What a USD stage or an Alembic archive has in it.
pub struct MovingMeshes {
    /// Vertices of all meshes.
    pub vertices: usize,
    /// Triangles of all meshes.
    pub triangles: usize,
    /// Paths of the meshes.
    pub meshes: Vec<String>,
    /// Joints that carry vertices.
    pub joints: usize,
    /// Number of samples of points, or of keys of the joint with the most.
    pub samples: usize,
    /// Times of the first and of the last, seconds.
    pub times_s: [f64; 2],
    /// Meters per unit, and whether z is up, if the format says that.
    pub units: Option<(f64, bool)>,
}

/// Reads a stage or an archive, as its ending says.
///
/// # Errors
/// It cannot be read, or has no mesh.
pub fn read_moving_meshes(path: &Path) -> Result<MovingMeshes, SceneError> {
    let is_archive = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("abc"));
    let (kind, units) = if is_archive {
        (UsdKind::Sampled(read_alembic(path, None, MOST_VALUES / 3)?), None)
    } else {
        let stage = read_usd(path, None, MOST_VALUES / 3)?;
        (stage.kind, Some((stage.unit_m, stage.up != DQuat::IDENTITY)))
    };
    Ok(match kind {
        UsdKind::Sampled(body) => MovingMeshes {
            vertices: body.frames[0].len(),
            triangles: body.triangles.len(),
            meshes: body.names,
            joints: 0,
            samples: body.times_s.len(),
            times_s: [body.times_s[0], body.times_s[body.times_s.len() - 1]],
            units,
        },
        UsdKind::Skinned(body) => MovingMeshes {
            vertices: body.header.vertices(),
            triangles: body.triangles.len(),
            meshes: body.names,
            joints: body.header.parts.iter().filter_map(|part| part.skin.as_ref()).map(|skin| skin.joints.len()).sum(),
            samples: body.header.tracks.iter().map(|track| track.keys).max().unwrap_or(1),
            times_s: [0.0, body.length_s],
            units,
        },
    })
}

/// The body of a `usd` or `abc`, whose content is `kind`. `placement` = relative to the scene's local origin.
pub(super) fn file_body(
    fields: &Fields,
    value: &Value,
    kind: UsdKind,
    path: &Path,
    name: &str,
    placement: &Placement,
    remarks: &mut Remarks,
) -> Result<Body, SceneError> {
    let moves = match &kind {
        UsdKind::Sampled(body) => body.frames.len() > 1,
        UsdKind::Skinned(body) => !body.header.tracks.is_empty(),
    };
    if !moves && let Some(key) = PLAY_FIELDS.into_iter().find(|key| fields.get(key).is_some()) {
        return Err(fields.error_at(key, format!("has nothing to play: the meshes of {} stand still", path.display())));
    }
    if moves && fields.get("motion").is_some() {
        return Err(
            fields.error_at("motion", format!("does not go with meshes that move, as those of {}", path.display()))
        );
    }
    match kind {
        UsdKind::Sampled(body) if !moves => {
            let positions = body.frames.into_iter().next().unwrap_or_default();
            let mut surface = Surface { positions, triangles: body.triangles, ..Surface::default() };
            let flat = needles(&surface.positions, &surface.triangles);
            remarks.left_out.extend(leave_out(&mut surface, &flat, path)?);
            Ok(Body::AtRest(surface))
        }
        UsdKind::Sampled(mut body) => {
            if body.rest.is_none() && fields.get("lead_in_s").is_some() {
                return Err(fields.error_at("lead_in_s", "needs a rest shape, which the file does not have"));
            }
            let rest = body.rest.unwrap_or_else(|| body.frames[0].clone());
            body.frames.insert(0, rest);
            let surface = Surface { triangles: body.triangles, ..Surface::default() };
            cached_frames(fields, (surface, body.times_s, body.frames), [path, path], name, placement, remarks)
                .map(|(surface, movement)| Body::Playing(surface, movement))
        }
        UsdKind::Skinned(body) => {
            let mut rig = Rig { header: body.header, values: body.values };
            if !moves {
                let mut surface = surface(&rig, body.triangles);
                let flat = needles(&surface.positions, &surface.triangles);
                remarks.left_out.extend(leave_out(&mut surface, &flat, path)?);
                return Ok(Body::AtRest(surface));
            }
            let playback = playback(fields, body.length_s.max(0.0))?;
            (rig.header.playback, rig.header.placement) = (Some(playback), placement.affine());
            playing(rig, body.triangles, playback, value, path, name, remarks)
        }
    }
}

/// Names of the clips of a file, for a message.
pub(super) fn clip_names(file: &BodyFile) -> String {
    let names: Vec<&str> = file.clips.iter().map(|clip| &clip.name[..]).collect();
    names.join(", ")
}

/// The body at time 0.
fn surface(rig: &Rig, triangles: Vec<[u32; 3]>) -> Surface {
    let positions = rig.positions_at(0.0);
    Surface { positions: cast_slice(&positions).to_vec(), triangles, ..Surface::default() }
}

/// Drops triangles without area; a sentence with their number.
fn leave_out(surface: &mut Surface, flat: &[bool], path: &Path) -> Result<Option<String>, SceneError> {
    match flat.contains(&false) {
        true => Ok(surface.leave_out(flat, path)),
        false => {
            Err(SceneError::File { path: path.into(), what: "has no triangle with an area in all of its poses".into() })
        }
    }
}

/// When a sequence of `1 + later` frames is played; none if its first frame is at time 0 and its last one stays.
pub(super) fn sequence_playback(
    fields: &Fields,
    frames_per_s: f64,
    later: usize,
) -> Result<Option<Playback>, SceneError> {
    let is_plain = PLAY_FIELDS.iter().all(|key| fields.get(key).is_none());
    if is_plain { Ok(None) } else { playback(fields, later as f64 / frames_per_s).map(Some) }
}

/// A surface at time 0 and how it moves.
pub(super) fn cached(mut surface: Surface, cache: Cache, name: &str, remarks: &mut Remarks) -> (Surface, Movement) {
    surface.positions = cache.positions_at(0.0);
    remarks.warnings.extend(jump(|time_s| cache.positions_at(time_s), cache.playback, name));
    (surface, Movement::Cached(Arc::new(cache)))
}

/// Reads a `pc2` or `mdd`: a point cache and the mesh that it moves. `placement` = relative to the scene's local
/// origin.
pub(super) fn point_cache(
    fields: &Fields,
    value: &Value,
    name: &str,
    scene: &Path,
    placement: &Placement,
    remarks: &mut Remarks,
) -> Result<(Surface, Movement), SceneError> {
    let files = value.table(&["rest", "cache"])?;
    let file = |key: &str| {
        let value = files.required(key)?;
        find(scene, value.text()?).map_err(|what| value.error(what))
    };
    let (rest, path) = (file("rest")?, file("cache")?);
    let format = match value.is_named("pc2") {
        true => CacheFormat::Pc2 { frames_per_s: fields.required("frames_per_s")?.positive()? },
        false => CacheFormat::Mdd,
    };
    // Far coordinates are rounded here as the cache has rounded them.
    let mut surface = read_file(&rest, 0.0)?;
    let vertices = surface.positions.len();
    let Samples { times_s, mut frames } = read_cache(&path, format, (vertices, &rest), MOST_VALUES / 3)?;
    frames.insert(0, std::mem::take(&mut surface.positions));
    cached_frames(fields, (surface, times_s, frames), [&rest, &path], name, placement, remarks)
}

/// A surface without positions whose vertices go through frames: at rest and at times. `files`: those of the rest mesh
/// and of the other frames.
fn cached_frames(
    fields: &Fields,
    (mut surface, times_s, mut frames): (Surface, Vec<f64>, Vec<Vec<Vec3>>),
    files: [&Path; 2],
    name: &str,
    placement: &Placement,
    remarks: &mut Remarks,
) -> Result<(Surface, Movement), SceneError> {
    let mut flat = vec![false; surface.triangles.len()];
    for (frame, positions) in frames.iter_mut().enumerate() {
        let mut moved = Surface { positions: std::mem::take(positions), ..Surface::default() };
        placement.move_surface(&mut moved);
        *positions = moved.positions;
        if let Some(vertex) = positions.iter().position(|p| !p.is_finite()) {
            let what = format!("at its place in the scene, vertex {} is not finite", vertex + 1);
            return Err(SceneError::File { path: files[frame.min(1)].into(), what });
        }
        flat.iter_mut().zip(needles(positions, &surface.triangles)).for_each(|(flat, needle)| *flat |= needle);
    }
    remarks.left_out.extend(leave_out(&mut surface, &flat, files[0])?);
    let playback = playback(fields, times_s[times_s.len() - 1].max(0.0))?;
    Ok(cached(surface, Cache { playback, times_s, frames }, name, remarks))
}

/// A warning about a body that starts its clip over from another place.
fn jump(poses: impl Fn(f64) -> Vec<Vec3>, playback: Playback, name: &str) -> Option<String> {
    if !playback.repeats {
        return None;
    }
    // The end of the clip itself is its beginning already.
    let just_before = playback.length_s * (1.0 - 1e-9);
    let [first, last] = [0.0, just_before].map(|clip_s| poses(playback.run_time(clip_s)));
    let far = first.iter().zip(&last).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
    (far > JUMP_M).then(|| {
        format!(
            "obstacle `{name}` jumps by up to {far:.2} m within a step wherever its clip starts over; `loop` is for a \
             clip that ends as it begins"
        )
    })
}
