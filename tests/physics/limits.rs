//! Strain limits: cloth that hangs, flies and is pulled stays within them, and where nothing reaches them nothing
//! changes.

use loomtree::math::{DVec3, Vec3};
use loomtree::model::State;
use loomtree::output::{BeyondLimits, beyond_limit, principal_stretches};
use loomtree::scene::{Fabric, Keyframe, Motion, Obstacles, Overrides, Pin, Scene, StrainLimit, read_str};
use loomtree::solver::ExchangeMode;
use support::physics::{ACROSS, DOWN, OneRank, strip, uniform_fabric};
use support::{cpu, isotropic_fabric, scene, sheet, simulate};

fn limited(fabric: Fabric, strain_limit: [f64; 2]) -> Fabric {
    Fabric { strain_limit: Some(StrainLimit::Every(strain_limit)), ..fabric }
}

/// Largest and smallest stretch of all triangles.
fn stretches(scene: &Scene, positions: &[Vec3]) -> [f64; 2] {
    let mesh = &scene.mesh;
    mesh.triangles.iter().zip(&mesh.material_uv).fold([0.0, f64::INFINITY], |[most, least], (corners, uv)| {
        let [largest, smallest] = principal_stretches(corners.map(|v| positions[v as usize]), *uv);
        [most.max(largest), least.min(smallest)]
    })
}

/// A strip that hangs from its end. Its weight would stretch it by `density g L / k` there.
fn hanging_strip(strain_limit: Option<StrainLimit>) -> Scene {
    let fabric = Fabric { damping_s: 0.01, strain_limit, ..uniform_fabric([50.0, 0.0, 50.0, 20.0], 1e-6, 0.5) };
    let pinned: Vec<u32> = (0..ACROSS as u32).collect();
    scene(strip(40, 0.025, -Vec3::Z), fabric, &pinned, 0.004, DOWN)
}

#[test]
fn a_hanging_strip_ends_at_its_limit() {
    let ends_at = |strain_limit| {
        let scene = hanging_strip(strain_limit);
        let mut cloth = OneRank::new(&scene);
        for _ in 0..1500 {
            cloth.step();
        }
        // Nothing takes out what swings it to and fro, but it has stopped to fall.
        assert!(cloth.fastest_m_s() < 0.05, "{strain_limit:?}: {} m/s", cloth.fastest_m_s());
        stretches(&scene, &cloth.positions())[0]
    };
    // The stiffness is per Green strain, so the stretch s obeys k s (s^2 - 1) / 2 = weight: 9.1 % for 9.8 %.
    assert!(ends_at(None) > 1.08);
    for most in [1.02, 1.05] {
        let largest = ends_at(Some(StrainLimit::Every([0.0, most])));
        assert!(largest > most && largest < most + 0.005, "limit {most}: stretched to {largest}");
    }
}

#[test]
fn within_the_limits_nothing_changes() {
    let mut flying = scene(
        sheet(13, 13, [0.4; 2], Vec3::ZERO, Vec3::X, Vec3::Y),
        isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.001),
        &[0, 12],
        0.004,
        DOWN,
    );
    let without = simulate(&flying, 1, ExchangeMode::Halo, 20, cpu);
    assert!(stretches(&flying, &without.positions)[0] < 1.2);
    flying.fabrics[0].strain_limit = Some(StrainLimit::Every([0.2, 1.5]));
    let with = simulate(&flying, 1, ExchangeMode::Halo, 20, cpu);
    assert_eq!(with.positions, without.positions);
    assert_eq!(with.velocities, without.velocities);
}

/// A sheet that starts 10 % too long and 10 % too short, and flies.
fn pulled() -> Scene {
    let fabric = limited(isotropic_fabric(300.0, 0.3, 2e-5, 0.15, 0.0), [0.95, 1.05]);
    let mut scene = scene(sheet(11, 11, [0.4; 2], Vec3::ZERO, Vec3::X, Vec3::Y), fabric, &[], 0.002, Vec3::ZERO);
    scene.mesh.positions.iter_mut().for_each(|p| *p = Vec3::new(1.1 * p.x, 0.9 * p.y, 0.01 * (20.0 * p.x).sin()));
    scene.settings.relative_tolerance = 1e-7;
    scene
}

/// Of the mass at its highest speed: per step an f32 rounding of every velocity, and that of the product of the matrix
/// with the change of velocities. The second one is eps K dt^2 / (rho h^2), K the stiffness of a limit, over the square
/// root of the number of rows; the tolerance of the solve has no part in it.
#[test]
fn limits_keep_the_momentum() {
    for (step_s, relative) in [(0.002, 1e-5), (0.0005, 1e-6)] {
        let mut scene = pulled();
        scene.settings.step_s = step_s;
        let mut cloth = OneRank::new(&scene);
        let mass: f64 = cloth.masses().iter().sum();
        let (mut scale, mut worst) = (0.0f64, 0.0f64);
        for _ in 0..(0.1 / step_s) as u32 {
            cloth.step();
            scale = scale.max(mass * f64::from(cloth.fastest_m_s()));
            worst = worst.max(cloth.momentum().length() / scale);
        }
        println!("{step_s} s: {worst:.1e} of the momentum");
        assert!(worst < relative, "{step_s} s: {worst} of {scale} kg m/s");
        assert!(scale > mass, "nothing is faster than 1 m/s");
        let [most, least] = stretches(&scene, &cloth.positions());
        assert!(most < 1.055 && least > 0.945, "{most} {least}");
    }
}

#[test]
fn limits_give_the_same_bits_on_every_number_of_ranks() {
    let mut scene = pulled();
    scene.settings.relative_tolerance = 0.01;
    let one = simulate(&scene, 1, ExchangeMode::Halo, 12, cpu);
    for ranks in [2, 3, 5, 8] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 12, cpu);
        assert!(many.positions == one.positions && many.velocities == one.velocities, "{ranks} ranks");
    }
}

/// A strip that spins about the edge it is held by turns by 0.4 rad in a step. A tangent of that length is longer than
/// the strip by 1 / cos 0.4, 8.6 %. What its own mass asks of the limit is density w^2 L^2 / 2 = 25 N/m, a little over
/// what the fabric holds at 3 %.
#[test]
fn cloth_that_turns_far_within_a_step_is_not_longer_for_it() {
    let fabric = limited(uniform_fabric([600.0, 0.0, 600.0, 200.0], 1e-6, 0.5), [0.9, 1.03]);
    let held: Vec<u32> = (0..ACROSS as u32).collect();
    let mut scene = scene(strip(8, 0.0125, -Vec3::Z), fabric, &held, 0.004, Vec3::ZERO);
    scene.velocities = scene.mesh.positions.iter().map(|p| Vec3::X * (-100.0 * p.z)).collect();
    let mut cloth = OneRank::new(&scene);
    let (mut most, mut solved_again) = (0.0f64, 0);
    for _ in 0..10 {
        solved_again += cloth.step().limits.solved_again;
        most = most.max(stretches(&scene, &cloth.positions())[0]);
    }
    println!("{:.2} % beyond, {solved_again} steps solved again, {} m/s", 100.0 * (most - 1.03), cloth.fastest_m_s());
    assert!(most < 1.035, "{most}");
    assert!(solved_again > 0, "no step ended far beyond the limit");
}

/// A sheet that hangs by two corners in a wind of 10 m/s: it is thrown taut in a quarter of a second, and all its load
/// hangs by two points. This is ARCSim's flag without what happens to it later.
fn thrown_taut() -> Scene {
    let fabric = limited(isotropic_fabric(200.0, 0.3, 3e-5, 0.57, 0.0), [0.95, 1.05]);
    let mesh = sheet(31, 21, [3.0, 2.0], Vec3::ZERO, Vec3::X, Vec3::Z);
    let mut scene = scene(mesh, fabric, &[0, 31 * 20], 0.005, DOWN);
    scene.settings.wind_m_s = Vec3::new(7.0, 7.0, 0.0);
    scene.settings.air_density_kg_m3 = 1.0;
    scene
}

#[test]
fn a_sheet_that_the_wind_throws_taut_stays_near_its_limits() {
    let scene = thrown_taut();
    let mut cloth = OneRank::new(&scene);
    let (mut most, mut least, mut solved_again, mut pulled) = (0.0f64, 1.0f64, 0, 0);
    for _ in 0..80 {
        let limits = cloth.step().limits;
        (solved_again, pulled) = (solved_again + limits.solved_again, pulled + limits.pulled);
        let [largest, smallest] = stretches(&scene, &cloth.positions());
        (most, least) = (most.max(largest), least.min(smallest));
    }
    println!("{least} to {most}, {solved_again} steps solved again, {pulled} triangles pulled back");
    assert!(cloth.fastest_m_s() > 1.0);
    assert!(most < 1.09 && least > 0.945, "{least} to {most}");
    assert!(solved_again > 0 && pulled > 0);
}

#[test]
fn what_is_pulled_back_has_the_same_bits_on_every_number_of_ranks() {
    let scene = thrown_taut();
    let one = simulate(&scene, 1, ExchangeMode::Halo, 45, cpu);
    for ranks in [2, 5, 8] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 45, cpu);
        assert!(many.positions == one.positions && many.velocities == one.velocities, "{ranks} ranks");
    }
}

/// Warp, weft and shear by themselves.
fn along(warp: Option<[f64; 2]>, weft: Option<[f64; 2]>, shear_deg: Option<f64>) -> Option<StrainLimit> {
    Some(StrainLimit::Along { warp, weft, shear_deg })
}

#[test]
fn a_limit_of_the_warp_leaves_the_weft_alone() {
    let ends_at = |strain_limit| {
        let scene = hanging_strip(strain_limit);
        let mut cloth = OneRank::new(&scene);
        (0..1500).for_each(|_| _ = cloth.step());
        stretches(&scene, &cloth.positions())[0]
    };
    // The strip hangs by its warp.
    let largest = ends_at(along(Some([0.0, 1.02]), None, None));
    assert!(largest > 1.02 && largest < 1.025, "{largest}");
    assert!(ends_at(along(None, Some([0.9, 1.02]), Some(10.0))) > 1.08);
}

#[test]
fn a_limit_of_shear_holds_the_angle_between_warp_and_weft() {
    let angle_of = |strain_limit| {
        let fabric = Fabric { strain_limit, ..uniform_fabric([400.0, 0.0, 400.0, 1.0], 1e-5, 0.15) };
        let held: Vec<u32> = (0..9).collect();
        // Hung up by its left edge, so that its weight shears it.
        let mesh = sheet(9, 9, [0.4; 2], Vec3::ZERO, Vec3::Z, Vec3::X);
        let mut scene = scene(mesh, fabric, &held, 0.004, DOWN);
        scene.fabrics[0].damping_s = 0.01;
        let mut cloth = OneRank::new(&scene);
        let mut most = 0.0f64;
        for step in 0..800 {
            cloth.step();
            if step < 780 {
                continue;
            }
            let x = cloth.positions();
            let limit = StrainLimit::Along { warp: None, weft: None, shear_deg: Some(1e-3) };
            let beyond = scene.mesh.triangles.iter().zip(&scene.mesh.material_uv);
            let beyond = beyond.map(|(t, uv)| beyond_limit(&limit, t.map(|v| x[v as usize]), *uv)).fold(0.0, f64::max);
            most = most.max((2.0 * beyond).clamp(0.0, 1.0).asin().to_degrees());
        }
        most
    };
    let free = angle_of(None);
    assert!(free > 15.0, "{free} degrees");
    let held = angle_of(along(None, None, Some(8.0)));
    println!("free {free}, held {held} degrees");
    assert!(held > 7.0 && held < 8.6, "{held} degrees");
}

/// Pins that move farther apart than a limit allows: the cloth gives way, the run goes on, and the report names a pin.
#[test]
fn impossible_limits_are_counted_and_named() {
    let mut scene = hanging_strip(Some(StrainLimit::Every([0.9, 1.05])));
    scene.settings.gravity_m_s2 = Vec3::ZERO;
    let last = scene.mesh.positions.len() as u32 - ACROSS as u32;
    scene.motions = vec![Motion {
        keyframes: [(0.0, 0.0), (0.4, 0.2), (9.0, 0.2)]
            .map(|(time_s, by)| Keyframe { translation_m: DVec3::new(0.0, 0.0, -by), ..Keyframe::identity(time_s) })
            .into(),
    }];
    let pin = |vertex: u32, motion| Pin::new(vertex, motion, 0.0, f64::INFINITY);
    let columns = ACROSS as u32;
    scene.pins = (0..columns).map(|v| pin(v, None)).chain((last..last + columns).map(|v| pin(v, Some(0)))).collect();
    let mut cloth = OneRank::new(&scene);
    let obstacles = Obstacles::new(&scene.obstacles);
    let state = |cloth: &OneRank| State { positions: cloth.positions(), ..State::start_of(&scene) };
    assert_eq!(BeyondLimits::of(&scene, &obstacles, &state(&cloth), 0.0), None);
    (0..200).for_each(|_| _ = cloth.step());
    let found = BeyondLimits::of(&scene, &obstacles, &state(&cloth), 0.8).expect("20 % is beyond 5 %");
    assert!(found.triangles > 100 && found.at_pins > 4, "{found:?}");
    assert!(found.strain > 0.1 && found.strain < 0.4, "{found:?}");
    assert!(found.place.ends_with("which a pin holds") || found.at_pins < found.triangles, "{found:?}");
    assert_eq!(found.at_obstacles, []);
}

/// A ball that grows into a sheet held at its rim makes the limit impossible, and the report names it.
#[test]
fn an_obstacle_that_makes_a_limit_impossible_is_named() {
    let text = r#"
        resolution = 400
        [simulation]
        step_s = 0.004
        gravity_m_s2 = [0.0, 0.0, 0.0]
        [[cloth]]
        sheet = { size_m = [0.4, 0.4] }
        plane = "xz"
        strain_limit = [0.9, 1.02]
        [[pin]]
        edge = "left"
        [[pin]]
        edge = "right"
        [[obstacle]]
        name = "wall"
        plane = { point_m = [0.0, -1.0, 0.0], size_m = [1.0, 1.0] }
        [[obstacle]]
        name = "ram"
        sphere = { center_m = [0.2, -0.11, -0.2], radius_m = 0.1, triangles = 500 }
        motion = [{ time_s = 0.0 }, { time_s = 0.3, translate_m = [0.0, 0.12, 0.0] }]
    "#;
    let scene = read_str(text, "ram.toml".as_ref()).unwrap().at(&Overrides::default()).unwrap();
    let mut cloth = OneRank::new(&scene);
    (0..75).for_each(|_| _ = cloth.step());
    let state = State { positions: cloth.positions(), ..State::start_of(&scene) };
    let found = BeyondLimits::of(&scene, &Obstacles::new(&scene.obstacles), &state, 0.3).expect("beyond 2 %");
    let [touched] = &found.at_obstacles[..] else { panic!("the ram alone: {found:?}") };
    assert!(touched.obstacle == "ram" && touched.triangles > 0, "{found:?}");
    assert!(found.place.ends_with("`ram`") || found.place.ends_with("a pin holds") || found.at_pins > 0, "{found:?}");
}
