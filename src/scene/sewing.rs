//! [`Sewing`]: the pairs of vertices that the seams of a scene draw together, and what is done once they have met.

use serde::{Deserialize, Serialize};

use crate::math::Vec3;

/// What the seams of a scene sew, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Sewing {
    /// Vertices of the scene's mesh that become one, ascending, each pair once with its smaller vertex first.
    pub pairs: Vec<[u32; 2]>,
    /// Names of the seams.
    pub names: Vec<String>,
    /// Dihedral angle at rest that the edges of each seam get, radians ([`super::Fold::angle`]).
    pub angles: Vec<f32>,
    /// The seam of every pair; of several the first.
    pub seam_of_pair: Vec<u32>,
    /// How the pairs are closed.
    pub closing: Closing,
    /// Lengths of the threads when they begin to shorten, meters, by pair; none: those at the start of the scene.
    pub first_m: Option<Vec<f32>>,
    /// The pairs become vertices at the first frame at which no vertex has farther to go than half of this, meters.
    pub weld_m: f64,
    /// Number of times that the triangles of the sewn cloth are then divided into four.
    pub refine: u32,
    /// Acceleration of gravity once the cloth is sewn, m/s^2.
    pub gravity_m_s2: Vec3,
}

/// Largest [`Closing::firmness`]: a thread pulled by a newton is then about 0.2 mm longer.
const FIRM: f64 = 10.0;

/// How fast seams close.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Closing {
    /// Time at which the threads have their first length, seconds.
    pub start_s: f64,
    /// Time from there until the threads have their last length, seconds.
    pub close_s: f64,
    /// Last length of a thread, meters.
    pub last_m: f64,
}

impl Closing {
    /// Share of the way from its first to its last length that a thread has shortened at a time (seconds).
    pub fn share(&self, time_s: f64) -> f64 {
        ((time_s - self.start_s) / self.close_s).clamp(0.0, 1.0)
    }

    /// Stiffness of the threads over that of the cloth that they sew: 1 until they have their last length, so that
    /// panels come together gently, then rising to `FIRM` within a quarter of that time, so that the tension of cloth
    /// that is a little short does not hold a seam open.
    pub fn firmness(&self, time_s: f64) -> f64 {
        1.0 + (FIRM - 1.0) * (4.0 * ((time_s - self.start_s) / self.close_s - 1.0)).clamp(0.0, 1.0)
    }

    /// Whether the threads are at their firmest at a time (seconds).
    pub fn is_firm(&self, time_s: f64) -> bool {
        self.firmness(time_s) >= FIRM
    }

    /// Change of [`Closing::share`], 1/s.
    pub fn share_rate(&self, time_s: f64) -> f64 {
        if time_s - self.start_s < self.close_s { 1.0 / self.close_s } else { 0.0 }
    }
}
