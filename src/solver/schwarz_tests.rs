//! The preconditioner on a seeded cloth-like system: symmetric, positive, zero on pins, the same on every number of ranks.

use super::super::sweep::outer_layout;
use super::*;
use crate::assembly::SellLayout;
use crate::assembly::sell::value_index;
use crate::partition::halo_plans;
use crate::solver::PipelinedSpmv;
use crate::solver::pcg::{Pcg, PcgParams};
use crate::solver::preconditioner::{IterationSums, Jacobi};
use crate::solver::vector::PcgVectors;
use crate::telemetry::Recorder;
use crate::test_support::device;
use crate::test_support::seeded::Seeded;
use crate::transport::{InProcessTransport, Transport};

const SIDE: usize = 96;
const ROWS: usize = SIDE * SIDE;

/// Blocks of a grid in strips of 8 columns, so that consecutive rows are neighbors: springs along edges and diagonals,
/// a few links between distant rows, small masses.
fn system() -> Vec<Vec<(usize, [f32; BLOCK])>> {
    let mut seeded = Seeded::new(11);
    let at = |i: usize, j: usize| i / 8 * 8 * SIDE + j * 8 + i % 8;
    let mut rows: Vec<std::collections::BTreeMap<usize, [f32; BLOCK]>> = vec![Default::default(); ROWS];
    let mut spring = |a: usize, b: usize, k: f32| {
        let d = [(); 3].map(|()| seeded.uniform(-1.0, 1.0));
        let length = d.iter().map(|v| v * v).sum::<f32>().max(0.01);
        for c in 0..BLOCK {
            let v = k * d[c / 3] * d[c % 3] / length + if c % 4 == 0 { 0.1 * k } else { 0.0 };
            for (row, column, sign) in [(a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)] {
                rows[row].entry(column).or_default()[c] += sign * v;
            }
        }
    };
    for i in 0..SIDE {
        for j in 0..SIDE {
            for (a, b) in [(i + 1, j), (i, j + 1), (i + 1, j + 1)].into_iter().filter(|&(a, b)| a < SIDE && b < SIDE) {
                spring(at(i, j), at(a, b), 1.0);
            }
        }
    }
    for k in 0..60 {
        spring(k * 131, ROWS - 1 - k * 97, 3.0);
    }
    for (row, blocks) in rows.iter_mut().enumerate() {
        let own = blocks.entry(row).or_default();
        [0, 4, 8].iter().for_each(|&c| own[c] += 2e-4);
    }
    rows.into_iter().map(|row| row.into_iter().collect()).collect()
}

fn pinned(row: usize) -> bool {
    row < 40 || row % 1000 == 7
}

fn right_hand_side(row: usize) -> [f32; 3] {
    [0.3, 0.7, 1.1].map(|k| (row as f32 * k).sin())
}

/// Result of a solve on one rank.
struct Solved {
    x: Vec<f32>,
    iterations: u32,
}

/// Executor and order of the sweeps.
#[derive(Clone, Copy, PartialEq)]
enum By {
    /// The native executor with this number of threads, along the rows.
    Chain(usize),
    /// The native executor, by color.
    Colors,
    /// A device, by color.
    Device,
}

impl By {
    fn executor(self) -> Executor {
        match self {
            By::Chain(threads) => Executor::cpu(threads),
            By::Colors => Executor::cpu(1),
            By::Device => Executor::gpu(None, 0).expect("a device"),
        }
    }
}

/// [`on_ranks_in`] with a matrix that is not in difference form.
fn on_ranks<T: Send>(
    ranks: usize,
    mode: ExchangeMode,
    by: By,
    work: impl Fn(&Executor, &mut InProcessTransport, &mut Rank) -> T + Sync,
) -> Vec<T> {
    on_ranks_in(false, ranks, mode, by, work)
}

/// Runs `work` on every rank with its matrix, inverse diagonal blocks, tables after setup, and transport. `difference`:
/// the same matrix in difference form.
fn on_ranks_in<T: Send>(
    difference: bool,
    ranks: usize,
    mode: ExchangeMode,
    by: By,
    work: impl Fn(&Executor, &mut InProcessTransport, &mut Rank) -> T + Sync,
) -> Vec<T> {
    let (system, partition) = (system(), RowPartition::new(ROWS, ranks));
    let halos: Vec<Vec<u32>> = (0..ranks)
        .map(|rank| {
            let own = partition.rows_of(rank);
            let columns = system[own.clone()].iter().flatten().map(|(column, _)| *column as u32);
            let mut halo: Vec<u32> = columns.filter(|&column| !own.contains(&(column as usize))).collect();
            halo.sort_unstable();
            halo.dedup();
            halo
        })
        .collect();
    let plans = halo_plans(&partition, &halos);
    let schedule = crate::interconnect::direct(ranks);
    let (system, work) = (&system, &work);
    std::thread::scope(|scope| {
        let started: Vec<_> = plans
            .into_iter()
            .zip(InProcessTransport::group(ranks))
            .zip(&schedule.queues)
            .map(|((plan, mut transport), queue)| {
                scope.spawn(move || {
                    let executor = by.executor();
                    let mut rank = Rank::new(&executor, system, partition, plan, mode, queue, by, difference);
                    rank.set_up(&executor, &mut transport);
                    work(&executor, &mut transport, &mut rank)
                })
            })
            .collect();
        started.into_iter().map(|thread| thread.join().expect("no panic")).collect()
    })
}

struct Rank {
    matrix: SellMatrix,
    inverse: DeviceVec<f32>,
    b: DeviceVec<f32>,
    vectors: PcgVectors,
    spmv: PipelinedSpmv,
    pcg: Pcg,
    jacobi: Jacobi,
    schwarz: Schwarz,
}

impl Rank {
    #[expect(clippy::too_many_arguments, reason = "the parts of a rank")]
    fn new(
        executor: &Executor,
        system: &[Vec<(usize, [f32; BLOCK])>],
        partition: RowPartition,
        plan: HaloPlan,
        mode: ExchangeMode,
        queue: &[QueueNode],
        by: By,
        difference: bool,
    ) -> Rank {
        let own = partition.rows_of(plan.rank);
        let (mut offsets, mut columns) = (vec![0u32], Vec::new());
        for row in own.clone() {
            let local = |column: &usize| plan.local_from_global(*column as u32).expect("held");
            columns.extend(system[row].iter().map(|(column, _)| local(column)));
            offsets.push(columns.len() as u32);
        }
        let layout = match mode {
            ExchangeMode::Halo => SellLayout::halo(&offsets, &columns, plan.own.clone()),
            ExchangeMode::Full => outer_layout(&partition, &plan, mode, queue, &offsets, &columns),
        };
        let mut matrix = SellMatrix::new(executor, own.len(), &layout);
        let (mut values, mut inverse) = (vec![0.0; matrix.values.len()], Vec::new());
        let mut k = 0;
        for row in own.clone() {
            for (column, block) in &system[row] {
                for (c, &v) in block.iter().enumerate() {
                    let of_row = || system[row].iter().map(|(_, block)| block[c] as f64).sum::<f64>() as f32;
                    values[value_index(layout.block_address[k], c)] =
                        if difference && *column == row { of_row() } else { v };
                }
                if *column == row {
                    let inverted = crate::assembly::fill::inverse_symmetric(block);
                    inverse.extend(if pinned(row) { [0.0; 6] } else { inverted });
                }
                k += 1;
            }
        }
        matrix.values.write_range(executor, 0, &values);
        matrix.difference = difference;
        let pattern = RankPattern { offsets: &offsets, columns: &columns, block_address: &layout.block_address };
        let b: Vec<f32> = own.clone().flat_map(right_hand_side).collect();
        Rank {
            schwarz: Schwarz::with_smoother(
                executor,
                &partition,
                &plan,
                mode,
                queue,
                pattern,
                !matches!(by, By::Chain(_)),
            ),
            inverse: DeviceVec::upload(executor, &inverse),
            b: DeviceVec::upload(executor, &b),
            vectors: PcgVectors::new(executor, plan.own.clone(), plan.local_rows),
            pcg: Pcg::new(&partition),
            jacobi: Jacobi::new(executor, &partition, plan.rank),
            spmv: PipelinedSpmv::new(
                executor,
                mode,
                HaloExchange::new(plan, queue.to_vec()),
                queue.to_vec(),
                partition.sub_vector_rows(),
            ),
            matrix,
        }
    }

    fn set_up(&mut self, executor: &Executor, transport: &mut dyn Transport) {
        let recorder = &mut Recorder::new(None);
        let mut rank = RankContext { executor, transport, recorder };
        let (halo, flags) = (self.spmv.halo(), &mut self.vectors.u);
        let set = self.schwarz.set_up(&mut rank, halo, &(&self.matrix).into(), &self.inverse, flags);
        set.expect("sets up");
    }

    fn solve(&mut self, executor: &Executor, transport: &mut dyn Transport, sweep: bool) -> Solved {
        self.vectors.x.fill_zero(executor);
        let params = PcgParams { relative_tolerance: 1e-3, energy: false, max_iterations: 2000, nonzero_start: false };
        let mut rank = RankContext { executor, transport, recorder: &mut Recorder::new(None) };
        let mut operator = StoredMatrix { spmv: &mut self.spmv, matrix: (&self.matrix).into() };
        let mut schwarz = self.schwarz.of(executor, &self.inverse);
        let mut jacobi = self.jacobi.of(&self.inverse);
        let preconditioner: &mut dyn Preconditioner<_> = if sweep { &mut *schwarz } else { &mut jacobi };
        let (b, vectors) = (&self.b, &mut self.vectors);
        let info = self.pcg.solve(&mut rank, &mut operator, &mut [preconditioner], b, vectors, &params);
        let info = info.expect("solves");
        assert!(info.converged, "{info:?}");
        Solved { x: self.vectors.x.read(executor), iterations: info.iterations }
    }

    /// M^-1 r on a single rank.
    fn precondition(&mut self, executor: &Executor, r: &[f32]) -> Vec<f32> {
        let transport = &mut InProcessTransport::group(1).remove(0);
        let mut rank = RankContext { executor, transport, recorder: &mut Recorder::new(None) };
        let mut sums = IterationSums::new(&RowPartition::new(ROWS, 1));
        self.vectors.w.fill_zero(executor);
        let b = DeviceVec::upload(executor, r);
        let mut schwarz = self.schwarz.of(executor, &self.inverse);
        schwarz.start(&mut rank, &mut sums, &b, &mut self.vectors).expect("alone");
        self.vectors.u.read(executor)
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(&a, &b)| a as f64 * b as f64).sum()
}

#[test]
fn it_is_symmetric_positive_and_zero_on_pins() {
    let check = |executor: &Executor, _: &mut InProcessTransport, rank: &mut Rank| {
        let mut seeded = Seeded::new(3);
        for _ in 0..4 {
            let mut vector = || (0..ROWS * 3).map(|_| seeded.uniform(-1.0, 1.0)).collect::<Vec<f32>>();
            let (y, z) = (vector(), vector());
            let (my, mz) = (rank.precondition(executor, &y), rank.precondition(executor, &z));
            let (zmy, ymz, ymy) = (dot(&z, &my), dot(&y, &mz), dot(&y, &my));
            assert!(ymy > 0.0 && (zmy - ymz).abs() < 1e-5 * ymy, "{zmy} {ymz} {ymy}");
            for row in (0..ROWS).filter(|&row| pinned(row)) {
                assert_eq!(my[row * 3..row * 3 + 3], [0.0; 3], "row {row}");
            }
        }
    };
    on_ranks(1, ExchangeMode::Halo, By::Chain(1), check);
    on_ranks(1, ExchangeMode::Halo, By::Colors, check);
    if device::executor().is_some() {
        on_ranks(1, ExchangeMode::Halo, By::Device, check);
    }
}

/// (D' + L) D'^-1 (D' + U) v on the rows that are not pinned, in f64, for the colors of `colored`.
fn colored_product(colored: &Colored, v: &[f32]) -> Vec<f64> {
    let (system, chunk_rows) = (system(), RowPartition::new(ROWS, 1).chunk_rows());
    let colors = colored.colors_of_rows();
    let multiply = |v: &[f64], above: bool| -> Vec<f64> {
        let mut out = vec![0.0; v.len()];
        for (row, blocks) in system.iter().enumerate().filter(|(row, _)| !pinned(*row)) {
            for (column, block) in blocks.iter().filter(|(column, _)| !pinned(*column)) {
                let inside = column / chunk_rows == row / chunk_rows;
                assert!(!inside || *column == row || colors[*column] != colors[row], "{row} and {column} are coupled");
                let factor = match (*column == row, (colors[*column] > colors[row]) == above) {
                    (true, _) => 1.0 / super::super::colored::RELAXATION as f64,
                    (false, counts) => f64::from(u8::from(inside && counts)),
                };
                for (c, &value) in block.iter().enumerate() {
                    out[row * 3 + c / 3] += factor * value as f64 * v[column * 3 + c % 3];
                }
            }
        }
        out
    };
    let mut t = multiply(&v.iter().map(|&v| v as f64).collect::<Vec<_>>(), true);
    for (row, t) in t.as_chunks_mut::<3>().0.iter_mut().enumerate().filter(|(row, _)| !pinned(*row)) {
        let block = system[row].iter().find(|(column, _)| *column == row).map(|(_, block)| *block).expect("a diagonal");
        let m = glam::DMat3::from_cols_array(&block.map(f64::from)).inverse();
        *t = (m * glam::DVec3::from_array(*t)).to_array().map(|v| v * super::super::colored::RELAXATION as f64);
    }
    multiply(&t, false)
}

#[test]
fn sweeps_by_color_solve_what_they_should() {
    on_ranks(1, ExchangeMode::Halo, By::Colors, |executor, _, rank| {
        let mut seeded = Seeded::new(5);
        let values: Vec<f32> =
            (0..ROWS * 3).map(|at| if pinned(at / 3) { 0.0 } else { seeded.uniform(-1.0, 1.0) }).collect();
        let (r, mut u) = (DeviceVec::upload(executor, &values), DeviceVec::zeros(executor, ROWS * 3));
        let Smoother::Colors(colored) = &mut rank.schwarz.smoother else { panic!("by color") };
        let correction = vec![0.0; rank.schwarz.coarse.correction.len()];
        colored.sweep(executor, &rank.inverse, &correction, &r, &mut u);
        let back = colored_product(colored, u.as_slice());
        let worst = back.iter().zip(&values).map(|(a, &b)| (a - b as f64).abs()).fold(0.0, f64::max);
        assert!(worst < 1e-4, "{worst}");
    });
}

#[test]
fn a_device_sweeps_and_sums_as_the_native_twin() {
    if device::executor().is_none() {
        return;
    }
    let run = |by: By, difference: bool| {
        let mut of_ranks = on_ranks_in(difference, 3, ExchangeMode::Halo, by, |executor, transport, rank| {
            let rows = rank.b.len();
            let Smoother::Colors(colored) = &mut rank.schwarz.smoother else { panic!("by color") };
            let flags = &rank.vectors.u;
            let sums: Vec<f64> = colored
                .set_values(executor, &rank.matrix, flags)
                .into_iter()
                .flatten()
                .flat_map(|(group, block)| block.into_iter().chain([f64::from(group)]))
                .collect();
            let mut seeded = Seeded::new(transport.rank() as u64);
            let mut vector = |len: usize| -> Vec<f32> { (0..len).map(|_| seeded.uniform(-1.0, 1.0)).collect() };
            let (r, correction) =
                (DeviceVec::upload(executor, &vector(rows)), vector(rank.schwarz.coarse.correction.len()));
            let (mut w, mut u) = (DeviceVec::upload(executor, &vector(rows)), DeviceVec::zeros(executor, flags.len()));
            colored.sweep(executor, &rank.inverse, &correction, &r, &mut u);
            let (mut scalars, mut restricted) = (Vec::new(), Vec::new());
            colored.sums(executor, &rank.inverse, &mut w, &u, &mut scalars, &mut restricted);
            let swept: Vec<f64> = u.read(executor).iter().chain(&w.read(executor)).map(|&v| v as f64).collect();
            [sums, scalars.concat(), restricted, swept]
        });
        of_ranks.pop().expect("three ranks")
    };
    let both = |by: By| [run(by, false), run(by, true)].concat();
    for (device, twin) in both(By::Device).iter().zip(&both(By::Colors)) {
        let size = twin.iter().map(|v| v.abs()).fold(0.0, f64::max);
        assert!(size > 0.1 && device.len() == twin.len());
        for (at, (a, b)) in device.iter().zip(twin).enumerate() {
            assert!((a - b).abs() < 1e-5 * size, "{at}: {a} and {b}");
        }
    }
}

/// |b - A x| / |b| over the rows that are not pinned, in f64.
fn true_residual(x: &[f32]) -> f64 {
    let (mut rr, mut bb) = (0.0, 0.0);
    for (row, blocks) in system().iter().enumerate().filter(|(row, _)| !pinned(*row)) {
        let b = right_hand_side(row).map(f64::from);
        let mut r = b;
        for (column, block) in blocks {
            for (c, &v) in block.iter().enumerate() {
                r[c / 3] -= v as f64 * x[column * 3 + c % 3] as f64;
            }
        }
        rr += r.iter().map(|v| v * v).sum::<f64>();
        bb += b.iter().map(|v| v * v).sum::<f64>();
    }
    (rr / bb).sqrt()
}

/// Iterations of textbook PCG in f64 [Hestenes and Stiefel 1952] with this preconditioner.
fn textbook_iterations(executor: &Executor, rank: &mut Rank) -> u32 {
    let system = system();
    let narrow = |v: &[f64]| v.iter().map(|&v| v as f32).collect::<Vec<f32>>();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let free = |row: usize| f64::from(u8::from(!pinned(row)));
    let mut r: Vec<f64> = (0..ROWS).flat_map(|row| right_hand_side(row).map(|v| v as f64 * free(row))).collect();
    let start = dot(&r, &r).sqrt();
    let (mut p, mut old) = (vec![0.0; r.len()], 1.0);
    for iteration in 0..2000 {
        if dot(&r, &r).sqrt() <= 1e-3 * start {
            return iteration;
        }
        let z: Vec<f64> = rank.precondition(executor, &narrow(&r)).iter().map(|&v| v as f64).collect();
        let gamma = dot(&r, &z);
        let beta = if iteration == 0 { 0.0 } else { gamma / old };
        p.iter_mut().zip(&z).for_each(|(p, z)| *p = z + beta * *p);
        let mut image = vec![0.0; r.len()];
        for (row, blocks) in system.iter().enumerate() {
            for (column, block) in blocks {
                for (c, &v) in block.iter().enumerate() {
                    image[row * 3 + c / 3] += v as f64 * p[column * 3 + c % 3] * free(row);
                }
            }
        }
        let alpha = gamma / dot(&p, &image);
        r.iter_mut().zip(&image).for_each(|(r, s)| *r -= alpha * s);
        old = gamma;
    }
    2000
}

#[test]
fn iterations_are_those_of_textbook_pcg_and_far_fewer_than_with_jacobi() {
    let check = |executor: &Executor, transport: &mut InProcessTransport, rank: &mut Rank| {
        let jacobi = rank.solve(executor, transport, false);
        let textbook = textbook_iterations(executor, rank);
        let schwarz = rank.solve(executor, transport, true);
        println!("jacobi {}, schwarz {}, textbook {textbook}", jacobi.iterations, schwarz.iterations);
        assert!(schwarz.iterations.abs_diff(textbook) <= 2, "{} {textbook}", schwarz.iterations);
        // Chunks of 72 rows and distant links; larger systems need more.
        assert!(schwarz.iterations * 2 <= jacobi.iterations, "{} {}", schwarz.iterations, jacobi.iterations);
        for x in [&jacobi.x, &schwarz.x] {
            let reached = true_residual(x);
            assert!(reached < 1.05e-3, "{reached}");
        }
    };
    on_ranks(1, ExchangeMode::Halo, By::Chain(1), check);
    on_ranks(1, ExchangeMode::Halo, By::Colors, check);
}

#[test]
fn the_bits_are_those_of_one_rank_whatever_the_ranks_and_threads() {
    let solve = |ranks, by| {
        let solved =
            on_ranks(ranks, ExchangeMode::Halo, by, |executor, transport, rank| rank.solve(executor, transport, true));
        let bits: Vec<u32> = solved.iter().flat_map(|s| s.x.iter().map(|v| v.to_bits())).collect();
        (bits, solved[0].iterations)
    };
    let one = solve(1, By::Chain(1));
    for (ranks, threads) in [(1, 3), (2, 1), (3, 1), (4, 2), (8, 1)] {
        assert!(solve(ranks, By::Chain(threads)) == one, "{ranks} ranks, {threads} threads");
    }
    let one = solve(1, By::Colors);
    assert!(solve(3, By::Colors) == one, "by color");
    if device::executor().is_some() {
        let device = solve(1, By::Device);
        assert!(device.1.abs_diff(one.1) <= 2, "{} and {} iterations", device.1, one.1);
        for ranks in [2, 3] {
            assert!(solve(ranks, By::Device) == device, "{ranks} ranks on devices");
        }
    }
}

#[test]
fn the_difference_form_is_the_same_matrix() {
    let solve = |difference, mode, ranks, by| {
        let solved = on_ranks_in(difference, ranks, mode, by, |executor, transport, rank| {
            // The coarse matrix, entry by entry.
            let Executor::Cpu(cpu) = executor else { panic!("native") };
            let flags: Vec<f32> = (0..ROWS * 3).map(|at| f32::from(u8::from(!pinned(at / 3)))).collect();
            let entries: Vec<f64> = match &mut rank.schwarz.smoother {
                Smoother::Chain(sweeps) if ranks == 1 => {
                    sweeps.set_values(cpu, &rank.matrix, &flags).concat().iter().flat_map(|e| e.1).collect()
                }
                Smoother::Colors(colored) if ranks == 1 => {
                    let flags = DeviceVec::upload(executor, &flags);
                    let sums = colored.set_values(executor, &rank.matrix, &flags);
                    sums.concat().iter().flat_map(|e| e.1).collect()
                }
                _ => Vec::new(),
            };
            (entries, rank.solve(executor, transport, true))
        });
        let entries = solved[0].0.clone();
        (entries, solved.iter().flat_map(|s| s.1.x.clone()).collect::<Vec<f32>>(), solved[0].1.iterations)
    };
    for by in [By::Chain(1), By::Colors] {
        let (entries, x, iterations) = solve(false, ExchangeMode::Halo, 1, by);
        for (mode, ranks) in [(ExchangeMode::Halo, 1), (ExchangeMode::Halo, 3), (ExchangeMode::Full, 3)] {
            let (found, y, steps) = solve(true, mode, ranks, by);
            let size = entries.iter().fold(0.0f64, |m, v| m.max(v.abs()));
            assert!(found.iter().zip(&entries).all(|(a, b)| (a - b).abs() < 1e-5 * size), "{found:?} {entries:?}");
            let difference: Vec<f32> = x.iter().zip(&y).map(|(a, b)| a - b).collect();
            assert!(dot(&difference, &difference) < 1e-4 * dot(&x, &x));
            assert!(steps.abs_diff(iterations) <= 2, "{steps} {iterations}");
        }
    }
}

#[test]
fn whole_sub_vectors_give_the_same_solution_within_rounding() {
    for by in [By::Chain(1), By::Colors] {
        let solve =
            |ranks, mode| on_ranks(ranks, mode, by, |executor, transport, rank| rank.solve(executor, transport, true));
        let (one, full) = (solve(1, ExchangeMode::Halo), solve(3, ExchangeMode::Full));
        let x: Vec<f32> = full.iter().flat_map(|s| s.x.iter().copied()).collect();
        let difference: Vec<f32> = one[0].x.iter().zip(&x).map(|(a, b)| a - b).collect();
        assert!(full[0].iterations.abs_diff(one[0].iterations) <= 1);
        assert!(dot(&difference, &difference) < 1e-4 * dot(&x, &x));
    }
}
