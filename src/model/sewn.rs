//! From panels to sewn cloth: the scene after its seams have closed, and a state of the panels as a state of it.
//!
//! Paired vertices become one, whose mass is the sum of theirs, and which keeps their momentum; then triangles are
//! divided into four as often as the scene asks. The scene that results follows from the panels' scene alone, so that a
//! run can be resumed on either side of the change.

use std::collections::HashMap;

use super::folds::{add_parts, folds_of_seams, listed};
use super::seam_reach::{Reach, near_seams};
use super::state::{creases_of, renumbered};
use super::{Crease, LetGo, State};
use crate::math::{DVec3, Vec3};
use crate::mesh::{Part, SewnMesh, TriangleMesh, ascending, hinges};
use crate::scene::{Closing, Cloth, Fold, Maps, Pin, Scene, Settings, SettingsOverTime, Sewing};

/// The way from a state of panels to one of the sewn cloth.
pub struct Sewn {
    /// Joined vertex of every vertex of the panels.
    vertex_of: Vec<u32>,
    /// The vertices of every joined vertex that has several.
    sets: Vec<Vec<u32>>,
    /// Masses of the panels' vertices, kg.
    masses: Vec<f64>,
    /// Vertices of the panels that a pin holds at some time.
    is_pinned: Vec<bool>,
    /// Ends of the edge that every added vertex halves, by level.
    halved: Vec<Vec<[u32; 2]>>,
    /// Vertex of the sewn scene of every vertex of the sewn and divided mesh.
    place_of: Vec<u32>,
    weld_m: f64,
    /// Triangles of the sewn cloth in a triangle of the panels.
    parts: usize,
    /// Edges in the order of the creases of the panels and of the sewn cloth; empty if no fabric is plastic.
    hinges_before: Vec<[u32; 2]>,
    hinges_after: Vec<[u32; 2]>,
    /// Those of the sewn scene.
    folds: Vec<Fold>,
}

impl Sewn {
    /// The scene that `scene` becomes once it is sewn, and the way to it; none if it has no seams. The sewn scene has
    /// no seams, and joined vertices lie at the mean of their places at the start.
    pub fn of(scene: &Scene) -> Option<(Scene, Sewn)> {
        let sewing = scene.sewing.as_ref()?;
        let joined = SewnMesh::new(&scene.mesh, &sewing.pairs).ok()?;
        let mut members: Vec<Vec<u32>> = vec![Vec::new(); joined.mesh.positions.len()];
        for (v, &joined) in (0u32..).zip(&joined.vertex_of) {
            members[joined as usize].push(v);
        }
        let mut is_pinned = vec![false; scene.mesh.positions.len()];
        scene.pins.iter().for_each(|pin| is_pinned[pin.vertex as usize] = true);
        let SewnMesh { mut mesh, vertex_of } = joined;
        let mut folds = folds_of_seams(&scene.mesh, &mesh, sewing);
        folds.extend(scene.folds.iter().map(|fold| (ascending(fold.edge.map(|v| vertex_of[v as usize])), fold.angle)));
        // A pin holds where it took hold.
        for (joined, members) in members.iter().enumerate() {
            if let Some(&pinned) = members.iter().find(|&&v| is_pinned[v as usize]) {
                mesh.positions[joined] = scene.mesh.positions[pinned as usize];
            }
        }
        let mut cloth_of: Vec<u32> = members.iter().map(|members| cloth_of_vertex(scene, members[0])).collect();
        let mut pins: Vec<Pin> =
            scene.pins.iter().map(|pin| Pin { vertex: vertex_of[pin.vertex as usize], ..*pin }).collect();
        let (mut halved, first_half) = (Vec::new(), mesh.positions.len() as u32);
        for _ in 0..sewing.refine {
            let edges = mesh.halved_edges();
            pins.extend(pins_of_halves(&pins, &edges, mesh.positions.len() as u32));
            let of_halves =
                edges.iter().map(|&[a, b]| cloth_of[a as usize].min(cloth_of[b as usize])).collect::<Vec<_>>();
            cloth_of.extend(of_halves);
            mesh = mesh.divided();
            halved.push(edges);
        }
        add_parts(&mut folds, &halved, first_half);
        // The vertices of a cloth lie together.
        let mut order: Vec<u32> = (0..mesh.positions.len() as u32).collect();
        order.sort_by_key(|&v| cloth_of[v as usize]);
        let (mesh, place_of) = mesh.reordered(&order);
        pins.iter_mut().for_each(|pin| pin.vertex = place_of[pin.vertex as usize]);
        pins.sort_by(|a, b| a.vertex.cmp(&b.vertex).then(a.start_s.total_cmp(&b.start_s)));
        pins.dedup();
        let placed = |edge: [u32; 2]| ascending(edge.map(|v| place_of[v as usize]));
        let folds = listed(folds.into_iter().map(|(edge, angle)| (placed(edge), angle)));
        let parts = 1u32 << (2 * sewing.refine);
        let range = |range: &std::ops::Range<u32>| range.start * parts..range.end * parts;
        let cloths = scene.cloths.iter().enumerate().map(|(number, cloth)| {
            let first = |cloth: u32| order.partition_point(|&v| cloth_of[v as usize] < cloth) as u32;
            let vertices = first(number as u32)..first(number as u32 + 1);
            Cloth { vertices, triangles: range(&cloth.triangles), ..cloth.clone() }
        });
        let is_plastic = creases_of(scene) > 0;
        let edges_of = |mesh: &TriangleMesh| match is_plastic {
            true => hinges(mesh).iter().map(|h| [h.vertices[0], h.vertices[1]]).collect(),
            false => Vec::new(),
        };
        let sewn = Sewn {
            masses: lumped_masses(scene),
            sets: members.into_iter().filter(|members| members.len() > 1).collect(),
            vertex_of,
            is_pinned,
            halved,
            place_of,
            weld_m: sewing.weld_m,
            parts: parts as usize,
            hinges_before: edges_of(&scene.mesh),
            hinges_after: edges_of(&mesh),
            folds: folds.clone(),
        };
        let velocities = sewn.vectors(&sewn.joined_velocities(&scene.velocities));
        let after = Scene {
            velocities,
            fabric_of_triangle: scene.fabric_of_triangle.iter().flat_map(|&f| vec![f; parts as usize]).collect(),
            pins,
            cloths: cloths.collect(),
            parts: scene.parts.iter().map(|part| Part { triangles: range(&part.triangles), ..part.clone() }).collect(),
            settings: Settings {
                gravity_m_s2: sewing.gravity_m_s2,
                over_time: SettingsOverTime { gravity_waits: false, ..scene.settings.over_time.clone() },
                ..scene.settings.clone()
            },
            maps: scene.maps.mapped(|list| sewn.numbers(list)),
            folds,
            sewing: None,
            mesh,
            ..scene.clone()
        };
        Some((after, sewn))
    }

    /// `scene`, which has no seams, with every triangle divided into four, `times` times, and the way to it.
    pub fn divided(scene: &Scene, times: u32) -> Option<(Scene, Sewn)> {
        let sewing = Sewing {
            pairs: Vec::new(),
            names: Vec::new(),
            angles: Vec::new(),
            seam_of_pair: Vec::new(),
            closing: Closing { start_s: 0.0, close_s: 1.0, last_m: 0.0 },
            first_m: None,
            weld_m: 0.0,
            refine: times,
            gravity_m_s2: scene.settings.gravity_m_s2,
        };
        Sewn::of(&Scene { sewing: Some(sewing), ..scene.clone() })
    }

    /// The largest distance that two vertices to be joined have from each other by way of the place where they meet,
    /// meters, and where the vertices of the panels are once they have met: two in the middle, more at their mean, and
    /// a pinned one stays.
    pub fn ends(&self, positions: &[Vec3]) -> (f64, Vec<Vec3>) {
        let mut ends = positions.to_vec();
        let mut widest_m: f64 = 0.0;
        for members in &self.sets {
            let at = |v: u32| positions[v as usize].as_dvec3();
            let mean = members.iter().map(|&v| at(v)).sum::<DVec3>() / members.len() as f64;
            let pinned = members.iter().copied().find(|&v| self.is_pinned[v as usize]);
            let end = pinned.map_or(mean.as_vec3(), |v| positions[v as usize]);
            for &v in members {
                widest_m = widest_m.max(2.0 * at(v).distance(end.as_dvec3()));
                ends[v as usize] = end;
            }
        }
        (widest_m, ends)
    }

    /// The vertices of places where vertices to be joined have farther to go than half of [`Sewn::weld_m`], on their
    /// way to `ends`.
    pub fn open<'a>(&'a self, positions: &'a [Vec3], ends: &'a [Vec3]) -> impl Iterator<Item = &'a [u32]> {
        let way_m = |&v: &u32| positions[v as usize].as_dvec3().distance(ends[v as usize].as_dvec3());
        let is_open = move |members: &&[u32]| members.iter().any(|v| 2.0 * way_m(v) > self.weld_m);
        self.sets.iter().map(Vec::as_slice).filter(is_open)
    }

    /// The vertices of every place at which several become one.
    pub fn places(&self) -> impl Iterator<Item = &[u32]> {
        self.sets.iter().map(Vec::as_slice)
    }

    /// Largest [`Sewn::ends`] at which seams count as closed, meters.
    pub fn weld_m(&self) -> f64 {
        self.weld_m
    }

    /// Whether vertices of two features of the panels become one.
    pub fn joins(&self, one: &[u32], other: &[u32]) -> bool {
        let joined = |v: &u32| self.vertex_of[*v as usize];
        one.iter().any(|v| other.iter().any(|w| joined(v) == joined(w)))
    }

    /// Vertex of the sewn mesh, before it is divided, that a vertex of the panels has become.
    pub fn joined_vertex(&self, panels: u32) -> u32 {
        self.vertex_of[panels as usize]
    }

    /// For every vertex of the panels the vertices of the sewn mesh that it is near and that several became, ascending:
    /// within two rings of the sewn mesh, or within a way of `beyond_m` along edges at rest from there. `panels`: their
    /// mesh.
    pub fn near_seams(&self, panels: &TriangleMesh, beyond_m: f64) -> Vec<Vec<u32>> {
        let joined = |v: u32| self.vertex_of[v as usize];
        let sides = panels.triangles.iter().zip(&panels.material_uv).map(|(corners, &[a, b, c])| {
            (corners.map(joined), [[a, b], [b, c], [c, a]].map(|[p, q]| p.as_dvec2().distance(q.as_dvec2())))
        });
        let seams = self.sets.iter().map(|members| joined(members[0]));
        let mut near: Vec<Vec<u32>> = vec![Vec::new(); self.joined()];
        for [v, seam] in near_seams(sides, self.joined(), seams, Reach { rings: 2, beyond_m }) {
            near[v as usize].push(seam);
        }
        self.vertex_of.iter().map(|&v| near[v as usize].clone()).collect()
    }

    /// Vertex of the sewn cloth that a vertex of the panels has become.
    pub fn vertex(&self, panels: u32) -> u32 {
        self.place_of[self.vertex_of[panels as usize] as usize]
    }

    /// The vertices that were added in the middle of edges, with the ends of these, level by level.
    pub fn halves(&self) -> Vec<(u32, [u32; 2])> {
        let place = |v: u32| self.place_of[v as usize];
        let middles = self.joined() as u32..;
        middles.zip(self.halved.iter().flatten()).map(|(middle, &ends)| (place(middle), ends.map(place))).collect()
    }

    /// The state of the sewn cloth that follows from a state of the panels whose vertices have met at `ends`.
    pub fn state(&self, panels: &State, ends: &[Vec3]) -> State {
        let mut joined = vec![Vec3::ZERO; self.joined()];
        for (v, &place) in self.vertex_of.iter().enumerate() {
            joined[place as usize] = ends[v];
        }
        State {
            positions: self.vectors(&joined),
            velocities: self.vectors(&self.joined_velocities(&panels.velocities)),
            creases: self.creases(&panels.creases),
            stretches: panels.stretches.iter().flat_map(|&stretch| vec![stretch; self.parts]).collect(),
            let_go: self.let_go(&panels.let_go),
            holds: renumbered(&panels.holds, |v| self.place_of[self.vertex_of[v as usize] as usize]),
        }
    }

    /// Number of vertices of the sewn cloth before it is divided.
    fn joined(&self) -> usize {
        self.place_of.len() - self.halved.iter().map(Vec::len).sum::<usize>()
    }

    /// Momentum over mass of every joined vertex.
    fn joined_velocities(&self, velocities: &[Vec3]) -> Vec<Vec3> {
        let mut sums = vec![(DVec3::ZERO, 0.0); self.joined()];
        let mut first = vec![u32::MAX; self.joined()];
        for (v, &place) in self.vertex_of.iter().enumerate() {
            let (momentum, mass) = &mut sums[place as usize];
            *momentum += velocities[v].as_dvec3() * self.masses[v];
            *mass += self.masses[v];
            first[place as usize] = match first[place as usize] {
                u32::MAX => v as u32,
                _ => u32::MAX - 1,
            };
        }
        let velocity = |(&(momentum, mass), &only): (&(DVec3, f64), &u32)| match velocities.get(only as usize) {
            Some(&velocity) => velocity,
            None => (momentum / mass).as_vec3(),
        };
        sums.iter().zip(&first).map(velocity).collect()
    }

    /// Values of the vertices of the sewn scene from those of the joined ones: in the middle of an edge the mean of its
    /// ends.
    fn vectors(&self, joined: &[Vec3]) -> Vec<Vec3> {
        let mut all = joined.to_vec();
        for level in &self.halved {
            for &[a, b] in level {
                all.push(all[a as usize].midpoint(all[b as usize]));
            }
        }
        let mut placed = vec![Vec3::ZERO; all.len()];
        all.iter().zip(&self.place_of).for_each(|(value, &place)| placed[place as usize] = *value);
        placed
    }

    /// Numbers of the vertices of the sewn scene from those of the panels: joined vertices have their mean.
    fn numbers(&self, panels: &[f32]) -> Vec<f32> {
        let mut sums = vec![(0.0f32, 0.0f32); self.joined()];
        for (&joined, &value) in self.vertex_of.iter().zip(panels) {
            let (sum, count) = &mut sums[joined as usize];
            (*sum, *count) = (*sum + value, *count + 1.0);
        }
        let means: Vec<Vec3> = sums.iter().map(|(sum, count)| Vec3::splat(sum / count)).collect();
        self.vectors(&means).into_iter().map(|value| value.x).collect()
    }

    /// A crease goes on to the parts of its edge; all other edges start with their angle at rest.
    fn creases(&self, panels: &[Crease]) -> Vec<Crease> {
        if self.hinges_before.is_empty() {
            return Vec::new();
        }
        let joined = |v: u32| self.vertex_of[v as usize];
        let before = self.hinges_before.iter().map(|edge| ascending(edge.map(joined)));
        let mut of_edge: HashMap<[u32; 2], Crease> = before.zip(panels.iter().copied()).collect();
        add_parts(&mut of_edge, &self.halved, self.joined() as u32);
        let placed = |edge: [u32; 2]| ascending(edge.map(|v| self.place_of[v as usize]));
        let placed: HashMap<[u32; 2], Crease> =
            of_edge.into_iter().map(|(edge, crease)| (placed(edge), crease)).collect();
        let at_rest = |edge: [u32; 2]| [Fold::angle_of(&self.folds, edge), 0.0];
        self.hinges_after.iter().map(|&edge| placed.get(&edge).copied().unwrap_or_else(|| at_rest(edge))).collect()
    }

    /// What is let go goes on to every vertex of the edges and triangles around.
    fn let_go(&self, panels: &[LetGo]) -> Vec<LetGo> {
        let mut all: Vec<LetGo> =
            panels.iter().map(|one| LetGo { vertex: self.vertex_of[one.vertex as usize], ..*one }).collect();
        if all.is_empty() {
            return all;
        }
        let mut middle = self.joined() as u32;
        for level in &self.halved {
            let before = all.clone();
            for &[a, b] in level {
                let of_ends = before.iter().filter(|one| one.vertex == a || one.vertex == b);
                all.extend(of_ends.map(|one| LetGo { vertex: middle, ..*one }));
                middle += 1;
            }
        }
        all.iter_mut().for_each(|one| one.vertex = self.place_of[one.vertex as usize]);
        all.sort_unstable();
        all.dedup_by_key(|one| (one.vertex, one.obstacle));
        all
    }
}

/// Pins of the middles of edges whose ends are held alike; middles are numbered from `first` on.
fn pins_of_halves(pins: &[Pin], edges: &[[u32; 2]], first: u32) -> Vec<Pin> {
    let mut of_vertex: HashMap<u32, Vec<&Pin>> = HashMap::new();
    pins.iter().for_each(|pin| of_vertex.entry(pin.vertex).or_default().push(pin));
    let mut halves = Vec::new();
    for (middle, [a, b]) in (first..).zip(edges) {
        let (Some(of_a), Some(of_b)) = (of_vertex.get(a), of_vertex.get(b)) else { continue };
        for pin in of_a {
            let alike = |other: &&&Pin| Pin { vertex: pin.vertex, ..***other } == **pin;
            halves.extend(of_b.iter().find(alike).map(|_| Pin { vertex: middle, ..**pin }));
        }
    }
    halves
}

/// Number of the cloth of a vertex.
fn cloth_of_vertex(scene: &Scene, vertex: u32) -> u32 {
    scene.cloths.partition_point(|cloth| cloth.vertices.end <= vertex) as u32
}

/// Mass of every vertex: a third of those of its triangles, kg.
fn lumped_masses(scene: &Scene) -> Vec<f64> {
    let mut masses = vec![0.0; scene.mesh.positions.len()];
    for ((corners, uv), &fabric) in
        scene.mesh.triangles.iter().zip(&scene.mesh.material_uv).zip(&scene.fabric_of_triangle)
    {
        let [a, b, c] = uv.map(|p| p.as_dvec2());
        let area_m2 = 0.5 * (b - a).perp_dot(c - a).abs();
        let third = area_m2 * scene.fabrics[usize::from(fabric)].density_kg_m2 / 3.0;
        corners.iter().for_each(|&v| masses[v as usize] += third * Maps::factor(&scene.maps.density, v));
    }
    masses
}
