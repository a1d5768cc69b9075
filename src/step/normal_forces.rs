//! The normal forces that friction goes by: what the contacts of a first solve really press with, added up as vectors
//! vertex by vertex.
//!
//! These forces balance what presses. What the barriers give at the gaps of a second solve would be more on average,
//! since a barrier is convex and gaps waver as facets pass each other; so would be the sum of the pushes alone, as
//! linear contacts of one vertex also pull while others push too hard, and the sum of the magnitudes over a ridge,
//! where normals differ. Each contact of the second solve gets the share of its barrier in what its vertices press
//! with.
//!
//! Every rank adds up its own rows; the ratios to the barriers, one float a row, go to all ranks.

use std::ops::Range;

use crate::forces::{ContactElement, LinearBarrier, NO_VERTEX, linearized};
use crate::math::Vec3;

/// Most that the friction of a contact may be of what its own barrier gives.
const SCALE_MOST: f32 = 100.0;

/// Normal forces on a rank's own rows.
pub(super) struct NormalForces {
    own: Range<usize>,
    /// Contacts that push in the solve under way, with the force that it solves for; vertices in global numbers.
    solved: Vec<(ContactElement, LinearBarrier)>,
    /// N, of the first solve.
    first: Vec<Vec3>,
    /// Of every row of the cloth: what it presses with, of what its contacts' barriers give.
    pub scale: Vec<f32>,
}

/// The gap of a contact at the positions `x`, if it is `distance_m` at `x_t0`.
fn gap_m(element: &ContactElement, x_t0: &[f32], x: &[f32]) -> f32 {
    let at = |x: &[f32], v: u32| Vec3::from_slice(&x[3 * v as usize..]);
    let present = element.vertices.iter().zip(element.weights).filter(|(v, _)| **v != NO_VERTEX);
    let parting = present.fold(Vec3::ZERO, |sum, (&v, weight)| sum + weight * (at(x, v) - at(x_t0, v)));
    element.distance_m + parting.dot(Vec3::from(element.normal))
}

impl NormalForces {
    pub(super) fn new(own: Range<usize>, rows: usize) -> NormalForces {
        let first = vec![Vec3::ZERO; own.len()];
        NormalForces { own, solved: Vec::new(), first, scale: vec![0.0; rows] }
    }

    /// The contacts of a first solve. `ahead`: where velocities lead and, where vertices can `fall`, their fall of
    /// `fall_m`.
    pub(super) fn take_first(
        &mut self,
        elements: &[ContactElement],
        x_t0: &[f32],
        ahead: &[f32],
        fall_m: Vec3,
        falls: impl Fn(u32) -> bool,
        ratio: f32,
    ) {
        self.solved.clear();
        for element in elements {
            let present = element.vertices.iter().zip(element.weights).filter(|(v, _)| **v != NO_VERTEX);
            let (mut cloth, mut falling) = (0.0, 0.0);
            for (&v, weight) in present {
                // Rows of the cloth, then obstacles.
                cloth += if (v as usize) < self.scale.len() { weight } else { 0.0 };
                falling += if falls(v) { weight } else { 0.0 };
            }
            let fall_m = fall_m.dot(Vec3::from(element.normal));
            let free_m = gap_m(element, x_t0, ahead) - falling * fall_m;
            let barrier = linearized(element, free_m, ratio, false);
            if barrier.at(free_m + cloth * fall_m) > 0.0 {
                self.solved.push((*element, barrier));
            }
        }
    }

    /// The first solve ends at `x_t1`.
    pub(super) fn first_ends(&mut self, x_t0: &[f32], x_t1: &[f32]) {
        self.first.fill(Vec3::ZERO);
        for (element, barrier) in &self.solved {
            let force = Vec3::from(element.normal) * barrier.at(gap_m(element, x_t0, x_t1));
            for (&v, weight) in element.vertices.iter().zip(element.weights) {
                if self.own.contains(&(v as usize)) {
                    self.first[v as usize - self.own.start] += weight * force;
                }
            }
        }
    }

    /// The scales of the own rows for the contacts of a second solve, which starts from `x_t1`.
    pub(super) fn take_again(&mut self, elements: &[ContactElement], x_t0: &[f32], x_t1: &[f32], ratio: f32) {
        let mut sums = vec![(0.0f32, Vec3::ZERO); self.own.len()];
        for element in elements {
            let free_m = gap_m(element, x_t0, x_t1);
            let push = linearized(element, free_m, ratio, true).at(free_m).max(0.0);
            for (&v, weight) in element.vertices.iter().zip(element.weights) {
                if self.own.contains(&(v as usize)) {
                    let (sum, direction) = &mut sums[v as usize - self.own.start];
                    *sum += weight.abs() * push;
                    *direction += weight * push * Vec3::from(element.normal);
                }
            }
        }
        let scales = &mut self.scale[self.own.clone()];
        for ((scale, &presses), (sum, direction)) in scales.iter_mut().zip(&self.first).zip(sums) {
            let toward = presses.dot(direction) > 0.0;
            *scale = if toward { (presses.length() / sum).min(SCALE_MOST) } else { 0.0 };
        }
    }

    /// Friction coefficients of a second solve's contacts, times what their vertices press with, of what their barriers
    /// give.
    pub(super) fn scale(&self, elements: &mut [ContactElement]) {
        for element in elements {
            let (mut sum, mut weights) = (0.0, 0.0);
            for (&v, weight) in element.vertices.iter().zip(element.weights) {
                if let Some(scale) = self.scale.get(v as usize) {
                    sum += weight.abs() * scale;
                    weights += weight.abs();
                }
            }
            element.friction *= if weights > 0.0 { sum / weights } else { 0.0 };
        }
    }
}
