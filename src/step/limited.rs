//! Triangles of a rank whose fabric has strain limits: how far they are beyond them, and which way they are pulled back
//! (`limits`).

use std::ops::Range;

use crate::forces::{FabricTable, TriangleElement, largest_overstretch, overstretch};
use crate::gpu::CpuExecutor;
use crate::math::Vec3;
use crate::model::RankArrays;

/// Strain beyond a limit from which on triangles are pulled back, and where they are pulled to: fibers have their full
/// slope there, and hold a weight within it.
pub(super) const PULLED_TO: f32 = 0.0025;
pub(super) const PULLED_FROM: f32 = PULLED_TO + EXCESS;
/// Strain beyond what they are pulled back to that ends the rounds.
pub(super) const EXCESS: f32 = 0.001;
/// Part of the way that every triangle asks for in a round. Its neighbors ask at the same time.
const PART: f32 = 0.4;
/// Triangles that one thread measures at least.
const GRAIN: usize = 256;

/// Displacements of the local vertices in a round, meters: zero but for those of `vertices`.
pub(super) struct Moves {
    by: Vec<Vec3>,
    vertices: Vec<u32>,
}

impl Moves {
    pub(super) fn none(vertices: usize) -> Moves {
        Moves { by: vec![Vec3::ZERO; vertices], vertices: Vec::new() }
    }

    /// Vertices that may have moved, in no order, some more than once.
    pub(super) fn vertices(&self) -> &[u32] {
        &self.vertices
    }

    pub(super) fn of(&self, vertex: usize) -> Vec3 {
        self.by[vertex]
    }

    fn clear(&mut self) {
        self.vertices.drain(..).for_each(|v| self.by[v as usize] = Vec3::ZERO);
    }

    fn add(&mut self, vertex: u32, by: Vec3) {
        let sum = &mut self.by[vertex as usize];
        if *sum == Vec3::ZERO {
            self.vertices.push(vertex);
        }
        *sum += by;
    }
}

/// Triangles of a rank whose fabric has strain limits.
pub(super) struct LimitedTriangles {
    fabrics: Vec<FabricTable>,
    triangles: Vec<TriangleElement>,
    /// Strain beyond a limit of every triangle where it was measured last.
    strains: Vec<f32>,
    /// Strain to which every triangle is pulled back within the step.
    targets: Vec<f32>,
    /// Triangles of every local vertex, ascending: those of vertex v are `of_vertex[starts[v]..starts[v + 1]]`.
    starts: Vec<u32>,
    of_vertex: Vec<u32>,
    /// Triangles that are looked at in the rounds of a step, and a mark for each of them.
    watched: Vec<u32>,
    is_watched: Vec<bool>,
}

impl LimitedTriangles {
    /// None if no fabric of the scene has limits; all ranks know all fabrics.
    pub(super) fn of(arrays: &RankArrays) -> Option<LimitedTriangles> {
        if !arrays.fabrics.iter().any(FabricTable::is_limited) {
            return None;
        }
        let is_limited = |e: &&TriangleElement| arrays.fabrics[e.fabric as usize].is_limited();
        let triangles: Vec<TriangleElement> = arrays.triangles.iter().filter(is_limited).copied().collect();
        let corners = || triangles.iter().enumerate().flat_map(|(t, e)| e.vertices.map(|v| (v as usize, t as u32)));
        let mut starts = vec![0u32; corners().map(|(v, _)| v + 2).max().unwrap_or(1)];
        corners().for_each(|(v, _)| starts[v + 1] += 1);
        (1..starts.len()).for_each(|v| starts[v] += starts[v - 1]);
        let (mut next, mut of_vertex) = (starts.clone(), vec![0; triangles.len() * 3]);
        corners().for_each(|(v, t)| {
            of_vertex[next[v] as usize] = t;
            next[v] += 1;
        });
        let (strains, is_watched) = (vec![0.0; triangles.len()], vec![false; triangles.len()]);
        let targets = strains.clone();
        let fabrics = arrays.fabrics.clone();
        Some(LimitedTriangles {
            fabrics,
            triangles,
            strains,
            targets,
            starts,
            of_vertex,
            watched: Vec::new(),
            is_watched,
        })
    }

    /// Takes the shapes at rest of the rank's triangles, `elements`, as they are now.
    pub(super) fn take_rest_shapes(&mut self, elements: &[TriangleElement]) {
        let fabrics = &self.fabrics;
        let limited = elements.iter().filter(|element| fabrics[element.fabric as usize].is_limited());
        self.triangles.iter_mut().zip(limited).for_each(|(triangle, element)| *triangle = *element);
    }

    fn strain(&self, triangle: usize, positions: &[f32]) -> f32 {
        let element = &self.triangles[triangle];
        largest_overstretch(&self.fabrics[element.fabric as usize], element, corners(element, positions))
    }

    /// Measures all triangles at `positions` (xyz of all local vertices), and watches those that may be pulled back,
    /// each by the strain `most` at most.
    pub(super) fn measure(&mut self, threads: Option<&CpuExecutor>, positions: &[f32], most: f32) {
        let mut strains = std::mem::take(&mut self.strains);
        let fill = |range: Range<usize>, out: &mut [f32]| {
            for (triangle, strain) in range.zip(out) {
                *strain = self.strain(triangle, positions);
            }
        };
        match threads {
            Some(threads) => threads.for_ranges_mut(&mut strains, 1, GRAIN, fill),
            None => fill(0..self.triangles.len(), &mut strains),
        }
        self.strains = strains;
        self.watched.drain(..).for_each(|triangle| self.is_watched[triangle as usize] = false);
        for triangle in 0..self.triangles.len() {
            self.targets[triangle] = (self.strains[triangle] - most).max(PULLED_TO);
            if self.strains[triangle] > PULLED_TO {
                self.watch(triangle as u32);
            }
        }
    }

    /// Lets watched triangles be pulled back as far as it takes that were not farther beyond a limit than `strain` at
    /// `positions` (xyz of all local vertices).
    pub(super) fn unbind_within(&mut self, positions: &[f32], strain: f32) {
        for at in 0..self.watched.len() {
            let triangle = self.watched[at] as usize;
            if self.targets[triangle] > PULLED_TO && self.strain(triangle, positions) <= strain {
                self.targets[triangle] = PULLED_TO;
            }
        }
    }

    fn watch(&mut self, triangle: u32) {
        if !std::mem::replace(&mut self.is_watched[triangle as usize], true) {
            self.watched.push(triangle);
        }
    }

    /// Watches the triangles of a local vertex that has been moved. All others are as far beyond as they were.
    pub(super) fn watch_around(&mut self, vertex: usize) {
        let Some(&[start, end]) = self.starts.get(vertex..).and_then(|starts| starts.first_chunk()) else { return };
        for at in start..end {
            self.watch(self.of_vertex[at as usize]);
        }
    }

    /// Measures the triangles that are watched.
    pub(super) fn measure_watched(&mut self, positions: &[f32]) {
        for at in 0..self.watched.len() {
            let triangle = self.watched[at] as usize;
            self.strains[triangle] = self.strain(triangle, positions);
        }
    }

    /// Strains of the triangles that are watched. All others are within what they would be pulled back to.
    fn watched_strains(&self) -> impl Iterator<Item = f32> {
        self.watched.iter().map(|&triangle| self.strains[triangle as usize])
    }

    /// Largest strain beyond a limit; 0 if no triangle is far enough beyond to be watched.
    pub(super) fn worst(&self) -> f32 {
        self.watched_strains().fold(0.0, f32::max)
    }

    /// Largest strain beyond what a triangle is pulled back to.
    pub(super) fn worst_excess(&self) -> f32 {
        let targets = self.watched.iter().map(|&triangle| self.targets[triangle as usize]);
        self.watched_strains().zip(targets).map(|(strain, target)| strain - target).fold(0.0, f32::max)
    }

    /// Triangles farther beyond than `strain`, at least [`PULLED_TO`], whose first corner is one of the local vertices
    /// `own`, so that ranks count each once.
    pub(super) fn count(&self, strain: f32, own: &Range<usize>) -> u64 {
        let is_own = |triangle: &u32| own.contains(&(self.triangles[*triangle as usize].vertices[0] as usize));
        self.watched.iter().filter(|t| self.strains[**t as usize] > strain && is_own(t)).count() as u64
    }

    /// Sets `moves` of the local vertices to what their triangles ask for, in ascending order of the triangles, so that
    /// sums of own vertices are the same on every number of ranks. `inverse_masses`: 1/kg, 0 = a pin holds it.
    pub(super) fn pull(&mut self, positions: &[f32], inverse_masses: &[f32], moves: &mut Moves) {
        moves.clear();
        self.watched.sort_unstable();
        for &triangle in &self.watched {
            let triangle = triangle as usize;
            let target = self.targets[triangle];
            if self.strains[triangle] <= target {
                continue;
            }
            let element = &self.triangles[triangle];
            let weights = element.corner_weights();
            let inverse = element.vertices.map(|v| inverse_masses[v as usize]);
            let beyond = overstretch(&self.fabrics[element.fabric as usize], element, corners(element, positions));
            for one in beyond.iter().filter(|one| one.strain > target) {
                let gradients = weights.map(|weights| one.gradient(weights));
                let compliance: f32 = gradients.iter().zip(inverse).map(|(g, w)| w * g.length_squared()).sum();
                if compliance <= 0.0 {
                    continue;
                }
                let impulse = PART * (one.strain - target) / compliance;
                for ((gradient, w), v) in gradients.iter().zip(inverse).zip(element.vertices) {
                    moves.add(v, *gradient * -(w * impulse));
                }
            }
        }
    }
}

fn corners(element: &TriangleElement, positions: &[f32]) -> [Vec3; 3] {
    let at = |v: u32| Vec3::from_slice(&positions[v as usize * 3..][..3]);
    let [a, b, c] = element.vertices;
    [at(a), at(b), at(c)]
}
