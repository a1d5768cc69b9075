//! `loomtree check FILE`: checks a scene or mesh. It reads everything that a run reads before its first step.

use std::io::Write;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use crate::math::{DVec3, Vec3};
use crate::mesh::{
    FileMesh, Group, GroupKind, MaterialSource, MeshReadError, Part, TriangleMesh, crossings, first_at_place, hinges,
    read_mesh, read_obstacle,
};
use crate::model::Sewn;
use crate::os::console::is_json;
use crate::scene::{
    DEFAULT_THICKNESS_M, Movement, MovingMeshes, Overrides, Scene, load, load_fabric, load_untangled, read_body,
    read_moving_meshes, size_warning,
};

use super::far::far_line;
use super::start_state::{Places, untangled_line, write_mesh};
use super::{CliError, answer_to, print_to};

/// Arguments of `loomtree check`.
#[derive(Debug, clap::Args)]
pub struct CheckArgs {
    /// A scene (.toml, ARCSim's .json), a fabric (.json), a mesh (.obj, .ply) or a body (.glb, .gltf, .usda, .usdc,
    /// .abc).
    pub file: PathBuf,
    /// Triangles of all sheets together (for example 30000, 500K or 1.2M)
    #[arg(long, value_name = "TRIANGLES", value_parser = super::count)]
    pub resolution: Option<u64>,
    /// Where to write the triangles that cross or touch at the start, if there are any (.obj)
    #[arg(long, value_name = "FILE")]
    pub write_crossings: Option<PathBuf>,
    /// Untangle a start state that crosses, and write where the cloth then is, or how far it went (.obj)
    #[arg(long, value_name = "FILE")]
    pub untangle: Option<PathBuf>,
    /// Judge a mesh as what cloth meets, not as cloth: edges may have any number of triangles, and it may cross itself
    #[arg(long)]
    pub obstacle: bool,
}

/// Prints a summary of the file to `out`.
///
/// # Errors
/// Exit code 2 and one sentence if the file is invalid.
pub fn check(args: &CheckArgs, out: &mut dyn Write) -> Result<(), CliError> {
    let found = summary(args);
    if is_json()
        && let Err(error) = &found
    {
        let verdict = json!({ "file": args.file, "valid": false, "error": error.message });
        print_to(out, &format!("{verdict}\n"))?;
    }
    let text = found?;
    answer_to(out, &text, || verdict(args, &text))
}

/// The lines of a summary, `label   value`, as fields; a label that comes again makes a list.
fn verdict(args: &CheckArgs, summary: &str) -> Value {
    let mut lines = summary.lines();
    let kind = lines.next().and_then(|line| line.split(' ').next()).unwrap_or_default();
    let mut fields = serde_json::Map::new();
    for line in lines {
        let Some((label, value)) = line.trim_start().split_once("  ") else { continue };
        match fields.get_mut(label) {
            None => {
                fields.insert(label.to_string(), json!(value.trim()));
            }
            Some(Value::Array(values)) => values.push(json!(value.trim())),
            Some(other) => *other = json!([other.clone(), value.trim()]),
        }
    }
    json!({ "file": args.file, "valid": true, "kind": kind, "found": fields })
}
/// What is said of the file.
fn summary(args: &CheckArgs) -> Result<String, CliError> {
    let extension = args.file.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    let is_scene = match extension.as_str() {
        "obj" | "ply" | "gz" | "glb" | "gltf" | "usd" | "usda" | "usdc" | "usdz" | "abc" => false,
        "json" => !is_fabric(&args.file),
        _ => true,
    };
    if let (false, Some(_)) = (is_scene, &args.untangle) {
        return Err(CliError::bad_input("--untangle needs a scene: name the mesh in one (docs/scene.md)"));
    }
    let is_mesh = matches!(extension.as_str(), "obj" | "ply" | "gz");
    if !is_scene && args.resolution.is_some() {
        return Err(CliError::bad_input("--resolution is for the sheets of a scene"));
    }
    let is_moving = matches!(extension.as_str(), "usd" | "usda" | "usdc" | "usdz" | "abc");
    let is_body = is_moving || matches!(extension.as_str(), "glb" | "gltf");
    if args.obstacle && (!(is_mesh || is_body) || args.write_crossings.is_some()) {
        return Err(CliError::bad_input("--obstacle is for a mesh (.obj, .ply) or a body, which may cross itself"));
    }
    let summary = match extension.as_str() {
        _ if is_mesh && args.obstacle => obstacle_summary(&args.file)?,
        "glb" | "gltf" => body_summary(&args.file)?,
        _ if is_moving => moving_summary(&args.file)?,
        _ if is_mesh => mesh_summary(&args.file, args.write_crossings.as_deref())?,
        "json" if !is_scene => {
            let fabric = load_fabric(&args.file).map_err(CliError::bad_input)?;
            format!("fabric {}: valid\n  density     {} kg/m^2\n", fabric.name, fabric.density_kg_m2)
        }
        _ => {
            let overrides = Overrides { resolution: args.resolution, frames: None };
            let places = Places { crossings: args.write_crossings.clone(), best: args.untangle.clone() };
            let refuse = |mut error| CliError::bad_input(places.refuse(&mut error));
            match &args.untangle {
                None => scene_summary(&load(&args.file, &overrides).map_err(refuse)?),
                Some(file) => {
                    let (scene, done) = load_untangled(&args.file, &overrides).map_err(refuse)?;
                    let did = match &done {
                        Some(done) => {
                            let TriangleMesh { positions, triangles, .. } = &scene.mesh;
                            write_mesh(file, scene.origin_m, positions, triangles).map_err(CliError::failed)?;
                            format!("{}; written to {}", untangled_line(done), file.display())
                        }
                        None => "nothing to untangle".to_owned(),
                    };
                    format!("{}  start       {did}\n", scene_summary(&scene))
                }
            }
        }
    };
    Ok(summary)
}

/// True for a file with a density and no cloths. A file that cannot be parsed counts as a scene, whose reader then
/// reports the error.
fn is_fabric(path: &Path) -> bool {
    let small = std::fs::metadata(path).is_ok_and(|metadata| metadata.is_file() && metadata.len() < 1 << 16);
    let text = if small { std::fs::read_to_string(path).unwrap_or_default() } else { String::new() };
    text.contains("stretching") && !text.contains("cloths")
}

fn mesh_summary(path: &Path, write_crossings: Option<&Path>) -> Result<String, CliError> {
    let file = read_mesh(path, MaterialSource::Auto).map_err(|error| {
        let mut sentence = error.to_string();
        if matches!(error, MeshReadError::Mesh { .. }) && read_obstacle(path, 1.0).is_ok() {
            sentence += "; as an obstacle it can be used (`check --obstacle`)";
        }
        CliError::bad_input(sentence)
    })?;
    let TriangleMesh { positions, triangles, .. } = &file.mesh;
    let whole = Group { triangles: 0..triangles.len(), kind: GroupKind::Cloth };
    let pairs = crossings(positions, triangles, &[whole]);
    if let Some([a, b]) = pairs.first() {
        return Err(CliError::bad_input(crossing_sentence(path, &file, [*a, *b], &pairs, write_crossings)));
    }
    let mut text = format!("mesh {}: valid\n{}", path.display(), mesh_lines(&file.mesh));
    text += &parts_line(&file.parts);
    file.left_out(path).into_iter().for_each(|line| text += &format!("  left out    {line}\n"));
    let mut warnings = file.warnings(path, 1.0);
    warnings.extend(size_warning(&path.display().to_string(), file.extent(), DEFAULT_THICKNESS_M));
    warnings.iter().for_each(|line| text += &format!("  warning     {line}\n"));
    Ok(text)
}

/// Error message about a mesh that crosses itself. Writes the crossing triangles if a file is given.
fn crossing_sentence(
    path: &Path,
    file_mesh: &FileMesh,
    first: [u32; 2],
    pairs: &[[u32; 2]],
    write_crossings: Option<&Path>,
) -> String {
    let mesh = &file_mesh.mesh;
    let [a, b] = first.map(|t| t + 1);
    let mut sentence =
        format!("{}: triangles {a} and {b} cross or touch, so no simulation can start here", path.display());
    let place = first_at_place(&mesh.positions);
    let doubled = (0..).zip(&place).filter(|&(vertex, &first)| first != vertex).count();
    if doubled > 0 {
        sentence += &format!(
            " ({doubled} vertices lie at the place of others, as an exporter splits a seam: `weld_m` of a [[cloth]] joins them)"
        );
    }
    let Some(file) = write_crossings else { return sentence };
    let mut meeting: Vec<u32> = pairs.as_flattened().to_vec();
    meeting.sort_unstable();
    meeting.dedup();
    let corners: Vec<Vec3> =
        meeting.iter().flat_map(|&t| mesh.triangles[t as usize].map(|v| mesh.positions[v as usize])).collect();
    let triangles: Vec<[u32; 3]> = (0..meeting.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
    match write_mesh(file, file_mesh.base, &corners, &triangles) {
        Ok(()) => sentence + &format!("; {} holds a mesh of all that do", file.display()),
        Err(fault) => format!("{sentence}; {fault}"),
    }
}

fn obstacle_summary(path: &Path) -> Result<String, CliError> {
    let (surface, left_out) = read_obstacle(path, 1.0).map_err(CliError::bad_input)?;
    let mut text =
        format!("obstacle {}: valid\n{}", path.display(), size_lines(&surface.positions, surface.triangles.len()));
    text += &parts_line(&surface.parts);
    left_out.into_iter().for_each(|line| text += &format!("  left out    {line}\n"));
    Ok(text)
}

fn body_summary(path: &Path) -> Result<String, CliError> {
    let body = read_body(path).map_err(CliError::bad_input)?;
    let [vertices, triangles] = body.counts();
    let mut text = format!("body {}: valid\n  vertices    {vertices}\n  triangles   {triangles}\n", path.display());
    let clips: Vec<String> =
        body.clips.iter().map(|clip| format!("{} ({} s)", clip.name, clip.length_s as f32)).collect();
    let names = body.mesh_nodes().into_iter().filter(|name| !name.is_empty()).collect::<Vec<&str>>();
    for (title, list) in [("clips", clips.join(", ")), ("nodes", names.join(", "))] {
        if !list.is_empty() {
            text += &format!("  {title:<10}  {list}\n");
        }
    }
    Ok(text)
}

fn moving_summary(path: &Path) -> Result<String, CliError> {
    let MovingMeshes { vertices, triangles, meshes, joints, samples, times_s, units } =
        read_moving_meshes(path).map_err(CliError::bad_input)?;
    let mut text = format!("body {}: valid\n  vertices    {vertices}\n  triangles   {triangles}\n", path.display());
    text += &format!("  nodes       {}\n", meshes.join(", "));
    if joints > 0 {
        text += &format!("  joints      {joints}\n");
    }
    text += &match samples {
        0 | 1 => "  samples     none: it stands still\n".to_owned(),
        _ => format!("  samples     {samples}, from {} to {} s\n", times_s[0] as f32, times_s[1] as f32),
    };
    if let Some((unit_m, z_up)) = units {
        text += &format!("  unit        {unit_m} m, {} up\n", if z_up { "z" } else { "y" });
    }
    Ok(text)
}

/// A line with the names of the objects and groups that pins can select.
fn parts_line(parts: &[Part]) -> String {
    /// Limit of names in the line.
    const SHOWN: usize = 8;
    let mut names: Vec<&str> = parts.iter().flat_map(|part| [part.object.as_str(), part.group.as_str()]).collect();
    names.retain(|name| !name.is_empty());
    names.sort_unstable();
    names.dedup();
    match names.len() {
        0 => String::new(),
        count if count <= SHOWN => format!("  parts       {}\n", names.join(", ")),
        count => format!("  parts       {}, .. ({count} names)\n", names[..SHOWN].join(", ")),
    }
}

fn size_lines(positions: &[Vec3], triangles: usize) -> String {
    let (low, high) = positions.iter().fold((positions[0], positions[0]), |(low, high), &p| (low.min(p), high.max(p)));
    let size = high - low;
    format!(
        "  vertices    {}\n  triangles   {triangles}\n  extent      {:.4} x {:.4} x {:.4} m\n",
        positions.len(),
        size.x,
        size.y,
        size.z
    )
}

fn mesh_lines(mesh: &TriangleMesh) -> String {
    let rest: f64 = mesh.material_uv.iter().map(|uv| f64::from((uv[1] - uv[0]).perp_dot(uv[2] - uv[0])) / 2.0).sum();
    let corners = |t: &[u32; 3]| t.map(|v| mesh.positions[v as usize].as_dvec3());
    let doubled = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a).length();
    let space: f64 = mesh.triangles.iter().map(|t| doubled(corners(t)) / 2.0).sum();
    format!(
        "{}  hinges      {}\n  rest area   {rest:.4} m^2 ({space:.4} m^2 in space)\n",
        size_lines(&mesh.positions, mesh.triangles.len()),
        hinges(mesh).len()
    )
}

fn scene_summary(scene: &Scene) -> String {
    let settings = &scene.settings;
    let fabrics: Vec<&str> = scene.fabrics.iter().map(|fabric| fabric.name.as_str()).collect();
    let mut text = format!("scene {}: valid\n{}", scene.name, mesh_lines(&scene.mesh));
    text += &format!("  fabrics     {}\n", fabrics.join(", "));
    let moving = scene.pins.iter().filter(|pin| pin.motion.is_some()).count();
    text += &format!("  pins        {} ({moving} moving)\n", scene.pins.len());
    if !scene.obstacles.is_empty() {
        let triangles: usize = scene.obstacles.iter().map(|obstacle| obstacle.triangles.len()).sum();
        let names: Vec<String> = scene
            .obstacles
            .iter()
            .map(|obstacle| match &obstacle.movement {
                Movement::Sequence { later, .. } => format!("{} ({} frames)", obstacle.name, later.len() + 1),
                Movement::Cached(cache) => format!("{} ({} samples)", obstacle.name, cache.times_s.len()),
                _ if obstacle.moving() => format!("{} (moving)", obstacle.name),
                _ => obstacle.name.clone(),
            })
            .collect();
        text += &format!("  obstacles   {}; {triangles} triangles\n", names.join(", "));
    }
    let contacts = match settings.collisions {
        true => format!("within {} m, friction {}", settings.thickness_m, settings.friction),
        false => "none (collisions = false)".into(),
    };
    text += &format!("  contacts    {contacts}\n");
    if let (Some(sewing), Some((sewn, _))) = (&scene.sewing, Sewn::of(scene)) {
        let at = |v: u32| scene.mesh.positions[v as usize];
        let widest_m = sewing.pairs.iter().map(|&[a, b]| at(a).distance(at(b))).fold(0.0, f32::max);
        text += &format!(
            "  seams       {}; {} pairs up to {widest_m:.3} m apart; sewn: {} vertices, {} triangles\n",
            sewing.names.len(),
            sewing.pairs.len(),
            sewn.mesh.positions.len(),
            sewn.mesh.triangles.len()
        );
    }
    let seconds = settings.step_s * f64::from(settings.steps_per_frame) * f64::from(settings.frames);
    text += &format!(
        "  frames      {} of {} steps of {} s ({seconds:.3} s)\n",
        settings.frames, settings.steps_per_frame, settings.step_s
    );
    if let Some(line) = far_line(scene) {
        text += &format!("  far         {line}\n");
    }
    text += &parts_line(&scene.parts);
    for line in &scene.warnings {
        text += &format!("  warning     {line}\n");
    }
    for line in &scene.left_out {
        text += &format!("  left out    {line}\n");
    }
    text
}
