//! Values of attributes as numbers. Other types than these are not written by anybody for what is read here.

use openusd::gf;
use openusd::sdf::Value;
use openusd::usd::{Attribute, TimeCode};

use crate::math::{DAffine3, DMat3, DQuat, DVec3, Vec3};

/// The sentence of an error with its causes, without line breaks.
pub(super) fn one_line(error: &impl std::fmt::Display) -> String {
    format!("{error:#}").split_whitespace().collect::<Vec<&str>>().join(" ")
}

/// An error of the crate as half a sentence.
pub(super) fn broken(error: impl std::fmt::Display) -> String {
    format!("is damaged: {}", one_line(&error))
}

/// The value at a time code; without one the value that does not depend on time.
pub(super) fn value(attribute: &Attribute, code: Option<f64>) -> Result<Option<Value>, String> {
    let found = attribute.get_at::<Value>(code.map(TimeCode::new)).map_err(broken)?;
    Ok(found.filter(|value| !matches!(value, Value::None | Value::ValueBlock)))
}

pub(super) fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Double(x) => Some(*x),
        Value::Float(x) => Some(f64::from(*x)),
        Value::Half(x) => Some(f64::from(x.to_f32())),
        Value::Int(x) => Some(f64::from(*x)),
        Value::Int64(x) => Some(*x as f64),
        _ => None,
    }
}

pub(super) fn vector(value: &Value) -> Option<DVec3> {
    let vector = |v: [f32; 3]| DVec3::from_array(v.map(f64::from));
    match value {
        Value::Vec3d(v) => Some(DVec3::from_array((*v).into())),
        Value::Vec3f(v) => Some(vector((*v).into())),
        Value::Vec3h(v) => Some(vector([v.x.to_f32(), v.y.to_f32(), v.z.to_f32()])),
        _ => None,
    }
}

pub(super) fn rotation(value: &Value) -> Option<DQuat> {
    let of = |[w, x, y, z]: [f64; 4]| DQuat::from_xyzw(x, y, z, w);
    match value {
        Value::Quatd(q) => Some(of([q.w, q.x, q.y, q.z])),
        Value::Quatf(q) => Some(of([q.w, q.x, q.y, q.z].map(f64::from))),
        Value::Quath(q) => Some(of([q.w, q.x, q.y, q.z].map(|x| f64::from(x.to_f32())))),
        _ => None,
    }
}

/// A matrix for points that are rows, as one for points that are columns.
pub(super) fn affine(matrix: &gf::Matrix4d) -> DAffine3 {
    let row = |i: usize| DVec3::from_slice(&matrix.0[4 * i..]);
    DAffine3 { matrix3: DMat3::from_cols(row(0), row(1), row(2)), translation: row(3) }
}

pub(super) fn vectors(value: Value) -> Option<Vec<Vec3>> {
    match value {
        Value::Vec3fVec(all) => Some(all.into_iter().map(|v| Vec3::from_array(v.into())).collect()),
        Value::Vec3dVec(all) => Some(all.into_iter().map(|v| DVec3::from_array(v.into()).as_vec3()).collect()),
        Value::Vec3hVec(all) => Some(all.iter().map(|v| Vec3::new(v.x.to_f32(), v.y.to_f32(), v.z.to_f32())).collect()),
        _ => None,
    }
}

/// Rotations as xyzw.
pub(super) fn rotations(value: Value) -> Option<Vec<[f32; 4]>> {
    match value {
        Value::QuatfVec(all) => Some(all.iter().map(|q| [q.x, q.y, q.z, q.w]).collect()),
        Value::QuathVec(all) => Some(all.iter().map(|q| [q.x, q.y, q.z, q.w].map(|x| x.to_f32())).collect()),
        Value::QuatdVec(all) => Some(all.iter().map(|q| [q.x, q.y, q.z, q.w].map(|x| x as f32)).collect()),
        _ => None,
    }
}

pub(super) fn floats(value: Value) -> Option<Vec<f32>> {
    match value {
        Value::FloatVec(all) => Some(all),
        Value::DoubleVec(all) => Some(all.iter().map(|&x| x as f32).collect()),
        Value::HalfVec(all) => Some(all.iter().map(|x| x.to_f32()).collect()),
        _ => None,
    }
}

pub(super) fn integers(value: Value) -> Option<Vec<i32>> {
    match value {
        Value::IntVec(all) => Some(all),
        _ => None,
    }
}

pub(super) fn affines(value: Value) -> Option<Vec<DAffine3>> {
    match value {
        Value::Matrix4dVec(all) => Some(all.iter().map(affine).collect()),
        _ => None,
    }
}

pub(super) fn words(value: Value) -> Option<Vec<String>> {
    match value {
        Value::TokenVec(all) => Some(all.iter().map(|word| word.as_str().to_owned()).collect()),
        Value::StringVec(all) => Some(all),
        _ => None,
    }
}
