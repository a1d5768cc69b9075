//! `loomtree solve` as a user calls it: real worker processes, and matrices of other fields.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use loomtree::linear_system::read_right_hand_side;

fn solve(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_loomtree"));
    command.args(["solve", "--executor", "cpu"]).args(arguments).output().expect("the program starts")
}

/// The report of a solve and its exit code.
fn report(arguments: &[&str]) -> (serde_json::Value, Option<i32>) {
    let output = solve(arguments);
    let text = String::from_utf8_lossy(&output.stdout);
    let complaint = String::from_utf8_lossy(&output.stderr);
    let json = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}{complaint}"));
    (json, output.status.code())
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
    let (json, code) = report(&[&matrix, "--rhs", &rhs, "--rtol", "1e-9", "--workers", "2", "--solution", &out]);
    assert_eq!(code, Some(0));
    assert_eq!((json["rows"].as_u64(), json["workers"].as_u64()), (Some(4), Some(2)));
    for key in ["iterations", "converged", "relative_residual", "seconds", "bytes_exchanged"] {
        assert!(!json[key].is_null(), "{key} is missing in {json}");
    }
    let x = read_right_hand_side(&solution, 4).expect("a Matrix Market array");
    for (x, exact) in x.iter().zip([1.0, 1.0, 0.5, 1.0]) {
        assert!((x - exact).abs() < 1e-8, "{x} instead of {exact}");
    }
}

#[test]
fn a_solve_that_does_not_converge_exits_with_1() {
    let (_folder, matrix) = folder();
    let output = solve(&[&matrix, "--max-iterations", "0"]);
    assert_eq!(output.status.code(), Some(1));
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(complaint.contains("not converged: relative residual 1.000e0 after 0 iterations"), "{complaint}");
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("the report is printed all the same");
    assert_eq!(json["converged"], false);
}

#[test]
fn an_indefinite_matrix_is_a_sentence_with_exit_code_1() {
    let (folder, _) = folder();
    let matrix = folder.path().join("indefinite.mtx");
    std::fs::write(
        &matrix,
        "%%MatrixMarket matrix coordinate real symmetric\n4 4 5\n1 1 1\n2 2 1\n3 3 1\n4 4 1\n4 1 3\n",
    )
    .expect("writes");
    // Rows 1 and 4 against each other: the direction in which the matrix is negative.
    let rhs = folder.path().join("b.txt");
    std::fs::write(&rhs, "1\n0\n0\n-1\n").expect("writes");
    let (matrix, rhs) = (matrix.display().to_string(), rhs.display().to_string());
    let output = solve(&[&matrix, "--rhs", &rhs, "--rtol", "1e-6"]);
    assert_eq!(output.status.code(), Some(1));
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(complaint.contains("not positive definite: p'Ap = -"), "{complaint}");
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("the report is printed all the same");
    let residual = json["relative_residual"].as_f64().expect("a number");
    assert!(json["converged"] == false && residual > 1e-6 && residual <= 1.0, "{json}");
}

#[test]
fn a_singular_matrix_is_refused_and_a_stiff_one_goes_on_in_double_precision() {
    let folder = tempfile::tempdir().expect("a folder");
    let chain = |name: &str, rows: usize, ratio: f64, ends: [f64; 2]| {
        let stiffness = |i: usize| match i {
            0 => ends[0],
            i if i == rows => ends[1],
            i => [1.0, ratio][i % 2],
        };
        let mut lines = vec![format!("1 1 {}", stiffness(0) + stiffness(1))];
        for i in 2..=rows {
            lines.push(format!("{i} {i} {}", stiffness(i - 1) + stiffness(i)));
            lines.push(format!("{i} {} -{}", i - 1, stiffness(i - 1)));
        }
        let path = folder.path().join(name).display().to_string();
        let header = "%%MatrixMarket matrix coordinate real symmetric";
        let text = format!("{header}\n{rows} {rows} {}\n{}\n", lines.len(), lines.join("\n"));
        std::fs::write(&path, text).expect("writes");
        path
    };
    let output = solve(&[&chain("free.mtx", 200, 1.0, [0.0, 0.0])]);
    assert_eq!(output.status.code(), Some(2));
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(complaint.contains("free.mtx: the matrix is singular"), "{complaint}");
    let output = solve(&[&chain("stiff.mtx", 300, 1e3, [1.0, 1.0]), "--rtol", "1e-6"]);
    assert_eq!(output.status.code(), Some(0));
    let complaint = String::from_utf8_lossy(&output.stderr);
    assert!(complaint.contains("stiff.mtx: single precision cannot solve this system"), "{complaint}");
    let json: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert!(json["double_precision_iterations"].as_u64() > Some(100), "{json}");
    assert!(json["relative_residual"].as_f64() <= Some(1e-6), "{json}");
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
        let output = solve(&arguments);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
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
        for rtol in ["1e-2", "1e-5", "1e-8", "1e-10"] {
            let scalar_jacobi = counts[rtol].as_u64();
            for workers in ["1", "3"] {
                let (json, code) = report(&[&matrix, "--rtol", rtol, "--workers", workers]);
                println!("{name} (cond {condition:.1e}) rtol {rtol}, scalar Jacobi in f64 {scalar_jacobi:?}: {json}");
                assert_eq!(code, Some(0), "{name}: {json}");
                let residual = json["relative_residual"].as_f64().expect("a number");
                assert!(residual <= rtol.parse::<f64>().expect("a number"), "{name}: {json}");
            }
        }
    }
}

/// A grid of 24 x 24 springs in row order as Matrix Market text, three unknowns per point.
fn grid() -> String {
    const SIDE: usize = 24;
    let (mut lines, mut diagonal) = (Vec::new(), vec![0.02f64; SIDE * SIDE * 3]);
    for i in 0..SIDE {
        for j in 0..SIDE {
            for (a, b) in [(i + 1, j), (i, j + 1)].into_iter().filter(|&(a, b)| a < SIDE && b < SIDE) {
                for c in 0..3 {
                    let (row, column) = ((a * SIDE + b) * 3 + c, (i * SIDE + j) * 3 + c);
                    lines.push(format!("{} {} -1", row + 1, column + 1));
                    diagonal[row] += 1.0;
                    diagonal[column] += 1.0;
                }
            }
        }
    }
    lines.extend(diagonal.iter().enumerate().map(|(row, v)| format!("{} {} {v}", row + 1, row + 1)));
    let rows = diagonal.len();
    format!("%%MatrixMarket matrix coordinate real symmetric\n{rows} {rows} {}\n{}\n", lines.len(), lines.join("\n"))
}

#[test]
fn every_preconditioner_reaches_the_residual_and_the_solution_is_in_the_order_of_the_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let matrix = folder.path().join("grid.mtx");
    std::fs::write(&matrix, grid()).expect("writes");
    let (matrix, out) = (matrix.display().to_string(), folder.path().join("x.mtx").display().to_string());
    for (preconditioner, used) in [("jacobi", "jacobi"), ("schwarz", "schwarz"), ("auto", "schwarz")] {
        let mut bits = Vec::new();
        for workers in ["1", "2", "3"] {
            let common = ["--rtol", "1e-7", "--workers", workers, "--solution", &out];
            let (json, code) = report(&[&[matrix.as_str(), "--preconditioner", preconditioner], &common[..]].concat());
            assert_eq!(code, Some(0), "{json}");
            assert_eq!(json["preconditioner"], used);
            assert!(json["relative_residual"].as_f64().expect("a number") <= 1e-7, "{json}");
            let text = std::fs::read_to_string(&out).expect("a solution");
            let x: Vec<f64> = text.lines().filter_map(|line| line.trim().parse().ok()).collect();
            assert_eq!(x.len(), 24 * 24 * 3);
            // The right-hand side is A * 1.
            assert!(x.iter().all(|x| (x - 1.0).abs() < 1e-4), "{x:?}");
            bits.push(text);
        }
        assert!(bits.iter().all(|text| *text == bits[0]), "{preconditioner}: the bits depend on the workers");
    }
}

fn loomtree(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_loomtree")).args(arguments).output().expect("the program starts")
}

#[test]
fn a_trace_of_a_solve_is_predicted_on_another_machine() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    std::fs::write(path("grid.mtx"), grid()).expect("writes");
    let topology = Path::new(env!("CARGO_MANIFEST_DIR")).join("topology/pcie_4.toml").display().to_string();
    for (exchange, preconditioner) in [("halo", "jacobi"), ("halo", "schwarz"), ("full", "jacobi")] {
        let trace = path(&format!("{exchange}-{preconditioner}"));
        let flags = ["--exchange", exchange, "--preconditioner", preconditioner, "--repeat", "3", "--trace", &trace];
        let (json, code) =
            report(&[&[path("grid.mtx").as_str(), "--workers", "2", "--rtol", "1e-7"], &flags[..]].concat());
        assert_eq!(code, Some(0), "{json}");
        for kernels in ["device", "recorded"] {
            let output = loomtree(&["predict", &trace, "--topology", &topology, "--json", "--kernels", kernels]);
            let found: serde_json::Value = serde_json::from_slice(&output.stdout)
                .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&output.stderr)));
            let steps = found["steps"].as_array().expect("steps");
            assert_eq!((steps.len(), &found["exchange"]), (3, &json["exchange"]), "{found:#}");
            assert_eq!(found["scene"], "grid.mtx");
            // Solves do the same every time; most of it is products, vectors and reductions.
            for step in steps {
                let (solve, all) = (step["stage_modelled_s"]["solve"].as_f64(), step["modelled_s"].as_f64());
                assert!(solve > Some(0.5 * all.expect("seconds")), "{step:#}");
            }
            if kernels == "device" {
                assert_eq!(steps[0]["modelled_s"], steps[2]["modelled_s"], "{found:#}");
            }
            assert!(found["memory_bytes_per_gpu"][1].as_u64() > Some(10_000), "{found:#}");
        }
        // What is there is kept.
        let again = solve(&[&path("grid.mtx"), "--trace", &trace]);
        let message = String::from_utf8_lossy(&again.stderr);
        assert_eq!(again.status.code(), Some(2), "{message}");
        assert!(message.contains("--trace") && message.contains("already holds a report"), "{message}");
    }
    let on_file = solve(&[&path("grid.mtx"), "--trace", &path("grid.mtx")]);
    assert_eq!(on_file.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&on_file.stderr).contains("is a file; name a folder"));
}
