//! Transforms of USD prims: the list `xformOpOrder` of operations, whose values may have samples.

use openusd::sdf::Value;
use openusd::usd::Prim;

use super::value::{self, broken};
use crate::math::{DAffine3, DMat3, DQuat, DVec3};
use crate::scene::rig_track::{slerp, unit};
use crate::scene::sampled::around;

/// The transform of a prim into the coordinates of the stage.
pub(super) struct Placing {
    /// Operations of the prims from the top down, each from the outermost in.
    operations: Vec<Operation>,
    /// Time codes of all samples, ascending; empty if it does not move.
    pub codes: Vec<f64>,
}

struct Operation {
    /// What it does, such as `rotateXYZ`.
    kind: String,
    is_inverse: bool,
    /// Time codes of its samples, and their values; none for an operation without a value, which does nothing.
    codes: Vec<f64>,
    amounts: Vec<Amount>,
}

/// The value of an operation.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Amount {
    Number(f64),
    Vector(DVec3),
    Rotation(DQuat),
    Matrix(DAffine3),
}

impl Amount {
    fn read(found: &Value) -> Option<Amount> {
        if let Value::Matrix4d(matrix) = found {
            return Some(Amount::Matrix(value::affine(matrix)));
        }
        let number = value::number(found).map(Amount::Number);
        let vector = || value::vector(found).map(Amount::Vector);
        let rotation = || value::rotation(found).map(|rotation| Amount::Rotation(unit(rotation)));
        number.or_else(vector).or_else(rotation)
    }

    /// Between two samples numbers change evenly, also those of a matrix; rotations turn evenly the shorter way.
    fn between(self, other: Amount, share: f64) -> Amount {
        match (self, other) {
            (Amount::Number(a), Amount::Number(b)) => Amount::Number(a + share * (b - a)),
            (Amount::Vector(a), Amount::Vector(b)) => Amount::Vector(a + share * (b - a)),
            (Amount::Rotation(a), Amount::Rotation(b)) => Amount::Rotation(slerp(a, b, share)),
            (Amount::Matrix(a), Amount::Matrix(b)) => {
                let even = |a: DVec3, b: DVec3| a + share * (b - a);
                let (from, to) = (a.matrix3, b.matrix3);
                let matrix3 = DMat3::from_cols(
                    even(from.x_axis, to.x_axis),
                    even(from.y_axis, to.y_axis),
                    even(from.z_axis, to.z_axis),
                );
                Amount::Matrix(DAffine3 { matrix3, translation: even(a.translation, b.translation) })
            }
            _ => self,
        }
    }
}

impl Placing {
    /// Reads the transform of a prim and of those above it. An error is half a sentence.
    pub(super) fn of(prim: &Prim) -> Result<Placing, String> {
        let mut operations = Vec::new();
        let mut paths: Vec<_> = prim.path().ancestors_below_root().collect();
        paths.reverse();
        for path in paths {
            let prim = prim.stage().prim(path);
            let order = value::value(&prim.attribute("xformOpOrder"), None)?.and_then(value::words);
            for (i, name) in order.unwrap_or_default().iter().enumerate() {
                if name == "!resetXformStack!" {
                    // What stands above does not count.
                    operations.clear();
                    if i > 0 {
                        return Err(format!("has a transform that is reset in its middle: {}", prim.path()));
                    }
                    continue;
                }
                let (is_inverse, name) = match name.strip_prefix("!invert!") {
                    Some(name) => (true, name),
                    None => (false, &name[..]),
                };
                let kind = name.strip_prefix("xformOp:").and_then(|rest| rest.split(':').next());
                let kind = kind.ok_or_else(|| format!("has a transform `{name}` that USD does not know"))?.to_owned();
                operations.push(Operation::read(&prim, name, kind, is_inverse)?);
            }
        }
        let moving = operations.iter().filter(|operation| operation.codes.len() > 1);
        let mut codes: Vec<f64> = moving.flat_map(|operation| operation.codes.iter().copied()).collect();
        codes.sort_by(f64::total_cmp);
        codes.dedup();
        Ok(Placing { operations, codes })
    }

    /// The transform at a time code.
    pub(super) fn at(&self, code: f64) -> Result<DAffine3, String> {
        let mut all = DAffine3::IDENTITY;
        for operation in &self.operations {
            all = all * operation.at(code);
        }
        if all.is_finite() { Ok(all) } else { Err(format!("has a transform that is not finite at time code {code}")) }
    }
}

impl Operation {
    fn read(prim: &Prim, name: &str, kind: String, is_inverse: bool) -> Result<Operation, String> {
        let attribute = prim.attribute(name);
        let mut codes = attribute.time_sample_times().map_err(broken)?;
        let at: Vec<Option<f64>> = match codes.is_empty() {
            true => vec![None],
            false => codes.iter().copied().map(Some).collect(),
        };
        let mut amounts = Vec::with_capacity(at.len());
        for code in at {
            let Some(found) = value::value(&attribute, code)? else { continue };
            let amount = Amount::read(&found).filter(|amount| matrix(&kind, *amount).is_some());
            let wrong = || format!("has a transform that cannot be read: {}", attribute.path());
            amounts.push(amount.ok_or_else(wrong)?);
        }
        if amounts.len() != codes.len() {
            codes = vec![0.0; amounts.len().min(1)];
            amounts.truncate(1);
        }
        Ok(Operation { kind, is_inverse, codes, amounts })
    }

    fn at(&self, code: f64) -> DAffine3 {
        if self.amounts.is_empty() {
            return DAffine3::IDENTITY;
        }
        let (before, after, share) = around(&self.codes, code);
        let amount = self.amounts[before].between(self.amounts[after], share);
        let matrix = matrix(&self.kind, amount).unwrap_or(DAffine3::IDENTITY);
        if self.is_inverse { matrix.inverse() } else { matrix }
    }
}

/// The matrix of an operation; none if it has a value of another type, or is not known.
fn matrix(kind: &str, amount: Amount) -> Option<DAffine3> {
    let axis = |letter: char| match letter {
        'X' => Some(DVec3::X),
        'Y' => Some(DVec3::Y),
        'Z' => Some(DVec3::Z),
        _ => None,
    };
    let along = |kind: &str| kind.chars().next().filter(|_| kind.len() == 1).and_then(axis);
    let about = |axis: DVec3, degrees: f64| DQuat::from_axis_angle(axis, degrees.to_radians());
    if let Some(rest) = kind.strip_prefix("translate") {
        return match (rest, amount) {
            ("", Amount::Vector(by)) => Some(DAffine3::from_translation(by)),
            (_, Amount::Number(by)) => Some(DAffine3::from_translation(along(rest)? * by)),
            _ => None,
        };
    }
    if let Some(rest) = kind.strip_prefix("scale") {
        return match (rest, amount) {
            ("", Amount::Vector(by)) => Some(DAffine3::from_scale(by)),
            (_, Amount::Number(by)) => Some(DAffine3::from_scale(DVec3::ONE + along(rest)? * (by - 1.0))),
            _ => None,
        };
    }
    if let Some(rest) = kind.strip_prefix("rotate") {
        return match amount {
            Amount::Number(degrees) => Some(DAffine3::from_quat(about(along(rest)?, degrees))),
            Amount::Vector(degrees) if rest.len() == 3 => {
                // The axis that is named first turns first.
                let mut all = DQuat::IDENTITY;
                for letter in rest.chars() {
                    let axis = axis(letter)?;
                    all = about(axis, degrees.dot(axis)) * all;
                }
                Some(DAffine3::from_quat(all))
            }
            _ => None,
        };
    }
    match (kind, amount) {
        ("orient", Amount::Rotation(rotation)) => Some(DAffine3::from_quat(rotation)),
        ("transform", Amount::Matrix(matrix)) => Some(matrix),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use openusd::gf;

    #[test]
    fn operations_move_points() {
        let read = |kind: &str, found: Value| matrix(kind, Amount::read(&found)?);
        let moved = |kind: &str, found: Value, p: DVec3| read(kind, found).unwrap().transform_point3(p);
        let three = |x, y, z| Value::Vec3f(gf::Vec3f { x, y, z });
        assert_eq!(moved("translate", three(1.0, 2.0, 3.0), DVec3::X), DVec3::new(2.0, 2.0, 3.0));
        assert_eq!(moved("translateY", Value::Double(2.0), DVec3::X), DVec3::new(1.0, 2.0, 0.0));
        assert_eq!(moved("scaleZ", Value::Float(3.0), DVec3::ONE), DVec3::new(1.0, 1.0, 3.0));
        // First about x, which leaves x alone, then about y.
        let turned = moved("rotateXYZ", three(90.0, 90.0, 0.0), DVec3::Y);
        assert!(turned.distance(DVec3::X) < 1e-12, "{turned}");
        let turned = moved("rotateZYX", three(90.0, 90.0, 0.0), DVec3::X);
        assert!(turned.distance(DVec3::Y) < 1e-12, "{turned}");
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let turned = moved("orient", Value::Quatf(gf::Quatf { w: half, x: 0.0, y: 0.0, z: half }), DVec3::X);
        assert!(turned.distance(DVec3::Y) < 1e-7, "{turned}");
        for unknown in ["rotateXYA", "rotateXY", "shear", "scaleQ"] {
            assert!(read(unknown, three(1.0, 1.0, 1.0)).is_none(), "{unknown}");
        }
    }
}
