//! Arbitrary text as scene, ARCSim scene and fabric: a scene or one sentence, never a panic.

use std::path::Path;

use loomtree::scene::{Obstacles, Overrides, parse, parse_fabric};
use proptest::prelude::*;

fn sane(text: &str) -> Result<(), TestCaseError> {
    for name in ["s.toml", "s.json"] {
        match parse(text, Path::new(name), &Overrides { resolution: None, frames: Some(1) }) {
            Ok(scene) => {
                prop_assert_eq!(scene.velocities.len(), scene.mesh.positions.len());
                let (obstacles, mut positions) = (Obstacles::new(&scene.obstacles), Vec::new());
                for time_s in [0.0, 0.7, 1.5, 1e6] {
                    obstacles.positions_at(time_s, &mut positions);
                    prop_assert_eq!(positions.len(), 3 * obstacles.vertices());
                    prop_assert!(positions.iter().all(|x| x.is_finite()), "{} at {} s", text, time_s);
                }
            }
            Err(error) => prop_assert_eq!(error.to_string().lines().count(), 1, "{}", error),
        }
    }
    if let Err(error) = parse_fabric(text, Path::new("f.json")) {
        prop_assert_eq!(error.to_string().lines().count(), 1, "{}", error);
    }
    Ok(())
}

/// A scene with some values replaced by others of any type.
fn toml_scene() -> impl Strategy<Value = String> {
    let value = prop_oneof![
        Just("0".to_owned()),
        Just("-1".to_owned()),
        Just("1e-9".to_owned()),
        Just("nan".to_owned()),
        Just("1e300".to_owned()),
        Just("[1, 2, 3]".to_owned()),
        Just("[[0, 0, 0], [1, 1, 1]]".to_owned()),
        Just("\"left\"".to_owned()),
        Just("\"cotton\"".to_owned()),
        Just("{}".to_owned()),
        Just("{ size_m = [1, 1], triangles = 8 }".to_owned()),
        Just("{ size_m = [1e-30, 1e30], triangles = 9 }".to_owned()),
        Just("true".to_owned()),
        Just("1979-05-27".to_owned()),
        Just("[{ time_s = 1 }]".to_owned()),
        (0u8..9).prop_map(|n| n.to_string()),
        Just("9223372036854775807".to_owned()),
        Just("[]".to_owned()),
        Just("[90, 0, 0, 1]".to_owned()),
        Just("{ center_m = [0, 0, 9], radius_m = 1, triangles = 20 }".to_owned()),
        Just("{ center_m = [0, 0, 0], size_m = [1, 1, 1e-3], triangles = 12 }".to_owned()),
        Just("{ center_m = [0, 3e38, 0], size_m = [1, 2], normal = [0, 0, -1] }".to_owned()),
        Just("{ point_m = [0, 0, 9], size_m = [1, 1e9] }".to_owned()),
        Just("{ center_m = [0, 0, 9], top_radius_m = 2, bottom_radius_m = 1, height_m = 1e-9 }".to_owned()),
        Just("[{ time_s = 1, scale = 1e30 }, { time_s = 2, rotate_deg = [1e30, 0, 1, 0], translate_m = [3e38, 3e38, 0] }]".to_owned()),
        Just("\"x%04d.obj\"".to_owned()),
    ];
    let key = prop::sample::select(vec![
        "\n[simulation]\nstep_s",
        "\n[air]\nwind_m_s",
        "\n[[cloth]]\nsheet",
        "\nplane",
        "\norigin_m",
        "\nrotate_deg",
        "\nfabric",
        "\nthicken",
        "\n[[pin]]\nedge",
        "\nevery",
        "\ncount",
        "\nvertices",
        "\nbox_m",
        "\nsphere",
        "\nmotion",
        "\nend_s",
        "\nframe_s",
        "\nresolution",
        "\nmesh",
        "\n[[fabric]]\nbending_n_m",
        "\nstretching_n_m",
        "\ncorners",
        "\nscale",
        "\nfriction",
        "\ncollisions",
        "\ncontact_stiffness",
        "\n[[obstacle]]\nsphere",
        "\n[[obstacle]]\nbox",
        "\n[[obstacle]]\nplate",
        "\n[[obstacle]]\nplane",
        "\n[[obstacle]]\nfunnel",
        "\n[[obstacle]]\nsequence",
        "\nframes_per_s",
    ]);
    prop::collection::vec((key, value), 0..8).prop_map(|fields| {
        let fields: String = fields.iter().map(|(key, value)| format!("{key} = {value}")).collect();
        format!("[[cloth]]\nsheet = {{ size_m = [1, 1], triangles = 8 }}{fields}")
    })
}

fn json_scene() -> impl Strategy<Value = String> {
    let leaf = prop_oneof![
        Just("1".to_owned()),
        Just("-1".to_owned()),
        Just("null".to_owned()),
        Just("'meshes/m.obj'".to_owned()),
        Just("1e999".to_owned()),
        Just("[0,0,0]".to_owned()),
        Just("NaN".to_owned()),
        Just("[90,0,0,1]".to_owned()),
    ];
    leaf.prop_recursive(4, 24, 4, |inner| {
        let key = prop::sample::select(vec![
            "frame_time",
            "cloths",
            "mesh",
            "transform",
            "materials",
            "handles",
            "nodes",
            "motions",
            "motion",
            "time",
            "wind",
            "magic",
            "disable",
            "obstacles",
            "motfile",
            "fps",
            "obs_friction",
            "density",
            "stretching",
            "bending",
            "end_time",
        ]);
        prop_oneof![
            prop::collection::vec(inner.clone(), 0..4).prop_map(|list| format!("[{}]", list.join(","))),
            prop::collection::vec((key, inner), 0..4)
                .prop_map(|list| format!("{{{}}}", list.iter().map(|(k, v)| format!("{k}:{v},")).collect::<String>())),
        ]
    })
}

proptest! {
    #[test]
    fn any_text(text in "\\PC{0,200}") {
        sane(&text)?;
    }

    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        sane(&String::from_utf8_lossy(&bytes))?;
    }

    #[test]
    fn any_punctuation(text in "[\\[\\]{}=,:#/*\"'a0.\\-\n \\\\]{0,80}") {
        sane(&text)?;
    }

    #[test]
    fn scenes_with_any_values(text in toml_scene()) {
        sane(&text)?;
    }

    #[test]
    fn arcsim_scenes_with_any_values(text in json_scene()) {
        sane(&text)?;
    }
}

#[test]
fn deep_nesting_is_refused() {
    for open in ["[", "{a=", "a.", "[[", "{a:", "[/*]*/", "'["] {
        let deep = open.repeat(50_000);
        for (name, text) in [("s.toml", format!("a = {deep}")), ("s.toml", deep.clone()), ("s.json", deep.clone())] {
            let error = parse(&text, Path::new(name), &Overrides::default()).unwrap_err().to_string();
            assert_eq!(error.lines().count(), 1, "{error}");
        }
    }
}
