//! CPU twin of `crease.wgsl`: the return map of every hinge; `crease` explains it.

use super::bend_cpu::dihedral_angle;
use super::element::{FabricTable, HingeElement, vertex};
use crate::gpu::CpuExecutor;

/// Moves the angles at rest of `elements`, and sets `damage` where they moved. Bytes per hinge: 48 element + 48
/// positions read, 52 written.
pub(super) fn crease(
    cpu: &CpuExecutor,
    fabrics: &[FabricTable],
    positions: &[f32],
    elements: &mut [HingeElement],
    damage: &mut [f32],
) {
    cpu.for_ranges_mut(elements, 1, 64, |_, elements| {
        for element in elements {
            let fabric = FabricTable::yields_first(element.fabric.map(|of_side| &fabrics[of_side as usize]));
            if fabric.yield_curvature > 0.0 {
                let (angle, _) = dihedral_angle(element.vertices.map(|v| vertex(positions, v)));
                return_map(fabric, angle, element);
            }
        }
    });
    let elements: &[HingeElement] = elements;
    cpu.for_ranges_mut(damage, 1, 64, |range, damage| {
        for (element, damage) in elements[range].iter().zip(damage) {
            *damage = super::crease::damage(fabrics, element);
        }
    });
}

/// The return map of a hinge at `angle`, radians.
fn return_map(fabric: &FabricTable, angle: f32, element: &mut HingeElement) {
    let curvature = element.curvature_from_angle * (angle - element.rest_angle);
    let excess = curvature.abs() - (fabric.yield_curvature + fabric.hardening * element.plastic_curvature);
    if excess > 0.0 {
        let change = excess / (1.0 + fabric.hardening);
        element.rest_angle += change.copysign(curvature) / element.curvature_from_angle;
        element.plastic_curvature += change;
    }
}

#[cfg(test)]
mod tests {
    use super::super::element::hinge_element;
    use super::*;
    use crate::math::Vec2;
    use crate::scene::{Fabric, Plasticity};

    /// A hinge of 1 cm between triangles of 50 mm^2: c = 100 1/m.
    fn hinge() -> HingeElement {
        hinge_element([0, 1, 2, 3], [0, 0], [[Vec2::ZERO, Vec2::new(0.01, 0.0)]; 2], [5e-5; 2], 0.0)
    }

    fn yields_at(yield_curvature_1_m: f64, hardening: f64, weakening: f64) -> FabricTable {
        let plasticity = Some(Plasticity { yield_curvature_1_m, hardening, weakening, ..Plasticity::NONE });
        FabricTable::from(&Fabric { plasticity, ..Fabric::uniform("f", 0.1, [1.0; 4], 1e-5) })
    }

    #[test]
    fn below_yield_nothing_moves_and_above_it_the_rest_follows_the_map() {
        let mut element = hinge();
        return_map(&yields_at(50.0, 0.0, 0.0), 0.49, &mut element);
        assert_eq!(element, hinge());
        // kappa = 80: 30 too much without hardening; with H = 0.5 the surface moves halfway.
        return_map(&yields_at(50.0, 0.0, 0.0), -0.8, &mut element);
        assert!((element.rest_angle + 0.3).abs() < 1e-6 && (element.plastic_curvature - 30.0).abs() < 1e-4);
        let mut element = hinge();
        return_map(&yields_at(50.0, 0.5, 0.0), 0.8, &mut element);
        assert!((element.rest_angle - 0.2).abs() < 1e-6 && (element.plastic_curvature - 20.0).abs() < 1e-4);
    }

    /// The path from 0 to 1.2 rad and back to 0 in any number of steps ends alike: 1.2 - 0.5 forth and, as the way back
    /// bends by 0.7 rad, 0.2 of it back.
    #[test]
    fn the_map_does_not_depend_on_the_number_of_steps() {
        for steps in [1, 7, 100] {
            let mut element = hinge();
            let way = (1..=steps).map(|i| i as f32 / steps as f32);
            way.clone().map(|s| 1.2 * s).chain(way.map(|s| 1.2 * (1.0 - s))).for_each(|angle| {
                return_map(&yields_at(50.0, 0.0, 0.0), angle, &mut element);
            });
            assert!((element.rest_angle - 0.5).abs() < 1e-5, "{steps} steps: {}", element.rest_angle);
            assert!((element.plastic_curvature - 90.0).abs() < 1e-2, "{steps} steps: {}", element.plastic_curvature);
        }
    }

    #[test]
    fn weakening_divides_the_stiffness() {
        assert_eq!(yields_at(50.0, 0.0, 2.0).weakened(25.0), 0.5);
        assert_eq!(yields_at(50.0, 0.0, 0.0).weakened(25.0), 1.0);
        let (soft, stiff, elastic) = (yields_at(20.0, 0.0, 0.0), yields_at(50.0, 0.0, 0.0), {
            FabricTable::from(&Fabric::uniform("f", 0.1, [1.0; 4], 1e-5))
        });
        for pair in [[&soft, &stiff], [&stiff, &soft], [&elastic, &soft], [&soft, &elastic]] {
            assert_eq!(FabricTable::yields_first(pair).yield_curvature, 20.0);
        }
    }
}
