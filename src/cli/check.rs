//! `loomtree check FILE`: is this scene or mesh valid? Reads everything that a run would read before its first step.

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::mesh::{MaterialSource, TriangleMesh, first_intersection, hinges, read_mesh};
use crate::scene::{Movement, Overrides, Scene, load, load_fabric, load_untangled};

use super::start_state::{Places, untangled_line, write_mesh};
use super::{CliError, print_to};

/// Arguments of `loomtree check`.
#[derive(Debug, clap::Args)]
pub struct CheckArgs {
    /// A scene (.toml, ARCSim's .json), a fabric (.json) or a mesh (.obj, .ply).
    pub file: PathBuf,
    /// Triangles of all sheets together.
    #[arg(long, value_name = "TRIANGLES")]
    pub resolution: Option<u64>,
    /// Where to write the triangles that cross or touch at the start, if there are any (.obj)
    #[arg(long, value_name = "FILE")]
    pub write_crossings: Option<PathBuf>,
    /// Untangle a start state that crosses, and write where the cloth then is, or how far it went (.obj)
    #[arg(long, value_name = "FILE")]
    pub untangle: Option<PathBuf>,
}

/// Prints a summary of the file to `out`.
///
/// # Errors
/// Exit code 2 and one sentence if the file cannot be used.
pub fn check(args: &CheckArgs, out: &mut dyn Write) -> Result<(), CliError> {
    let extension = args.file.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    let is_scene = match extension.as_str() {
        "obj" | "ply" => false,
        "json" => !is_fabric(&args.file),
        _ => true,
    };
    if let (false, Some(_)) = (is_scene, &args.untangle) {
        return Err(CliError::bad_input("--untangle needs a scene: name the mesh in one (docs/scene.md)"));
    }
    let summary = match extension.as_str() {
        "obj" | "ply" => mesh_summary(&args.file)?,
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
                            write_mesh(file, positions, triangles).map_err(CliError::failed)?;
                            format!("{}; written to {}", untangled_line(done), file.display())
                        }
                        None => "nothing to untangle".to_owned(),
                    };
                    format!("{}  start       {did}\n", scene_summary(&scene))
                }
            }
        }
    };
    print_to(out, &summary)
}

/// A fabric file has a density and no cloths; anything that does not parse is taken for a scene, which then says why not.
fn is_fabric(path: &Path) -> bool {
    let small = std::fs::metadata(path).is_ok_and(|metadata| metadata.is_file() && metadata.len() < 1 << 16);
    let text = if small { std::fs::read_to_string(path).unwrap_or_default() } else { String::new() };
    text.contains("stretching") && !text.contains("cloths")
}

fn mesh_summary(path: &Path) -> Result<String, CliError> {
    let file = read_mesh(path, MaterialSource::TextureOrShape).map_err(CliError::bad_input)?;
    if let Some([a, b]) = first_intersection(&file.mesh) {
        let sentence = format!(
            "{}: triangles {} and {} cross or touch, so no simulation can start here",
            path.display(),
            a + 1,
            b + 1
        );
        return Err(CliError::bad_input(sentence));
    }
    let left_out = file.left_out(path).map(|line| format!("  left out    {line}\n")).unwrap_or_default();
    Ok(format!("mesh {}: valid\n{}{left_out}", path.display(), mesh_lines(&file.mesh)))
}

fn mesh_lines(mesh: &TriangleMesh) -> String {
    let (low, high) =
        mesh.positions.iter().fold((mesh.positions[0], mesh.positions[0]), |(low, high), &p| (low.min(p), high.max(p)));
    let size = high - low;
    let area: f64 = mesh.material_uv.iter().map(|uv| f64::from((uv[1] - uv[0]).perp_dot(uv[2] - uv[0])) / 2.0).sum();
    format!(
        "  vertices    {}\n  triangles   {}\n  hinges      {}\n  extent      {:.4} x {:.4} x {:.4} m\n  rest area   {area:.4} m^2\n",
        mesh.positions.len(),
        mesh.triangles.len(),
        hinges(mesh).len(),
        size.x,
        size.y,
        size.z
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
    let seconds = settings.step_s * f64::from(settings.steps_per_frame) * f64::from(settings.frames);
    text += &format!(
        "  frames      {} of {} steps of {} s ({seconds:.3} s)\n",
        settings.frames, settings.steps_per_frame, settings.step_s
    );
    for line in &scene.left_out {
        text += &format!("  left out    {line}\n");
    }
    text
}
