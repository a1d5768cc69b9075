//! Fabrics: presets, ARCSim's measured-fabric files, checks.
//!
//! The presets are plausible values, not measurements of one fabric; docs/scene.md has the drape coefficients that they
//! give. Stiffness tables can hold negative entries at single strains, as
//! measured tables do. The force code keeps the matrix positive definite.

use std::path::Path;

use super::error::SceneError;
use super::files::read_text;
use super::json::{Json, parse_json};

/// A fabric in ARCSim's form [Wang et al. 2011].
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Fabric {
    /// Name or file.
    pub name: String,
    /// Mass per rest area, kg/m^2.
    pub density_kg_m2: f64,
    /// Stretching stiffness, N/m. Row 0: at rest; rows 1..=5: at a principal strain of 1/6 along 0, 22.5, .. 90 degrees
    /// from the warp. Columns: warp, cross (warp-weft), weft, shear.
    pub stretching_n_m: [[f64; 4]; 6],
    /// Bending stiffness, N m: rows = 0, 45, 90 degrees from the warp; columns = curvature 0, 5, 10, 15, 20 1/m.
    pub bending_n_m: [[f64; 5]; 3],
    /// Stiffness-proportional damping, seconds (damping matrix = damping_s * stiffness matrix).
    pub damping_s: f64,
    /// Bending and stretching beyond which folds and stretches stay; none = elastic.
    #[serde(default)]
    pub plasticity: Option<Plasticity>,
    /// How far it stretches; none = as the stiffness allows.
    #[serde(default)]
    pub strain_limit: Option<StrainLimit>,
}

/// Strain limits. A stretch is length / length at rest.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub enum StrainLimit {
    /// Least and largest stretch in every direction.
    Every([f64; 2]),
    /// Limits of their own; what has none is as the stiffness allows.
    Along {
        /// Least and largest stretch of the warp.
        warp: Option<[f64; 2]>,
        /// Least and largest stretch of the weft.
        weft: Option<[f64; 2]>,
        /// Largest change of the right angle between warp and weft, degrees.
        shear_deg: Option<f64>,
    },
}

impl StrainLimit {
    /// Checks the values.
    fn check(&self) -> Result<(), String> {
        let usable = |[least, most]: [f64; 2]| {
            (0.0..=1.0).contains(&least) && (1.0..=f64::from(f32::MAX)).contains(&most) && most > least
        };
        let bad = |of: &str, [least, most]: [f64; 2]| {
            Err(format!(
                "the strain limit{of} must be two stretches, the first from 0 to 1 and the second at least 1, such as \
                 [0.95, 1.05], not [{least}, {most}]"
            ))
        };
        match *self {
            StrainLimit::Every(range) if !usable(range) => bad("", range),
            StrainLimit::Every(_) => Ok(()),
            StrainLimit::Along { warp: Some(range), .. } if !usable(range) => bad(" of the warp", range),
            StrainLimit::Along { weft: Some(range), .. } if !usable(range) => bad(" of the weft", range),
            StrainLimit::Along { shear_deg: Some(angle), .. } if !(angle > 0.0 && angle < 90.0) => {
                Err(format!("the limit of shear must be an angle above 0 and below 90 degrees, not {angle}"))
            }
            StrainLimit::Along { warp: None, weft: None, shear_deg: None } => {
                Err("the strain limit has none of `warp`, `weft` and `shear_deg`".into())
            }
            StrainLimit::Along { .. } => Ok(()),
        }
    }
}

/// Plastic bending and stretching [Narain et al. 2013], per hinge and per triangle: see [`crate::forces::crease`] and
/// [`crate::forces::plastic_stretch`].
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Plasticity {
    /// Elastic curvature beyond which the fold stays, 1/m; above 0, infinite = every fold is elastic.
    pub yield_curvature_1_m: f64,
    /// Growth of the yield curvature per plastic curvature, and of the yield strain per plastic strain; 0 = none.
    pub hardening: f64,
    /// Stiffness is divided by 1 + this * damage; 0 = it stays. Damage: plastic curvature / yield curvature, plastic
    /// strain / yield strain.
    pub weakening: f64,
    /// Strain in any direction beyond which the stretch stays; above 0, infinite = every stretch is elastic.
    pub yield_strain: f64,
}

impl Plasticity {
    /// Nothing yields.
    pub const NONE: Plasticity =
        Plasticity { yield_curvature_1_m: f64::INFINITY, hardening: 0.0, weakening: 0.0, yield_strain: f64::INFINITY };
}

impl Fabric {
    /// A fabric with the same stiffness at every strain, direction and curvature. `stretching_n_m` = warp, cross, weft,
    /// shear.
    pub fn uniform(name: &str, density_kg_m2: f64, stretching_n_m: [f64; 4], bending_n_m: f64) -> Fabric {
        Fabric {
            name: name.into(),
            density_kg_m2,
            stretching_n_m: [stretching_n_m; 6],
            bending_n_m: [[bending_n_m; 5]; 3],
            damping_s: 0.0,
            plasticity: None,
            strain_limit: None,
        }
    }

    /// The preset with this name, if there is one.
    pub fn preset(name: &str) -> Option<Fabric> {
        PRESETS.iter().find(|preset| preset.0 == name).map(|&(name, density, stretching, bending)| Fabric {
            bending_n_m: bending.map(|row| [row; 5]),
            ..Fabric::uniform(name, density, stretching, 0.0)
        })
    }

    /// Names of the presets.
    pub fn preset_names() -> impl Iterator<Item = &'static str> {
        PRESETS.iter().map(|preset| preset.0)
    }

    /// The fabric at `factor` times the thickness. Density, stretching and bending are multiplied by `factor`, as in
    /// ARCSim.
    pub fn thickened(&self, factor: f64) -> Fabric {
        self.scaled(factor, factor, factor)
    }

    /// Multiplies density, stretching and bending.
    pub(super) fn scaled(&self, density: f64, stretching: f64, bending: f64) -> Fabric {
        Fabric {
            density_kg_m2: self.density_kg_m2 * density,
            stretching_n_m: self.stretching_n_m.map(|row| row.map(|k| k * stretching)),
            bending_n_m: self.bending_n_m.map(|row| row.map(|k| k * bending)),
            ..self.clone()
        }
    }

    /// True if folds of the fabric stay beyond a curvature.
    pub fn creases(&self) -> bool {
        self.plasticity.is_some_and(|plasticity| plasticity.yield_curvature_1_m < f64::INFINITY)
    }

    /// True if stretches of the fabric stay beyond a strain.
    pub fn stays_stretched(&self) -> bool {
        self.plasticity.is_some_and(|plasticity| plasticity.yield_strain < f64::INFINITY)
    }

    /// Checks the values. An error names the table entry, counted from 1.
    pub fn check(&self) -> Result<(), String> {
        let usable = |value: f64| (value as f32).is_finite();
        if !(usable(self.density_kg_m2) && self.density_kg_m2 > 0.0) {
            return Err(format!("the density must be a number above 0 (kg/m^2), not {}", self.density_kg_m2));
        }
        if !(usable(self.damping_s) && self.damping_s >= 0.0) {
            return Err(format!("the damping must be a number of at least 0 (s), not {}", self.damping_s));
        }
        if let Some(Plasticity { yield_curvature_1_m, hardening, weakening, yield_strain }) = self.plasticity {
            let yields = |value: f64| value == f64::INFINITY || usable(value) && value as f32 > 0.0;
            if !yields(yield_curvature_1_m) {
                return Err(format!("the yield curvature must be a number above 0 (1/m), not {yield_curvature_1_m}"));
            }
            if !yields(yield_strain) {
                return Err(format!("the yield strain must be a number above 0, not {yield_strain}"));
            }
            for (what, value) in [("hardening", hardening), ("weakening", weakening)] {
                if !(usable(value) && value >= 0.0) {
                    return Err(format!("the {what} must be a number of at least 0, not {value}"));
                }
            }
        }
        self.strain_limit.as_ref().map_or(Ok(()), StrainLimit::check)?;
        for (row, values) in self.stretching_n_m.iter().enumerate() {
            if let Some(column) = values.iter().position(|&k| !usable(k)) {
                return Err(format!("stretching row {}, column {} must be a finite number", row + 1, column + 1));
            }
        }
        for (row, values) in self.bending_n_m.iter().enumerate() {
            if let Some(column) = values.iter().position(|&k| !usable(k) || k < 0.0) {
                return Err(format!("bending row {}, column {} must be a number of at least 0", row + 1, column + 1));
            }
        }
        // The fabric must resist at rest, because an implicit step needs a force.
        if let Some(column) = [0, 2].into_iter().find(|&column| self.stretching_n_m[0][column] <= 0.0) {
            return Err(format!("stretching row 1, column {} (at rest) must be above 0", column + 1));
        }
        Ok(())
    }
}

/// Name, density kg/m^2, stretching N/m, bending N m along warp, at 45 degrees, along weft.
type Preset = (&'static str, f64, [f64; 4], [f64; 3]);

const PRESETS: [Preset; 6] = [
    ("cotton", 0.15, [480.0, 45.0, 420.0, 70.0], [3.0e-5, 2.2e-5, 2.6e-5]),
    ("silk", 0.06, [320.0, 30.0, 280.0, 30.0], [6.0e-6, 4.0e-6, 5.0e-6]),
    ("denim", 0.36, [1300.0, 60.0, 1050.0, 130.0], [3.2e-4, 2.2e-4, 2.7e-4]),
    ("wool", 0.26, [160.0, 40.0, 130.0, 45.0], [6.0e-5, 4.5e-5, 5.5e-5]),
    ("nylon", 0.07, [900.0, 60.0, 900.0, 90.0], [1.5e-5, 1.0e-5, 1.5e-5]),
    // Young's modulus times thickness 700 N/m, Poisson's ratio 0.3; shear is 4 G, so that the energy
    // (k0 Exx^2 + 2 k1 Exx Eyy + k2 Eyy^2 + k3 Exy^2) / 2 with the tensor's Exy does not depend on direction.
    ("membrane", 0.2, [769.2308, 230.7692, 769.2308, 1076.9231], [1.0e-6, 1.0e-6, 1.0e-6]),
];

/// Reads a measured fabric in ARCSim's JSON form [Wang et al. 2011]: `density`, `stretching` (6x4), `bending` (3x5).
pub fn load_fabric(path: &Path) -> Result<Fabric, SceneError> {
    parse_fabric(&read_text(path)?, path)
}

/// Reads a fabric from the text of the file at `path`.
pub fn parse_fabric(text: &str, path: &Path) -> Result<Fabric, SceneError> {
    let value = parse_json(text, path)?;
    let json = Json::root(path, &value);
    let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
    let fabric = Fabric {
        name,
        density_kg_m2: json.required("density")?.number()?,
        stretching_n_m: json.required("stretching")?.table()?,
        bending_n_m: json.required("bending")?.table()?,
        damping_s: json.or("damping", 0.0, |value| value.number())?,
        plasticity: None,
        strain_limit: None,
    };
    fabric.check().map_err(|what| SceneError::File { path: path.into(), what })?;
    Ok(fabric)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_pass_their_own_check() {
        for name in Fabric::preset_names() {
            assert_eq!(Fabric::preset(name).unwrap().check(), Ok(()), "{name}");
        }
        assert_eq!(Fabric::preset("coton"), None);
    }

    #[test]
    fn the_membrane_is_isotropic() {
        let [warp, cross, weft, shear] = Fabric::preset("membrane").unwrap().stretching_n_m[0];
        assert_eq!(warp, weft);
        // The energy of a uniaxial strain along the diagonal (all three entries 1/2) must equal that along the warp.
        let diagonal = (warp + 2.0 * cross + weft + shear) / 4.0;
        assert!((diagonal - warp).abs() < 1e-3);
    }

    #[test]
    fn thickening_multiplies_all_three() {
        let thick = Fabric::uniform("f", 0.1, [1.0, 2.0, 3.0, 4.0], 5.0).thickened(2.0);
        assert_eq!(thick, Fabric::uniform("f", 0.2, [2.0, 4.0, 6.0, 8.0], 10.0));
    }

    fn fault(text: &str) -> String {
        parse_fabric(text, Path::new("f.json")).unwrap_err().to_string()
    }

    #[test]
    fn faults_are_sentences() {
        let stretching = "[[1,0,1,1],[1,0,1,1],[1,0,1,1],[1,0,1,1],[1,0,1,1],[1,0,1,1]]";
        let bending = "[[1,1,1,1,1],[1,1,1,1,1],[1,1,1,1,1]]";
        let file =
            |density: &str| format!("// thin\n{{density: {density}, stretching: {stretching}, bending: {bending}}}");
        assert_eq!(parse_fabric(&file("0.5"), Path::new("f.json")).unwrap().density_kg_m2, 0.5);
        assert_eq!(fault(&file("-1")), "f.json: the density must be a number above 0 (kg/m^2), not -1");
        assert_eq!(fault("{density: 1}"), "f.json: field `stretching`: is missing");
        assert_eq!(
            fault(&file("1").replace("[1,0,1,1],", "[1,0,1],")),
            "f.json: field `stretching`: must be a table of 6 rows of 4 numbers"
        );
        assert_eq!(
            fault(&file("1").replace("1,1,1,1,1", "1,1,-1,1,1")),
            "f.json: bending row 1, column 3 must be a number of at least 0"
        );
    }
}
