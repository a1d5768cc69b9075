//! u(X), from the state of a coarse level to one of a finer level of the same scene [Liang and Lin 2018, Sec. 3.1].
//!
//! Levels are nested: every triangle of the coarse level is four flat triangles of the next one. The surface stays the
//! same, so a state without penetrations becomes one without penetrations, but for the rounding of the middle
//! of an edge to single precision, which whoever hands the state on has to check. Meshes that are the same at both
//! levels are copied.

use std::collections::HashMap;

use crate::math::Vec3;
use crate::mesh::{Refinement, hinges};
use crate::model::{Crease, LetGo, RestStretch, State, UNSTRETCHED};
use crate::scene::{Fabric, Scene};

/// The way from a coarse level of a scene to a fine one.
#[derive(Clone, Debug)]
pub struct Upsampling {
    /// The vertex of the coarse mesh of every fine vertex that has one; ascending by the fine vertex.
    copies: Vec<[u32; 2]>,
    /// Fine vertices in the middle of an edge, with the ends of it, which come before them here or among the copies.
    middles: Vec<[u32; 3]>,
    fine_vertices: usize,
    coarse_vertices: usize,
    /// Edges of the hinges of both meshes in the order of their creases; empty if no fabric is plastic.
    coarse_hinges: Vec<[u32; 2]>,
    fine_hinges: Vec<[u32; 2]>,
    /// Triangles of both meshes, and the fine ones of every coarse one.
    coarse_triangles: Vec<[u32; 3]>,
    fine_triangles: Vec<[u32; 3]>,
    parts: Vec<Vec<u32>>,
}

impl Upsampling {
    /// For the levels `coarse` and `fine` of one scene. `refinements`: from each piece of `coarse` to that of `fine`
    /// ([`crate::scene::ParsedScene::coarser_at`]).
    pub fn new(coarse: &Scene, fine: &Scene, refinements: &[Refinement]) -> Upsampling {
        assert_eq!(
            (coarse.cloths.len(), refinements.len()),
            (fine.cloths.len(), fine.cloths.len()),
            "levels of a scene"
        );
        let (mut copies, mut middles, mut parts) = (Vec::new(), Vec::new(), Vec::new());
        for ((small, large), refinement) in coarse.cloths.iter().zip(&fine.cloths).zip(refinements) {
            let first = large.vertices.start;
            copies.extend(refinement.copies.iter().zip(small.vertices.clone()).map(|(&to, from)| [first + to, from]));
            middles.extend(refinement.middles.iter().map(|middle| middle.map(|vertex| first + vertex)));
            let of_piece = refinement.triangles.chunks_exact(refinement.parts);
            parts.extend(of_piece.map(|parts| parts.iter().map(|t| large.triangles.start + t).collect()));
        }
        let creases = fine.fabrics.iter().any(Fabric::creases);
        let edges = |scene: &Scene| {
            let edge = |hinge: &crate::mesh::Hinge| [hinge.vertices[0], hinge.vertices[1]];
            if creases { hinges(&scene.mesh).iter().map(edge).collect() } else { Vec::new() }
        };
        Upsampling {
            copies,
            middles,
            fine_vertices: fine.mesh.positions.len(),
            coarse_vertices: coarse.mesh.positions.len(),
            coarse_hinges: edges(coarse),
            fine_hinges: edges(fine),
            coarse_triangles: coarse.mesh.triangles.clone(),
            fine_triangles: fine.mesh.triangles.clone(),
            parts,
        }
    }

    /// The state of the fine level on the surface of `coarse`, a state of the coarse one. Positions and velocities in
    /// the middle of an edge are the means of its ends; a crease goes on to the parts of its edge, a rest stretch to
    /// those of its triangle; what is let go goes on to all vertices of its triangles. Pins take hold anew.
    pub fn state(&self, coarse: &State) -> State {
        assert_eq!(coarse.vertices(), Some(self.coarse_vertices), "a state of the coarse level");
        State {
            positions: self.vectors(&coarse.positions),
            velocities: self.vectors(&coarse.velocities),
            creases: self.creases(&coarse.creases),
            stretches: self.stretches(&coarse.stretches),
            let_go: self.let_go(&coarse.let_go),
            holds: Vec::new(),
        }
    }

    /// Values of the fine vertices from values of the coarse ones.
    pub fn vectors(&self, coarse: &[Vec3]) -> Vec<Vec3> {
        let mut fine = vec![Vec3::ZERO; self.fine_vertices];
        for &[to, from] in &self.copies {
            fine[to as usize] = coarse[from as usize];
        }
        for &[to, a, b] in &self.middles {
            fine[to as usize] = fine[a as usize].midpoint(fine[b as usize]);
        }
        fine
    }

    fn creases(&self, coarse: &[Crease]) -> Vec<Crease> {
        let fine_of: HashMap<u32, u32> = self.copies.iter().map(|&[fine, coarse]| (coarse, fine)).collect();
        let ascending = |a: u32, b: u32| [a.min(b), a.max(b)];
        let mut of_edge: HashMap<[u32; 2], Crease> = self
            .coarse_hinges
            .iter()
            .zip(coarse)
            .map(|(&[a, b], &crease)| (ascending(fine_of[&a], fine_of[&b]), crease))
            .collect();
        for &[middle, a, b] in &self.middles {
            if let Some(&crease) = of_edge.get(&ascending(a, b)) {
                of_edge.insert(ascending(a, middle), crease);
                of_edge.insert(ascending(b, middle), crease);
            }
        }
        self.fine_hinges.iter().map(|&[a, b]| of_edge.get(&[a, b]).copied().unwrap_or_default()).collect()
    }

    fn stretches(&self, coarse: &[RestStretch]) -> Vec<RestStretch> {
        if coarse.is_empty() {
            return Vec::new();
        }
        let mut fine = vec![UNSTRETCHED; self.fine_triangles.len()];
        for (&stretch, parts) in coarse.iter().zip(&self.parts) {
            parts.iter().for_each(|&triangle| fine[triangle as usize] = stretch);
        }
        fine
    }

    fn let_go(&self, coarse: &[LetGo]) -> Vec<LetGo> {
        let mut fine = Vec::new();
        if coarse.is_empty() {
            return fine;
        }
        for (corners, parts) in self.coarse_triangles.iter().zip(&self.parts) {
            for pair in coarse.iter().filter(|pair| corners.contains(&pair.vertex)) {
                let vertices = parts.iter().flat_map(|&t| self.fine_triangles[t as usize]);
                fine.extend(vertices.map(|vertex| LetGo { vertex, ..*pair }));
            }
        }
        fine.sort_unstable();
        // One side for each vertex and obstacle, also where corners came from different sides.
        fine.dedup_by_key(|pair| (pair.vertex, pair.obstacle));
        fine
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Overrides, ParsedScene, read_str};

    const SCENE: &str = r#"
        name = "two"
        [simulation]
        collisions = false
        [[cloth]]
        sheet = { size_m = [1.0, 0.8], triangles = 2_000 }
        yield_curvature = 5.0
        yield_strain = 0.02
        [[cloth]]
        sheet = { radius_m = 0.3, triangles = 900 }
        origin_m = [0.0, 0.0, 1.0]
    "#;

    fn parsed() -> ParsedScene {
        read_str(SCENE, "two.toml".as_ref()).unwrap()
    }

    fn levels(coarsenings: usize) -> (Scene, Scene, Upsampling) {
        let (parsed, wanted) = (parsed(), Overrides::default());
        let ((coarse, refinements), fine) =
            (parsed.coarser_at(&wanted, coarsenings).unwrap(), parsed.at(&wanted).unwrap());
        let up = Upsampling::new(&coarse, &fine, &refinements);
        (coarse, fine, up)
    }

    /// A map that keeps straight lines straight.
    fn affine(p: Vec3) -> Vec3 {
        Vec3::new(0.5 * p.x - 0.25 * p.y, 2.0 * p.z + p.x, p.y - 1.0)
    }

    #[test]
    fn an_affine_state_stays_affine() {
        for coarsenings in [0, 1, 3] {
            let (coarse, fine, up) = levels(coarsenings);
            let mapped = |scene: &Scene| scene.mesh.positions.iter().map(|&p| affine(p)).collect::<Vec<_>>();
            let state = State { positions: mapped(&coarse), velocities: mapped(&coarse), ..State::start_of(&coarse) };
            let (state, expected) = (up.state(&state), mapped(&fine));
            assert_eq!(state.vertices(), Some(fine.mesh.positions.len()));
            assert_eq!(state.creases.len(), hinges(&fine.mesh).len());
            // The rim of a disc is round at every level, so its middles are not middles of edges.
            let rectangle = fine.cloths[0].vertices.end as usize;
            for (got, wanted) in
                [&state.positions, &state.velocities].into_iter().flat_map(|x| x.iter().zip(&expected).take(rectangle))
            {
                assert!(got.distance(*wanted) < 1e-6, "{got} instead of {wanted}");
            }
            if coarsenings == 0 {
                assert_eq!(state.positions, expected);
            }
        }
    }

    #[test]
    fn a_rolled_sheet_stays_free_of_crossings() {
        let (coarse, fine, up) = levels(2);
        // One and a half turns around the y axis, so coarse that facets of one turn come near those of the next.
        let rolled = |p: Vec3| {
            let turn = 1.5 * p.x;
            let (sin, cos) = (std::f32::consts::TAU * turn).sin_cos();
            Vec3::new((1.0 + 0.8 * turn) * cos, p.y + 3.0 * p.z, (1.0 + 0.8 * turn) * sin)
        };
        let positions: Vec<Vec3> = coarse.mesh.positions.iter().map(|&p| rolled(p)).collect();
        let state = up.state(&State { positions, ..State::start_of(&coarse) });
        let count = |positions: &[Vec3], scene: &Scene| {
            let triangles = 0..scene.cloths[0].triangles.end as usize;
            let group = crate::mesh::Group { triangles, kind: crate::mesh::GroupKind::Cloth };
            crate::mesh::crossings(positions, &scene.mesh.triangles, &[group]).len()
        };
        let before = coarse.mesh.positions.iter().map(|&p| rolled(p)).collect::<Vec<_>>();
        assert_eq!((count(&before, &coarse), count(&state.positions, &fine)), (0, 0));
    }

    #[test]
    fn creases_go_on_to_the_parts_of_their_edges() {
        let (coarse, fine, up) = levels(2);
        let edges = hinges(&coarse.mesh);
        let creases: Vec<Crease> = (0..edges.len()).map(|i| [1.0 + i as f32, 0.5]).collect();
        let state = up.state(&State { creases: creases.clone(), ..State::start_of(&coarse) });
        for (i, hinge) in edges.iter().enumerate() {
            let own: Vec<usize> = (0..state.creases.len()).filter(|&j| state.creases[j] == creases[i]).collect();
            assert_eq!(own.len(), 4, "an edge of two coarser levels");
            let fine_hinges = hinges(&fine.mesh);
            let ends = own.iter().flat_map(|&j| fine_hinges[j].vertices[..2].to_vec()).collect::<Vec<_>>();
            // Both ends once, and the three middles twice.
            let shift = |v: u32| {
                if v < coarse.cloths[0].vertices.end {
                    v
                } else {
                    v - coarse.cloths[1].vertices.start + fine.cloths[1].vertices.start
                }
            };
            for v in &hinge.vertices[..2] {
                assert_eq!(ends.iter().filter(|&&end| end == shift(*v)).count(), 1);
            }
            if i >= 40 {
                break;
            }
        }
        let carried = state.creases.iter().filter(|crease| **crease != Crease::default()).count();
        assert_eq!(carried, 4 * edges.len());
    }

    #[test]
    fn rest_stretches_go_on_to_the_parts_of_their_triangles() {
        let (coarse, fine, up) = levels(1);
        let stretches: Vec<RestStretch> = (0..coarse.mesh.triangles.len()).map(|t| [1.0, 1.0, 0.0, t as f32]).collect();
        let state = up.state(&State { stretches, ..State::start_of(&coarse) });
        assert_eq!(state.stretches.len(), fine.mesh.triangles.len());
        let first = state.stretches[..8].iter().map(|stretch| stretch[3]).collect::<Vec<_>>();
        assert_eq!(first, [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
    }

    #[test]
    fn what_is_let_go_goes_on_to_whole_triangles() {
        let (coarse, fine, up) = levels(1);
        let corner = coarse.mesh.triangles[5][1];
        let state =
            State { let_go: vec![LetGo { vertex: corner, obstacle: 3, inside: 1 }], ..State::start_of(&coarse) };
        let state = up.state(&state);
        let around: Vec<usize> = (0..coarse.cloths[0].triangles.end as usize)
            .filter(|&t| coarse.mesh.triangles[t].contains(&corner))
            .collect();
        for t in around {
            for v in fine.mesh.triangles[4 * t..4 * t + 4].as_flattened() {
                assert!(state.let_go.contains(&LetGo { vertex: *v, obstacle: 3, inside: 1 }));
            }
        }
        assert!(state.let_go.is_sorted() && state.vertices().is_some());
    }
}
