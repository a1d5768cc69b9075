//! Scene file -> validated [`Scene`]: sheets and meshes, fabrics, pins, wind, solver settings. No simulation state.

mod motion;

use crate::math::Vec3;
use crate::mesh::TriangleMesh;

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
    /// Rigid motions that pins (and obstacles) follow.
    pub motions: Vec<Motion>,
    /// Numbers of the run.
    pub settings: Settings,
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

/// A rigid (or scaling) motion by keyframes, linear between them (rotation: slerp), constant outside.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Motion {
    /// Keyframes in ascending time.
    pub keyframes: Vec<Keyframe>,
}

/// One keyframe: x -> rotation * (scale * x) + translation, rotation about `pivot_m`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Keyframe {
    pub time_s: f64,
    pub translation_m: crate::math::DVec3,
    pub rotation: crate::math::DQuat,
    pub scale: f64,
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
    /// Thickness of the cloth for contacts, metres.
    pub thickness_m: f64,
    /// Coulomb friction coefficient of contacts.
    pub friction: f64,
}
