//! Clothes for the person in its rest pose: surfaces around the body, cut open where a head, arms or legs come out.

use super::anatomy::{CHEST, COLLAR, FOREARM, NECK, PELVIS, SHIN, SPINE, THIGH, UPPER_ARM, flesh};
use super::cone::{Cone, blended, bounds};
use crate::math::DVec3;
use crate::mesh::level_set::LevelSet;
use crate::mesh::{FileMesh, MaterialSource, VertexProperty};

/// Which garment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Dress,
    Skirt,
    Jacket,
    Trousers,
    Robe,
}

/// Names of garments in scene files.
pub(crate) const KINDS: [(&str, Kind); 5] = [
    ("dress", Kind::Dress),
    ("skirt", Kind::Skirt),
    ("jacket", Kind::Jacket),
    ("trousers", Kind::Trousers),
    ("robe", Kind::Robe),
];

/// A garment as a scene describes it, in the coordinates of the person.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Garment {
    pub kind: Kind,
    /// Its distance from the body where it lies close, meters.
    pub ease_m: f64,
    /// Height of its lower border, meters.
    pub hem_m: f64,
    /// Radius of a skirt at its hem, of sleeves and of trouser legs at their ends, meters.
    pub width_m: f64,
    /// Number of pleats around a skirt; 0: it is smooth.
    pub pleats: u64,
    /// Depth of the pleats from ridge to valley, meters.
    pub pleat_depth_m: f64,
    /// True: it is open in front.
    pub open: bool,
}

/// Height of the waist, meters.
const WAIST_M: f64 = 1.075;
/// Half of the height of the band that counts as the waist, meters.
const WAIST_BAND_M: f64 = 0.012;
/// Half of the gap of a garment that is open in front, meters.
const GAP_M: f64 = 0.004;
/// Half of that gap as a share of an edge, so that a coarse mesh is cut through, for a garment of about this area,
/// m^2.
const GAP_EDGES: f64 = 0.7;
const AREA_M2: f64 = 1.5;

impl Kind {
    /// Height of the hem and width, unless the scene says otherwise.
    pub(crate) fn measures(self) -> (f64, f64) {
        match self {
            Kind::Dress | Kind::Skirt => (0.12, 0.36),
            Kind::Jacket => (0.78, 0.085),
            Kind::Trousers => (0.13, 0.085),
            Kind::Robe => (0.16, 0.15),
        }
    }

    /// Lowest and highest place of the hem, meters.
    pub(crate) fn hems(self) -> [f64; 2] {
        match self {
            Kind::Dress | Kind::Skirt => [0.01, 0.85],
            Kind::Jacket | Kind::Robe => [0.05, 0.95],
            Kind::Trousers => [0.10, 0.70],
        }
    }

    pub(crate) fn has_skirt(self) -> bool {
        matches!(self, Kind::Dress | Kind::Skirt)
    }

    fn has_sleeves(self) -> bool {
        matches!(self, Kind::Jacket | Kind::Robe)
    }
}

impl Garment {
    /// The garment with about this many triangles; none if no surface of so few is one cloth.
    pub(crate) fn mesh(&self, triangles: f64) -> Option<FileMesh> {
        let mut surface = self.shape(triangles, |shape| shape.mesh(triangles))?;
        let waist = surface.positions.iter().map(|p| {
            let p = p.as_dvec3();
            let is_waist = (p.y - WAIST_M).abs() <= WAIST_BAND_M && p.x.abs() < 0.3;
            f32::from(u8::from(is_waist))
        });
        surface.properties.push(VertexProperty { name: "waist".into(), values: waist.collect() });
        surface.into_mesh(MaterialSource::Shape).ok()
    }

    /// Its area, m^2.
    pub(crate) fn area(&self) -> Option<f64> {
        /// About the triangles of the mesh that measures it.
        const MEASURED: f64 = 4e3;
        self.shape(MEASURED, |shape| shape.area())
    }

    /// A box around it.
    pub(crate) fn bounds(&self) -> [DVec3; 2] {
        bounds(&self.cones())
    }

    fn shape<T>(&self, triangles: f64, mesh: impl FnOnce(&LevelSet) -> T) -> T {
        let cones = self.cones();
        let gap_m = GAP_M.max(GAP_EDGES * (AREA_M2 / triangles).sqrt() * 1.5);
        let inside = |p: DVec3| blended(&cones, p) - self.pleat(p);
        let keep = |p: DVec3| self.kept(p, gap_m);
        let [low, high] = bounds(&cones);
        let room = DVec3::splat(self.pleat_depth_m);
        mesh(&LevelSet { inside: &inside, keep: Some(&keep), bounds: [low - room, high + room] })
    }

    /// How far pleats push the surface out.
    fn pleat(&self, p: DVec3) -> f64 {
        if self.pleats == 0 {
            return 0.0;
        }
        // They begin below the waist, where the skirt is wide enough.
        let below = ((WAIST_M - 0.03 - p.y) / 0.15).clamp(0.0, 1.0);
        let wave = (self.pleats as f64 * p.z.atan2(p.x)).cos();
        self.pleat_depth_m * below * (1.0 + wave) / 2.0
    }

    /// The body below the garment and what stands off it.
    fn cones(&self) -> Vec<Cone> {
        let mut covered = vec![PELVIS, SPINE, THIGH[0], THIGH[1]];
        match self.kind {
            Kind::Dress => covered.extend([CHEST, NECK, COLLAR[0], COLLAR[1], UPPER_ARM[0], UPPER_ARM[1]]),
            Kind::Jacket | Kind::Robe => {
                covered.extend([CHEST, NECK]);
                [COLLAR, UPPER_ARM, FOREARM].iter().for_each(|pair| covered.extend(pair));
            }
            Kind::Skirt => covered.push(CHEST),
            Kind::Trousers => covered.extend([CHEST, SHIN[0], SHIN[1]]),
        }
        let body = flesh().into_iter().filter(|(joint, _)| covered.contains(joint));
        let mut cones: Vec<Cone> = body.map(|(_, cone)| cone.grown(self.ease_m)).collect();
        let mut both = |cone: Cone| cones.extend([cone, cone.mirrored()]);
        // Skirts and legs go on beyond the hem, so that the cut leaves them open.
        let end = self.hem_m - 0.02;
        if self.kind.has_skirt() {
            both(Cone::new([0.055, 1.04, 0.0], [0.02, end, 0.0], [0.075 + self.ease_m, self.width_m]));
            both(Cone::new([0.055, 0.92, -0.01], [0.04, end, -0.01], [0.105 + self.ease_m, self.width_m]));
        }
        if self.kind.has_sleeves() {
            let width = self.width_m;
            both(Cone::new(
                [0.150, 1.365, -0.005],
                [0.382, 1.196, -0.005],
                [0.058 + self.ease_m, 0.5 * (width + 0.06)],
            ));
            both(Cone::new([0.382, 1.196, -0.005], [0.620, 0.996, 0.010], [0.5 * (width + 0.06), width]));
            both(Cone::new([0.070, 1.250, 0.0], [0.065, 1.000, 0.0], [0.092 + self.ease_m, 0.088 + self.ease_m]));
            let foot = if self.kind == Kind::Robe { 0.19 } else { 0.125 };
            both(Cone::new(
                [0.065, 1.000, 0.0],
                [0.095, end.min(0.80), 0.0],
                [0.088 + self.ease_m, 0.125 + self.ease_m],
            ));
            both(Cone::new([0.095, 0.80, 0.0], [0.100, end - foot, 0.0], [0.125 + self.ease_m, foot + self.ease_m]));
        }
        if self.kind == Kind::Trousers {
            let width = self.width_m;
            both(Cone::new([0.090, 0.900, -0.01], [0.134, 0.480, 0.0], [0.100 + self.ease_m, width + 0.005]));
            both(Cone::new([0.134, 0.480, 0.0], [0.172, end - width, -0.004], [width + 0.005, width]));
        }
        cones
    }

    /// Not negative where there is cloth.
    fn kept(&self, p: DVec3, gap_m: f64) -> f64 {
        let mut kept = p.y - self.hem_m;
        let mut cut = |distance: f64| kept = kept.min(distance);
        match self.kind {
            Kind::Skirt | Kind::Trousers => cut(WAIST_M + 0.01 - p.y),
            Kind::Dress | Kind::Jacket | Kind::Robe => {
                let deep = if self.kind == Kind::Dress { 0.012 } else { 0.0 };
                // Wider for what stands off the neck.
                let wide = (self.ease_m - 0.012).max(0.0);
                let radii = [0.078 + deep + wide, 0.075 + wide];
                cut(Cone::new([0.0, 1.42 - deep, 0.055], [0.0, 1.60, -0.03], radii).distance(p));
            }
        }
        let arm = DVec3::new(p.x.abs(), p.y, p.z);
        if self.kind == Kind::Dress {
            let reach = 0.072 + self.ease_m;
            cut(Cone::new([0.222, 1.352, -0.005], [0.402, 1.201, -0.010], [reach; 2]).distance(arm));
        }
        if self.kind.has_sleeves() {
            // Across the forearm, above the wrist.
            let (wrist, along) = (DVec3::new(0.555, 1.065, 0.008), DVec3::new(0.765, -0.644, 0.02));
            let sleeve = Cone::new([0.382, 1.196, -0.005], [0.620, 0.996, 0.010], [0.28; 2]);
            cut((wrist - arm).dot(along.normalize()).max(sleeve.distance(arm)));
        }
        if self.open {
            cut((p.x.abs() - gap_m).max(-p.z));
        }
        kept
    }
}
