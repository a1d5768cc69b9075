//! `loomtree new-scene`: a commented scene from mesh files, with the unit and the up axis guessed.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde_json::json;

use super::{CliError, answer};
use crate::math::Vec3;
use crate::mesh::{FileMesh, MaterialSource, read_mesh, read_obstacle};
use crate::os::console::note;
use crate::output::write_atomically;
use crate::scene::{Overrides, SceneError, read_str};

/// Write a commented scene that simulates meshes as cloth.
///
/// The unit of the files and their up axis are guessed from the size and the shape of the meshes, and said; --units and
/// --up set them.
#[derive(Args, Clone, Debug)]
pub struct NewSceneArgs {
    /// Meshes of cloth (.obj, .ply), a piece each
    #[arg(required = true, value_name = "MESH")]
    pub meshes: Vec<PathBuf>,
    /// A mesh or a body (.obj, .ply, .glb, .gltf, .usda, .usdc, .abc) that the cloth meets
    #[arg(long, value_name = "FILE")]
    pub obstacle: Vec<PathBuf>,
    /// The scene [default: the name of the first mesh, with .toml]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Unit of the meshes [default: guessed from their size]
    #[arg(long, value_enum)]
    pub units: Option<Unit>,
    /// Axis of the meshes that points up [default: guessed from their shape]
    #[arg(long, value_enum)]
    pub up: Option<Up>,
    /// Fabric by name: silk, wool, cotton, nylon, denim or membrane
    #[arg(long, value_name = "NAME", default_value = "cotton")]
    pub fabric: String,
    /// Put a floor below everything
    #[arg(long)]
    pub ground: bool,
    /// Replace a file that is there
    #[arg(long)]
    pub overwrite: bool,
}

/// Unit of length of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Unit {
    /// Meters
    M,
    /// Centimeters
    Cm,
    /// Millimeters
    Mm,
    /// Inches
    In,
}

impl Unit {
    fn meters(self) -> f64 {
        match self {
            Unit::M => 1.0,
            Unit::Cm => 0.01,
            Unit::Mm => 0.001,
            Unit::In => 0.0254,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Unit::M => "meters",
            Unit::Cm => "centimeters",
            Unit::Mm => "millimeters",
            Unit::In => "inches",
        }
    }
}

/// Axis of a file that points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Up {
    /// Y
    Y,
    /// Z
    Z,
}

/// Distance of the floor below cloth, meters: a start state must not touch.
const CLEAR_M: f64 = 0.01;
/// Largest diameter of clothes and people in meters and in centimeters, with room: a coat is 1.5 m or 150 cm.
const LARGEST: [f64; 2] = [12.0, 700.0];
/// How much longer an axis must be than the other to be taken for the height.
const TALLER: f32 = 1.25;

/// A file that the scene names.
struct Piece {
    name: String,
    path: PathBuf,
    /// In the unit of the file.
    positions: Vec<Vec3>,
    /// Of cloth; it knows the numbers of the file's vertices.
    mesh: Option<FileMesh>,
    /// The field of a body that has its own unit and up axis; none for a mesh.
    body: Option<&'static str>,
}

/// Runs the command.
///
/// # Errors
/// A mesh cannot be read or cannot be cloth, or the scene is there or cannot be written (exit code 2).
pub fn run(args: &NewSceneArgs) -> Result<(), CliError> {
    let out = args.out.clone().unwrap_or_else(|| {
        let stem = args.meshes[0].file_name().unwrap_or_default().to_string_lossy();
        PathBuf::from(stem.split('.').next().unwrap_or("scene")).with_extension("toml")
    });
    let place = out.display();
    if out.extension().is_none_or(|extension| extension != "toml") {
        return Err(CliError::bad_input(format!("{place}: the name of a scene ends in .toml")));
    }
    if out.exists() && !args.overwrite {
        return Err(CliError::bad_input(format!("{place} is there already; --overwrite replaces it")));
    }
    let mut names = Vec::new();
    let cloths = args.meshes.iter().map(|path| cloth(path, &mut names)).collect::<Result<Vec<_>, _>>()?;
    let obstacles = args.obstacle.iter().map(|path| obstacle(path, &mut names)).collect::<Result<Vec<_>, _>>()?;
    let (unit, why_unit) = match args.units {
        Some(unit) => (unit, "as --units says".to_string()),
        None => guess_unit(&cloths, &obstacles),
    };
    let (up, why_up) = match args.up {
        Some(up) => (up, "as --up says".to_string()),
        None => guess_up(&cloths, &obstacles),
    };
    let text = scene_text(args, &out, &cloths, &obstacles, (unit, &why_unit), (up, &why_up));
    // The text must be a scene before it takes the place of a file.
    let start = check(&text, &out)?;
    write_atomically(&out, |file| file.write_all(text.as_bytes())).map_err(CliError::bad_input)?;
    note(format_args!("unit: {}, {why_unit}; up: {}, {why_up}", unit.name(), if up == Up::Y { "y" } else { "z" }));
    let flag = match &start {
        None => "",
        Some(what) => {
            note(format_args!("warning: {what}; `--untangle` tries to part what crosses"));
            " --untangle"
        }
    };
    answer(&format!("{place}; next: loomtree run {place}{flag} --view\n"), || {
        json!({
            "file": out,
            "units_m": unit.meters(),
            "up": if up == Up::Y { "y" } else { "z" },
            "starts_free": start.is_none(),
        })
    })
}

/// Why the start state is refused, if it crosses.
fn check(text: &str, out: &Path) -> Result<Option<String>, CliError> {
    let parsed = read_str(text, out).map_err(CliError::bad_input)?;
    match parsed.at(&Overrides::default()) {
        Ok(_) => Ok(None),
        Err(error @ SceneError::Crossing { .. }) => Ok(Some(error.to_string())),
        Err(error) => Err(CliError::bad_input(error)),
    }
}

/// A name for a file that is not taken yet.
fn name_of(path: &Path, names: &mut Vec<String>) -> String {
    let file = path.file_name().unwrap_or_default().to_string_lossy();
    let stem: String =
        file.split('.').next().unwrap_or_default().chars().filter(|c| !matches!(c, '"' | '\\')).collect();
    let stem = if stem.is_empty() { "mesh".to_string() } else { stem };
    let taken = |name: &String| names.contains(name);
    let name = std::iter::once(stem.clone()).chain((2..).map(|i| format!("{stem} {i}"))).find(|name| !taken(name));
    let name = name.unwrap_or(stem);
    names.push(name.clone());
    name
}

fn cloth(path: &Path, names: &mut Vec<String>) -> Result<Piece, CliError> {
    let file = read_mesh(path, MaterialSource::Auto).map_err(|error| {
        let mut sentence = error.to_string();
        if read_obstacle(path, 1.0).is_ok() {
            sentence += "; as something that cloth meets it can be used (--obstacle)";
        }
        CliError::bad_input(sentence)
    })?;
    let positions = file.mesh.positions.clone();
    Ok(Piece { name: name_of(path, names), path: path.to_path_buf(), positions, mesh: Some(file), body: None })
}

fn obstacle(path: &Path, names: &mut Vec<String>) -> Result<Piece, CliError> {
    let extension = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    // A body has the meters and the up axis of its format.
    let body = match &extension[..] {
        "glb" | "gltf" => Some("gltf"),
        "usd" | "usda" | "usdc" | "usdz" => Some("usd"),
        "abc" => Some("abc"),
        _ => None,
    };
    let positions = match body {
        Some(_) => Vec::new(),
        None => read_obstacle(path, 1.0).map_err(CliError::bad_input)?.0.positions,
    };
    Ok(Piece { name: name_of(path, names), path: path.to_path_buf(), positions, mesh: None, body })
}

/// Lowest and highest corner of all pieces.
fn bounds<'a>(pieces: impl Iterator<Item = &'a Piece>) -> [Vec3; 2] {
    let none = [Vec3::INFINITY, Vec3::NEG_INFINITY];
    pieces.flat_map(|piece| &piece.positions).fold(none, |[low, high], p| [low.min(*p), high.max(*p)])
}

fn guess_unit(cloths: &[Piece], obstacles: &[Piece]) -> (Unit, String) {
    let [low, high] = bounds(cloths.iter().chain(obstacles));
    let size = f64::from((high - low).length());
    let unit = match size {
        size if size <= LARGEST[0] => Unit::M,
        size if size <= LARGEST[1] => Unit::Cm,
        _ => Unit::Mm,
    };
    (unit, format!("because everything together is {size:.3} units across (--units m|cm|mm|in changes it)"))
}

fn guess_up(cloths: &[Piece], obstacles: &[Piece]) -> (Up, String) {
    // A body tells more than cloth.
    let bodies = obstacles.iter().any(|piece| !piece.positions.is_empty());
    let [low, high] = if bodies { bounds(obstacles.iter()) } else { bounds(cloths.iter()) };
    let size = high - low;
    let flat = size.min_element() < 0.02 * size.max_element();
    let what = if bodies { "what the cloth meets" } else { "the cloth" };
    if !flat && size.z > TALLER * size.y {
        (Up::Z, format!("because {what} is tallest along z (--up y changes it)"))
    } else if !flat && size.y > TALLER * size.z {
        (Up::Y, format!("because {what} is tallest along y (--up z changes it)"))
    } else {
        (Up::Y, "as usual, because the shape does not tell (--up z changes it)".into())
    }
}

/// How a path is written in a scene at `out`: relative to its folder, if it is below it.
fn from_scene(path: &Path, out: &Path) -> String {
    let folder = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let inside = std::path::absolute(folder).ok().and_then(|folder| whole.strip_prefix(folder).map(PathBuf::from).ok());
    toml::Value::String(inside.unwrap_or(whole).to_string_lossy().into_owned()).to_string()
}

fn text_value(text: &str) -> String {
    toml::Value::String(text.into()).to_string()
}

fn scene_text(
    args: &NewSceneArgs,
    out: &Path,
    cloths: &[Piece],
    obstacles: &[Piece],
    (unit, why_unit): (Unit, &str),
    (up, why_up): (Up, &str),
) -> String {
    let file = out.file_name().unwrap_or_default().to_string_lossy();
    let mut text = format!(
        "\
# A scene of loomtree, made by `loomtree new-scene`.
#
#   loomtree check {file}         what is in it, or what is wrong with it
#   loomtree run {file} --view    simulate it and look at it
#
# Units are SI and stand in the names. Every field: docs/scene.md.
#
# The meshes are in {}, {why_unit}.
# Their up axis is {}, {why_up}.

",
        unit.name(),
        if up == Up::Y { "y" } else { "z" },
    );
    text += "\
[simulation]
step_s = 0.004
steps_per_frame = 10 # 25 frames a second
frames = 50
thickness_m = 0.001 # of the cloth: contacts act within this distance
friction = 0.3

# [air] # without this table there is no air
# wind_m_s = [2, 0, 0]
";
    // String formatting does not fail.
    for piece in cloths {
        let (name, path, fabric) = (text_value(&piece.name), from_scene(&piece.path, out), text_value(&args.fabric));
        let _ = write!(text, "\n[[cloth]]\nname = {name}\nmesh = {path}\n");
        if unit != Unit::M {
            let _ = writeln!(text, "scale = {} # meters per unit of the file", unit.meters());
        }
        if up == Up::Z {
            text += "rotate_deg = [-90, 1, 0, 0] # z up becomes y up\n";
        }
        let _ = writeln!(text, "fabric = {fabric} # silk, wool, cotton, nylon, denim, membrane; your own: [[fabric]]");
    }
    for piece in obstacles {
        let (name, path) = (text_value(&piece.name), from_scene(&piece.path, out));
        let form = piece.body.unwrap_or("mesh");
        let _ = write!(text, "\n[[obstacle]]\nname = {name}\n{form} = {path}\n");
        if piece.body.is_none() {
            if unit != Unit::M {
                let _ = writeln!(text, "units_m = {} # meters per unit of the file", unit.meters());
            }
            if up == Up::Z {
                text += "up = \"z\"\n";
            }
        }
    }
    let height = |p: &Vec3| f64::from(if up == Up::Y { p.y } else { p.z }) * unit.meters();
    let lowest =
        |pieces: &[Piece]| pieces.iter().flat_map(|piece| &piece.positions).map(height).fold(f64::INFINITY, f64::min);
    if args.ground {
        let floor_m = (lowest(cloths) - CLEAR_M).min(lowest(obstacles));
        let [low, high] = bounds(cloths.iter().chain(obstacles)).map(|p| p.as_dvec3() * unit.meters());
        let (middle, size) = (0.5 * (low + high), 2.0 * (high - low).length() + 1.0);
        let depth = if up == Up::Y { middle.z } else { -middle.y };
        let _ = write!(
            text,
            "\n[[obstacle]]\nname = \"floor\"\nplane = {{ point_m = [{:.4}, {floor_m:.4}, {depth:.4}], normal = [0, 1, \
             0], size_m = [{size:.2}, {size:.2}] }}\nfriction = 0.5\n",
            middle.x
        );
    } else if obstacles.is_empty() {
        text += "\n# Nothing is below the cloth, so it hangs by its highest vertices (numbers of the file, from 0).\n";
        for piece in cloths {
            let file =
                |vertex: usize| piece.mesh.as_ref().map_or(vertex as u32, |mesh| mesh.file_vertex(vertex as u32));
            let [one, other] = highest(&piece.positions, height).map(file);
            let name = text_value(&piece.name);
            let _ = writeln!(text, "[[pin]]\ncloth = {name}\nvertices = [{one}, {other}]");
        }
    } else {
        text += "\n# [[pin]] # holds vertices in place (numbers of the file, from 0)\n# vertices = [0]\n";
    }
    text
}

/// Two vertices near the top that are far apart.
fn highest(positions: &[Vec3], height: impl Fn(&Vec3) -> f64) -> [usize; 2] {
    let (low, high) = positions.iter().map(&height).fold((f64::MAX, f64::MIN), |(l, h), y| (l.min(y), h.max(y)));
    let top: Vec<usize> =
        (0..positions.len()).filter(|i| height(&positions[*i]) >= high - 0.02 * (high - low)).collect();
    let farthest = |from: usize| {
        let far = |i: &usize| positions[*i].distance_squared(positions[from]);
        top.iter().copied().max_by(|a, b| far(a).total_cmp(&far(b))).unwrap_or(from)
    };
    let one = farthest(top.first().copied().unwrap_or(0));
    let other = farthest(one);
    [one.min(other), one.max(other)]
}
