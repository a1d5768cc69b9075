//! `loomtree ccd`: runs the continuous collision test on a file of queries with rational coordinates and counts misses
//! and false hits against the file's truth.
//!
//! The product works in f32, so coordinates are rounded to f32 first. Rounding changes the query and often its answer.
//! The truth for the rounded query comes from the first of these: `--truth`; `STEM.exact.csv` beside the queries;
//! `KIND_pairs.csv` in the folder above. The last two have a column `hit_f32` with one row per query in the same order.
//! Without them, the seventh column of the queries is used. It answers the query before rounding, so "truth" in the
//! output is "unrounded" and a miss can be an effect of rounding. Without any truth, "missed" and "false_hits" are
//! null.
//!
//! `--frames` runs another test, see `ccd_frames`.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde::Serialize;

use super::CliError;
pub use super::ccd_csv::{CcdKind, CsvFault};
use super::ccd_csv::{columns, in_file, lines, parse_flag, parse_time, read, shown, write_json};
use super::ccd_frames::write_frames;
use crate::collision::elementary::{CandidateKind, DecidedBy, ccd};
use crate::math::Vec3;

/// Rows of a query: four vertices at the start and four at the end of the step.
const ROWS: usize = 8;

/// Arguments of `loomtree ccd`.
#[derive(Clone, Debug, clap::Args)]
pub struct CcdArgs {
    /// CSV, 8 rows per query: x, y, z as numerator, denominator each, then optionally the truth (0 or 1)
    #[arg(required_unless_present = "frames", conflicts_with = "frames")]
    pub queries: Option<PathBuf>,
    /// vf = rows are vertex, face corners; ee = first edge, second edge; needed for queries, for pairs only if both fit
    #[arg(long, required_unless_present = "frames")]
    pub kind: Option<CcdKind>,
    /// Two frames of a mesh (PLY or OBJ): run the whole detection between them instead
    #[arg(long, num_args = 2, value_names = ["START", "END"], requires = "pairs")]
    pub frames: Option<Vec<PathBuf>>,
    /// CSV with columns i0, i1, i2, i3 (vertices of the frames from 0) and hit_f32: every true pair must be found
    #[arg(long, value_name = "CSV", requires = "frames")]
    pub pairs: Option<PathBuf>,
    /// Distance that counts as contact, metres
    #[arg(long, value_name = "METRES", default_value_t = 0.0, value_parser = separation)]
    pub minimum_separation: f32,
    /// CSV with a column hit_f32 (and toi_f32): the truth for coordinates rounded to f32, one row per query
    #[arg(long, value_name = "CSV", conflicts_with = "frames")]
    pub truth: Option<PathBuf>,
}

fn separation(text: &str) -> Result<f32, String> {
    match text.parse::<f32>() {
        Ok(value) if value >= 0.0 && value.is_finite() => Ok(value),
        _ => Err("a distance is a number of metres, 0 or more".into()),
    }
}

/// A query with coordinates rounded to f32.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Query {
    /// Positions at the start of the step.
    pub x_t0: [Vec3; 4],
    /// Positions at the end of the step.
    pub x_t1: [Vec3; 4],
    /// Answer before rounding, if the file has the seventh column.
    pub hit: Option<bool>,
}

/// True answer of a query.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Truth {
    /// True if the features touch.
    pub hit: bool,
    /// Earliest time of contact, if known.
    pub toi: Option<f64>,
}

/// The printed report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CcdReport {
    /// Queries in the file.
    pub queries: usize,
    /// Queries that the test reports as hits.
    pub hits: usize,
    /// True hits that were not found; null without a truth.
    pub missed: Option<usize>,
    /// Reported hits that are not true; null without a truth.
    pub false_hits: Option<usize>,
    /// Reported hits with a later time than the truth, which is as bad as a miss.
    pub late: Option<usize>,
    /// "rounded", "unrounded" or "none", see the module's documentation.
    pub truth: &'static str,
    /// Number of queries decided by each part of the test.
    pub decided_by: DecidedByCounts,
    /// Wall time of the tests alone on one thread, nanoseconds.
    pub ns_per_query: f64,
}

/// Number of queries decided by each part of the test.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct DecidedByCounts {
    /// The boxes of the two trajectories are disjoint.
    pub boxes: usize,
    /// Separating planes exist, or bisection found a hit.
    pub planes: usize,
    /// The test in wider arithmetic decided.
    pub fallback: usize,
    /// The limit of planes was reached. The query counts as a hit, which is the safe side.
    pub plane_limit: usize,
}

/// Runs the command; the report goes to stdout.
///
/// # Errors
/// A file cannot be read or is malformed (exit code 2), or a hit was missed or found too late (exit code 1).
pub fn run(args: CcdArgs) -> Result<(), CliError> {
    write_ccd(&args, &mut io::stdout().lock())
}

/// Runs the command and writes the report to `out`. A closed pipe is not an error.
///
/// # Errors
/// Those of [`run`].
pub fn write_ccd(args: &CcdArgs, out: &mut impl Write) -> Result<(), CliError> {
    if let (Some([start, end]), Some(pairs)) = (args.frames.as_deref(), &args.pairs) {
        return write_frames([start, end], pairs, args.kind, args.minimum_separation, out);
    }
    let (Some(file), Some(kind)) = (&args.queries, args.kind) else {
        return Err(CliError::bad_input("give a file of queries with --kind, or --frames with --pairs"));
    };
    let queries = parse_queries(&read(file)?).map_err(|fault| in_file(file, &fault))?;
    let (truth, truth_name) = truth_of(args, file, kind, &queries)?;
    let kind = if kind == CcdKind::Vf { CandidateKind::VertexFace } else { CandidateKind::EdgeEdge };
    let report = check(kind, &queries, truth.as_deref(), truth_name, args.minimum_separation);
    write_json(&report, out)?;
    let (missed, late) = (report.missed.unwrap_or(0), report.late.unwrap_or(0));
    if missed + late > 0 {
        let name = file.display();
        return Err(CliError::failed(format!("{name}: {missed} contacts missed, {late} found later than they happen")));
    }
    Ok(())
}

/// Tests all queries and compares the results with the truth; `truth` has one entry per query.
pub fn check(
    kind: CandidateKind,
    queries: &[Query],
    truth: Option<&[Truth]>,
    truth_name: &'static str,
    minimum_separation: f32,
) -> CcdReport {
    let started = Instant::now();
    let answers: Vec<_> = queries.iter().map(|q| ccd(kind, q.x_t0, q.x_t1, minimum_separation)).collect();
    let ns = started.elapsed().as_nanos() as f64;
    let mut decided_by = DecidedByCounts::default();
    for answer in &answers {
        match answer.decided_by {
            DecidedBy::Boxes => decided_by.boxes += 1,
            DecidedBy::Planes => decided_by.planes += 1,
            DecidedBy::Fallback => decided_by.fallback += 1,
            DecidedBy::PlaneLimit => decided_by.plane_limit += 1,
        }
    }
    let count = |wrong: fn(Option<f32>, &Truth) -> bool| {
        truth.map(|truth| answers.iter().zip(truth).filter(|(answer, truth)| wrong(answer.toi, truth)).count())
    };
    CcdReport {
        queries: queries.len(),
        hits: answers.iter().filter(|answer| answer.toi.is_some()).count(),
        missed: count(|toi, truth| toi.is_none() && truth.hit),
        false_hits: count(|toi, truth| toi.is_some() && !truth.hit),
        // The true time is rounded as well.
        late: count(
            |toi, truth| matches!((toi, truth.toi), (Some(ours), Some(exact)) if f64::from(ours) > exact.next_up()),
        ),
        truth: truth_name,
        decided_by,
        ns_per_query: (ns / queries.len().max(1) as f64).round(),
    }
}

/// The truth and its name in the report.
fn truth_of(
    args: &CcdArgs,
    name: &Path,
    kind: CcdKind,
    queries: &[Query],
) -> Result<(Option<Vec<Truth>>, &'static str), CliError> {
    let kind = if kind == CcdKind::Vf { "vf" } else { "ee" };
    let beside = name.with_extension("exact.csv");
    let above = name.parent().and_then(Path::parent).map(|folder| folder.join(format!("{kind}_pairs.csv")));
    let file = args.truth.clone().or_else(|| [Some(beside), above].into_iter().flatten().find(|path| path.is_file()));
    if let Some(path) = file {
        let truth = parse_truth(&read(&path)?).map_err(|fault| in_file(&path, &fault))?;
        if truth.len() != queries.len() {
            let (path, name, rows, wanted) = (path.display(), name.display(), truth.len(), queries.len());
            return Err(CliError::bad_input(format!("{path}: {rows} rows of truth, but {name} has {wanted} queries")));
        }
        return Ok((Some(truth), "rounded"));
    }
    if args.minimum_separation > 0.0 {
        return Ok((None, "none"));
    }
    let column: Option<Vec<Truth>> = queries.iter().map(|q| q.hit.map(|hit| Truth { hit, toi: None })).collect();
    Ok(match column.filter(|c| !c.is_empty()) {
        Some(truth) => (Some(truth), "unrounded"),
        None => (None, "none"),
    })
}

/// Reads queries; empty lines are skipped.
///
/// # Errors
/// A line is not a vertex, the truth changes within a query, or the last query is incomplete.
pub fn parse_queries(bytes: &[u8]) -> Result<Vec<Query>, CsvFault> {
    let mut queries = Vec::new();
    let mut rows: Vec<(Vec3, Option<bool>)> = Vec::with_capacity(ROWS);
    let mut last = 0;
    for (line, text) in lines(bytes) {
        last = line;
        let row = parse_vertex(text).map_err(|what| CsvFault { line, what })?;
        if rows.first().is_some_and(|first| first.1 != row.1) {
            let what = "the truth differs from that of the rows above; the 8 rows of a query have the same".into();
            return Err(CsvFault { line, what });
        }
        rows.push(row);
        if rows.len() == ROWS {
            let at = |start: usize| std::array::from_fn(|i| rows[start + i].0);
            queries.push(Query { x_t0: at(0), x_t1: at(4), hit: rows[0].1 });
            rows.clear();
        }
    }
    if !rows.is_empty() {
        let what = format!("the file ends after {} rows of a query; a query has {ROWS}", rows.len());
        return Err(CsvFault { line: last, what });
    }
    Ok(queries)
}

fn parse_vertex(text: &[u8]) -> Result<(Vec3, Option<bool>), String> {
    let columns = columns(text)?;
    if columns.len() != 6 && columns.len() != 7 {
        let found = columns.len();
        return Err(format!("{found} columns; a vertex is 3 pairs numerator, denominator, and optionally the truth"));
    }
    let hit = columns.get(6).map(|&text| parse_flag(text)).transpose()?;
    let component = |c: usize| ratio_to_f32(columns[2 * c], columns[2 * c + 1]);
    Ok((Vec3::new(component(0)?, component(1)?, component(2)?), hit))
}

/// The f32 nearest to the quotient of two decimal integers (ties to even). Exact for up to 18 digits each. With more
/// digits the quotient is rounded to f64 first, which is exact if it is an f64 and both integers are.
fn ratio_to_f32(numerator: &str, denominator: &str) -> Result<f32, String> {
    let integer = |text: &str| {
        let digits = text.strip_prefix('-').unwrap_or(text);
        let fine = !digits.is_empty() && digits.len() <= 400 && digits.bytes().all(|b| b.is_ascii_digit());
        if fine { Ok(text.len()) } else { Err(format!("{} is no integer of at most 400 digits", shown(text))) }
    };
    let exact = integer(numerator)? <= 18 && integer(denominator)? <= 18;
    let small = |text: &str| text.parse::<i64>().map_err(|_| format!("{} is no integer", shown(text)));
    let value = if exact {
        let (n, d) = (small(numerator)?, small(denominator)?);
        if d <= 0 {
            return Err(format!("{} is no denominator; write a positive integer", shown(denominator)));
        }
        let magnitude = nearest_f32(n.unsigned_abs(), d.unsigned_abs());
        if n < 0 { -magnitude } else { magnitude }
    } else {
        let wide = |text: &str| text.parse::<f64>().map_err(|_| format!("{} is no integer", shown(text)));
        let (n, d) = (wide(numerator)?, wide(denominator)?);
        if !(d > 0.0 && d.is_finite()) {
            return Err(format!("{} is no denominator; write a positive integer below 1e308", shown(denominator)));
        }
        (n / d) as f32
    };
    if value.is_finite() { Ok(value) } else { Err("the coordinate is too large for single precision".into()) }
}

/// n / d, rounded to the nearest f32, for d > 0 and both below 2^63. The result is never subnormal.
fn nearest_f32(n: u64, d: u64) -> f32 {
    if n == 0 {
        return 0.0;
    }
    // The quotient has 64 or 65 bits plus a bit for a nonzero remainder. Conversion through f64 would round twice, so
    // it is first cut to 30 bits with the rest folded into the last bit. 30 bits fit f64 exactly, so only the step to
    // f32 rounds.
    let shift = 64 + n.leading_zeros() - 1;
    let scaled = u128::from(n) << shift;
    let (quotient, rest) = (scaled / u128::from(d), scaled % u128::from(d));
    let cut = (128 - quotient.leading_zeros()) - 30;
    let left = rest != 0 || quotient & ((1u128 << cut) - 1) != 0;
    let head = ((quotient >> cut) as u64) << 1 | u64::from(left);
    (head as f64 * 2f64.powi(cut as i32 - 1 - shift as i32)) as f32
}

/// Reads a table of truth: a header line with the columns `hit_f32` and optionally `toi_f32`, then one row per query.
///
/// # Errors
/// The column is missing, or a row has an invalid entry in it.
pub fn parse_truth(bytes: &[u8]) -> Result<Vec<Truth>, CsvFault> {
    let mut lines = lines(bytes);
    let missing = |line| CsvFault { line, what: "no column hit_f32; the first line names the columns".into() };
    let (line, header) = lines.next().ok_or_else(|| missing(1))?;
    let names = columns(header).map_err(|what| CsvFault { line, what })?;
    let hit = names.iter().position(|&name| name == "hit_f32").ok_or_else(|| missing(line))?;
    let toi = names.iter().position(|&name| name == "toi_f32");
    lines
        .map(|(line, text)| {
            let fault = |what: String| CsvFault { line, what };
            let row = columns(text).map_err(fault)?;
            let hit = parse_flag(row.get(hit).copied().unwrap_or_default()).map_err(fault)?;
            let toi = match toi.and_then(|c| row.get(c)).filter(|text| hit && !text.is_empty()) {
                None => None,
                Some(text) => Some(parse_time(text).map_err(fault)?),
            };
            Ok(Truth { hit, toi })
        })
        .collect()
}
