//! Kernels on a device against their native twins: seeded inputs, odd sizes larger than a workgroup, the rows of one
//! rank among several.

use loomtree::assembly::fill::{Fill, FillParams, FillTables};
use loomtree::assembly::{ElementRows, Numbering, SellMatrix};
use loomtree::forces::bend::Bend;
use loomtree::forces::crease;
use loomtree::forces::fiber::{self, TautFibers};
use loomtree::forces::plastic_stretch::{self, NO_HINGE, PlasticTriangle};
use loomtree::forces::stretch::Stretch;
use loomtree::forces::{HINGE_RECORD_FLOATS, StepParams, TRIANGLE_RECORD_FLOATS, TriangleElement};
use loomtree::gpu::{DeviceVec, Executor};
use loomtree::integrator::advance::Advance;
use loomtree::integrator::pins::PRESCRIBED;
use loomtree::integrator::scatter::Scatter;
use loomtree::math::Vec3;
use loomtree::model::{GlobalModel, RankModel};
use loomtree::partition::RowPartition;
use loomtree::solver::spmv::{OwnRows, Spmv};
use loomtree::solver::vector::VectorOps;
use support::device;
use support::seeded::Seeded;
use support::{isotropic_fabric, scene, sheet};

/// Rank 1 of 3 of a crumpled sheet with a fabric whose stiffness depends on strain, direction and curvature.
fn crumpled_rank(n: usize) -> RankModel {
    let mut seeded = Seeded::new(5);
    let mut mesh = sheet(n, n, [0.3, 0.3], Vec3::ZERO, Vec3::X, Vec3::Y);
    let spacing = 0.3 / n as f32;
    let mut noise = |scale: f32| {
        Vec3::new(seeded.uniform(-scale, scale), seeded.uniform(-scale, scale), seeded.uniform(-scale, scale))
    };
    mesh.positions.iter_mut().for_each(|p| *p += noise(0.3 * spacing));
    let velocities: Vec<Vec3> = mesh.positions.iter().map(|_| noise(1.0)).collect();
    let mut fabric = isotropic_fabric(150.0, 0.25, 2e-5, 0.15, 0.002);
    for (i, row) in fabric.stretching_n_m.iter_mut().enumerate() {
        row.iter_mut().for_each(|k| *k *= 1.0 + 0.2 * i as f64);
    }
    for (i, k) in fabric.bending_n_m.iter_mut().flatten().enumerate() {
        *k *= 1.0 + 0.1 * i as f64;
    }
    let mut scene = scene(mesh, fabric, &[], 0.004, Vec3::new(0.0, 0.0, -9.81));
    scene.velocities = velocities;
    let model = GlobalModel::new(&scene);
    let mut parts = Vec::new();
    RankModel::split(&model, &RowPartition::new(model.rows(), 3), |_, part| {
        parts.push(part);
        Ok::<(), ()>(())
    })
    .unwrap();
    parts.swap_remove(1)
}

/// Everything that the kernels up to the assembly make on one executor.
struct Assembled {
    triangle_records: Vec<f32>,
    hinge_records: Vec<f32>,
    values: Vec<f32>,
    rhs: Vec<f32>,
    inverse_diagonal: Vec<f32>,
    /// Tables of the matrix: row of every lane, slice offsets, columns.
    index: [Vec<u32>; 3],
}

/// Fill tables and zero matrix of a rank.
fn tables_of(executor: &Executor, part: &RankModel) -> (FillTables, SellMatrix) {
    let triangles: Vec<[u32; 3]> = part.arrays.triangles.iter().map(|e| e.vertices).collect();
    let hinges: Vec<[u32; 4]> = part.arrays.hinges.iter().map(|e| e.vertices).collect();
    let own = part.plan.own.clone();
    let (t, h) = (ElementRows::new(own.clone(), &triangles), ElementRows::new(own.clone(), &hinges));
    let (triangles, hinges) =
        (DeviceVec::upload(executor, &part.arrays.triangles), DeviceVec::upload(executor, &part.arrays.hinges));
    let numbering = Numbering {
        own,
        columns: part.plan.local_rows,
        global_from_local: &part.plan.global_from_local,
        sub_vectors: None,
    };
    FillTables::new(executor, &numbering, (&t, &triangles), (&h, &hinges)).unwrap()
}

/// Every seventh row is prescribed, every fifth of the others has a spring.
fn pinned(rows: usize) -> Vec<f32> {
    let of_row = |r: usize| match (r % 7, r % 5) {
        (3, _) => PRESCRIBED,
        (_, 1) => 3e-4,
        _ => 0.0,
    };
    (0..rows).map(of_row).collect()
}

fn assemble(executor: &Executor, part: &RankModel) -> Assembled {
    let (arrays, rows) = (&part.arrays, part.plan.own.len());
    let fabrics = DeviceVec::upload(executor, &arrays.fabrics);
    let (triangles, hinges) =
        (DeviceVec::upload(executor, &arrays.triangles), DeviceVec::upload(executor, &arrays.hinges));
    let (x, v) = (DeviceVec::upload(executor, &arrays.positions), DeviceVec::upload(executor, &arrays.velocities));
    let mut triangle_records = DeviceVec::zeros(executor, triangles.len() * TRIANGLE_RECORD_FLOATS);
    let mut hinge_records = DeviceVec::zeros(executor, hinges.len() * HINGE_RECORD_FLOATS);
    let params = |count: usize| StepParams {
        step_s: 0.004,
        air_density: 1.2,
        air_drag: 0.1,
        count: count as u32,
        wind: [3.0, -1.0, 2.0],
        ahead_s: 0.004,
    };
    Stretch::new(executor).apply(
        executor,
        &params(triangles.len()),
        &fabrics,
        &triangles,
        &x,
        &v,
        &mut triangle_records,
    );
    Bend::new(executor).apply(executor, &params(hinges.len()), &fabrics, &hinges, &x, &v, &mut hinge_records);

    let (tables, mut matrix) = tables_of(executor, part);
    let (mut rhs, mut inverse) = (DeviceVec::zeros(executor, rows * 3), DeviceVec::zeros(executor, rows * 6));
    let (masses, pinned) = (DeviceVec::upload(executor, &arrays.masses), DeviceVec::upload(executor, &pinned(rows)));
    let params = FillParams { gravity: [0.0, 0.0, -9.81], step_s: 0.004, rows: rows as u32 };
    let fill = Fill::new(executor);
    // Twice: what an earlier step left must not show.
    for _ in 0..2 {
        fill.apply(
            executor,
            &params,
            &tables,
            &triangles,
            &triangle_records,
            &hinge_records,
            &TautFibers::default(),
            &masses,
            &pinned,
            None,
            &mut matrix,
            &mut rhs,
            &mut inverse,
        );
    }
    let made = Assembled {
        triangle_records: triangle_records.read(executor),
        hinge_records: hinge_records.read(executor),
        values: matrix.values.read(executor),
        rhs: rhs.read(executor),
        inverse_diagonal: inverse.read(executor),
        index: [&matrix.row_of_lane, &matrix.slice_offsets, &matrix.columns].map(|words| words.read(executor)),
    };
    assert_eq!(executor.take_fault(), None);
    made
}

/// Items of `width` values are equal within `tolerance` of the largest value at the same place of any item.
fn assert_close(what: &str, found: &[f32], expected: &[f32], width: usize, tolerance: f32) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for place in 0..width {
        let scale = expected.iter().skip(place).step_by(width).fold(0.0f32, |m, v| m.max(v.abs()));
        for (item, (a, b)) in found.iter().zip(expected).skip(place).step_by(width).enumerate() {
            assert!(
                (a - b).abs() <= tolerance * scale,
                "{what}: place {place} of item {item} is {a}, not {b} (scale {scale})"
            );
        }
    }
}

#[test]
fn assembly_equals_the_native_twins() {
    let Some(gpu) = device::executor() else { return };
    let part = crumpled_rank(41);
    let (expected, found) = (assemble(&Executor::cpu(1), &part), assemble(&gpu, &part));
    assert_close("triangle records", &found.triangle_records, &expected.triangle_records, TRIANGLE_RECORD_FLOATS, 1e-5);
    assert_close("hinge records", &found.hinge_records, &expected.hinge_records, HINGE_RECORD_FLOATS, 1e-5);
    assert!(found.index == expected.index);
    // Inner rows have 13 blocks.
    assert!(found.index[2].len() > 12 * part.plan.own.len(), "{} slots", found.index[2].len());
    assert_close("values", &found.values, &expected.values, 1, 1e-5);
    assert_close("right-hand side", &found.rhs, &expected.rhs, 3, 1e-5);
    assert_close("inverse diagonal", &found.inverse_diagonal, &expected.inverse_diagonal, 6, 1e-4);
    let pinned = pinned(part.plan.own.len());
    assert!(found.inverse_diagonal.chunks(6).zip(pinned).all(|(m, pinned)| (m == [0.0; 6]) == (pinned < 0.0)));
}

/// Twice, the second time from a state that has creases; then bending with the creases.
fn creases(executor: &Executor, part: &RankModel) -> (Vec<f32>, Vec<f32>) {
    let arrays = &part.arrays;
    let mut fabric = arrays.fabrics[0];
    (fabric.yield_curvature, fabric.hardening, fabric.weakening) = (40.0, 0.3, 0.7);
    let fabrics = DeviceVec::upload(executor, &[fabric]);
    let mut hinges = DeviceVec::upload(executor, &arrays.hinges);
    let x = DeviceVec::upload(executor, &arrays.positions);
    let flatter: Vec<f32> = arrays.positions.chunks(3).flat_map(|p| [p[0], p[1], 0.2 * p[2]]).collect();
    let flatter = DeviceVec::upload(executor, &flatter);
    let mut records = DeviceVec::zeros(executor, hinges.len() * HINGE_RECORD_FLOATS);
    let mut damage = DeviceVec::zeros(executor, hinges.len());
    crease::apply(executor, &fabrics, &x, &mut hinges, &mut damage);
    crease::apply(executor, &fabrics, &flatter, &mut hinges, &mut damage);
    let count = hinges.len() as u32;
    let params = StepParams { step_s: 0.004, air_density: 0.0, air_drag: 0.0, count, wind: [0.0; 3], ahead_s: 0.004 };
    Bend::new(executor).apply(executor, &params, &fabrics, &hinges, &flatter, &x, &mut records);
    let found = hinges.read(executor).iter().flat_map(|hinge| hinge.crease()).collect();
    let records = records.read(executor);
    assert_eq!(executor.take_fault(), None);
    (found, records)
}

#[test]
fn creases_equal_the_native_twin() {
    let (Some(gpu), Some(split)) = (device::executor(), device::executor_binding(192 << 10)) else { return };
    let part = crumpled_rank(65);
    let expected = creases(&Executor::cpu(1), &part);
    let yielded = expected.0.chunks(2).filter(|crease| crease[1] > 0.0).count();
    assert!(yielded > expected.0.len() / 8 && yielded < expected.0.len() / 2, "{yielded} hinges yield");
    for executor in [gpu, split] {
        let found = creases(&executor, &part);
        assert_close("creases", &found.0, &expected.0, 2, 1e-5);
        assert_close("hinge records", &found.1, &expected.1, HINGE_RECORD_FLOATS, 1e-5);
    }
}

/// Rest stretches after two return maps, the elements' weights and damage, and their records.
fn rest_stretches(executor: &Executor, part: &RankModel) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let arrays = &part.arrays;
    let mut fabric = arrays.fabrics[0];
    (fabric.yield_strain, fabric.hardening, fabric.weakening) = (0.05, 0.3, 0.7);
    let fabrics = DeviceVec::upload(executor, &[fabric]);
    let mut elements = DeviceVec::upload(executor, &arrays.triangles);
    let hinges = arrays.hinges.len() as u32;
    let of_triangle = |(i, element): (u32, &TriangleElement)| {
        PlasticTriangle::new(element, [i % hinges, if i % 2 == 0 { NO_HINGE } else { 0 }, (i + 7) % hinges])
    };
    let plastic: Vec<PlasticTriangle> = (0..).zip(&arrays.triangles).map(of_triangle).collect();
    let mut plastic = DeviceVec::upload(executor, &plastic);
    let damage: Vec<f32> = (0..hinges).map(|i| 0.1 * (i % 5) as f32).collect();
    let damage = DeviceVec::upload(executor, &damage);
    let x = DeviceVec::upload(executor, &arrays.positions);
    let other: Vec<f32> =
        arrays.positions.chunks(3).flat_map(|p| [0.9 * p[0] + 0.2 * p[1], 1.1 * p[1], p[2]]).collect();
    let other = DeviceVec::upload(executor, &other);
    for positions in [&x, &other] {
        plastic_stretch::apply(executor, true, &fabrics, positions, &damage, &mut plastic, &mut elements);
    }
    plastic_stretch::apply(executor, false, &fabrics, &x, &damage, &mut plastic, &mut elements);
    let mut records = DeviceVec::zeros(executor, elements.len() * TRIANGLE_RECORD_FLOATS);
    let count = elements.len() as u32;
    let params = StepParams { step_s: 0.004, air_density: 0.0, air_drag: 0.0, count, wind: [0.0; 3], ahead_s: 0.004 };
    Stretch::new(executor).apply(executor, &params, &fabrics, &elements, &x, &x, &mut records);
    let states = plastic.read(executor).iter().flat_map(|triangle| triangle.state()).collect();
    let weights = |element: &TriangleElement| {
        let ([a, b], [c, d]) = (element.weights_u, element.weights_v);
        [a, b, c, d, element.damage]
    };
    let weights = elements.read(executor).iter().flat_map(weights).collect();
    let records = records.read(executor);
    assert_eq!(executor.take_fault(), None);
    (states, weights, records)
}

#[test]
fn rest_stretches_equal_the_native_twin() {
    let (Some(gpu), Some(split)) = (device::executor(), device::executor_binding(192 << 10)) else { return };
    let part = crumpled_rank(65);
    let expected = rest_stretches(&Executor::cpu(1), &part);
    let yielded = expected.0.chunks(4).filter(|state| state[3] > 0.0).count();
    assert!(yielded > expected.0.len() / 16, "{yielded} triangles yield");
    for executor in [gpu, split] {
        let found = rest_stretches(&executor, &part);
        assert_close("rest stretches", &found.0, &expected.0, 4, 1e-5);
        assert_close("weights", &found.1, &expected.1, 5, 1e-5);
        assert_close("triangle records", &found.2, &expected.2, TRIANGLE_RECORD_FLOATS, 1e-5);
    }
}

/// Triangle records and fibers of a fabric with tight limits; fibers follow 192 other records.
fn limits(executor: &Executor, part: &RankModel, along: bool) -> (Vec<f32>, Vec<f32>) {
    let arrays = &part.arrays;
    let mut fabric = arrays.fabrics[0];
    fabric.limit_stiffness = 5000.0;
    if along {
        (fabric.warp_limit, fabric.weft_limit, fabric.shear_limit) = ([0.9, 1.1], [0.95, 1.02], 0.1);
    } else {
        fabric.strain_limit = [0.9, 1.1];
    }
    let fabrics = DeviceVec::upload(executor, &[fabric]);
    let triangles = DeviceVec::upload(executor, &arrays.triangles);
    let (x, v) = (DeviceVec::upload(executor, &arrays.positions), DeviceVec::upload(executor, &arrays.velocities));
    let mut triangle_records = DeviceVec::zeros(executor, triangles.len() * TRIANGLE_RECORD_FLOATS);
    let mut records = DeviceVec::zeros(executor, (192 + triangles.len()) * HINGE_RECORD_FLOATS);
    let count = triangles.len() as u32;
    let params =
        StepParams { step_s: 0.004, air_density: 1.2, air_drag: 0.1, count, wind: [3.0, -1.0, 2.0], ahead_s: 0.004 };
    let stretch = Stretch::new(executor);
    let (of_triangles, of_fibers) = (&mut triangle_records, &mut records);
    let taut = TautFibers::new(executor, 192, triangles.len());
    fiber::apply(executor, &stretch, &params, &fabrics, &triangles, &x, &v, of_triangles, &taut, of_fibers);
    let (triangle_records, mut records) = (triangle_records.read(executor), records.read(executor));
    assert_eq!(executor.take_fault(), None);
    let fibers = records.split_off(192 * HINGE_RECORD_FLOATS);
    assert!(records.iter().all(|value| *value == 0.0));
    (triangle_records, fibers)
}

#[test]
fn limits_equal_the_native_twins() {
    let (Some(gpu), Some(split)) = (device::executor(), device::executor_binding(192 << 10)) else { return };
    let part = crumpled_rank(65);
    let expected = limits(&Executor::cpu(1), &part, false);
    let fibers = expected.1.chunks(HINGE_RECORD_FLOATS).filter(|record| record[3] > 0.0).count();
    let triangles = part.arrays.triangles.len();
    assert!(fibers > triangles / 10 && fibers < triangles, "{fibers} fibers in {triangles} triangles");
    for executor in [gpu, split] {
        let found = limits(&executor, &part, false);
        assert_close("triangle records", &found.0, &expected.0, TRIANGLE_RECORD_FLOATS, 1e-4);
        assert_close("fibers", &found.1, &expected.1, HINGE_RECORD_FLOATS, 1e-4);
        let (expected, found) = (limits(&Executor::cpu(1), &part, true), limits(&executor, &part, true));
        assert_close(
            "records with limits of warp, weft and shear",
            &found.0,
            &expected.0,
            TRIANGLE_RECORD_FLOATS,
            1e-4,
        );
        assert!(found.1.iter().all(|value| *value == 0.0), "a fiber without a limit of every direction");
    }
}

#[test]
fn splitting_arrays_does_not_change_a_bit() {
    let part = crumpled_rank(65);
    // Small enough that records, values and columns are seen in several windows.
    let (Some(whole), Some(split)) = (device::executor(), device::executor_binding(192 << 10)) else {
        return;
    };
    let (expected, found) = (assemble(&whole, &part), assemble(&split, &part));
    assert!(expected.values.len() * 4 > 2 * (192 << 10) && expected.triangle_records.len() * 4 > 192 << 10);
    let equal = |a: &[f32], b: &[f32]| a.iter().map(|v| v.to_bits()).eq(b.iter().map(|v| v.to_bits()));
    assert!(
        equal(&found.triangle_records, &expected.triangle_records)
            && equal(&found.hinge_records, &expected.hinge_records)
    );
    assert!(found.index == expected.index);
    assert!(equal(&found.values, &expected.values) && equal(&found.rhs, &expected.rhs));
    assert!(equal(&found.inverse_diagonal, &expected.inverse_diagonal));

    let mut seeded = Seeded::new(8);
    let x: Vec<f32> = (0..part.plan.local_rows * 3).map(|_| seeded.uniform(-1.0, 1.0)).collect();
    assert!(equal(&products(&split, &part, &expected.values, &x), &products(&whole, &part, &expected.values, &x)));
}

/// y = A x over both sections, then y += A x with x from the host.
fn products(executor: &Executor, part: &RankModel, values: &[f32], x: &[f32]) -> Vec<f32> {
    let rows = part.plan.own.len();
    let (_, mut matrix) = tables_of(executor, part);
    matrix.values.write_range(executor, 0, values);
    let (spmv, device_x, mut y) =
        (Spmv::new(executor), DeviceVec::upload(executor, x), DeviceVec::zeros(executor, rows * 3));
    let start = part.plan.own.start;
    let own = OwnRows { x: &device_x, start, diagonal: start as u32 };
    for section in 0..2 {
        spmv.apply(executor, &matrix, section, false, &device_x, start, &mut y);
        spmv.apply_host(executor, &matrix, section, true, x, own, &mut y);
    }
    let found = y.read(executor);
    assert_eq!(executor.take_fault(), None);
    found
}

#[test]
fn products_equal_the_native_twin() {
    let Some(gpu) = device::executor() else { return };
    let (part, cpu) = (crumpled_rank(41), Executor::cpu(1));
    let values = assemble(&cpu, &part).values;
    let mut seeded = Seeded::new(7);
    let x: Vec<f32> = (0..part.plan.local_rows * 3).map(|_| seeded.uniform(-1.0, 1.0)).collect();
    let (expected, found) = (products(&cpu, &part, &values, &x), products(&gpu, &part, &values, &x));
    assert!(expected.iter().all(|y| *y != 0.0));
    assert_close("y", &found, &expected, 1, 1e-5);
}

#[test]
fn vector_work_equals_the_native_twin() {
    let Some(gpu) = device::executor() else { return };
    // Chunks longer than a workgroup, the last one short; own rows in the middle of u.
    let (rows, chunk_rows, first, local) = (1003, 300, 17, 1100);
    let run = |executor: &Executor| {
        let mut seeded = Seeded::new(11);
        let mut vector = |rows: usize| {
            let values: Vec<f32> = (0..rows * 3).map(|_| seeded.uniform(-1.0, 1.0)).collect();
            DeviceVec::upload(executor, &values)
        };
        let (b, w, mut p, mut s, mut x, mut r, mut u) =
            (vector(rows), vector(rows), vector(rows), vector(rows), vector(rows), vector(rows), vector(local));
        let inverse: Vec<f32> = (0..rows)
            .flat_map(|i| if i % 9 == 4 { [0.0; 6] } else { [2.0, 0.1, -0.2, 1.5, 0.3, 1.0 + i as f32 * 1e-3] })
            .collect();
        let inverse = DeviceVec::upload(executor, &inverse);
        let mut ops = VectorOps::new(executor, rows, chunk_rows);
        let (mut first_sums, mut second_sums) = (Vec::new(), Vec::new());
        ops.start(executor, &b, &w, &inverse, &mut r, &mut u, first * 3);
        ops.dot(executor, &w, &u, first * 3);
        ops.sums(executor, &mut first_sums);
        ops.update(executor, 0.3, -0.7, &w, &inverse, &mut u, first * 3, &mut p, &mut s, &mut x, &mut r);
        ops.dot(executor, &w, &u, first * 3);
        ops.sums(executor, &mut second_sums);
        let vectors = [&r, &u, &p, &s, &x].map(|v| v.read(executor));
        assert_eq!(executor.take_fault(), None);
        ([first_sums, second_sums], vectors)
    };
    let ((expected_sums, expected), (found_sums, found)) = (run(&Executor::cpu(1)), run(&gpu));
    for (name, (found, expected)) in ["r", "u", "p", "s", "x"].iter().zip(found.iter().zip(&expected)) {
        assert_close(name, found, expected, 1, 1e-6);
    }
    for (found, expected) in found_sums.iter().flatten().zip(expected_sums.iter().flatten()) {
        // Rounding of single precision, against the size of what is added: 900 products of about 1.
        assert!((0..3).all(|i| (found[i] - expected[i]).abs() < 1e-6 * 1500.0), "{found:?} {expected:?}");
    }
    assert_eq!(found_sums[0].len(), 4);
}

#[test]
fn advancing_and_scattering_equal_the_native_twins() {
    let Some(gpu) = device::executor() else { return };
    let (rows, first) = (777, 31);
    let run = |executor: &Executor| {
        let mut seeded = Seeded::new(13);
        let mut vector = |rows: usize| {
            let values: Vec<f32> = (0..rows * 3).map(|_| seeded.uniform(-1.0, 1.0)).collect();
            DeviceVec::upload(executor, &values)
        };
        let (dv, mut v, mut x) = (vector(rows), vector(rows + 50), vector(rows + 50));
        let (advance, scatter) = (Advance::new(executor), Scatter::new(executor));
        advance.advance(executor, 0.01, &dv, first * 3, &mut v, &mut x);
        let set: Vec<u32> = (0..rows as u32).step_by(3).collect();
        let to: Vec<[f32; 3]> = set.iter().map(|&r| [r as f32, 0.5, -1.0]).collect();
        scatter.apply(executor, &set, &to, first * 3, &mut x);
        scatter.apply(executor, &[], &[], first * 3, &mut x);
        let found = [x.read(executor), v.read(executor)];
        assert_eq!(executor.take_fault(), None);
        found
    };
    let (expected, found) = (run(&Executor::cpu(1)), run(&gpu));
    assert_close("positions", &found[0], &expected[0], 1, 1e-6);
    assert_close("velocities", &found[1], &expected[1], 1, 1e-6);
    assert_eq!(found[0][first * 3..first * 3 + 3], [0.0, 0.5, -1.0]);
}
