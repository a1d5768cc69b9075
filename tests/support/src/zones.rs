//! A small world of cloth and obstacles with one step, and the loop around impact zones as a step runs it: brute-force
//! candidates, zones shared out over pretended ranks.

use loomtree::collision::broad::{CollisionMesh, Query, brute_force};
use loomtree::collision::elementary::{CandidateKind, ccd, edge_crosses_triangle};
use loomtree::collision::{Candidate, Impact};
use loomtree::gpu::{CpuExecutor, Executor};
use loomtree::impact_zone::{
    FailSafes, ImpactZones, Impossible, Moved, StepPositions, ZoneCounts, ZoneSettings, apply,
};
use loomtree::math::{DVec3, Vec3};

/// Rounds after which a loop counts as endless.
pub const ROUNDS_MAX: u32 = 200;

#[derive(Clone, Default)]
pub struct World {
    pub x_t0: Vec<f32>,
    pub x_t1: Vec<f32>,
    pub inverse_masses: Vec<f32>,
    pub triangles: Vec<[u32; 3]>,
    /// Vertices before the first obstacle.
    pub cloth: Option<usize>,
}

pub struct Outcome {
    pub x_t1: Vec<f32>,
    pub counts: ZoneCounts,
    pub fail_safes: FailSafes,
    pub iterations: u64,
    pub solve_s: f64,
}

impl World {
    pub fn vertices(&self) -> usize {
        self.inverse_masses.len()
    }

    /// A vertex; infinite mass for inverse mass 0. Returns its number.
    pub fn vertex(&mut self, x_t0: Vec3, x_t1: Vec3, inverse_mass: f32) -> u32 {
        self.x_t0.extend(x_t0.to_array());
        self.x_t1.extend(x_t1.to_array());
        self.inverse_masses.push(inverse_mass);
        self.vertices() as u32 - 1
    }

    pub fn triangle(&mut self, x_t0: [Vec3; 3], x_t1: [Vec3; 3], inverse_mass: f32) -> [u32; 3] {
        let made = std::array::from_fn(|i| self.vertex(x_t0[i], x_t1[i], inverse_mass));
        self.triangles.push(made);
        made
    }

    /// A grid of n x n vertices at `place(u, v)`, u and v in 0..=1, that moves by `motion`.
    pub fn sheet(
        &mut self,
        n: u32,
        inverse_mass: f32,
        place: impl Fn(f32, f32) -> Vec3,
        mut motion: impl FnMut(Vec3) -> Vec3,
    ) -> u32 {
        let first = self.vertices() as u32;
        for i in 0..n * n {
            let x = place((i % n) as f32 / (n - 1) as f32, (i / n) as f32 / (n - 1) as f32);
            self.vertex(x, motion(x), inverse_mass);
        }
        for (i, j) in (0..n - 1).flat_map(|j| (0..n - 1).map(move |i| (i, j))) {
            let a = first + j * n + i;
            self.triangles.extend([[a, a + 1, a + n + 1], [a, a + n + 1, a + n]]);
        }
        first
    }

    /// What was made so far is cloth; what follows is obstacle.
    pub fn obstacles_from_here(&mut self) {
        self.cloth = Some(self.vertices());
    }

    pub fn mesh(&self) -> CollisionMesh {
        let cloth = self.cloth.unwrap_or(self.vertices());
        CollisionMesh::new(self.vertices(), cloth, self.triangles.clone()).unwrap()
    }

    /// All impacts of the motion to `x_t1`.
    pub fn impacts(&self, mesh: &CollisionMesh, x_t1: &[f32]) -> Vec<Impact> {
        let candidates = brute_force(mesh, &Query { x_t0: &self.x_t0, x_t1, radius_m: 0.0 }).unwrap();
        let hit = |candidate: Candidate| {
            let kind = if candidate.is_vertex_face() { CandidateKind::VertexFace } else { CandidateKind::EdgeEdge };
            let gather = |x: &[f32]| candidate.vertices.map(|v| Vec3::from_slice(&x[3 * v as usize..]));
            Some(Impact { candidate, toi: ccd(kind, gather(&self.x_t0), gather(x_t1), 0.0).toi? })
        };
        candidates.into_iter().filter_map(hit).collect()
    }

    /// The loop of a step. The zones of each of `ranks` ranks are solved in a call of their own.
    pub fn resolve(&self, executor: &Executor, settings: ZoneSettings, ranks: usize) -> Result<Outcome, Impossible> {
        let mesh = self.mesh();
        let alone = CpuExecutor::new(1);
        let host = if let Executor::Cpu(cpu) = executor { cpu } else { &alone };
        let mut zones = ImpactZones::new(settings);
        let (mut x_t1, mut iterations, mut solve_s) = (self.x_t1.clone(), 0, 0.0);
        for _ in 0..ROUNDS_MAX {
            let impacts = self.impacts(&mesh, &x_t1);
            if impacts.is_empty() {
                assert_eq!(executor.take_fault(), None);
                return Ok(Outcome {
                    x_t1,
                    counts: zones.counts(),
                    fail_safes: zones.fail_safes(),
                    iterations,
                    solve_s,
                });
            }
            let started = std::time::Instant::now();
            let step = StepPositions { x_t0: &self.x_t0, x_t1: &x_t1, inverse_masses: &self.inverse_masses };
            zones.add(&step, &impacts)?;
            let mut moved: Vec<Moved> = Vec::new();
            for rank in 0..ranks {
                let solved = zones.solve(executor, host, &step, &zones.share(rank, ranks));
                iterations += solved.iterations;
                moved.extend(solved.moved);
            }
            apply(&moved, &mut x_t1);
            solve_s += started.elapsed().as_secs_f64();
        }
        panic!("{ROUNDS_MAX} rounds: {:?}", zones.counts());
    }

    /// True if no edge crosses a triangle at the positions.
    pub fn is_free(&self, x: &[f32]) -> bool {
        let mesh = self.mesh();
        let at = |v: u32| Vec3::from_slice(&x[3 * v as usize..]);
        let obstacle = |v: u32| v as usize >= mesh.cloth_vertices;
        mesh.edges.iter().all(|e| {
            mesh.triangles.iter().all(|t| {
                let ([p, q], [a, b, c]) = (e.map(at), t.map(at));
                e.iter().any(|v| t.contains(v))
                    || (obstacle(e[0]) && obstacle(t[0]))
                    || !edge_crosses_triangle(p, q, a, b, c)
            })
        })
    }

    /// Sum of mass times position over the movable vertices.
    pub fn momentum(&self, x: &[f32]) -> DVec3 {
        let movable = (0..self.vertices()).filter(|&v| self.inverse_masses[v] > 0.0);
        movable.map(|v| Vec3::from_slice(&x[3 * v..]).as_dvec3() / f64::from(self.inverse_masses[v])).sum()
    }
}

/// Settings of a cloth of 1 mm.
pub fn settings() -> ZoneSettings {
    ZoneSettings::for_thickness(1e-3)
}
