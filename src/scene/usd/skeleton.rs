//! Meshes that hang on a UsdSkel skeleton, as a rig: joints are nodes, blend shapes are morph targets. A point goes
//! through the transform of its mesh when it was bound, the inverse bind transforms of its joints, the joints, and the
//! transform of the skeleton, weighted linearly.

use openusd::sdf::{self, Value};
use openusd::usd::{Attribute, Prim, Stage};

use super::mesh::{Points, points, triangles};
use super::transform::Placing;
use super::value::{self, broken};
use crate::math::DAffine3;
use crate::scene::rig::{Node, RigHeader, RigPart, Skin};
use crate::scene::rig_track::{Interpolation, Pose, Property, Track, unit};

/// A body and the only clip that it has.
#[derive(Clone, Debug, Default)]
pub(crate) struct SkinnedBody {
    /// Without playback and placement.
    pub header: RigHeader,
    pub values: Vec<f32>,
    pub triangles: Vec<[u32; 3]>,
    /// Time of the last sample, seconds.
    pub length_s: f64,
    /// Paths of the meshes.
    pub names: Vec<String>,
}

/// True for a mesh that hangs on joints or has blend shapes.
pub(super) fn is_skinned(prim: &Prim) -> Result<bool, String> {
    let has = |name: &str| value::value(&prim.attribute(name), None).map(|found| found.is_some());
    Ok((has("primvars:skel:jointIndices")? && target(prim, "skel:skeleton")?.is_some()) || has("skel:blendShapes")?)
}

/// The prim that a relationship names, of the prim itself or of the nearest one above that has it.
fn target(prim: &Prim, name: &str) -> Result<Option<sdf::Path>, String> {
    for path in prim.path().ancestors_below_root() {
        if let Some(path) = prim.stage().prim(path).relationship(name).targets().map_err(broken)?.into_iter().next() {
            return Ok(Some(path));
        }
    }
    Ok(None)
}

/// An attribute without samples.
fn uniform<T>(prim: &Prim, name: &str, read: impl Fn(Value) -> Option<T>) -> Result<Option<T>, String> {
    let wrong = || format!("has a `{name}` of another type than USD prescribes: `{}`", prim.path());
    value::value(&prim.attribute(name), None)?.map(|found| read(found).ok_or_else(wrong)).transpose()
}

/// Reads meshes of which at least one is skinned. An error is half a sentence.
pub(super) fn skinned(stage: &Stage, meshes: &[Prim], per_s: f64) -> Result<SkinnedBody, String> {
    let mut body = SkinnedBody::default();
    let mut skeletons: Vec<Skeleton> = Vec::new();
    for prim in meshes {
        let path = prim.path().as_str().to_owned();
        let Points { codes, frames, .. } = points(prim)?;
        if codes.len() > 1 && frames.iter().any(|frame| *frame != frames[0]) {
            return Err(format!("has both a skeleton and points with samples, which are not read together: `{path}`"));
        }
        let mut corners = triangles(prim, &frames[0])?;
        let first = body.header.parts.iter().map(|part| part.vertices as u32).sum::<u32>();
        let mut part = RigPart {
            node: body.header.nodes.len() as u32,
            vertices: frames[0].len(),
            points: 0,
            targets: 0,
            skin: None,
        };
        let placing = Placing::of(prim)?;
        let joints = uniform(prim, "primvars:skel:jointIndices", value::integers)?;
        let skeleton = target(prim, "skel:skeleton")?.filter(|_| joints.is_some());
        // A skinned mesh goes with its joints, another one with its own transform.
        let place = place_node(&placing, skeleton.is_some(), per_s, &path, &mut body)?;
        if skeleton.is_none() && place.matrix3.determinant() < 0.0 {
            corners.iter_mut().for_each(|corners| corners.swap(1, 2));
        }
        if let Some(word) = uniform(prim, "primvars:skel:skinningMethod", word)?
            && word != "classicLinear"
        {
            return Err(format!("has a mesh with the skinning method {word}, which is not read: `{path}`"));
        }
        // The displacements of blend shapes follow the points.
        part.points = body.values.len();
        body.values.extend(frames[0].iter().flat_map(|p| p.to_array()));
        blend_shapes(prim, per_s, &mut part, &mut body)?;
        if let (Some(joints), Some(skeleton)) = (joints, skeleton) {
            let found = match skeletons.iter().position(|known| known.path == skeleton) {
                Some(found) => found,
                None => {
                    skeletons.push(Skeleton::read(&stage.prim(skeleton), prim, per_s, &mut body)?);
                    skeletons.len() - 1
                }
            };
            part.skin = Some(skin(prim, &joints, &skeletons[found], part.vertices, &mut body.values)?);
        }
        body.header.parts.push(part);
        body.triangles.extend(corners.iter().map(|corners| corners.map(|v| v + first)));
        body.names.push(path);
    }
    Ok(body)
}

fn word(found: Value) -> Option<String> {
    match found {
        Value::Token(word) => Some(word.as_str().to_owned()),
        _ => None,
    }
}

/// Adds a node with the transform of a prim, and keys where it moves. `is_ignored`: it has no say.
fn place_node(
    placing: &Placing,
    is_ignored: bool,
    per_s: f64,
    path: &str,
    body: &mut SkinnedBody,
) -> Result<DAffine3, String> {
    let node = body.header.nodes.len() as u32;
    let start = placing.at(placing.codes.first().copied().unwrap_or(0.0))?;
    let is_still = is_ignored || placing.codes.is_empty();
    body.header.nodes.push(Node {
        parent: None,
        pose: pose(&start),
        matrix: is_still.then_some(start),
        weights: Vec::new(),
    });
    if is_still {
        return Ok(start);
    }
    let mut poses = Vec::new();
    for &code in &placing.codes {
        let at = placing.at(code)?;
        let found = pose(&at);
        let again = DAffine3::from_scale_rotation_translation(found.scale, found.rotation, found.translation);
        if !again.abs_diff_eq(at, 1e-6 * (1.0 + at.translation.length())) {
            return Err(format!("has a transform that shears while it moves, which is not read: `{path}`"));
        }
        poses.push(found);
    }
    let mut keys = Keys::new(&placing.codes, per_s, body);
    keys.add(node, Property::Translation, poses.iter().flat_map(|pose| pose.translation.as_vec3().to_array()), body);
    keys.add(node, Property::Rotation, poses.iter().flat_map(|pose| pose.rotation.to_array().map(|x| x as f32)), body);
    keys.add(node, Property::Scale, poses.iter().flat_map(|pose| pose.scale.as_vec3().to_array()), body);
    Ok(start)
}

fn pose(transform: &DAffine3) -> Pose {
    let (scale, rotation, translation) = transform.to_scale_rotation_translation();
    Pose { translation, rotation: unit(rotation), scale }
}

/// Times of keys that several tracks share.
struct Keys {
    count: usize,
    times: usize,
}

impl Keys {
    fn new(codes: &[f64], per_s: f64, body: &mut SkinnedBody) -> Keys {
        let times = body.values.len();
        body.values.extend(codes.iter().map(|code| (code / per_s) as f32));
        body.length_s = codes.iter().fold(body.length_s, |most, code| most.max(code / per_s));
        Keys { count: codes.len(), times }
    }

    /// Adds a track; `numbers` = those of every key, one after the other.
    fn add(&mut self, node: u32, property: Property, numbers: impl Iterator<Item = f32>, body: &mut SkinnedBody) {
        let values = body.values.len();
        body.values.extend(numbers);
        let width = (body.values.len() - values) / self.count;
        let (keys, times, interpolation) = (self.count, self.times, Interpolation::Linear);
        body.header.tracks.push(Track { node, property, interpolation, keys, width, times, values });
    }
}

/// Joints of a skeleton as nodes.
struct Skeleton {
    path: sdf::Path,
    /// Paths of the joints.
    joints: Vec<String>,
    /// The node of the first joint; the others follow.
    first: u32,
    inverse_bind: Vec<DAffine3>,
}

impl Skeleton {
    /// Adds the nodes of a skeleton and the tracks of its animation, which the skeleton or else the mesh names.
    fn read(prim: &Prim, mesh: &Prim, per_s: f64, body: &mut SkinnedBody) -> Result<Skeleton, String> {
        let path = prim.path().as_str();
        let lacks = |what: &str| format!("has a skeleton without {what}: `{path}`");
        let joints = uniform(prim, "joints", value::words)?.filter(|joints| !joints.is_empty());
        let joints = joints.ok_or_else(|| lacks("joints"))?;
        let whole = |all: &Vec<DAffine3>| all.len() == joints.len() && all.iter().all(|one| one.is_finite());
        let bind = uniform(prim, "bindTransforms", value::affines)?.filter(whole);
        let bind = bind.ok_or_else(|| lacks("as many bindTransforms as it has joints"))?;
        let rest = uniform(prim, "restTransforms", value::affines)?.filter(whole);
        let inverse_bind: Vec<DAffine3> = bind.iter().map(DAffine3::inverse).collect();
        if inverse_bind.iter().any(|inverse| !inverse.is_finite()) {
            return Err(lacks("bindTransforms that can be inverted"));
        }
        let root = body.header.nodes.len() as u32;
        place_node(&Placing::of(prim)?, false, per_s, path, body)?;
        let source = match target(prim, "skel:animationSource")? {
            Some(source) => Some(source),
            None => target(mesh, "skel:animationSource")?,
        };
        let animation = source.map(|source| Animation::read(&prim.stage().prim(source))).transpose()?;
        let first = body.header.nodes.len() as u32;
        for (i, joint) in joints.iter().enumerate() {
            let parent = parent_of(joint, &joints);
            if parent.is_some_and(|parent| parent >= i) {
                return Err(lacks("an order in which parents stand before their children"));
            }
            let local = match &rest {
                Some(rest) => rest[i],
                None => parent.map_or(bind[i], |parent| inverse_bind[parent] * bind[i]),
            };
            let is_moved = animation.as_ref().is_some_and(|animation| animation.joints.contains(joint));
            body.header.nodes.push(Node {
                parent: Some(parent.map_or(root, |parent| first + parent as u32)),
                pose: pose(&local),
                matrix: (!is_moved).then_some(local),
                weights: Vec::new(),
            });
        }
        let skeleton = Skeleton { path: prim.path().clone(), joints, first, inverse_bind };
        if let Some(animation) = animation {
            animation.add(&skeleton, per_s, body)?;
        }
        Ok(skeleton)
    }

    fn node(&self, joint: &str) -> Option<u32> {
        self.joints.iter().position(|known| known == joint).map(|i| self.first + i as u32)
    }
}

/// The nearest joint whose path is the beginning of a joint's.
fn parent_of(joint: &str, joints: &[String]) -> Option<usize> {
    let mut path = joint;
    while let Some((above, _)) = path.rsplit_once('/') {
        if let Some(found) = joints.iter().position(|known| known == above) {
            return Some(found);
        }
        path = above;
    }
    None
}

/// A prim with samples of joints.
struct Animation {
    path: String,
    joints: Vec<String>,
    attributes: [(Property, usize, Attribute); 3],
}

impl Animation {
    fn read(prim: &Prim) -> Result<Animation, String> {
        let attribute = |property, width, name: &str| (property, width, prim.attribute(name));
        Ok(Animation {
            path: prim.path().as_str().to_owned(),
            joints: uniform(prim, "joints", value::words)?.unwrap_or_default(),
            attributes: [
                attribute(Property::Translation, 3, "translations"),
                attribute(Property::Rotation, 4, "rotations"),
                attribute(Property::Scale, 3, "scales"),
            ],
        })
    }

    /// Adds the tracks of the joints that a skeleton has.
    fn add(&self, skeleton: &Skeleton, per_s: f64, body: &mut SkinnedBody) -> Result<(), String> {
        for (property, width, attribute) in &self.attributes {
            let codes = attribute.time_sample_times().map_err(broken)?;
            let at: Vec<Option<f64>> =
                if codes.is_empty() { vec![None] } else { codes.iter().copied().map(Some).collect() };
            let mut frames: Vec<Vec<f32>> = Vec::with_capacity(at.len());
            for &code in &at {
                let Some(found) = value::value(attribute, code)? else { break };
                let numbers: Option<Vec<f32>> = match property {
                    Property::Rotation => value::rotations(found).map(|all| all.into_flattened()),
                    _ => value::vectors(found).map(|all| all.iter().flat_map(|v| v.to_array()).collect()),
                };
                let fits = |numbers: &Vec<f32>| numbers.len() == width * self.joints.len();
                let numbers = numbers.filter(fits).filter(|numbers| numbers.iter().all(|x| x.is_finite()));
                frames.push(numbers.ok_or_else(|| {
                    let name = attribute.path().as_str();
                    format!("has an animation whose `{name}` does not fit its {} joints", self.joints.len())
                })?);
            }
            // What the animation does not move keeps its rest pose.
            if frames.len() < at.len() || frames.is_empty() {
                continue;
            }
            let codes = if codes.is_empty() { vec![0.0] } else { codes };
            let mut keys = Keys::new(&codes, per_s, body);
            for (i, joint) in self.joints.iter().enumerate() {
                let Some(node) = skeleton.node(joint) else { continue };
                let numbers = frames.iter().flat_map(|frame| frame[width * i..width * (i + 1)].iter().copied());
                keys.add(node, *property, numbers, body);
            }
        }
        if self.joints.is_empty() {
            return Err(format!("has an animation without joints: `{}`", self.path));
        }
        Ok(())
    }
}

/// Joints and weights of the vertices of a mesh.
fn skin(
    prim: &Prim,
    indices: &[i32],
    skeleton: &Skeleton,
    vertices: usize,
    values: &mut Vec<f32>,
) -> Result<Skin, String> {
    let path = prim.path().as_str();
    let weights = uniform(prim, "primvars:skel:jointWeights", value::floats)?.unwrap_or_default();
    let attribute = prim.attribute("primvars:skel:jointIndices");
    let is_constant = attribute.get_metadata::<Value>("interpolation").map_err(broken)?.and_then(word);
    let is_constant = is_constant.is_some_and(|word| word == "constant");
    let rows = if is_constant { 1 } else { vertices };
    let influences = indices.len() / rows.max(1);
    if indices.len() != weights.len() || influences == 0 || influences * rows != indices.len() {
        let (a, b) = (indices.len(), weights.len());
        return Err(format!("has {a} joint indices and {b} joint weights for the {vertices} points of `{path}`"));
    }
    // A mesh may number joints on its own.
    let own = uniform(prim, "skel:joints", value::words)?.filter(|own| !own.is_empty());
    let names = own.as_ref().unwrap_or(&skeleton.joints);
    let unknown = |joint: &str| format!("has no joint `{joint}` in its skeleton, which `{path}` names");
    let place = |joint: &String| skeleton.joints.iter().position(|known| known == joint).ok_or_else(|| unknown(joint));
    let places = names.iter().map(place).collect::<Result<Vec<usize>, String>>()?;
    let bound = uniform(prim, "primvars:skel:geomBindTransform", |found| match found {
        Value::Matrix4d(matrix) => Some(value::affine(&matrix)),
        _ => None,
    })?;
    let bound = bound.unwrap_or(DAffine3::IDENTITY);
    let carriers = values.len();
    let mut all = Vec::with_capacity(vertices * influences);
    for vertex in 0..vertices {
        let row = if is_constant { 0 } else { vertex * influences };
        let own: Vec<(i32, f32)> = (row..row + influences).map(|i| (indices[i], weights[i])).collect();
        let sum: f64 = own.iter().map(|&(_, weight)| f64::from(weight)).sum();
        if !(sum > 0.0 && sum.is_finite()) {
            return Err(format!("vertex {vertex} (from 0) of `{path}` hangs on no joint: its weights are {sum}"));
        }
        for (joint, weight) in own {
            let joint = usize::try_from(joint).ok().filter(|&joint| joint < places.len() || weight == 0.0);
            let joint = joint.ok_or_else(|| {
                format!("vertex {vertex} (from 0) of `{path}` names a joint beyond the {} that there are", places.len())
            })?;
            values.push(if weight != 0.0 { joint as f32 } else { 0.0 });
            all.push((f64::from(weight) / sum) as f32);
        }
    }
    let weights = values.len();
    values.extend(all);
    Ok(Skin {
        joints: places.iter().map(|&place| skeleton.first + place as u32).collect(),
        inverse_bind: places.iter().map(|&place| skeleton.inverse_bind[place] * bound).collect(),
        influences,
        carriers,
        weights,
    })
}

/// Adds the displacements of the blend shapes of a mesh, and how they are weighted over time, to its node.
fn blend_shapes(prim: &Prim, per_s: f64, part: &mut RigPart, body: &mut SkinnedBody) -> Result<(), String> {
    let path = prim.path().as_str();
    let Some(names) = uniform(prim, "skel:blendShapes", value::words)?.filter(|names| !names.is_empty()) else {
        return Ok(());
    };
    let targets = prim.relationship("skel:blendShapeTargets").targets().map_err(broken)?;
    if targets.len() != names.len() {
        return Err(format!("has {} blend shapes and {} targets for them: `{path}`", names.len(), targets.len()));
    }
    for target in &targets {
        let shape = prim.stage().prim(target.clone());
        let wrong = |what: &str| format!("has a blend shape with {what}: `{}`", target.as_str());
        let properties = shape.property_names().map_err(broken)?;
        if properties.iter().any(|name| name.as_str().starts_with("inbetweens:")) {
            return Err(wrong("inbetweens, which are not read"));
        }
        let offsets = uniform(&shape, "offsets", value::vectors)?.ok_or_else(|| wrong("no offsets"))?;
        let points = uniform(&shape, "pointIndices", value::integers)?;
        let mut row = vec![0.0; 3 * part.vertices];
        if points.as_ref().map_or(part.vertices, Vec::len) != offsets.len() {
            return Err(wrong("another number of offsets than of points"));
        }
        for (i, offset) in offsets.iter().enumerate() {
            let point = points.as_ref().map_or(i, |points| points[i] as usize);
            let place = row.get_mut(3 * point.min(part.vertices)..3 * point.min(part.vertices) + 3);
            let place =
                place.filter(|_| offset.is_finite()).ok_or_else(|| wrong("offsets of points that are not there"))?;
            place.copy_from_slice(&offset.to_array());
        }
        body.values.extend(row);
    }
    part.targets = names.len();
    body.header.nodes[part.node as usize].weights = vec![0.0; names.len()];
    let skeleton = target(prim, "skel:skeleton")?.map(|path| prim.stage().prim(path));
    let source = match skeleton.map(|skeleton| target(&skeleton, "skel:animationSource")).transpose()?.flatten() {
        Some(source) => Some(source),
        None => target(prim, "skel:animationSource")?,
    };
    let Some(animation) = source.map(|source| prim.stage().prim(source)) else { return Ok(()) };
    let order = uniform(&animation, "blendShapes", value::words)?.unwrap_or_default();
    let attribute = animation.attribute("blendShapeWeights");
    let codes = attribute.time_sample_times().map_err(broken)?;
    let at: Vec<Option<f64>> = if codes.is_empty() { vec![None] } else { codes.iter().copied().map(Some).collect() };
    let mut numbers = Vec::with_capacity(at.len() * names.len());
    for &code in &at {
        let Some(weights) = value::value(&attribute, code)?.and_then(value::floats) else { return Ok(()) };
        if weights.len() != order.len() || weights.iter().any(|weight| !weight.is_finite()) {
            return Err(format!(
                "has {} weights for {} blend shapes: `{}`",
                weights.len(),
                order.len(),
                animation.path()
            ));
        }
        let weight = |name: &String| order.iter().position(|known| known == name).map_or(0.0, |i| weights[i]);
        numbers.extend(names.iter().map(weight));
    }
    let codes = if codes.is_empty() { vec![0.0] } else { codes };
    Keys::new(&codes, per_s, body).add(part.node, Property::Weights, numbers.into_iter(), body);
    Ok(())
}
