//! ARCSim's motions: cubic Hermite splines through keyframed transforms, sampled into piecewise linear motions.

use crate::math::{DQuat, DVec3};

use super::super::files::read_text;
use super::super::json::Json;
use super::super::placement::Placement;
use super::super::{Keyframe, Motion, SceneError};
use super::common::{UNMOVED, find, placement};
use super::mot_file;

/// Linear pieces per spline segment. The error is below 1/500 of the deviation of the cubic from its chord.
const PIECES: u32 = 16;

/// Value or derivative of a transform, blended by component as in ARCSim.
#[derive(Clone, Copy)]
struct Blend {
    translation: DVec3,
    /// A quaternion, normalized only when it is used.
    rotation: DQuat,
    scale: f64,
}

impl Blend {
    const ZERO: Blend = Blend { translation: DVec3::ZERO, rotation: DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), scale: 0.0 };

    fn weighted(terms: [(f64, Blend); 4]) -> Blend {
        terms.iter().fold(Blend::ZERO, |sum, (weight, term)| Blend {
            translation: sum.translation + *weight * term.translation,
            rotation: sum.rotation + term.rotation * *weight,
            scale: sum.scale + weight * term.scale,
        })
    }
}

struct Key {
    time_s: f64,
    value: Blend,
    velocity: Option<Blend>,
}

/// `motions: {motfile, fps, transform}`: motions from a file instead of a list.
pub(super) struct MotionFile<'a> {
    /// Name and content of the file; none if the scene has a list of motions or no motions.
    file: Option<(&'a str, Result<Vec<Motion>, String>)>,
}

impl<'a> MotionFile<'a> {
    /// Reads the file if the scene names one. A missing or damaged file is an error only where a motion is used.
    pub(super) fn of(root: &Json<'a>) -> Result<MotionFile<'a>, SceneError> {
        let Some(motions) = root.get("motions").filter(|motions| motions.get("motfile").is_some()) else {
            return Ok(MotionFile { file: None });
        };
        let name = motions.required("motfile")?;
        let frames_per_s = motions.required("fps")?.positive()?;
        let overall = motions.or("transform", UNMOVED, placement)?;
        let read = match find(&name) {
            Ok(path) => match read_text(&path) {
                Ok(text) => {
                    mot_file::parse(&text).map_err(|what| format!("its motion is in {}: {what}", path.display()))
                }
                Err(error) => Err(format!("its motion is in {error}")),
            },
            Err(_) => Err(format!(
                "its motion is in `{}`, which is neither beside the scene, in the folder above nor in the working directory",
                name.text()?
            )),
        };
        let motions = read.map(|bodies| bodies.iter().map(|body| body_motion(body, frames_per_s, &overall)).collect());
        Ok(MotionFile { file: Some((name.text()?, motions)) })
    }
}

/// A spline through the frames, each followed by the overall transform.
fn body_motion(frames: &[mot_file::BodyFrame], frames_per_s: f64, overall: &Placement) -> Motion {
    let mut keys: Vec<Key> = Vec::with_capacity(frames.len());
    for (i, frame) in frames.iter().enumerate() {
        let mut rotation = overall.rotation * frame.orientation;
        if keys.last().is_some_and(|last| last.value.rotation.dot(rotation) < 0.0) {
            rotation = -rotation;
        }
        let translation = overall.translation_m + overall.rotation * (overall.scale * frame.position);
        let value = Blend { translation, rotation, scale: overall.scale };
        keys.push(Key { time_s: i as f64 / frames_per_s, value, velocity: None });
    }
    sample(&keys)
}

/// The motion of an obstacle, in world coordinates; `index` is the field with its number.
pub(super) fn world_motion(root: &Json, file: &MotionFile, index: &Json) -> Result<Motion, SceneError> {
    motion_number(root, file, index.whole(0)? as usize, index)
}

/// The motion with this number. Errors refer to `at`.
pub(super) fn motion_number(root: &Json, file: &MotionFile, number: usize, at: &Json) -> Result<Motion, SceneError> {
    if let Some((name, motions)) = &file.file {
        let motions = motions.as_ref().map_err(|what| at.error(what))?;
        let missing = || at.error(format!("there is no motion {number}; `{name}` has {}", motions.len()));
        return motions.get(number).cloned().ok_or_else(missing);
    }
    let list = root.get("motions").ok_or_else(|| at.error("the scene has no `motions`"))?.array()?;
    let motion = list
        .get(number)
        .ok_or_else(|| at.error(format!("there is no motion {number}; the scene has {}", list.len())))?;
    Ok(sample(&keys(motion)?))
}

/// The motion of a handle that starts at `start_s`, relative to the motion's transform at that time.
pub(super) fn handle_motion(root: &Json, file: &MotionFile, index: &Json, start_s: f64) -> Result<Motion, SceneError> {
    let relative = relative_to(&world_motion(root, file, index)?, start_s);
    relative.ok_or_else(|| index.error(format!("the motion has scale 0 at {start_s} s, when the handle takes hold")))
}

fn keys(motion: &Json) -> Result<Vec<Key>, SceneError> {
    let mut keys: Vec<Key> = Vec::new();
    for json in motion.array()? {
        let time_s = json.required("time")?.number()?;
        if keys.last().is_some_and(|last| last.time_s >= time_s) {
            return Err(json.error("its time must be later than that of the keyframe before"));
        }
        let placement = json.or("transform", UNMOVED, placement)?;
        let mut rotation = placement.rotation;
        // q and -q are the same rotation; blending needs the one closer to the previous key.
        if keys.last().is_some_and(|last| last.value.rotation.dot(rotation) < 0.0) {
            rotation = -rotation;
        }
        let velocity = |json: &Json| -> Result<Blend, SceneError> {
            Ok(Blend {
                translation: json.or("translate", DVec3::ZERO, Json::vector)?,
                scale: json.or("scale", 0.0, Json::number)?,
                ..Blend::ZERO
            })
        };
        let velocity = json.get("velocity").map(|json| velocity(&json)).transpose()?;
        keys.push(Key {
            time_s,
            value: Blend { translation: placement.translation_m, rotation, scale: placement.scale },
            velocity,
        });
    }
    if keys.is_empty() {
        return Err(motion.error("a motion needs at least one keyframe"));
    }
    Ok(keys)
}

/// Derivative at a key: as given, else Catmull-Rom inside and zero at the ends.
fn velocity(keys: &[Key], i: usize) -> Blend {
    match keys[i].velocity {
        Some(velocity) => velocity,
        None if i == 0 || i + 1 == keys.len() => Blend::ZERO,
        None => {
            let (before, after) = (&keys[i - 1], &keys[i + 1]);
            let rate = 1.0 / (after.time_s - before.time_s);
            Blend::weighted([(rate, after.value), (-rate, before.value), (0.0, Blend::ZERO), (0.0, Blend::ZERO)])
        }
    }
}

fn sample(keys: &[Key]) -> Motion {
    let mut keyframes = Vec::new();
    let mut push = |time_s: f64, value: Blend| {
        let rotation = if value.rotation.length() > 0.0 { value.rotation.normalize() } else { DQuat::IDENTITY };
        keyframes.push(Keyframe {
            translation_m: value.translation,
            rotation,
            scale: value.scale,
            ..Keyframe::identity(time_s)
        });
    };
    for (i, pair) in keys.windows(2).enumerate() {
        let span = pair[1].time_s - pair[0].time_s;
        let velocities = [velocity(keys, i), velocity(keys, i + 1)];
        for piece in 0..PIECES {
            let s = f64::from(piece) / f64::from(PIECES);
            let (s2, s3) = (s * s, s * s * s);
            let value = Blend::weighted([
                (2.0 * s3 - 3.0 * s2 + 1.0, pair[0].value),
                (3.0 * s2 - 2.0 * s3, pair[1].value),
                ((s3 - 2.0 * s2 + s) * span, velocities[0]),
                ((s3 - s2) * span, velocities[1]),
            ]);
            push(pair[0].time_s + s * span, value);
        }
    }
    if let Some(last) = keys.last() {
        push(last.time_s, last.value);
    }
    Motion { keyframes }
}

/// M(t) M(start)^-1 with the position of M(start) as pivot, so that every component is still blended between keyframes.
fn relative_to(motion: &Motion, start_s: f64) -> Option<Motion> {
    let (scale, rotation, place) = motion.transform_at(start_s).to_scale_rotation_translation();
    let inverse = rotation.inverse();
    let relative = |key: &Keyframe| Keyframe {
        translation_m: key.translation_m - place,
        rotation: key.rotation * inverse,
        scale: key.scale / scale.x,
        pivot_m: place,
        ..*key
    };
    (scale.x > 0.0).then(|| Motion { keyframes: motion.keyframes.iter().map(relative).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Vec3;
    use std::path::Path;

    fn motion(text: &str, start_s: f64) -> Result<Motion, String> {
        let value = crate::scene::json::parse_json(text, Path::new("m.json")).unwrap();
        let root = Json::root(Path::new("m.json"), &value);
        let file = MotionFile::of(&root).map_err(|error| error.to_string())?;
        handle_motion(&root, &file, &root.required("use").unwrap(), start_s).map_err(|error| error.to_string())
    }

    #[test]
    fn the_spline_eases_in_and_out_and_starts_where_the_handle_is() {
        let text = "{use: 0, motions: [[{time: 0, transform: {translate: [5, 0, 0]}}, {time: 2, transform: {translate: [9, 0, 0]}}]]}";
        let motion = motion(text, 0.0).unwrap();
        for (time_s, x) in [(0.0, 0.0), (0.5, 4.0 * (3.0 / 16.0 - 2.0 / 64.0)), (1.0, 2.0), (2.0, 4.0), (5.0, 4.0)] {
            assert!(motion.apply(time_s, Vec3::ZERO).distance(Vec3::new(x, 0.0, 0.0)) < 1e-6, "at {time_s} s");
        }
    }

    #[test]
    fn rotation_about_the_place_of_the_motion() {
        let text = "{use: 0, motions: [[{time: 0, transform: {translate: [1, 0, 0], rotate: [30, 0, 0, 1]}},
            {time: 1, transform: {translate: [1, 0, 0], rotate: [120, 0, 0, 1]}}]]}";
        let motion = motion(text, 0.0).unwrap();
        assert!(motion.apply(1.0, Vec3::new(3.0, 0.0, 0.0)).distance(Vec3::new(1.0, 2.0, 0.0)) < 1e-6);
    }

    #[test]
    fn motions_that_cannot_be_had_say_why() {
        let fault = |text| motion(text, 1.0).unwrap_err();
        assert_eq!(fault("{use: 1}"), "m.json: field `use`: the scene has no `motions`");
        assert_eq!(fault("{use: 1, motions: [[]]}"), "m.json: field `use`: there is no motion 1; the scene has 1");
        assert_eq!(
            fault("{use: 0, motions: {motfile: 'a.mot', fps: 1}}"),
            "m.json: field `use`: its motion is in `a.mot`, which is neither beside the scene, in the folder above nor in the \
             working directory"
        );
        assert_eq!(fault("{use: 0, motions: {motfile: 'a.mot'}}"), "m.json: field `motions.fps`: is missing");
        assert_eq!(
            fault("{use: 0, motions: {motfile: 'a.mot', fps: 0}}"),
            "m.json: field `motions.fps`: must be a number above 0"
        );
        assert_eq!(
            fault("{use: 0, motions: [[{time: 1}, {time: 1}]]}"),
            "m.json: field `motions[0][1]`: its time must be later than that of the keyframe before"
        );
        assert_eq!(
            fault("{use: 0, motions: [[{time: 0, transform: {scale: 0}}]]}"),
            "m.json: field `use`: the motion has scale 0 at 1 s, when the handle takes hold"
        );
    }
}
