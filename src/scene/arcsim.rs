//! Import of ARCSim's scene files: JSON with comments -> [`ParsedScene`].
//!
//! Every feature that has no counterpart here is left out and adds a sentence to `Scene::left_out`. A scene is refused
//! only if its cloth or one of its handles cannot be read. Formats: ARCSim 0.2/0.3 [Narain et al. 2012, 2013].

mod common;
mod left_out;
mod mot_file;
mod motions;
mod obstacles;

use std::path::Path;

use crate::math::DVec3;
use crate::mesh::MaterialSource;

use super::cloth_source::{ClothSource, Shape, StartVelocity, UnplacedCloth, place_cloths};
use super::json::{Json, parse_json};
use super::model::CONTACT_STIFFNESS;
use super::parsed::ParsedScene;
use super::pins::{PinSource, Selection};
use super::placement::unplaced_mesh;
use super::seam_file::SewingSource;
use super::{Fabric, Motion, Plasticity, SceneError, Settings, SettingsOverTime, StrainLimit, load_fabric};

use common::{UNMOVED, find, placement};
use left_out::LeftOut;

/// Seconds that a scene without an end runs. ARCSim runs it until the user stops it.
const ENDLESS_S: f64 = 10.0;

/// Reads an ARCSim scene. Files that it names are looked up beside it, in the folder above and in the working
/// directory.
pub(super) fn parse(text: &str, path: &Path) -> Result<ParsedScene, SceneError> {
    let value = parse_json(text, path)?;
    let root = Json::root(path, &value);
    let mut left_out = LeftOut { disabled: Vec::new(), lines: Vec::new() };
    for name in root.entries("disable")? {
        left_out.disabled.push(name.text()?);
    }

    let list = root.required("cloths")?;
    let entries = list.array()?;
    if entries.is_empty() {
        return Err(list.error("a scene needs at least one cloth"));
    }
    let (mut cloths, mut fields) = (Vec::with_capacity(entries.len()), Vec::new());
    let (mut of_files, mut warnings) = (Vec::new(), Vec::new());
    for entry in &entries {
        let (source, line) = cloth(entry, &mut left_out, &mut warnings)?;
        cloths.push(source);
        fields.push(velocity_field(entry)?);
        of_files.extend(line);
    }
    let (mut cloths, origin_m) = place_cloths(cloths)?;
    for (cloth, [linear, angular, center]) in cloths.iter_mut().zip(fields) {
        let Shape::Mesh(placed) = &cloth.shape else { continue };
        let center = center - origin_m;
        let velocity = |p: &crate::math::Vec3| (linear + angular.cross(p.as_dvec3() - center)).as_vec3();
        cloth.velocity = StartVelocity::PerVertex(placed.mesh.positions.iter().map(velocity).collect());
    }
    let settings = settings(&root, &mut left_out)?;
    let motion_file = motions::MotionFile::of(&root)?;
    let obstacles = obstacles::obstacles(&root, &motion_file, origin_m, &mut left_out)?;

    let (mut pins, mut scene_motions) = (Vec::new(), Vec::new());
    for handle in root.entries("handles")? {
        pins.extend(handle_pin(&root, &motion_file, &handle, &cloths, &mut scene_motions, &mut left_out)?);
    }
    let motions = scene_motions.into_iter().map(|motion| motion.relative_to(origin_m, origin_m)).collect();
    left_out.whole_scene(&root);
    left_out.lines.extend(of_files);
    let scene = ParsedScene {
        path: path.into(),
        name: path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default(),
        origin_m,
        cloths,
        fabrics: Vec::new(),
        pins,
        changes: Vec::new(),
        seams: Vec::new(),
        sewing: SewingSource::default(),
        motions,
        followed: Vec::new(),
        obstacles,
        settings,
        warnings,
        left_out: left_out.lines,
        seams_at: list.place(),
        cloths_at: list.place(),
        pins_at: root.get("handles").unwrap_or(root).place(),
    };
    Ok(scene.warn_of_sizes(|_| true))
}

/// Reads a cloth. The second value is a sentence about parts of its file that are left out.
fn cloth(
    cloth: &Json,
    left_out: &mut LeftOut,
    warnings: &mut Vec<String>,
) -> Result<(UnplacedCloth, Option<String>), SceneError> {
    let file = cloth.required("mesh")?;
    let placement = cloth.or("transform", UNMOVED, placement)?;
    if placement.scale <= 0.0 {
        return Err(cloth.error("the scale of its transform must be above 0"));
    }
    let path = find(&file)?;
    let mesh = unplaced_mesh(&path, MaterialSource::TextureOrShape, None, &placement)?;
    let materials = cloth.required("materials")?.array()?;
    let Some(first) = materials.first() else {
        return Err(cloth.required("materials")?.error("a cloth needs a material"));
    };
    if materials.len() > 1 {
        left_out.say(format!(
            "{}.materials: only the first of {} is used, for the whole mesh",
            cloth.name,
            materials.len()
        ));
    }
    let fabric = material(first, left_out)?;
    if cloth.get("remeshing").is_some() {
        left_out.module("remeshing", "remeshing: left out, the mesh keeps its triangles");
    }
    if let Some(areas) = mesh.texture_areas(placement.scale) {
        warnings.push(format!(
            "{}: {areas}: the cloth will spring to that size, as in ARCSim; a scene in TOML may take its shape in space \
             (`material = \"shape\"`)",
            path.display()
        ));
    }
    mesh.repairs(&path).into_iter().for_each(|line| left_out.say(line));
    let line = mesh.left_out(&path);
    let source = ClothSource {
        name: cloth.name.clone(),
        velocity: StartVelocity::Same(crate::math::Vec3::ZERO),
        shape: Shape::Mesh(mesh),
        fabric,
        friction: None,
        pressure_pa: 0.0,
        wrap: None,
        maps: Vec::new(),
    };
    Ok((UnplacedCloth { source, placement, file: Some(path) }, line))
}

/// The velocity field v + w x (x - o) of a rigid motion: v, w and o, in world coordinates.
fn velocity_field(cloth: &Json) -> Result<[DVec3; 3], SceneError> {
    Ok(match cloth.get("velocity") {
        None => [DVec3::ZERO; 3],
        Some(velocity) if velocity.value.is_array() => [velocity.vector()?, DVec3::ZERO, DVec3::ZERO],
        Some(velocity) => {
            let part = |key| velocity.or(key, DVec3::ZERO, Json::vector);
            [part("linear")?, part("angular")?, part("origin")?]
        }
    })
}

fn material(json: &Json, left_out: &mut LeftOut) -> Result<Fabric, SceneError> {
    let fabric = load_fabric(&find(&json.required("data")?)?)?;
    let factor = |key| json.or(key, 1.0, Json::positive);
    let thicken = factor("thicken")?;
    let mut fabric = fabric.scaled(
        thicken * factor("density_mult")?,
        thicken * factor("stretching_mult")?,
        thicken * factor("bending_mult")?,
    );
    fabric.damping_s = json.or("damping", fabric.damping_s, Json::not_negative)?;
    if !left_out.disabled.contains(&"strainlimiting")
        && let Some(limits) = json.get("strain_limits")
    {
        fabric.strain_limit = Some(StrainLimit::Every(limits.pair()?));
    }
    if !left_out.disabled.contains(&"plasticity") {
        fabric.plasticity = plasticity(json)?;
        for key in ["plastic_flow", "plastic_limit"].into_iter().filter(|key| json.get(key).is_some()) {
            left_out
                .say(format!("{}.{key}: left out, a stretch yields at once and to three times its length", json.name));
        }
    }
    fabric.check().map_err(|what| json.error(what))?;
    Ok(fabric)
}

/// `yield_curv` (1/m), `yield_stretch` (1 + strain, as `strain_limits`) and `weakening`; none without the first two.
fn plasticity(json: &Json) -> Result<Option<Plasticity>, SceneError> {
    let (curvature, stretch) = (json.get("yield_curv"), json.get("yield_stretch"));
    if curvature.is_none() && stretch.is_none() {
        return Ok(None);
    }
    let mut found = Plasticity { weakening: json.or("weakening", 0.0, Json::not_negative)?, ..Plasticity::NONE };
    if let Some(curvature) = curvature {
        found.yield_curvature_1_m = curvature.positive()?;
    }
    if let Some(stretch) = stretch {
        found.yield_strain = stretch.positive()? - 1.0;
        if found.yield_strain <= 0.0 {
            return Err(stretch.error("must be a stretch (length / length at rest) above 1"));
        }
    }
    Ok(Some(found))
}

fn handle_pin(
    root: &Json,
    motion_file: &motions::MotionFile,
    handle: &Json,
    cloths: &[ClothSource],
    scene_motions: &mut Vec<Motion>,
    left_out: &mut LeftOut,
) -> Result<Option<PinSource>, SceneError> {
    let kind = handle.or("type", "node", |value| value.text())?;
    let Some(nodes) = handle.get("nodes").or_else(|| handle.get("vertices")).filter(|_| kind == "node") else {
        left_out.say(format!("{}: left out, only handles with a list of `nodes` are known here", handle.name));
        return Ok(None);
    };
    let cloth = handle.or("cloth", 0, |value| value.whole(0))? as usize;
    if cloth >= cloths.len() {
        let what = format!("there is no cloth {cloth}; the scene has {}", cloths.len());
        return Err(handle.get("cloth").unwrap_or_else(|| handle.clone()).error(what));
    }
    let start_s = handle.or("start_time", 0.0, Json::not_negative)?;
    let end_s = handle.or("end_time", f64::INFINITY, Json::not_negative)?;
    if end_s <= start_s {
        return Err(handle.error(format!("ends at {end_s} s, before it starts at {start_s} s")));
    }
    if handle.get("fade_time").is_some() {
        left_out.say(format!("{}.fade_time: left out, the handle lets go at once", handle.name));
    }
    let motion = match handle.get("motion") {
        None => None,
        Some(index) => {
            let motion = motions::handle_motion(root, motion_file, &index, start_s)?;
            if start_s > 0.0 {
                let name = &handle.name;
                left_out.say(format!(
                    "{name}: moves its nodes from their places at time 0, not from where they are at {start_s} s"
                ));
            }
            scene_motions.push(motion);
            Some(scene_motions.len() as u32 - 1)
        }
    };
    let numbers = nodes.array()?.iter().map(|node| node.whole(0)).collect::<Result<Vec<u32>, _>>()?;
    if numbers.is_empty() {
        left_out.say(format!("{}: left out, its list of nodes is empty", handle.name));
        return Ok(None);
    }
    let select = Selection::Vertices(numbers);
    Ok(Some(PinSource {
        name: None,
        cloth,
        select,
        motion,
        follow: None,
        start_s,
        end_s,
        stiffness_n_m: None,
        on_touch: false,
        at: nodes.place(),
    }))
}

fn settings(root: &Json, left_out: &mut LeftOut) -> Result<Settings, SceneError> {
    let frame_s = root.required("frame_time")?.positive()?;
    let steps_per_frame = root.or("frame_steps", 1, |value| value.whole(1))?;
    let mut frames = f64::INFINITY;
    for key in ["end_time", "duration"] {
        frames = frames.min(root.or(key, f64::INFINITY, Json::not_negative)? / frame_s);
    }
    frames = frames.min(root.or("end_frame", f64::INFINITY, |value| value.whole(0).map(f64::from))?);
    if frames.is_infinite() {
        frames = ENDLESS_S / frame_s;
        left_out.say(format!("the scene has no end; it runs for {ENDLESS_S} s here"));
    }
    // Rounded up, because ARCSim runs until the end time has been reached. The margin absorbs the rounding of quotients
    // such as 10 / 0.04.
    let frames = (frames - 1e-6).ceil().max(0.0);
    if frames > 1e7 {
        return Err(root
            .required("frame_time")?
            .error(format!("the scene would have {frames} frames; at most 10000000 are written")));
    }
    let vector = |json: &Json, key: &str| json.or(key, DVec3::ZERO, Json::vector).map(|v| v.as_vec3());
    // Absent tables read as empty ones.
    let empty = serde_json::Value::Null;
    let table = |key: &str| root.get(key).unwrap_or_else(|| Json { file: root.file, name: key.into(), value: &empty });
    let (wind, magic) = (table("wind"), table("magic"));
    let collisions = !left_out.disabled.contains(&"collision");
    if collisions && left_out.disabled.contains(&"proximity") {
        left_out
            .say("disable proximity: left out, contacts push within the thickness wherever they are detected at all");
    }
    Ok(Settings {
        step_s: frame_s / f64::from(steps_per_frame),
        substeps: Default::default(),
        steps_per_frame,
        frames: frames as u32,
        gravity_m_s2: vector(root, "gravity")?,
        wind_m_s: vector(&wind, "velocity")?,
        air_density_kg_m3: wind.or("density", 1.0, Json::not_negative)?,
        air_drag_kg_m2_s: wind.or("drag", 0.0, Json::not_negative)?,
        relative_tolerance: 0.01,
        max_iterations: 500,
        preconditioner: Default::default(),
        thickness_m: magic.or("repulsion_thickness", 1e-3, Json::positive)?,
        friction: root.or("friction", 0.6, Json::not_negative)?,
        collisions,
        contact_stiffness: CONTACT_STIFFNESS,
        over_time: SettingsOverTime::default(),
    })
}
