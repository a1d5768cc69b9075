//! Files of a run: exact bytes, round trips, and that nothing is lost or half-written when something goes wrong.

use std::fs;
use std::io;
use std::path::Path;

use loomtree::math::{DVec3, Vec2, Vec3};
use loomtree::mesh::TriangleMesh;
use loomtree::model::{LetGo, State};
use loomtree::output::*;
use loomtree::scene::Hold;
use proptest::prelude::*;

/// Two triangles that share an edge; vertex 1 lies on a seam.
fn two_triangles() -> TriangleMesh {
    let uv = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 0.25]].map(Vec2::from_array);
    TriangleMesh {
        positions: vec![
            Vec3::new(0.0, 0.0, 0.0),
            Vec3::new(1.0, 0.0, 0.1),
            Vec3::new(1.0, -1.5, 1e-7),
            Vec3::new(0.0, 1.0, 123456.79),
        ],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        material_uv: vec![[uv[0], uv[1], uv[2]], [uv[0], uv[4], uv[3]]],
    }
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn run_directory(folder: &tempfile::TempDir) -> RunDirectory {
    RunDirectory::create(&folder.path().join("run"), Existing::Refuse).unwrap()
}

#[test]
fn a_failing_writer_leaves_no_file_and_keeps_the_old_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file");
    let fail = |out: &mut dyn io::Write| {
        out.write_all(&[7; 1 << 20])?;
        Err(io::Error::other("disk on fire"))
    };
    let error = write_atomically(&path, fail).unwrap_err();
    assert_eq!(error.to_string(), format!("cannot write {}: disk on fire", path.display()));
    assert_eq!(names(folder.path()), Vec::<String>::new());

    write_atomically(&path, |out| out.write_all(b"old")).unwrap();
    write_atomically(&path, fail).unwrap_err();
    assert_eq!(fs::read(&path).unwrap(), b"old");
    assert_eq!(names(folder.path()), ["file"]);
    let nowhere = write_atomically(&folder.path().join("no/such/file"), |_| Ok(())).unwrap_err();
    assert!(nowhere.to_string().ends_with("No such file or directory (os error 2)"), "{nowhere}");
}

#[test]
fn ply_of_two_triangles_is_these_bytes() {
    let mesh = two_triangles();
    let mut bytes = Vec::new();
    ply::write(&mut bytes, &mut Vec::new(), &mesh.positions, &mesh.triangles).unwrap();
    let mut expected = b"ply\nformat binary_little_endian 1.0\ncomment loomtree, metres\nelement vertex 4\n\
        property float x\nproperty float y\nproperty float z\nelement face 2\n\
        property list uchar int vertex_indices\nend_header\n"
        .to_vec();
    for p in &mesh.positions {
        p.to_array().into_iter().for_each(|x| expected.extend(x.to_le_bytes()));
    }
    expected.extend([3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    expected.extend([3, 0, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0]);
    assert_eq!(bytes, expected);
    let read = ply::read(&bytes).unwrap();
    assert_eq!((read.positions, read.triangles), (mesh.positions, mesh.triangles));
    for length in 0..bytes.len() {
        assert!(ply::read(&bytes[..length]).is_err(), "{length} of {} bytes were taken for a mesh", bytes.len());
    }
}

#[test]
fn obj_of_two_triangles_is_this_text() {
    let mesh = two_triangles();
    let texture = obj::TextureCoordinates::new(4, &mesh.triangles, &mesh.material_uv);
    let mut bytes = Vec::new();
    obj::write(&mut bytes, &mut Vec::new(), DVec3::ZERO, &mesh.positions, &mesh.triangles, Some(&texture), &[])
        .unwrap();
    let text = String::from_utf8(bytes).unwrap();
    let expected = "v 0 0 0\nv 1 0 0.1\nv 1 -1.5 1e-7\nv 0 1 123456.79\n\
        vt 0 0\nvt 1 0\nvt 1 1\nvt 0.5 0.25\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/4 4/5\n";
    assert_eq!(text, expected);
    let read = obj::read(text.as_bytes(), DVec3::ZERO).unwrap();
    assert_eq!((read.positions, read.triangles), (mesh.positions, mesh.triangles));

    let message = |text: &str| obj::read(text.as_bytes(), DVec3::ZERO).unwrap_err().to_string();
    assert_eq!(message("v 0 0 0\nv 1 x 0"), "line 2 has a coordinate that is no number");
    assert_eq!(message("v 0 0 0\nf 1 1 0"), "line 2 has vertex number 0 (they count from 1)");
    assert_eq!(message("v 0 0 0\nf 1 1 2"), "triangle 0 (from 0) names a vertex beyond the 1 there are");
}

proptest! {
    #[test]
    fn frames_read_back_bit_by_bit(bits in prop::collection::vec(any::<[u32; 3]>(), 3..40)) {
        let finite = |b: u32| Some(f32::from_bits(b)).filter(|x| x.is_finite()).unwrap_or(1.0);
        let positions: Vec<Vec3> = bits.iter().map(|b| Vec3::from_array(b.map(finite))).collect();
        let triangles: Vec<[u32; 3]> = (2..positions.len() as u32).map(|i| [0, i - 1, i]).collect();
        let as_bits = |p: &[Vec3]| p.iter().map(|p| p.to_array().map(f32::to_bits)).collect::<Vec<_>>();
        for write_and_read in [
            |p: &[Vec3], t: &[[u32; 3]]| {
                let mut b = Vec::new();
                obj::write(&mut b, &mut Vec::new(), DVec3::ZERO, p, t, None, &[]).unwrap();
                obj::read(&b, DVec3::ZERO)
            },
            |p: &[Vec3], t: &[[u32; 3]]| { let mut b = Vec::new(); ply::write(&mut b, &mut Vec::new(), p, t).unwrap(); ply::read(&b) },
        ] {
            let mesh = write_and_read(&positions, &triangles).unwrap();
            prop_assert_eq!(as_bits(&mesh.positions), as_bits(&positions));
            prop_assert_eq!(&mesh.triangles, &triangles);
        }
    }

    #[test]
    fn arbitrary_bytes_are_an_error_and_no_panic(bytes in prop::collection::vec(any::<u8>(), 0..400), cut in 0usize..300) {
        let mut ply_file = Vec::new();
        ply::write(&mut ply_file, &mut Vec::new(), &[Vec3::ONE; 3], &[[0, 1, 2]]).unwrap();
        let checkpoint = checkpoint_file(3);
        prop_assert!(Checkpoint::from_bytes(&bytes).is_err());
        for start in [&ply_file, &checkpoint] {
            let mut file = start[..cut.min(start.len())].to_vec();
            file.extend(&bytes);
            // What comes out, if anything does, must be sound.
            if let Ok(mesh) = ply::read(&file) {
                prop_assert!(mesh.triangles.iter().flatten().all(|i| (*i as usize) < mesh.positions.len()));
            }
            if file != *start {
                prop_assert!(Checkpoint::from_bytes(&file).is_err());
            }
        }
        if let Ok(mesh) = obj::read(&bytes, DVec3::ZERO) {
            prop_assert!(mesh.triangles.iter().flatten().all(|i| (*i as usize) < mesh.positions.len()));
        }
    }

    #[test]
    fn one_changed_bit_of_a_checkpoint_is_found(byte in 0usize..10_000, bit in 0u8..8) {
        let mut file = checkpoint_file(5 + u64::from(bit / 4) * 2);
        let at = byte % file.len();
        file[at] ^= 1 << bit;
        prop_assert!(Checkpoint::from_bytes(&file).is_err());
    }
}

fn checkpoint(step: u64) -> Checkpoint {
    let positions: Vec<Vec3> = (0..step).map(|i| Vec3::new(i as f32, 0.5, -0.0)).collect();
    // Every other one has creases, which is another layout.
    let creases = (0..step / 2 % 2 * 3).map(|i| [i as f32, 0.25]).collect();
    // None of the first, so that all layouts are written.
    let let_go = (3..step as u32).map(|vertex| LetGo { vertex, obstacle: 7, inside: vertex % 2 }).collect();
    let stretches = (0..step / 4 % 2 * 5).map(|i| [1.0 + i as f32, 1.0, 0.25, 0.5]).collect();
    let hold = |vertex| Hold { vertex, corners: [4, 5, 6], weights: [0.5, 0.25, 0.25], offset_m: [0.0, -0.0, 1e-3] };
    let holds = (0..step as u32 / 8 % 2 * 4).map(hold).collect();
    let state = State { velocities: positions.clone(), positions, creases, stretches, let_go, holds };
    Checkpoint { frame: 2, step, time_s: 0.25, fingerprint: 77, state }
}

fn checkpoint_file(step: u64) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    fs::read(checkpoint::write(folder.path(), &checkpoint(step)).unwrap()).unwrap()
}

#[test]
fn kept_states_stay() {
    let folder = tempfile::tempdir().unwrap();
    for step in [8, 2, 4, 6, 0] {
        checkpoint::keep(folder.path(), &checkpoint(step)).unwrap();
    }
    for step in [0, 2, 4, 6, 8] {
        let file = fs::read(folder.path().join(format!("step_{step:08}.ltc"))).unwrap();
        assert_eq!(Checkpoint::from_bytes(&file).unwrap(), checkpoint(step));
    }
}

#[test]
fn the_newest_valid_checkpoint_is_found_and_three_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    assert!(checkpoint::latest(folder.path()).found.is_none());
    for step in [10, 20, 30, 40] {
        checkpoint::write(folder.path(), &checkpoint(step)).unwrap();
    }
    assert_eq!(names(folder.path()), ["step_00000020.ltc", "step_00000030.ltc", "step_00000040.ltc"]);
    let (path, found) = checkpoint::latest(folder.path()).found.unwrap();
    assert_eq!((path.file_name().unwrap().to_str(), found), (Some("step_00000040.ltc"), checkpoint(40)));

    let bytes = fs::read(&path).unwrap();
    fs::write(&path, &bytes[..bytes.len() - 100]).unwrap();
    fs::write(folder.path().join("step_00000035.ltc"), b"something else").unwrap();
    let latest = checkpoint::latest(folder.path());
    assert_eq!(latest.found.unwrap().1, checkpoint(30));
    assert_eq!(latest.notes.len(), 2);
    assert!(latest.notes[0].contains("step_00000040.ltc is skipped: it is cut off or damaged"), "{:?}", latest.notes);
    assert!(latest.notes[1].contains("step_00000035.ltc is skipped: it is not a checkpoint"), "{:?}", latest.notes);

    // Taken up from 30: the damaged later ones must not outlive or displace what is written now.
    checkpoint::write(folder.path(), &checkpoint(32)).unwrap();
    assert_eq!(names(folder.path()), ["step_00000020.ltc", "step_00000030.ltc", "step_00000032.ltc"]);
}

#[test]
fn a_run_directory_is_refused_with_one_sentence() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run");
    let refusal = |existing| RunDirectory::create(&path, existing).unwrap_err().to_string();
    assert!(refusal(Existing::Resume).ends_with("holds no run to continue; leave out --resume to start one"));
    assert!(!path.exists(), "a refusal left a folder");

    fs::write(&path, b"").unwrap();
    assert!(refusal(Existing::Refuse).contains("is a file, but a run needs a folder"));
    fs::remove_file(&path).unwrap();
    assert!(RunDirectory::open(folder.path()).unwrap_err().to_string().contains("is not a run directory"));

    let directory = RunDirectory::create(&path, Existing::Refuse).unwrap();
    assert!(matches!(RunDirectory::create(&path, Existing::Refuse), Err(DirectoryError::InUse(_))));
    drop(directory);
    fs::write(path.join("report.json"), b"{}").unwrap();
    fs::write(path.join("frames/frame_000000.ply"), b"").unwrap();
    fs::write(path.join("frames/.x.part"), b"").unwrap();
    fs::write(path.join("notes.txt"), b"mine").unwrap();
    assert!(refusal(Existing::Refuse).contains("already holds a run"));

    drop(RunDirectory::create(&path, Existing::Resume).unwrap());
    assert_eq!(names(&path.join("frames")), ["frame_000000.ply"]);
    drop(RunDirectory::create(&path, Existing::Overwrite).unwrap());
    assert_eq!(names(&path), ["checkpoint", "frames", "notes.txt"]);
    assert_eq!(names(&path.join("frames")), Vec::<String>::new());
}

#[test]
fn an_unwritable_folder_is_named() {
    let error = RunDirectory::create(Path::new("/proc/no/run"), Existing::Refuse).unwrap_err();
    assert!(matches!(error, DirectoryError::Unwritable { .. }), "{error}");
    assert!(error.to_string().starts_with("cannot write to /proc/no/run: "), "{error}");
}

#[test]
fn formats_are_read_or_explained() {
    assert_eq!("ply, OBJ,ply".parse(), Ok(FormatList(vec![FrameFormat::Ply, FrameFormat::Obj], vec![])));
    let caches = vec![CacheFormat::Usd, CacheFormat::Abc];
    assert_eq!("pc2,usd, ABC,usd".parse(), Ok(FormatList(vec![FrameFormat::Pc2], caches.clone())));
    // Caches are made from frames.
    let list: FormatList = "usd,abc".parse().unwrap();
    assert_eq!((list.to_string(), list), ("ply,usd,abc".to_owned(), FormatList(vec![FrameFormat::Ply], caches)));
    let unknown = "stl".parse::<FormatList>().unwrap_err();
    assert_eq!(
        unknown.to_string(),
        "--format \"stl\" is unknown; valid are obj, ply, pc2, usd, usdc, abc, mdd, vtu and glb (separated by commas)"
    );
    assert_eq!("".parse::<FormatList>(), Err(FormatError::Empty));
}

#[test]
fn frames_of_every_format_hold_the_same_positions() {
    let folder = tempfile::tempdir().unwrap();
    let directory = run_directory(&folder);
    let mesh = two_triangles();
    let formats = [FrameFormat::Obj, FrameFormat::Ply, FrameFormat::Pc2];
    let moved = |frame: u32| mesh.positions.iter().map(|p| *p + Vec3::splat(frame as f32)).collect::<Vec<_>>();
    let mut writer = FrameWriter::new(&directory, &formats, &mesh, 0).unwrap();
    for frame in 0..3 {
        writer.write(frame, &mesh, &moved(frame)).unwrap();
    }
    writer.write_obstacle(2, &mesh.positions, &mesh.triangles).unwrap();
    let bad = vec![Vec3::ZERO, Vec3::ZERO, Vec3::new(0.0, f32::NAN, 0.0), Vec3::ZERO];
    let error = writer.write(3, &mesh, &bad).unwrap_err().to_string();
    assert!(error.starts_with("frame 3 is not written: position of vertex 2 is [0, NaN, 0]"), "{error}");
    // Beyond a gap: the point cache counts the frames before it, and no run goes on after it.
    writer.write(5, &mesh, &moved(5)).unwrap();
    assert_eq!(pc2::samples(&directory.point_cache()).unwrap(), 3);
    fs::remove_file(directory.frames().join("frame_000005.obj")).unwrap();
    fs::remove_file(directory.frames().join("frame_000005.ply")).unwrap();
    drop(writer);
    let gap = FrameWriter::new(&directory, &formats, &mesh, 5).err().map(|error| error.to_string());
    assert!(gap.as_deref().is_some_and(|text| text.starts_with("frame 5 does not follow the 3 frames")), "{gap:?}");

    // Resumed at frame 2: frame 2 is made again, the others stay.
    let mut writer = FrameWriter::new(&directory, &formats, &mesh, 2).unwrap();
    writer.write(2, &mesh, &moved(20)).unwrap();
    writer.write(3, &mesh, &moved(3)).unwrap();

    for extensions in [&["ply", "obj"][..], &["obj"], &[]] {
        for entry in fs::read_dir(directory.frames()).unwrap().map(|e| e.unwrap().path()) {
            let name = entry.file_name().unwrap().to_str().unwrap();
            if name.starts_with("frame_") && !extensions.iter().any(|e| name.ends_with(e)) {
                fs::remove_file(entry).unwrap();
            }
        }
        let source = FrameSource::open(&directory).unwrap();
        assert_eq!(source.numbers(), [0, 1, 2, 3]);
        assert_eq!(source.read(1).unwrap().positions, moved(1));
        assert_eq!(source.read(2).unwrap().positions, moved(20));
        assert_eq!(source.read(3).unwrap(), FrameMesh { positions: moved(3), triangles: mesh.triangles.clone() });
        assert_eq!(source.read_obstacle(2).unwrap().unwrap().positions, mesh.positions);
        assert!(source.read_obstacle(1).unwrap().is_none());
    }
}

#[test]
fn a_point_cache_has_the_header_that_players_expect() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cloth.pc2");
    let mut writer = pc2::Pc2Writer::open(&path, 2, 0).unwrap();
    writer.write(0, &[Vec3::ZERO, Vec3::ONE]).unwrap();
    let mut expected = b"POINTCACHE2\0".to_vec();
    expected.extend([1, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x80, 0x3f, 1, 0, 0, 0]);
    expected.extend([0; 12]);
    expected.extend([0, 0, 0x80, 0x3f].repeat(3));
    assert_eq!(fs::read(&path).unwrap(), expected);
    // A sample that was cut off is not counted, and a file that lies about its length is an error.
    fs::write(&path, &expected[..50]).unwrap();
    assert!(pc2::read(&path, 0).unwrap_err().to_string().ends_with("frame 0 is missing or cut off"));
    assert!(pc2::Pc2Writer::open(&path, 3, 1).is_err());
}

#[test]
fn a_point_cache_takes_frames_in_any_order_and_counts_those_before_the_first_gap() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cloth.pc2");
    let mut writer = pc2::Pc2Writer::open(&path, 2, 0).unwrap();
    let positions = |frame: u32| [Vec3::splat(frame as f32), Vec3::ONE];
    for (frame, samples) in [(2, 0), (0, 1), (3, 1), (1, 4), (1, 4)] {
        writer.write(frame, &positions(frame)).unwrap();
        assert_eq!(pc2::samples(&path).unwrap(), samples, "after frame {frame}");
    }
    for frame in 0..4 {
        assert_eq!(pc2::read(&path, frame).unwrap(), positions(frame));
    }
    let error = writer.write(4, &[Vec3::ZERO]).unwrap_err().to_string();
    assert!(error.contains("it holds 2 points, frame 4 has 1"), "{error}");
}

#[test]
fn a_chart_is_svg_and_an_empty_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("chart.svg");
    let series = |points: &[(f64, f64)]| plot::Series { name: "halo <b>".to_string(), points: points.to_vec() };
    let points = [(1.0, 4.0), (2.0, f64::NAN), (4.0, 1.25)];
    plot::line_chart(&path, "Step", "workers", "seconds", &[series(&points)]).unwrap();
    let svg = fs::read_to_string(&path).unwrap();
    assert!(svg.starts_with("<svg") && svg.trim_end().ends_with("</svg>"));
    assert_eq!(svg.matches("<circle").count(), 2, "one dot per finite point");
    assert!(svg.contains("halo &lt;b&gt;"));
    let error = plot::line_chart(&path, "Step", "x", "y", &[series(&points[1..2])]).unwrap_err().to_string();
    assert_eq!(error, "chart \"Step\" has nothing to show: no series has a finite point");
}
