//! [`Scene`]: what a run simulates, with its parts and settings. It holds the start state and nothing that changes in a run.

use crate::math::Vec3;
use crate::mesh::{Part, TriangleMesh};

use super::fabric::Fabric;
use super::motion::Motion;
use super::obstacle::Obstacle;
use super::preconditioner::PreconditionerKind;

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
pub(super) const CONTACT_STIFFNESS: f64 = 8.0;

/// Thickness of the cloth where a scene does not say, metres.
pub const DEFAULT_THICKNESS_M: f64 = 0.002;

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
