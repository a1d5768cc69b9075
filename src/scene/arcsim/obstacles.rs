//! ARCSim's obstacles: a list of meshes with motions, or a printf pattern of body parts whose i-th part has the i-th
//! motion. A motion gives the placement in the world, also at time 0.

use std::path::Path;

use crate::math::DVec3;
use crate::mesh::{Surface, check_obstacle, read_obstacle};

use super::super::json::Json;
use super::super::keyframes::stays_finite;
use super::super::obstacle_file::base;
use super::super::placement::Placement;
use super::super::sequence::Pattern;
use super::super::{Motion, Movement, Obstacle, SceneError};
use super::common::{UNMOVED, find, placement};
use super::left_out::LeftOut;
use super::motions::{MotionFile, motion_number, world_motion};

/// Reads the obstacles of a scene with the local origin `origin_m`.
pub(super) fn obstacles(
    root: &Json,
    motions: &MotionFile,
    origin_m: DVec3,
    left_out: &mut LeftOut,
) -> Result<Vec<Obstacle>, SceneError> {
    let friction = root.or("obs_friction", 0.3, Json::not_negative)?;
    let Some(list) = root.get("obstacles") else { return Ok(Vec::new()) };
    if list.value.is_string() {
        return body_parts(root, &list, motions, origin_m, friction, left_out);
    }
    let mut obstacles = Vec::new();
    for json in list.array()? {
        let mesh = json.required("mesh")?;
        let Ok(path) = find(&mesh) else {
            let (name, file) = (&json.name, mesh.text()?);
            left_out.say(format!("{name}: left out, there is no file `{file}`"));
            continue;
        };
        let placement = json.or("transform", UNMOVED, placement)?;
        let (mut surface, line) = read_obstacle(&path, placement.scale)?;
        line.into_iter().for_each(|line| left_out.say(line));
        let base_m = settle(&mut surface, &placement, origin_m, json.get("motion").is_some());
        check_obstacle(&surface).map_err(|fault| mesh.error(format!("at its place in the scene: {fault}")))?;
        for key in ["start_time", "end_time"] {
            if json.get(key).is_some() {
                left_out.say(format!("{}.{key}: left out, an obstacle is there all the time", json.name));
            }
        }
        let motion = json.get("motion").map(|index| world_motion(root, motions, &index)).transpose()?;
        let motion = motion.map(|motion| motion.relative_to(base_m, origin_m));
        let (positions, triangles) = (surface.positions, surface.triangles);
        obstacles.push(Obstacle {
            name: json.name.clone(),
            friction,
            movement: movement(motion, &positions, &json)?,
            positions,
            triangles,
        });
    }
    Ok(obstacles)
}

fn body_parts(
    root: &Json,
    field: &Json,
    motions: &MotionFile,
    origin_m: DVec3,
    friction: f64,
    left_out: &mut LeftOut,
) -> Result<Vec<Obstacle>, SceneError> {
    let text = field.text()?;
    let pattern = Pattern::parse(text)
        .ok_or_else(|| field.error(format!("`{text}` must have one number in it, as in `body%04d.obj`")))?;
    let mut obstacles = Vec::new();
    for number in 0.. {
        let name = pattern.name(number);
        let value = serde_json::Value::String(name.clone());
        let Ok(path) = find(&Json { file: field.file, name: field.name.clone(), value: &value }) else { break };
        let (mut surface, line) = read_obstacle(&path, 1.0)?;
        line.into_iter().for_each(|line| left_out.say(line));
        let base_m = settle(&mut surface, &UNMOVED, origin_m, true);
        let motion = motion_number(root, motions, number as usize, field)?.relative_to(base_m, origin_m);
        obstacles.push(Obstacle {
            friction,
            movement: movement(Some(motion), &surface.positions, field)?,
            name,
            positions: surface.positions,
            triangles: surface.triangles,
        });
    }
    let folder = field.file.parent().unwrap_or(Path::new(""));
    let missing = obstacles.len() as u32;
    if let Some(next) =
        [folder, &folder.join(".."), Path::new("")].iter().find_map(|root| pattern.next_from(root, missing))
    {
        let what = format!(
            "number {missing} is missing: there is `{}`, but no `{}`",
            pattern.name(next),
            pattern.name(missing)
        );
        return Err(field.error(what));
    }
    if obstacles.is_empty() {
        left_out.say(format!("obstacles: none, there is no file `{}`", pattern.name(0)));
    }
    Ok(obstacles)
}

/// Places a surface; returns the point that its positions are relative to then.
fn settle(surface: &mut Surface, placement: &Placement, origin_m: DVec3, moves: bool) -> DVec3 {
    let base_m = base(placement.bounds(&surface.positions, surface.base), origin_m, moves);
    placement.about(base_m).move_surface(surface);
    base_m
}

fn movement(motion: Option<Motion>, positions: &[crate::math::Vec3], at: &Json) -> Result<Movement, SceneError> {
    let Some(motion) = motion else { return Ok(Movement::Still) };
    if !stays_finite(&motion, positions) {
        return Err(at.error("its motion moves it to where no number can say"));
    }
    if motion.keyframes.iter().any(|key| key.scale <= 0.0) {
        return Err(at.error("its motion has a scale that is not above 0"));
    }
    Ok(Movement::Keyframes(motion))
}
