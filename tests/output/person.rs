//! The person that is made by formulas, and her clothes: closed surfaces, clips that keep the body out of itself,
//! garments that start around it without touching it at any resolution.

use std::path::Path;

use bytemuck::cast_slice;
use loomtree::math::Vec3;
use loomtree::mesh::{NearestPoint, TriangleMesh, first_intersection};
use loomtree::scene::{Obstacles, Overrides, Scene, SceneError, parse};

fn scene(text: &str) -> Result<Scene, SceneError> {
    parse(text, Path::new("x.toml"), &Overrides::default())
}

fn person(more: &str, garment: &str) -> Scene {
    let text = format!(
        r#"
        [[cloth]]
        garment = {{ {garment} }}
        origin_m = [1, 0, 2]
        rotate_deg = [30, 0, 1, 0]
        [[obstacle]]
        body = "person"
        origin_m = [1, 0, 2]
        rotate_deg = [30, 0, 1, 0]
        {more}
        "#
    );
    scene(&text).unwrap()
}

fn body_at(scene: &Scene, time_s: f64) -> Vec<Vec3> {
    let mut values = Vec::new();
    Obstacles::new(&scene.obstacles).positions_at(time_s, &mut values);
    cast_slice(&values).to_vec()
}

#[test]
fn the_body_is_closed_stands_on_the_floor_and_stays_out_of_itself_in_every_clip() {
    for (clip, length_s) in
        [("stand", 4.0), ("spin", 6.0), ("walk", 6.0), ("kneel", 4.0), ("kick", 4.0), ("sit", 4.0), ("bow", 4.0)]
    {
        let scene = person(&format!("clip = \"{clip}\""), "kind = \"skirt\", triangles = 3000");
        let body = &scene.obstacles[0];
        let mut edges: Vec<[u32; 2]> = Vec::new();
        for &[a, b, c] in &body.triangles {
            edges.extend([[a, b], [b, c], [c, a]]);
        }
        let mut reversed: Vec<[u32; 2]> = edges.iter().map(|&[a, b]| [b, a]).collect();
        edges.sort_unstable();
        reversed.sort_unstable();
        assert_eq!(edges, reversed, "closed");
        assert!(edges.windows(2).all(|pair| pair[0] != pair[1]));
        assert!((11_000..13_000).contains(&body.triangles.len()), "{}", body.triangles.len());
        for look in 0..=16 {
            let time_s = length_s * f64::from(look) / 16.0;
            let positions = body_at(&scene, time_s);
            let lowest = positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
            let triangles = body.triangles.clone();
            let crossing = first_intersection(&TriangleMesh { positions, triangles, ..TriangleMesh::default() });
            assert_eq!(crossing, None, "{clip} at {time_s} s");
            assert!((-0.02..0.03).contains(&lowest), "{clip} at {time_s} s: {lowest}");
        }
    }
}

#[test]
fn garments_start_around_the_body_at_any_resolution() {
    for kind in ["dress", "skirt", "jacket", "trousers", "robe"] {
        for triangles in [3_000, 7_000] {
            // A cloth that crosses or touches the body at the start is refused.
            let scene = person("", &format!("kind = \"{kind}\", triangles = {triangles}"));
            let count = scene.mesh.triangles.len() as f64;
            assert!((count / f64::from(triangles) - 1.0).abs() < 0.12, "{kind}: {count} of {triangles}");
        }
    }
}

#[test]
fn shipped_scenes_start_at_any_resolution_and_hold_the_waist() {
    for name in ["dress", "kneel", "karate", "princess", "pleats", "kimono", "three_pieces"] {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes").join(name).with_extension("toml");
        let parsed = loomtree::scene::read(&path).unwrap();
        for resolution in [None, Some(5_000)] {
            let scene = parsed.at(&Overrides { resolution, frames: None }).unwrap();
            assert_eq!(scene.name, name);
            // The waist is a ring of vertices, some 20 of them on the coarsest dress.
            assert!(scene.pins.len() >= 16 && scene.followed == [0], "{name}: {} pins", scene.pins.len());
        }
    }
}

#[test]
fn a_garment_keeps_its_ease_from_the_body() {
    let scene = person("", "kind = \"dress\", triangles = 3000, ease_m = 0.02");
    let body = body_at(&scene, 0.0);
    let surface = NearestPoint::new(&body, &scene.obstacles[0].triangles);
    let distance = |p: &Vec3| surface.to(p.as_dvec3()).unwrap().distance_m;
    let least = scene.mesh.positions.iter().map(distance).fold(f64::INFINITY, f64::min);
    assert!((0.015..0.021).contains(&least), "{least}");
}

#[test]
fn mistakes_are_named() {
    let refused = |cloth: &str, obstacle: &str| {
        let text = format!("[[cloth]]\n{cloth}\n[[obstacle]]\n{obstacle}");
        scene(&text).unwrap_err().to_string()
    };
    let (dress, body) = ("garment = { kind = \"dress\", triangles = 3000 }", "body = \"person\"");
    for (cloth, obstacle, what) in [
        ("garment = { kind = \"hat\" }", body, "field `cloth.garment.kind`: must be one of dress, skirt"),
        (
            "garment = { kind = \"robe\", pleats = 9 }",
            body,
            "field `cloth.garment.pleats`: belongs to a dress or skirt",
        ),
        (
            "garment = { kind = \"skirt\", hem_m = 1.2 }",
            body,
            "field `cloth.garment.hem_m`: must be from 0.01 to 0.85 m",
        ),
        ("garment = { kind = \"skirt\" }\nweld_m = 1", body, "field `cloth.weld_m`: does not belong"),
        (dress, "body = \"horse\"", "field `obstacle.body`: must be one of person"),
        (dress, "body = \"person\"\nclip = \"fly\"", "no clip is named `fly`; the file has stand, spin"),
        (dress, "body = \"person\"\nnode = \"x\"", "belongs to an obstacle with a `gltf`, `usd` or `abc`"),
        (dress, "body = \"person\"\nunits_m = 2", "field `obstacle.units_m`: belongs to an obstacle with one of"),
        (dress, "body = \"person\"\ntriangles = 100", "must be a whole number from 4000"),
        (
            dress,
            "sphere = { center_m = [0, 9, 0], radius_m = 1 }\ntriangles = 100",
            "belongs to an obstacle with a `body`",
        ),
    ] {
        let error = refused(cloth, obstacle);
        assert!(error.contains(what), "{error}");
    }
}
