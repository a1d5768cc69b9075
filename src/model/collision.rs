//! Data of the whole scene for collision detection and response, on every rank: all triangles, masses, pins and
//! obstacles. It takes about 50 bytes per triangle. Only the tables of queries are split over the ranks (`collision`).

use serde::{Deserialize, Serialize};

use super::GlobalModel;
use super::seam_reach::{Reach, near_seams};
use crate::integrator::pins::{RankPin, is_held};
use crate::scene::{ObstacleHeader, Obstacles};

/// Distance that impact zones leave over the last length of threads, while cloth is sewn.
const SEWN_MARGIN: f64 = 0.08;

/// How far along the cloth seams are looked for, beyond one ring, over the thickness. The gap of both sides of a seam
/// is half of the way through it (`collision/sewn_sides.rs`), so it reaches the thickness after twice that on both
/// sides together; a way along edges is up to twice as long as the straight one.
const REACH: f64 = 4.0;

/// Time span in which a row is pinned.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PinSpan {
    /// Global row.
    pub row: u32,
    /// Start of the hold, seconds.
    pub start_s: f64,
    /// End of the hold, seconds.
    pub end_s: f64,
    /// True if the row is held only while it is one of those that touch ([`CollisionModel::inverse_masses`]).
    pub on_touch: bool,
    /// True if what moves the row is an obstacle.
    pub follows: bool,
}

impl PinSpan {
    fn of(pin: &RankPin) -> PinSpan {
        let follows = pin.grip.is_some() || pin.surface.is_some();
        PinSpan { row: pin.row, start_s: pin.start_s, end_s: pin.end_s, on_touch: pin.on_touch, follows }
    }
}

/// The scene as collisions use it. Vertices are numbered with the cloth rows (global order) first, then the obstacle
/// vertices.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CollisionModel {
    /// Distance below which cloth repels, meters.
    pub thickness_m: f64,
    /// Stiffness of contacts in effective masses per step^2.
    pub stiffness: f64,
    /// Distance that impact zones leave per hit, meters, if it is less than that of the thickness.
    pub margin_m: Option<f64>,
    /// Pins of all ranks.
    pub pins: Vec<PinSpan>,
    /// Byte limit of the tables of a query on a rank; queries that need more are split into batches.
    pub memory_limit_bytes: Option<u64>,
    obstacle_header: ObstacleHeader,
    /// Bulk data; sent unserialized after the header.
    #[serde(skip)]
    pub arrays: CollisionArrays,
}

/// Flat arrays of a [`CollisionModel`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CollisionArrays {
    /// Cloth triangles, global rows.
    pub triangles: Vec<[u32; 3]>,
    /// Smallest altitude of each triangle at rest, meters.
    pub altitudes_m: Vec<f32>,
    /// Masses of all rows, kg.
    pub masses: Vec<f32>,
    /// Friction coefficients of all rows.
    pub friction: Vec<f32>,
    /// Factors of all rows on the friction of obstacles; empty where they are 1.
    pub friction_factors: Vec<f32>,
    /// Factors of all rows on the thickness; empty where they are 1.
    pub thickness_factors: Vec<f32>,
    /// Obstacle positions, as [`Obstacles::arrays`] gives them.
    pub obstacle_positions: Vec<f32>,
    /// Obstacle triangles, numbered over the obstacles.
    pub obstacle_triangles: Vec<[u32; 3]>,
    /// Rows that seams make one.
    pub sewn: Vec<[u32; 2]>,
    /// Pairs of a row and a row of a seam that it is near along the cloth, ascending.
    pub near_sewn: Vec<[u32; 2]>,
}

impl CollisionModel {
    /// Collision model of a whole cloth.
    pub fn new(model: &GlobalModel) -> CollisionModel {
        let altitudes_m = model.triangles.iter().map(|e| e.smallest_altitude_m()).collect();
        let (positions, _) = model.obstacles.arrays();
        let sewn: Vec<[u32; 2]> = model.stitches.iter().map(|stitch| stitch.vertices).collect();
        let sides = model.triangles.iter().map(|triangle| (triangle.vertices, triangle.sides_m()));
        let reach = Reach { rings: 1, beyond_m: REACH * model.settings.thickness_m };
        let near_sewn = near_seams(sides, model.rows(), sewn.iter().flatten().copied(), reach);
        let arrays = CollisionArrays {
            triangles: model.triangles.iter().map(|e| e.vertices).collect(),
            altitudes_m,
            masses: model.masses.clone(),
            friction: model.friction.clone(),
            friction_factors: model.factors[0].clone(),
            thickness_factors: model.factors[1].clone(),
            obstacle_positions: positions.to_vec(),
            obstacle_triangles: model.obstacles.welded_triangles(),
            sewn,
            near_sewn,
        };
        CollisionModel {
            thickness_m: model.settings.thickness_m,
            stiffness: model.settings.contact_stiffness,
            // Threads draw sides together in every step; what zones leave between them must not hold a seam open.
            margin_m: model.closing.map(|closing| SEWN_MARGIN * closing.last_m),
            pins: model.pins.iter().filter(|pin| pin.stiffness_n_m.is_none()).map(PinSpan::of).collect(),
            memory_limit_bytes: None,
            obstacle_header: model.obstacles.header().clone(),
            arrays,
        }
    }

    /// Builds the obstacles and leaves their arrays empty. None if the arrays do not fit the header.
    pub fn take_obstacles(&mut self) -> Option<Obstacles> {
        let positions = std::mem::take(&mut self.arrays.obstacle_positions);
        let triangles = std::mem::take(&mut self.arrays.obstacle_triangles);
        Obstacles::from_parts(self.obstacle_header.clone(), positions, triangles)
    }

    /// Inverse masses of the rows during a step, 1/kg: 0 for held rows. `touching`: rows of all ranks that are held
    /// since they touched an obstacle, ascending.
    pub fn inverse_masses(&self, start_s: f64, step_s: f64, touching: &[u32], out: &mut [f32]) {
        for (inverse, mass) in out.iter_mut().zip(&self.arrays.masses) {
            *inverse = 1.0 / mass;
        }
        let is_on = |pin: &&PinSpan| !pin.on_touch || touching.binary_search(&pin.row).is_ok();
        for pin in self.pins.iter().filter(|pin| is_held((pin.start_s, pin.end_s), start_s, step_s)).filter(is_on) {
            out[pin.row as usize] = 0.0;
        }
    }
}

impl CollisionArrays {
    /// The arrays as bytes, in a fixed order.
    pub fn to_bytes(&self) -> [&[u8]; 10] {
        [
            bytemuck::cast_slice(&self.triangles),
            bytemuck::cast_slice(&self.altitudes_m),
            bytemuck::cast_slice(&self.masses),
            bytemuck::cast_slice(&self.friction),
            bytemuck::cast_slice(&self.obstacle_positions),
            bytemuck::cast_slice(&self.obstacle_triangles),
            bytemuck::cast_slice(&self.sewn),
            bytemuck::cast_slice(&self.friction_factors),
            bytemuck::cast_slice(&self.thickness_factors),
            bytemuck::cast_slice(&self.near_sewn),
        ]
    }
}
