//! Round cones, and the smooth shape that many of them make together.

use crate::math::DVec3;

/// A ball that grows or shrinks on a straight way.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Cone {
    pub ends: [DVec3; 2],
    pub radii: [f64; 2],
}

/// How softly cones flow into each other, meters.
pub(super) const SOFT_M: f64 = 0.012;
/// Beyond this many soft lengths a cone no longer counts.
const FAR: f64 = 20.0;

impl Cone {
    pub(super) fn new(from: [f64; 3], to: [f64; 3], radii: [f64; 2]) -> Cone {
        Cone { ends: [from.into(), to.into()], radii }
    }

    /// Its mirror image across the plane x = 0.
    pub(super) fn mirrored(&self) -> Cone {
        Cone { ends: self.ends.map(|p| DVec3::new(-p.x, p.y, p.z)), ..*self }
    }

    /// The cone with larger radii.
    pub(super) fn grown(&self, by: f64) -> Cone {
        Cone { radii: self.radii.map(|r| r + by), ..*self }
    }

    /// Distance from its surface, negative inside; close to it for cones that change their radius slowly.
    pub(super) fn distance(&self, p: DVec3) -> f64 {
        let [a, b] = self.ends;
        let along = b - a;
        let t = ((p - a).dot(along) / along.length_squared().max(1e-12)).clamp(0.0, 1.0);
        p.distance(a + along * t) - (self.radii[0] + t * (self.radii[1] - self.radii[0]))
    }

    /// Lowest and highest corner of a box around it.
    fn bounds(&self) -> [DVec3; 2] {
        let ends = [0, 1].map(|i| [self.ends[i] - self.radii[i], self.ends[i] + self.radii[i]]);
        [ends[0][0].min(ends[1][0]), ends[0][1].max(ends[1][1])]
    }
}

/// Distance from the surface of all cones together: no more than from any one of them, and smooth everywhere.
pub(super) fn blended(cones: &[Cone], p: DVec3) -> f64 {
    /// Cones whose distances are kept from the first round for the second.
    const KEPT: usize = 64;
    let mut kept = [0.0; KEPT];
    let mut least = f64::INFINITY;
    for (i, cone) in cones.iter().enumerate() {
        let distance = cone.distance(p);
        least = least.min(distance);
        kept[i % KEPT] = distance;
    }
    let mut sum = 0.0;
    for (i, cone) in cones.iter().enumerate() {
        let distance = if cones.len() <= KEPT { kept[i] } else { cone.distance(p) };
        let over = (distance - least) / SOFT_M;
        if over < FAR {
            sum += (-over).exp();
        }
    }
    least - SOFT_M * sum.ln()
}

/// Lowest and highest corner of a box around the shape of all cones.
pub(super) fn bounds(cones: &[Cone]) -> [DVec3; 2] {
    let room = SOFT_M * (cones.len() as f64).ln();
    let all = cones.iter().map(Cone::bounds);
    let [low, high] = all.fold([DVec3::INFINITY, DVec3::NEG_INFINITY], |[l, h], [a, b]| [l.min(a), h.max(b)]);
    [low - room, high + room]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cone_alone_is_itself_and_others_only_add() {
        let cone = Cone::new([0.0; 3], [0.0, 1.0, 0.0], [0.1, 0.3]);
        for (p, d) in [([0.5, 0.0, 0.0], 0.4), ([0.0, 2.0, 0.0], 0.7), ([0.2, 0.5, 0.0], 0.0), ([0.0, 0.0, 0.0], -0.1)]
        {
            assert!((cone.distance(p.into()) - d).abs() < 1e-12, "{p:?}");
            assert!((blended(&[cone], p.into()) - d).abs() < 1e-12, "{p:?}");
            let pair = [cone, cone.mirrored().grown(-0.02)];
            assert!(blended(&pair, p.into()) < d && blended(&pair, p.into()) > d - SOFT_M, "{p:?}");
        }
        assert_eq!(bounds(&[cone]), [DVec3::new(-0.3, -0.1, -0.3), DVec3::new(0.3, 1.3, 0.3)]);
    }
}
