//! Scene file -> validated [`Scene`]: sheets and meshes, fabrics, pins, wind, solver settings. No simulation state.

mod arcsim;
mod cloth_file;
mod fabric;
mod fields;
mod file;
mod json;
mod keyframes;
mod motion;
mod obstacle;
mod obstacle_file;
mod parsed;
mod pieces;
mod pin_file;
mod pins;
mod preconditioner;
mod sequence;
mod settings_file;
mod sheet;
mod start;

use std::io::Read;
use std::path::{Path, PathBuf};

use crate::input::{Input, Streams};
use crate::math::Vec3;
use crate::mesh::{MeshReadError, Part, TriangleMesh};

pub use fabric::{load_fabric, parse_fabric};
pub use obstacle::{Movement, Obstacle, ObstacleHeader, Obstacles};
pub use parsed::ParsedScene;
pub use pieces::size_warning;
pub use preconditioner::PreconditionerKind;
pub use sheet::{Sheet, sheet_cells};
pub use start::{BestState, Crossings, Doubled, Untangling};

/// What the command line changes in a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Overrides {
    /// Triangles of all sheets together; meshes from files keep theirs.
    pub resolution: Option<u64>,
    /// Frames to write.
    pub frames: Option<u32>,
}

/// Resolutions that a sheet can be made in, triangles.
pub const RESOLUTIONS: std::ops::RangeInclusive<u64> = 2..=20_000_000;

/// Stiffness of contacts where a scene does not say.
const CONTACT_STIFFNESS: f64 = 8.0;

/// Thickness of the cloth where a scene does not say, metres.
pub const DEFAULT_THICKNESS_M: f64 = 0.002;

/// Longest scene text that is read; a scene is written by hand.
const LONGEST_TEXT_BYTES: u64 = 16 << 20;

/// Why a scene is refused: one sentence with the file and, where known, line and field.
#[allow(missing_docs, reason = "the sentence of a variant says what its fields are")]
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file is missing or cannot be read, or is no scene at all.
    #[error("{}: {what}", path.display())]
    File { path: PathBuf, what: String },
    /// The text is not TOML or JSON.
    #[error("{}{}: {what}", path.display(), line_suffix(*line))]
    Syntax { path: PathBuf, line: Option<usize>, what: String },
    /// A field has a value it must not have.
    #[error("{}{}: field `{field}`: {what}", path.display(), line_suffix(*line))]
    Field { path: PathBuf, line: Option<usize>, field: String, what: String },
    /// The start state crosses itself or an obstacle.
    #[error("{}{}: field `{field}`: {crossings}", path.display(), line_suffix(*line))]
    Crossing { path: PathBuf, line: Option<usize>, field: String, crossings: Box<Crossings> },
    /// A mesh that the scene names is refused.
    #[error(transparent)]
    Mesh(#[from] MeshReadError),
}

fn line_suffix(line: Option<usize>) -> String {
    line.map(|line| format!(", line {line}")).unwrap_or_default()
}

/// Reads and checks a scene file: `.toml` in the format of `docs/scene.md`, `.json` in ARCSim's.
/// [`ParsedScene::at`] makes scenes of it.
pub fn read(path: &Path) -> Result<ParsedScene, SceneError> {
    let parser = parser_of(path)?;
    parser(&read_text(path)?, path)
}

/// [`read`] of a text that was the file `path`: files it names are looked up relative to that place.
pub fn read_str(text: &str, path: &Path) -> Result<ParsedScene, SceneError> {
    parser_of(path)?(text, path)
}

/// [`read`], at one resolution.
pub fn load(path: &Path, overrides: &Overrides) -> Result<Scene, SceneError> {
    read(path)?.at(overrides)
}

/// [`read`], at one resolution and untangled where needed: see [`ParsedScene::untangled_at`].
pub fn load_untangled(path: &Path, overrides: &Overrides) -> Result<(Scene, Option<Untangling>), SceneError> {
    read(path)?.untangled_at(overrides)
}

/// [`read_str`], at one resolution.
pub fn parse(text: &str, path: &Path, overrides: &Overrides) -> Result<Scene, SceneError> {
    read_str(text, path)?.at(overrides)
}

type Parser = fn(&str, &Path) -> Result<ParsedScene, SceneError>;

fn parser_of(path: &Path) -> Result<Parser, SceneError> {
    match path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase().as_str() {
        "toml" => Ok(file::parse),
        "json" => Ok(arcsim::parse),
        _ => Err(SceneError::File {
            path: path.into(),
            what: "a scene file ends in .toml (or .json for ARCSim's)".into(),
        }),
    }
}

fn read_text(path: &Path) -> Result<String, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    let unreadable = |error: std::io::Error| fault(format!("cannot be read: {error}"));
    let input = Input::open(path, Streams::Refused).map_err(unreadable)?;
    let mut bytes = Vec::new();
    input.reader.take(LONGEST_TEXT_BYTES + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > LONGEST_TEXT_BYTES {
        return Err(fault(format!("is longer than {LONGEST_TEXT_BYTES} bytes, which no scene is")));
    }
    String::from_utf8(bytes).map_err(|_| fault("is not UTF-8 text".into()))
}

/// Everything a run needs to know about what is simulated; all checks have passed.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Name shown in reports.
    pub name: String,
    /// All cloth pieces merged into one mesh.
    pub mesh: TriangleMesh,
    /// Start velocity of every vertex, m/s.
    pub velocities: Vec<Vec3>,
    /// Fabrics; `fabric_of_triangle` indexes them.
    pub fabrics: Vec<Fabric>,
    /// Fabric of every triangle.
    pub fabric_of_triangle: Vec<u16>,
    /// Pinned vertices.
    pub pins: Vec<Pin>,
    /// Rigid motions that pins follow.
    pub motions: Vec<Motion>,
    /// The pieces of cloth, ascending by vertices and triangles; empty = one piece with the settings' friction.
    pub cloths: Vec<Cloth>,
    /// Obstacles; [`Obstacles::new`] makes one numbered surface of them.
    pub obstacles: Vec<Obstacle>,
    /// Objects and groups that the files of the pieces name, by triangles of the scene; ascending.
    pub parts: Vec<Part>,
    /// Numbers of the run.
    pub settings: Settings,
    /// One sentence for everything that was repaired or is likely not meant so.
    pub warnings: Vec<String>,
    /// One sentence for every feature of an imported scene that is left out.
    pub left_out: Vec<String>,
}

/// A fabric in ARCSim's form [Wang et al. 2011].
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Fabric {
    /// Name or file.
    pub name: String,
    /// Mass per rest area, kg/m^2.
    pub density_kg_m2: f64,
    /// Stretching stiffness, N/m: row 0 at rest, rows 1..=5 at a principal strain of 1/6 along 0, 22.5, .. 90 degrees from the
    /// warp; columns: warp, cross (warp-weft), weft, shear.
    pub stretching_n_m: [[f64; 4]; 6],
    /// Bending stiffness, N m: rows = 0, 45, 90 degrees from the warp; columns = curvature 0, 5, 10, 15, 20 1/m.
    pub bending_n_m: [[f64; 5]; 3],
    /// Stiffness-proportional damping, seconds (damping matrix = damping_s * stiffness matrix).
    pub damping_s: f64,
}

/// A piece of cloth: its place in the scene's mesh and what contacts need to know of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Cloth {
    /// Shown in messages.
    pub name: String,
    /// Its vertices.
    pub vertices: std::ops::Range<u32>,
    /// Its triangles.
    pub triangles: std::ops::Range<u32>,
    /// Coulomb friction coefficient of its contacts with cloth.
    pub friction: f64,
}

impl Scene {
    /// Friction coefficient of the cloth at a vertex. A contact of two cloths has the mean of theirs, one with
    /// an obstacle the obstacle's alone.
    pub fn friction_of_vertex(&self, vertex: u32) -> f64 {
        let after = self.cloths.partition_point(|cloth| cloth.vertices.end <= vertex);
        self.cloths.get(after).map_or(self.settings.friction, |cloth| cloth.friction)
    }

    /// A vertex of the mesh as messages name it: where there are several pieces, by its number within its piece.
    pub fn vertex_name(&self, vertex: u32) -> String {
        match self.cloths.iter().find(|cloth| cloth.vertices.contains(&vertex)) {
            Some(cloth) if self.cloths.len() > 1 => {
                format!("vertex {} of `{}`", vertex - cloth.vertices.start, cloth.name)
            }
            _ => format!("vertex {vertex}"),
        }
    }
}

/// A vertex whose position is prescribed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pin {
    /// Vertex of the scene's mesh.
    pub vertex: u32,
    /// Index into `Scene::motions`, applied to the vertex's start position; none = stays where it is.
    pub motion: Option<u32>,
    /// Held from this time, seconds.
    pub start_s: f64,
    /// Released after this time, seconds (infinite = never).
    pub end_s: f64,
}

/// A rigid (or scaling) motion by keyframes, linear between them (rotation: by angle, or slerp), constant outside;
/// [`Motion::transform_at`] evaluates it.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Motion {
    /// Keyframes in ascending time.
    pub keyframes: Vec<Keyframe>,
}

/// One keyframe: x -> rotation * (scale * x) + translation, rotation about `pivot_m`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Keyframe {
    /// Seconds since the start of the run.
    pub time_s: f64,
    /// Added last, meters.
    pub translation_m: crate::math::DVec3,
    /// Unit quaternion.
    pub rotation: crate::math::DQuat,
    /// The rotation as unit axis and angle in radians, where it was given so: the angle may be more than a turn.
    pub turn: Option<(crate::math::DVec3, f64)>,
    /// Factor about the pivot, above 0.
    pub scale: f64,
    /// Center of rotation and scale, meters.
    pub pivot_m: crate::math::DVec3,
}

/// Numbers of a run.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Settings {
    /// Length of a step, seconds.
    pub step_s: f64,
    /// Steps per written frame.
    pub steps_per_frame: u32,
    /// Frames to write (frame 0 is the start state and comes on top).
    pub frames: u32,
    /// Acceleration of gravity, m/s^2.
    pub gravity_m_s2: Vec3,
    /// Velocity of the air, m/s.
    pub wind_m_s: Vec3,
    /// Density of the air (pressure term of the wind), kg/m^3.
    pub air_density_kg_m3: f64,
    /// Tangential drag per area and velocity, kg/(m^2 s).
    pub air_drag_kg_m2_s: f64,
    /// Relative residual at which PCG stops.
    pub relative_tolerance: f64,
    /// Most PCG iterations per step.
    pub max_iterations: u32,
    /// What PCG multiplies the residual by.
    pub preconditioner: PreconditionerKind,
    /// Thickness of the cloth for contacts, metres.
    pub thickness_m: f64,
    /// Coulomb friction coefficient of contacts for everything that has none of its own.
    pub friction: f64,
    /// Whether contacts are detected and answered at all.
    pub collisions: bool,
    /// Stiffness of contacts: multiplies (effective mass of the pair) / step_s^2.
    pub contact_stiffness: f64,
}
