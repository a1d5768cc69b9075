//! What the contact tests share: scenes with obstacles built in code, runs of which every step is kept, and a look at
//! every step that knows nothing of the collision code: `mesh::crossings`, which decides exactly.

use loomtree::gpu::Executor;
use loomtree::math::{DVec3, Vec2, Vec3};
use loomtree::mesh::{Group, GroupKind, Surface, TriangleMesh, crossings, shapes};
use loomtree::model::{GlobalModel, LetGo};
use loomtree::scene::{Keyframe, Motion, Movement, Obstacle, Obstacles, Pin, Scene};
use loomtree::solver::ExchangeMode;
use loomtree::step::StepStats;

use crate::physics::DOWN;
use crate::{isotropic_fabric, on_ranks, scene, sheet, whole_state};

/// A cloth of 150 g/m^2.
pub const DENSITY_KG_M2: f64 = 0.15;

/// A scene of `mesh` with contacts in it: 4 ms steps, cloth `thickness_m` thick.
pub fn contact_scene(mesh: TriangleMesh, thickness_m: f64, friction: f64, gravity: Vec3) -> Scene {
    let mut scene = scene(mesh, isotropic_fabric(200.0, 0.3, 1e-5, DENSITY_KG_M2, 0.001), &[], 0.004, gravity);
    scene.settings.collisions = true;
    scene.settings.thickness_m = thickness_m;
    scene.settings.friction = friction;
    scene
}

/// Meshes as one, numbered one after the other.
pub fn together(meshes: impl IntoIterator<Item = TriangleMesh>) -> TriangleMesh {
    let mut all = TriangleMesh::default();
    for mesh in meshes {
        let first = all.positions.len() as u32;
        all.positions.extend(mesh.positions);
        all.triangles.extend(mesh.triangles.iter().map(|t| t.map(|v| v + first)));
        all.material_uv.extend(mesh.material_uv);
    }
    all
}

/// A sheet rolled up around the y axis direction: its warp runs along a spiral that begins at `radius_m` and grows by
/// `pitch_m` a turn, in the plane of x and z.
pub fn rolled(mut mesh: TriangleMesh, radius_m: f32, pitch_m: f32, center: Vec3) -> TriangleMesh {
    let uv_of = uv_of_vertices(&mesh);
    for (x, uv) in mesh.positions.iter_mut().zip(uv_of) {
        // Length along a spiral r = a + b phi is about a phi + b phi^2 / 2.
        let b = pitch_m / std::f32::consts::TAU;
        let phi = ((radius_m * radius_m + 2.0 * b * uv.x).sqrt() - radius_m) / b;
        let r = radius_m + b * phi;
        *x = center + Vec3::new(r * phi.cos(), uv.y, r * phi.sin());
    }
    mesh
}

fn uv_of_vertices(mesh: &TriangleMesh) -> Vec<Vec2> {
    let mut uv = vec![Vec2::ZERO; mesh.positions.len()];
    for (corners, of_corners) in mesh.triangles.iter().zip(&mesh.material_uv) {
        corners.iter().zip(of_corners).for_each(|(&v, &at)| uv[v as usize] = at);
    }
    uv
}

/// A still obstacle.
pub fn obstacle(name: &str, surface: Surface, friction: f64) -> Obstacle {
    Obstacle {
        name: name.into(),
        friction,
        positions: surface.positions,
        triangles: surface.triangles,
        movement: Movement::Still,
    }
}

/// A level floor facing +z at height 0, `size_m` square.
pub fn floor(size_m: f64, cells: u32, friction: f64) -> Obstacle {
    let mut surface = shapes::rectangle([size_m; 2], [cells; 2]);
    // x z y -> x y z with the same handedness.
    surface.positions.iter_mut().for_each(|p| *p = Vec3::new(p.x, -p.z, p.y));
    obstacle("floor", surface, friction)
}

/// A ball about `center`.
pub fn ball(radius_m: f64, frequency: u32, center: Vec3, friction: f64) -> Obstacle {
    let mut surface = shapes::sphere(radius_m, frequency);
    surface.positions.iter_mut().for_each(|p| *p += center);
    obstacle("ball", surface, friction)
}

/// A level closed plate about `center` that moves by `by` between two times.
pub fn plate(name: &str, size_m: [f64; 3], center: Vec3, by: DVec3, from_s: f64, to_s: f64) -> Obstacle {
    let mut surface = shapes::cuboid(size_m, [4, 4, 1]);
    surface.positions.iter_mut().for_each(|p| *p = Vec3::new(p.x, p.y, p.z) + center);
    let keyframes = vec![Keyframe::identity(from_s), Keyframe { translation_m: by, ..Keyframe::identity(to_s) }];
    Obstacle { movement: Movement::Keyframes(Motion { keyframes }), ..obstacle(name, surface, 0.4) }
}

/// A body that is moved by `by` and back between three times.
pub fn there_and_back(body: Obstacle, name: &str, by: DVec3, times_s: [f64; 3]) -> Obstacle {
    let key = |time_s, translation_m| Keyframe { translation_m, ..Keyframe::identity(time_s) };
    let [start, turn, end] = times_s;
    let keyframes = vec![key(start, DVec3::ZERO), key(turn, by), key(end, DVec3::ZERO)];
    Obstacle { name: name.into(), movement: Movement::Keyframes(Motion { keyframes }), ..body }
}

/// A sheet hung at its upper edge, between two balls that move into each other by `depth_m` and apart again.
pub fn between_balls(depth_m: f64, times_s: [f64; 3]) -> Scene {
    let mesh = sheet(17, 17, [0.2; 2], Vec3::new(-0.1, 0.0, -0.1), Vec3::X, Vec3::Z);
    let mut scene = contact_scene(mesh, 1.5e-3, 0.3, DOWN);
    let held = |vertex| Pin::new(vertex, None, 0.0, f64::INFINITY);
    scene.pins = (16 * 17..17 * 17).map(held).collect();
    scene.obstacles = [("left", -1.0), ("right", 1.0)]
        .map(|(name, side)| {
            let body = ball(0.05, 6, Vec3::new(0.004, side * 0.06, -0.03), 0.3);
            there_and_back(body, name, DVec3::Y * -f64::from(side) * (0.01 + 0.5 * depth_m), times_s)
        })
        .to_vec();
    scene
}

/// Every state of a run, in the mesh's order; `steps[0]` is the one after step 1.
pub struct Watched {
    pub positions: Vec<Vec<Vec3>>,
    pub velocities: Vec<Vec<Vec3>>,
    /// Of rank 0.
    pub stats: Vec<StepStats>,
    pub masses: Vec<f64>,
    /// What each state has let go.
    pub let_go: Vec<Vec<LetGo>>,
}

impl Watched {
    /// Bits of the last state.
    pub fn bits(&self) -> Vec<[u32; 6]> {
        let (x, v) = (self.positions.last().unwrap(), self.velocities.last().unwrap());
        x.iter().zip(v).map(|(x, v)| [x.x, x.y, x.z, v.x, v.y, v.z].map(f32::to_bits)).collect()
    }

    /// Kinetic energy after every step, joules.
    pub fn kinetic_j(&self) -> Vec<f64> {
        let of = |v: &Vec<Vec3>| v.iter().zip(&self.masses).map(|(v, m)| 0.5 * m * v.as_dvec3().length_squared()).sum();
        self.velocities.iter().map(of).collect()
    }

    /// Sums over the steps: contacts, impacts, fail-safes, halvings, and the largest number of rounds.
    pub fn summary(&self) -> String {
        let sum = |of: fn(&StepStats) -> u64| self.stats.iter().map(of).sum::<u64>();
        format!(
            "{} contacts, {} impacts in zones, {} fail-safes, {} halvings, at most {} rounds, {} iterations a step",
            sum(|s| s.contacts),
            sum(|s| s.zones.impacts),
            sum(|s| s.zones.fail_safes),
            sum(|s| u64::from(s.zones.halvings)),
            self.stats.iter().map(|s| s.zones.rounds).max().unwrap_or(0),
            sum(|s| u64::from(s.iterations)) / self.stats.len() as u64,
        )
    }
}

/// Runs `steps` steps on `ranks` threads and keeps every state.
pub fn watch(scene: &Scene, ranks: usize, steps: u32, executor: fn(usize) -> Executor) -> Watched {
    let model = GlobalModel::new(scene);
    let results = on_ranks(&model, ranks, ExchangeMode::Halo, executor, move |simulation, transport| {
        let mut kept = Vec::new();
        for step in 1..=steps {
            let stats = simulation.step(transport, step, false).unwrap();
            kept.push((simulation.state(), stats));
        }
        kept
    });
    let original = |values: Vec<&[f32]>| {
        let mut out = vec![Vec3::ZERO; model.rows()];
        let rows = values.into_iter().flat_map(|part| part.chunks_exact(3));
        model.original_from_global.iter().zip(rows).for_each(|(&v, x)| out[v as usize] = Vec3::from_slice(x));
        out
    };
    let mut masses = vec![0.0; model.rows()];
    model.original_from_global.iter().zip(&model.masses).for_each(|(&v, &m)| masses[v as usize] = f64::from(m));
    let mut watched =
        Watched { positions: Vec::new(), velocities: Vec::new(), stats: Vec::new(), masses, let_go: Vec::new() };
    for step in 0..steps as usize {
        watched.positions.push(original(results.iter().map(|rank| &rank[step].0.positions[..]).collect()));
        watched.velocities.push(original(results.iter().map(|rank| &rank[step].0.velocities[..]).collect()));
        watched.stats.push(results[0][step].1);
        let whole = whole_state(&model, results.iter().map(|rank| &rank[step].0));
        watched.let_go.push(whole.let_go);
    }
    watched
}

/// Fails if triangles of the cloth cross or touch each other or an obstacle after any step.
pub fn assert_free(scene: &Scene, watched: &Watched) {
    let obstacles = Obstacles::new(&scene.obstacles);
    let cloth = scene.mesh.positions.len() as u32;
    let mut triangles = scene.mesh.triangles.clone();
    triangles.extend(obstacles.triangles().iter().map(|t| t.map(|v| v + cloth)));
    let first = scene.mesh.triangles.len();
    let groups = [(0..first, GroupKind::Cloth), (first..triangles.len(), GroupKind::Obstacle)]
        .map(|(triangles, kind)| Group { triangles, kind });
    let groups = &groups[..if obstacles.is_empty() { 1 } else { 2 }];
    let mut at = Vec::new();
    let before = std::iter::once(&scene.mesh.positions);
    for (step, positions) in before.chain(&watched.positions).enumerate() {
        obstacles.positions_at(step as f64 * scene.settings.step_s, &mut at);
        let mut all = positions.clone();
        all.extend(at.chunks_exact(3).map(Vec3::from_slice));
        let found = crossings(&all, &triangles, groups);
        assert!(found.is_empty(), "step {step}: {} pairs cross, {:?}", found.len(), &found[..found.len().min(5)]);
    }
}
