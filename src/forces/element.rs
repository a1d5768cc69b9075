//! Elements: what a kernel needs to know of a triangle or a hinge besides positions and velocities. Plain data that
//! travels from the coordinator to the workers and to the device as it is.

use crate::gpu::gpu_struct;
use crate::math::{DVec2, Vec2, Vec3};
use crate::scene::{Fabric, Plasticity, StrainLimit};

/// Corners of a triangle element.
pub const CORNERS_TRIANGLE: usize = 3;
/// Corners of a hinge element.
pub const CORNERS_HINGE: usize = 4;
/// Length of a triangle record (layout: `stretch`).
pub const TRIANGLE_RECORD_FLOATS: usize = 24;
/// Length of a hinge record (layout: `bend`).
pub const HINGE_RECORD_FLOATS: usize = 16;
/// Length of a contact record (layout: `contact`).
pub const CONTACT_RECORD_FLOATS: usize = 12;

gpu_struct! {
    /// Stretch element: a triangle and its rest shape.
    pub struct TriangleElement {
        /// Local vertex indices.
        pub vertices: [u32; 3],
        /// Index into the fabric table.
        pub fabric: u32,
        /// d(position)/d(warp) = sum over corners of weight * position; weights of corners 1 and 2 (corner 0: minus
        /// their sum), 1/m.
        pub weights_u: [f32; 2],
        /// The same for the weft.
        pub weights_v: [f32; 2],
        /// Rest area, m^2.
        pub area_m2: f32,
        /// The stiffness is divided by 1 + this; 0 unless a fabric is plastic and weakens.
        pub damage: f32,
        /// Pressure on the side from which its corners run clockwise over that on the other one, Pa.
        pub pressure_pa: f32,
        /// Factor on the stiffness of the fabric.
        pub stiffness: f32,
    }
}

impl TriangleElement {
    /// Lengths of the sides of the rest shape, meters: from corner 0 to 1, from 1 to 2, from 2 to 0.
    pub fn sides_m(&self) -> [f64; 3] {
        let ([u1, u2], [v1, v2]) = (self.weights_u.map(f64::from), self.weights_v.map(f64::from));
        // The weights are the inverse of the matrix of the two sides from corner 0.
        let det = u1 * v2 - u2 * v1;
        let (a, b) = (DVec2::new(v2, -u2) / det, DVec2::new(-v1, u1) / det);
        [a.length(), (a - b).length(), b.length()]
    }

    /// Smallest altitude of the rest shape, metres: twice the area over the longest side.
    pub fn smallest_altitude_m(&self) -> f32 {
        let [ab, bc, ca] = self.sides_m();
        let longest = ab.max(ca).max(bc);
        (2.0 * f64::from(self.area_m2) / longest) as f32
    }

    /// Weights (warp, weft) of all three corners.
    pub fn corner_weights(&self) -> [[f32; 2]; 3] {
        let ([u1, u2], [v1, v2]) = (self.weights_u, self.weights_v);
        [[-(u1 + u2), -(v1 + v2)], [u1, v1], [u2, v2]]
    }
}

gpu_struct! {
    /// Bending element: an interior edge with the two triangles beside it.
    pub struct HingeElement {
        /// Local vertex indices: edge start, edge end, opposite vertex of triangle 0, opposite vertex of triangle 1.
        pub vertices: [u32; 4],
        /// Bending stiffness (N m) times this = torsion stiffness of the hinge: l^2 / (4 a), a = area of both
        /// triangles.
        pub shape: f32,
        /// Curvature (1/m) = this * dihedral angle: l / a.
        pub curvature_from_angle: f32,
        /// Dihedral angle at rest, radians; plastic bending moves it.
        pub rest_angle: f32,
        /// Plastic curvature so far, 1/m, every change counted positive.
        pub plastic_curvature: f32,
        /// Direction of the edge in material space on each side: 0 = warp, 1 = 45 degrees, 2 = weft.
        pub bias: [f32; 2],
        /// Fabric of each side.
        pub fabric: [u32; 2],
    }
}

impl HingeElement {
    /// Angle at rest and plastic curvature.
    pub fn crease(&self) -> [f32; 2] {
        [self.rest_angle, self.plastic_curvature]
    }

    /// Sets what [`HingeElement::crease`] gives.
    pub fn set_crease(&mut self, crease: [f32; 2]) {
        [self.rest_angle, self.plastic_curvature] = crease;
    }
}

gpu_struct! {
    /// What all elements of a step share; uniform of the element kernels.
    pub struct StepParams {
        /// Step length, seconds.
        pub step_s: f32,
        /// Density of the air, kg/m^3.
        pub air_density: f32,
        /// Tangential drag, kg/(m^2 s).
        pub air_drag: f32,
        /// Number of elements.
        pub count: u32,
        /// Velocity of the air, m/s.
        pub wind: [f32; 3],
        /// Internal forces are those at this time after the state, to first order, seconds: the step, or 0 where the
        /// state is already that of the end of the step.
        pub ahead_s: f32,
    }
}

/// [`FabricTable::limit_stiffness`] over the largest stiffness of the fabric (docs/papers.md, D28).
const LIMIT_STIFFENING: f64 = 80.0;

gpu_struct! {
    /// A fabric on the device: stretching rows (6 x 4), bending rows (3 x 5), damping, plasticity, strain limits; 52
    /// floats.
    pub struct FabricTable {
        /// As [`Fabric::stretching_n_m`].
        pub stretching: [[f32; 4]; 6],
        /// As [`Fabric::bending_n_m`], row after row.
        pub bending: [f32; 15],
        /// Stiffness-proportional damping, seconds.
        pub damping_s: f32,
        /// As [`Plasticity::yield_curvature_1_m`]; 0 = folds are elastic.
        pub yield_curvature: f32,
        /// As [`Plasticity::hardening`].
        pub hardening: f32,
        /// As [`Plasticity::weakening`].
        pub weakening: f32,
        /// Least and largest stretch in any direction; 0 and `FREE` = no limit, here and below.
        pub strain_limit: [f32; 2],
        /// Least and largest stretch of the warp.
        pub warp_limit: [f32; 2],
        /// Least and largest stretch of the weft.
        pub weft_limit: [f32; 2],
        /// Sine of the largest change of the angle between warp and weft.
        pub shear_limit: f32,
        /// Largest stiffness beyond a strain limit, N/m; 0 = no limit of any kind.
        pub limit_stiffness: f32,
        /// Logarithm of the stretch at which it yields, ln(1 + [`Plasticity::yield_strain`]); 0 = elastic.
        pub yield_strain: f32,
    }
}

/// A stretch that no cloth reaches; its square is a finite number.
pub(super) const FREE: f32 = 1e6;

impl FabricTable {
    /// True if the fabric has a strain limit of any kind.
    pub fn is_limited(&self) -> bool {
        self.limit_stiffness > 0.0
    }

    /// True if the fabric has a strain limit that is the same in every direction, so that its triangles have fibers.
    pub fn has_fibers(&self) -> bool {
        self.is_limited() && self.strain_limit[1] < FREE
    }

    /// Which of the two fabrics of a hinge yields first; the first one if none does.
    pub(super) fn yields_first(of_sides: [&FabricTable; 2]) -> &FabricTable {
        let [one, other] = of_sides;
        let is_other =
            other.yield_curvature > 0.0 && (one.yield_curvature <= 0.0 || other.yield_curvature < one.yield_curvature);
        if is_other { other } else { one }
    }

    /// True if a part of the cloth of this fabric may have weakened triangles or another shape at rest.
    pub fn changes_triangles(&self) -> bool {
        self.yield_strain > 0.0 || self.yield_curvature > 0.0 && self.weakening > 0.0
    }

    /// The fabric with `factor` times its stiffness against stretching and bending.
    pub fn stiffened(&self, factor: f32) -> FabricTable {
        FabricTable {
            stretching: self.stretching.map(|row| row.map(|k| k * factor)),
            bending: self.bending.map(|k| k * factor),
            limit_stiffness: self.limit_stiffness * factor,
            ..*self
        }
    }

    /// Factor of the bending stiffness at a plastic curvature above 0.
    pub(super) fn weakened(&self, plastic_curvature: f32) -> f32 {
        self.yield_curvature / (self.yield_curvature + self.weakening * plastic_curvature)
    }
}

impl From<&Fabric> for FabricTable {
    fn from(fabric: &Fabric) -> FabricTable {
        let mut bending = [0.0; 15];
        for (to, from) in bending.iter_mut().zip(fabric.bending_n_m.iter().flatten()) {
            *to = *from as f32;
        }
        let Plasticity { yield_curvature_1_m, hardening, weakening, yield_strain } =
            fabric.plasticity.unwrap_or(Plasticity::NONE);
        let yields_at = |value: f64| if value < f64::INFINITY { value as f32 } else { 0.0 };
        let narrow = |range: Option<[f64; 2]>| range.map_or([0.0, FREE], |range| range.map(|stretch| stretch as f32));
        let (every, warp, weft, shear_deg) = match fabric.strain_limit {
            None => (None, None, None, None),
            Some(StrainLimit::Every(range)) => (Some(range), None, None, None),
            Some(StrainLimit::Along { warp, weft, shear_deg }) => (None, warp, weft, shear_deg),
        };
        let stiffest = fabric.stretching_n_m.iter().map(|row| row[0].max(row[2])).fold(0.0, f64::max);
        FabricTable {
            stretching: fabric.stretching_n_m.map(|row| row.map(|k| k as f32)),
            bending,
            damping_s: fabric.damping_s as f32,
            yield_curvature: yields_at(yield_curvature_1_m),
            hardening: hardening as f32,
            weakening: weakening as f32,
            strain_limit: narrow(every),
            warp_limit: narrow(warp),
            weft_limit: narrow(weft),
            shear_limit: shear_deg.map_or(1.0, |angle| angle.to_radians().sin() as f32),
            limit_stiffness: if fabric.strain_limit.is_some() { (LIMIT_STIFFENING * stiffest) as f32 } else { 0.0 },
            yield_strain: yields_at(yield_strain.ln_1p()),
        }
    }
}

/// Rest shape of a triangle with material coordinates `uv`. The caller has refused zero areas.
pub fn triangle_element(vertices: [u32; 3], fabric: u32, uv: [Vec2; 3]) -> TriangleElement {
    let [a, b, c] = uv.map(|p| DVec2::new(p.x as f64, p.y as f64));
    let (e1, e2) = (b - a, c - a);
    let det = e1.x * e2.y - e1.y * e2.x;
    // Rows of the inverse of [e1 e2]: gradients of the barycentric coordinates of corners 1 and 2.
    let (w1, w2) = (DVec2::new(e2.y, -e2.x) / det, DVec2::new(-e1.y, e1.x) / det);
    TriangleElement {
        vertices,
        fabric,
        weights_u: [w1.x as f32, w2.x as f32],
        weights_v: [w1.y as f32, w2.y as f32],
        area_m2: (0.5 * det.abs()) as f32,
        damage: 0.0,
        pressure_pa: 0.0,
        stiffness: 1.0,
    }
}

/// Rest shape of a hinge. `uv_edge[side]` = material coordinates of the edge's two ends on that side, `areas_m2` = rest
/// areas of the two triangles. Edge direction -> bias as in [Wang et al. 2011]: samples at 0, 45 and 90 degrees.
pub fn hinge_element(
    vertices: [u32; 4],
    fabric: [u32; 2],
    uv_edge: [[Vec2; 2]; 2],
    areas_m2: [f64; 2],
    rest_angle: f32,
) -> HingeElement {
    let bias = uv_edge.map(|[p, q]| {
        let d = DVec2::new((q.x - p.x) as f64, (q.y - p.y) as f64);
        (d.y.abs().atan2(d.x.abs()) * 4.0 / std::f64::consts::PI) as f32
    });
    let length = 0.5 * uv_edge.iter().map(|[p, q]| (*q - *p).as_dvec2().length()).sum::<f64>();
    let area = areas_m2[0] + areas_m2[1];
    HingeElement {
        vertices,
        shape: (length * length / (4.0 * area)) as f32,
        curvature_from_angle: (length / area) as f32,
        rest_angle,
        plastic_curvature: 0.0,
        bias,
        fabric,
    }
}

/// Vertex `v` of a packed xyz array.
#[inline(always)]
pub(super) fn vertex(values: &[f32], v: u32) -> Vec3 {
    let at = v as usize * 3;
    Vec3::new(values[at], values[at + 1], values[at + 2])
}
