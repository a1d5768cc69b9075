//! Transforms of Alembic files (`AbcGeom_Xform_v3`): a list of operations whose numbers have samples.

use crate::math::{DAffine3, DMat3, DQuat, DVec3};

use super::ogawa::{Archive, BOOL, Compound, F64, Property, U8};
use crate::scene::sampled::around;

/// A transform of an object into the coordinates of the one above it.
pub(super) struct Transform {
    /// False: it places the object in the world, whatever stands above.
    pub inherits: bool,
    /// Times of the samples, seconds.
    pub times_s: Vec<f64>,
    operations: Vec<Operation>,
    /// Numbers of all operations, by sample.
    values: Vec<Vec<f64>>,
}

/// The first operation is the outermost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Operation {
    Scale,
    Translate,
    /// An axis and an angle.
    Rotate,
    Matrix,
    /// About an axis of the coordinates.
    RotateAxis(usize),
}

impl Operation {
    /// The number of an operation stands in the high half of its byte.
    fn read(byte: u8) -> Option<Operation> {
        match byte >> 4 {
            0 => Some(Operation::Scale),
            1 => Some(Operation::Translate),
            2 => Some(Operation::Rotate),
            3 => Some(Operation::Matrix),
            axis @ 4..=6 => Some(Operation::RotateAxis(usize::from(axis) - 4)),
            _ => None,
        }
    }

    fn numbers(self) -> usize {
        match self {
            Operation::Scale | Operation::Translate => 3,
            Operation::Rotate => 4,
            Operation::Matrix => 16,
            Operation::RotateAxis(_) => 1,
        }
    }

    fn matrix(self, numbers: &[f64]) -> DAffine3 {
        match self {
            Operation::Scale => DAffine3::from_scale(DVec3::from_slice(numbers)),
            Operation::Translate => DAffine3::from_translation(DVec3::from_slice(numbers)),
            Operation::Rotate => match DVec3::from_slice(numbers).try_normalize() {
                Some(axis) => DAffine3::from_axis_angle(axis, numbers[3].to_radians()),
                None => DAffine3::IDENTITY,
            },
            // Row by row, for points that are rows.
            Operation::Matrix => {
                let row = |i: usize| DVec3::from_slice(&numbers[4 * i..]);
                DAffine3 { matrix3: DMat3::from_cols(row(0), row(1), row(2)), translation: row(3) }
            }
            Operation::RotateAxis(axis) => DAffine3::from_quat(DQuat::from_axis_angle(
                DVec3::from_array(std::array::from_fn(|i| f64::from(u8::from(i == axis)))),
                numbers[0].to_radians(),
            )),
        }
    }
}

impl Transform {
    /// Reads the transform of the object `path`. An error is half a sentence.
    pub(super) fn read(archive: &Archive, properties: &Compound, path: &str) -> Result<Transform, String> {
        let mut transform = Transform { inherits: true, times_s: vec![0.0], operations: vec![], values: vec![vec![]] };
        let Some(inner) = properties.compound(archive, ".xform")? else { return Ok(transform) };
        let samples = |name: &str| inner.property(archive, name).filter(|property| property.samples() > 0);
        if let Some(inherits) = samples(".inherits") {
            transform.inherits = inherits.bytes(0, BOOL)?.first() != Some(&0);
        }
        let (Some(operations), Some(values)) = (samples(".ops"), samples(".vals")) else { return Ok(transform) };
        let unknown = || format!("has a transform of an unknown kind: `{path}`");
        let operations = operations.bytes(0, U8)?.iter().map(|&byte| Operation::read(byte));
        transform.operations = operations.collect::<Option<Vec<Operation>>>().ok_or_else(unknown)?;
        let needed: usize = transform.operations.iter().map(|operation| operation.numbers()).sum();
        transform.values = (0..values.samples()).map(|i| numbers(&values, i)).collect::<Result<_, String>>()?;
        if transform.values.iter().any(|numbers| numbers.len() < needed || numbers.iter().any(|x| !x.is_finite())) {
            return Err(format!("has a transform whose numbers are missing or not finite: `{path}`"));
        }
        transform.times_s = values.times_s();
        Ok(transform)
    }

    /// True if its samples differ.
    pub(super) fn moves(&self) -> bool {
        self.values.iter().any(|numbers| *numbers != self.values[0])
    }

    /// The transform at a time. Numbers are interpolated, not matrices.
    pub(super) fn at(&self, time_s: f64) -> DAffine3 {
        let (before, after, share) = around(&self.times_s, time_s);
        let pairs = self.values[before].iter().zip(&self.values[after]);
        let numbers: Vec<f64> = pairs.map(|(a, b)| if share > 0.0 { a + share * (b - a) } else { *a }).collect();
        let mut all = DAffine3::IDENTITY;
        let mut first = 0;
        for operation in &self.operations {
            all = all * operation.matrix(&numbers[first..]);
            first += operation.numbers();
        }
        all
    }
}

fn numbers(property: &Property, sample: usize) -> Result<Vec<f64>, String> {
    Ok(property.bytes(sample, F64)?.as_chunks::<8>().0.iter().map(|word| f64::from_le_bytes(*word)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_operation_is_the_outermost() {
        let operations = [0x10, 0x50, 0x00].map(|byte| Operation::read(byte).unwrap()).to_vec();
        assert_eq!(operations, [Operation::Translate, Operation::RotateAxis(1), Operation::Scale]);
        let values = [0.0, 1.0].map(|x| vec![5.0 * x, 0.0, 0.0, 90.0 * x, 2.0, 2.0, 2.0]).to_vec();
        let transform = Transform { inherits: true, times_s: vec![0.0, 1.0], operations, values };
        assert!(transform.moves());
        let end = transform.at(1.0).transform_point3(DVec3::X);
        assert!(end.distance(DVec3::new(5.0, 0.0, -2.0)) < 1e-12, "{end}");
        let half = transform.at(0.5).transform_point3(DVec3::X);
        assert!(half.distance(DVec3::new(2.5 + 2f64.sqrt(), 0.0, -(2f64.sqrt()))) < 1e-12, "{half}");
        assert_eq!(Operation::read(0x70), None);
    }

    #[test]
    fn matrices_are_row_by_row() {
        let numbers: Vec<f64> = [0., 1., 0., 0., -1., 0., 0., 0., 0., 0., 1., 0., 7., 8., 9., 1.].into();
        let moved = Operation::Matrix.matrix(&numbers).transform_point3(DVec3::X);
        assert_eq!(moved, DVec3::new(7.0, 9.0, 9.0));
        let turned = Operation::Rotate.matrix(&[0.0, 0.0, 2.0, 90.0]).transform_point3(DVec3::X);
        assert!(turned.distance(DVec3::Y) < 1e-12);
    }
}
