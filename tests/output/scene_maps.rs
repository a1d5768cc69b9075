//! Maps of a cloth: factors from vertex properties and images, at every vertex, and the sentence for every mistake.
//! What they do to the motion is `physics::maps`'s question.

use std::path::Path;

use loomtree::scene::{Maps, Overrides, Scene, parse};

const PLY: &str = "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n\
    property float heavy\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n\
    0 0 0 1\n9 9 9 7\n1 0 0 2\n1 1 0 4\n0 1 0 0.5\n3 0 2 3\n3 0 3 4\n";

/// Texture coordinates that keep lengths; the image lies over the square.
const OBJ: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n";

/// A folder with the files that the scenes below name.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
    write("m.ply", PLY.as_bytes());
    write("m.obj", OBJ.as_bytes());
    write("bare.obj", OBJ.replace("/1", "").replace("/2", "").replace("/3", "").replace("/4", "").as_bytes());
    write("no.png", b"nothing");
    // Left black, right white; 16 bit gray with alpha for the second one: dark above, bright below.
    write("left.png", &png(png::ColorType::Rgb, png::BitDepth::Eight, [2, 1], &[0, 0, 0, 255, 255, 255]));
    let deep = png(png::ColorType::GrayscaleAlpha, png::BitDepth::Sixteen, [1, 2], &[0, 0, 9, 9, 255, 255, 0, 0]);
    write("down.png", &deep);
    folder
}

fn png(color: png::ColorType, depth: png::BitDepth, [width, height]: [u32; 2], samples: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.write_header().unwrap().write_image_data(samples).unwrap();
    bytes
}

fn read(folder: &Path, text: &str) -> Result<Scene, String> {
    parse(text, &folder.join("x.toml"), &Overrides::default()).map_err(|error| error.to_string())
}

#[test]
fn properties_give_their_own_factors_and_added_vertices_the_mean() {
    let folder = folder();
    let scene = read(folder.path(), "[[cloth]]\nmesh = \"m.ply\"\n[cloth.maps]\ndensity = \"heavy\"").unwrap();
    assert_eq!(
        scene.maps,
        Maps { density: vec![1.0, 2.0, 4.0, 0.5], ..Maps::default() },
        "a vertex of no triangle is out"
    );
    let text =
        "[[cloth]]\nmesh = \"m.ply\"\nsubdivide = 1\nmaps = { stiffness = { property = \"heavy\", from = 1, to = 3 } }";
    let scene = read(folder.path(), text).unwrap();
    assert_eq!(scene.maps.stiffness[..4], [3.0, 5.0, 9.0, 2.0]);
    assert_eq!(scene.maps.stiffness.len(), 9);
    let middle = |x: f32, y: f32| scene.mesh.positions.iter().position(|p| (p.x, p.y) == (x, y)).unwrap();
    assert_eq!(scene.maps.stiffness[middle(0.5, 0.0)], 4.0);
    // A piece without a map has 1 beside one that has.
    let two = "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 2, mesh = \"grid\" }\norigin_m = [0, 0, 1]\n\
        [[cloth]]\nmesh = \"m.ply\"\nmaps = { friction = \"heavy\" }";
    let scene = read(folder.path(), two).unwrap();
    assert_eq!(scene.maps.friction, [1.0, 1.0, 1.0, 1.0, 1.0, 2.0, 4.0, 0.5]);
    assert_eq!((scene.friction_of_vertex(0), scene.friction_of_vertex(6)), (0.3, 4.0 * 0.3));
}

#[test]
fn images_cover_a_sheet_and_the_texture_of_a_mesh() {
    let folder = folder();
    let sheet = "[[cloth]]\nsheet = { size_m = [2, 3], triangles = 32, mesh = \"grid\" }\n";
    let text = format!(
        "{sheet}maps = {{ thickness = {{ image = \"left.png\", from = 0.5 }}, density = {{ image = \"down.png\", from = 3, to = 1 }} }}"
    );
    let scene = read(folder.path(), &text).unwrap();
    for (v, p) in scene.mesh.positions.iter().enumerate() {
        // Pixels have their centers at a quarter and three quarters.
        let between = |share: f32| ((share - 0.25) / 0.5).clamp(0.0, 1.0);
        let (across, down) = (0.5 + 0.5 * between(p.x / 2.0), 3.0 - 2.0 * between(1.0 - p.y / 3.0));
        assert!((scene.maps.thickness[v] - across).abs() < 1e-5, "{p}: {} {across}", scene.maps.thickness[v]);
        assert!((scene.maps.density[v] - down).abs() < 1e-4, "{p}: {} {down}", scene.maps.density[v]);
    }
    let text =
        "[[cloth]]\nmesh = \"m.obj\"\nsubdivide = 1\nmaps = { stiffness = { image = \"left.png\", from = 1, to = 2 } }";
    let scene = read(folder.path(), text).unwrap();
    for (p, factor) in scene.mesh.positions.iter().zip(&scene.maps.stiffness) {
        assert!((factor - (1.0 + p.x)).abs() < 1e-6, "{p}: {factor}");
    }
}

#[test]
fn mistakes_of_maps_are_named() {
    let folder = folder();
    let mesh = |maps: &str| format!("[[cloth]]\nmesh = \"m.ply\"\nmaps = {{ {maps} }}");
    for (text, what) in [
        (
            mesh("density = \"light\""),
            "line 3: field `cloth.maps.density`: `cloth 0` has no vertex property named `light` (heavy)",
        ),
        (
            mesh("mass = \"heavy\""),
            "`cloth.maps.mass`: unknown field; known here: density, stiffness, friction, thickness",
        ),
        (mesh("density = {}"), "field `cloth.maps.density`: a map needs a `property` or an `image`"),
        (mesh("density = { property = \"heavy\", image = \"left.png\" }"), "a map needs a `property` or an `image`"),
        (mesh("density = 3"), "field `cloth.maps.density`: must be a table"),
        (
            mesh("thickness = \"heavy\""),
            "the factor of vertex 2 of `cloth 0` is 2; it must be from 0.2 to 1; simulation.thickness_m is the largest thickness",
        ),
        (
            mesh("stiffness = { property = \"heavy\", to = -1 }"),
            "the factor of vertex 0 of `cloth 0` is -1; it must be from 0.001 to 1000",
        ),
        (
            mesh("friction = { image = \"there.png\" }"),
            "no file `there.png` beside the scene or in the working directory",
        ),
        (mesh("friction = { image = \"no.png\" }"), "no.png: is not a PNG image that can be read"),
        (mesh("friction = { image = \"left.png\" }"), "`cloth 0` has no texture coordinates; an image needs a sheet"),
        (
            "[[cloth]]\nmesh = \"bare.obj\"\nmaps = { friction = { image = \"left.png\" } }".into(),
            "`cloth 0` has no texture coordinates",
        ),
        (
            "[[cloth]]\nsheet = { size_m = [1, 1], triangles = 8 }\nmaps = { friction = \"heavy\" }".into(),
            "`cloth 0` has no vertex property named `heavy` (its file has none)",
        ),
    ] {
        let found = read(folder.path(), &text).expect_err(&text);
        assert!(found.contains(what), "{text}: {found}");
    }
}
