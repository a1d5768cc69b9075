//! Vertices, skins and triangles of a primitive.

use ::gltf::json::mesh::{Mode, Primitive, Semantic};
use ::gltf::json::validation::Checked;
use ::gltf::json::{self, Index};

use super::accessor::Numbers;
use super::{Document, entry};
use crate::math::{DAffine3, DMat3, DVec3};
use crate::scene::rig::{RigPart, Skin};

/// The transform of a matrix that is given column by column.
pub(super) fn affine(m: &[f64]) -> DAffine3 {
    let column = |i: usize| DVec3::from_slice(&m[4 * i..]);
    DAffine3 { matrix3: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) }
}

/// Joints and inverse bind matrices of a skin.
pub(super) fn skin(
    document: &Document,
    index: &Index<json::Skin>,
    place: &[u32],
) -> Result<(Vec<u32>, Vec<DAffine3>), String> {
    let of = format!("skin {index}");
    let skin = entry(&document.root.skins, index, "skin", "a node")?;
    let joint =
        |joint: &Index<json::Node>| entry(&document.root.nodes, joint, "node", &of).map(|_| place[joint.value()]);
    let joints = skin.joints.iter().map(joint).collect::<Result<Vec<u32>, String>>()?;
    let inverse_bind = match &skin.inverse_bind_matrices {
        None => vec![DAffine3::IDENTITY; joints.len()],
        Some(accessor) => {
            let numbers = document.numbers(accessor, 16, Numbers::Real, &format!("inverse bind matrices of {of}"))?;
            numbers.chunks_exact(16).map(affine).collect()
        }
    };
    match joints.len() {
        0 => Err(format!("{of} has no joints")),
        count if inverse_bind.len() < count => {
            Err(format!("{of} has {count} joints, but {} inverse bind matrices", inverse_bind.len()))
        }
        count => Ok((joints, inverse_bind[..count].to_vec())),
    }
}

/// Points and displacements of a primitive.
pub(super) fn points(
    document: &Document,
    primitive: &Primitive,
    values: &mut Vec<f32>,
    of: &str,
) -> Result<RigPart, String> {
    let positions = primitive.attributes.get(&Checked::Valid(Semantic::Positions));
    let positions = positions.ok_or_else(|| format!("{of} has no POSITION"))?;
    let numbers = document.numbers(positions, 3, Numbers::Real, &format!("POSITION of {of}"))?;
    let vertices = numbers.len() / 3;
    values.extend(numbers.iter().map(|&x| x as f32));
    let targets = primitive.targets.as_deref().unwrap_or_default();
    for (i, target) in targets.iter().enumerate() {
        match &target.positions {
            None => values.resize(values.len() + 3 * vertices, 0.0),
            Some(accessor) => {
                let numbers = document.numbers(accessor, 3, Numbers::Real, &format!("morph target {i} of {of}"))?;
                if numbers.len() != 3 * vertices {
                    return Err(format!("morph target {i} of {of} has {} vertices, not {vertices}", numbers.len() / 3));
                }
                values.extend(numbers.iter().map(|&x| x as f32));
            }
        }
    }
    Ok(RigPart { node: 0, vertices, points: 0, targets: targets.len(), skin: None })
}

/// Joints and weights of the vertices of a primitive, any number of sets of four.
pub(super) fn carriers(
    document: &Document,
    primitive: &Primitive,
    vertices: usize,
    joints: &[u32],
    inverse_bind: &[DAffine3],
    values: &mut Vec<f32>,
    of: &str,
) -> Result<Skin, String> {
    let mut sets = Vec::new();
    for set in 0.. {
        let attribute = |semantic| primitive.attributes.get(&Checked::Valid(semantic));
        let (numbers, weights) = match (attribute(Semantic::Joints(set)), attribute(Semantic::Weights(set))) {
            (None, None) if set > 0 => break,
            (Some(numbers), Some(weights)) => (numbers, weights),
            _ => return Err(format!("{of} has a skin, but not both JOINTS_{set} and WEIGHTS_{set}")),
        };
        let numbers = document.numbers(numbers, 4, Numbers::Whole, &format!("JOINTS_{set} of {of}"))?;
        let weights = document.numbers(weights, 4, Numbers::Real, &format!("WEIGHTS_{set} of {of}"))?;
        if [numbers.len(), weights.len()] != [4 * vertices; 2] {
            return Err(format!("{of} has {vertices} vertices, but not as many JOINTS_{set} and WEIGHTS_{set}"));
        }
        sets.push((numbers, weights));
    }
    let influences = 4 * sets.len();
    let mut all = Vec::with_capacity(vertices * influences);
    let carriers = values.len();
    for vertex in 0..vertices {
        let own = sets
            .iter()
            .flat_map(|(numbers, weights)| numbers[4 * vertex..][..4].iter().zip(&weights[4 * vertex..][..4]));
        let own: Vec<(f64, f64)> = own.map(|(&joint, &weight)| (joint, weight)).collect();
        let sum: f64 = own.iter().map(|(_, weight)| weight).sum();
        if sum <= 0.0 {
            return Err(format!("vertex {vertex} (from 0) of {of} hangs on no joint: its weights are 0"));
        }
        for (joint, weight) in own {
            if weight != 0.0 && joint >= joints.len() as f64 {
                return Err(format!(
                    "vertex {vertex} (from 0) of {of} names joint {joint}, but its skin has only {}",
                    joints.len()
                ));
            }
            values.push(if weight != 0.0 { joint as f32 } else { 0.0 });
            all.push((weight / sum) as f32);
        }
    }
    let weights = values.len();
    values.extend(all);
    Ok(Skin { joints: joints.to_vec(), inverse_bind: inverse_bind.to_vec(), influences, carriers, weights })
}

pub(super) fn triangles(
    document: &Document,
    primitive: &Primitive,
    mode: Mode,
    vertices: usize,
    of: &str,
) -> Result<Vec<[u32; 3]>, String> {
    let indices: Vec<u32> = match &primitive.indices {
        None => (0..vertices as u32).collect(),
        Some(accessor) => {
            let numbers = document.numbers(accessor, 1, Numbers::Whole, &format!("indices of {of}"))?;
            numbers.iter().map(|&x| x as u32).collect()
        }
    };
    let triangles: Vec<[u32; 3]> = match mode {
        Mode::Triangles => indices.as_chunks::<3>().0.to_vec(),
        // Every second triangle of a strip is wound the other way.
        Mode::TriangleStrip => {
            let turned = |(i, w): (usize, &[u32])| [w[0], w[1 + i % 2], w[2 - i % 2]];
            indices.windows(3).enumerate().map(turned).collect()
        }
        _ => indices.windows(2).skip(1).map(|pair| [pair[0], pair[1], indices[0]]).collect(),
    };
    let beyond = |corners: &[u32; 3]| corners.iter().any(|&v| v as usize >= vertices);
    if let Some(t) = triangles.iter().position(beyond) {
        let vertex = triangles[t].iter().find(|&&v| v as usize >= vertices).copied().unwrap_or_default();
        return Err(format!("triangle {t} (from 0) of {of} names vertex {vertex}, but there are only {vertices}"));
    }
    // Exporters close strips with triangles that have a vertex twice.
    let is_flat = |t: &[u32; 3]| t[0] == t[1] || t[1] == t[2] || t[2] == t[0];
    Ok(triangles.into_iter().filter(|corners| mode == Mode::Triangles || !is_flat(corners)).collect())
}
