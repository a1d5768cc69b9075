//! `[[force]]` of the TOML scene format.

use crate::math::DVec3;

use super::SceneError;
use super::fields::{Fields, Value};
use super::force_field::{FieldShape, ForceField};
use super::over_time::over_time;

pub(super) const FORCE_FIELDS: [&str; 10] =
    ["kind", "strength_m_s2", "center_m", "radius_m", "axis", "scale_m", "change_s", "seed", "start_s", "end_s"];

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Radial,
    Vortex,
    Turbulence,
}

const KINDS: [(&str, Kind); 3] = [("radial", Kind::Radial), ("vortex", Kind::Vortex), ("turbulence", Kind::Turbulence)];

/// Reads a `[[force]]` of a scene with this local origin.
pub(super) fn force(fields: &Fields, origin_m: DVec3) -> Result<ForceField, SceneError> {
    let kind = fields.required("kind")?.choice(&KINDS)?;
    let of_others: &[&str] = match kind {
        Kind::Radial => &["axis", "scale_m", "change_s", "seed"],
        Kind::Vortex => &["scale_m", "change_s", "seed"],
        Kind::Turbulence => &["center_m", "radius_m", "axis"],
    };
    if let Some(key) = of_others.iter().find(|key| fields.get(key).is_some()) {
        let named = KINDS.iter().find(|(_, one)| *one == kind).map_or("", |(name, _)| name);
        return Err(fields.error_at(key, format!("does not belong to a force of the kind `{named}`")));
    }
    let center = || -> Result<DVec3, SceneError> { Ok(fields.or("center_m", DVec3::ZERO, Value::vector)? - origin_m) };
    let radius_m = fields.or("radius_m", f64::INFINITY, Value::positive)?;
    let shape = match kind {
        Kind::Radial => FieldShape::Radial { center_m: center()?, radius_m },
        Kind::Vortex => {
            let axis = fields.or("axis", DVec3::Y, Value::vector)?;
            let unit = axis.try_normalize();
            let axis = unit.ok_or_else(|| fields.error_at("axis", "must have a length above 0"))?;
            FieldShape::Vortex { center_m: center()?, axis, radius_m }
        }
        Kind::Turbulence => FieldShape::Turbulence {
            scale_m: fields.or("scale_m", 1.0, Value::positive)?,
            change_s: fields.or("change_s", f64::INFINITY, Value::positive)?,
            seed: fields.or("seed", 0, |value| value.whole(0..=u64::from(u32::MAX)))?,
            origin_m,
        },
    };
    let strength = fields.required("strength_m_s2")?;
    let (strength_m_s2, strength_over_time) = over_time(&strength, Value::number)?;
    let start_s = fields.or("start_s", 0.0, Value::number)?;
    let end_s = fields.or("end_s", f64::INFINITY, Value::number)?;
    if end_s <= start_s {
        return Err(fields.error_at("end_s", format!("must be later than start_s = {start_s}")));
    }
    Ok(ForceField { shape, strength_m_s2, strength_over_time, start_s, end_s })
}
