//! `loomtree solve` as a library call and the matrices of other fields.

use std::path::{Path, PathBuf};

use loomtree::cli::solve::{SolveArgs, SolveJob, prepare, report, run_in_process};
use loomtree::linear_system::{SolveStats, read_right_hand_side};

#[derive(clap::Parser)]
struct Command {
    #[command(flatten)]
    args: SolveArgs,
}

fn job(arguments: &[&str]) -> Result<SolveJob, String> {
    let arguments = ["solve", "--executor", "cpu"].iter().chain(arguments);
    let command = <Command as clap::Parser>::try_parse_from(arguments).map_err(|error| error.to_string())?;
    prepare(command.args).map_err(|error| {
        assert_eq!(error.exit_code, 2);
        error.message
    })
}

fn stats(arguments: &[&str]) -> SolveStats {
    let (results, executor) = run_in_process(job(arguments).expect("a valid job")).expect("solves");
    assert_eq!(executor, "cpu");
    results[0].stats.clone()
}

/// A temporary folder with a 4x4 matrix; its block rows are 2.
fn folder() -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let matrix = folder.path().join("a.mtx");
    let text = "%%MatrixMarket matrix coordinate real symmetric\n4 4 5\n1 1 2\n2 2 4\n3 3 8\n4 4 2\n4 1 1\n";
    std::fs::write(&matrix, text).expect("writes");
    (folder, matrix.display().to_string())
}

#[test]
fn the_solution_is_written_and_read_back() {
    let (folder, matrix) = folder();
    let (rhs, solution) = (folder.path().join("b.txt"), folder.path().join("x.mtx"));
    std::fs::write(&rhs, "3\n4\n4\n3\n").expect("writes");
    let (rhs, out) = (rhs.display().to_string(), solution.display().to_string());
    let job = job(&[&matrix, "--rhs", &rhs, "--rtol", "1e-9", "--workers", "2", "--solution", &out]).expect("valid");
    let facts = job.facts();
    let (results, executor) = run_in_process(job).expect("solves");
    report(&facts, &executor, &results).expect("converged and written");
    let x = read_right_hand_side(&solution, 4).expect("a Matrix Market array");
    for (x, exact) in x.iter().zip([1.0, 1.0, 0.5, 1.0]) {
        assert!((x - exact).abs() < 1e-8, "{x} instead of {exact}");
    }
}

#[test]
fn a_solve_that_does_not_converge_exits_with_1() {
    let (_folder, matrix) = folder();
    let job = job(&[&matrix, "--max-iterations", "0"]).expect("valid");
    let facts = job.facts();
    let (results, executor) = run_in_process(job).expect("ends");
    let error = report(&facts, &executor, &results).expect_err("not converged");
    assert_eq!(error.exit_code, 1);
    assert!(error.message.starts_with("not converged: relative residual 1.000e0 after 0 iterations"), "{error}");
}

#[test]
fn bad_usage_is_one_sentence() {
    let (folder, matrix) = folder();
    let missing = folder.path().join("nowhere").join("x.mtx").display().to_string();
    for (arguments, expected) in [
        (vec![matrix.as_str(), "--workers", "3"], "--workers 3: the matrix has only 2 block rows"),
        (vec![&matrix, "--workers", "0"], "--workers 0: expected 1 to"),
        (vec![&matrix, "--solution", &missing], "there is no folder"),
        (vec![&matrix, "--rhs", "matrix"], "holds no right-hand side"),
        (vec![&matrix, "--rhs", &missing], "nowhere"),
        (vec![missing.as_str()], "nowhere"),
        (vec![&matrix, "--rtol", "2"], "expected a number between 0 and 1"),
    ] {
        let message = job(&arguments).err().expect("must be refused");
        assert!(message.contains(expected), "{message}");
    }
}

fn data_sets() -> Option<(PathBuf, serde_json::Value)> {
    let Some(root) = std::env::var_os("LOOMTREE_TEST_DATA") else {
        eprintln!("skipped: LOOMTREE_TEST_DATA is not set");
        return None;
    };
    let folder = Path::new(&root).join("spd");
    let index = std::fs::read_to_string(folder.join("index.json")).expect("the index of the data sets");
    Some((folder, serde_json::from_str(&index).expect("JSON")))
}

#[test]
fn matrices_of_other_fields_reach_their_tolerance() {
    let Some((folder, index)) = data_sets() else { return };
    for (name, facts) in index.as_object().expect("an object") {
        let matrix = folder.join(format!("{name}.mtx")).display().to_string();
        let condition = facts["cond"].as_f64().expect("cond");
        let counts = &facts["jacobi_pcg_iterations_f64"];
        for rtol in ["1e-2", "1e-5", "1e-8"] {
            let scalar_jacobi = counts[rtol].as_u64().expect("a count");
            for workers in ["1", "3"] {
                let stats = stats(&[&matrix, "--rtol", rtol, "--workers", workers]);
                println!(
                    "{name} (cond {condition:.1e}) rtol {rtol}, {workers} workers: {} iterations (scalar Jacobi in f64: {scalar_jacobi}), {} corrections, residual {:.2e}, converged {}",
                    stats.iterations, stats.refinements, stats.relative_residual, stats.converged
                );
                assert!(stats.converged, "{name}: {stats:?}");
                assert!(stats.relative_residual <= rtol.parse::<f64>().expect("a number"));
            }
        }
    }
}
