//! Vertices that are added on the border of a cloth while it runs, so that a seam has as many on both sides. The
//! surface stays the same, and so does everything that a state knows of it.

use std::collections::HashMap;

use super::folds::listed;
use super::state::{creases_of, renumbered};
use super::{Crease, LetGo, State};
use crate::math::Vec3;
use crate::mesh::{EdgeCut, Part, TriangleMesh, ascending, hinges};
use crate::scene::{Cloth, Fold, Pin, Scene, Sewing};

/// The way from a mesh to one with more vertices on its border.
pub struct Cut {
    /// Vertex here of every vertex before.
    vertex_of: Vec<u32>,
    /// The added vertices in the order of the cuts.
    added: Vec<u32>,
    cuts: Vec<EdgeCut>,
    /// Triangle before of every triangle.
    triangle_of: Vec<u32>,
    /// Edges in the order of the creases before and here; empty if no fabric is plastic.
    hinges_before: Vec<[u32; 2]>,
    hinges_after: Vec<[u32; 2]>,
}

impl Cut {
    /// The scene with a vertex at every one of the cuts, which must all differ and lie on edges of the border, and the
    /// way to it.
    pub fn of(scene: &Scene, cuts: &[EdgeCut]) -> (Scene, Cut) {
        let before = scene.mesh.positions.len() as u32;
        let mut mesh = scene.mesh.clone();
        let (_, first_part) = mesh.cut_edges(cuts);
        let cloth_of = |v: u32| scene.cloths.partition_point(|cloth| cloth.vertices.end <= v);
        // The vertices of a cloth lie together.
        let cloths_of: Vec<usize> =
            (0..before).map(cloth_of).chain(cuts.iter().map(|cut| cloth_of(cut.edge[0]))).collect();
        let mut order: Vec<u32> = (0..mesh.positions.len() as u32).collect();
        order.sort_by_key(|&v| cloths_of[v as usize]);
        let (mesh, place_of) = mesh.reordered(&order);
        let range = |range: &std::ops::Range<u32>| first_part[range.start as usize]..first_part[range.end as usize];
        let cloths = scene.cloths.iter().enumerate().map(|(number, cloth)| {
            let first = |cloth: usize| order.partition_point(|&v| cloths_of[v as usize] < cloth) as u32;
            Cloth { vertices: first(number)..first(number + 1), triangles: range(&cloth.triangles), ..cloth.clone() }
        });
        let is_plastic = creases_of(scene) > 0;
        let edges_of = |mesh: &TriangleMesh| match is_plastic {
            true => hinges(mesh).iter().map(|h| [h.vertices[0], h.vertices[1]]).collect(),
            false => Vec::new(),
        };
        let parts_of = first_part.windows(2).map(|ends| (ends[1] - ends[0]) as usize);
        let triangle_of: Vec<u32> = (0u32..).zip(parts_of).flat_map(|(t, parts)| vec![t; parts]).collect();
        let cut = Cut {
            vertex_of: place_of[..before as usize].to_vec(),
            added: place_of[before as usize..].to_vec(),
            cuts: cuts.to_vec(),
            hinges_before: edges_of(&scene.mesh),
            hinges_after: edges_of(&mesh),
            triangle_of,
        };
        let sewing = scene.sewing.as_ref().map(|sewing| Sewing {
            pairs: sewing.pairs.iter().map(|pair| pair.map(|v| cut.vertex(v))).collect(),
            ..sewing.clone()
        });
        let placed = |fold: &Fold| (ascending(fold.edge.map(|v| cut.vertex(v))), fold.angle);
        let folds = listed(scene.folds.iter().map(placed));
        let fabric = |&t: &u32| scene.fabric_of_triangle[t as usize];
        let after = Scene {
            velocities: cut.vectors(&scene.velocities),
            fabric_of_triangle: cut.triangle_of.iter().map(fabric).collect(),
            maps: scene.maps.mapped(|list| cut.numbers(list)),
            pins: scene.pins.iter().map(|pin| Pin { vertex: cut.vertex(pin.vertex), ..*pin }).collect(),
            cloths: cloths.collect(),
            parts: scene.parts.iter().map(|part| Part { triangles: range(&part.triangles), ..part.clone() }).collect(),
            folds,
            sewing,
            mesh,
            ..scene.clone()
        };
        (after, cut)
    }

    /// Vertex here of a vertex before.
    pub fn vertex(&self, before: u32) -> u32 {
        self.vertex_of[before as usize]
    }

    /// The vertex that was added at a cut.
    pub fn added(&self, cut: usize) -> u32 {
        self.added[cut]
    }

    /// The state here that follows from one before.
    pub fn state(&self, before: &State) -> State {
        State {
            positions: self.vectors(&before.positions),
            velocities: self.vectors(&before.velocities),
            creases: self.creases(&before.creases),
            stretches: match before.stretches.is_empty() {
                true => Vec::new(),
                false => self.triangle_of.iter().map(|&t| before.stretches[t as usize]).collect(),
            },
            let_go: self.let_go(&before.let_go),
            holds: renumbered(&before.holds, |v| self.vertex(v)),
        }
    }

    /// Values of the vertices here: on an edge linear between its ends.
    fn vectors(&self, before: &[Vec3]) -> Vec<Vec3> {
        let mut values = vec![Vec3::ZERO; before.len() + self.added.len()];
        self.vertex_of.iter().zip(before).for_each(|(&v, &value)| values[v as usize] = value);
        for (&v, cut) in self.added.iter().zip(&self.cuts) {
            let [a, b] = cut.edge.map(|end| before[end as usize].as_dvec3());
            values[v as usize] = a.lerp(b, cut.share).as_vec3();
        }
        values
    }

    /// As `vectors` for numbers.
    fn numbers(&self, before: &[f32]) -> Vec<f32> {
        let of: Vec<Vec3> = before.iter().map(|&value| Vec3::splat(value)).collect();
        self.vectors(&of).into_iter().map(|value| value.x).collect()
    }

    /// Hinges within a triangle of before are new and flat.
    fn creases(&self, before: &[Crease]) -> Vec<Crease> {
        let of_edge = self.hinges_before.iter().map(|edge| ascending(edge.map(|v| self.vertex(v)))).zip(before);
        let of_edge: HashMap<[u32; 2], Crease> = of_edge.map(|(edge, &crease)| (edge, crease)).collect();
        self.hinges_after.iter().map(|&edge| of_edge.get(&ascending(edge)).copied().unwrap_or_default()).collect()
    }

    /// What is let go goes on to the vertices on the edges beside.
    fn let_go(&self, before: &[LetGo]) -> Vec<LetGo> {
        let mut all: Vec<LetGo> = before.iter().map(|one| LetGo { vertex: self.vertex(one.vertex), ..*one }).collect();
        for (&vertex, cut) in self.added.iter().zip(&self.cuts) {
            let of_ends = before.iter().filter(|one| cut.edge.contains(&one.vertex));
            all.extend(of_ends.map(|one| LetGo { vertex, ..*one }));
        }
        all.sort_unstable();
        all.dedup_by_key(|one| (one.vertex, one.obstacle));
        all
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::mesh::{Border, validate};
    use crate::scene::{Overrides, parse};

    /// Two grids of 2 x 2 cells, plastic, and a cut on the border of the first one.
    #[test]
    fn a_cut_keeps_the_surface_and_all_that_is_known_of_it() {
        let cloth = |z: f64| {
            format!(
                "[[cloth]]\nsheet = {{ size_m = [2, 2], triangles = 8, mesh = \"grid\" }}\norigin_m = [0, 0, {z}]\n\
                 yield_curvature = 1.0\nyield_strain = 0.1\n"
            )
        };
        let text = format!("{}{}[[pin]]\ncloth = 1\ncorners = [\"top-right\"]\n", cloth(0.0), cloth(1.0));
        let scene = parse(&text, Path::new("x.toml"), &Overrides::default()).unwrap();
        let mut state = State::start_of(&scene);
        let hinges_before = hinges(&scene.mesh);
        state.creases.iter_mut().enumerate().for_each(|(i, crease)| *crease = [i as f32, 1.0]);
        state.stretches.iter_mut().enumerate().for_each(|(i, stretch)| stretch[3] = i as f32);
        state.velocities[0] = Vec3::X;
        state.let_go = vec![LetGo { vertex: 1, obstacle: 0, inside: 0 }, LetGo { vertex: 17, obstacle: 0, inside: 1 }];
        let (after, cut) = Cut::of(&scene, &[EdgeCut { edge: [0, 1], share: 0.25 }]);
        assert_eq!(validate(&after.mesh), Ok(()));
        assert_eq!((after.mesh.positions.len(), after.mesh.triangles.len()), (19, 17));
        assert_eq!([after.cloths[0].vertices.clone(), after.cloths[1].vertices.clone()], [0..10, 10..19]);
        assert_eq!([after.cloths[0].triangles.clone(), after.cloths[1].triangles.clone()], [0..9, 9..17]);
        assert_eq!((cut.vertex(0), cut.vertex(9), cut.added(0), after.pins[0].vertex), (0, 10, 9, 18));
        assert_eq!(after.mesh.positions[9], Vec3::new(0.25, 0.0, 0.0));
        let border = Border::new(&after.mesh);
        assert!(border.edge(0, 9).is_some() && border.edge(9, 1).is_some() && border.edge(0, 1).is_none());
        let there = cut.state(&state);
        assert_eq!(there.vertices(), Some(19));
        assert_eq!((there.velocities[0], there.velocities[9]), (Vec3::X, Vec3::new(0.75, 0.0, 0.0)));
        assert_eq!(there.plastic_counts().stretches, 17);
        // Every hinge of before has its crease, and the new one is flat.
        let hinges_after = hinges(&after.mesh);
        assert_eq!(there.creases.len(), hinges_after.len());
        for (hinge, crease) in hinges_before.iter().zip(&state.creases) {
            let edge = ascending([hinge.vertices[0], hinge.vertices[1]].map(|v| cut.vertex(v)));
            let place = hinges_after.iter().position(|h| ascending([h.vertices[0], h.vertices[1]]) == edge).unwrap();
            assert_eq!(there.creases[place], *crease);
        }
        assert_eq!(there.creases.iter().filter(|crease| crease[1] == 0.0).count(), 1);
        let let_go: Vec<u32> = there.let_go.iter().map(|one| one.vertex).collect();
        assert_eq!(let_go, [1, 9, 18]);
    }
}
