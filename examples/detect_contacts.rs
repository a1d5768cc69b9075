//! Detects the contacts between a level triangle and a corner that hangs 0.5 mm above it.
//!
//! `cargo run --release --example detect_contacts`

use std::error::Error;

use loomtree::{CollisionMesh, ContactParams, CpuExecutor, Detector, Split};

fn main() -> Result<(), Box<dyn Error>> {
    let floor = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]];
    let above = [[0.02, 0.02, 0.0005], [0.03, 0.02, 0.1], [0.02, 0.03, 0.1]];
    let x: Vec<f32> = [floor, above].as_flattened().as_flattened().to_vec();
    let mesh = CollisionMesh::new(6, 6, vec![[0, 1, 2], [3, 4, 5]])?;
    let params = ContactParams {
        thickness_m: 0.001,
        separation_m: 0.0,
        stiffness_ratio: 8.0,
        step_s: 0.004,
        friction: vec![0.3; 6],
        inverse_masses_per_kg: vec![1e3; 6],
        smallest_altitudes_m: vec![0.05; 6],
        friction_factors: Vec::new(),
        thickness_factors: Vec::new(),
    };
    let mut contacts = Vec::new();
    Detector::new(mesh, params)?.contacts(&CpuExecutor::new(1), &x, &mut Split::alone(0, 1), &mut contacts)?;
    for contact in &contacts {
        println!("vertices {:?}: {:.2} mm along {:?}", contact.vertices, contact.distance_m * 1e3, contact.normal);
    }
    if contacts.len() == 1 { Ok(()) } else { Err("one corner is near the floor".into()) }
}
