//! `loomtree render` on small runs: what is drawn, in which colour, from where, and what is said when nothing can be.

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::BufReader;
use std::path::Path;

use clap::Parser;
use loomtree::cli::CliError;
use loomtree::cli::render::{self, RenderArgs};
use loomtree::math::Vec3;
use loomtree::mesh::TriangleMesh;
use loomtree::output::{Existing, FrameFormat, FrameWriter, ReportHeader, ReportWriter, RunDirectory, Status};
use support::device;

#[derive(Parser)]
struct Cli {
    #[command(flatten)]
    render: RenderArgs,
}

fn args(run: &Path, flags: &[&str]) -> Result<RenderArgs, clap::Error> {
    let words = ["render", run.to_str().unwrap()];
    Cli::try_parse_from(words.iter().chain(flags)).map(|cli| cli.render)
}

fn render(run: &Path, flags: &[&str]) -> Result<(), CliError> {
    render::run(args(run, flags).unwrap())
}

/// A unit square from the origin along `x` and `y`; its front faces x cross y.
fn square(x: Vec3, y: Vec3) -> TriangleMesh {
    let positions = vec![Vec3::ZERO, x, x + y, y];
    TriangleMesh { positions, triangles: vec![[0, 1, 2], [0, 2, 3]], material_uv: Vec::new() }
}

/// A run of `frames` frames in which the mesh moves by `shift` a frame.
fn run_of(folder: &Path, mesh: &TriangleMesh, frames: u32, shift: Vec3, format: FrameFormat) -> RunDirectory {
    let directory = RunDirectory::create(folder, Existing::Overwrite).unwrap();
    let mut writer = FrameWriter::new(&directory, &[format], mesh, 0).unwrap();
    for frame in 0..frames {
        let moved: Vec<Vec3> = mesh.positions.iter().map(|p| *p + shift * frame as f32).collect();
        writer.write(frame, mesh, &moved).unwrap();
    }
    directory
}

struct Picture {
    width: usize,
    height: usize,
    rgb: Vec<u8>,
}

impl Picture {
    fn load(path: &Path) -> Picture {
        let mut reader = png::Decoder::new(BufReader::new(File::open(path).unwrap())).read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut rgb).unwrap();
        assert_eq!(info.color_type, png::ColorType::Rgb);
        Picture { width: info.width as usize, height: info.height as usize, rgb }
    }

    fn at(&self, x: usize, y: usize) -> [i32; 3] {
        let at = (y * self.width + x) * 3;
        [0, 1, 2].map(|c| i32::from(self.rgb[at + c]))
    }

    fn center(&self) -> [i32; 3] {
        self.at(self.width / 2, self.height / 2)
    }

    /// Pixels of the cloth's front (red) as (left, top, right, bottom).
    fn red_box(&self) -> Option<[usize; 4]> {
        let red = (0..self.width * self.height).filter(|i| is_red(self.at(i % self.width, i / self.width)));
        red.fold(None, |seen: Option<[usize; 4]>, i| {
            let (x, y) = (i % self.width, i / self.width);
            let [l, t, r, b] = seen.unwrap_or([x, y, x, y]);
            Some([l.min(x), t.min(y), r.max(x), b.max(y)])
        })
    }
}

fn is_red([r, g, b]: [i32; 3]) -> bool {
    r > g + 40 && r > b + 40
}

fn is_blue([r, g, b]: [i32; 3]) -> bool {
    b > r + 40 && b > g
}

fn is_gray([r, g, b]: [i32; 3]) -> bool {
    (r - g).abs() < 14 && (g - b).abs() < 14 && r < 215
}

fn frame(run: &RunDirectory, number: u32) -> Picture {
    Picture::load(&run.pictures().join(format!("frame_{number:06}.png")))
}

const SMALL: [&str; 2] = ["--size", "160x120"];

#[test]
fn front_and_back_have_their_tints_and_fill_the_picture() {
    let folder = tempfile::tempdir().unwrap();
    // Upright, front towards -y: seen from there.
    let run = run_of(folder.path(), &square(Vec3::X, Vec3::Z), 1, Vec3::ZERO, FrameFormat::Ply);
    render(folder.path(), &SMALL).unwrap();
    let picture = frame(&run, 0);
    assert_eq!((picture.width, picture.height), (160, 120));
    assert!(is_red(picture.center()), "{:?}", picture.center());
    let [left, top, right, bottom] = picture.red_box().unwrap();
    assert!(left > 0 && top > 0 && right < 159 && bottom < 119, "cut off: {left} {top} {right} {bottom}");
    assert!(right - left > 120 || bottom - top > 90, "small: {left} {top} {right} {bottom}");

    render(folder.path(), &[&SMALL[..], &["--azimuth", "60"]].concat()).unwrap();
    let behind = frame(&run, 0);
    assert!(is_blue(behind.center()), "{:?}", behind.center());
    assert!(behind.red_box().is_none());
}

#[test]
fn pictures_do_not_depend_on_the_file_format() {
    let (one, other, third) =
        (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mesh = square(Vec3::X, Vec3::Z);
    let formats = [(&one, FrameFormat::Ply), (&other, FrameFormat::Obj), (&third, FrameFormat::Pc2)];
    let pictures = formats.map(|(folder, format)| {
        let run = run_of(folder.path(), &mesh, 3, Vec3::new(0.1, 0.2, -0.3), format);
        render(folder.path(), &SMALL).unwrap();
        frame(&run, 2).rgb
    });
    assert!(pictures[0] == pictures[1] && pictures[0] == pictures[2]);
}

#[test]
fn the_up_axis_comes_from_the_report_or_the_flag() {
    let folder = tempfile::tempdir().unwrap();
    // Falls along -y.
    let run = run_of(folder.path(), &square(Vec3::X, Vec3::Y), 2, Vec3::new(0.0, -2.0, 0.0), FrameFormat::Ply);
    let mut header = ReportHeader::now();
    header.set_gravity([0.0, -9.81, 0.0]);
    ReportWriter::create(&run.report(), header).unwrap().finish(Status::Done).unwrap();
    let boxes = |flags: &[&str]| {
        render(folder.path(), &[&SMALL[..], flags].concat()).unwrap();
        [0, 1].map(|n| frame(&run, n).red_box().unwrap())
    };
    let [before, after] = boxes(&[]);
    assert!(before[3] < after[1], "it does not fall down: {before:?} {after:?}");
    assert_eq!(boxes(&["--up", "y"]), [before, after]);
    let [before, after] = boxes(&["--up", "z", "--azimuth", "0"]);
    assert!(after[2] < before[0], "with z up, seen from +x, it moves to the left: {before:?} {after:?}");
}

#[test]
fn the_nearer_surface_hides_the_farther_one() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = square(Vec3::X, Vec3::Z);
    let run = run_of(folder.path(), &mesh, 2, Vec3::ZERO, FrameFormat::Ply);
    let mut writer = FrameWriter::new(&run, &[FrameFormat::Ply], &mesh, 0).unwrap();
    for (number, y) in [(0, 0.3), (1, -0.3)] {
        let wall: Vec<Vec3> = mesh.positions.iter().map(|p| *p + Vec3::Y * y).collect();
        writer.write_obstacle(number, &wall, &mesh.triangles).unwrap();
    }
    render(folder.path(), &[&SMALL[..], &["--azimuth", "-90", "--elevation", "0"]].concat()).unwrap();
    assert!(is_red(frame(&run, 0).center()), "{:?}", frame(&run, 0).center());
    assert!(is_gray(frame(&run, 1).center()), "{:?}", frame(&run, 1).center());
}

#[test]
fn colourings_show_height_and_direction() {
    let folder = tempfile::tempdir().unwrap();
    let run = run_of(folder.path(), &square(Vec3::X, Vec3::Z), 1, Vec3::ZERO, FrameFormat::Ply);
    let view = ["--azimuth", "-90", "--elevation", "0", "--color"];
    render(folder.path(), &[&SMALL[..], &view, &["height"]].concat()).unwrap();
    let picture = frame(&run, 0);
    let (high, low) = (picture.at(80, 15), picture.at(80, 105));
    assert!(high[1] > high[2] + 40 && low[2] > low[1], "high {high:?}, low {low:?}");
    render(folder.path(), &[&SMALL[..], &view, &["normal"]].concat()).unwrap();
    let [r, g, b] = frame(&run, 0).center();
    // Straight towards the camera: (0, 0, 1) -> (0.5, 0.5, 1).
    assert!((r - 128).abs() < 4 && (g - 128).abs() < 4 && b > 250, "{:?}", [r, g, b]);
}

#[test]
fn frames_are_chosen_and_the_sheet_shows_them() {
    let folder = tempfile::tempdir().unwrap();
    let run = run_of(folder.path(), &square(Vec3::X, Vec3::Z), 30, Vec3::ZERO, FrameFormat::Ply);
    render(folder.path(), &[&SMALL[..], &["--frames", "3..20", "--every", "5"]].concat()).unwrap();
    let mut names: Vec<_> = fs::read_dir(run.pictures()).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    let expected = ["contact_sheet", "frame_000003", "frame_000008", "frame_000013", "frame_000018"];
    assert_eq!(names, expected.map(|n| std::ffi::OsString::from(format!("{n}.png"))));
    let sheet = Picture::load(&run.pictures().join("contact_sheet.png"));
    // Two by two pictures of 160x120 with 6 pixels around each; cloth in the middle of every one.
    assert_eq!((sheet.width, sheet.height), (2 * 166 + 6, 2 * 126 + 6));
    for (x, y) in [(86, 66), (252, 66), (86, 192), (252, 192)] {
        assert!(is_red(sheet.at(x, y)), "no cloth at {x}, {y}");
    }
    // The digit 8 in dots of 3 pixels, on the second picture.
    let ink: Vec<String> = (0..5)
        .map(|row| {
            let dot = |column: usize| sheet.at(6 + 166 + 3 + 3 * column + 1, 6 + 3 + 3 * row + 1)[0] < 100;
            (0..3).map(|column| if dot(column) { '#' } else { '.' }).collect()
        })
        .collect();
    assert_eq!(ink, ["###", "#.#", "###", "#.#", "###"]);
}

#[test]
fn broken_positions_are_left_out_and_broken_files_named() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = square(Vec3::X, Vec3::Z);
    let run = run_of(folder.path(), &mesh, 2, Vec3::ZERO, FrameFormat::Ply);
    let file = run.frames().join("frame_000001.ply");
    let good = fs::read(&file).unwrap();
    // The last vertex becomes NaN: its triangle goes, the other one stays.
    let mut broken = good.clone();
    let header = good.len() - 2 * 13 - 4 * 12;
    broken[header + 36..header + 48].fill(0xff);
    fs::write(&file, &broken).unwrap();
    render(folder.path(), &SMALL).unwrap();
    let count = |n| {
        let picture = frame(&run, n);
        (0..160 * 120).filter(|i| is_red(picture.at(i % 160, i / 160))).count()
    };
    let (whole, half) = (count(0), count(1));
    assert!(half * 10 > whole * 4 && half * 10 < whole * 6, "{half} of {whole} pixels");

    fs::write(&file, &good[..good.len() - 1]).unwrap();
    let error = render(folder.path(), &SMALL).unwrap_err();
    let expected = "frame_000001.ply: it is cut off: shorter than its 4 vertices and 2 triangles need";
    assert!(error.message.ends_with(expected) && error.exit_code == 2, "{error}");
}

/// `first` and `second` in one mesh, not connected.
fn joined(first: &TriangleMesh, second: &TriangleMesh) -> TriangleMesh {
    let offset = first.positions.len() as u32;
    let moved = second.triangles.iter().map(|t| t.map(|i| i + offset));
    TriangleMesh {
        positions: first.positions.iter().chain(&second.positions).copied().collect(),
        triangles: first.triangles.iter().copied().chain(moved).collect(),
        material_uv: Vec::new(),
    }
}

/// A square that reaches `half` metres to each side of the origin, at height `z`.
fn floor(half: f32, z: f32) -> TriangleMesh {
    let mut mesh = square(Vec3::X * 2.0 * half, Vec3::Y * 2.0 * half);
    mesh.positions.iter_mut().for_each(|p| *p += Vec3::new(-half, -half, z));
    mesh
}

#[test]
fn pieces_of_cloth_have_colours_of_their_own() {
    let folder = tempfile::tempdir().unwrap();
    // Side by side with a gap; both fronts are seen.
    let mut right = square(Vec3::X, Vec3::Z);
    right.positions.iter_mut().for_each(|p| *p += Vec3::X * 1.2);
    let mesh = joined(&square(Vec3::X, Vec3::Z), &right);
    let run = run_of(folder.path(), &mesh, 1, Vec3::ZERO, FrameFormat::Ply);
    let view = |azimuth| {
        render(folder.path(), &[&SMALL[..], &["--azimuth", azimuth, "--elevation", "0"]].concat()).unwrap();
        let picture = frame(&run, 0);
        [40, 120].map(|x| picture.at(x, 60))
    };
    let [left, right] = view("-90");
    assert!(is_red(left) && is_blue(right), "{left:?} {right:?}");
    // From behind they change sides, and each is a paler shade of its own colour.
    let [left, right] = view("90");
    let tint = |[r, _, b]: [i32; 3]| r - b;
    assert!(tint(left) < -20 && tint(right) > 20, "{left:?} {right:?}");
}

#[test]
fn a_floor_far_larger_than_the_cloth_does_not_shrink_it() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = square(Vec3::X, Vec3::Z);
    let run = run_of(folder.path(), &mesh, 1, Vec3::ZERO, FrameFormat::Ply);
    let flags = [&SMALL[..], &["--ground", "off"]].concat();
    render(folder.path(), &flags).unwrap();
    let alone = frame(&run, 0);
    let floor = floor(1000.0, -0.1);
    let mut writer = FrameWriter::new(&run, &[FrameFormat::Ply], &mesh, 0).unwrap();
    writer.write_obstacle(0, &floor.positions, &floor.triangles).unwrap();
    render(folder.path(), &flags).unwrap();
    let with_floor = frame(&run, 0);
    // Samples of another background within a pixel of its edge may count or not.
    let boxes = [&with_floor, &alone].map(|picture| picture.red_box().unwrap());
    assert!((0..4).all(|side| boxes[0][side].abs_diff(boxes[1][side]) <= 1), "{boxes:?}");
    // It reaches past the picture's lower edge, which is nearer than its corners, and behind the camera.
    for x in [2, 80, 157] {
        assert!(is_gray(with_floor.at(x, 118)) && !is_gray(alone.at(x, 118)), "{:?}", with_floor.at(x, 118));
    }
    let sheet = Picture::load(&run.pictures().join("contact_sheet.png"));
    assert!(is_gray(sheet.at(6 + 80, 6 + 118)), "{:?}", sheet.at(6 + 80, 6 + 118));
}

#[test]
fn a_flat_floor_under_all_of_the_cloth_becomes_the_ground() {
    let folder = tempfile::tempdir().unwrap();
    let mesh = square(Vec3::X, Vec3::Z);
    let run = run_of(folder.path(), &mesh, 1, Vec3::ZERO, FrameFormat::Ply);
    let picture = |floor: &TriangleMesh| {
        let mut writer = FrameWriter::new(&run, &[FrameFormat::Ply], &mesh, 0).unwrap();
        writer.write_obstacle(0, &floor.positions, &floor.triangles).unwrap();
        render(folder.path(), &SMALL).unwrap();
        frame(&run, 0)
    };
    // As large as it may be, and at the height of the cloth's lower edge: no gray, and the same picture for both.
    let (wide, wider) = (picture(&floor(3.0, 0.0)), picture(&floor(300.0, 0.0)));
    assert!(wide.rgb == wider.rgb && !is_gray(wide.at(80, 118)), "{:?}", wide.at(80, 118));
    // One that ends below the cloth is drawn, because cloth could hang over its edge.
    let mut small = floor(0.4, 0.0);
    small.positions.iter_mut().for_each(|p| *p += Vec3::new(0.5, -0.4, 0.0));
    let drawn = picture(&small);
    let grays = (0..160 * 120).filter(|i| is_gray(drawn.at(i % 160, i / 160))).count();
    assert!(grays > 300, "{grays}");
}

#[test]
fn cloth_casts_a_shadow_on_the_ground_and_on_what_is_below_it() {
    let folder = tempfile::tempdir().unwrap();
    // A roof one meter above the ground, which is at the foot of a thin post.
    let mut roof = square(Vec3::X, Vec3::Y);
    roof.positions.iter_mut().for_each(|p| *p += Vec3::Z);
    let post = square(Vec3::X * 0.01, Vec3::Z);
    let run = run_of(folder.path(), &joined(&roof, &post), 1, Vec3::ZERO, FrameFormat::Ply);
    let grays = |flags: &[&str]| {
        let view = ["--azimuth", "-90", "--elevation", "30"];
        render(folder.path(), &[&SMALL[..], &view, flags].concat()).unwrap();
        let picture = frame(&run, 0);
        let pixels = (0..160 * 118).map(|i| picture.at(i % 160, i / 160));
        pixels.filter(|[r, _, b]| (r - b).abs() < 14).map(|[_, g, _]| g).collect::<Vec<i32>>()
    };
    let (shaded, plain) = (grays(&["--color", "fabric"]), grays(&["--color", "fabric", "--no-shadows"]));
    // In the open nothing is darker than a line of the grid.
    let darkest = plain.iter().min().unwrap();
    let dark = shaded.iter().filter(|gray| *gray + 10 < *darkest).count();
    assert!(dark > 100, "{dark} pixels darker than {darkest}");
}

#[test]
fn pictures_are_the_same_for_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    let run = run_of(folder.path(), &two_sheets(), 7, Vec3::new(0.1, 0.0, 0.2), FrameFormat::Ply);
    let bytes = |threads| {
        let movie = folder.path().join("movie.png");
        let flags = ["--threads", threads, "--smooth", "--executor", "cpu", "--movie", movie.to_str().unwrap()];
        render(folder.path(), &[&SMALL[..], &flags].concat()).unwrap();
        let read = |path: &Path| fs::read(path).unwrap();
        let mut files: Vec<_> = (0..7).map(|n| read(&run.pictures().join(format!("frame_{n:06}.png")))).collect();
        files.extend([read(&run.pictures().join("contact_sheet.png")), read(&movie)]);
        files
    };
    let one = bytes("1");
    assert!(one == bytes("2") && one == bytes("5"));
    // The movie holds all frames, in order: its last one is the last picture.
    let mut reader = png::Decoder::new(BufReader::new(File::open(folder.path().join("movie.png")).unwrap()));
    reader.ignore_checksums(false);
    let mut reader = reader.read_info().unwrap();
    let control = *reader.info().animation_control().unwrap();
    assert_eq!((control.num_frames, control.num_plays), (7, 0));
    let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
    for n in 0..7 {
        reader.next_frame(&mut rgb).unwrap();
        assert!(rgb == frame(&run, n).rgb, "frame {n}");
    }
}

#[test]
fn smooth_cloth_has_other_edges_and_the_same_colors() {
    let folder = tempfile::tempdir().unwrap();
    let bent = TriangleMesh {
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Z, Vec3::Z, Vec3::new(0.5, -0.5, 0.5)],
        triangles: vec![[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]],
        material_uv: Vec::new(),
    };
    let run = run_of(folder.path(), &bent, 1, Vec3::ZERO, FrameFormat::Ply);
    let view = ["--azimuth", "-90", "--elevation", "0"];
    let reds = |flags: &[&str]| {
        render(folder.path(), &[&SMALL[..], &view, flags].concat()).unwrap();
        let picture = frame(&run, 0);
        (0..160 * 120).filter(|i| is_red(picture.at(i % 160, i / 160))).count()
    };
    let (sharp, smooth) = (reds(&[]), reds(&["--smooth", "2"]));
    // Corners of a border become round.
    assert!(smooth < sharp && smooth * 2 > sharp, "{smooth} of {sharp}");
}

/// A sheet of waves over a smaller flat one.
fn two_sheets() -> TriangleMesh {
    let cells = 24;
    let grid = |size: f32, z: &dyn Fn(f32, f32) -> f32| {
        let at = |i: u32| size * (i as f32 / cells as f32 - 0.5);
        let corner = |i: u32| (at(i % (cells + 1)), at(i / (cells + 1)));
        let positions = (0..(cells + 1) * (cells + 1)).map(corner).map(|(x, y)| Vec3::new(x, y, z(x, y))).collect();
        let cell = |i: u32| {
            let first = i / cells * (cells + 1) + i % cells;
            [[first, first + 1, first + cells + 2], [first, first + cells + 2, first + cells + 1]]
        };
        TriangleMesh { positions, triangles: (0..cells * cells).flat_map(cell).collect(), material_uv: Vec::new() }
    };
    joined(&grid(2.0, &|x, y| 0.3 + 0.2 * (5.0 * x + y).sin()), &grid(1.4, &|_, _| -0.1))
}

/// Why two drawings of one scene differ by more than roundings and edges do.
fn difference(one: &Picture, other: &Picture) -> Option<String> {
    assert_eq!((one.width, one.height), (other.width, other.height));
    let far = |a: [i32; 3], b: [i32; 3]| (0..3).map(|c| (a[c] - b[c]).abs()).max().unwrap();
    let (mut sum, mut edges) = (0, 0);
    for (x, y) in (0..one.width * one.height).map(|i| (i % one.width, i / one.width)) {
        let apart = far(one.at(x, y), other.at(x, y));
        sum += apart;
        if apart > 3 {
            // An edge: something else is seen right beside the pixel.
            let near = |v: usize, size: usize| v.saturating_sub(1)..=(v + 1).min(size - 1);
            let beside = near(x, one.width).flat_map(|i| near(y, one.height).map(move |j| (i, j)));
            let contrast = beside.map(|(i, j)| far(one.at(x, y), one.at(i, j))).max().unwrap();
            if contrast + 3 < apart {
                let colors = (one.at(x, y), other.at(x, y));
                return Some(format!("{colors:?} at {x}, {y}, where the picture is smooth ({contrast})"));
            }
            edges += 1;
        }
    }
    let (pixels, mean) = (one.width * one.height, sum as f64 / (one.width * one.height) as f64);
    println!("mean difference {mean:.3} of 255, {edges} of {pixels} pixels differ at edges");
    (mean > 0.5 || edges * 100 > pixels).then(|| format!("mean {mean}, {edges} pixels at edges"))
}

#[test]
fn device_and_processor_draw_the_same() {
    if device::executor().is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mesh = two_sheets();
    let run = run_of(folder.path(), &mesh, 1, Vec3::ZERO, FrameFormat::Ply);
    let mut writer = FrameWriter::new(&run, &[FrameFormat::Ply], &mesh, 0).unwrap();
    // Frame 1 has shrunk to a point: nothing can be drawn of it.
    writer.write(1, &mesh, &vec![Vec3::ZERO; mesh.positions.len()]).unwrap();
    let mut block = square(Vec3::X * 0.5, Vec3::Z * 0.4);
    block.positions.iter_mut().for_each(|p| *p += Vec3::new(-0.2, -1.1, -0.2));
    let obstacle = joined(&floor(500.0, -0.3), &block);
    writer.write_obstacle(0, &obstacle.positions, &obstacle.triangles).unwrap();
    let colors = ["shaded", "fabric", "height", "normal"].map(|color| ["--color", color]);
    for flags in colors.into_iter().chain([["--elevation", "-20"], ["--ground", "off"], ["--smooth", "1"]]) {
        let draw = |executor| {
            render(folder.path(), &["--size", "320x240", "--executor", executor, flags[0], flags[1]]).unwrap();
            [frame(&run, 0), frame(&run, 1)]
        };
        let ([cpu, cpu_empty], [gpu, gpu_empty]) = (draw("cpu"), draw("gpu"));
        assert_eq!(difference(&cpu, &gpu), None, "{flags:?}");
        assert_eq!(difference(&cpu_empty, &gpu_empty), None, "{flags:?}");
        // The comparison sees a device that draws nothing.
        assert!(difference(&cpu, &gpu_empty).is_some(), "{flags:?}");
    }
}

#[test]
fn executors_that_cannot_be_had_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    run_of(folder.path(), &square(Vec3::X, Vec3::Z), 1, Vec3::ZERO, FrameFormat::Ply);
    let error = render(folder.path(), &["--executor", "cpu", "--adapter", "0"]).unwrap_err();
    assert!(error.message.contains("cannot go with --executor cpu") && error.exit_code == 2, "{error}");
    // The same request on a machine with and without adapters.
    let error = render(folder.path(), &["--executor", "gpu", "--adapter", "99"]).unwrap_err();
    let said = error.message.contains("adapter 99 does not exist") || error.message.contains("no graphics adapter");
    assert!(said && error.exit_code == 2, "{error}");
}

#[test]
fn bad_requests_get_one_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let error = render(folder.path(), &[]).unwrap_err();
    assert!(error.message.contains("is not a run directory") && error.exit_code == 2, "{error}");
    run_of(folder.path(), &square(Vec3::X, Vec3::Z), 2, Vec3::ZERO, FrameFormat::Ply);
    let error = render(folder.path(), &["--frames", "7.."]).unwrap_err();
    assert!(error.message.ends_with("; it holds 0..1") && error.exit_code == 2, "{error}");

    let sentences = HashMap::from([
        (["--size", "9x9999"], "is no size; write WIDTHxHEIGHT with 16 to 8192 pixels each"),
        (["--frames", "9..3"], "is no range of frames; write A..B with A not above B"),
        (
            ["--color", "plaid"],
            "is not a coloring; valid are shaded, fabric, piece, rank, strain, contact, height, segment, normal",
        ),
        (["--up", "x"], "is not an up axis; valid are y and z"),
        (["--every", "0"], "0 is not in 1.."),
    ]);
    for (flags, sentence) in sentences {
        let error = args(folder.path(), &flags).unwrap_err().to_string();
        assert!(error.contains(sentence), "{error}");
    }
}
