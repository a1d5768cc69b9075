//! What the physics tests share: one rank stepped by hand with its state after every step, energies and momenta in f64,
//! strips. Makes no claim about several ranks; `super::simulate` runs those.

use loomtree::forces::{bend_energy, dihedral_angle, stretch_energy, stretch_stiffness};
use loomtree::math::{DVec3, Vec2, Vec3};
use loomtree::mesh::TriangleMesh;
use loomtree::model::{GlobalModel, RankModel, RestStretch};
use loomtree::partition::RowPartition;
use loomtree::scene::{Fabric, Scene};
use loomtree::solver::ExchangeMode;
use loomtree::step::{ExchangePlan, Simulation, StepStats};
use loomtree::transport::InProcessTransport;

use super::cpu;

/// Acceleration of gravity, m/s^2.
pub const GRAVITY_M_S2: f32 = 9.81;

/// Gravity along -z.
pub const DOWN: Vec3 = Vec3::new(0.0, 0.0, -GRAVITY_M_S2);

/// Relative residual for tests with known answers: about where the recursive residual of an f32 solve stops meaning
/// something, so that what is left of an error is the model's or the arithmetic's.
pub const TIGHT: f64 = 1e-6;

/// Relative residual for the way to a state at rest: there the right-hand side vanishes, so the state does not depend on it.
pub const TO_REST: f64 = 1e-3;

/// A fabric of one stiffness row (warp, cross, weft, shear; N/m) and one bending sample (N m).
pub fn uniform_fabric(stretching_n_m: [f64; 4], bending_n_m: f64, density_kg_m2: f64) -> Fabric {
    Fabric::uniform("test", density_kg_m2, stretching_n_m, bending_n_m)
}

/// Vertices of a strip per step of its length.
pub const ACROSS: usize = 3;

/// A strip from the origin along `along` (warp), two square cells wide across +-y, `cells` long; vertices in threes from the
/// start to the end, the middle one on the axis. The diagonals mirror each other about the axis: if all ran the same way
/// (or in a strip of one cell), bending would twist the strip, and with the twist t free it would bend 1 / 0.8 times as
/// easily (energy (kx + t)^2 + 4 t^2 instead of kx^2).
pub fn strip(cells: usize, cell_m: f32, along: Vec3) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    let across = ACROSS as u32;
    let uv = |v: u32| Vec2::new((v / across) as f32, (v % across) as f32) * cell_m;
    for v in 0..across * (cells as u32 + 1) {
        mesh.positions.push(along * uv(v).x + Vec3::Y * (uv(v).y - cell_m));
    }
    for a in (0..cells as u32).map(|cell| across * cell) {
        let [a, b, c, d, e, f] = [0, 1, 2, 3, 4, 5].map(|i| a + i);
        mesh.triangles.extend([[a, d, e], [a, e, b], [b, e, c], [e, f, c]]);
    }
    mesh.material_uv = mesh.triangles.iter().map(|t| t.map(uv)).collect();
    mesh
}

/// One rank, its transport and the cloth in global order.
pub struct OneRank {
    pub model: GlobalModel,
    pub steps: u32,
    simulation: Simulation,
    transport: InProcessTransport,
}

impl OneRank {
    pub fn new(scene: &Scene) -> OneRank {
        let model = GlobalModel::new(scene);
        let mut parts = Vec::new();
        RankModel::split(&model, &RowPartition::new(model.rows(), 1), |_, part| {
            parts.push(part);
            Ok::<(), ()>(())
        })
        .unwrap();
        let plan = ExchangePlan { mode: ExchangeMode::Halo, queue: Vec::new() };
        let simulation = Simulation::new(cpu(0), parts.remove(0), &plan).unwrap();
        OneRank { model, steps: 0, simulation, transport: InProcessTransport::group(1).remove(0) }
    }

    /// One step; fails the test if the solve does not converge.
    pub fn step(&mut self) -> StepStats {
        self.steps += 1;
        let stats = self.simulation.step(&mut self.transport, self.steps, false).unwrap();
        assert!(
            stats.converged,
            "step {}: residual {} after {} iterations",
            self.steps, stats.residual, stats.iterations
        );
        stats
    }

    /// Steps until no vertex is faster than `rest_m_s`; fails the test if `most_steps` are not enough.
    pub fn settle(&mut self, rest_m_s: f32, most_steps: u32) {
        for _ in 0..most_steps {
            self.step();
            if self.fastest_m_s() < rest_m_s {
                return;
            }
        }
        panic!("not at rest after {most_steps} steps: {} m/s", self.fastest_m_s());
    }

    pub fn fastest_m_s(&self) -> f32 {
        self.velocities().iter().map(|v| v.length()).fold(0.0, f32::max)
    }

    /// Positions in the mesh's order, metres.
    pub fn positions(&self) -> Vec<Vec3> {
        self.original(&self.simulation.state().positions)
    }

    /// Velocities in the mesh's order, m/s.
    pub fn velocities(&self) -> Vec<Vec3> {
        self.original(&self.simulation.state().velocities)
    }

    /// Masses in the mesh's order, kg.
    pub fn masses(&self) -> Vec<f64> {
        let mut masses = vec![0.0; self.model.rows()];
        for (&original, &m) in self.model.original_from_global.iter().zip(&self.model.masses) {
            masses[original as usize] = f64::from(m);
        }
        masses
    }

    /// Angle at rest, radians, and plastic curvature, 1/m, of the hinge whose edge has these ends.
    pub fn crease(&self, edge: [u32; 2]) -> [f32; 2] {
        let row = |vertex: u32| self.model.original_from_global.iter().position(|&v| v == vertex).unwrap() as u32;
        let mut wanted = edge.map(row);
        wanted.sort_unstable();
        let hinge = self.model.hinges.iter().position(|hinge| {
            let mut ends = [hinge.vertices[0], hinge.vertices[1]];
            ends.sort_unstable();
            ends == wanted
        });
        self.simulation.state().creases[hinge.expect("an inner edge")]
    }

    /// Rest stretches of all triangles, in the order of the model.
    pub fn rest_stretches(&self) -> Vec<RestStretch> {
        self.simulation.state().stretches
    }

    fn original(&self, xyz: &[f32]) -> Vec<Vec3> {
        let mut out = vec![Vec3::ZERO; self.model.rows()];
        for (&original, p) in self.model.original_from_global.iter().zip(xyz.chunks_exact(3)) {
            out[original as usize] = Vec3::from_slice(p);
        }
        out
    }

    pub fn kinetic_energy_j(&self) -> f64 {
        self.masses().iter().zip(self.velocities()).map(|(m, v)| 0.5 * m * v.as_dvec3().length_squared()).sum()
    }

    /// Stretching energy; the fabric must be the same at every strain.
    pub fn stretch_energy_j(&self) -> f64 {
        let x = self.simulation.state().positions;
        let stiffness = |fabric: u32| stretch_stiffness(&self.model.fabrics[fabric as usize], [0.0; 3]);
        let at = |v: u32| Vec3::from_slice(&x[v as usize * 3..][..3]);
        self.model.triangles.iter().map(|e| stretch_energy(e, stiffness(e.fabric), e.vertices.map(at))).sum()
    }

    /// Bending energy; the fabric must be the same at every curvature.
    pub fn bend_energy_j(&self) -> f64 {
        let x = self.simulation.state().positions;
        let angle = |v: [u32; 4]| dihedral_angle(v.map(|v| Vec3::from_slice(&x[v as usize * 3..][..3]))).0;
        self.model.hinges.iter().map(|e| bend_energy(&self.model.fabrics, e, 0.0, angle(e.vertices))).sum()
    }

    /// Kinetic, stretching and bending energy.
    pub fn energy_j(&self) -> f64 {
        self.kinetic_energy_j() + self.stretch_energy_j() + self.bend_energy_j()
    }

    /// Sum of m v, kg m/s.
    pub fn momentum(&self) -> DVec3 {
        self.masses().iter().zip(self.velocities()).map(|(&m, v)| v.as_dvec3() * m).sum()
    }

    /// Sum of x x m v about the origin, kg m^2/s.
    pub fn angular_momentum(&self) -> DVec3 {
        let (x, v) = (self.positions(), self.velocities());
        self.masses().iter().zip(x.iter().zip(v)).map(|(&m, (x, v))| x.as_dvec3().cross(v.as_dvec3()) * m).sum()
    }
}
