//! [`Scene`]: the objects, start state and settings of a run.

use crate::math::{DVec3, Vec3};
use crate::mesh::{Part, TriangleMesh};

use super::fabric::Fabric;
use super::force_field::ForceField;
use super::maps::Maps;
use super::motion::Motion;
use super::obstacle::Obstacle;
use super::over_time::OverTime;
use super::preconditioner::PreconditionerKind;
use super::sewing::Sewing;
use super::substeps::Substeps;

/// Values from the command line that replace those of a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Overrides {
    /// Triangles of all sheets together. Meshes from files keep their triangles.
    pub resolution: Option<u64>,
    /// Frames to write.
    pub frames: Option<u32>,
}

/// Valid resolutions of a sheet, triangles.
pub const RESOLUTIONS: std::ops::RangeInclusive<u64> = 2..=20_000_000;

/// Contact stiffness if the scene does not give one.
pub(super) const CONTACT_STIFFNESS: f64 = 8.0;

/// Thickness of the cloth if the scene does not give one, meters.
pub const DEFAULT_THICKNESS_M: f64 = 0.002;

/// Input of a run. All checks have passed.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Name shown in reports.
    pub name: String,
    /// The local origin, meters: zero, or for cloth far from the world's origin a point near its middle
    /// ([`crate::math::local_origin`]). Positions of mesh and obstacles are relative to it, as are the motions and all
    /// states of a run; only files and messages for people are in world coordinates.
    pub origin_m: DVec3,
    /// All cloth pieces merged into one mesh.
    pub mesh: TriangleMesh,
    /// Start velocity of every vertex, m/s.
    pub velocities: Vec<Vec3>,
    /// Fabrics, indexed by `fabric_of_triangle`.
    pub fabrics: Vec<Fabric>,
    /// Index into `fabrics` of every triangle.
    pub fabric_of_triangle: Vec<u16>,
    /// Pinned vertices.
    pub pins: Vec<Pin>,
    /// Rigid motions that pins follow.
    pub motions: Vec<Motion>,
    /// Obstacles that pins follow.
    pub followed: Vec<u32>,
    /// The pieces of cloth, ascending by vertices and triangles. Empty means one piece with the friction of the
    /// settings.
    pub cloths: Vec<Cloth>,
    /// Obstacles. [`Obstacles::new`](super::Obstacles::new) merges them into one numbered surface.
    pub obstacles: Vec<Obstacle>,
    /// Factors that differ from vertex to vertex.
    pub maps: Maps,
    /// Objects and groups of the pieces' mesh files, as triangles of the scene, ascending.
    pub parts: Vec<Part>,
    /// Edges that are not flat at rest, ascending.
    pub folds: Vec<Fold>,
    /// What its seams sew; none if it has no seams, or once they are sewn.
    pub sewing: Option<Sewing>,
    /// Settings of the run.
    pub settings: Settings,
    /// One sentence for every repair and for every value that is probably a mistake.
    pub warnings: Vec<String>,
    /// One sentence for every feature of an imported scene that is left out.
    pub left_out: Vec<String>,
}

/// An edge that is not flat at rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fold {
    /// Vertices of the scene's mesh, ascending.
    pub edge: [u32; 2],
    /// Dihedral angle at rest, radians; positive if the edge stands out on the outside, where its triangles run
    /// counter-clockwise.
    pub angle: f32,
}

impl Fold {
    /// The angle at rest of an edge, whose vertices ascend, radians. `folds`: ascending.
    pub fn angle_of(folds: &[Fold], edge: [u32; 2]) -> f32 {
        folds.binary_search_by(|fold| fold.edge.cmp(&edge)).map_or(0.0, |place| folds[place].angle)
    }
}

/// A piece of cloth: its vertices and triangles in the scene's mesh, and its friction.
#[derive(Clone, Debug, PartialEq)]
pub struct Cloth {
    /// Name in messages.
    pub name: String,
    /// Its vertices in the scene's mesh.
    pub vertices: std::ops::Range<u32>,
    /// Its triangles in the scene's mesh.
    pub triangles: std::ops::Range<u32>,
    /// Coulomb friction coefficient for contacts between cloth.
    pub friction: f64,
    /// Pressure inside over that outside, Pa: acts on what closes a volume.
    pub pressure_pa: f64,
}

impl Scene {
    /// Friction coefficient of the cloth at a vertex. A contact of two cloths uses the mean of both coefficients; a
    /// contact with an obstacle uses that of the obstacle alone.
    pub fn friction_of_vertex(&self, vertex: u32) -> f64 {
        let after = self.cloths.partition_point(|cloth| cloth.vertices.end <= vertex);
        let of_cloth = self.cloths.get(after).map_or(self.settings.friction, |cloth| cloth.friction);
        of_cloth * Maps::factor(&self.maps.friction, vertex)
    }

    /// Name of a vertex for messages. In a scene with several pieces, the number counts within the piece.
    pub fn vertex_name(&self, vertex: u32) -> String {
        match self.cloths.iter().find(|cloth| cloth.vertices.contains(&vertex)) {
            Some(cloth) if self.cloths.len() > 1 => {
                format!("vertex {} of `{}`", vertex - cloth.vertices.start, cloth.name)
            }
            _ => format!("vertex {vertex}"),
        }
    }
}

/// A vertex that is held: its position is prescribed, or a spring pulls it to where it would be prescribed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pin {
    /// Vertex of the scene's mesh.
    pub vertex: u32,
    /// Index into `Scene::motions`; the motion is applied to the start position of the vertex. None = the vertex stays
    /// there. From the number of motions on, the index into `Scene::followed`: the vertex keeps its place on the
    /// nearest triangle of that obstacle, where both are when the hold begins.
    pub motion: Option<u32>,
    /// Held from this time, seconds.
    pub start_s: f64,
    /// Released after this time, seconds (infinite = never).
    pub end_s: f64,
    /// Stiffness of the spring to the prescribed position, N/m; none = the position is that one exactly.
    pub stiffness_n_m: Option<f64>,
    /// True if the hold begins only when the vertex touches the obstacle that it follows, not before `start_s`.
    pub on_touch: bool,
}

impl Pin {
    /// A pin that prescribes the position of its vertex from `start_s` to `end_s`.
    pub fn new(vertex: u32, motion: Option<u32>, start_s: f64, end_s: f64) -> Pin {
        Pin { vertex, motion, start_s, end_s, stiffness_n_m: None, on_touch: false }
    }

    /// True if what the vertex is held at follows from the state when the hold begins, not from the scene alone.
    pub fn takes_hold_later(&self, motions: usize) -> bool {
        let follows = self.motion.is_some_and(|motion| motion as usize >= motions);
        self.on_touch || (self.start_s > 0.0 && (follows || self.stiffness_n_m.is_some()))
    }
}

/// Numerical settings of a run.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Settings {
    /// Length of a step, seconds.
    pub step_s: f64,
    /// Sub-steps that a step is made in.
    pub substeps: Substeps,
    /// Steps per written frame.
    pub steps_per_frame: u32,
    /// Frames to write, in addition to frame 0, which is the start state.
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
    /// Limit of PCG iterations per step.
    pub max_iterations: u32,
    /// The preconditioner of PCG.
    pub preconditioner: PreconditionerKind,
    /// Thickness of the cloth for contacts, meters.
    pub thickness_m: f64,
    /// Coulomb friction coefficient of everything that has no coefficient of its own.
    pub friction: f64,
    /// False switches off detection and response of contacts.
    pub collisions: bool,
    /// Contact stiffness: a multiple of (effective mass of the pair) / step_s^2.
    pub contact_stiffness: f64,
    /// What changes during the run.
    pub over_time: SettingsOverTime,
}

/// Settings that change during a run, and accelerations that depend on the place.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SettingsOverTime {
    /// In place of [`Settings::gravity_m_s2`].
    pub gravity_m_s2: Option<OverTime<Vec3>>,
    /// True while panels that are sewn have no weight.
    pub gravity_waits: bool,
    /// In place of [`Settings::wind_m_s`].
    pub wind_m_s: Option<OverTime<Vec3>>,
    /// Factor on all friction coefficients.
    pub friction_factor: Option<OverTime<f64>>,
    /// Factor on the stiffness of all fabrics, against stretching and bending.
    pub stiffness_factor: Option<OverTime<f64>>,
    /// Force fields; they add up.
    pub forces: Vec<ForceField>,
}

impl Settings {
    /// Gives the settings that change their values at `time_s`.
    pub fn take_time(&mut self, time_s: f64) {
        let SettingsOverTime { gravity_m_s2, gravity_waits, wind_m_s, .. } = &self.over_time;
        if let (Some(gravity), false) = (gravity_m_s2, gravity_waits) {
            self.gravity_m_s2 = gravity.at(time_s);
        }
        if let Some(wind) = wind_m_s {
            self.wind_m_s = wind.at(time_s);
        }
    }

    /// Largest factor on the stiffness of fabrics during the run.
    pub fn stiffness_factor_most(&self) -> f64 {
        self.over_time.stiffness_factor.as_ref().map_or(1.0, |factor| factor.values().fold(0.0, f64::max))
    }
}
