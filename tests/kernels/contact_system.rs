//! Contacts in the distributed system: products over ranks against a dense accumulate in f64, the same bits for every
//! number of ranks, both exchange modes, device against native twin, tables that are used again.

use loomtree::assembly::sell::value_index;
use loomtree::assembly::{
    ContactSystem, LANES, NO_ROW, Numbering, RowTooLong, SellLayout, SellMatrix, SubVectors, SystemMatrix,
};
use loomtree::context::RankContext;
use loomtree::forces::contact::ContactStep;
use loomtree::forces::{ContactElement, LEAST_GAP, NO_VERTEX, STICK_SPEED_M_S};
use loomtree::gpu::{DeviceVec, Executor};
use loomtree::partition::{HaloPlan, RowPartition, halo_plans};
use loomtree::solver::{ExchangeMode, HaloExchange, PipelinedSpmv};
use loomtree::telemetry::Recorder;
use loomtree::transport::InProcessTransport;
use support::device;
use support::direct_queue;
use support::seeded::Seeded;

const STIFFNESS_RATIO: f64 = 8.0;
const STEP_S: f32 = 0.004;
const OBSTACLES: usize = 9;

/// A system in global numbers: a banded elastic matrix and contacts.
struct Case {
    rows: usize,
    /// In ascending order of their keys; obstacle vertices come after the rows.
    contacts: Vec<ContactElement>,
    velocities: Vec<f32>,
    x: Vec<f32>,
}

impl Case {
    fn new(rows: usize, count: usize, seed: u64) -> Case {
        let mut seeded = Seeded::new(seed);
        let mut contacts: Vec<ContactElement> = (0..count)
            .map(|i| {
                let base = seeded.below(rows as u32);
                let mut vertices = [base; 4];
                for k in 1..4 {
                    while vertices[..k].contains(&vertices[k]) {
                        let reach = if i % 7 == 0 { rows as u32 } else { 12 };
                        vertices[k] = (base + seeded.below(reach)) % rows as u32;
                    }
                }
                let t = seeded.uniform(0.1, 0.9);
                let weights = match i % 4 {
                    0 => [1.0, -t, t - 1.0, 0.0],
                    1 => [t, 1.0 - t, -0.25, -0.75],
                    2 => [1.0, -0.5, -0.5 * t, 0.5 * t - 0.5],
                    _ => [1.0, -1.0, 0.0, 0.0],
                };
                (0..4).filter(|&k| weights[k] == 0.0).for_each(|k| vertices[k] = NO_VERTEX);
                if i % 8 == 2 {
                    (1..4).for_each(|k| vertices[k] = rows as u32 + seeded.below(OBSTACLES as u32));
                }
                let z = seeded.uniform(-1.0, 1.0);
                let (s, c) = seeded.uniform(0.0, 6.0).sin_cos();
                ContactElement {
                    vertices,
                    weights,
                    normal: [c * (1.0 - z * z).sqrt(), s * (1.0 - z * z).sqrt(), z],
                    // A tenth of them is out of reach: some of those come within it.
                    distance_m: seeded.uniform(0.0, 0.0011),
                    thickness_m: 0.001,
                    stiffness_n_m: 400.0,
                    friction: seeded.uniform(0.0, 0.6),
                    kind: (i % 4 == 1).into(),
                }
            })
            .collect();
        contacts.sort_by_key(ContactElement::key);
        let mut values = |n: usize, scale: f32| (0..n * 3).map(|_| seeded.uniform(-scale, scale)).collect::<Vec<f32>>();
        let (velocities, x) = (values(rows + OBSTACLES, 0.1), values(rows, 1.0));
        Case { rows, contacts, velocities, x }
    }

    /// Rows that row `row` of the elastic matrix reads.
    fn elastic_columns(&self, row: usize) -> Vec<usize> {
        let near = [-17i64, -1, 0, 1, 17].map(|d| row as i64 + d);
        near.into_iter().filter(|&c| (0..self.rows as i64).contains(&c)).map(|c| c as usize).collect()
    }

    fn elastic_value(row: usize, column: usize, c: usize) -> f32 {
        let c = if row > column { c % 3 * 3 + c / 3 } else { c };
        (((row.min(column) * 31 + row.max(column)) * 9 + c) as f32 * 0.37).sin()
    }

    /// Plans whose halo holds what elastic rows and contacts of a rank read.
    fn plans(&self, partition: &RowPartition) -> Vec<HaloPlan> {
        let halo = |rank: usize| {
            let own = partition.rows_of(rank);
            let elastic = own.clone().flat_map(|row| self.elastic_columns(row)).map(|c| c as u32);
            let contact = self.touching(&own).flat_map(|c| c.vertices).filter(|&v| (v as usize) < self.rows);
            let mut halo: Vec<u32> = elastic.chain(contact).filter(|&v| !own.contains(&(v as usize))).collect();
            halo.sort_unstable();
            halo.dedup();
            halo
        };
        halo_plans(partition, &(0..partition.ranks()).map(halo).collect::<Vec<_>>())
    }

    fn touching<'a>(&'a self, own: &'a std::ops::Range<usize>) -> impl Iterator<Item = &'a ContactElement> + 'a {
        self.contacts.iter().filter(|c| c.vertices.iter().any(|&v| own.contains(&(v as usize))))
    }

    /// Contacts that touch the rows `own`, in local numbers: `local_from_global` for rows, obstacles from `columns` on.
    fn localized(
        &self,
        own: &std::ops::Range<usize>,
        columns: usize,
        local_from_global: impl Fn(u32) -> u32,
    ) -> Vec<ContactElement> {
        let local = |v: u32| match v {
            NO_VERTEX => NO_VERTEX,
            v if v as usize >= self.rows => v - self.rows as u32 + columns as u32,
            v => local_from_global(v),
        };
        self.touching(own).map(|c| ContactElement { vertices: c.vertices.map(local), ..*c }).collect()
    }

    fn local_velocities(&self, global_from_local: &[u32]) -> Vec<f32> {
        let of_row = |&g: &u32| self.velocities[g as usize * 3..g as usize * 3 + 3].to_vec();
        global_from_local.iter().flat_map(of_row).chain(self.velocities[self.rows * 3..].to_vec()).collect()
    }

    /// Own rows of the elastic matrix, in the numbering of `plan`.
    fn elastic(&self, ex: &Executor, plan: &HaloPlan, mode: ExchangeMode, cut: &SubVectors<'_>) -> SellMatrix {
        let (mut offsets, mut columns, mut values) = (vec![0u32], Vec::new(), Vec::new());
        for row in plan.own.clone() {
            let row = plan.global_from_local[row] as usize;
            for column in self.elastic_columns(row) {
                columns.push(plan.local_from_global(column as u32).unwrap());
                values.push(std::array::from_fn::<f32, 9, _>(|c| Case::elastic_value(row, column, c)));
            }
            offsets.push(columns.len() as u32);
        }
        let layout = match mode {
            ExchangeMode::Halo => SellLayout::halo(&offsets, &columns, plan.own.clone()),
            ExchangeMode::Full => {
                SellLayout::full(&offsets, &columns, &plan.global_from_local, cut.rows_of, plan.rank, cut.order)
            }
        };
        let mut matrix = SellMatrix::new(ex, plan.own.len(), &layout);
        let mut table = vec![0.0; matrix.values.len()];
        for (block, &address) in values.iter().zip(&layout.block_address) {
            (0..9).for_each(|c| table[value_index(address, c)] = block[c]);
        }
        matrix.values.write_range(ex, 0, &table);
        matrix
    }

    /// Elastic and off-diagonal contact blocks times x, and what contacts add per row (diagonal 6, right-hand side 3),
    /// in f64.
    fn dense(&self) -> (Vec<f64>, Vec<[f64; 9]>) {
        let x = |v: usize, i: usize| f64::from(self.x[v * 3 + i]);
        let mut y = vec![0.0; self.rows * 3];
        for row in 0..self.rows {
            for column in self.elastic_columns(row) {
                for c in 0..9 {
                    y[row * 3 + c / 3] += f64::from(Case::elastic_value(row, column, c)) * x(column, c % 3);
                }
            }
        }
        let mut sums = vec![[0.0; 9]; self.rows];
        let (h, pairs) = (f64::from(STEP_S), [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]);
        for contact in &self.contacts {
            let n = contact.normal.map(f64::from);
            let present = || (0..4).filter(|&a| contact.vertices[a] != NO_VERTEX);
            let velocity = |a: usize, i: usize| f64::from(self.velocities[contact.vertices[a] as usize * 3 + i]);
            let u: [f64; 3] =
                std::array::from_fn(|i| present().map(|a| f64::from(contact.weights[a]) * velocity(a, i)).sum());
            let un: f64 = (0..3).map(|i| n[i] * u[i]).sum();
            let (thickness, gap) = (f64::from(contact.thickness_m), f64::from(contact.distance_m));
            let (k, free) = (f64::from(contact.stiffness_n_m), gap + h * un);
            // Where m (d - free) / dt^2 = k h (h - d) / d, if that is closer than the start.
            let b = STIFFNESS_RATIO * thickness - free;
            let stopped = 0.5 * ((b * b + 4.0 * STIFFNESS_RATIO * thickness * thickness).sqrt() - b);
            let start = gap.clamp(f64::from(LEAST_GAP) * thickness, thickness);
            let d = start.min(stopped);
            let (force, slope) = (k * thickness * (thickness - d) / d, k * (thickness / d).powi(2));
            let push = force + slope * (d - free);
            if push <= 0.0 {
                continue;
            }
            let slip: [f64; 3] = std::array::from_fn(|i| u[i] - n[i] * un);
            let speed = slip.iter().map(|s| s * s).sum::<f64>().sqrt().max(f64::from(STICK_SPEED_M_S));
            // The mass that the stiffness was made for.
            let mass = k * h * h / STIFFNESS_RATIO;
            let pressing = if stopped < start { force } else { push };
            let drag = h * f64::from(contact.friction) * pressing / speed;
            let beta = drag * (8.0 * drag / mass).min(1.0);
            let s = |i: usize, j: usize| (h * h * slope - beta) * n[i] * n[j] + if i == j { beta } else { 0.0 };
            for a in present().filter(|&a| (contact.vertices[a] as usize) < self.rows) {
                let (row, wa) = (contact.vertices[a] as usize, f64::from(contact.weights[a]));
                for (sum, (i, j)) in sums[row].iter_mut().zip(pairs) {
                    *sum += wa * wa * s(i, j);
                }
                for i in 0..3 {
                    sums[row][6 + i] += wa * (n[i] * h * push - slip[i] * drag);
                }
                for b in present().filter(|&b| b != a && (contact.vertices[b] as usize) < self.rows) {
                    let (column, wb) = (contact.vertices[b] as usize, f64::from(contact.weights[b]));
                    for c in 0..9 {
                        y[row * 3 + c / 3] += wa * wb * s(c / 3, c % 3) * x(column, c % 3);
                    }
                }
            }
        }
        (y, sums)
    }
}

/// What one rank computes.
struct RankResult {
    y: Vec<f32>,
    /// Per own row; zeros for rows that contacts do not touch.
    sums: Vec<[f32; 9]>,
    index: [Vec<u32>; 3],
    values: Vec<f32>,
}

/// Builds the contacts of a rank, after those of another step so that nothing old may show.
fn built(
    ex: &Executor,
    case: &Case,
    plan: &HaloPlan,
    numbering: &Numbering<'_>,
    elastic: &SellMatrix,
) -> ContactSystem {
    let mut system = ContactSystem::new(ex);
    let local = |v| plan.local_from_global(v).unwrap();
    let contacts = case.localized(&case_rows(plan), plan.local_rows, local);
    let velocities = DeviceVec::upload(ex, &case.local_velocities(&plan.global_from_local));
    let step = ContactStep {
        step_s: STEP_S,
        stiffness_ratio: STIFFNESS_RATIO as f32,
        at_end: false,
        fall_m: [0.0; 3],
        rows: plan.local_rows as u32,
    };
    let other: Vec<ContactElement> = contacts.iter().filter(|c| c.kind == 0).chain(contacts.iter()).copied().collect();
    for elements in [&other, &Vec::new(), &contacts] {
        system.build(ex, elements, numbering, elastic).unwrap();
        system.records(ex, &step, &velocities, &velocities);
        system.fill(ex);
        assert_eq!((system.contacts(), system.matrix().is_some()), (elements.len(), !elements.is_empty()));
    }
    system
}

fn case_rows(plan: &HaloPlan) -> std::ops::Range<usize> {
    let first = plan.global_from_local[plan.own.start] as usize;
    first..first + plan.own.len()
}

fn results(case: &Case, ranks: usize, mode: ExchangeMode, executor: fn() -> Executor) -> Vec<RankResult> {
    let partition = RowPartition::new(case.rows, ranks);
    std::thread::scope(|scope| {
        let handles: Vec<_> = case
            .plans(&partition)
            .into_iter()
            .zip(InProcessTransport::group(ranks))
            .map(|(plan, mut transport)| {
                scope.spawn(move || {
                    let (ex, rank, rows) = (executor(), plan.rank, case_rows(&plan));
                    let rows_of: Vec<_> = (0..ranks).map(|r| partition.rows_of(r)).collect();
                    let queue = direct_queue(rank, ranks);
                    let order: Vec<usize> = queue.iter().map(|node| node.vector).collect();
                    let cut = SubVectors { rows_of: &rows_of, order: &order };
                    let elastic = case.elastic(&ex, &plan, mode, &cut);
                    let numbering = Numbering {
                        own: plan.own.clone(),
                        columns: plan.local_rows,
                        global_from_local: &plan.global_from_local,
                        sub_vectors: (mode == ExchangeMode::Full).then_some(cut),
                    };
                    let system = built(&ex, case, &plan, &numbering, &elastic);
                    let mut u = DeviceVec::zeros(&ex, plan.local_rows * 3);
                    u.write_range(&ex, plan.own.start * 3, &case.x[rows.start * 3..rows.end * 3]);
                    let mut y = DeviceVec::upload(&ex, &vec![7.0; rows.len() * 3]);
                    let halo = HaloExchange::new(plan.clone(), queue.clone());
                    let mut spmv = PipelinedSpmv::new(&ex, mode, halo, queue, partition.sub_vector_rows());
                    let matrix = system.system(&elastic);
                    let recorder = &mut Recorder::new(None);
                    let mut rank = RankContext { executor: &ex, transport: &mut transport, recorder };
                    spmv.apply(&mut rank, &matrix, &mut u, &mut y).unwrap();
                    result(&ex, &system, &y, rows.len())
                })
            })
            .collect();
        handles.into_iter().map(|handle| handle.join().unwrap()).collect()
    })
}

fn result(ex: &Executor, system: &ContactSystem, y: &DeviceVec<f32>, rows: usize) -> RankResult {
    let mut sums = vec![[0.0; 9]; rows];
    let found = system.sums().unwrap().sums.read(ex);
    let slots = system.sums().unwrap().slots.read(ex);
    for (slot, (&row, values)) in system.touched_rows().iter().zip(found.as_chunks::<9>().0).enumerate() {
        assert_eq!(slots[row as usize] as usize, slot);
        sums[row as usize] = *values;
    }
    let matrix = system.matrix().unwrap();
    let result = RankResult {
        y: y.read(ex),
        sums,
        index: [&matrix.row_of_lane, &matrix.slice_offsets, &matrix.columns].map(|words| words.read(ex)),
        values: matrix.values.read(ex),
    };
    assert_eq!(ex.take_fault(), None);
    result
}

fn assert_close(what: &str, found: impl Iterator<Item = f32>, expected: impl Iterator<Item = f64> + Clone) {
    let scale = expected.clone().fold(0.0f64, |largest, v| largest.max(v.abs()));
    assert!(scale > 0.0);
    let mut count = 0;
    for (i, (found, expected)) in found.zip(expected.clone()).enumerate() {
        // Some tens of roundings in single precision.
        assert!((f64::from(found) - expected).abs() < 1e-5 * scale, "{what} {i}: {found} instead of {expected}");
        count += 1;
    }
    assert_eq!(count, expected.count());
}

fn check_against_dense(case: &Case, ranks: &[RankResult]) {
    let (y, sums) = case.dense();
    assert_close("y", ranks.iter().flat_map(|r| r.y.iter().copied()), y.iter().copied());
    for c in 0..9 {
        let found = ranks.iter().flat_map(|r| r.sums.iter().map(|s| s[c]));
        assert_close(&format!("sum {c} of row"), found, sums.iter().map(|s| s[c]));
    }
}

fn native() -> Executor {
    Executor::cpu(2)
}

#[test]
fn products_equal_a_dense_accumulate_with_the_same_bits_on_every_rank_count() {
    let case = Case::new(203, 400, 3);
    let one = results(&case, 1, ExchangeMode::Halo, native);
    check_against_dense(&case, &one);
    for ranks in [2, 3] {
        let many = results(&case, ranks, ExchangeMode::Halo, native);
        let bits = |ranks: &[RankResult]| -> Vec<u32> {
            let sums = ranks.iter().flat_map(|r| r.sums.iter().flatten());
            ranks.iter().flat_map(|r| r.y.iter()).chain(sums).map(|v| v.to_bits()).collect()
        };
        assert!(bits(&many) == bits(&one), "{ranks} ranks");
    }
}

#[test]
fn whole_sub_vectors_give_the_same_products() {
    let case = Case::new(203, 400, 4);
    for ranks in [1, 3] {
        let found = results(&case, ranks, ExchangeMode::Full, native);
        check_against_dense(&case, &found);
        let sections = found[0].index[0].len();
        assert!(sections > 0);
    }
}

#[test]
fn the_device_fills_the_same_tables() {
    if device::executor().is_none() {
        return;
    }
    // Tables, records and values in several windows; more rows than a workgroup.
    let case = Case::new(701, 2200, 5);
    for (ranks, mode) in [(2, ExchangeMode::Halo), (3, ExchangeMode::Full)] {
        let native = results(&case, ranks, mode, native);
        let small = || device::executor_binding(64 << 10).expect("there is an adapter, see above");
        let device = results(&case, ranks, mode, small);
        for (native, device) in native.iter().zip(&device) {
            assert!(device.index == native.index);
            assert!(native.values.len() * 4 > 128 << 10);
            let exact = |values: &[f32]| values.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
            assert_close("value", device.values.iter().copied(), exact(&native.values).into_iter());
            assert_close("y", device.y.iter().copied(), exact(&native.y).into_iter());
        }
        check_against_dense(&case, &device);
    }
}

/// Decoded blocks of one rank that owns everything.
#[test]
fn the_contact_matrix_is_symmetric_bit_for_bit() {
    let case = Case::new(97, 300, 6);
    let result = results(&case, 1, ExchangeMode::Halo, native).pop().unwrap();
    let [rows, slices, columns] = &result.index;
    let n = case.rows * 3;
    let mut a = vec![0.0f32; n * n];
    let mut blocks = 0;
    for (i, &row) in rows.iter().enumerate().filter(|(_, row)| **row != NO_ROW) {
        for slot in slices[i / LANES]..slices[i / LANES + 1] {
            let address = slot * LANES as u32 + (i % LANES) as u32;
            let column = columns[address as usize];
            let values: [f32; 9] = std::array::from_fn(|c| result.values[value_index(address, c)]);
            blocks += usize::from(values != [0.0; 9]);
            (0..9).for_each(|c| a[(row as usize * 3 + c / 3) * n + column as usize * 3 + c % 3] += values[c]);
        }
    }
    assert!(blocks > 600, "{blocks} blocks");
    assert!((0..n).all(|i| (0..i).all(|j| a[i * n + j].to_bits() == a[j * n + i].to_bits())));
    assert!((0..case.rows).all(|v| a[v * 3 * n + v * 3] == 0.0), "diagonal blocks belong to the elastic matrix");
}

#[test]
fn a_row_with_too_many_columns_is_reported() {
    let ex = Executor::cpu(1);
    // One vertex against 66,000 others: more than a position can name.
    let others = 66_000u32;
    let contact = |v| ContactElement {
        vertices: [1, v, NO_VERTEX, NO_VERTEX],
        weights: [1.0, -1.0, 0.0, 0.0],
        normal: [0.0, 0.0, 1.0],
        distance_m: 0.0,
        thickness_m: 1e-3,
        stiffness_n_m: 1.0,
        friction: 0.0,
        kind: 0,
    };
    let contacts: Vec<ContactElement> = (2..2 + others).map(contact).collect();
    let global: Vec<u32> = (0..2 + others).collect();
    let numbering = Numbering { own: 0..4, columns: global.len(), global_from_local: &global, sub_vectors: None };
    let layout = SellLayout::halo(&[0, 1, 2, 3, 4], &[0, 1, 2, 3], 0..4);
    let elastic = SellMatrix::new(&ex, 4, &layout);
    let mut system = ContactSystem::new(&ex);
    let refused = system.build(&ex, &contacts, &numbering, &elastic);
    assert_eq!(refused, Err(RowTooLong { local: 1, columns: others as usize }));
    // The next step is as good as any.
    system.build(&ex, &contacts[..9], &numbering, &elastic).unwrap();
    assert_eq!((system.contacts(), system.touched_rows()), (9, &[1, 2, 3][..]));
    assert!(SystemMatrix::from(&elastic).contact.is_none() && system.system(&elastic).contact.is_some());
}
