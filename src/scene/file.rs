//! The TOML scene format (`docs/scene.md`): text -> [`Scene`].

use std::path::{Path, PathBuf};

use toml::de::DeTable;

use crate::math::{DQuat, DVec2, DVec3, Vec3};
use crate::mesh::{FileMesh, MaterialSource, TriangleMesh};

use super::fields::{Fields, Source, Value};
use super::keyframes::motion;
use super::obstacle_file::{OBSTACLE_FIELDS, obstacle};
use super::pieces::{Piece, Placement, merge, placed_mesh};
use super::start::{Start, StartState};
use super::{
    CONTACT_STIFFNESS, Fabric, Motion, Overrides, Pin, PreconditionerKind, RESOLUTIONS, Scene, SceneError, Settings,
    pins, sheet_cells,
};

/// Triangles of all sheets together where neither the scene nor the command line says.
const DEFAULT_RESOLUTION: u64 = 10_000;

/// Reads a TOML scene; `path` is where relative file names start and what messages name.
pub(super) fn parse(
    text: &str,
    path: &Path,
    overrides: &Overrides,
    start: &mut StartState,
) -> Result<Scene, SceneError> {
    let source = Source { path, text };
    let document = DeTable::parse(text).map_err(|error| {
        let line =
            error.span().map(|span| 1 + text.as_bytes().iter().take(span.start).filter(|&&c| c == b'\n').count());
        SceneError::Syntax { path: path.into(), line, what: error.message().replace('\n', ", ") }
    })?;
    let known = ["name", "resolution", "simulation", "air", "fabric", "cloth", "pin", "obstacle"];
    let root = Fields::root(&source, document.get_ref(), &known)?;
    let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let name = root.or("name", stem, |value| value.text().map(str::to_owned))?;

    let fabrics = root.tables("fabric", &FABRIC_FIELDS)?.iter().map(fabric).collect::<Result<Vec<Fabric>, _>>()?;
    let cloths = root.tables("cloth", &CLOTH_FIELDS)?;
    if cloths.is_empty() {
        return Err(root.error_at("cloth", "a scene needs at least one `[[cloth]]`"));
    }
    let triangles = sheet_triangles(&root, &cloths, overrides, path)?;
    let mut pieces = Vec::with_capacity(cloths.len());
    for (i, cloth) in cloths.iter().enumerate() {
        pieces.push(piece(cloth, i, triangles[i], &fabrics, path)?);
    }
    let mut settings = settings(&root)?;
    settings.frames = overrides.frames.unwrap_or(settings.frames);
    let mut merged = merge(&mut pieces, settings.friction).map_err(|what| root.error_at("cloth", what))?;
    let mut obstacles = Vec::new();
    for (i, fields) in root.tables("obstacle", &OBSTACLE_FIELDS)?.iter().enumerate() {
        obstacles.push(obstacle(fields, i, settings.friction, path)?);
    }

    let mut motions = Vec::new();
    let mut held = Vec::new();
    for pin in root.tables("pin", &PIN_FIELDS)? {
        held.extend(pins_of(&pin, &pieces, &mut motions)?);
    }
    let pins = pins::without_conflicts(held).map_err(|vertex| {
        root.error_at("pin", format!("vertex {vertex} is held by two pins at the same time that move it differently"))
    })?;

    let flat: Vec<bool> = pieces.iter().map(|piece| piece.sheet.is_some()).collect();
    Start {
        path,
        resolution: overrides.resolution,
        flat: &flat,
        obstacles: &obstacles,
        pins: &pins,
        settings: &settings,
    }
    .settle(&mut merged, start)
    .map_err(|crossings| root.crossing_at("cloth", crossings))?;
    Ok(Scene {
        name,
        mesh: merged.mesh,
        velocities: merged.velocities,
        fabrics: merged.fabrics,
        fabric_of_triangle: merged.fabric_of_triangle,
        pins,
        motions,
        cloths: merged.cloths,
        obstacles,
        settings,
        left_out: pieces.into_iter().filter_map(|piece| piece.left_out).collect(),
    })
}

fn settings(root: &Fields) -> Result<Settings, SceneError> {
    let known = [
        "step_s",
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
    ];
    let simulation = root.table("simulation", &known)?;
    let step_s = simulation.or("step_s", 1.0 / 250.0, Value::positive)?;
    let steps_per_frame = simulation.optional("steps_per_frame", |value| value.whole(1..=1_000_000))?;
    let frame_s = simulation.optional("frame_s", Value::positive)?;
    let steps_per_frame = match (steps_per_frame, frame_s) {
        (Some(_), Some(_)) => return Err(simulation.error_at("frame_s", "give either `frame_s` or `steps_per_frame`")),
        (Some(steps), None) => steps as u32,
        (None, None) => 10,
        (None, Some(frame_s)) => {
            let steps = (frame_s / step_s).round();
            // A thousandth of a step: what rounding 1/24 s to four digits needs.
            if !(1.0..=1e6).contains(&steps) || (frame_s / step_s - steps).abs() > 1e-3 * steps {
                return Err(simulation.error_at("frame_s", format!("must be a whole number of steps of {step_s} s")));
            }
            steps as u32
        }
    };
    let vector = |value: &Value| Ok(value.vector()?.as_vec3());
    let relative_tolerance = simulation.or("relative_tolerance", 0.01, Value::positive)?;
    if relative_tolerance >= 1.0 {
        return Err(simulation.error_at("relative_tolerance", format!("must be below 1, not {relative_tolerance}")));
    }
    // Without `[air]` there is none, so that free fall is free.
    let air = root.table("air", &["wind_m_s", "density_kg_m3", "drag_kg_m2_s"])?;
    let density = if root.get("air").is_some() { 1.2 } else { 0.0 };
    Ok(Settings {
        step_s,
        steps_per_frame,
        frames: simulation.or("frames", 100, |value| value.whole(0..=10_000_000))? as u32,
        gravity_m_s2: simulation.or("gravity_m_s2", Vec3::new(0.0, -9.81, 0.0), vector)?,
        wind_m_s: air.or("wind_m_s", Vec3::ZERO, vector)?,
        air_density_kg_m3: air.or("density_kg_m3", density, Value::not_negative)?,
        air_drag_kg_m2_s: air.or("drag_kg_m2_s", 0.0, Value::not_negative)?,
        relative_tolerance,
        max_iterations: simulation.or("max_iterations", 500, |value| value.whole(1..=1_000_000))? as u32,
        preconditioner: simulation
            .or("preconditioner", PreconditionerKind::Auto, |value| value.choice(&PreconditionerKind::CHOICES))?,
        thickness_m: simulation.or("thickness_m", 0.002, Value::positive)?,
        friction: simulation.or("friction", 0.3, Value::not_negative)?,
        collisions: simulation.or("collisions", true, Value::boolean)?,
        contact_stiffness: simulation.or("contact_stiffness", CONTACT_STIFFNESS, Value::positive)?,
    })
}

const FABRIC_FIELDS: [&str; 5] = ["name", "density_kg_m2", "stretching_n_m", "bending_n_m", "damping_s"];

fn fabric(fields: &Fields) -> Result<Fabric, SceneError> {
    let stretching = |value: &Value| -> Result<[[f64; 4]; 6], SceneError> {
        if value.array()?.first().is_some_and(Value::is_array) { rows(value) } else { Ok([value.numbers()?; 6]) }
    };
    let bending = |value: &Value| -> Result<[[f64; 5]; 3], SceneError> {
        if value.is_array() { rows(value) } else { Ok([[value.not_negative()?; 5]; 3]) }
    };
    let fabric = Fabric {
        name: fields.required("name")?.text()?.to_owned(),
        density_kg_m2: fields.required("density_kg_m2")?.positive()?,
        stretching_n_m: stretching(&fields.required("stretching_n_m")?)?,
        bending_n_m: bending(&fields.required("bending_n_m")?)?,
        damping_s: fields.or("damping_s", 0.0, Value::not_negative)?,
    };
    fabric.check().map_err(|what| fields.error(what))?;
    Ok(fabric)
}

fn rows<const R: usize, const C: usize>(value: &Value) -> Result<[[f64; C]; R], SceneError> {
    let rows = value.array()?.iter().map(Value::numbers::<C>).collect::<Result<Vec<_>, _>>()?;
    rows.try_into()
        .map_err(|rows: Vec<_>| value.error(format!("must have {R} rows of {C} numbers, not {} rows", rows.len())))
}

const CLOTH_FIELDS: [&str; 13] = [
    "name",
    "sheet",
    "mesh",
    "material",
    "plane",
    "origin_m",
    "rotate_deg",
    "scale",
    "fabric",
    "thicken",
    "damping_s",
    "velocity_m_s",
    "friction",
];

/// Triangles of every cloth's sheet (0 where it is a mesh): shares of the resolution, by area unless given.
fn sheet_triangles(
    root: &Fields,
    cloths: &[Fields],
    overrides: &Overrides,
    path: &Path,
) -> Result<Vec<u64>, SceneError> {
    let resolution = root.or("resolution", DEFAULT_RESOLUTION, |value| value.whole(RESOLUTIONS))?;
    let mut areas = Vec::new();
    let mut given = Vec::new();
    for cloth in cloths {
        let sheet = cloth.table("sheet", &["size_m", "triangles"])?;
        let area = sheet.optional("size_m", |value| Ok(value.numbers::<2>()?.iter().product::<f64>().abs()))?;
        areas.push(area.unwrap_or(0.0));
        given.push(sheet.optional("triangles", |value| value.whole(RESOLUTIONS))?);
    }
    let area: f64 = areas.iter().sum();
    let share = |i: usize| {
        given[i].map_or_else(|| resolution as f64 * areas[i] / area.max(f64::MIN_POSITIVE), |given| given as f64)
    };
    let shares: Vec<f64> = (0..cloths.len()).map(share).collect();
    let factor = match overrides.resolution {
        None => 1.0,
        Some(wanted) => {
            let fault = |what: &str| SceneError::File { path: path.into(), what: what.into() };
            if !RESOLUTIONS.contains(&wanted) {
                let (least, most) = (RESOLUTIONS.start(), RESOLUTIONS.end());
                return Err(fault(&format!("the resolution must be from {least} to {most} triangles, not {wanted}")));
            }
            if area == 0.0 {
                return Err(fault("the resolution of a scene can be chosen for sheets only, and this scene has none"));
            }
            wanted as f64 / shares.iter().sum::<f64>()
        }
    };
    Ok(shares.iter().map(|share| (share * factor).round().max(2.0) as u64).collect())
}

fn piece(cloth: &Fields, index: usize, triangles: u64, fabrics: &[Fabric], path: &Path) -> Result<Piece, SceneError> {
    let placement = Placement {
        translation_m: cloth.or("origin_m", DVec3::ZERO, Value::vector)?,
        rotation: cloth.or("rotate_deg", DQuat::IDENTITY, Value::rotation)?,
        scale: cloth.or("scale", 1.0, Value::positive)?,
    };
    let (placed, sheet, left_out) = match (cloth.get("sheet"), cloth.get("mesh")) {
        (Some(_), None) => {
            if let Some(key) = ["material", "scale"].into_iter().find(|key| cloth.get(key).is_some()) {
                return Err(cloth.error_at(key, "belongs to a cloth with a `mesh`; this one has a `sheet`"));
            }
            let size = cloth.table("sheet", &["size_m", "triangles"])?.required("size_m")?;
            let size_m = size.numbers::<2>()?;
            if size_m.iter().any(|&side| side <= 0.0) {
                return Err(size.error("both sides must be above 0"));
            }
            let planes = [("xy", [DVec3::X, DVec3::Y]), ("xz", [DVec3::X, DVec3::NEG_Z]), ("yz", [DVec3::Y, DVec3::Z])];
            let axes = cloth.or("plane", planes[0].1, |value| value.choice(&planes))?;
            let cells = sheet_cells(size_m, triangles);
            let uv = cells.coordinates(size_m);
            let in_space = |uv: DVec2| axes[0] * uv.x + axes[1] * uv.y;
            let corners = cells.triangle_corners();
            let mut mesh = TriangleMesh {
                positions: uv.iter().map(|uv| in_space(uv.as_dvec2()).as_vec3()).collect(),
                material_uv: corners.iter().map(|t| t.map(|v| uv[v as usize])).collect(),
                triangles: corners,
            };
            placement.place(&mut mesh);
            crate::mesh::validate(&mesh).map_err(|fault| cloth.error_at("sheet", fault.to_string()))?;
            (FileMesh::from(mesh), Some(cells), None)
        }
        (None, Some(file)) => {
            if cloth.get("plane").is_some() {
                return Err(cloth.error_at("plane", "belongs to a cloth with a `sheet`; this one has a `mesh`"));
            }
            let sources = [("uv", MaterialSource::TextureOrShape), ("shape", MaterialSource::Shape)];
            let source = cloth.or("material", MaterialSource::TextureOrShape, |value| value.choice(&sources))?;
            let found = find(path, file.text()?).map_err(|what| file.error(what))?;
            let mesh = placed_mesh(&found, source, &placement)?;
            let left_out = mesh.left_out(&found);
            (mesh, None, left_out)
        }
        _ => return Err(cloth.error("a cloth needs either `sheet = { size_m = [w, h] }` or `mesh = \"file.obj\"`")),
    };
    let velocity = cloth.or("velocity_m_s", DVec3::ZERO, Value::vector)?.as_vec3();
    let mut fabric = match cloth.get("fabric") {
        None => Fabric::preset("cotton").unwrap_or_else(|| Fabric::uniform("cotton", 0.15, [400.0; 4], 1e-5)),
        Some(value) => named_fabric(&value, fabrics, path)?,
    };
    if let Some(factor) = cloth.optional("thicken", Value::positive)? {
        fabric = fabric.thickened(factor);
    }
    fabric.damping_s = cloth.or("damping_s", fabric.damping_s, Value::not_negative)?;
    fabric.check().map_err(|what| cloth.error_at("fabric", what))?;
    Ok(Piece {
        name: cloth.or("name", format!("cloth {index}"), |value| value.text().map(str::to_owned))?,
        velocities: vec![velocity; placed.mesh.positions.len()],
        cloth: placed,
        left_out,
        fabric,
        friction: cloth.optional("friction", Value::not_negative)?,
        sheet,
        first_vertex: 0,
    })
}

fn named_fabric(value: &Value, fabrics: &[Fabric], path: &Path) -> Result<Fabric, SceneError> {
    let name = value.text()?;
    if let Some(fabric) = fabrics.iter().find(|fabric| fabric.name == name) {
        return Ok(fabric.clone());
    }
    if let Some(fabric) = Fabric::preset(name) {
        return Ok(fabric);
    }
    if name.ends_with(".json") {
        return super::load_fabric(&find(path, name).map_err(|what| value.error(what))?);
    }
    let known: Vec<String> =
        fabrics.iter().map(|fabric| fabric.name.clone()).chain(Fabric::preset_names().map(String::from)).collect();
    Err(value.error(format!("`{name}` is no known fabric; known: {}, or a .json file", known.join(", "))))
}

/// The file a scene names: beside the scene, or in the working directory.
pub(super) fn find(scene: &Path, name: &str) -> Result<PathBuf, String> {
    let beside = scene.parent().unwrap_or(Path::new("")).join(name);
    let found = [beside, PathBuf::from(name)].into_iter().find(|path| path.is_file());
    found.ok_or_else(|| format!("no file `{name}` beside the scene or in the working directory"))
}

const PIN_FIELDS: [&str; 11] =
    ["cloth", "corners", "edge", "every", "count", "vertices", "box_m", "sphere", "start_s", "end_s", "motion"];

fn pins_of(pin: &Fields, pieces: &[Piece], motions: &mut Vec<Motion>) -> Result<Vec<Pin>, SceneError> {
    let piece = match pin.get("cloth") {
        None if pieces.len() == 1 => &pieces[0],
        None => return Err(pin.error_at("cloth", "is missing; the scene has several cloths, so a pin must name one")),
        Some(value) if value.is_text() => {
            let name = value.text()?;
            pieces
                .iter()
                .find(|piece| piece.name == name)
                .ok_or_else(|| value.error(format!("no cloth is named `{name}`")))?
        }
        Some(value) => &pieces[value.whole(0..=pieces.len() as u64 - 1)? as usize],
    };
    let vertices = selected(pin, piece)?;
    let start_s = pin.or("start_s", 0.0, Value::not_negative)?;
    let end_s = pin.or("end_s", f64::INFINITY, Value::positive)?;
    if end_s <= start_s {
        return Err(pin.error_at("end_s", format!("must be after start_s = {start_s}")));
    }
    let motion = motion(pin)?.map(|motion| {
        motions.push(motion);
        motions.len() as u32 - 1
    });
    Ok(vertices.into_iter().map(|v| Pin { vertex: piece.first_vertex + v, motion, start_s, end_s }).collect())
}

/// The vertices of the piece that a pin holds.
fn selected(pin: &Fields, piece: &Piece) -> Result<Vec<u32>, SceneError> {
    let ways = ["corners", "edge", "vertices", "box_m", "sphere"];
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
    let sheet = || {
        let what = format!("`{}` is a mesh; only a sheet has corners and edges", piece.name);
        piece.sheet.as_ref().ok_or_else(|| value.error(what))
    };
    let vertices = match way {
        "corners" => {
            let sheet = sheet()?;
            let names = if value.is_text() {
                vec![value.choice(&pins::CORNERS)]
            } else {
                value.array()?.iter().map(|v| v.choice(&pins::CORNERS)).collect()
            };
            names.into_iter().map(|which| Ok(pins::corner(sheet, which?))).collect::<Result<Vec<u32>, SceneError>>()?
        }
        "edge" => {
            let vertices = pins::edge(sheet()?, value.choice(&pins::EDGES)?);
            let every = pin.optional("every", |value| value.whole(1..=1_000_000_000))?;
            let count = pin.optional("count", |value| value.whole(1..=1_000_000_000))?;
            match (every, count) {
                (Some(_), Some(_)) => return Err(pin.error_at("every", "give either `every` or `count`")),
                (Some(every), None) => vertices.into_iter().step_by(every as usize).collect(),
                (None, Some(count)) => pins::evenly(&vertices, count as usize),
                (None, None) => vertices,
            }
        }
        "vertices" => {
            let index = |value: &Value| {
                let number = value.whole(0..=u64::from(u32::MAX))?;
                let missing = || value.error(format!("`{}` has no vertex {number} (they count from 0)", piece.name));
                piece.cloth.vertex(number as u32).ok_or_else(missing)
            };
            value.array()?.iter().map(index).collect::<Result<_, _>>()?
        }
        "box_m" => {
            let corners = value.array()?.iter().map(Value::vector).collect::<Result<Vec<DVec3>, _>>()?;
            let [low, high] = corners[..] else {
                return Err(value.error("must be two corners, `[[x, y, z], [x, y, z]]`"));
            };
            if low.cmpgt(high).any() {
                return Err(value.error("the first corner must be the lower one in x, y and z"));
            }
            pins::region(&piece.cloth.mesh, |p| p.cmpge(low).all() && p.cmple(high).all())
        }
        _ => {
            let sphere = value.table(&["center_m", "radius_m"])?;
            let (center, radius) = (sphere.required("center_m")?.vector()?, sphere.required("radius_m")?.positive()?);
            pins::region(&piece.cloth.mesh, |p| p.distance(center) <= radius)
        }
    };
    if vertices.is_empty() {
        return Err(value.error(format!("selects no vertex of `{}`", piece.name)));
    }
    Ok(vertices)
}
