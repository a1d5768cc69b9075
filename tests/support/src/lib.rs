//! What several test binaries share: small scenes built in code, and ranks run as threads.

pub mod collision;
pub mod contact;
pub mod device;
pub mod exact;
pub mod numpy;
pub mod physics;
pub mod process;
pub mod seeded;
pub mod zones;

use loomtree::gpu::Executor;
use loomtree::interconnect::QueueNode;
use loomtree::math::{DVec3, Vec2, Vec3};
use loomtree::mesh::TriangleMesh;
use loomtree::model::{GlobalModel, RankModel, RankState, State};
use loomtree::partition::RowPartition;
use loomtree::scene::{Closing, Fabric, Maps, Pin, Scene, Settings, Sewing, Substeps};
use loomtree::solver::ExchangeMode;
use loomtree::step::{ExchangePlan, Simulation, StepStats};
use loomtree::telemetry::{Activity, Event, EventName};
use loomtree::transport::InProcessTransport;

/// An event of step 1, done when it was asked for; `route` = (stage, source, vector).
pub fn event(name: EventName, activity: Activity, span_ns: (u64, u64), route: (u32, u32, u32)) -> Event {
    let ((stage, source, vector), (start_ns, end_ns)) = (route, span_ns);
    let (name, activity, step) = (name as u32, activity as u32, 1);
    Event { name, activity, step, stage, source, vector, asked_ns: start_ns, start_ns, end_ns, bytes: 0, flops: 0 }
}

/// An isotropic fabric: Young's modulus times thickness (N/m), Poisson's ratio, bending sample (N m).
pub fn isotropic_fabric(eh: f64, nu: f64, bending: f64, density: f64, damping_s: f64) -> Fabric {
    let c = eh / (1.0 - nu * nu);
    let row = [c, nu * c, c, 2.0 * eh / (1.0 + nu)];
    Fabric {
        name: "isotropic".into(),
        density_kg_m2: density,
        stretching_n_m: [row; 6],
        bending_n_m: [[bending; 5]; 3],
        damping_s,
        plasticity: None,
        strain_limit: None,
    }
}

/// A sheet of `nx` x `ny` vertices in the plane spanned by `u` and `v` from `origin`, one diagonal per cell.
pub fn sheet(nx: usize, ny: usize, size_m: [f32; 2], origin: Vec3, u: Vec3, v: Vec3) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    let uv =
        |i: usize, j: usize| Vec2::new(size_m[0] * i as f32 / (nx - 1) as f32, size_m[1] * j as f32 / (ny - 1) as f32);
    for j in 0..ny {
        for i in 0..nx {
            let p = uv(i, j);
            mesh.positions.push(origin + u * p.x + v * p.y);
        }
    }
    let at = |i: usize, j: usize| (j * nx + i) as u32;
    for j in 0..ny - 1 {
        for i in 0..nx - 1 {
            mesh.triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
            mesh.material_uv.push([uv(i, j), uv(i + 1, j), uv(i + 1, j + 1)]);
            mesh.triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            mesh.material_uv.push([uv(i, j), uv(i + 1, j + 1), uv(i, j + 1)]);
        }
    }
    mesh
}

/// A scene of one mesh and fabric; vertices in `pinned` stay where they are.
pub fn scene(mesh: TriangleMesh, fabric: Fabric, pinned: &[u32], step_s: f64, gravity: Vec3) -> Scene {
    Scene {
        name: "test".into(),
        origin_m: DVec3::ZERO,
        velocities: vec![Vec3::ZERO; mesh.positions.len()],
        fabric_of_triangle: vec![0; mesh.triangles.len()],
        mesh,
        fabrics: vec![fabric],
        pins: pinned.iter().map(|&vertex| Pin::new(vertex, None, 0.0, f64::INFINITY)).collect(),
        motions: Vec::new(),
        followed: Vec::new(),
        cloths: Vec::new(),
        obstacles: Vec::new(),
        settings: Settings {
            step_s,
            substeps: Substeps::Fixed(1),
            steps_per_frame: 1,
            frames: 1,
            gravity_m_s2: gravity,
            wind_m_s: Vec3::ZERO,
            air_density_kg_m3: 0.0,
            air_drag_kg_m2_s: 0.0,
            relative_tolerance: 0.01,
            max_iterations: 500,
            preconditioner: Default::default(),
            thickness_m: 1e-3,
            friction: 0.0,
            collisions: false,
            contact_stiffness: 8.0,
            over_time: Default::default(),
        },
        maps: Maps::default(),
        parts: Vec::new(),
        folds: Vec::new(),
        sewing: None,
        warnings: Vec::new(),
        left_out: Vec::new(),
    }
}

/// State in original vertex order, and what the steps reported on rank 0.
pub struct Outcome {
    pub positions: Vec<Vec3>,
    pub velocities: Vec<Vec3>,
    pub stats: Vec<StepStats>,
}

/// Every rank receives from the others in ascending distance.
pub fn direct_queue(rank: usize, ranks: usize) -> Vec<QueueNode> {
    (1..ranks).map(|d| (rank + d) % ranks).map(|v| QueueNode { source: v, vector: v }).collect()
}

/// Runs `program` on `ranks` threads, each with its part of `model`, its executor and its transport; results by rank.
pub fn on_ranks<T: Send + 'static>(
    model: &GlobalModel,
    ranks: usize,
    mode: ExchangeMode,
    executor: fn(usize) -> Executor,
    program: impl Fn(&mut Simulation, &mut InProcessTransport) -> T + Clone + Send + 'static,
) -> Vec<T> {
    let partition = RowPartition::new(model.rows(), ranks);
    let mut parts = Vec::new();
    RankModel::split(model, &partition, |_, part| {
        parts.push(part);
        Ok::<(), ()>(())
    })
    .unwrap();
    let handles: Vec<_> = parts
        .into_iter()
        .zip(InProcessTransport::group(ranks))
        .enumerate()
        .map(|(rank, (part, mut transport))| {
            let program = program.clone();
            std::thread::spawn(move || {
                let plan = ExchangePlan { mode, queue: direct_queue(rank, ranks) };
                let mut simulation = Simulation::new(executor(rank), part, &plan).unwrap();
                program(&mut simulation, &mut transport)
            })
        })
        .collect();
    handles.into_iter().map(|handle| handle.join().unwrap()).collect()
}

/// Runs `steps` steps on `ranks` threads.
pub fn simulate(
    scene: &Scene,
    ranks: usize,
    mode: ExchangeMode,
    steps: u32,
    executor: fn(usize) -> Executor,
) -> Outcome {
    let model = GlobalModel::new(scene);
    let results = on_ranks(&model, ranks, mode, executor, move |simulation, transport| {
        let stats: Vec<StepStats> = (1..=steps).map(|step| simulation.step(transport, step, false).unwrap()).collect();
        (simulation.state(), stats)
    });
    let State { positions, velocities, .. } = whole_state(&model, results.iter().map(|(state, _)| state));
    Outcome { positions, velocities, stats: results[0].1.clone() }
}

/// The state of the whole cloth, from the parts of all ranks in rank order.
pub fn whole_state<'a>(model: &GlobalModel, parts: impl ExactSizeIterator<Item = &'a RankState>) -> State {
    let partition = RowPartition::new(model.rows(), parts.len());
    let plastic = RankModel::plastic_elements(model, &partition);
    let mut state = State::zeros(model.rows(), model.plastic_elements().counts());
    parts.enumerate().for_each(|(rank, part)| {
        state.scatter(&model.original_from_global[partition.rows_of(rank)], &plastic[rank], part);
    });
    state
}

/// The native executor with one thread.
pub fn cpu(_rank: usize) -> Executor {
    Executor::cpu(1)
}

/// Two square sheets of `n` x `n` vertices with a gap of 5 cm, drawn together along their facing edges. Nothing holds
/// them.
pub fn sewn_sheets(n: usize, closing: Closing) -> Scene {
    let fabric = isotropic_fabric(200.0, 0.3, 2e-5, 0.15, 0.001);
    let mut mesh = sheet(n, n, [0.2, 0.2], Vec3::ZERO, Vec3::X, Vec3::Y);
    let other = sheet(n, n, [0.2, 0.2], Vec3::new(0.25, 0.01, 0.02), Vec3::X, Vec3::Y);
    let first = mesh.positions.len() as u32;
    mesh.positions.extend(other.positions);
    mesh.triangles.extend(other.triangles.iter().map(|t| t.map(|v| v + first)));
    mesh.material_uv.extend(other.material_uv);
    let mut scene = scene(mesh, fabric, &[], 0.004, Vec3::ZERO);
    let row = |j: usize| (j * n) as u32;
    scene.sewing = Some(Sewing {
        pairs: (0..n).map(|j| [row(j) + n as u32 - 1, first + row(j)]).collect(),
        names: vec!["middle".into()],
        angles: vec![0.0],
        seam_of_pair: vec![0; n],
        closing,
        first_m: None,
        weld_m: 0.001,
        refine: 1,
        gravity_m_s2: Vec3::ZERO,
    });
    scene
}
