//! Readers on hand-sized files and arbitrary bytes; solves with known answers on 1 to 4 ranks.

use proptest::prelude::*;

use super::*;
use crate::gpu::Executor;
use crate::interconnect::direct;
use crate::partition::RowPartition;
use crate::solver::{ExchangeMode, PreconditionerKind};
use crate::transport::InProcessTransport;

fn market(text: &str) -> Result<BlockSystem, SystemError> {
    parse_matrix_market(text.as_bytes(), text.len() as u64, "a.mtx")
}

fn refusal(text: &str) -> String {
    market(text).expect_err("must be refused").to_string()
}

fn symmetric(body: &str) -> String {
    format!("%%MatrixMarket matrix coordinate real symmetric\n{body}")
}

fn params(relative_tolerance: f64) -> SolveParams {
    SolveParams {
        relative_tolerance,
        max_iterations: 2000,
        repeat: 1,
        time_products: false,
        host_threads: 1,
        preconditioner: PreconditionerKind::Auto,
        record_solves: 0,
    }
}

/// Solves on `ranks` threads and returns the result of every rank.
fn solve(
    system: &BlockSystem,
    rhs: &[f64],
    ranks: usize,
    mode: ExchangeMode,
    params: SolveParams,
) -> Vec<Result<SolveResult, SolveError>> {
    let partition = RowPartition::new(system.block_rows(), ranks);
    let schedule = direct(ranks);
    let mut parts = Vec::new();
    let all: Result<(), ()> = system.clone().split(rhs.to_vec(), &partition, |rank, part| {
        // The arrays pass through bytes, as between processes.
        let arrays = RankSystemArrays::from_bytes(&part.arrays.to_bytes(), part.double_precision).expect("own bytes");
        assert!(part.message_values() > 0 && rank == part.plan.rank);
        parts.push(RankSystem { arrays, ..part });
        Ok(())
    });
    all.expect("collects");
    std::thread::scope(|scope| {
        let threads: Vec<_> = parts
            .iter()
            .zip(InProcessTransport::group(ranks))
            .zip(&schedule.queues)
            .map(|((part, mut transport), queue)| {
                scope.spawn(move || solve_rank(&Executor::cpu(1), &mut transport, part, mode, queue, &params))
            })
            .collect();
        threads.into_iter().map(|thread| thread.join().expect("no panic")).collect()
    })
}

fn solve_one(system: &BlockSystem, rhs: &[f64], relative_tolerance: f64) -> SolveResult {
    solve(system, rhs, 1, ExchangeMode::Halo, params(relative_tolerance)).pop().expect("one rank").expect("solves")
}

/// Joins x of all ranks; their figures must be equal.
fn joined(results: Vec<Result<SolveResult, SolveError>>) -> (Vec<f64>, SolveStats) {
    let results: Vec<SolveResult> = results.into_iter().map(|result| result.expect("solves")).collect();
    let stats = SolveStats { seconds: Vec::new(), ..results[0].stats.clone() };
    for result in &results {
        assert_eq!(stats, SolveStats { seconds: Vec::new(), ..result.stats.clone() });
    }
    (results.into_iter().flat_map(|result| result.x).collect(), stats)
}

/// A grid of `side * side` vertices, each with three unknowns coupled to each other and to the neighbors.
fn grid(side: usize) -> BlockSystem {
    let mut text = String::new();
    let mut entries = 0;
    let mut add = |row: usize, column: usize, value: f64| {
        text.push_str(&format!("{} {} {value}\n", row + 1, column + 1));
        entries += 1;
    };
    for v in 0..side * side {
        for i in 0..3 {
            add(v * 3 + i, v * 3 + i, 4.05 + 0.3 * (v as f64 * 0.37 + i as f64).sin());
            for j in 0..i {
                add(v * 3 + i, v * 3 + j, 0.2);
            }
            for neighbor in [(v % side > 0).then(|| v - 1), (v >= side).then(|| v - side)].into_iter().flatten() {
                add(v * 3 + i, neighbor * 3 + i, -0.9);
            }
        }
    }
    let rows = side * side * 3;
    market(&symmetric(&format!("{rows} {rows} {entries}\n{text}"))).expect("a valid matrix")
}

#[test]
fn a_2x2_system_by_hand() {
    // [[4,1],[1,3]] x = [1,2]: x = [1/11, 7/11]
    let system = market(&symmetric("% comment\n\n2 2 3\n1 1 4\n2 1 1\n2 2 3\n")).expect("valid");
    assert_eq!((system.scalar_rows, system.block_rows(), system.blocks()), (2, 1, 1));
    // The third row is padding.
    assert_eq!(system.values, Values::F64(vec![4.0, 1.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 4.0]));
    assert_eq!(system.times_ones(), [5.0, 4.0]);
    let result = solve_one(&system, &[1.0, 2.0], 1e-10);
    assert!((result.x[0] - 1.0 / 11.0).abs() < 1e-10 && (result.x[1] - 7.0 / 11.0).abs() < 1e-10, "{:?}", result.x);
    assert_eq!(result.x[2], 0.0);
    assert!(result.stats.converged && result.stats.relative_residual <= 1e-10);
}

#[test]
fn duplicates_are_added_and_a_general_matrix_may_be_symmetric() {
    let text = "%%MatrixMarket matrix coordinate integer general\n2 2 6\n1 1 1\n1 1 3\n2 1 1\n1 2 1\n2 2 3\n1 1 0\n";
    let system = market(text).expect("valid");
    assert_eq!(system.values, Values::F64(vec![4.0, 1.0, 0.0, 1.0, 3.0, 0.0, 0.0, 0.0, 4.0]));
}

#[test]
fn a_5x5_chain_over_two_blocks_by_hand() {
    // Second differences with fixed ends: x_i = i (6 - i) / 2 for b = 1.
    let body: String =
        (1..=5).map(|i| format!("{i} {i} 2\n")).chain((2..=5).map(|i| format!("{i} {} -1\n", i - 1))).collect();
    let system = market(&symmetric(&format!("5 5 9\n{body}"))).expect("valid");
    assert_eq!((system.block_rows(), system.blocks()), (2, 4));
    for ranks in [1, 2] {
        let (x, stats) = joined(solve(&system, &[1.0; 5], ranks, ExchangeMode::Halo, params(1e-10)));
        for (i, x) in x[..5].iter().enumerate() {
            assert!((x - (i as f64 + 1.0) * (5.0 - i as f64) / 2.0).abs() < 1e-8, "{ranks} ranks: {x}");
        }
        assert_eq!(stats.bytes_exchanged > 0, ranks > 1);
    }
}

#[test]
fn every_rank_count_gives_the_same_bits() {
    let system = grid(31);
    let rhs: Vec<f64> = (0..system.scalar_rows).map(|i| (i as f64 * 0.71).sin()).collect();
    for rtol in [1e-2, 1e-9] {
        let (x, one) = joined(solve(&system, &rhs, 1, ExchangeMode::Halo, params(rtol)));
        assert!(one.converged && one.relative_residual <= rtol);
        for ranks in [2, 3, 4] {
            let (y, stats) = joined(solve(&system, &rhs, ranks, ExchangeMode::Halo, params(rtol)));
            assert!(x.iter().map(|v| v.to_bits()).eq(y.iter().map(|v| v.to_bits())), "{ranks} ranks, rtol {rtol}");
            assert_eq!(
                (stats.iterations, stats.relative_residual.to_bits()),
                (one.iterations, one.relative_residual.to_bits())
            );
        }
    }
}

#[test]
fn whole_sub_vectors_give_the_same_solution_and_move_more() {
    let system = grid(31);
    let rhs = system.times_ones();
    let (x, halo) = joined(solve(&system, &rhs, 3, ExchangeMode::Halo, params(1e-8)));
    let (y, full) = joined(solve(&system, &rhs, 3, ExchangeMode::Full, params(1e-8)));
    for (x, y) in x.iter().zip(&y) {
        assert!((x - 1.0).abs() < 1e-6 && (x - y).abs() < 1e-6);
    }
    // Every product: each of 3 ranks receives two sub-vectors; or 4 * 31 rows in all.
    let sub_vector = RowPartition::new(31 * 31, 3).sub_vector_rows() as u64 * 12;
    assert_eq!(full.product_bytes, u64::from(full.products) * 6 * sub_vector);
    assert!(halo.product_bytes < full.product_bytes / 5);
}

#[test]
fn refinement_reaches_residuals_beyond_single_precision() {
    let system = grid(20);
    let rhs: Vec<f64> = (0..system.scalar_rows).map(|i| (i as f64 * 1.3).cos() * 1e-30).collect();
    let result = solve_one(&system, &rhs, 1e-10);
    assert!(result.stats.converged && result.stats.refinements > 0 && result.stats.relative_residual <= 1e-10);
    let first = solve_one(&system, &rhs, 1e-2);
    assert_eq!(first.stats.refinements, 0);
    assert!(first.stats.converged && first.stats.iterations < result.stats.iterations);
}

#[test]
fn a_zero_right_hand_side_needs_no_iteration() {
    let result = solve_one(&grid(3), &[0.0; 27], 1e-2);
    assert!(result.stats.converged && result.stats.iterations == 0 && result.x.iter().all(|&x| x == 0.0));
}

#[test]
fn units_far_from_one_do_not_matter() {
    let scaled = |s: &str| market(&symmetric(&format!("2 2 3\n1 1 4{s}\n2 1 1{s}\n2 2 3{s}\n"))).expect("valid");
    for (s, factor) in [("e-60", 1e60), ("e60", 1e-60)] {
        let result = solve_one(&scaled(s), &[1.0, 2.0], 1e-8);
        assert!((result.x[0] / factor - 1.0 / 11.0).abs() < 1e-7, "{s}: {:?}", result.x);
    }
}

#[test]
fn too_few_iterations_are_said_with_numbers() {
    let system = grid(20);
    let rhs: Vec<f64> = (0..system.scalar_rows).map(|i| (i as f64 * 1.3).cos()).collect();
    let limited = SolveParams { max_iterations: 2, ..params(1e-6) };
    let (_, stats) = joined(solve(&system, &rhs, 2, ExchangeMode::Halo, limited));
    assert!(!stats.converged && stats.iterations == 2 && stats.relative_residual > 1e-6);
}

#[test]
fn an_indefinite_matrix_is_told_on_every_rank_with_the_best_iterate() {
    // Positive diagonal blocks, negative in the direction (1,..,-1) across two blocks.
    let body: String =
        (1..=6).map(|i| format!("{i} {i} 1\n")).chain((1..=3).map(|i| format!("{} {i} 2\n", i + 3))).collect();
    let system = market(&symmetric(&format!("6 6 9\n{body}"))).expect("looks fine");
    let rhs = [1.0, 2.0, 0.5, -1.0, -2.0, 0.1];
    for ranks in [1, 2] {
        let (x, stats) = joined(solve(&system, &rhs, ranks, ExchangeMode::Halo, params(1e-6)));
        assert!(matches!(stats.end, SolveEnd::NotPositiveDefinite { curvature } if curvature < 0.0), "{stats:?}");
        assert!(!stats.converged);
        let square: f64 = (0..6).map(|i| (rhs[i] - x[i] - 2.0 * x[(i + 3) % 6]).powi(2)).sum();
        let relative = (square / rhs.iter().map(|b| b * b).sum::<f64>()).sqrt();
        assert!((relative - stats.relative_residual).abs() < 1e-12 && relative <= 1.0, "{relative} {stats:?}");
    }
}

#[test]
fn a_singular_matrix_says_so() {
    // A ring of second differences: all row sums are zero.
    let body: String =
        (1..=9).map(|i| format!("{i} {i} 2\n")).chain((2..=9).map(|i| format!("{i} {} -1\n", i - 1))).collect();
    let message = refusal(&symmetric(&format!("9 9 18\n{body}9 1 -1\n")));
    assert!(message.starts_with("a.mtx: the matrix is singular: its product with the vector of ones"), "{message}");
    // Its null vector alternates, so that only a solve can find it.
    let body: String =
        (1..=8).map(|i| format!("{i} {i} 2\n")).chain((2..=8).map(|i| format!("{i} {} 1\n", i - 1))).collect();
    let system = market(&symmetric(&format!("8 8 16\n{body}8 1 1\n"))).expect("looks fine");
    let mut rhs = [1.0; 8];
    rhs[3] = 1.5;
    for ranks in [1, 3] {
        let (_, stats) = joined(solve(&system, &rhs, ranks, ExchangeMode::Halo, params(1e-6)));
        assert_eq!((stats.converged, stats.end), (false, SolveEnd::Singular));
        // No x leaves less than the part of b in the null space, 0.5 / sqrt(8). PCG minimizes another norm, so that its
        // best iterate leaves more.
        let b: f64 = rhs.iter().map(|b| b * b).sum::<f64>().sqrt();
        let over_least = stats.relative_residual * b / (0.5 / 8f64.sqrt());
        assert!(over_least > 1.0 - 1e-9 && over_least < 2.0, "{stats:?}");
    }
}

/// A chain of springs between two walls, every other one `ratio` times as stiff as the others.
fn springs(rows: usize, ratio: f64) -> BlockSystem {
    let stiffness = |i: usize| if i.is_multiple_of(2) { 1.0 } else { ratio };
    let mut body = String::new();
    for i in 1..=rows {
        body += &format!("{i} {i} {}\n", stiffness(i - 1) + stiffness(i));
        if i > 1 {
            body += &format!("{i} {} -{}\n", i - 1, stiffness(i - 1));
        }
    }
    market(&symmetric(&format!("{rows} {rows} {}\n{body}", rows * 2 - 1))).expect("a valid matrix")
}

#[test]
fn what_single_precision_cannot_solve_goes_on_in_double_precision() {
    // The solution is 1 everywhere, so that stiff springs cancel in the right-hand side. At 1e7, f64 itself reaches
    // about 1e-9; what is asked for there, a preconditioner that holds all 36 rows may reach in single precision.
    for (rows, ratio, rtol, in_double) in [(300, 1e3, 1e-10, true), (36, 1e7, 1e-6, false)] {
        let system = springs(rows, ratio);
        let rhs = system.times_ones();
        let (x, one) = joined(solve(&system, &rhs, 1, ExchangeMode::Halo, params(rtol)));
        assert!(one.converged && one.relative_residual <= rtol, "{one:?}");
        assert!(one.double_iterations > 0 || !in_double, "{one:?}");
        // The residual once more, from the springs.
        let stiffness = |i: usize| if i.is_multiple_of(2) { 1.0 } else { ratio };
        let at = |i: usize| if (1..=rows).contains(&i) { x[i - 1] } else { 0.0 };
        let force = |i: usize| stiffness(i - 1) * (at(i) - at(i - 1)) + stiffness(i) * (at(i) - at(i + 1));
        let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
        let relative = norm(&mut (1..=rows).map(|i| rhs[i - 1] - force(i))) / norm(&mut rhs.iter().copied());
        assert!(relative <= 2.0 * rtol, "{relative:e}");
        let (y, several) = joined(solve(&system, &rhs, 3, ExchangeMode::Halo, params(rtol)));
        assert!(x.iter().map(|v| v.to_bits()).eq(y.iter().map(|v| v.to_bits())));
        assert_eq!(one.double_iterations, several.double_iterations);
    }
}

#[test]
fn refusals_name_the_place() {
    for (text, expected) in [
        ("", "a.mtx:1: expected '%%MatrixMarket"),
        ("%%MatrixMarket matrix array real general\n1 1\n1\n", "a.mtx:1: a dense matrix (array)"),
        ("%%MatrixMarket matrix coordinate pattern symmetric\n", "a.mtx:1: pattern values"),
        ("%%MatrixMarket matrix coordinate complex symmetric\n", "a.mtx:1: complex values"),
        ("%%MatrixMarket matrix coordinate real hermitian\n", "a.mtx:1: a matrix that is hermitian"),
        ("%%MatrixMarket matrix coordinate real symmetric\n%\n", "a.mtx:2: the file ends before"),
    ] {
        assert!(refusal(text).starts_with(expected), "{}", refusal(text));
    }
    for (body, expected) in [
        ("2 3 3\n", "a.mtx:2: the matrix has 2 rows and 3 columns"),
        ("0 0 0\n", "a.mtx:2: the matrix has no rows"),
        ("2 2\n", "a.mtx:2: expected three numbers"),
        ("-2 2 3\n", "a.mtx:2: '-2' is not a number of rows"),
        ("2 2 99999999999\n", "a.mtx:2: 99999999999 entries cannot fit"),
        ("2 2 1\n1 1 1\n", "a.mtx:2: 1 entries are too few"),
        ("1 1 2\n1 1 1\n", "a.mtx:3: the file ends after 1 of 2"),
        ("1 1 1\n1 1 1\n1 1 1\n", "a.mtx:4: more than the 1 entries"),
        ("2 2 2\n1 1 1\n3 1 1\n", "a.mtx:4: '3' is not a row between 1 and 2"),
        ("2 2 2\n1 1 1\n2 0 1\n", "a.mtx:4: '0' is not a column"),
        ("1 1 1\n1 1 nan\n", "a.mtx:3: 'nan' is not a finite number"),
        ("1 1 1\n1 1 1 0\n", "a.mtx:3: expected an entry"),
        ("2 2 2\n1 1 1\n1 2 1\n", "a.mtx:4: a symmetric matrix lists only"),
        ("2 2 2\n1 1 1\n2 2 -1\n", "a.mtx: row 2, column 2: the diagonal value is -1e0; it must be positive"),
        ("2 2 2\n1 1 1\n2 1 1\n", "a.mtx: row 2, column 2: the diagonal value is missing or zero"),
        ("4 4 4\n1 1 1\n2 2 1\n3 3 1\n4 1 1\n", "a.mtx: row 4, column 4: the diagonal value is missing or zero"),
        ("4 4 4\n1 1 1\n2 2 1\n3 3 1\n1 1 1\n", "a.mtx: row 4, column 4: the diagonal value is missing or zero"),
        (
            "9 9 9\n1 1 1\n2 2 1\n3 3 1\n1 1 1\n7 7 1\n8 8 1\n9 9 1\n1 1 1\n1 1 1\n",
            "a.mtx: row 4, column 4: the diagonal value is missing",
        ),
        ("2 2 3\n1 1 1\n2 2 1\n2 1 2\n", "a.mtx: rows 1 to 2: their diagonal block is not positive definite"),
        ("2 2 2\n1 1 1e-20\n2 2 1e20\n", "a.mtx: the diagonal spans from 1e-20 (row 1) to 1e20 (row 2)"),
        ("1 1 2\n1 1 1e308\n1 1 1e308\n", "a.mtx: row 1, column 1: the value is not a finite number"),
    ] {
        let text = symmetric(body);
        assert!(refusal(&text).starts_with(expected), "{body:?}: {}", refusal(&text));
    }
    let general = |body: &str| format!("%%MatrixMarket matrix coordinate real general\n{body}");
    let diagonal: String = (1..=6).map(|i| format!("{i} {i} 9\n")).collect();
    for (extra, count) in [("5 1 1\n", 7), ("1 5 1\n", 7), ("1 5 1\n5 1 2\n", 8), ("2 1 1\n", 7)] {
        let message = refusal(&general(&format!("6 6 {count}\n{diagonal}{extra}")));
        assert!(message.starts_with("a.mtx: the matrix is not symmetric: row "), "{message}");
    }
}

#[test]
fn right_hand_sides_in_both_forms() {
    let parse = |text: &str| parse_right_hand_side(text.as_bytes(), 3, "b");
    assert_eq!(parse("1\n\n# two\n2e0\n -3 \n").expect("plain"), [1.0, 2.0, -3.0]);
    let array = "%%MatrixMarket matrix array real general\n% c\n3 1\n1\n2\n-3\n";
    assert_eq!(parse(array).expect("array"), [1.0, 2.0, -3.0]);
    for (text, expected) in [
        ("1\n2\n", "b:2: the file ends after 2 values; the matrix has 3 rows"),
        ("1\n2\n3\n4\n", "b:4: more values than the 3 rows"),
        ("1\nx\n", "b:2: 'x' is not one finite number"),
        ("%%MatrixMarket matrix array real general\n2 1\n", "b:2: expected '3 1'"),
        ("%%MatrixMarket matrix coordinate real general\n", "b:1: expected '%%MatrixMarket matrix array real general'"),
    ] {
        let message = parse(text).expect_err("must be refused").to_string();
        assert!(message.starts_with(expected), "{message}");
    }
    let mut out = Vec::new();
    let x = [0.1, -1e-300, 3.0];
    write_solution(&mut out, &x).expect("writes into memory");
    assert_eq!(parse_right_hand_side(&out[..], 3, "x").expect("own format"), x);
}

/// A CLTHBSR1 file with two block rows, 4 I on the diagonal and -I beside it.
fn block_csr(value_bytes: u32) -> Vec<u8> {
    let mut bytes = BLOCK_CSR_MAGIC.to_vec();
    bytes.extend([2u64, 4].iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend([3, value_bytes].iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend([0u64, 2, 4].iter().flat_map(|v| v.to_le_bytes()));
    bytes.extend([0u32, 1, 0, 1].iter().flat_map(|v| v.to_le_bytes()));
    let mut push = |v: f64| match value_bytes {
        4 => bytes.extend((v as f32).to_le_bytes()),
        _ => bytes.extend(v.to_le_bytes()),
    };
    for diagonal in [4.0, -1.0, -1.0, 4.0] {
        (0..9).for_each(|c| push(if c % 4 == 0 { diagonal } else { 0.0 }));
    }
    (0..6).for_each(|i| push(i as f64));
    bytes
}

#[test]
fn block_csr_by_hand_in_both_precisions() {
    for value_bytes in [4, 8] {
        let bytes = block_csr(value_bytes);
        let (system, rhs) = parse_block_csr(&bytes[..], bytes.len() as u64, "a.bsr").expect("valid");
        assert_eq!((system.block_rows(), system.blocks(), rhs), (2, 4, vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0]));
        assert_eq!(matches!(system.values, Values::F32(_)), value_bytes == 4);
        // (4 I, -I; -I, 4 I) x = b: x = (4 b0 + b1, b0 + 4 b1) / 15.
        let result = solve_one(&system, &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0], 1e-10);
        for (x, exact) in result.x.iter().zip([3.0, 8.0, 13.0, 12.0, 17.0, 22.0].map(|v| v / 15.0)) {
            assert!((x - exact).abs() < 1e-9, "{:?}", result.x);
        }
    }
}

#[test]
fn block_csr_refusals_name_the_byte() {
    let refused = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = block_csr(4);
        change(&mut bytes);
        parse_block_csr(&bytes[..], bytes.len() as u64, "a.bsr").expect_err("must be refused").to_string()
    };
    assert!(refused(&|b| b.truncate(20)).starts_with("a.bsr, byte 0: the file has 20 bytes"));
    assert!(refused(&|b| b.truncate(90)).contains("need a file of 240 bytes, this one has 90"));
    assert!(refused(&|b| b[0] = 0).contains("CLTHBSR1"));
    assert!(refused(&|b| b[24] = 2).starts_with("a.bsr, byte 24: the block size is 2"));
    assert!(refused(&|b| b[28] = 2).starts_with("a.bsr, byte 28: a value has 2 bytes"));
    assert!(refused(&|b| b[8] = 0).starts_with("a.bsr, byte 8: the matrix has no rows"));
    assert!(refused(&|b| b[15] = 255).contains("at most"));
    assert!(refused(&|b| b[40] = 9).starts_with("a.bsr, byte 40: row start 1 is 9"));
    assert!(refused(&|b| b[60] = 2).starts_with("a.bsr, byte 60: block row 0 names column 2"));
    assert!(refused(&|b| b[60] = 0).starts_with("a.bsr, byte 60: the columns of block row 0 do not ascend"));
    assert!(
        refused(&|b| b[72..76].copy_from_slice(&f32::NAN.to_le_bytes()))
            .contains("row 1, column 1: the value is not a finite")
    );
    assert!(
        refused(&|b| b[216..220].copy_from_slice(&f32::NAN.to_le_bytes()))
            .starts_with("a.bsr, byte 216: value 1 of the right-hand side")
    );
    assert!(refused(&|b| b[108..112].copy_from_slice(&5f32.to_le_bytes())).contains("not symmetric: row 1, column 4"));
}

proptest! {
    #[test]
    fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _ = parse_matrix_market(&bytes[..], bytes.len() as u64, "a");
        let _ = parse_block_csr(&bytes[..], bytes.len() as u64, "a");
        let _ = parse_right_hand_side(&bytes[..], 3, "a");
    }

    #[test]
    fn arbitrary_market_text_never_panics(body in "[0-9 .e\n%-]{0,200}", symmetry in "(symmetric|general)") {
        let text = format!("%%MatrixMarket matrix coordinate real {symmetry}\n{body}");
        let _ = market(&text);
    }

    #[test]
    fn a_damaged_block_csr_file_never_panics(at in 0usize..240, byte in any::<u8>()) {
        let mut bytes = block_csr(4);
        bytes[at] = byte;
        let _ = parse_block_csr(&bytes[..], bytes.len() as u64, "a");
    }
}
