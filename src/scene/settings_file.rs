//! `[simulation]` and `[air]` of the TOML scene format.

use crate::math::{DVec3, Vec3};

use super::fields::{Fields, Value};
use super::force_file::{FORCE_FIELDS, force};
use super::model::{CONTACT_STIFFNESS, DEFAULT_THICKNESS_M};
use super::over_time::{OverTime, over_time};
use super::{PreconditionerKind, SceneError, Settings, SettingsOverTime, Substeps};

pub(super) const SIMULATION_FIELDS: [&str; 15] = [
    "step_s",
    "substeps",
    "frames",
    "steps_per_frame",
    "frame_s",
    "gravity_m_s2",
    "relative_tolerance",
    "max_iterations",
    "preconditioner",
    "thickness_m",
    "friction",
    "collisions",
    "contact_stiffness",
    "friction_factor",
    "stiffness_factor",
];
pub(super) const AIR_FIELDS: [&str; 3] = ["wind_m_s", "density_kg_m3", "drag_kg_m2_s"];

/// Reads the settings from the document `root`; `origin_m`: the scene's local origin.
pub(super) fn settings(root: &Fields, origin_m: DVec3, warnings: &mut Vec<String>) -> Result<Settings, SceneError> {
    let simulation = root.table("simulation", &SIMULATION_FIELDS)?;
    let (step_s, steps_per_frame) = step(&simulation, warnings)?;
    let vector = |value: &Value| Ok(value.vector()?.as_vec3());
    let relative_tolerance = simulation.or("relative_tolerance", 0.01, Value::positive)?;
    if relative_tolerance >= 1.0 {
        return Err(simulation.error_at("relative_tolerance", format!("must be below 1, not {relative_tolerance}")));
    }
    // Without `[air]` there is no air, so that free fall has no drag.
    let air = root.table("air", &AIR_FIELDS)?;
    let density = if root.get("air").is_some() { 1.2 } else { 0.0 };
    let keyed = |value: &Value| over_time(value, vector);
    let (gravity_m_s2, gravity_keys) = simulation.or("gravity_m_s2", (Vec3::new(0.0, -9.81, 0.0), None), keyed)?;
    let (wind_m_s, wind_keys) = air.or("wind_m_s", (Vec3::ZERO, None), keyed)?;
    let forces = root.tables("force", &FORCE_FIELDS)?;
    let over_time = SettingsOverTime {
        gravity_m_s2: gravity_keys,
        gravity_waits: false,
        wind_m_s: wind_keys,
        friction_factor: simulation.optional("friction_factor", |value| factor(value, Value::not_negative))?,
        stiffness_factor: simulation.optional("stiffness_factor", |value| factor(value, Value::positive))?,
        forces: forces.iter().map(|fields| force(fields, origin_m)).collect::<Result<_, _>>()?,
    };
    Ok(Settings {
        step_s,
        substeps: simulation.or("substeps", Substeps::Auto, substeps)?,
        steps_per_frame,
        frames: simulation.or("frames", u64::from(FRAMES), |value| value.whole(0..=10_000_000))? as u32,
        gravity_m_s2,
        wind_m_s,
        air_density_kg_m3: air.or("density_kg_m3", density, Value::not_negative)?,
        air_drag_kg_m2_s: air.or("drag_kg_m2_s", 0.0, Value::not_negative)?,
        relative_tolerance,
        max_iterations: simulation.or("max_iterations", 500, |value| value.whole(1..=1_000_000))? as u32,
        preconditioner: simulation
            .or("preconditioner", PreconditionerKind::Auto, |value| value.choice(&PreconditionerKind::CHOICES))?,
        thickness_m: simulation.or("thickness_m", DEFAULT_THICKNESS_M, Value::positive)?,
        friction: simulation.or("friction", 0.3, Value::not_negative)?,
        collisions: simulation.or("collisions", true, Value::boolean)?,
        contact_stiffness: simulation.or("contact_stiffness", CONTACT_STIFFNESS, Value::positive)?,
        over_time,
    })
}

/// A factor with or without keys.
fn factor<'a>(
    value: &Value<'a>,
    read: impl Fn(&Value<'a>) -> Result<f64, SceneError>,
) -> Result<OverTime<f64>, SceneError> {
    let (factor, keyed) = over_time(value, read)?;
    keyed.or_else(|| OverTime::new(vec![(0.0, factor)])).ok_or_else(|| value.error("needs a key"))
}

/// `"auto"` or a number.
fn substeps(value: &Value) -> Result<Substeps, SceneError> {
    if value.is_text() {
        return value.text()?.parse().map_err(|_| value.error("must be \"auto\" or a whole number"));
    }
    Ok(Substeps::Fixed(value.whole(1..=u64::from(Substeps::MOST))? as u32))
}

/// Step length if the scene does not give one, seconds.
pub(super) const STEP_S: f64 = 1.0 / 250.0;
/// Steps of a frame, and frames of a shot, of a scene that does not say.
pub(super) const STEPS_PER_FRAME: u32 = 10;
pub(super) const FRAMES: u32 = 100;

/// Step length in seconds and number of steps per frame.
fn step(simulation: &Fields, warnings: &mut Vec<String>) -> Result<(f64, u32), SceneError> {
    let step_s = simulation.or("step_s", STEP_S, Value::positive)?;
    let steps_per_frame = simulation.optional("steps_per_frame", |value| value.whole(1..=1_000_000))?;
    let frame_s = simulation.optional("frame_s", Value::positive)?;
    let frame_s = match (steps_per_frame, frame_s) {
        (Some(_), Some(_)) => return Err(simulation.error_at("frame_s", "give either `frame_s` or `steps_per_frame`")),
        (steps, None) => return Ok((step_s, steps.map_or(STEPS_PER_FRAME, |steps| steps as u32))),
        (None, Some(frame_s)) => frame_s,
    };
    let steps = (frame_s / step_s).round();
    // The tolerance of a thousandth of a step accepts 1/24 s rounded to four digits.
    if (1.0..=1e6).contains(&steps) && (frame_s / step_s - steps).abs() <= 1e-3 * steps {
        return Ok((step_s, steps as u32));
    }
    // The step is shortened, never lengthened, to fit the frame.
    let steps = (frame_s / step_s).ceil();
    let fitting = frame_s / steps;
    if simulation.get("step_s").is_none() && steps <= 1e6 {
        warnings.push(format!("step_s is {fitting:.6} s, so that frame_s = {frame_s} is {steps} steps"));
        return Ok((fitting, steps as u32));
    }
    let what = format!("must be a whole number of steps of {step_s} s");
    Err(simulation.error_at("frame_s", format!("{what}; step_s = {fitting:.9} makes it {steps} steps")))
}
