//! Values that differ from vertex to vertex, with known answers: weight and stiffness of a hanging strip, the distance
//! of contacts; the same bits on any number of ranks.

use loomtree::math::Vec3;
use loomtree::mesh::shapes;
use loomtree::scene::{Maps, Scene};
use loomtree::solver::ExchangeMode;
use support::contact::{contact_scene, obstacle};
use support::physics::{ACROSS, DOWN, GRAVITY_M_S2, OneRank, TO_REST, strip, uniform_fabric};
use support::{cpu, scene, sheet, simulate};

const EH_N_M: f64 = 1000.0;
const CELLS: usize = 20;
const CELL_M: f64 = 0.05;
const DENSITY_KG_M2: f64 = 0.2;

/// Heights of a strip hung by its upper end, one per row of vertices, with the factors of the rows.
fn hung(density: impl Fn(usize) -> f32, stiffness: impl Fn(usize) -> f32) -> Vec<f64> {
    let mesh = strip(CELLS, CELL_M as f32, Vec3::NEG_Z);
    let fabric = uniform_fabric([EH_N_M, 0.0, EH_N_M, 2.0 * EH_N_M], 0.0, DENSITY_KG_M2);
    let mut scene = scene(mesh, fabric, &[0, 1, 2], 0.02, DOWN);
    scene.settings.relative_tolerance = TO_REST;
    let rows = (0..scene.mesh.positions.len()).map(|v| v / ACROSS);
    scene.maps.density = rows.clone().map(density).collect();
    scene.maps.stiffness = rows.map(stiffness).collect();
    let mut cloth = OneRank::new(&scene);
    cloth.settle(1e-5, 400);
    (0..=CELLS).map(|row| -f64::from(cloth.positions()[ACROSS * row + 1].z)).collect()
}

/// Length of the strip down to every row: each cell carries the mass of the rows below it, and its triangles have the
/// mean factor of their corners.
fn expected(density: impl Fn(usize) -> f32, stiffness: impl Fn(usize) -> f32) -> Vec<f64> {
    let row_kg = |row: usize| {
        let cells = if row == 0 || row == CELLS { 0.5 } else { 1.0 };
        DENSITY_KG_M2 * 2.0 * CELL_M * CELL_M * cells * f64::from(density(row))
    };
    let mut places = vec![0.0];
    for cell in 0..CELLS {
        let force_n = (cell + 1..=CELLS).map(row_kg).sum::<f64>() * f64::from(GRAVITY_M_S2);
        let (upper, lower) = (f64::from(stiffness(cell)), f64::from(stiffness(cell + 1)));
        let strain = force_n / (2.0 * CELL_M) / (EH_N_M * 0.5 * (upper + lower));
        places.push(places[cell] + CELL_M * (1.0 + strain));
    }
    places
}

fn assert_hangs(density: impl Fn(usize) -> f32 + Copy, stiffness: impl Fn(usize) -> f32 + Copy) {
    // Strains of up to 1 % make a Green-strain material stiffer by as much.
    const RELATIVE: f64 = 2e-2;
    let (found, wanted) = (hung(density, stiffness), expected(density, stiffness));
    for row in [CELLS / 2, CELLS] {
        let at_rest = row as f64 * CELL_M;
        let (found, wanted) = (found[row] - at_rest, wanted[row] - at_rest);
        assert!((found / wanted - 1.0).abs() < RELATIVE, "row {row}: {found} m instead of {wanted} m");
    }
}

#[test]
fn a_heavier_lower_half_stretches_the_upper_one_by_its_weight() {
    assert_hangs(|row| if row > CELLS / 2 { 4.0 } else { 1.0 }, |_| 1.0);
}

#[test]
fn a_stiffer_half_stretches_less() {
    assert_hangs(|_| 1.0, |row| if row < CELLS / 2 { 5.0 } else { 0.5 });
}

/// A sheet on a floor, thinner where x is above its middle.
fn on_floor(factor: f32) -> Scene {
    let mesh = sheet(9, 9, [0.2; 2], Vec3::new(0.0, 0.0, 2.2e-3), Vec3::X, Vec3::Y);
    let mut scene = contact_scene(mesh, 2e-3, 0.3, DOWN);
    scene.fabrics[0] = uniform_fabric([20.0, 0.0, 20.0, 10.0], 0.0, 0.2);
    let mut floor = shapes::rectangle([1.0, 1.0], [4, 4]);
    floor.positions.iter_mut().for_each(|p| *p = Vec3::new(p.x, p.z, 0.0));
    floor.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    scene.obstacles = vec![obstacle("floor", floor, 0.3)];
    scene.maps.thickness = scene.mesh.positions.iter().map(|p| if p.x > 0.1 { factor } else { 1.0 }).collect();
    scene
}

#[test]
fn contacts_act_within_the_thickness_of_the_place() {
    let scene = on_floor(0.5);
    let mut cloth = OneRank::new(&scene);
    for _ in 0..150 {
        cloth.step();
    }
    // Away from the middle, where the sheet bends down.
    let heights = |range: std::ops::Range<f32>| {
        let inside = move |p: &&Vec3| range.contains(&p.x);
        let found: Vec<f32> = cloth.positions().iter().filter(inside).map(|p| p.z).collect();
        (found.iter().copied().fold(f32::INFINITY, f32::min), found.into_iter().fold(0.0, f32::max))
    };
    let ((thick_low, thick_high), (thin_low, thin_high)) = (heights(-0.1..0.06), heights(0.14..0.3));
    assert!(1.5e-3 < thick_low && thick_high < 2e-3, "{thick_low} to {thick_high} m");
    assert!(0.5e-3 < thin_low && thin_high < 1e-3, "{thin_low} to {thin_high} m");
}

#[test]
fn maps_give_the_same_bits_on_any_number_of_ranks() {
    let mut scene = on_floor(0.4);
    let of = |low: f32, high: f32| {
        let along = |p: &Vec3| low + (high - low) * ((p.x + 2.0 * p.y) / 0.6);
        scene.mesh.positions.iter().map(along).collect::<Vec<f32>>()
    };
    scene.maps = Maps { density: of(0.5, 3.0), stiffness: of(2.0, 0.5), friction: of(0.0, 2.0), ..scene.maps.clone() };
    scene.velocities.iter_mut().for_each(|v| *v = Vec3::new(0.3, 0.1, -0.5));
    let one = simulate(&scene, 1, ExchangeMode::Halo, 20, cpu);
    for ranks in [2, 3, 5] {
        let many = simulate(&scene, ranks, ExchangeMode::Halo, 20, cpu);
        assert!(many.positions == one.positions && many.velocities == one.velocities, "{ranks} ranks");
    }
    let plain = simulate(&Scene { maps: Maps::default(), ..scene.clone() }, 1, ExchangeMode::Halo, 20, cpu);
    assert!(plain.positions != one.positions);
}
