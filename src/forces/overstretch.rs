//! What of a triangle is beyond the strain limits of its fabric, and which way it is pulled back. Host code for both
//! executors: `step` needs it for the few triangles that a solve leaves far beyond their limits.

use super::element::{FREE, FabricTable, TriangleElement};
use super::fiber_cpu::{MohrCircle, deformation};
use crate::math::{Vec2, Vec3};

/// A strain beyond a limit. It grows by the dot product of [`Overstretch::gradient`] with the displacement of a corner.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Overstretch {
    /// Stretch beyond the limit, of shear half the sine beyond that of the limit; 0 = within.
    pub strain: f32,
    along_u: Vec3,
    along_v: Vec3,
}

impl Overstretch {
    /// Of a corner with these weights ([`TriangleElement::corner_weights`]), 1/m.
    pub fn gradient(&self, [u, v]: [f32; 2]) -> Vec3 {
        self.along_u * u + self.along_v * v
    }
}

/// The largest strain of [`overstretch`]. Nearly all triangles are within limits that are the same in every direction,
/// and are done after a few products.
#[inline]
pub fn largest_overstretch(fabric: &FabricTable, element: &TriangleElement, corners: [Vec3; 3]) -> f32 {
    if fabric.has_fibers() {
        let [u, v] = deformation(element, corners);
        let [least, most] = fabric.strain_limit;
        if MohrCircle::new(u.dot(u), v.dot(v), u.dot(v)).is_within(least * least, most * most) {
            return 0.0;
        }
    }
    overstretch(fabric, element, corners).iter().map(|one| one.strain).fold(0.0, f32::max)
}

/// What is beyond the limits of `fabric` in a triangle with these corners: at most two principal stretches, or warp,
/// weft and shear.
pub fn overstretch(fabric: &FabricTable, element: &TriangleElement, corners: [Vec3; 3]) -> [Overstretch; 3] {
    let mut found = [Overstretch::default(); 3];
    if !fabric.is_limited() {
        return found;
    }
    let [u, v] = deformation(element, corners);
    if fabric.has_fibers() {
        let circle = MohrCircle::new(u.dot(u), v.dot(v), u.dot(v));
        let [least, most] = fabric.strain_limit;
        if circle.is_within(least * least, most * most) {
            return found;
        }
        let ([largest, smallest], first) = (circle.principal(), circle.wide_direction());
        found[0] = of_stretch([u, v], first, fabric.strain_limit, largest);
        found[1] = of_stretch([u, v], Vec2::new(-first.y, first.x), fabric.strain_limit, smallest);
        return found;
    }
    found[0] = of_stretch([u, v], Vec2::X, fabric.warp_limit, u.dot(u));
    found[1] = of_stretch([u, v], Vec2::Y, fabric.weft_limit, v.dot(v));
    let lengths = (u.dot(u) * v.dot(v)).sqrt();
    let sine = if lengths > 0.0 { u.dot(v) / lengths } else { 0.0 };
    let strain = 0.5 * (sine.abs() - fabric.shear_limit);
    if strain > 0.0 {
        let scale = 0.5 * sine.signum() / lengths;
        found[2] = Overstretch { strain, along_u: v * scale, along_v: u * scale };
    }
    found
}

/// Of the stretch along `d` (material space), whose square is `squared`.
fn of_stretch(f: [Vec3; 2], d: Vec2, [least, most]: [f32; 2], squared: f32) -> Overstretch {
    let stretch = squared.max(0.0).sqrt();
    let (strain, sign) = if stretch > most {
        (stretch - most, 1.0)
    } else if stretch < least {
        (least - stretch, -1.0)
    } else {
        return Overstretch::default();
    };
    // A triangle that has been pressed to nothing does not say which way it opens.
    let n = (f[0] * d.x + f[1] * d.y) * (sign / stretch.max(1.0 / FREE));
    Overstretch { strain, along_u: n * d.x, along_v: n * d.y }
}

#[cfg(test)]
mod tests {
    use super::super::element::triangle_element;
    use super::*;
    use crate::scene::{Fabric, StrainLimit};

    const UV: [Vec2; 3] = [Vec2::new(0.01, 0.02), Vec2::new(0.06, 0.01), Vec2::new(0.03, 0.07)];

    fn fabric(limit: StrainLimit) -> FabricTable {
        FabricTable::from(&Fabric { strain_limit: Some(limit), ..Fabric::uniform("f", 0.1, [100.0; 4], 1e-5) })
    }

    /// A displacement of every corner along its gradient changes the strain as the gradients say.
    #[test]
    fn gradients_are_differences() {
        let element = triangle_element([0, 1, 2], 0, UV);
        let along = StrainLimit::Along { warp: Some([0.95, 1.02]), weft: Some([0.9, 1.03]), shear_deg: Some(5.0) };
        for fabric in [fabric(StrainLimit::Every([0.9, 1.05])), fabric(along)] {
            let at = |p: Vec2| Vec3::new(1.2 * p.x + 0.3 * p.y, 0.8 * p.y - 0.1 * p.x, 0.2 * p.x + 0.1 * p.y);
            let corners = UV.map(at);
            let found = overstretch(&fabric, &element, corners);
            assert!(found.iter().filter(|one| one.strain > 0.0).count() >= 2, "{found:?}");
            for (i, one) in found.iter().enumerate().filter(|(_, one)| one.strain > 0.0) {
                let gradients = element.corner_weights().map(|weights| one.gradient(weights));
                let sum: Vec3 = gradients.iter().sum();
                assert!(sum.length() < 1e-3 * gradients[0].length(), "a shift stretches nothing: {sum}");
                for a in 0..3 {
                    let step = gradients[a].normalize() * 1e-4;
                    let moved = |by: Vec3| {
                        let mut corners = corners;
                        corners[a] += by;
                        overstretch(&fabric, &element, corners)[i].strain
                    };
                    let (slope, expected) = ((moved(step) - moved(-step)) / 2e-4, gradients[a].length());
                    // The limit of shear goes with the lengths of the threads, whose change the gradient leaves out.
                    let off = if i == 2 { 0.3 } else { 0.02 };
                    assert!((slope - expected).abs() < off * expected, "{i}, corner {a}: {slope} {expected}");
                }
            }
        }
    }

    #[test]
    fn what_is_within_the_limits_is_not_overstretched() {
        let element = triangle_element([0, 1, 2], 0, UV);
        let flat = |u: f32, v: f32| UV.map(|p| Vec3::new(u * p.x, v * p.y, 0.0));
        let every = fabric(StrainLimit::Every([0.9, 1.05]));
        assert_eq!(largest_overstretch(&every, &element, flat(1.04, 0.91)), 0.0);
        assert!((largest_overstretch(&every, &element, flat(1.08, 0.85)) - 0.05).abs() < 1e-5);
        assert!(overstretch(&every, &element, flat(1.04, 0.91)).iter().all(|one| one.strain == 0.0));
        let found = overstretch(&every, &element, flat(1.08, 0.85));
        assert!((found[0].strain - 0.03).abs() < 1e-5 && (found[1].strain - 0.05).abs() < 1e-5, "{found:?}");
        let warp = fabric(StrainLimit::Along { warp: Some([0.9, 1.05]), weft: None, shear_deg: None });
        assert!(overstretch(&warp, &element, flat(1.04, 3.0)).iter().all(|one| one.strain == 0.0));
        assert!((overstretch(&warp, &element, flat(1.08, 3.0))[0].strain - 0.03).abs() < 1e-5);
    }
}
