//! The person as a body with joints: its surface, who carries its vertices, and its clips as keys.

use std::collections::BTreeSet;

use super::anatomy::{JOINTS, flesh, skeleton};
use super::clips::{CLIPS, Clip, Pose};
use super::cone::{Cone, blended, bounds};
use crate::math::{DAffine3, DQuat, DVec3};
use crate::mesh::Surface;
use crate::mesh::level_set::LevelSet;
use crate::scene::gltf::{BodyFile, MadeBody, MadeClip};
use crate::scene::rig::{Node, RigPart, Skin};
use crate::scene::rig_track::{Interpolation, Pose as NodePose, Property, Track};

/// Joints per vertex.
const INFLUENCES: usize = 4;
/// Over this length a vertex passes from one joint to the next, meters.
const BLEND_M: f64 = 0.02;
/// Weights are evened out over about this length, meters.
const EVEN_M: f64 = 0.05;
/// Most rounds of that.
const EVEN_ROUNDS: f64 = 400.0;
/// Keys of a clip per second; between them splines have the slopes of the formulas.
const KEYS_PER_S: f64 = 24.0;
/// Time over which slopes are taken, seconds.
const SLOPE_S: f64 = 1e-4;

/// The person with about `triangles` triangles; none if no surface of so few is one that closes.
pub(crate) fn person(triangles: f64) -> Option<BodyFile> {
    let flesh = flesh();
    let cones: Vec<Cone> = flesh.iter().map(|(_, cone)| *cone).collect();
    let inside = |p: DVec3| blended(&cones, p);
    let surface = LevelSet { inside: &inside, keep: None, bounds: bounds(&cones) }.mesh(triangles)?;
    let weights = evened(&surface, surface.positions.iter().map(|p| first_weights(&flesh, p.as_dvec3())).collect());
    let joints = skeleton();
    let mut nodes: Vec<Node> = joints
        .iter()
        .map(|joint| {
            let from = joint.parent.map_or(DVec3::ZERO, |parent| joints[parent].at);
            Node { parent: joint.parent.map(|parent| parent as u32), ..node(joint.at - from) }
        })
        .collect();
    nodes.push(node(DVec3::ZERO));
    let mut values: Vec<f32> = surface.positions.iter().flat_map(|p| p.to_array()).collect();
    let carriers = values.len();
    let carried: Vec<[(usize, f32); INFLUENCES]> = weights.iter().map(strongest).collect();
    values.extend(carried.as_flattened().iter().map(|(joint, _)| *joint as f32));
    let weights = values.len();
    values.extend(carried.as_flattened().iter().map(|(_, weight)| *weight));
    let skin = Skin {
        joints: (0..JOINTS as u32).collect(),
        inverse_bind: joints.iter().map(|joint| DAffine3::from_translation(-joint.at)).collect(),
        influences: INFLUENCES,
        carriers,
        weights,
    };
    let vertices = surface.positions.len();
    let part = RigPart { node: JOINTS as u32, vertices, points: 0, targets: 0, skin: Some(skin) };
    let names = joints.iter().map(|joint| joint.name.to_owned()).chain(["person".to_owned()]).collect();
    let clips = CLIPS.iter().map(|clip| keys(clip, &nodes)).collect();
    Some(BodyFile::made(MadeBody { nodes, names, part, values, triangles: surface.triangles, clips }))
}

fn node(translation: DVec3) -> Node {
    let pose = NodePose { translation, rotation: DQuat::IDENTITY, scale: DVec3::ONE };
    Node { parent: None, pose, matrix: None, weights: Vec::new() }
}

/// Weights by the distances of the joints' cones: those of the nearest joint, of its parent and of its children.
fn first_weights(flesh: &[(usize, Cone)], p: DVec3) -> [f64; JOINTS] {
    let mut distances = [f64::INFINITY; JOINTS];
    flesh.iter().for_each(|(joint, cone)| distances[*joint] = distances[*joint].min(cone.distance(p)));
    let nearest = (0..JOINTS).fold(0, |best, joint| if distances[joint] < distances[best] { joint } else { best });
    let joints = skeleton();
    let is_near = |joint: usize| {
        joint == nearest || joints[joint].parent == Some(nearest) || joints[nearest].parent == Some(joint)
    };
    let weight =
        |joint: usize| if is_near(joint) { ((distances[nearest] - distances[joint]) / BLEND_M).exp() } else { 0.0 };
    let weights: [f64; JOINTS] = std::array::from_fn(weight);
    let sum: f64 = weights.iter().sum();
    weights.map(|weight| weight / sum)
}

/// Takes means with the neighbors on the surface, so that nothing jumps where another joint becomes the nearest.
fn evened(surface: &Surface, mut weights: Vec<[f64; JOINTS]>) -> Vec<[f64; JOINTS]> {
    let mut edges = BTreeSet::new();
    for &[a, b, c] in &surface.triangles {
        edges.extend([[a, b], [b, c], [c, a]].map(|[s, t]| [s.min(t), s.max(t)]));
    }
    let length = |&[a, b]: &[u32; 2]| f64::from(surface.positions[a as usize].distance(surface.positions[b as usize]));
    let mean = edges.iter().map(length).sum::<f64>() / edges.len().max(1) as f64;
    let rounds = (EVEN_M / mean).powi(2).clamp(1.0, EVEN_ROUNDS) as usize;
    for _ in 0..rounds {
        let mut sums: Vec<([f64; JOINTS], f64)> = weights.iter().map(|own| (*own, 1.0)).collect();
        for &[a, b] in &edges {
            for (to, from) in [(a, b), (b, a)] {
                let (sum, count) = &mut sums[to as usize];
                (0..JOINTS).for_each(|joint| sum[joint] += weights[from as usize][joint]);
                *count += 1.0;
            }
        }
        weights = sums.into_iter().map(|(sum, count)| sum.map(|weight| weight / count)).collect();
    }
    weights
}

/// The joints with the largest weights, and their shares.
fn strongest(weights: &[f64; JOINTS]) -> [(usize, f32); INFLUENCES] {
    let mut order: [usize; JOINTS] = std::array::from_fn(|joint| joint);
    order.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]).then(a.cmp(&b)));
    let sum: f64 = order[..INFLUENCES].iter().map(|&joint| weights[joint]).sum();
    std::array::from_fn(|i| (order[i], (weights[order[i]] / sum) as f32))
}

/// The keys of a clip: the way of the pelvis and the turns of those joints that turn.
fn keys(&(name, length_s, pose): &Clip, nodes: &[Node]) -> MadeClip {
    let count = (length_s * KEYS_PER_S).round() as usize + 1;
    let times: Vec<f64> = (0..count).map(|key| length_s * key as f64 / (count - 1) as f64).collect();
    let around: Vec<[Pose; 3]> =
        times.iter().map(|&t| [t - SLOPE_S, t, t + SLOPE_S].map(|t| pose(t.max(0.0)))).collect();
    let mut clip = MadeClip { name: name.to_owned(), length_s, tracks: Vec::new(), values: Vec::new() };
    let mut add = |node: usize, property: Property, width: usize, numbers: &dyn Fn(&Pose) -> [f64; 4]| {
        let first = clip.values.len();
        clip.values.extend(times.iter().map(|&time_s| time_s as f32));
        let values = clip.values.len();
        let mut before: Option<[f64; 4]> = None;
        for (key, poses) in around.iter().enumerate() {
            let mut three = [0, 1, 2].map(|i| numbers(&poses[i]));
            // Both signs of a quaternion are the same turn; the spline needs those that are near each other.
            if property == Property::Rotation {
                let mut last = before.unwrap_or(three[1]);
                for i in [1, 0, 2] {
                    let dot: f64 = (0..4).map(|k| three[i][k] * last[k]).sum();
                    three[i] = three[i].map(|x| if dot < 0.0 { -x } else { x });
                    if i == 1 {
                        last = three[1];
                    }
                }
                before = Some(last);
            }
            // The first key has its pose before it as well.
            let span = if key == 0 { SLOPE_S } else { 2.0 * SLOPE_S };
            let slope: [f64; 4] = std::array::from_fn(|k| (three[2][k] - three[0][k]) / span);
            for row in [slope, three[1], slope] {
                clip.values.extend(row[..width].iter().map(|&x| x as f32));
            }
        }
        let interpolation = Interpolation::CubicSpline;
        clip.tracks.push(Track {
            node: node as u32,
            property,
            interpolation,
            keys: count,
            width,
            times: first,
            values,
        });
    };
    let start = nodes[0].pose.translation;
    if around.iter().any(|[_, pose, _]| pose.root != DVec3::ZERO) {
        add(0, Property::Translation, 3, &|pose| {
            let way = start + pose.root;
            [way.x, way.y, way.z, 0.0]
        });
    }
    for joint in 0..JOINTS {
        if around.iter().any(|[_, pose, _]| pose.turns[joint] != DQuat::IDENTITY) {
            add(joint, Property::Rotation, 4, &|pose| pose.turns[joint].to_array());
        }
    }
    clip
}
