//! Finite-difference checks of both element kinds: forces against the energy, Jacobian blocks against the forces.

use super::element::{FabricTable, HINGE_RECORD_FLOATS, StepParams, TRIANGLE_RECORD_FLOATS};
use super::*;
use crate::gpu::CpuExecutor;
use crate::math::{Vec2, Vec3};
use crate::scene::Fabric;
use crate::test_support::seeded::Seeded;

/// An isotropic fabric: Young's modulus times thickness `eh` (N/m), Poisson's ratio `nu`, bending sample `bending` (N
/// m).
pub(super) fn isotropic(eh: f64, nu: f64, bending: f64) -> FabricTable {
    let c = eh / (1.0 - nu * nu);
    // Energy k3/2 E_uv^2 with E_uv counted once: k3 = 4 G h.
    let row = [c, nu * c, c, 2.0 * eh / (1.0 + nu)];
    FabricTable::from(&Fabric {
        name: "isotropic".into(),
        density_kg_m2: 0.1,
        stretching_n_m: [row; 6],
        bending_n_m: [[bending; 5]; 3],
        damping_s: 0.0,
        plasticity: None,
        strain_limit: None,
    })
}

fn still_air(step_s: f32, count: u32) -> StepParams {
    StepParams { step_s, air_density: 0.0, air_drag: 0.0, count, wind: [0.0; 3], ahead_s: step_s }
}

fn flat<const N: usize>(x: [Vec3; N]) -> Vec<f32> {
    x.iter().flat_map(|p| p.to_array()).collect()
}

/// Force on each corner, from the record.
fn triangle_forces(element: &TriangleElement, record: &[f32]) -> [Vec3; 3] {
    element.corner_weights().map(|[u, v]| {
        -(Vec3::from_slice(&record[16..19]) * u + Vec3::from_slice(&record[20..23]) * v)
            + Vec3::new(record[15], record[19], record[23])
    })
}

fn stretch_record(
    params: &StepParams,
    fabric: FabricTable,
    element: &TriangleElement,
    x: [Vec3; 3],
    v: [Vec3; 3],
) -> Vec<f32> {
    let mut record = vec![0.0; TRIANGLE_RECORD_FLOATS];
    stretch_cpu::stretch(&CpuExecutor::new(1), params, &[fabric], &[*element], &flat(x), &flat(v), &mut record);
    record
}

#[test]
fn stretch_force_is_the_negative_gradient_of_the_energy() {
    let mut random = Seeded::new(7);
    let fabric = isotropic(500.0, 0.3, 0.0);
    for _ in 0..50 {
        let element = triangle_element([0, 1, 2], 0, [Vec2::ZERO, Vec2::new(0.02, 0.003), Vec2::new(0.004, 0.015)]);
        let x: [Vec3; 3] = std::array::from_fn(|i| {
            let uv = [Vec2::ZERO, Vec2::new(0.02, 0.003), Vec2::new(0.004, 0.015)][i];
            Vec3::new(uv.x, uv.y, 0.0) + random.vector() * 0.004
        });
        let record = stretch_record(&still_air(0.0, 1), fabric, &element, x, [Vec3::ZERO; 3]);
        let forces = triangle_forces(&element, &record);
        let k = stretch_stiffness(&fabric, [0.0; 3]);
        let h = 1e-5;
        for corner in 0..3 {
            for axis in 0..3 {
                let energy = |sign: f32| {
                    let mut x = x;
                    x[corner][axis] += sign * h;
                    stretch_energy(&element, k, x)
                };
                let expected = -(energy(1.0) - energy(-1.0)) / (2.0 * h as f64);
                let scale = forces.iter().map(|f| f.length()).fold(1e-3, f32::max) as f64;
                assert!(
                    (forces[corner][axis] as f64 - expected).abs() < 5e-3 * scale,
                    "corner {corner} axis {axis}: {} {expected}",
                    forces[corner][axis]
                );
            }
        }
    }
}

#[test]
fn forces_of_a_free_element_balance() {
    let mut random = Seeded::new(3);
    let fabric = isotropic(300.0, 0.2, 1e-4);
    let mut point = || random.vector() * 0.01;
    let element = triangle_element([0, 1, 2], 0, [Vec2::ZERO, Vec2::new(0.01, 0.0), Vec2::new(0.0, 0.01)]);
    let record =
        stretch_record(&still_air(0.01, 1), fabric, &element, [point(), point(), point()], [point(), point(), point()]);
    let forces = triangle_forces(&element, &record);
    let scale: f32 = forces.iter().map(|f| f.length()).sum();
    assert!((forces[0] + forces[1] + forces[2]).length() < 1e-5 * scale);
}

/// A stretched, unsheared triangle has a positive definite stress, so the record's K is the exact negative Jacobian:
/// its action on a velocity (dt K v in P) must equal the change of the force along that velocity.
#[test]
fn stretch_jacobian_of_a_tensioned_triangle_matches_finite_differences() {
    let fabric = isotropic(500.0, 0.3, 0.0);
    let uv = [Vec2::ZERO, Vec2::new(0.02, 0.0), Vec2::new(0.0, 0.02)];
    let element = triangle_element([0, 1, 2], 0, uv);
    let x = uv.map(|p| Vec3::new(p.x * 1.1, p.y * 1.05 + p.x * 0.02, 0.3 * p.x));
    let v = [Vec3::new(0.1, 0.2, -0.3), Vec3::new(-0.2, 0.1, 0.4), Vec3::new(0.3, -0.1, 0.2)];
    let dt = 1e-4;
    let with = triangle_forces(&element, &stretch_record(&still_air(dt, 1), fabric, &element, x, v));
    let without = triangle_forces(&element, &stretch_record(&still_air(0.0, 1), fabric, &element, x, v));
    let at = |s: f32| {
        triangle_forces(
            &element,
            &stretch_record(&still_air(0.0, 1), fabric, &element, std::array::from_fn(|i| x[i] + v[i] * s), v),
        )
    };
    let (plus, minus) = (at(dt), at(-dt));
    for corner in 0..3 {
        let from_record = with[corner] - without[corner];
        let expected = (plus[corner] - minus[corner]) * 0.5;
        assert!(
            (from_record - expected).length() < 1e-2 * expected.length() + 1e-5,
            "corner {corner}: {from_record} {expected}"
        );
    }
}

#[test]
fn dihedral_gradient_matches_finite_differences() {
    let mut random = Seeded::new(11);
    for _ in 0..100 {
        let base = [Vec3::ZERO, Vec3::X, Vec3::new(0.4, 0.9, 0.0), Vec3::new(0.6, -0.8, 0.2)];
        let x = base.map(|p| p + random.vector() * 0.15);
        let (_, g) = dihedral_angle(x);
        for corner in 0..4 {
            for axis in 0..3 {
                let angle = |sign: f32| {
                    let mut x = x;
                    x[corner][axis] += sign * 1e-3;
                    dihedral_angle(x).0 as f64
                };
                let expected = (angle(1.0) - angle(-1.0)) / 2e-3;
                assert!(
                    (g[corner][axis] as f64 - expected).abs() < 5e-3,
                    "corner {corner} axis {axis}: {} {expected}",
                    g[corner][axis]
                );
            }
        }
        assert!((g[0] + g[1] + g[2] + g[3]).length() < 1e-5);
    }
}

#[test]
fn bending_moment_is_the_derivative_of_the_energy() {
    let fabric = [isotropic(0.0, 0.0, 2e-5)];
    let uv = [Vec2::ZERO, Vec2::new(0.01, 0.0)];
    let element = hinge_element([0, 1, 2, 3], [0, 0], [uv, uv], [5e-5, 5e-5], 0.1);
    let x = [Vec3::ZERO, Vec3::X * 0.01, Vec3::new(0.0, 0.01, 0.002), Vec3::new(0.01, -0.01, 0.001)];
    let mut record = vec![0.0; HINGE_RECORD_FLOATS];
    bend_cpu::bend(&CpuExecutor::new(1), &still_air(0.0, 1), &fabric, &[element], &flat(x), &[0.0; 12], &mut record);
    let angle = dihedral_angle(x).0;
    let h = 1e-3;
    let expected = (bend_energy(&fabric, &element, angle, angle + h)
        - bend_energy(&fabric, &element, angle, angle - h))
        / (2.0 * h as f64);
    assert!((record[7] as f64 - expected).abs() < 1e-3 * expected.abs(), "{} {expected}", record[7]);
}

/// The mean altitude at rest is 1 cm. A side of 5 % of it has its whole stiffness; below 2 % the largest entry of the
/// Jacobian grows no more.
#[test]
fn a_collapsed_side_bends_no_harder_than_a_thin_one() {
    let fabric = [isotropic(0.0, 0.0, 2e-5)];
    let uv = [Vec2::ZERO, Vec2::new(0.01, 0.0)];
    let element = hinge_element([0, 1, 2, 3], [0, 0], [uv, uv], [5e-5, 5e-5], 0.0);
    let largest = |altitude_m: f32| {
        let x = [Vec3::ZERO, Vec3::X * 0.01, Vec3::new(0.004, altitude_m, 0.0), Vec3::new(0.006, -0.01, 0.001)];
        let mut record = vec![0.0; HINGE_RECORD_FLOATS];
        let params = still_air(0.004, 1);
        bend_cpu::bend(&CpuExecutor::new(1), &params, &fabric, &[element], &flat(x), &[0.0; 12], &mut record);
        record[3] * Vec3::from_slice(&record[8..11]).length_squared()
    };
    let whole = largest(0.01);
    assert!((largest(5e-4) / whole - 400.0).abs() < 4.0, "{} of {whole}", largest(5e-4));
    for altitude_m in [2e-4, 1e-4, 1e-5, 1e-6, 1e-7] {
        assert!((largest(altitude_m) / whole - 2500.0).abs() < 25.0, "{altitude_m}: {}", largest(altitude_m) / whole);
    }
}

#[test]
fn measured_tables_give_a_positive_semidefinite_stiffness_at_every_strain() {
    let mut random = Seeded::new(5);
    for _ in 0..1000 {
        let row = || [0.0; 4];
        let mut rows = [row(); 6];
        rows.iter_mut().flatten().for_each(|k| *k = 200.0 * random.signed() as f64);
        let fabric = FabricTable::from(&Fabric {
            name: "random".into(),
            density_kg_m2: 0.1,
            stretching_n_m: rows,
            bending_n_m: [[0.0; 5]; 3],
            damping_s: 0.0,
            plasticity: None,
            strain_limit: None,
        });
        let [warp, cross, weft, shear] =
            stretch_stiffness(&fabric, [random.signed() * 0.4, random.signed() * 0.4, random.signed() * 0.4]);
        assert!(warp >= 0.0 && weft >= 0.0 && shear >= 0.0);
        assert!(cross * cross <= warp * weft);
    }
}

#[test]
fn stiffness_at_the_samples_is_the_table() {
    let rows: [[f64; 4]; 6] =
        std::array::from_fn(|i| [100.0 + i as f64, 10.0 + i as f64, 200.0 + i as f64, 50.0 + i as f64]);
    let fabric = FabricTable::from(&Fabric {
        name: "table".into(),
        density_kg_m2: 0.1,
        stretching_n_m: rows,
        bending_n_m: [[0.0; 5]; 3],
        damping_s: 0.0,
        plasticity: None,
        strain_limit: None,
    });
    assert_eq!(stretch_stiffness(&fabric, [0.0; 3])[0], 100.0);
    // A principal strain of 1/6 along the warp, the weft and 45 degrees.
    let e = 0.5 * ((7.0f32 / 6.0).powi(2) - 1.0);
    let close = |k: [f32; 4], row: usize| (0..4).all(|i| (k[i] as f64 - rows[row][i]).abs() < 1e-2);
    assert!(close(stretch_stiffness(&fabric, [e, 0.0, 0.0]), 1));
    assert!(close(stretch_stiffness(&fabric, [0.0, e, 0.0]), 5));
    assert!(close(stretch_stiffness(&fabric, [0.5 * e, 0.5 * e, 0.5 * e]), 3));
}
