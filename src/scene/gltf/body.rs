//! The meshes, skins, nodes and clips of a document as a [`Rig`].

use ::gltf::json::animation::{Animation, Interpolation as Interpolated, Property as Moved};
use ::gltf::json::mesh::Mode;
use ::gltf::json::validation::Checked;
use ::gltf::json::{self, Index};

use super::accessor::Numbers;
use super::primitive::{affine, carriers, points, skin, triangles};
use super::{Document, entry};
use crate::math::{DAffine3, DQuat, DVec3};
use crate::scene::Playback;
use crate::scene::rig::{Node, Rig, RigHeader, RigPart};
use crate::scene::rig_track::{Interpolation, Pose, Property, Track, unit};

/// A glTF file that was read and checked.
#[derive(Clone, Debug)]
pub struct BodyFile {
    /// Parents stand before their children.
    nodes: Vec<Node>,
    /// Names of the nodes, in that order; empty if a node has none.
    names: Vec<String>,
    parts: Vec<Part>,
    /// The clips, in the order of the file.
    pub clips: Vec<Clip>,
}

/// An animation of a file.
#[derive(Clone, Debug)]
pub struct Clip {
    /// Its name, or its number from 0 if it has none.
    pub name: String,
    /// Time of the last key, seconds.
    pub length_s: f64,
    tracks: Vec<Track>,
    values: Vec<f32>,
}

/// A primitive with triangles. Places in it begin at 0.
#[derive(Clone, Debug)]
struct Part {
    part: RigPart,
    values: Vec<f32>,
    triangles: Vec<[u32; 3]>,
}

/// A body of one mesh that was made instead of read.
pub(crate) struct MadeBody {
    /// Parents stand before their children.
    pub nodes: Vec<Node>,
    /// Their names.
    pub names: Vec<String>,
    /// Its places begin at 0 in `values`.
    pub part: RigPart,
    pub values: Vec<f32>,
    pub triangles: Vec<[u32; 3]>,
    pub clips: Vec<MadeClip>,
}

/// A clip of a body that was made. Places of the tracks begin at 0 in `values`.
pub(crate) struct MadeClip {
    pub name: String,
    pub length_s: f64,
    pub tracks: Vec<Track>,
    pub values: Vec<f32>,
}

impl BodyFile {
    /// The body that others made.
    pub(crate) fn made(body: MadeBody) -> BodyFile {
        let MadeBody { nodes, names, part, values, triangles, clips } = body;
        let clip = |MadeClip { name, length_s, tracks, values }| Clip { name, length_s, tracks, values };
        let clips = clips.into_iter().map(clip).collect();
        BodyFile { nodes, names, parts: vec![Part { part, values, triangles }], clips }
    }

    /// An error is half a sentence.
    pub(super) fn new(document: &Document) -> Result<BodyFile, String> {
        let Tree { order, parents } = Tree::new(&document.root.nodes)?;
        let mut place = vec![0; order.len()];
        (0u32..).zip(&order).for_each(|(new, &node)| place[node] = new);
        let mut nodes = Vec::with_capacity(order.len());
        for &i in &order {
            let parent = parents[i].map(|parent| place[parent]);
            nodes.push(node(&document.root, i, parent)?);
        }
        let mut body = BodyFile { names: names(document, &order), nodes, parts: Vec::new(), clips: Vec::new() };
        for i in in_scene(&document.root, &parents)? {
            body.take_meshes(document, i, &place)?;
        }
        if body.parts.is_empty() {
            return Err("has no triangles in it".into());
        }
        for (i, animation) in document.root.animations.iter().enumerate() {
            body.clips.push(clip(document, &body.nodes, &place, i, animation)?);
        }
        Ok(body)
    }

    /// Vertices and triangles of all meshes.
    pub fn counts(&self) -> [usize; 2] {
        let count = |of: fn(&Part) -> usize| self.parts.iter().map(of).sum();
        [count(|part| part.part.vertices), count(|part| part.triangles.len())]
    }

    /// Names of the nodes that carry triangles.
    pub fn mesh_nodes(&self) -> Vec<&str> {
        let mut names: Vec<&str> = self.parts.iter().map(|part| &self.names[part.part.node as usize][..]).collect();
        names.dedup();
        names
    }

    /// The clip with this name; an error lists those that there are.
    pub fn clip(&self, name: &str) -> Result<&Clip, String> {
        let found = self.clips.iter().find(|clip| clip.name == name);
        let names: Vec<&str> = self.clips.iter().map(|clip| &clip.name[..]).collect();
        found.ok_or_else(|| match names.is_empty() {
            true => format!("no clip is named `{name}`; the file has none"),
            false => format!("no clip is named `{name}`; the file has {}", names.join(", ")),
        })
    }

    /// The body with the meshes of the node `only` and of those below it (none: all), and its triangles. `clip`: what
    /// it plays and when. `placement`: from the coordinates of the file to those of the scene.
    ///
    /// # Errors
    /// No node of this name carries triangles; half a sentence.
    pub fn rig(
        &self,
        only: Option<&str>,
        clip: Option<(&Clip, Playback)>,
        placement: DAffine3,
    ) -> Result<(Rig, Vec<[u32; 3]>), String> {
        let mut header = RigHeader { nodes: self.nodes.clone(), placement, ..RigHeader::default() };
        let (mut values, mut triangles) = (Vec::new(), Vec::new());
        let is_below = |mut node: usize, name: &str| loop {
            match self.nodes[node].parent {
                _ if self.names[node] == name => return true,
                Some(parent) => node = parent as usize,
                None => return false,
            }
        };
        for Part { part, values: own, triangles: corners } in &self.parts {
            if only.is_some_and(|name| !is_below(part.node as usize, name)) {
                continue;
            }
            let (first, shift) = (header.vertices() as u32, values.len());
            let mut part = part.clone();
            part.points += shift;
            if let Some(skin) = &mut part.skin {
                skin.carriers += shift;
                skin.weights += shift;
            }
            values.extend_from_slice(own);
            triangles.extend(corners.iter().map(|corners| corners.map(|v| v + first)));
            header.parts.push(part);
        }
        if let (Some(name), true) = (only, header.parts.is_empty()) {
            return Err(format!("no node `{name}` has triangles; those that do are {}", self.mesh_nodes().join(", ")));
        }
        if let Some((clip, playback)) = clip {
            let shift = values.len();
            values.extend_from_slice(&clip.values);
            let moved = |track: &Track| Track { times: track.times + shift, values: track.values + shift, ..*track };
            header.tracks = clip.tracks.iter().map(moved).collect();
            header.playback = Some(playback);
        }
        Ok((Rig { header, values }, triangles))
    }

    /// Appends the meshes of the node `i` of the file.
    fn take_meshes(&mut self, document: &Document, i: usize, place: &[u32]) -> Result<(), String> {
        let node = &document.root.nodes[i];
        let Some(index) = &node.mesh else { return Ok(()) };
        let mesh = entry(&document.root.meshes, index, "mesh", &format!("node {i}"))?;
        let skin = node.skin.as_ref().map(|index| skin(document, index, place)).transpose()?;
        for (k, primitive) in mesh.primitives.iter().enumerate() {
            let of = format!("mesh {index}, primitive {k}");
            let Checked::Valid(mode) = primitive.mode else { return Err(format!("{of} has an unknown mode")) };
            if !matches!(mode, Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan) {
                continue;
            }
            let mut values = Vec::new();
            let mut part = points(document, primitive, &mut values, &of)?;
            part.node = place[i];
            if let Some((joints, inverse_bind)) = &skin {
                part.skin = Some(carriers(document, primitive, part.vertices, joints, inverse_bind, &mut values, &of)?);
            }
            let given = self.nodes[part.node as usize].weights.len();
            if given < part.targets {
                return Err(format!("{of} has {} morph targets, but its node has {given} weights", part.targets));
            }
            let mut triangles = triangles(document, primitive, mode, part.vertices, &of)?;
            if part.skin.is_none() && self.mirrors(part.node) {
                triangles.iter_mut().for_each(|corners| corners.swap(1, 2));
            }
            if !triangles.is_empty() {
                self.parts.push(Part { part, values, triangles });
            }
        }
        Ok(())
    }

    /// True if a node turns what it carries inside out.
    fn mirrors(&self, node: u32) -> bool {
        let header = RigHeader { nodes: self.nodes.clone(), ..RigHeader::default() };
        header.rest_transforms()[node as usize].matrix3.determinant() < 0.0
    }
}

/// Nodes with their parents.
struct Tree {
    /// Nodes of the file, parents first.
    order: Vec<usize>,
    parents: Vec<Option<usize>>,
}

impl Tree {
    fn new(nodes: &[json::Node]) -> Result<Tree, String> {
        let mut parents = vec![None; nodes.len()];
        for (i, node) in nodes.iter().enumerate() {
            for child in node.children.iter().flatten() {
                entry(nodes, child, "node", &format!("node {i}"))?;
                if parents[child.value()].replace(i).is_some() {
                    return Err(format!("node {child} is the child of several nodes"));
                }
            }
        }
        let mut order: Vec<usize> = (0..nodes.len()).filter(|&i| parents[i].is_none()).collect();
        let mut next = 0;
        while next < order.len() {
            order.extend(nodes[order[next]].children.iter().flatten().map(Index::value));
            next += 1;
        }
        // A node of a ring has a parent, and so is below no root.
        match order.len() == nodes.len() {
            true => Ok(Tree { order, parents }),
            false => Err("has nodes that are below themselves".into()),
        }
    }
}

fn names(document: &Document, order: &[usize]) -> Vec<String> {
    order.iter().map(|&i| document.root.nodes[i].name.clone().unwrap_or_default()).collect()
}

/// The nodes of the scene, depth first. A file without scenes is one as a whole.
fn in_scene(root: &json::Root, parents: &[Option<usize>]) -> Result<Vec<usize>, String> {
    let scene = match &root.scene {
        Some(index) => Some(entry(&root.scenes, index, "scene", "the file")?),
        None => root.scenes.first(),
    };
    let mut stack: Vec<usize> = match scene {
        Some(scene) => scene.nodes.iter().map(Index::value).collect(),
        None => (0..root.nodes.len()).filter(|&i| parents[i].is_none()).collect(),
    };
    stack.reverse();
    let mut nodes = Vec::new();
    while let Some(i) = stack.pop() {
        let node = root.nodes.get(i).ok_or_else(|| format!("the scene names node {i}, which is not there"))?;
        if nodes.len() == root.nodes.len() {
            return Err("has a scene with a node twice".into());
        }
        nodes.push(i);
        stack.extend(node.children.iter().flatten().rev().map(Index::value));
    }
    Ok(nodes)
}

fn node(root: &json::Root, i: usize, parent: Option<u32>) -> Result<Node, String> {
    let node = &root.nodes[i];
    let numbers = |numbers: &[f32]| match numbers.iter().all(|x| x.is_finite()) {
        true => Ok(()),
        false => Err(format!("node {i} has a transform that is not finite")),
    };
    let vector = |v: [f32; 3]| numbers(&v).map(|()| DVec3::from_array(v.map(f64::from)));
    let matrix = match &node.matrix {
        Some(matrix) => {
            numbers(matrix)?;
            Some(affine(&matrix.map(f64::from)))
        }
        None => None,
    };
    let rotation = node.rotation.as_ref().map_or([0.0, 0.0, 0.0, 1.0], |rotation| rotation.0);
    numbers(&rotation)?;
    let pose = Pose {
        translation: vector(node.translation.unwrap_or_default())?,
        rotation: unit(DQuat::from_array(rotation.map(f64::from))),
        scale: vector(node.scale.unwrap_or([1.0; 3]))?,
    };
    let mut weights = Vec::new();
    if let Some(index) = &node.mesh {
        let mesh = entry(&root.meshes, index, "mesh", &format!("node {i}"))?;
        let targets = mesh.primitives.iter().filter_map(|primitive| primitive.targets.as_ref().map(Vec::len)).max();
        let given = node.weights.as_ref().or(mesh.weights.as_ref());
        weights = given.map_or(vec![0.0; targets.unwrap_or(0)], |w| w.iter().map(|&w| f64::from(w)).collect());
        if weights.iter().any(|w| !w.is_finite()) {
            return Err(format!("node {i} has a morph weight that is not finite"));
        }
    }
    Ok(Node { parent, pose, matrix, weights })
}

fn clip(
    document: &Document,
    nodes: &[Node],
    place: &[u32],
    number: usize,
    animation: &Animation,
) -> Result<Clip, String> {
    let name = animation.name.clone().filter(|name| !name.is_empty()).unwrap_or_else(|| number.to_string());
    let mut clip = Clip { name, length_s: 0.0, tracks: Vec::new(), values: Vec::new() };
    for (i, channel) in animation.channels.iter().enumerate() {
        let of = format!("channel {i} of animation `{}`", clip.name);
        entry(&document.root.nodes, &channel.target.node, "node", &of)?;
        let node = place[channel.target.node.value()];
        // Extensions move other things, such as the colors of materials.
        let Checked::Valid(moved) = channel.target.path else { continue };
        let sampler = entry(&animation.samplers, &channel.sampler, "sampler", &of)?;
        let Checked::Valid(interpolated) = sampler.interpolation else {
            return Err(format!("{of} has an interpolation that glTF does not know"));
        };
        let (property, width) = match moved {
            Moved::Translation => (Property::Translation, 3),
            Moved::Rotation => (Property::Rotation, 4),
            Moved::Scale => (Property::Scale, 3),
            Moved::MorphTargetWeights => (Property::Weights, nodes[node as usize].weights.len()),
        };
        if width == 0 {
            continue;
        }
        if property != Property::Weights && nodes[node as usize].matrix.is_some() {
            return Err(format!("{of} moves a node that has a matrix, which has no parts to move"));
        }
        let times = document.numbers(&sampler.input, 1, Numbers::Real, &format!("times of {of}"))?;
        let numbers_per_element = if property == Property::Weights { 1 } else { width };
        let values =
            document.numbers(&sampler.output, numbers_per_element, Numbers::Real, &format!("values of {of}"))?;
        let interpolation = match interpolated {
            Interpolated::Linear => Interpolation::Linear,
            Interpolated::Step => Interpolation::Step,
            Interpolated::CubicSpline => Interpolation::CubicSpline,
        };
        let track = Track { node, property, interpolation, keys: times.len(), width, times: 0, values: 0 };
        if times.is_empty() || times.windows(2).any(|pair| pair[0] > pair[1]) {
            return Err(format!("{of} has no keys, or keys whose times do not grow"));
        }
        let needed = times.len() * width * track.values_per_key();
        if values.len() != needed {
            return Err(format!("{of} has {} numbers for its keys, not {needed}", values.len()));
        }
        let first = clip.values.len();
        clip.values.extend(times.iter().chain(&values).map(|&x| x as f32));
        let track = Track { times: first, values: first + times.len(), ..track };
        clip.length_s = clip.length_s.max(track.end_s(&clip.values));
        clip.tracks.push(track);
    }
    Ok(clip)
}
