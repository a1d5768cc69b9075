//! `loomtree convert`: the frames of a run in the formats of other programs.

use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::Args;
use serde_json::json;

use super::{CliError, answer};
use crate::coordinator::RunOptions;
use crate::math::DVec3;
use crate::model::Sewn;
use crate::os::console::note;
use crate::output::export::{
    Animation, ExportError, Track, VertexValues, plain_names, write_abc, write_glb, write_mdd, write_pvd, write_usda,
    write_usdc, write_vtu,
};
use crate::output::obj::{self, TextureCoordinates};
use crate::output::pc2::Pc2Writer;
use crate::output::{CacheFormat, FrameSource, Report, RunDirectory, RunManifest, WriteError, ply, write_atomically};
use crate::scene::{Obstacles, Overrides, Scene, read_str};
use crate::view::Known;

/// Write the frames of a run in the formats of other programs.
///
/// Pieces of cloth and obstacles get a mesh each, named as in the scene. Units are meters; the up axis is that of the
/// run.
#[derive(Args, Clone, Debug)]
pub struct ConvertArgs {
    /// Run directory (what `loomtree run` was given as --out); the run may still go on.
    pub run_dir: PathBuf,
    /// Formats, separated by commas: usd (one .usda stage), usdc (the same in binary, a quarter as large), abc (one
    /// Alembic archive), glb (a morph target per frame), mdd or pc2 (a point cache and an .obj per mesh), vtu (a grid
    /// per frame, with stretch, rank, strain, contact and its force, and a .pvd), ply (a file per mesh and frame).
    #[arg(long, value_name = "FORMATS", required = true, value_delimiter = ',')]
    pub to: Vec<Target>,
    /// Folder for the files [default: export in the run directory]
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
}

/// A format of `loomtree convert`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// A USD stage as text.
    Usd,
    /// A binary USD stage.
    Usdc,
    /// An Alembic archive.
    Abc,
    /// LightWave's point cache, a file per mesh.
    Mdd,
    /// PC2 point cache, a file per mesh.
    Pc2,
    /// VTK grids for ParaView.
    Vtu,
    /// Binary glTF.
    Glb,
    /// Binary PLY, a file per mesh and frame.
    Ply,
}

impl FromStr for Target {
    type Err = String;
    fn from_str(text: &str) -> Result<Target, String> {
        match text.trim().to_ascii_lowercase().as_str() {
            "usd" | "usda" => Ok(Target::Usd),
            "mdd" => Ok(Target::Mdd),
            "pc2" => Ok(Target::Pc2),
            "vtu" | "pvd" => Ok(Target::Vtu),
            "glb" => Ok(Target::Glb),
            "ply" => Ok(Target::Ply),
            "usdc" => Ok(Target::Usdc),
            "abc" => Ok(Target::Abc),
            _ => {
                Err("unknown format; valid are usd, usdc, abc, mdd, pc2, vtu, glb and ply (separated by commas)".into())
            }
        }
    }
}

impl From<CacheFormat> for Target {
    fn from(format: CacheFormat) -> Target {
        match format {
            CacheFormat::Usd => Target::Usd,
            CacheFormat::Usdc => Target::Usdc,
            CacheFormat::Abc => Target::Abc,
            CacheFormat::Mdd => Target::Mdd,
            CacheFormat::Vtu => Target::Vtu,
            CacheFormat::Glb => Target::Glb,
        }
    }
}

/// Writes the files and prints their names.
///
/// # Errors
/// The folder holds no run (exit code 2), or a frame cannot be read or a file not be written (exit code 1).
pub fn run(args: ConvertArgs) -> Result<(), CliError> {
    let (lines, frames) = export(&args.run_dir, &args.to, args.out)?;
    answer(&lines, || json!({ "files": lines.lines().collect::<Vec<_>>(), "frames": frames }))
}

/// Writes the frames of a run in other formats, into its folder `export` unless another one is given. Returns a line
/// for every file or kind of file, and the number of frames.
///
/// # Errors
/// As [`run`].
pub(super) fn export(run_dir: &Path, to: &[Target], out: Option<PathBuf>) -> Result<(String, usize), CliError> {
    let directory = RunDirectory::open(run_dir).map_err(CliError::bad_input)?;
    let report = Report::load(&directory.report()).map_err(CliError::bad_input)?;
    let mut source = FrameSource::open(&directory).map_err(CliError::bad_input)?;
    if let Some(stage) = report.header.stages.last() {
        let first = stage.first_frame;
        source = source.since(first);
        if source.numbers().is_empty() {
            let what = format!("no frame of the sewn cloth is there yet (it begins with frame {first})");
            return Err(CliError::bad_input(what));
        }
        note(format_args!("written are the frames from {first} on; those before have the mesh of the panels"));
    }
    let frame_s = report.header.step_s * f64::from(report.header.steps_per_frame);
    let tracks = tracks(&directory, &source, !report.header.stages.is_empty())?;
    let values = if to.contains(&Target::Vtu) { values(&directory) } else { None };
    let animation = Animation {
        values,
        source,
        folder: run_dir.to_path_buf(),
        frames_per_s: if frame_s > 0.0 { rounded(1.0 / frame_s) } else { 1.0 },
        z_up: report.header.up_axis == "z",
        tracks,
    };
    let out = out.unwrap_or_else(|| directory.path().join("export"));
    std::fs::create_dir_all(&out).map_err(|source| CliError::failed(WriteError { path: out.clone(), source }))?;
    let mut lines = String::new();
    for (i, target) in to.iter().enumerate() {
        if !to[..i].contains(target) {
            lines += &convert(&animation, *target, &out).map_err(CliError::failed)?;
        }
    }
    Ok((lines, animation.source.numbers().len()))
}

/// Rank, strain, contact and its force of the cloth's vertices, from the scene that the run has recorded.
fn values(directory: &RunDirectory) -> Option<Box<VertexValues>> {
    let known = match Known::load(directory) {
        Ok(known) => RefCell::new(known),
        Err(why) => {
            note(format_args!("grids without rank, strain, contact and its force: {why}"));
            return None;
        }
    };
    Some(Box::new(move |frame, positions| {
        let mut known = known.borrow_mut();
        let positions = known.about_origin(positions);
        // What a scene does not have, such as contacts without collisions, is left out.
        let forces = known.contact_force(&positions, frame);
        let found = [
            ("rank", Ok(known.ranks())),
            ("strain", known.strain(&positions)),
            ("contact", known.contact(&positions, frame)),
            ("contact_force", forces.map(|forces| forces.iter().flat_map(|force| force.to_array()).collect())),
        ];
        found.into_iter().filter_map(|(name, values)| values.ok().map(|values| (name, values))).collect()
    }))
}

/// A rate that differs from a whole number by rounding alone is that number.
fn rounded(rate: f64) -> f64 {
    let whole = rate.round();
    if (rate - whole).abs() < 1e-9 * whole { whole } else { rate }
}

/// Pieces and obstacles by the run's own scene; where its files are gone, all cloth and all obstacles as one each.
/// `sewn`: the frames are those of sewn cloth.
fn tracks(directory: &RunDirectory, source: &FrameSource, sewn: bool) -> Result<Vec<Track>, CliError> {
    let first = source.numbers()[0];
    let cloth = source.read(first).map_err(CliError::failed)?;
    let obstacles = source.read_obstacle(first).map_err(CliError::failed)?;
    let scene = scene_of(directory).map(|scene| match Sewn::of(&scene).filter(|_| sewn) {
        Some((scene, _)) => as_one(scene),
        None => scene,
    });
    match scene {
        Ok(scene) if scene.mesh.triangles.len() == cloth.triangles.len() => Ok(tracks_of(&scene, obstacles.is_some())),
        other => {
            let why = other.err().unwrap_or_else(|| "its frames are of another resolution".into());
            note(format_args!("the names of the pieces are not known ({why}): all cloth is one mesh"));
            let whole = |name: &str, obstacle, mesh: &crate::output::FrameMesh| Track {
                name: name.into(),
                obstacle,
                vertices: 0..mesh.positions.len(),
                triangles: 0..mesh.triangles.len(),
                uv: Vec::new(),
            };
            let obstacles = obstacles.iter().map(|mesh| whole("obstacles", true, mesh));
            Ok(std::iter::once(whole("cloth", false, &cloth)).chain(obstacles).collect())
        }
    }
}

/// Cloths that are sewn to each other share vertices, so they are one.
fn as_one(mut scene: Scene) -> Scene {
    if let [first, _, ..] = &scene.cloths[..] {
        let (vertices, triangles) = (0..scene.mesh.positions.len() as u32, 0..scene.mesh.triangles.len() as u32);
        scene.cloths = vec![crate::scene::Cloth { name: "cloth".into(), vertices, triangles, ..first.clone() }];
    }
    scene
}

fn scene_of(directory: &RunDirectory) -> Result<Scene, String> {
    let manifest = RunManifest::load(directory).map_err(|error| error.to_string())?;
    let options: RunOptions = manifest.flags().map_err(|error| error.to_string())?;
    let overrides = Overrides { resolution: options.resolution, frames: options.frames };
    let parsed = read_str(&manifest.text_to_read(), &manifest.scene_path).map_err(|error| error.to_string())?;
    parsed.untangled_at(&overrides).map(|(scene, _)| scene).map_err(|error| error.to_string())
}

fn tracks_of(scene: &Scene, with_obstacles: bool) -> Vec<Track> {
    let ranges = |range: &std::ops::Range<u32>| range.start as usize..range.end as usize;
    let cloths = scene.cloths.iter().map(|cloth| Track {
        name: cloth.name.clone(),
        obstacle: false,
        vertices: ranges(&cloth.vertices),
        triangles: ranges(&cloth.triangles),
        uv: scene.mesh.material_uv[ranges(&cloth.triangles)].to_vec(),
    });
    let all = Obstacles::new(&scene.obstacles);
    let obstacles = all.ranges().into_iter().enumerate().map(|(i, [vertices, triangles])| Track {
        name: all.name(i).to_owned(),
        obstacle: true,
        vertices,
        triangles,
        uv: Vec::new(),
    });
    cloths.chain(obstacles.filter(|_| with_obstacles)).collect()
}

/// Writes one format; a line for every file or kind of file.
fn convert(animation: &Animation, target: Target, out: &Path) -> Result<String, ExportError> {
    let names = plain_names(&animation.tracks);
    let frames = animation.frames();
    let mut lines = String::new();
    let mut say = |path: &Path| lines += &format!("{}\n", path.display());
    match target {
        Target::Usd => {
            let path = out.join("run.usda");
            write_usda(&path, animation)?;
            say(&path);
        }
        Target::Usdc => {
            let path = out.join("run.usdc");
            write_usdc(&path, animation)?;
            say(&path);
        }
        Target::Abc => {
            let path = out.join("run.abc");
            write_abc(&path, animation)?;
            say(&path);
        }
        Target::Glb => {
            let path = out.join("run.glb");
            write_glb(&path, animation)?;
            say(&path);
        }
        Target::Vtu => {
            let name = |frame: u32| format!("run_{frame:06}.vtu");
            for &frame in &frames {
                write_vtu(&out.join(name(frame)), animation, frame)?;
            }
            let path = out.join("run.pvd");
            write_pvd(&path, animation, name)?;
            say(&path);
        }
        Target::Mdd | Target::Pc2 => {
            let ending = if target == Target::Mdd { "mdd" } else { "pc2" };
            let paths: Vec<PathBuf> = names.iter().map(|name| out.join(format!("{name}.{ending}"))).collect();
            for ((track, name), path) in animation.tracks.iter().zip(&names).zip(&paths) {
                let rest = out.join(format!("{name}.obj"));
                write_rest(&rest, animation, track, frames[0])?;
                if target == Target::Mdd {
                    write_mdd(path, animation, track)?;
                }
                say(&rest);
                say(path);
            }
            if target == Target::Pc2 {
                let open = |(track, path): (&Track, &PathBuf)| Pc2Writer::open(path, track.vertices.len(), 0);
                let caches = animation.tracks.iter().zip(&paths).map(open);
                let mut caches = caches.collect::<Result<Vec<Pc2Writer>, _>>()?;
                for (sample, &frame) in (0..).zip(&frames) {
                    for (cache, points) in caches.iter_mut().zip(animation.points(frame)?) {
                        cache.write(sample, &points)?;
                    }
                }
            }
        }
        Target::Ply => {
            let mut buffer = Vec::new();
            for (track, name) in animation.tracks.iter().zip(&names) {
                for &frame in &frames {
                    let mesh = animation.mesh(track, frame)?;
                    let path = out.join(format!("{name}_{frame:06}.ply"));
                    write_atomically(&path, |out| ply::write(out, &mut buffer, &mesh.positions, &mesh.triangles))?;
                }
                say(&out.join(format!("{name}_%06d.ply")));
            }
        }
    }
    Ok(lines)
}

/// The mesh of a track in a frame, with its material coordinates.
fn write_rest(path: &Path, animation: &Animation, track: &Track, frame: u32) -> Result<(), ExportError> {
    let mesh = animation.mesh(track, frame)?;
    let texture = TextureCoordinates::new(mesh.positions.len(), &mesh.triangles, &track.uv);
    let mut buffer = Vec::new();
    write_atomically(path, |out| {
        obj::write(out, &mut buffer, DVec3::ZERO, &mesh.positions, &mesh.triangles, Some(&texture), &[])
    })?;
    Ok(())
}
