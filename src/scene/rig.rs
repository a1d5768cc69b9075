//! Bodies of nodes, skins and morph targets, evaluated at any time: poses are interpolated on the nodes, never on
//! vertices [Khronos 2021, Sec. 3.7.3 and 3.11].

use std::collections::HashMap;

use serde::{Deserialize, Serialize};

use crate::math::{DAffine3, DVec3};

use super::Playback;
use super::rig_track::{Pose, Property, Track};

/// A body and its clip. Every rank evaluates it from the same numbers in the same order.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    pub(super) header: RigHeader,
    /// What the header's places refer to: keys of the tracks, points, displacements, joints and weights of the parts.
    pub(super) values: Vec<f32>,
}

/// What a rig is, without its bulk values.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct RigHeader {
    /// Parents stand before their children.
    pub nodes: Vec<Node>,
    /// Channels of the clip; none if the body stays in its rest pose.
    pub tracks: Vec<Track>,
    /// Triangle meshes, in the order of their vertices.
    pub parts: Vec<RigPart>,
    /// When the clip is played; none without a clip.
    pub playback: Option<Playback>,
    /// From the coordinates of the file to those of the scene, relative to its local origin.
    pub placement: DAffine3,
}

/// A node of the tree.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Node {
    pub parent: Option<u32>,
    /// The rest pose.
    pub pose: Pose,
    /// In place of a pose; such a node does not move.
    pub matrix: Option<DAffine3>,
    /// Weights of the morph targets of its mesh at rest.
    pub weights: Vec<f64>,
}

/// One primitive of the mesh of a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct RigPart {
    pub node: u32,
    pub vertices: usize,
    /// Place of its points (xyz); the displacements of its morph targets follow, target by target.
    pub points: usize,
    pub targets: usize,
    pub skin: Option<Skin>,
}

/// Joints that carry the vertices of a part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Skin {
    /// Node of every joint.
    pub joints: Vec<u32>,
    /// Inverse bind matrix of every joint.
    pub inverse_bind: Vec<DAffine3>,
    /// Joints per vertex.
    pub influences: usize,
    /// Place of the joints' numbers (exact in f32), `influences` per vertex, and of their weights, whose sum is 1.
    pub carriers: usize,
    pub weights: usize,
}

impl Rig {
    /// The positions of all vertices at a time of the run, xyz, meters.
    pub fn positions_at(&self, time_s: f64) -> Vec<f32> {
        let mut out = Vec::new();
        self.header.positions_at(&self.values, time_s, &mut out);
        out
    }

    /// The clip's timing; none if the body stays in its rest pose.
    pub fn playback(&self) -> Option<Playback> {
        self.header.playback
    }
}

impl RigHeader {
    /// Number of vertices.
    pub(super) fn vertices(&self) -> usize {
        self.parts.iter().map(|part| part.vertices).sum()
    }

    /// Appends the positions at a time of the run. They are evaluated in f64 and rounded once.
    pub(super) fn positions_at(&self, values: &[f32], time_s: f64, out: &mut Vec<f32>) {
        let (clip_s, share) = self.playback.map_or((0.0, 0.0), |playback| playback.at(time_s));
        let (globals, weights) = self.pose_at(values, clip_s, share);
        for part in &self.parts {
            let morph = &weights[part.node as usize];
            match &part.skin {
                // The node of a skinned mesh has no say: joints alone carry the vertices [Khronos 2021, Sec. 3.7.3.3].
                Some(skin) => {
                    let joint = |(&node, bind): (&u32, &DAffine3)| self.placement * globals[node as usize] * *bind;
                    let joints: Vec<DAffine3> = skin.joints.iter().zip(&skin.inverse_bind).map(joint).collect();
                    part.emit(values, morph, |vertex| skin.carried(values, &joints, vertex), out);
                }
                None => {
                    let global = self.placement * globals[part.node as usize];
                    part.emit(values, morph, |_| global, out);
                }
            }
        }
    }

    /// The body with only these vertices, in this order, moving as they move in the whole body, and its values.
    pub(super) fn only(&self, all: &[f32], vertices: &[u32]) -> (RigHeader, Vec<f32>) {
        let mut values = Vec::new();
        let mut header = RigHeader { parts: Vec::new(), ..self.clone() };
        let mut take = |place: usize, count: usize| {
            values.extend_from_slice(&all[place..place + count]);
            values.len() - count
        };
        for track in &mut header.tracks {
            track.times = take(track.times, track.keys);
            track.values = take(track.values, track.width * track.keys * track.values_per_key());
        }
        for &vertex in vertices {
            let mut local = vertex as usize;
            let mut parts = self.parts.iter();
            let part = loop {
                let part = parts.next().expect("a vertex of the body");
                match local.checked_sub(part.vertices) {
                    Some(behind) => local = behind,
                    None => break part,
                }
            };
            let mut one = RigPart { vertices: 1, ..part.clone() };
            let mut row = |row: usize| take(part.points + 3 * (row * part.vertices + local), 3);
            one.points = row(0);
            for target in 1..=part.targets {
                row(target);
            }
            if let Some(skin) = &mut one.skin {
                skin.carriers = take(skin.carriers + local * skin.influences, skin.influences);
                skin.weights = take(skin.weights + local * skin.influences, skin.influences);
            }
            header.parts.push(one);
        }
        (header, values)
    }

    /// For every vertex the first one with the same numbers, which lies at the same place at all times.
    pub(super) fn alike(&self, values: &[f32]) -> Vec<u32> {
        let mut all = Vec::with_capacity(self.vertices());
        for part in &self.parts {
            let first = all.len() as u32;
            let mut known: HashMap<Vec<u32>, u32> = HashMap::with_capacity(part.vertices);
            for vertex in 0..part.vertices {
                let mut numbers = Vec::new();
                for row in 0..=part.targets {
                    numbers.extend_from_slice(&values[part.points + 3 * (row * part.vertices + vertex)..][..3]);
                }
                for place in part.skin.iter().flat_map(|skin| [skin.carriers, skin.weights]) {
                    let influences = part.skin.as_ref().map_or(0, |skin| skin.influences);
                    numbers.extend_from_slice(&values[place + vertex * influences..][..influences]);
                }
                // Adding 0 turns -0 into 0.
                let numbers = numbers.iter().map(|x| (x + 0.0).to_bits()).collect();
                all.push(*known.entry(numbers).or_insert(first + vertex as u32));
            }
        }
        all
    }

    /// The transform of every node into the file's coordinates in the rest pose.
    pub(super) fn rest_transforms(&self) -> Vec<DAffine3> {
        self.pose_at(&[], 0.0, 0.0).0
    }

    /// The transform of every node into the file's coordinates and its morph weights. With a share of 0 the values are
    /// not read.
    fn pose_at(&self, values: &[f32], clip_s: f64, share: f64) -> (Vec<DAffine3>, Vec<Vec<f64>>) {
        let mut poses: Vec<Pose> = self.nodes.iter().map(|node| node.pose).collect();
        let mut weights: Vec<Vec<f64>> = self.nodes.iter().map(|node| node.weights.clone()).collect();
        let mut value = Vec::new();
        for track in self.tracks.iter().filter(|_| share > 0.0) {
            track.at(values, clip_s, &mut value);
            let node = track.node as usize;
            poses[node].set(track.property, &value, share);
            if track.property == Property::Weights {
                weights[node].iter_mut().zip(&value).for_each(|(own, new)| *own += share * (new - *own));
            }
        }
        let mut globals: Vec<DAffine3> = Vec::with_capacity(self.nodes.len());
        for (node, pose) in self.nodes.iter().zip(&poses) {
            let local = node.matrix.unwrap_or_else(|| {
                DAffine3::from_scale_rotation_translation(pose.scale, pose.rotation, pose.translation)
            });
            globals.push(node.parent.map_or(local, |parent| globals[parent as usize] * local));
        }
        (globals, weights)
    }
}

impl RigPart {
    /// Appends its vertices: morph first, then the transform of each.
    fn emit(&self, values: &[f32], morph: &[f64], carry: impl Fn(usize) -> DAffine3, out: &mut Vec<f32>) {
        let row = |i: usize| &values[self.points + 3 * i * self.vertices..][..3 * self.vertices];
        let points = row(0).as_chunks::<3>().0;
        let targets: Vec<(f64, &[[f32; 3]])> = (0..self.targets)
            .map(|i| (morph[i], row(1 + i).as_chunks::<3>().0))
            .filter(|(weight, _)| *weight != 0.0)
            .collect();
        let vector = |p: &[f32; 3]| DVec3::from_array(p.map(f64::from));
        for (vertex, point) in points.iter().enumerate() {
            let morphed =
                targets.iter().fold(vector(point), |p, (weight, target)| p + *weight * vector(&target[vertex]));
            out.extend(carry(vertex).transform_point3(morphed).as_vec3().to_array());
        }
    }
}

impl Skin {
    /// The weighted sum of the transforms of a vertex's joints.
    fn carried(&self, values: &[f32], joints: &[DAffine3], vertex: usize) -> DAffine3 {
        let of_vertex = |place: usize| &values[place + vertex * self.influences..][..self.influences];
        let mut sum = DAffine3::ZERO;
        for (&joint, &weight) in of_vertex(self.carriers).iter().zip(of_vertex(self.weights)) {
            if weight != 0.0 {
                let (joint, weight) = (&joints[joint as usize], f64::from(weight));
                sum.matrix3 += joint.matrix3 * weight;
                sum.translation += joint.translation * weight;
            }
        }
        sum
    }
}
