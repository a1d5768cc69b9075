//! What a level set is, and its points near a given one.

use crate::math::DVec3;

/// A function of space. Its slope must not be above 2, and about 1 near its zeros.
pub type Field<'a> = dyn Fn(DVec3) -> f64 + 'a;

/// A surface to be meshed.
pub struct LevelSet<'a> {
    /// Negative inside, zero on the surface.
    pub inside: &'a Field<'a>,
    /// The surface is kept where this is not negative; none: all of it, closed.
    pub keep: Option<&'a Field<'a>>,
    /// A box that holds the surface, lowest and highest corner, meters.
    pub bounds: [DVec3; 2],
}

impl LevelSet<'_> {
    /// A point of the surface near `p`, by so many Newton steps that are no longer than `reach`.
    pub(super) fn onto(&self, mut p: DVec3, reach: f64, steps: usize) -> DVec3 {
        for _ in 0..steps {
            let (value, slope) = slope(self.inside, p);
            p -= (slope * (value / slope.length_squared().max(0.01))).clamp_length_max(reach);
        }
        p
    }

    /// Like [`LevelSet::onto`], to the rim where the surface is cut.
    pub(super) fn onto_rim(&self, mut p: DVec3, reach: f64, steps: usize) -> DVec3 {
        for _ in 0..steps {
            if let Some(keep) = self.keep {
                let normal = slope(self.inside, p).1.normalize_or_zero();
                let (value, slope) = slope(keep, p);
                let within = slope - normal * slope.dot(normal);
                // Where the cut runs along the surface there is no step.
                let length = within.length_squared();
                p -= if length < 0.01 { DVec3::ZERO } else { (within * (value / length)).clamp_length_max(reach) };
            }
            p = self.onto(p, reach, 1);
        }
        p
    }
}

/// Value and slope of a function.
fn slope(field: &Field, p: DVec3) -> (f64, DVec3) {
    /// Distance over which slopes are taken, meters.
    const DIFFERENCE: f64 = 1e-6;
    let value = field(p);
    let along = |axis: DVec3| (field(p + axis * DIFFERENCE) - value) / DIFFERENCE;
    (value, DVec3::new(along(DVec3::X), along(DVec3::Y), along(DVec3::Z)))
}
