//! `loomtree ccd --frames A B --pairs F.csv`: runs the whole detection (hash table, then continuous test) between two
//! frames of a mesh and checks that the true pairs of a table are among its results.
//!
//! Vertices are numbered from 0 in the order of the frames. Coordinates are rounded to f32 first, so the table must
//! hold the truth after rounding. Reported pairs outside the table are counted but not judged, because their truth is
//! unknown.

use std::collections::{HashMap, HashSet};
use std::io::{BufReader, Write};
use std::path::Path;
use std::time::Instant;

use serde::Serialize;

use super::CliError;
use super::ccd_csv::{CcdKind, CsvFault, columns, in_file, lines, parse_flag, parse_time, read, shown, write_json};
use crate::collision::broad::{CollisionMesh, Split};
use crate::collision::{Candidate, ContactParams, Detector, Impact};
use crate::gpu::CpuExecutor;
use crate::mesh::{ParseFault, Surface, parse_obj, parse_ply};
use crate::transport::cores;

/// A row of a table of pairs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TruePair {
    /// Line of the table, counting from 1.
    pub line: usize,
    /// One vertex and three face corners, or two edges.
    pub vertices: [u32; 4],
    /// True if they touch.
    pub hit: bool,
    /// Earliest time of contact, if known.
    pub toi: Option<f64>,
}

/// The printed report.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct FramesReport {
    pub kind: &'static str,
    /// Rows of the table.
    pub pairs: usize,
    /// Rows that are true contacts.
    pub hits: usize,
    /// True contacts that detection reports.
    pub found: usize,
    /// True contacts that detection does not report.
    pub missed: usize,
    /// True contacts reported with a later time than the truth, which is as bad as a miss.
    pub late: usize,
    /// Rows that detection reports although they do not touch according to the table.
    pub false_hits: usize,
    /// "rounded" or "unrounded": the column of the table that was used.
    pub truth: &'static str,
    /// All impacts between the frames that detection reports, of both kinds.
    pub impacts: u64,
    /// Pairs of features that the broad phase reports.
    pub candidates: u64,
    /// Candidates that the elementary tests examined.
    pub tested: u64,
    pub triangles: usize,
    pub seconds: f64,
}

/// Runs the command.
///
/// # Errors
/// A file cannot be read or does not match the others (exit code 2), or a true pair is missed or found too late (exit
/// code 1).
pub(super) fn write_frames(
    frames: [&Path; 2],
    pairs: &Path,
    kind: Option<CcdKind>,
    separation_m: f32,
    out: &mut impl Write,
) -> Result<(), CliError> {
    let [start, end] = frames;
    let (first, second) = (read_frame(start)?, read_frame(end)?);
    if first.positions.len() != second.positions.len() {
        let (one, other) = (first.positions.len(), second.positions.len());
        let what = format!("{other} vertices, but {} has {one}; frames of one mesh have as many", start.display());
        return Err(CliError::bad_input(format!("{}: {what}", end.display())));
    }
    if first.triangles != second.triangles {
        let what = format!("its triangles are not those of {}; frames of one mesh have the same", start.display());
        return Err(CliError::bad_input(format!("{}: {what}", end.display())));
    }
    let (table, truth) = parse_pairs(&read(pairs)?).map_err(|fault| in_file(pairs, &fault))?;
    let mesh = CollisionMesh::new(first.positions.len(), first.positions.len(), first.triangles.clone())
        .map_err(|fault| CliError::bad_input(format!("{}: {fault}", start.display())))?;
    let features = Features::new(&mesh);
    let kind = features.kind_of(&table, kind).map_err(|fault| in_file(pairs, &fault))?;
    let report = search(mesh, &features, [&first, &second], &table, kind, truth, separation_m)?;
    write_json(&report, out)?;
    if report.missed + report.late > 0 {
        let (name, missed, late) = (pairs.display(), report.missed, report.late);
        return Err(CliError::failed(format!("{name}: {missed} contacts missed, {late} found later than they happen")));
    }
    Ok(())
}

fn search(
    mesh: CollisionMesh,
    features: &Features,
    [first, second]: [&Surface; 2],
    table: &[TruePair],
    kind: CcdKind,
    truth: &'static str,
    separation_m: f32,
) -> Result<FramesReport, CliError> {
    let (vertices, triangles) = (mesh.vertices, mesh.triangles.len());
    let params = ContactParams {
        thickness_m: 0.0,
        separation_m,
        stiffness_ratio: 0.0,
        step_s: 1.0,
        friction: vec![0.0; vertices],
        inverse_masses_per_kg: vec![1.0; vertices],
        smallest_altitudes_m: vec![0.0; vertices],
        friction_factors: Vec::new(),
        thickness_factors: Vec::new(),
    };
    let mut detector = Detector::new(mesh, params).map_err(CliError::failed)?;
    let cpu = CpuExecutor::new(cores());
    let (x_t0, x_t1) = (bytemuck::cast_slice(&first.positions), bytemuck::cast_slice(&second.positions));
    let started = Instant::now();
    let mut impacts: Vec<Impact> = Vec::new();
    let stats =
        detector.impacts(&cpu, x_t0, x_t1, None, &mut Split::alone(0, 1), &mut impacts).map_err(CliError::bad_input)?;
    let seconds = started.elapsed().as_secs_f64();
    let found = |pair: &TruePair| {
        let wanted = features.candidate(pair, kind)?;
        impacts.binary_search_by_key(&wanted, |impact| impact.candidate).ok().map(|at| impacts[at].toi)
    };
    let answers: Vec<(Option<f32>, &TruePair)> = table.iter().map(|pair| (found(pair), pair)).collect();
    let count = |wanted: fn(&Option<f32>, &TruePair) -> bool| answers.iter().filter(|(a, p)| wanted(a, p)).count();
    Ok(FramesReport {
        kind: if kind == CcdKind::Vf { "vf" } else { "ee" },
        pairs: table.len(),
        hits: count(|_, pair| pair.hit),
        found: count(|toi, pair| toi.is_some() && pair.hit),
        missed: count(|toi, pair| toi.is_none() && pair.hit),
        // The true time is rounded as well.
        late: count(
            |toi, pair| matches!((toi, pair.toi), (Some(ours), Some(exact)) if f64::from(*ours) > exact.next_up()),
        ),
        false_hits: count(|toi, pair| toi.is_some() && !pair.hit),
        truth,
        impacts: stats.found,
        candidates: stats.broad.candidates,
        tested: stats.tested,
        triangles,
        seconds,
    })
}

/// Reads a frame without validation, because frames from other programs can be non-manifold or have vertices without
/// triangles.
fn read_frame(path: &Path) -> Result<Surface, CliError> {
    let unreadable =
        |error: std::io::Error| CliError::bad_input(format!("{}: cannot be read: {error}", path.display()));
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    if extension != "obj" && extension != "ply" {
        return Err(CliError::bad_input(format!("{}: a frame ends in .obj or .ply", path.display())));
    }
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let bytes = file.metadata().map_err(unreadable)?.len();
    let reader = BufReader::with_capacity(1 << 16, file);
    let surface = if extension == "obj" { parse_obj(reader) } else { parse_ply(reader, bytes) };
    surface.map_err(|ParseFault { line, what }| {
        let line = line.map(|line| format!(", line {line}")).unwrap_or_default();
        CliError::bad_input(format!("{}{line}: {what}", path.display()))
    })
}

/// Faces (by sorted corners) and edges.
struct Features {
    faces: HashMap<[u32; 3], [u32; 3]>,
    edges: HashSet<[u32; 2]>,
}

fn sorted<const N: usize>(mut vertices: [u32; N]) -> [u32; N] {
    vertices.sort_unstable();
    vertices
}

impl Features {
    fn new(mesh: &CollisionMesh) -> Features {
        Features {
            faces: mesh.triangles.iter().map(|&face| (sorted(face), face)).collect(),
            edges: mesh.edges.iter().copied().collect(),
        }
    }

    /// The pair as a candidate of detection, if both features exist and share no vertex.
    fn candidate(&self, pair: &TruePair, kind: CcdKind) -> Option<Candidate> {
        let [a, b, c, d] = pair.vertices;
        match kind {
            CcdKind::Vf if ![b, c, d].contains(&a) => {
                self.faces.get(&sorted([b, c, d])).map(|&face| Candidate::vertex_face(a, face))
            }
            CcdKind::Ee if ![c, d].contains(&a) && ![c, d].contains(&b) => {
                let both = [[a, b], [c, d]].iter().all(|&edge| self.edges.contains(&sorted(edge)));
                both.then(|| Candidate::edge_edge([a, b], [c, d]))
            }
            _ => None,
        }
    }

    /// The kind of all pairs of a table: the requested one, or the only one that fits.
    fn kind_of(&self, table: &[TruePair], asked: Option<CcdKind>) -> Result<CcdKind, CsvFault> {
        let stranger = |kind: CcdKind| table.iter().find(|pair| self.candidate(pair, kind).is_none());
        let fault =
            |pair: &TruePair, what: &str| CsvFault { line: pair.line, what: format!("{:?} {what}", pair.vertices) };
        match (asked, stranger(CcdKind::Vf), stranger(CcdKind::Ee)) {
            (Some(CcdKind::Vf), Some(pair), _) => {
                Err(fault(pair, "is not a vertex and the corners of a face of the frames"))
            }
            (Some(CcdKind::Ee), _, Some(pair)) => {
                Err(fault(pair, "is not two edges of the frames without a common vertex"))
            }
            (Some(kind), _, _) => Ok(kind),
            (None, None, Some(_)) => Ok(CcdKind::Vf),
            (None, Some(_), None) => Ok(CcdKind::Ee),
            (None, Some(pair), Some(_)) => {
                Err(fault(pair, "is neither a vertex and a face nor two edges of the frames"))
            }
            (None, None, None) => {
                Err(CsvFault { line: 1, what: "the pairs fit both kinds; say which with --kind vf or ee".into() })
            }
        }
    }
}

/// Reads a table of pairs: a header line with the columns `i0` to `i3`, the truth `hit_f32` (or `hit`, before rounding)
/// and optionally its time `toi_f32` (or `toi`), then one row per pair.
///
/// # Errors
/// A column is missing, or a row has an invalid entry in it.
pub(super) fn parse_pairs(bytes: &[u8]) -> Result<(Vec<TruePair>, &'static str), CsvFault> {
    let mut lines = lines(bytes);
    let missing =
        |line, column: &str| CsvFault { line, what: format!("no column {column}; the first line names the columns") };
    let (line, header) = lines.next().ok_or_else(|| missing(1, "i0"))?;
    let names = columns(header).map_err(|what| CsvFault { line, what })?;
    let column = |name: &str| names.iter().position(|&other| other == name);
    let mut vertices = [0; 4];
    for (i, place) in vertices.iter_mut().enumerate() {
        let name = format!("i{i}");
        *place = column(&name).ok_or_else(|| missing(line, &name))?;
    }
    let rounded = column("hit_f32");
    let hit = rounded.or_else(|| column("hit")).ok_or_else(|| missing(line, "hit_f32"))?;
    let toi = column(if rounded.is_some() { "toi_f32" } else { "toi" });
    let rows = lines.map(|(line, text)| {
        let fault = |what: String| CsvFault { line, what };
        let row = columns(text).map_err(fault)?;
        let entry = |at: usize| row.get(at).copied().unwrap_or_default();
        let mut pair = TruePair { line, vertices: [0; 4], hit: parse_flag(entry(hit)).map_err(fault)?, toi: None };
        for (vertex, &at) in pair.vertices.iter_mut().zip(&vertices) {
            let text = entry(at);
            *vertex =
                text.parse().map_err(|_| fault(format!("{} is no vertex; write its number from 0", shown(text))))?;
        }
        let time = toi.map(entry).filter(|text| pair.hit && !text.is_empty());
        pair.toi = time.map(parse_time).transpose().map_err(fault)?;
        Ok(pair)
    });
    Ok((rows.collect::<Result<_, _>>()?, if rounded.is_some() { "rounded" } else { "unrounded" }))
}
