//! The linear system of a step and its solution against a dense one in f64 that shares nothing with the kernels but the
//! model's elements and the dihedral angle's gradient: stiffness from gradients of the strains, stress projected by its
//! eigenvalues, Gaussian elimination. A tiny sheet, far from rest, in the wind, with moving pins.

use loomtree::assembly::fill::{Fill, FillParams, FillTables};
use loomtree::assembly::sell::value_index;
use loomtree::assembly::{ContactSystem, ElementRows, LANES, NO_ROW, Numbering, SellMatrix};
use loomtree::forces::bend::Bend;
use loomtree::forces::contact::ContactStep;
use loomtree::forces::fiber::TautFibers;
use loomtree::forces::stretch::Stretch;
use loomtree::forces::{
    ContactElement, HINGE_RECORD_FLOATS, LEAST_GAP, NO_VERTEX, STICK_SPEED_M_S, StepParams, TRIANGLE_RECORD_FLOATS,
    dihedral_angle,
};
use loomtree::gpu::{DeviceVec, Executor};
use loomtree::math::{DQuat, DVec3, Vec3};
use loomtree::model::{GlobalModel, RankModel};
use loomtree::partition::RowPartition;
use loomtree::scene::{Keyframe, Motion, Pin, Scene};
use loomtree::solver::ExchangeMode;
use support::physics::{DOWN, uniform_fabric};
use support::seeded::Seeded;
use support::{cpu, scene, sheet, simulate};

const STEP_S: f64 = 1.0 / 256.0;
/// Warp, cross, weft, shear; N/m.
const STRETCHING: [f64; 4] = [300.0, 40.0, 150.0, 60.0];
const BENDING_N_M: f64 = 1e-3;
/// Of contacts: stiffness over mass / step^2.
const STIFFNESS_RATIO: f64 = 8.0;
const DAMPING_S: f64 = 0.002;
const AIR_KG_M3: f64 = 1.2;
const DRAG_KG_M2_S: f64 = 0.3;
const WIND: DVec3 = DVec3::new(1.0, 3.0, 2.0);
const PINNED: [u32; 3] = [0, 3, 10];

/// 5 x 4 vertices, crumpled, moving; two corners turn, an inner vertex is brought to a stop.
fn crumpled() -> Scene {
    let mut mesh = sheet(5, 4, [0.08, 0.06], Vec3::ZERO, Vec3::X, Vec3::Y);
    let mut random = Seeded::new(9);
    mesh.positions.iter_mut().for_each(|x| *x += random.vector() * 0.006);
    let mut fabric = uniform_fabric(STRETCHING, BENDING_N_M, 0.2);
    fabric.damping_s = DAMPING_S;
    let mut scene = scene(mesh, fabric, &PINNED, STEP_S, DOWN);
    scene.velocities.iter_mut().for_each(|v| *v = random.vector());
    let turned =
        Keyframe { rotation: DQuat::from_rotation_x(0.2), translation_m: DVec3::X * 0.01, ..Keyframe::identity(0.05) };
    scene.motions = vec![Motion { keyframes: vec![Keyframe::identity(0.0), turned] }];
    scene.pins[..2].iter_mut().for_each(|pin: &mut Pin| pin.motion = Some(0));
    scene.settings.air_density_kg_m3 = AIR_KG_M3;
    scene.settings.air_drag_kg_m2_s = DRAG_KG_M2_S;
    scene.settings.wind_m_s = WIND.as_vec3();
    scene
}

/// A x = b over all vertices in global order, nobody pinned.
struct Dense {
    n: usize,
    a: Vec<f64>,
    b: Vec<f64>,
}

impl Dense {
    /// A += scale * left right' over the components of `vertices`.
    fn add_rank_one(&mut self, vertices: &[u32], scale: f64, left: &[DVec3], right: &[DVec3]) {
        for (&p, l) in vertices.iter().zip(left) {
            for (&q, r) in vertices.iter().zip(right) {
                for (i, l) in l.to_array().iter().enumerate() {
                    for (j, r) in r.to_array().iter().enumerate() {
                        self.a[(p as usize * 3 + i) * self.n + q as usize * 3 + j] += scale * l * r;
                    }
                }
            }
        }
    }

    fn add_rhs(&mut self, vertex: u32, value: DVec3) {
        value.to_array().iter().enumerate().for_each(|(i, v)| self.b[vertex as usize * 3 + i] += v);
    }

    /// Solution with the components of `fixed` prescribed, by Gaussian elimination with partial pivoting.
    fn solve(mut self, fixed: &[(usize, f64)]) -> Vec<f64> {
        let n = self.n;
        for &(i, value) in fixed {
            self.a[i * n..(i + 1) * n].fill(0.0);
            self.a[i * n + i] = 1.0;
            self.b[i] = value;
        }
        for k in 0..n {
            let pivot = (k..n).max_by(|&p, &q| self.a[p * n + k].abs().total_cmp(&self.a[q * n + k].abs())).unwrap();
            (0..n).for_each(|j| self.a.swap(k * n + j, pivot * n + j));
            self.b.swap(k, pivot);
            for i in k + 1..n {
                let factor = self.a[i * n + k] / self.a[k * n + k];
                for j in k..n {
                    self.a[i * n + j] -= factor * self.a[k * n + j];
                }
                self.b[i] -= factor * self.b[k];
            }
        }
        for i in (0..n).rev() {
            let known: f64 = (i + 1..n).map(|j| self.a[i * n + j] * self.b[j]).sum();
            self.b[i] = (self.b[i] - known) / self.a[i * n + i];
        }
        self.b
    }
}

/// (M + dt (dt + damping) K + dt D) dv = dt (f - (dt + damping) K v) written out [Li et al. 2020, Eqs. 1-3].
fn dense_system(model: &GlobalModel) -> Dense {
    let n = model.rows() * 3;
    let mut system = Dense { n, a: vec![0.0; n * n], b: vec![0.0; n] };
    let at = |values: &[f32], v: u32| Vec3::from_slice(&values[v as usize * 3..][..3]).as_dvec3();
    let (dt, rate) = (STEP_S, STEP_S + DAMPING_S);
    for (v, &m) in model.masses.iter().enumerate() {
        (0..3).for_each(|c| system.a[(v * 3 + c) * n + v * 3 + c] += f64::from(m));
        system.add_rhs(v as u32, DOWN.as_dvec3() * (dt * f64::from(m)));
    }
    for e in &model.triangles {
        let x = e.vertices.map(|v| at(&model.positions, v));
        let v = e.vertices.map(|v| at(&model.velocities, v));
        let w = e.corner_weights().map(|w| w.map(f64::from));
        let area = f64::from(e.area_m2);
        let along = |y: [DVec3; 3], axis: usize| (0..3).map(|c| y[c] * w[c][axis]).sum::<DVec3>();
        let (xu, xv) = (along(x, 0), along(x, 1));
        let strain = [0.5 * (xu.dot(xu) - 1.0), 0.5 * (xv.dot(xv) - 1.0), 0.5 * xu.dot(xv)];
        // Gradients of the strains uu, vv, uv by the corners.
        let gradient = [w.map(|w| xu * w[0]), w.map(|w| xv * w[1]), w.map(|w| 0.5 * (xu * w[1] + xv * w[0]))];
        let [warp, cross, weft, shear] = STRETCHING;
        let stiffness = [[warp, cross, 0.0], [cross, weft, 0.0], [0.0, 0.0, shear]];
        let stress: [f64; 3] = std::array::from_fn(|i| (0..3).map(|j| stiffness[i][j] * strain[j]).sum());
        // Strain energy: conjugate to uv is twice the off-diagonal stress.
        let (suu, svv, suv) = (stress[0], stress[1], 0.5 * stress[2]);
        let positive = positive_part(suu, suv, svv);
        let mut kv = [DVec3::ZERO; 3];
        for i in 0..3 {
            for j in 0..3 {
                let k = area * stiffness[i][j];
                system.add_rank_one(&e.vertices, dt * rate * k, &gradient[i], &gradient[j]);
                let speed: f64 = (0..3).map(|c| gradient[j][c].dot(v[c])).sum();
                (0..3).for_each(|c| kv[c] += gradient[i][c] * (k * speed));
            }
        }
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            for (p, q, s) in [(0, 0, positive[0]), (0, 1, positive[1]), (1, 0, positive[1]), (1, 1, positive[2])] {
                let (left, right) = (w.map(|w| axis * w[p]), w.map(|w| axis * w[q]));
                system.add_rank_one(&e.vertices, dt * rate * area * s, &left, &right);
                let speed: f64 = (0..3).map(|c| right[c].dot(v[c])).sum();
                (0..3).for_each(|c| kv[c] += left[c] * (area * s * speed));
            }
        }
        // Air: force of the mean velocity, a third to every corner; derivative of the pressure 2 rho |vn|, of the drag
        // c.
        let normal = xu.cross(xv).normalize();
        let relative = WIND - (v[0] + v[1] + v[2]) / 3.0;
        let vn = relative.dot(normal);
        let air = (normal * (AIR_KG_M3 * vn.abs() * vn) + (relative - normal * vn) * DRAG_KG_M2_S) * area / 3.0;
        let ninth = dt * area / 9.0;
        system.add_rank_one(
            &e.vertices,
            ninth * (2.0 * AIR_KG_M3 * vn.abs() - DRAG_KG_M2_S),
            &[normal; 3],
            &[normal; 3],
        );
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            system.add_rank_one(&e.vertices, ninth * DRAG_KG_M2_S, &[axis; 3], &[axis; 3]);
        }
        for c in 0..3 {
            let elastic: DVec3 = (0..3).map(|i| gradient[i][c] * (-area * stress[i])).sum();
            system.add_rhs(e.vertices[c], (elastic - kv[c] * rate + air) * dt);
        }
    }
    for e in &model.hinges {
        let x = e.vertices.map(|v| at(&model.positions, v).as_vec3());
        let (angle, g) = dihedral_angle(x);
        let g = g.map(|g| g.as_dvec3());
        let k = BENDING_N_M * f64::from(e.shape);
        system.add_rank_one(&e.vertices, dt * rate * k, &g, &g);
        let speed: f64 = (0..4).map(|c| g[c].dot(at(&model.velocities, e.vertices[c]))).sum();
        for c in 0..4 {
            system.add_rhs(e.vertices[c], g[c] * (-dt * k * (f64::from(angle) + rate * speed)));
        }
    }
    system
}

/// Positive semidefinite part of [[uu, uv], [uv, vv]] from its eigenvectors.
fn positive_part(uu: f64, uv: f64, vv: f64) -> [f64; 3] {
    let turn = 0.5 * (2.0 * uv).atan2(uu - vv);
    let (c, s) = (turn.cos(), turn.sin());
    let first = (uu * c * c + 2.0 * uv * c * s + vv * s * s).max(0.0);
    let second = (uu * s * s - 2.0 * uv * c * s + vv * c * c).max(0.0);
    [first * c * c + second * s * s, (first - second) * c * s, first * s * s + second * c * c]
}

/// What a rank's kernels fill: its rows of A over all global columns and of b, from row `first`.
struct RankRows {
    first: usize,
    a: Vec<Vec<f32>>,
    b: Vec<f32>,
}

fn rank_rows(model: &GlobalModel, part: &RankModel, contacts: &[ContactElement]) -> RankRows {
    let ex = Executor::cpu(1);
    let (plan, arrays) = (&part.plan, &part.arrays);
    let own = plan.own.clone();
    let triangle_vertices: Vec<_> = arrays.triangles.iter().map(|e| e.vertices).collect();
    let hinge_vertices: Vec<_> = arrays.hinges.iter().map(|e| e.vertices).collect();
    let triangle_rows = ElementRows::new(own.clone(), &triangle_vertices);
    let hinge_rows = ElementRows::new(own.clone(), &hinge_vertices);
    let (global_from_local, local_contacts) = localized(model, part, contacts);
    let numbering = Numbering {
        own: own.clone(),
        columns: global_from_local.len(),
        global_from_local: &global_from_local,
        sub_vectors: None,
    };
    let mut local_velocities: Vec<f32> = Vec::new();
    for &global in &global_from_local {
        local_velocities.extend(&model.velocities[global as usize * 3..][..3]);
    }
    local_velocities.extend(OBSTACLE.iter().flat_map(|v| v.to_array()));
    let params = |count: usize| StepParams {
        step_s: STEP_S as f32,
        air_density: AIR_KG_M3 as f32,
        air_drag: DRAG_KG_M2_S as f32,
        count: count as u32,
        wind: WIND.as_vec3().to_array(),
        ahead_s: STEP_S as f32,
    };
    let fabrics = DeviceVec::upload(&ex, &arrays.fabrics);
    let (x, v) = (DeviceVec::upload(&ex, &arrays.positions), DeviceVec::upload(&ex, &arrays.velocities));
    let triangles = DeviceVec::upload(&ex, &arrays.triangles);
    let hinges = DeviceVec::upload(&ex, &arrays.hinges);
    let mut triangle_records = DeviceVec::zeros(&ex, triangles.len() * TRIANGLE_RECORD_FLOATS);
    let mut hinge_records = DeviceVec::zeros(&ex, hinges.len() * HINGE_RECORD_FLOATS);
    Stretch::new(&ex).apply(&ex, &params(triangles.len()), &fabrics, &triangles, &x, &v, &mut triangle_records);
    Bend::new(&ex).apply(&ex, &params(hinges.len()), &fabrics, &hinges, &x, &v, &mut hinge_records);
    let (tables, mut matrix) =
        FillTables::new(&ex, &numbering, (&triangle_rows, &triangles), (&hinge_rows, &hinges)).unwrap();
    let mut system = ContactSystem::new(&ex);
    system.build(&ex, &local_contacts, &numbering, &matrix).unwrap();
    let local_velocities = DeviceVec::upload(&ex, &local_velocities);
    let step = ContactStep {
        step_s: STEP_S as f32,
        stiffness_ratio: STIFFNESS_RATIO as f32,
        at_end: false,
        fall_m: [0.0; 3],
        rows: plan.local_rows as u32,
    };
    system.records(&ex, &step, &local_velocities, &local_velocities);
    system.fill(&ex);
    let (mut b, mut inverse) = (DeviceVec::zeros(&ex, own.len() * 3), DeviceVec::zeros(&ex, own.len() * 6));
    let fill = FillParams { gravity: DOWN.to_array(), step_s: STEP_S as f32, rows: own.len() as u32 };
    let (masses, pinned) = (DeviceVec::upload(&ex, &arrays.masses), DeviceVec::zeros(&ex, own.len()));
    Fill::new(&ex).apply(
        &ex,
        &fill,
        &tables,
        &triangles,
        &triangle_records,
        &hinge_records,
        &TautFibers::default(),
        &masses,
        &pinned,
        system.sums(),
        &mut matrix,
        &mut b,
        &mut inverse,
    );

    let mut a = vec![vec![0.0; model.rows() * 3]; own.len() * 3];
    let first = plan.global_from_local[own.start] as usize;
    add_blocks(&ex, &matrix, &global_from_local, first, &mut a);
    if let Some(matrix) = system.matrix() {
        add_blocks(&ex, matrix, &global_from_local, first, &mut a);
    }
    RankRows { first, a, b: b.read(&ex) }
}

/// Adds what a matrix stores to rows over all global columns; `first`: global row of the first own row. In difference
/// form a block off the diagonal also counts in the diagonal block, with a minus.
fn add_blocks(ex: &Executor, matrix: &SellMatrix, global_from_local: &[u32], first: usize, a: &mut [Vec<f32>]) {
    let (rows, slices) = (matrix.row_of_lane.read(ex), matrix.slice_offsets.read(ex));
    let (columns, values) = (matrix.columns.read(ex), matrix.values.read(ex));
    for (i, &row) in rows.iter().enumerate().filter(|(_, row)| **row != NO_ROW) {
        for slot in slices[i / LANES]..slices[i / LANES + 1] {
            let address = slot * LANES as u32 + (i % LANES) as u32;
            let column = global_from_local[columns[address as usize] as usize] as usize;
            for c in 0..9 {
                let (value, of_row) = (values[value_index(address, c)], &mut a[row as usize * 3 + c / 3]);
                of_row[column * 3 + c % 3] += value;
                let diagonal = first + row as usize;
                if matrix.difference && column != diagonal {
                    of_row[diagonal * 3 + c % 3] -= value;
                }
            }
        }
    }
}

/// Velocities of three obstacle vertices in the coming step.
const OBSTACLE: [Vec3; 3] = [Vec3::new(0.2, 0.0, 0.1), Vec3::ZERO, Vec3::new(-0.3, 0.4, 0.0)];

/// Contacts of all kinds between any vertices of the model, in ascending order of their keys; some do not repel.
fn contacts(model: &GlobalModel) -> Vec<ContactElement> {
    let (mut random, rows) = (Seeded::new(77), model.rows() as u32);
    let mut contacts: Vec<ContactElement> = (0..40u32)
        .map(|i| {
            let v = |k: u32| (i * 7 + k * (3 + i % 4)) % rows;
            let obstacle = |k: u32| rows + (i + k) % 3;
            let (vertices, weights) = match i % 5 {
                0 => ([v(0), v(1), v(2), v(3)], [1.0, -0.5, -0.25, -0.25]),
                1 => ([v(0), v(1), v(2), NO_VERTEX], [1.0, -0.75, -0.25, 0.0]),
                2 => ([v(0), obstacle(0), obstacle(1), obstacle(2)], [1.0, -0.5, -0.25, -0.25]),
                3 => ([v(0), v(1), NO_VERTEX, NO_VERTEX], [1.0, -1.0, 0.0, 0.0]),
                _ => ([v(0), v(1), v(2), v(3)], [0.75, 0.25, -0.5, -0.5]),
            };
            ContactElement {
                vertices,
                weights,
                normal: random.vector().normalize().to_array(),
                distance_m: 0.0002 * (i % 6) as f32,
                thickness_m: 0.0008,
                stiffness_n_m: 300.0,
                friction: 0.1 * (i % 4) as f32,
                kind: u32::from(i % 5 == 4),
            }
        })
        .collect();
    contacts.sort_by_key(ContactElement::key);
    contacts
}

/// Local vertices of a rank with those appended, in no particular order, that only contacts reach, and the contacts
/// that touch own rows in this numbering; obstacles come last.
fn localized(model: &GlobalModel, part: &RankModel, contacts: &[ContactElement]) -> (Vec<u32>, Vec<ContactElement>) {
    let (plan, rows) = (&part.plan, model.rows() as u32);
    let mut global_from_local = plan.global_from_local.clone();
    let own = &plan.global_from_local[plan.own.clone()];
    let mine: Vec<_> = contacts.iter().filter(|c| c.vertices.iter().any(|v| own.contains(v))).collect();
    for &v in mine.iter().rev().flat_map(|c| &c.vertices) {
        if v < rows && !global_from_local.contains(&v) {
            global_from_local.push(v);
        }
    }
    let columns = global_from_local.len() as u32;
    let local = |v: u32| match v {
        NO_VERTEX => NO_VERTEX,
        v if v >= rows => columns + v - rows,
        v => global_from_local.iter().position(|&g| g == v).unwrap() as u32,
    };
    let numbered = mine.iter().map(|c| ContactElement { vertices: c.vertices.map(local), ..**c }).collect();
    (global_from_local, numbered)
}

/// Adds the contacts to the dense system: the barrier along the normal and friction as a drag of mu F / |u_t|.
fn add_contacts(system: &mut Dense, model: &GlobalModel, contacts: &[ContactElement]) -> usize {
    let rows = model.rows() as u32;
    let velocity = |v: u32| match v {
        NO_VERTEX => DVec3::ZERO,
        v if v >= rows => OBSTACLE[(v - rows) as usize].as_dvec3(),
        v => Vec3::from_slice(&model.velocities[v as usize * 3..][..3]).as_dvec3(),
    };
    let mut repelling = 0;
    for c in contacts {
        let (n, k) = (Vec3::from(c.normal).as_dvec3(), f64::from(c.stiffness_n_m));
        let u: DVec3 = (0..4).map(|a| velocity(c.vertices[a]) * f64::from(c.weights[a])).sum();
        let (h, gap) = (f64::from(c.thickness_m), f64::from(c.distance_m));
        let free = gap + STEP_S * n.dot(u);
        // Where m (d - free) / dt^2 = k h (h - d) / d, if that is closer than the start.
        let b = STIFFNESS_RATIO * h - free;
        let stopped = 0.5 * ((b * b + 4.0 * STIFFNESS_RATIO * h * h).sqrt() - b);
        let start = gap.clamp(f64::from(LEAST_GAP) * h, h);
        let d = start.min(stopped);
        let (force, slope) = (k * h * (h - d) / d, k * (h / d).powi(2));
        let push = force + slope * (d - free);
        if push <= 0.0 {
            continue;
        }
        repelling += 1;
        let slip = u - n * n.dot(u);
        // The mass that the stiffness was made for.
        let mass = k * STEP_S * STEP_S / STIFFNESS_RATIO;
        let pressing = if stopped < start { force } else { push };
        let drag = STEP_S * f64::from(c.friction) * pressing / slip.length().max(f64::from(STICK_SPEED_M_S));
        let beta = drag * (8.0 * drag / mass).min(1.0);
        let cloth: Vec<usize> = (0..4).filter(|&a| c.vertices[a] < rows).collect();
        let vertices: Vec<u32> = cloth.iter().map(|&a| c.vertices[a]).collect();
        let along = |axis: DVec3| cloth.iter().map(|&a| axis * f64::from(c.weights[a])).collect::<Vec<_>>();
        system.add_rank_one(&vertices, STEP_S * STEP_S * slope - beta, &along(n), &along(n));
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            system.add_rank_one(&vertices, beta, &along(axis), &along(axis));
        }
        for &a in &cloth {
            system.add_rhs(c.vertices[a], (n * (STEP_S * push) - slip * drag) * f64::from(c.weights[a]));
        }
    }
    repelling
}

fn parts(model: &GlobalModel, ranks: usize) -> Vec<RankModel> {
    let mut parts = Vec::new();
    RankModel::split(model, &RowPartition::new(model.rows(), ranks), |_, part| {
        parts.push(part);
        Ok::<(), ()>(())
    })
    .unwrap();
    parts
}

/// f32 against f64: some tens of roundings (6e-8 each) of terms a hundred times as large as their sum.
const F32_RELATIVE: f64 = 1e-4;

#[test]
fn block_ell_and_right_hand_side_equal_a_dense_accumulate_and_are_symmetric() {
    let model = GlobalModel::new(&crumpled());
    check_system(&model, dense_system(&model), &[]);
}

#[test]
fn contacts_add_what_a_dense_accumulate_adds() {
    let model = GlobalModel::new(&crumpled());
    let contacts = contacts(&model);
    let mut dense = dense_system(&model);
    let repelling = add_contacts(&mut dense, &model, &contacts);
    assert!(repelling > 10 && repelling < 35, "{repelling} of 40 contacts repel");
    check_system(&model, dense, &contacts);
}

fn check_system(model: &GlobalModel, dense: Dense, contacts: &[ContactElement]) {
    let rows = rank_rows(model, &parts(model, 1)[0], contacts);
    let n = dense.n;
    assert_eq!((rows.first, rows.a.len()), (0, n));
    let (largest_a, largest_b) = (norm(&dense.a), norm(&dense.b));
    let mut coupled = 0;
    for i in 0..n {
        for j in 0..n {
            let (value, expected) = (f64::from(rows.a[i][j]), dense.a[i * n + j]);
            assert!((value - expected).abs() < F32_RELATIVE * largest_a, "A[{i}][{j}]: {value} instead of {expected}");
            // Both triangles come from the same records; only the order of their products differs.
            let mirrored = f64::from(rows.a[j][i]);
            assert!((value - mirrored).abs() < 1e-6 * largest_a, "A[{i}][{j}] {value}, A[{j}][{i}] {mirrored}");
            coupled += usize::from(value != 0.0);
        }
        let (value, expected) = (f64::from(rows.b[i]), dense.b[i]);
        assert!((value - expected).abs() < F32_RELATIVE * largest_b, "b[{i}]: {value} instead of {expected}");
    }
    assert!(coupled > 9 * 20 * 8, "the matrix has off-diagonal blocks");
}

#[test]
fn rows_have_the_same_bits_on_every_rank_count() {
    let model = GlobalModel::new(&crumpled());
    let contacts = contacts(&model);
    let one = rank_rows(&model, &parts(&model, 1)[0], &contacts);
    let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    for ranks in 2..=4 {
        let mut next = 0;
        for part in parts(&model, ranks) {
            let rows = rank_rows(&model, &part, &contacts);
            assert_eq!(rows.first, next);
            for (i, row) in rows.a.iter().enumerate() {
                assert_eq!(bits(row), bits(&one.a[rows.first * 3 + i]), "{ranks} ranks, row {}", rows.first * 3 + i);
            }
            assert_eq!(bits(&rows.b), bits(&one.b[rows.first * 3..][..rows.b.len()]));
            next += rows.b.len() / 3;
        }
        assert_eq!(next, model.rows());
    }
}

/// The solve starts from the prescribed velocity changes of the pins, which are not zero here.
#[test]
fn a_step_with_moving_pins_equals_a_direct_solve() {
    let mut scene = crumpled();
    scene.settings.relative_tolerance = 1e-7;
    let model = GlobalModel::new(&scene);
    let global = |original: u32| model.original_from_global.iter().position(|&v| v == original).unwrap();
    let mut fixed = Vec::new();
    for pin in &scene.pins {
        let start = scene.mesh.positions[pin.vertex as usize];
        let end = pin.motion.map_or(start, |m| scene.motions[m as usize].apply(STEP_S, start));
        let change = (end - start).as_dvec3() / STEP_S - scene.velocities[pin.vertex as usize].as_dvec3();
        fixed.extend(change.to_array().iter().enumerate().map(|(c, &value)| (global(pin.vertex) * 3 + c, value)));
    }
    let expected = dense_system(&model).solve(&fixed);
    let largest = norm(&expected);
    for ranks in 1..=4 {
        let outcome = simulate(&scene, ranks, ExchangeMode::Halo, 1, cpu);
        for (row, &original) in model.original_from_global.iter().enumerate() {
            let v = original as usize;
            let dv = (outcome.velocities[v] - scene.velocities[v]).as_dvec3();
            let error = (dv - DVec3::from_slice(&expected[row * 3..])).length();
            assert!(error < F32_RELATIVE * largest, "{ranks} ranks, vertex {v}: off by {error} of {largest} m/s");
            let moved = scene.mesh.positions[v] + outcome.velocities[v] * STEP_S as f32;
            assert!(outcome.positions[v].distance(moved) < 1e-7, "x1 = x0 + dt v1");
        }
    }
}

fn norm(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |largest, v| v.abs().max(largest))
}
