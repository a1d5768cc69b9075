//! Products without a stored matrix: equal to the stored ones up to rounding, with contacts and without; the same bits on any
//! number of ranks; the same steps.

use loomtree::math::Vec3;
use loomtree::model::GlobalModel;
use loomtree::scene::Scene;
use loomtree::solver::ExchangeMode;
use support::contact::{contact_scene, floor, together};
use support::{cpu, on_ranks, sheet};

/// Two sheets of different meshes half a thickness apart, the lower one as far above a floor: contacts of all kinds.
fn stack() -> Scene {
    const THICKNESS_M: f64 = 4e-3;
    let layer = |cells: usize, height: f64, turn: f32| {
        let (u, v) = (Vec3::new(turn.cos(), turn.sin(), 0.0), Vec3::new(-turn.sin(), turn.cos(), 0.0));
        let origin = (u + v) * -0.05 + Vec3::new(0.0, 0.0, (height * THICKNESS_M) as f32);
        sheet(cells, cells, [0.1, 0.1], origin, u, v)
    };
    let mesh = together([layer(17, 0.5, 0.0), layer(14, 1.0, 0.3)]);
    let mut scene = contact_scene(mesh, THICKNESS_M, 0.3, Vec3::new(0.0, 0.0, -9.8));
    scene.obstacles.push(floor(0.4, 3, 0.5));
    scene.settings.air_drag_kg_m2_s = 0.1;
    scene.settings.air_density_kg_m3 = 1.2;
    scene.settings.wind_m_s = Vec3::new(1.0, 0.2, 0.5);
    // Lowers the sheets unevenly, so that air, damping and friction have something to act on.
    for (v, x) in scene.velocities.iter_mut().zip(&scene.mesh.positions) {
        *v = Vec3::new(0.2 * (x.x * 40.0).sin(), 0.1 * (x.y * 20.0).sin(), 0.05 * (x.y * 30.0).cos());
    }
    scene
}

/// Contacts, and products of three vectors, on `ranks` ranks.
fn products(scene: &Scene, ranks: usize, matrix_free: bool) -> (u64, Vec<Vec<f32>>) {
    let model = GlobalModel::new(scene);
    let results = on_ranks(&model, ranks, ExchangeMode::Halo, cpu, move |simulation, transport| {
        let rows = simulation.state().positions.len();
        if matrix_free {
            simulation.drop_matrix().unwrap();
        }
        let contacts = simulation.assemble(transport, 1).unwrap();
        let first = simulation.rows().start * 3;
        let products: Vec<Vec<f32>> = (0..3)
            .map(|k| {
                let x: Vec<f32> = (first..first + rows).map(|i| ((i * (k + 3)) as f32 * 0.731).sin()).collect();
                simulation.product(transport, &x).unwrap()
            })
            .collect();
        (contacts, products)
    });
    let contacts = results[0].0;
    let whole = |k: usize| results.iter().flat_map(|(_, products)| products[k].iter().copied()).collect();
    (contacts, (0..3).map(whole).collect())
}

#[test]
fn products_equal_the_stored_ones_up_to_rounding() {
    for collisions in [true, false] {
        let mut scene = stack();
        scene.settings.collisions = collisions;
        let (contacts, stored) = products(&scene, 1, false);
        let (_, free) = products(&scene, 1, true);
        assert_eq!(contacts > 300, collisions, "{contacts} contacts");
        for (stored, free) in stored.iter().zip(&free) {
            let largest = stored.iter().fold(0.0f32, |most, y| most.max(y.abs()));
            let furthest = stored.iter().zip(free).fold(0.0f32, |most, (a, b)| most.max((a - b).abs()));
            println!("{contacts} contacts: largest {largest:.3e}, furthest apart {furthest:.3e}");
            assert!(largest > 0.0 && furthest <= 2e-6 * largest, "{furthest} of {largest}");
        }
    }
}

#[test]
fn ranks_change_no_bit() {
    let scene = stack();
    let bits = |ranks: usize| -> Vec<Vec<u32>> {
        products(&scene, ranks, true).1.iter().map(|y| y.iter().map(|v| v.to_bits()).collect()).collect()
    };
    let one = bits(1);
    for ranks in [2, 5] {
        assert!(bits(ranks) == one, "{ranks} ranks");
    }
}

#[test]
fn steps_end_where_those_of_the_stored_matrix_end() {
    let mut scene = stack();
    scene.settings.relative_tolerance = 1e-4;
    let model = GlobalModel::new(&scene);
    let run = |matrix_free: bool| {
        let mut results = on_ranks(&model, 1, ExchangeMode::Halo, cpu, move |simulation, transport| {
            let stored = simulation.memory_bytes();
            if matrix_free {
                simulation.drop_matrix().unwrap();
                assert!(simulation.memory_bytes() < stored);
            }
            for step in 1..=3 {
                assert!(simulation.step(transport, step, false).unwrap().converged);
            }
            simulation.state().positions
        });
        results.remove(0)
    };
    let (stored, free) = (run(false), run(true));
    let furthest = stored.iter().zip(&free).fold(0.0f32, |most, (a, b)| most.max((a - b).abs()));
    let moved = stored.iter().zip(&model.positions).fold(0.0f32, |most, (a, b)| most.max((a - b).abs()));
    println!("moved {moved:.3e} m, apart {furthest:.3e} m");
    assert!(moved > 1e-4 && furthest < 1e-3 * moved, "{furthest} m apart after {moved} m");
}

#[test]
fn whole_sub_vectors_need_a_matrix() {
    let refused = on_ranks(&GlobalModel::new(&stack()), 1, ExchangeMode::Full, cpu, |simulation, _| {
        simulation.drop_matrix().map_err(|error| error.to_string())
    });
    assert!(refused[0].as_ref().is_err_and(|error| error.contains("--exchange halo")));
}
