//! CPU twin of `plastic_stretch.wgsl`: the return map of every triangle, and its damage; `plastic_stretch` explains it.

use super::element::{FabricTable, TriangleElement, vertex};
use super::fiber_cpu::{MohrCircle, deformation};
use super::plastic_stretch::{NO_HINGE, PlasticTriangle};
use crate::gpu::CpuExecutor;
use crate::math::{Vec2, Vec3};

/// Largest principal value of a rest stretch; the smallest one is its inverse.
const STRETCH_MOST: f32 = 3.0;
/// Least square of a stretch that is told from none.
const SQUARED_LEAST: f32 = 1e-4;

/// Moves the rest stretches of `plastic`, if they `move`, and sets weights and damage of `elements`. Bytes per
/// triangle: 48 element + 48 plastic + 36 positions + 12 damage read, 96 written.
pub(super) fn plastic_stretch(
    cpu: &CpuExecutor,
    moves: bool,
    fabrics: &[FabricTable],
    positions: &[f32],
    hinge_damage: &[f32],
    plastic: &mut [PlasticTriangle],
    elements: &mut [TriangleElement],
) {
    let known: &[TriangleElement] = elements;
    cpu.for_ranges_mut(plastic, 1, 64, |range, plastic| {
        for (element, plastic) in known[range].iter().zip(plastic) {
            let fabric = &fabrics[element.fabric as usize];
            if moves && fabric.yield_strain > 0.0 {
                return_map(fabric, deformation(element, element.vertices.map(|v| vertex(positions, v))), plastic);
            }
        }
    });
    let plastic: &[PlasticTriangle] = plastic;
    cpu.for_ranges_mut(elements, 1, 64, |range, elements| {
        for (plastic, element) in plastic[range].iter().zip(elements) {
            take_up(&fabrics[element.fabric as usize], plastic, hinge_damage, element);
        }
    });
}

/// Sets weights and damage of an element.
fn take_up(fabric: &FabricTable, plastic: &PlasticTriangle, hinge_damage: &[f32], element: &mut TriangleElement) {
    let mut damage = 0.0;
    if fabric.yield_strain > 0.0 {
        let [uu, vv, uv] = plastic.stretch;
        let determinant = uu * vv - uv * uv;
        let (iuu, ivv, iuv) = (vv / determinant, uu / determinant, -uv / determinant);
        for i in 0..2 {
            let (u, v) = (plastic.weights_u[i], plastic.weights_v[i]);
            element.weights_u[i] = u * iuu + v * iuv;
            element.weights_v[i] = u * iuv + v * ivv;
        }
        damage = plastic.plastic_strain / fabric.yield_strain;
    }
    if fabric.weakening > 0.0 {
        let of_hinge = |&hinge: &u32| if hinge == NO_HINGE { 0.0 } else { hinge_damage[hinge as usize] };
        let of_hinges = plastic.hinges.iter().map(of_hinge).fold(0.0, f32::max);
        element.damage = fabric.weakening * (damage + of_hinges);
    }
}

/// The return map of a triangle with the elastic deformation `[x_u, x_v]`.
fn return_map(fabric: &FabricTable, [u, v]: [Vec3; 2], plastic: &mut PlasticTriangle) {
    let (squared, d) = principal([u.dot(u), v.dot(v), u.dot(v)]);
    let strains = squared.map(|squared| 0.5 * squared.max(SQUARED_LEAST).ln());
    let excess = excess(strains.map(f32::abs), fabric, plastic.plastic_strain);
    if excess == [0.0; 2] {
        return;
    }
    let twice = [0, 1].map(|i| (2.0 * excess[i].copysign(strains[i])).exp());
    let [auu, avv, auv] = of_principal(twice, d);
    let [uu, vv, uv] = plastic.stretch;
    // The rows of A^2 U, then U A^2 U.
    let (row0, row1) = ([auu * uu + auv * uv, auu * uv + auv * vv], [auv * uu + avv * uv, auv * uv + avv * vv]);
    let squared = [uu * row0[0] + uv * row1[0], uv * row0[1] + vv * row1[1], uu * row0[1] + uv * row1[1]];
    let (values, d) = principal(squared);
    let roots = values.map(|value| value.max(0.0).sqrt().clamp(1.0 / STRETCH_MOST, STRETCH_MOST));
    plastic.stretch = of_principal(roots, d);
    plastic.plastic_strain += excess[0] + excess[1];
}

/// Strains that are beyond the yield surface, for strains with these `sizes`; zero if nothing yields.
fn excess(sizes: [f32; 2], fabric: &FabricTable, plastic_strain: f32) -> [f32; 2] {
    let (y, h) = (fabric.yield_strain, fabric.hardening);
    let (larger, smaller) = (sizes[0].max(sizes[1]), sizes[0].min(sizes[1]));
    if larger <= y + h * plastic_strain {
        return [0.0; 2];
    }
    let mut surface = (y + h * (plastic_strain + larger)) / (1.0 + h);
    if smaller > surface {
        surface = (y + h * (plastic_strain + larger + smaller)) / (1.0 + 2.0 * h);
    }
    sizes.map(|size| (size - surface).max(0.0))
}

/// Principal values of a symmetric matrix (uu, vv, uv), the larger one first, and the direction of that.
fn principal([uu, vv, uv]: [f32; 3]) -> ([f32; 2], Vec2) {
    let circle = MohrCircle::new(uu, vv, uv);
    (circle.principal(), circle.wide_direction())
}

/// The symmetric matrix with the first of these principal values along `d` and the second across it.
fn of_principal([first, second]: [f32; 2], d: Vec2) -> [f32; 3] {
    let (xx, yy) = (d.x * d.x, d.y * d.y);
    [first * xx + second * yy, first * yy + second * xx, (first - second) * d.x * d.y]
}

#[cfg(test)]
mod tests {
    use super::super::element::triangle_element;
    use super::*;
    use crate::scene::{Fabric, Plasticity};

    const UV: [Vec2; 3] = [Vec2::new(0.01, 0.02), Vec2::new(0.06, 0.01), Vec2::new(0.03, 0.07)];

    fn fabric(yield_strain: f64, hardening: f64, weakening: f64) -> FabricTable {
        let plasticity = Some(Plasticity { yield_strain, hardening, weakening, ..Plasticity::NONE });
        FabricTable::from(&Fabric { plasticity, ..Fabric::uniform("f", 0.1, [1.0; 4], 1e-5) })
    }

    /// A triangle that is stretched along the direction at `angle` by every one of `stretches` in turn, by
    /// `across` across it, and turned in space: its plastic state and its element.
    fn stretched(
        fabric: &FabricTable,
        angle: f32,
        stretches: &[f32],
        across: f32,
    ) -> (PlasticTriangle, TriangleElement) {
        let mut elements = [triangle_element([0, 1, 2], 0, UV)];
        let mut plastic = [PlasticTriangle::new(&elements[0], [0, NO_HINGE, NO_HINGE])];
        let (d, n) = (Vec2::from_angle(angle), Vec2::from_angle(angle).perp());
        for (turn, stretch) in stretches.iter().enumerate() {
            let (sin, cos) = (0.3 * turn as f32).sin_cos();
            let at = |p: Vec2| {
                let (along, across) = (stretch * p.dot(d), across * p.dot(n));
                [cos * along - sin * across, 0.3, sin * along + cos * across]
            };
            let positions: Vec<f32> = UV.iter().flat_map(|&p| at(p)).collect();
            let cpu = CpuExecutor::new(1);
            plastic_stretch(&cpu, true, &[*fabric], &positions, &[0.5], &mut plastic, &mut elements);
        }
        (plastic[0], elements[0])
    }

    #[test]
    fn below_yield_nothing_moves_and_above_it_the_rest_follows_the_map() {
        for angle in [0.0, 0.4, 1.2, 2.5] {
            let (plastic, element) = stretched(&fabric(0.05, 0.0, 0.0), angle, &[1.049, 0.96], 1.0);
            assert_eq!((plastic.stretch, plastic.plastic_strain), ([1.0, 1.0, 0.0], 0.0));
            assert_eq!(element, triangle_element([0, 1, 2], 0, UV));
            for (hardening, ways) in [(0.0f32, &[1.3f32][..]), (0.5, &[1.3]), (0.5, &[1.1, 1.2, 1.3])] {
                let (plastic, element) = stretched(&fabric(0.05, hardening.into(), 0.0), angle, ways, 1.0);
                let strain = ((1.3f32 / 1.05).ln()) / (1.0 + hardening);
                assert!((plastic.plastic_strain - strain).abs() < 1e-5, "{plastic:?}");
                let expected = of_principal([strain.exp(), 1.0], Vec2::from_angle(angle));
                let off = plastic.stretch.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(off < 2e-5, "{:?} instead of {expected:?}", plastic.stretch);
                // In that shape it is at rest.
                let [u, v] = deformation(
                    &element,
                    UV.map(|p| {
                        let [uu, vv, uv] = plastic.stretch;
                        Vec3::new(uu * p.x + uv * p.y, uv * p.x + vv * p.y, 0.0)
                    }),
                );
                assert!((u - Vec3::X).length() < 1e-5 && (v - Vec3::Y).length() < 1e-5, "{u} {v}");
            }
        }
    }

    /// Both directions yield together, one longer and one shorter; what is far out stays within the bounds.
    #[test]
    fn two_directions_share_the_surface() {
        let (y, h) = (0.05f32.ln_1p(), 0.25f32);
        let (plastic, _) = stretched(&fabric(0.05, h.into(), 0.0), 0.7, &[1.4], 0.8);
        let sizes = [1.4f32.ln(), -(0.8f32.ln())];
        let surface = (y + h * (sizes[0] + sizes[1])) / (1.0 + 2.0 * h);
        let (values, _) = principal(plastic.stretch);
        assert!((values[0].ln() - (sizes[0] - surface)).abs() < 1e-5, "{values:?}");
        assert!((values[1].ln() + (sizes[1] - surface)).abs() < 1e-5, "{values:?}");
        let (plastic, _) = stretched(&fabric(0.05, 0.0, 0.0), 0.7, &[9.0, 20.0], 1e-3);
        let (values, _) = principal(plastic.stretch);
        assert!((values[0] - 3.0).abs() < 1e-4 && (values[1] - 1.0 / 3.0).abs() < 1e-4, "{values:?}");
    }

    #[test]
    fn damage_is_of_strain_and_of_the_hinge() {
        let (plastic, element) = stretched(&fabric(0.05, 0.0, 2.0), 0.0, &[1.3], 1.0);
        let expected = 2.0 * (plastic.plastic_strain / 0.05f32.ln_1p() + 0.5);
        assert!((element.damage - expected).abs() < 1e-5, "{} instead of {expected}", element.damage);
        assert_eq!(stretched(&fabric(0.05, 0.0, 0.0), 0.0, &[1.3], 1.0).1.damage, 0.0);
    }
}
