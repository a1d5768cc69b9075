//! The whole cloth in the global order. Vertices are renumbered for locality. The order depends only on the scene, so
//! the row blocks of any rank count are contiguous ranges of it.

use super::grips::Grips;
use super::state::{PlasticElements, RankState, RestStretch, State, UNSTRETCHED, creases_of, stretches_of};
use crate::forces::stitch::StitchElement;
use crate::forces::{FabricTable, HingeElement, TriangleElement, hinge_element, triangle_element};
use crate::integrator::pins::RankPin;
use crate::math::Vec2;
use crate::mesh::{Hinge, closed_parts, hinges, vertex_order};
use crate::partition::chunk_rows;
use crate::scene::{Closing, Fold, Maps, Motion, Obstacles, Scene, Settings};

/// The cloth in global order.
pub struct GlobalModel {
    /// Original (mesh) vertex of every global row.
    pub original_from_global: Vec<u32>,
    /// Start positions in global order, xyz.
    pub positions: Vec<f32>,
    /// Start velocities in global order, xyz.
    pub velocities: Vec<f32>,
    /// Lumped masses in global order, kg.
    pub masses: Vec<f32>,
    /// Stretch elements, ascending smallest vertex; vertices are global rows.
    pub triangles: Vec<TriangleElement>,
    /// Bending elements, ascending smallest vertex; vertices are global rows.
    pub hinges: Vec<HingeElement>,
    /// Hinge of the mesh of every hinge here; empty if no fabric is plastic.
    pub original_hinge: Vec<u32>,
    /// Triangle of the mesh of every triangle here; empty if no fabric stays stretched.
    pub original_triangle: Vec<u32>,
    /// Rest stretch of every triangle here at the start; empty if no fabric stays stretched.
    pub stretches: Vec<RestStretch>,
    /// Threads of seams, ascending smallest vertex; vertices are global rows.
    pub stitches: Vec<StitchElement>,
    /// How they shorten; none without seams.
    pub closing: Option<Closing>,
    /// Fabrics.
    pub fabrics: Vec<FabricTable>,
    /// Pins; `row` is a global row.
    pub pins: Vec<RankPin>,
    /// Motions of the pins.
    pub motions: Vec<Motion>,
    /// Friction coefficients in global order.
    pub friction: Vec<f32>,
    /// Factors on the friction with obstacles and on the thickness, in global order; empty where they are 1.
    pub factors: [Vec<f32>; 2],
    /// Obstacles.
    pub obstacles: Obstacles,
    /// Largest k dt^2 / (rho h^2) of a triangle: stiffness at rest, step, mass per area, smallest altitude.
    pub stiffness_ratio: f64,
    /// Parameters of the run.
    pub settings: Settings,
}

/// Pressure on the side of every triangle from which its corners run clockwise, Pa; empty if there is none. Cloth
/// with a border, such as panels that are still to be sewn, holds no pressure.
fn pressures(scene: &Scene) -> Vec<f32> {
    if scene.cloths.iter().all(|cloth| cloth.pressure_pa == 0.0) {
        return Vec::new();
    }
    let mut pressures = closed_parts(&scene.mesh.triangles, &scene.mesh.positions);
    for cloth in &scene.cloths {
        for t in cloth.triangles.clone() {
            pressures[t as usize] *= cloth.pressure_pa as f32;
        }
    }
    pressures
}

impl GlobalModel {
    /// Orders the vertices and builds the elements. The scene has passed its checks.
    pub fn new(scene: &Scene) -> GlobalModel {
        let mesh = &scene.mesh;
        let original_from_global = vertex_order(mesh, chunk_rows(mesh.positions.len()));
        let mut global_from_original = vec![0u32; original_from_global.len()];
        for (global, &original) in original_from_global.iter().enumerate() {
            global_from_original[original as usize] = global as u32;
        }
        let map = |v: u32| global_from_original[v as usize];
        let nothing = PlasticElements::default();
        let RankState { positions, velocities, .. } = State::start_of(scene).gather(&original_from_global, &nothing);

        let mut masses = vec![0.0f64; mesh.positions.len()];
        let mut areas = vec![0.0f64; mesh.triangles.len()];
        let pressures = pressures(scene);
        let mut triangles = Vec::with_capacity(mesh.triangles.len());
        for (t, (corners, uv)) in mesh.triangles.iter().zip(&mesh.material_uv).enumerate() {
            let fabric = scene.fabric_of_triangle[t];
            let mut element = triangle_element(corners.map(map), fabric as u32, *uv);
            element.pressure_pa = pressures.get(t).copied().unwrap_or(0.0);
            element.stiffness = Maps::of_triangle(&scene.maps.stiffness, *corners) as f32;
            areas[t] = rest_area(uv);
            for &v in corners {
                let third = areas[t] * scene.fabrics[fabric as usize].density_kg_m2 / 3.0;
                masses[map(v) as usize] += third * Maps::factor(&scene.maps.density, v);
            }
            triangles.push(element);
        }
        let bend = |hinge: &Hinge| {
            let sides = hinge.triangles.map(|t| t as usize);
            let uv_edge =
                sides.map(|t| edge_uv(mesh.triangles[t], mesh.material_uv[t], hinge.vertices[0], hinge.vertices[1]));
            let mut element = hinge_element(
                hinge.vertices.map(map),
                sides.map(|t| scene.fabric_of_triangle[t] as u32),
                uv_edge,
                sides.map(|t| areas[t]),
                Fold::angle_of(&scene.folds, [hinge.vertices[0], hinge.vertices[1]]),
            );
            let [one, other] = sides.map(|t| Maps::of_triangle(&scene.maps.stiffness, mesh.triangles[t]));
            element.shape *= (0.5 * (one + other)) as f32;
            element
        };
        let obstacles = Obstacles::new(&scene.obstacles);
        let grips = Grips::new(scene, &obstacles);
        let surfaces: Vec<_> = scene.pins.iter().map(|pin| grips.surface_of(pin)).collect();
        let grips = grips.of_pins(&scene.pins);
        let of_mesh = hinges(mesh);
        let mut bends: Vec<HingeElement> = of_mesh.iter().map(bend).collect();
        // Elements of a row then lie close together. Ties keep their order, so the result is the same on every machine.
        let mut original_triangle: Vec<u32> = (0..stretches_of(scene) as u32).collect();
        original_triangle.sort_by_key(|&triangle| triangles[triangle as usize].vertices.iter().min().copied());
        triangles.sort_by_key(|e| e.vertices.iter().min().copied());
        let mut original_hinge: Vec<u32> = (0..creases_of(scene) as u32).collect();
        original_hinge.sort_by_key(|&hinge| bends[hinge as usize].vertices.iter().min().copied());
        bends.sort_by_key(|e| e.vertices.iter().min().copied());

        GlobalModel {
            positions,
            velocities,
            masses: masses.iter().map(|&m| m as f32).collect(),
            triangles,
            hinges: bends,
            original_hinge,
            stretches: vec![UNSTRETCHED; original_triangle.len()],
            original_triangle,
            stitches: stitches(scene, map),
            closing: scene.sewing.as_ref().map(|sewing| sewing.closing),
            fabrics: scene.fabrics.iter().map(FabricTable::from).collect(),
            pins: scene
                .pins
                .iter()
                .zip(grips.iter().zip(surfaces))
                .map(|(pin, (grip, surface))| RankPin {
                    row: map(pin.vertex),
                    start_m: mesh.positions[pin.vertex as usize].to_array(),
                    motion: pin.motion,
                    grip: *grip,
                    start_s: pin.start_s,
                    end_s: pin.end_s,
                    stiffness_n_m: pin.stiffness_n_m,
                    on_touch: pin.on_touch,
                    takes_hold_later: pin.takes_hold_later(scene.motions.len()),
                    surface,
                })
                .collect(),
            motions: scene.motions.clone(),
            friction: original_from_global.iter().map(|&v| scene.friction_of_vertex(v) as f32).collect(),
            factors: [&scene.maps.friction, &scene.maps.thickness].map(|list| match list.is_empty() {
                true => Vec::new(),
                false => original_from_global.iter().map(|&v| list[v as usize]).collect(),
            }),
            obstacles,
            stiffness_ratio: stiffness_ratio(scene) * scene.settings.stiffness_factor_most(),
            settings: scene.settings.clone(),
            original_from_global,
        }
    }

    /// Replaces the scene's start state by another one. Order, pins and rest shape stay those of the scene.
    pub fn set_state(&mut self, state: &State) {
        let RankState { positions, velocities, creases, stretches, let_go: _, holds: _ } =
            state.gather(&self.original_from_global, &self.plastic_elements());
        (self.positions, self.velocities, self.stretches) = (positions, velocities, stretches);
        self.hinges.iter_mut().zip(creases).for_each(|(hinge, crease)| hinge.set_crease(crease));
    }

    /// Elements of the mesh that a state knows something of, in the order of the elements here.
    pub fn plastic_elements(&self) -> PlasticElements {
        PlasticElements { hinges: self.original_hinge.clone(), triangles: self.original_triangle.clone() }
    }

    /// Mean of the smallest altitudes of the triangles at rest, meters.
    pub fn cell_m(&self) -> f64 {
        let sum: f64 = self.triangles.iter().map(|e| f64::from(e.smallest_altitude_m())).sum();
        sum / self.triangles.len() as f64
    }

    /// Number of vertices.
    pub fn rows(&self) -> usize {
        self.masses.len()
    }
}

/// [`GlobalModel::stiffness_ratio`] of a scene.
pub fn stiffness_ratio(scene: &Scene) -> f64 {
    let of_triangle = |((&fabric, uv), corners): ((&u16, &[Vec2; 3]), &[u32; 3])| {
        let (fabric, element) = (&scene.fabrics[usize::from(fabric)], triangle_element([0, 1, 2], 0, *uv));
        let [warp, _, weft, shear] = fabric.stretching_n_m[0];
        let steps_per_cell = scene.settings.step_s / f64::from(element.smallest_altitude_m());
        let [stiffer, heavier] =
            [&scene.maps.stiffness, &scene.maps.density].map(|list| Maps::of_triangle(list, *corners));
        warp.max(weft).max(shear) / fabric.density_kg_m2 * steps_per_cell.powi(2) * (stiffer / heavier)
    };
    let triangles = scene.fabric_of_triangle.iter().zip(&scene.mesh.material_uv).zip(&scene.mesh.triangles);
    triangles.map(of_triangle).fold(0.0, f64::max)
}

/// A thread for every pair of a scene's seams, as stiff as the cloth beside its ends.
fn stitches(scene: &Scene, map: impl Fn(u32) -> u32) -> Vec<StitchElement> {
    let Some(sewing) = &scene.sewing else { return Vec::new() };
    let mut stiffness = vec![0.0f64; scene.mesh.positions.len()];
    for (corners, &fabric) in scene.mesh.triangles.iter().zip(&scene.fabric_of_triangle) {
        let [warp, _, weft, _] = scene.fabrics[usize::from(fabric)].stretching_n_m[0];
        corners.iter().for_each(|&v| stiffness[v as usize] = stiffness[v as usize].max(warp.max(weft)));
    }
    let thread = |(number, pair): (usize, &[u32; 2])| {
        let [a, b] = pair.map(|v| scene.mesh.positions[v as usize].as_dvec3());
        let [ka, kb] = pair.map(|v| stiffness[v as usize]);
        let [a_row, b_row] = pair.map(&map);
        StitchElement {
            vertices: [a_row.min(b_row), a_row.max(b_row)],
            stiffness_n_m: (0.5 * (ka + kb)) as f32,
            first_m: sewing.first_m.as_ref().map_or(a.distance(b) as f32, |first_m| first_m[number]),
        }
    };
    let mut stitches: Vec<StitchElement> = sewing.pairs.iter().enumerate().map(thread).collect();
    stitches.sort_by_key(|stitch| stitch.vertices);
    stitches
}

fn rest_area(uv: &[Vec2; 3]) -> f64 {
    let [a, b, c] = uv.map(|p| p.as_dvec2());
    0.5 * (b - a).perp_dot(c - a).abs()
}

/// Material coordinates of the edge (p, q) in triangle `corners`.
fn edge_uv(corners: [u32; 3], uv: [Vec2; 3], p: u32, q: u32) -> [Vec2; 2] {
    let at = |v: u32| corners.iter().position(|&c| c == v).map_or(Vec2::ZERO, |i| uv[i]);
    [at(p), at(q)]
}
