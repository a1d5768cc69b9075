//! `motion = [{ time_s, translate_m, rotate_deg, scale, pivot_m }, ..]` of pins and obstacles.

use crate::math::{DVec3, Vec3};

use super::fields::{Fields, Value};
use super::{Keyframe, Motion, SceneError};

/// Most turns of a keyframe. Up to this number an f64 angle is accurate to 1e-9 of a turn.
const MOST_TURNS: f64 = 1e6;

/// Reads the field `motion`; none if it has no keyframes.
pub(super) fn motion(fields: &Fields) -> Result<Option<Motion>, SceneError> {
    let known = ["time_s", "translate_m", "rotate_deg", "scale", "pivot_m"];
    let mut keyframes: Vec<Keyframe> = Vec::new();
    for fields in fields.tables("motion", &known)? {
        let still = Keyframe::identity(fields.required("time_s")?.number()?);
        if keyframes.last().is_some_and(|last| last.time_s >= still.time_s) {
            return Err(fields.error_at("time_s", "must be later than that of the keyframe before"));
        }
        let keyframe = Keyframe {
            translation_m: fields.or("translate_m", DVec3::ZERO, Value::vector)?,
            scale: fields.or("scale", 1.0, Value::not_negative)?,
            pivot_m: fields.or("pivot_m", DVec3::ZERO, Value::vector)?,
            ..still
        };
        let keyframe = match fields.get("rotate_deg") {
            None => keyframe,
            Some(value) => {
                let (axis, degrees) = value.turn()?;
                if degrees.abs() > MOST_TURNS * 360.0 {
                    return Err(value.error(format!("turns by more than {MOST_TURNS} full turns")));
                }
                keyframe.turned(axis, degrees.to_radians())
            }
        };
        if keyframes.last().is_some_and(|last| ambiguous(last, &keyframe)) {
            let what = "turns by 180 degrees or more since the keyframe before, about another axis; add one between";
            return Err(fields.error_at("rotate_deg", what));
        }
        keyframes.push(keyframe);
    }
    Ok((!keyframes.is_empty()).then_some(Motion { keyframes }))
}

/// True if two keyframes turn about different axes and the rotation between them exceeds half a turn. Interpolation
/// takes the shorter way, which is then probably not the intended one.
fn ambiguous(last: &Keyframe, next: &Keyframe) -> bool {
    let (Some((axis, angle)), Some((other, next_angle))) = (last.turn, next.turn) else { return false };
    axis != other && (angle - next_angle).abs() >= std::f64::consts::PI
}

/// True if the motion keeps all points finite in f32 at every keyframe.
pub(super) fn stays_finite(motion: &Motion, points: &[Vec3]) -> bool {
    let (low, high) =
        points.iter().fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), &p| (low.min(p), high.max(p)));
    let radius = low.abs().max(high.abs()).as_dvec3().length();
    motion.keyframes.iter().all(|key| {
        let reach = key.pivot_m.length() + key.translation_m.length() + key.scale * (radius + key.pivot_m.length());
        reach < f64::from(f32::MAX)
    })
}
