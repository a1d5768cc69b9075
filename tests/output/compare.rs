//! `loomtree compare` as a user calls it, on small runs whose distances are known.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use loomtree::State;
use loomtree::math::Vec3;
use loomtree::mesh::TriangleMesh;
use loomtree::output::checkpoint::{Checkpoint, keep};
use loomtree::output::{
    Existing, FrameFormat, FrameRecord, FrameWriter, ReportHeader, ReportWriter, RunDirectory, Status,
};

fn compare(arguments: &[&Path], flags: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_loomtree"));
    command.arg("compare").args(arguments).args(flags).output().expect("the program starts")
}

fn json(arguments: &[&Path], flags: &[&str]) -> serde_json::Value {
    let output = compare(arguments, &[&["--json"], flags].concat());
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON on stdout")
}

fn square() -> TriangleMesh {
    let positions = vec![Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Z, Vec3::Z];
    TriangleMesh { positions, triangles: vec![[0, 1, 2], [0, 2, 3]], material_uv: Vec::new() }
}

/// A run of `frames` frames, two steps each, of a square that has moved by `shift` from frame 1 on.
fn run_of(folder: &Path, mesh: &TriangleMesh, frames: u32, shift: Vec3, format: FrameFormat) {
    let directory = RunDirectory::create(folder, Existing::Overwrite).unwrap();
    let mut writer = FrameWriter::new(&directory, &[format], mesh, 0).unwrap();
    let header = ReportHeader { steps_per_frame: 2, ..ReportHeader::now() };
    let mut report = ReportWriter::create(&directory.report(), header).unwrap();
    fs::create_dir_all(directory.states()).unwrap();
    for frame in 0..frames {
        let moved = if frame == 0 { Vec3::ZERO } else { shift };
        let positions: Vec<Vec3> = mesh.positions.iter().map(|p| *p + moved).collect();
        let velocities = vec![2.0 * moved; positions.len()];
        writer.write(frame, mesh, &positions).unwrap();
        let state = State { positions, velocities, ..State::default() };
        report
            .frame(FrameRecord { frame, time_s: f64::from(frame), state_hash: state.hash(), ..FrameRecord::default() })
            .unwrap();
        keep(&directory.states(), &Checkpoint { frame, step: u64::from(2 * frame), state, ..Checkpoint::default() })
            .unwrap();
    }
    report.finish(Status::Done).unwrap();
}

#[test]
fn runs_with_equal_bits_are_told_so_whatever_their_format() {
    let folder = tempfile::tempdir().unwrap();
    let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
    run_of(&a, &square(), 3, Vec3::X, FrameFormat::Ply);
    run_of(&b, &square(), 3, Vec3::X, FrameFormat::Pc2);
    let found = json(&[&a, &b], &[]);
    assert_eq!(found["equal_bits"], true);
    assert!(found["first_difference"].is_null() && found["seams"].as_array().unwrap().is_empty());
    assert_eq!(found["frames"].as_array().unwrap().len(), 3);
    assert_eq!(found["frames"][2]["rms_m"], 0.0);
    let text = String::from_utf8(compare(&[&a, &b], &[]).stdout).unwrap();
    assert!(text.starts_with("equal bits in all frames\n"), "{text}");
}

#[test]
fn a_shift_is_measured_beside_its_floor() {
    let folder = tempfile::tempdir().unwrap();
    let [a, b, c] = ["a", "b", "c"].map(|name| folder.path().join(name));
    run_of(&a, &square(), 2, Vec3::ZERO, FrameFormat::Ply);
    run_of(&b, &square(), 2, Vec3::new(0.0, 0.5, 0.0), FrameFormat::Ply);
    run_of(&c, &square(), 2, Vec3::new(0.0, 0.125, 0.0), FrameFormat::Ply);
    let (csv, svg) = (folder.path().join("d.csv"), folder.path().join("d.svg"));
    let [floor, csv_flag, svg_flag] = [&c, &csv, &svg].map(|path| path.to_str().unwrap());
    let found = json(&[&a, &b], &["--floor", floor, "--csv", csv_flag, "--svg", svg_flag]);
    assert_eq!((&found["equal_bits"], &found["first_difference"]), (&false.into(), &1.into()));
    let frame = &found["frames"][1];
    assert_eq!((&frame["rms_m"], &frame["max_m"], &frame["velocity_rms_m_s"]), (&0.5.into(), &0.5.into(), &1.0.into()));
    assert_eq!((&frame["floor_rms_m"], &frame["eq17_theta"]), (&0.125.into(), &0.0.into()));
    let lines = fs::read_to_string(&csv).unwrap();
    let lines: Vec<&str> = lines.lines().collect();
    assert!(lines[0].starts_with("frame,rms_m,max_m,aligned_rms_m,eq17_theta,eq17_curvature,velocity_rms_m_s,floor"));
    assert!(lines[2].starts_with("1,5e-1,5e-1,"), "{}", lines[2]);
    assert!(fs::read_to_string(&svg).unwrap().contains("rms distance, mm"));
}

#[test]
fn a_frame_that_one_run_lacks_is_a_difference() {
    let folder = tempfile::tempdir().unwrap();
    let [a, b] = ["a", "b"].map(|name| folder.path().join(name));
    run_of(&a, &square(), 3, Vec3::X, FrameFormat::Ply);
    run_of(&b, &square(), 2, Vec3::X, FrameFormat::Ply);
    let found = json(&[&a, &b], &[]);
    assert_eq!((&found["equal_bits"], &found["first_difference"]), (&false.into(), &2.into()));
    assert_eq!(found["frames"].as_array().unwrap().len(), 2);
}

#[test]
fn other_meshes_and_folders_that_are_no_runs_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let [a, b, none] = ["a", "b", "none"].map(|name| folder.path().join(name));
    run_of(&a, &square(), 2, Vec3::X, FrameFormat::Ply);
    let turned = TriangleMesh { triangles: vec![[0, 1, 3], [1, 2, 3]], ..square() };
    run_of(&b, &turned, 2, Vec3::X, FrameFormat::Ply);
    for (other, sentence) in [(&b, "have different triangles; runs of one mesh can be compared"), (&none, "none")] {
        let output = compare(&[&a, other], &[]);
        let complaint = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{complaint}");
        assert!(complaint.contains(sentence) && complaint.trim().lines().count() == 1, "{complaint}");
    }
    let output = compare(&[&a, &a], &["--csv", "/nowhere/d.csv"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&output.stderr).contains("/nowhere/d.csv cannot be written"));
}
