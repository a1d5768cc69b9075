//! Mesh files: hand-made ones, the hostile collection, and arbitrary bytes.
//!
//! Third-party files are found through `LOOMTREE_TEST_DATA`.

use std::path::{Path, PathBuf};

use loomtree::cli::check::{CheckArgs, check};
use loomtree::math::{Vec2, Vec3};
use loomtree::mesh::{
    MaterialSource, Surface, TriangleMesh, first_intersection, hinges, locality_order, parse_obj, parse_ply, read_mesh,
    unique_edges, validate, vertex_order,
};
use loomtree::scene::sheet_cells;
use proptest::prelude::*;

/// The folder of third-party data, or a printed reason for skipping.
fn test_data(folder: &str) -> Option<PathBuf> {
    let root = std::env::var_os("LOOMTREE_TEST_DATA");
    if root.is_none() {
        println!("skipped: LOOMTREE_TEST_DATA is not set");
    }
    root.map(|root| Path::new(&root).join(folder))
}

/// What `loomtree check` prints, or its sentence.
fn checked(path: &Path) -> Result<String, String> {
    let mut out = Vec::new();
    match check(
        &CheckArgs { file: path.into(), resolution: None, write_crossings: None, untangle: None, obstacle: false },
        &mut out,
    ) {
        Ok(()) => Ok(String::from_utf8(out).expect("a summary is text")),
        Err(error) => {
            assert_eq!((error.exit_code, error.message.lines().count()), (2, 1), "{}", error.message);
            Err(error.message)
        }
    }
}

#[test]
fn hostile_files_do_what_their_manifest_says() {
    let Some(folder) = test_data("hostile-meshes") else { return };
    let manifest = std::fs::read_to_string(folder.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    for (name, entry) in manifest.as_object().unwrap() {
        let result = checked(&folder.join(name));
        match entry["expect"].as_str().unwrap() {
            "accept" => assert!(result.is_ok(), "{name} is fine, but: {result:?}"),
            "reject" => {
                assert!(result.as_ref().is_err_and(|sentence| sentence.contains(name.as_str())), "{name}: {result:?}")
            }
            _ => {}
        }
    }
}

#[test]
fn meshes_with_known_intersections() {
    let Some(folder) = test_data("ipc-toolkit-tests") else { return };
    for name in ["two-cubes-close", "two-cubes-far", "bunny", "height-field"] {
        let result = checked(&folder.join(name).with_extension("ply"));
        assert!(result.is_ok(), "{name}: {result:?}");
    }
    assert!(checked(&folder.join("two-cubes-intersecting.ply")).unwrap_err().contains("cross or touch"));
}

#[test]
fn every_arcsim_mesh_is_a_cloth() {
    let Some(folder) = test_data("arcsim/meshes") else { return };
    let objs = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let objs: Vec<PathBuf> = objs.filter(|path| path.extension().is_some_and(|e| e == "obj")).collect();
    assert!(!objs.is_empty());
    for path in objs {
        assert!(checked(&path).is_ok(), "{:?}", checked(&path));
    }
}

fn surface(obj: &str) -> Surface {
    parse_obj(obj.as_bytes()).unwrap()
}

#[test]
fn texture_coordinates_are_the_material_space_where_they_are_a_map() {
    let vertices = "v 0 0 0\nv 1 0 0\nv 0 0 -1\nvt 0 0\nvt 2 0\nvt 0 3\n";
    let mapped = surface(&format!("{vertices}f 1/1 2/2 3/3"));
    let rest = [Vec2::ZERO, Vec2::new(2.0, 0.0), Vec2::new(0.0, 3.0)];
    let flat = [Vec2::ZERO, Vec2::X, Vec2::Y];
    assert_eq!(mapped.clone().into_mesh(MaterialSource::TextureOrShape).unwrap().mesh.material_uv, [rest]);
    assert_eq!(mapped.clone().into_mesh(MaterialSource::Shape).unwrap().mesh.material_uv, [flat]);
    assert_eq!(
        mapped.into_mesh(MaterialSource::Auto).unwrap().mesh.material_uv,
        [flat],
        "twice and three times as long"
    );
    for face in ["f 1/1 2/1 3/1", "f 1/1 2/2 3", "f 1 2 3"] {
        let mesh = surface(&format!("{vertices}{face}")).into_mesh(MaterialSource::TextureOrShape).unwrap().mesh;
        assert_eq!(mesh.material_uv, [flat], "{face}");
    }
    let mirrored = surface(&format!("{vertices}f 1/1 2/3 3/2")).into_mesh(MaterialSource::TextureOrShape).unwrap().mesh;
    assert_eq!(mirrored.material_uv, [[Vec2::ZERO, Vec2::new(0.0, 3.0), Vec2::new(-2.0, 0.0)]]);
}

#[test]
fn vertices_in_no_triangle_are_dropped_and_the_numbers_of_the_file_kept() {
    let file =
        surface("v 9 9 9\nv 0 0 0\nv 1 0 0\nv 8 8 8\nv 0 1 0\nf 2 3 5").into_mesh(MaterialSource::Shape).unwrap();
    assert_eq!(file.mesh.positions, [Vec3::ZERO, Vec3::X, Vec3::Y]);
    assert_eq!((0..6).map(|v| file.vertex(v)).collect::<Vec<_>>(), [None, Some(0), Some(1), None, Some(2), None]);
    assert_eq!(file.left_out(Path::new("a.obj")).unwrap(), "a.obj: 2 vertices belong to no triangle and are left out");
}

#[test]
fn files_that_cannot_be_read_are_named() {
    let refused = |path: &str| read_mesh(Path::new(path), MaterialSource::Shape).unwrap_err().to_string();
    assert_eq!(refused("no/such.obj"), "no/such.obj: cannot be read: No such file or directory (os error 2)");
    assert_eq!(refused("Cargo.toml"), "Cargo.toml: a mesh file ends in .obj or .ply");
}

#[test]
fn a_large_sheet_has_the_edges_and_hinges_that_euler_counts() {
    let sheet = sheet_cells([3.0, 2.0], 100_000);
    let mesh = TriangleMesh { triangles: sheet.triangle_corners(), ..TriangleMesh::default() };
    let (columns, rows) = (sheet.columns as usize, sheet.rows as usize);
    let edges = columns * (rows + 1) + rows * (columns + 1) + columns * rows;
    assert_eq!(unique_edges(&mesh).len(), edges);
    let hinges = hinges(&mesh);
    assert_eq!(hinges.len(), edges - 2 * (columns + rows));
    for hinge in &hinges {
        let [edge0, edge1, opposite0, opposite1] = hinge.vertices;
        for (triangle, stencil) in hinge.triangles.iter().zip([[edge0, edge1, opposite0], [edge1, edge0, opposite1]]) {
            let corners = mesh.triangles[*triangle as usize];
            let turned = (0..3).any(|i| [corners[i], corners[(i + 1) % 3], corners[(i + 2) % 3]] == stencil);
            assert!(turned, "{hinge:?} against {corners:?}");
        }
    }
}

#[test]
fn the_order_of_a_sheet_halves_it_without_tearing_it_to_pieces() {
    let sheet = sheet_cells([3.0, 2.0], 20_000);
    let uv = sheet.coordinates([3.0, 2.0]);
    let triangles = sheet.triangle_corners();
    let mesh = TriangleMesh {
        positions: uv.iter().map(|uv| uv.extend(0.0)).collect(),
        material_uv: triangles.iter().map(|t| t.map(|v| uv[v as usize])).collect(),
        triangles,
    };
    let order = vertex_order(&mesh, 100);
    let mut rank = vec![0; order.len()];
    (0..order.len()).for_each(|new| rank[order[new] as usize] = 8 * new / order.len());
    // Eight compact blocks of a sheet of 101 x 123 points: their seams together are a few hundred edges long.
    let cut = unique_edges(&mesh).iter().filter(|edge| rank[edge[0] as usize] != rank[edge[1] as usize]).count();
    assert!(cut < 2_000, "{cut} edges join two of eight blocks");
}

/// What a parser may return without being wrong: a sentence, or a mesh that holds its promises.
fn sane(surface: Result<Surface, impl std::fmt::Display>) -> Result<(), TestCaseError> {
    match surface.map(|surface| surface.into_mesh(MaterialSource::TextureOrShape)) {
        Ok(Ok(file)) => {
            prop_assert_eq!(validate(&file.mesh), Ok(()));
            first_intersection(&file.mesh);
        }
        Ok(Err(fault)) => prop_assert!(!fault.to_string().is_empty()),
        Err(fault) => prop_assert_eq!(fault.to_string().lines().count(), 1),
    }
    Ok(())
}

/// Pieces of OBJ lines, so that arbitrary text gets past the first word.
fn obj_text() -> impl Strategy<Value = String> {
    let word = prop_oneof![
        Just("v"),
        Just("vt"),
        Just("f"),
        Just("\nv"),
        Just("\nf"),
        Just("\n"),
        Just("0"),
        Just("1"),
        Just("2"),
        Just("3"),
        Just("-1"),
        Just("1/1"),
        Just("2//3"),
        Just("/"),
        Just("1e39"),
        Just("nan"),
        Just("0.5"),
        Just("\\\n"),
        Just("#"),
        Just("99999999999999999999"),
    ];
    prop::collection::vec(word, 0..60).prop_map(|words| words.join(" "))
}

proptest! {
    #[test]
    fn any_bytes_as_obj(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        sane(parse_obj(bytes.as_slice()))?;
    }

    #[test]
    fn any_words_as_obj(text in obj_text()) {
        sane(parse_obj(format!("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 1\nvt 0 0\n{text}").as_bytes()))?;
    }

    #[test]
    fn any_bytes_as_ply(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        sane(parse_ply(bytes.as_slice(), bytes.len() as u64))?;
    }

    #[test]
    fn any_header_and_body_as_ply(
        format in prop_oneof![Just("ascii"), Just("binary_little_endian"), Just("binary_big_endian")],
        vertices in prop_oneof![0u64..6, Just(u64::MAX), Just(4_294_967_295)],
        faces in prop_oneof![0u64..6, Just(1 << 40)],
        count in prop_oneof![Just("uchar"), Just("int"), Just("double"), Just("uint")],
        body in prop::collection::vec(any::<u8>(), 0..200),
    ) {
        let header = format!(
            "ply\nformat {format} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n\
             element nothing 99999999999\nelement face {faces}\nproperty list {count} int vertex_indices\nend_header\n"
        );
        let bytes = [header.as_bytes(), &body].concat();
        sane(parse_ply(bytes.as_slice(), bytes.len() as u64))?;
    }

    #[test]
    fn numbers_as_ascii_ply(numbers in prop::collection::vec(-2i64..6, 0..60), width in 1usize..7) {
        let lines: Vec<String> = numbers.chunks(width).map(|line| line.iter().map(i64::to_string).collect::<Vec<_>>().join(" ")).collect();
        let text = format!(
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n\
             property list uchar int vertex_indices\nend_header\n{}", lines.join("\n"));
        sane(parse_ply(text.as_bytes(), text.len() as u64))?;
    }

    #[test]
    fn the_order_is_a_permutation_and_knows_no_input_order_but_for_ties(
        points in prop::collection::vec((-3i8..4, -3i8..4, -3i8..4), 0..200), seed in any::<u64>(),
    ) {
        let points: Vec<Vec3> = points.iter().map(|&(x, y, z)| Vec3::new(x.into(), y.into(), z.into())).collect();
        let order = locality_order(&points);
        prop_assert_eq!(&order, &locality_order(&points));
        let mut sorted = order.clone();
        sorted.sort_unstable();
        prop_assert_eq!(sorted, (0..points.len() as u32).collect::<Vec<_>>());

        // The same points in another order, made different from each other by their index along a line.
        let distinct: Vec<Vec3> = points.iter().zip(0..).map(|(p, i)| *p + Vec3::splat(i as f32 * 1e-3)).collect();
        let mut shuffled: Vec<usize> = (0..points.len()).collect();
        shuffled.sort_by_key(|&i| (i as u64 + 1).wrapping_mul(seed | 1).rotate_left(17));
        let moved: Vec<Vec3> = shuffled.iter().map(|&i| distinct[i]).collect();
        let places = |order: Vec<u32>, points: &[Vec3]| order.iter().map(|&i| points[i as usize].to_array()).collect::<Vec<_>>();
        prop_assert_eq!(places(locality_order(&moved), &moved), places(locality_order(&distinct), &distinct));
    }
}

#[test]
fn a_pin_takes_the_vertices_of_a_ply_property() {
    let folder = tempfile::tempdir().unwrap();
    // The first vertex belongs to no triangle, so the others move up by one.
    let text = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float nx\n\
        property float z\nproperty uchar waist\nproperty float weight\nelement face 2\n\
        property list uchar int vertex_indices\nend_header\n\
        9 9 1 9 1 1\n0 0 1 0 1 0\n1 0 1 0 0 0.5\n1 1 1 0 1 0.4\n0 1 1 0 0 7\n3 1 2 3\n3 1 3 4\n";
    std::fs::write(folder.path().join("a.ply"), text).unwrap();
    let pins = |pin: &str| {
        let scene = format!("[[cloth]]\nname = \"a\"\nmesh = \"a.ply\"\n[[pin]]\n{pin}\n");
        let read = loomtree::scene::parse(&scene, &folder.path().join("x.toml"), &Default::default());
        read.map(|scene| scene.pins.iter().map(|pin| pin.vertex).collect::<Vec<u32>>()).map_err(|e| e.to_string())
    };
    assert_eq!(pins("property = \"waist\""), Ok(vec![0, 2]));
    assert_eq!(pins("property = \"weight\""), Ok(vec![1, 3]));
    let error = pins("property = \"hem\"").unwrap_err();
    assert!(error.contains("no vertex property named `hem` (nx, waist, weight)"), "{error}");
    assert!(pins("property = \"nx\"\ngroup = \"b\"").unwrap_err().contains("exactly one of"));
}
