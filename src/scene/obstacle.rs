//! Obstacles: surfaces that collide with cloth and follow a prescribed motion. Every rank evaluates their positions
//! from the same numbers in the same order, so all ranks hold the same bits.

use std::ops::Range;

use bytemuck::cast_slice;

use crate::math::{DAffine3, Vec3};

use super::cache::CacheHeader;
use super::rig::RigHeader;
use super::{Cache, Motion, Rig};

/// A validated obstacle of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Obstacle {
    /// Name in messages.
    pub name: String,
    /// Coulomb friction coefficient between this obstacle and cloth.
    pub friction: f64,
    /// Positions before any motion, meters: relative to the scene's local origin, or to a point of their own that the
    /// motion knows, where an obstacle comes from far away.
    pub positions: Vec<Vec3>,
    /// Vertex indices of every triangle, from 0 within the obstacle. Some vertices can be in no triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Prescribed motion.
    pub movement: Movement,
}

/// Prescribed motion of an obstacle.
#[derive(Clone, Debug, PartialEq)]
pub enum Movement {
    /// The obstacle does not move.
    Still,
    /// The whole obstacle moves: position(t) = motion(t) applied to `positions`.
    Keyframes(Motion),
    /// Every vertex moves on its own, linearly from frame to frame, and rests before the first and after the last. The
    /// first frame, at time 0, is the obstacle's `positions`.
    Sequence {
        /// Frames per second.
        frames_per_s: f64,
        /// The frames after the first; each has as many positions as the obstacle. They are shared, because a scene has
        /// the same obstacles at every resolution.
        later: std::sync::Arc<Vec<Vec<Vec3>>>,
    },
    /// A body with nodes, skins and morph targets that plays a clip. `positions` are those at time 0. Shared as the
    /// frames of a sequence are.
    Rigged(std::sync::Arc<Rig>),
    /// Every vertex moves on its own, as a point cache or a sequence says. `positions` are those at time 0.
    Cached(std::sync::Arc<Cache>),
}

impl Obstacle {
    /// True if the obstacle moves at any time.
    pub fn moving(&self) -> bool {
        match &self.movement {
            Movement::Still => false,
            Movement::Keyframes(motion) => motion
                .keyframes
                .windows(2)
                .any(|pair| (pair[0].transform(), pair[0].turn) != (pair[1].transform(), pair[1].turn)),
            Movement::Sequence { later, .. } => later.iter().any(|frame| *frame != self.positions),
            Movement::Rigged(rig) => rig.playback().is_some(),
            Movement::Cached(cache) => cache.moving(),
        }
    }
}

/// All obstacles of a scene as one surface. Vertices and triangles are numbered obstacle by obstacle.
///
/// To send it to a worker, it is split into a small header and bulk arrays ([`Obstacles::header`],
/// [`Obstacles::arrays`]). [`Obstacles::from_parts`] joins them again.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Obstacles {
    header: ObstacleHeader,
    /// xyz positions of obstacle 0 (all frames of a sequence in order; the values of a rig), then of obstacle 1, and so
    /// on.
    positions: Vec<f32>,
    /// Vertex indices over all obstacles.
    triangles: Vec<[u32; 3]>,
}

/// Metadata of [`Obstacles`], without the bulk arrays.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ObstacleHeader {
    parts: Vec<Part>,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
struct Part {
    name: String,
    friction: f64,
    vertices: u32,
    triangles: u32,
    moving: bool,
    motion: PartMotion,
}

#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
enum PartMotion {
    Still,
    Keyframes(Motion),
    Sequence { frames_per_s: f64, frames: u32 },
    Rigged { rig: RigHeader, values: usize },
    Cached(CacheHeader),
}

impl Part {
    fn frames(&self) -> u32 {
        match &self.motion {
            PartMotion::Sequence { frames, .. } => *frames,
            PartMotion::Cached(cache) => cache.frames() as u32,
            _ => 1,
        }
    }

    /// Number of f32 values of its positions, over all frames.
    fn values(&self) -> usize {
        match self.motion {
            PartMotion::Rigged { values, .. } => values,
            _ => 3 * self.vertices as usize * self.frames() as usize,
        }
    }
}

impl Obstacles {
    /// Merges the obstacles of a scene.
    pub fn new(obstacles: &[Obstacle]) -> Obstacles {
        let mut all = Obstacles::default();
        let mut first = 0;
        for obstacle in obstacles {
            if !matches!(obstacle.movement, Movement::Rigged(_) | Movement::Cached(_)) {
                all.positions.extend_from_slice(cast_slice(&obstacle.positions));
            }
            let motion = match &obstacle.movement {
                Movement::Still => PartMotion::Still,
                Movement::Rigged(rig) => {
                    all.positions.extend_from_slice(&rig.values);
                    PartMotion::Rigged { rig: rig.header.clone(), values: rig.values.len() }
                }
                Movement::Cached(cache) => {
                    cache.frames.iter().for_each(|frame| all.positions.extend_from_slice(cast_slice(frame)));
                    PartMotion::Cached(cache.header())
                }
                Movement::Keyframes(motion) => PartMotion::Keyframes(motion.clone()),
                Movement::Sequence { frames_per_s, later } => {
                    later.iter().for_each(|frame| all.positions.extend_from_slice(cast_slice(frame)));
                    PartMotion::Sequence { frames_per_s: *frames_per_s, frames: 1 + later.len() as u32 }
                }
            };
            all.triangles.extend(obstacle.triangles.iter().map(|corners| corners.map(|v| v + first)));
            let vertices = obstacle.positions.len() as u32;
            first += vertices;
            all.header.parts.push(Part {
                name: obstacle.name.clone(),
                friction: obstacle.friction,
                vertices,
                triangles: obstacle.triangles.len() as u32,
                moving: obstacle.moving(),
                motion,
            });
        }
        all
    }

    /// Joins the results of [`Obstacles::header`] and [`Obstacles::arrays`]; none if they do not match.
    pub fn from_parts(header: ObstacleHeader, positions: Vec<f32>, triangles: Vec<[u32; 3]>) -> Option<Obstacles> {
        let sum = |count: fn(&Part) -> usize| header.parts.iter().map(count).sum::<usize>();
        let vertices = sum(|part| part.vertices as usize);
        let fits = sum(Part::values) == positions.len()
            && sum(|part| part.triangles as usize) == triangles.len()
            && header.parts.iter().all(|part| part.frames() > 0)
            && triangles.iter().flatten().all(|&v| (v as usize) < vertices);
        fits.then_some(Obstacles { header, positions, triangles })
    }

    /// The metadata, for a message.
    pub fn header(&self) -> &ObstacleHeader {
        &self.header
    }

    /// The bulk arrays, for a message: xyz positions (all frames of sequences and the values of rigs included) and
    /// triangles.
    pub fn arrays(&self) -> (&[f32], &[[u32; 3]]) {
        (&self.positions, &self.triangles)
    }

    /// Number of obstacles.
    pub fn len(&self) -> usize {
        self.header.parts.len()
    }

    /// True if there are no obstacles.
    pub fn is_empty(&self) -> bool {
        self.header.parts.is_empty()
    }

    /// Number of vertices of all obstacles.
    pub fn vertices(&self) -> usize {
        self.header.parts.iter().map(|part| part.vertices as usize).sum()
    }

    /// Vertex indices of the triangles of all obstacles.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// The triangles as detection takes them: vertices of a body that an exporter has split along a seam, so that they
    /// always lie at one place, are one vertex.
    pub fn welded_triangles(&self) -> Vec<[u32; 3]> {
        let mut of_vertex: Vec<u32> = (0..self.vertices() as u32).collect();
        let (mut rest, mut first) = (&self.positions[..], 0);
        for part in &self.header.parts {
            let (own, others) = rest.split_at(part.values());
            let range = first..first + part.vertices as usize;
            (rest, first) = (others, range.end);
            let alike = match &part.motion {
                PartMotion::Rigged { rig, .. } => rig.alike(own),
                PartMotion::Cached(cache) => cache.alike(own, part.vertices as usize),
                _ => continue,
            };
            let start = range.start as u32;
            of_vertex[range].iter_mut().zip(alike).for_each(|(vertex, alike)| *vertex = start + alike);
        }
        self.triangles.iter().map(|corners| corners.map(|v| of_vertex[v as usize])).collect()
    }

    /// Only these vertices (ascending), in this order, without triangles; each moves as in the whole.
    pub fn only(&self, vertices: &[u32]) -> Obstacles {
        let mut few = Obstacles::default();
        let (mut rest, mut first, mut wanted) = (&self.positions[..], 0, vertices);
        for part in &self.header.parts {
            let (own, others) = rest.split_at(part.values());
            let end = first + part.vertices;
            let (here, later) = wanted.split_at(wanted.partition_point(|&vertex| vertex < end));
            let local: Vec<u32> = here.iter().map(|vertex| vertex - first).collect();
            (rest, first, wanted) = (others, end, later);
            if local.is_empty() {
                continue;
            }
            let motion = match &part.motion {
                PartMotion::Rigged { rig, .. } => {
                    let (rig, values) = rig.only(own, &local);
                    few.positions.extend_from_slice(&values);
                    PartMotion::Rigged { rig, values: values.len() }
                }
                motion => {
                    for frame in own.chunks_exact(3 * part.vertices as usize) {
                        let points = local.iter().flat_map(|&vertex| &frame[3 * vertex as usize..][..3]);
                        few.positions.extend(points);
                    }
                    motion.clone()
                }
            };
            few.header.parts.push(Part { vertices: local.len() as u32, triangles: 0, motion, ..part.clone() });
        }
        few
    }

    /// The obstacle that a vertex belongs to. It panics if there is no such vertex.
    pub fn obstacle_of_vertex(&self, vertex: usize) -> usize {
        let mut end = 0;
        let found = self.header.parts.iter().position(|part| {
            end += part.vertices as usize;
            vertex < end
        });
        found.expect("a vertex of the obstacles")
    }

    /// Vertices and triangles of every obstacle, in order.
    pub fn ranges(&self) -> Vec<[Range<usize>; 2]> {
        let mut ends = [0; 2];
        let mut next = |counts: [u32; 2]| {
            let starts = ends;
            ends = [0, 1].map(|i| starts[i] + counts[i] as usize);
            [0, 1].map(|i| starts[i]..ends[i])
        };
        self.header.parts.iter().map(|part| next([part.vertices, part.triangles])).collect()
    }

    /// Name of an obstacle.
    pub fn name(&self, obstacle: usize) -> &str {
        &self.header.parts[obstacle].name
    }

    /// Coulomb friction coefficient between an obstacle and cloth.
    pub fn friction(&self, obstacle: usize) -> f64 {
        self.header.parts[obstacle].friction
    }

    /// True if any obstacle moves at any time.
    pub fn moving(&self) -> bool {
        self.header.parts.iter().any(|part| part.moving)
    }

    /// Replaces the content of `out` by the xyz positions of all vertices at a time. They are evaluated in f64 and
    /// rounded once, and depend on nothing but the obstacles and the time.
    pub fn positions_at(&self, time_s: f64, out: &mut Vec<f32>) {
        out.clear();
        out.reserve(3 * self.vertices());
        let mut rest = &self.positions[..];
        for part in &self.header.parts {
            let (own, others) = rest.split_at(part.values());
            rest = others;
            match &part.motion {
                PartMotion::Still => out.extend_from_slice(own),
                PartMotion::Keyframes(motion) => transformed(&motion.transform_at(time_s), own, out),
                PartMotion::Sequence { frames_per_s, frames } => {
                    interpolated(own, *frames as usize, time_s * frames_per_s, out);
                }
                PartMotion::Rigged { rig, .. } => rig.positions_at(own, time_s, out),
                PartMotion::Cached(cache) => cache.positions_at(own, time_s, out),
            }
        }
    }
}

fn transformed(transform: &DAffine3, positions: &[f32], out: &mut Vec<f32>) {
    for p in cast_slice::<f32, Vec3>(positions) {
        out.extend(transform.transform_point3(p.as_dvec3()).as_vec3().to_array());
    }
}

/// Linear interpolation. `at` is the time in frames.
fn interpolated(values: &[f32], frames: usize, at: f64, out: &mut Vec<f32>) {
    let length = values.len() / frames;
    let frame = |i: usize| &values[i * length..(i + 1) * length];
    let before = (at.floor().max(0.0) as usize).min(frames - 1);
    let share = at - before as f64;
    if before + 1 == frames || share <= 0.0 {
        out.extend_from_slice(frame(before));
        return;
    }
    let between = |(&a, &b): (&f32, &f32)| (f64::from(a) + share * (f64::from(b) - f64::from(a))) as f32;
    out.extend(frame(before).iter().zip(frame(before + 1)).map(between));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DVec3;
    use crate::scene::{Keyframe, Playback};

    fn triangle(name: &str, at: f32, movement: Movement) -> Obstacle {
        let positions = [Vec3::ZERO, Vec3::X, Vec3::Y].map(|p| p + at).to_vec();
        Obstacle { name: name.into(), friction: f64::from(at), positions, triangles: vec![[0, 1, 2]], movement }
    }

    fn three() -> Obstacles {
        let key = |time_s, x| Keyframe { translation_m: DVec3::new(x, 0.0, 0.0), ..Keyframe::identity(time_s) };
        let moved = Motion { keyframes: vec![key(0.0, 1.0), key(2.0, 5.0)] };
        let later = vec![vec![Vec3::splat(4.0); 3], vec![Vec3::splat(8.0); 3]];
        Obstacles::new(&[
            triangle("still", 7.0, Movement::Still),
            triangle("moved", 0.0, Movement::Keyframes(moved)),
            triangle("sequence", 0.0, Movement::Sequence { frames_per_s: 2.0, later: later.into() }),
        ])
    }

    #[test]
    fn one_numbering_over_all() {
        let all = three();
        assert_eq!((all.len(), all.vertices(), all.triangles()), (3, 9, &[[0, 1, 2], [3, 4, 5], [6, 7, 8]][..]));
        assert_eq!([0, 2, 3, 8].map(|v| all.obstacle_of_vertex(v)), [0, 0, 1, 2]);
        assert_eq!((all.name(1), all.friction(0), all.moving()), ("moved", 7.0, true));
        assert_eq!(all.ranges(), [[0..3, 0..1], [3..6, 1..2], [6..9, 2..3]]);
        assert!(!Obstacles::new(&[triangle("a", 0.0, Movement::Still)]).moving());
        let key = Motion { keyframes: vec![Keyframe::identity(0.0), Keyframe::identity(1.0)] };
        assert!(!Obstacles::new(&[triangle("a", 0.0, Movement::Keyframes(key))]).moving());
        assert!(Obstacles::default().is_empty() && !Obstacles::default().moving());
    }

    #[test]
    fn a_ball_that_turns_whole_turns_moves() {
        let whole = Motion {
            keyframes: vec![Keyframe::identity(0.0), Keyframe::identity(1.0).turned(DVec3::Y, std::f64::consts::TAU)],
        };
        assert!(Obstacles::new(&[triangle("ball", 0.0, Movement::Keyframes(whole))]).moving());
    }

    #[test]
    fn positions_at_any_time() {
        let all = three();
        let mut out = vec![9.0; 4];
        for (time_s, moved, first, second) in [
            (-1.0, 1.0, 0.0, 1.0),
            (0.0, 1.0, 0.0, 1.0),
            (0.25, 1.5, 2.0, 2.5),
            (0.5, 2.0, 4.0, 4.0),
            (0.75, 2.5, 6.0, 6.0),
            (1.0, 3.0, 8.0, 8.0),
            (9.0, 5.0, 8.0, 8.0),
        ] {
            all.positions_at(time_s, &mut out);
            assert_eq!(out.len(), 27);
            assert_eq!(out[..3], [7.0; 3], "the still one at {time_s} s");
            assert_eq!(out[9..12], [moved, 0.0, 0.0], "the moved one at {time_s} s");
            assert_eq!(out[18..22], [first, first, first, second], "the sequence at {time_s} s");
        }
    }

    /// A node that moves and carries a morph target, two joints that carry a triangle, and a cache of two samples.
    fn more() -> Obstacles {
        use crate::math::{DAffine3, DQuat};
        use crate::scene::rig::{Node, Rig, RigHeader, RigPart, Skin};
        use crate::scene::rig_track::{Interpolation, Pose, Property, Track};
        let playback = Playback { start_s: 0.25, rate: 1.0, repeats: false, lead_in_s: 0.5, length_s: 1.0 };
        let pose = Pose { translation: DVec3::ZERO, rotation: DQuat::IDENTITY, scale: DVec3::ONE };
        let node = |parent, weights| Node { parent, pose, matrix: None, weights };
        let part = RigPart { node: 0, vertices: 3, points: 0, targets: 1, skin: None };
        let joints = Skin {
            joints: vec![0, 1],
            inverse_bind: vec![DAffine3::IDENTITY; 2],
            influences: 2,
            carriers: 27,
            weights: 33,
        };
        let skinned = RigPart { node: 1, vertices: 3, points: 18, targets: 0, skin: Some(joints) };
        let track = |node, property, width, values| Track {
            node,
            property,
            interpolation: Interpolation::Linear,
            keys: 2,
            width,
            times: 39,
            values,
        };
        let points = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let target = [0.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 3.0];
        let weights = [1.0, 0.0, 0.5, 0.5, 0.25, 0.75];
        let carriers = [0.0, 1.0, 0.0, 1.0, 0.0, 1.0];
        let keys = [0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0];
        let values = [&points[..], &target, &points, &carriers, &weights, &keys].concat();
        let header = RigHeader {
            nodes: vec![node(None, vec![0.0]), node(Some(0), Vec::new())],
            tracks: vec![track(0, Property::Weights, 1, 41), track(1, Property::Translation, 3, 43)],
            parts: vec![part, skinned],
            playback: Some(playback),
            placement: DAffine3::from_translation(DVec3::new(0.0, 0.0, 10.0)),
        };
        let rig = Movement::Rigged(Rig { header, values }.into());
        let frames = [9.0, 1.0, 3.0].map(|x| vec![Vec3::splat(x), Vec3::ZERO, Vec3::splat(-x)]).to_vec();
        let cache = Movement::Cached(Cache { playback, times_s: vec![0.0, 1.0], frames }.into());
        let six = [triangle("", 0.0, Movement::Still).positions, vec![Vec3::ZERO; 3]].concat();
        let body = Obstacle { positions: six, ..triangle("body", 0.0, rig) };
        Obstacles::new(&[triangle("still", 7.0, Movement::Still), body, triangle("cache", 0.0, cache)])
    }

    #[test]
    fn bodies_and_caches_move_as_their_clips_say() {
        let all = more();
        let mut out = Vec::new();
        // The lead-in ends at 0.75 s; half a second later the weight is 0.5 and the second joint is 2 m further.
        all.positions_at(1.25, &mut out);
        let at = |vertex: usize| Vec3::from_slice(&out[3 * vertex..]);
        assert_eq!([3, 4, 5].map(at), [[0., 0., 10.5], [1., 0., 11.], [0., 1., 11.5]].map(Vec3::from));
        assert_eq!([6, 7, 8].map(at), [[0., 0., 10.], [2., 0., 10.], [1.5, 1., 10.]].map(Vec3::from));
        assert_eq!([9, 10, 11].map(at), [Vec3::splat(2.0), Vec3::ZERO, Vec3::splat(-2.0)]);
        // Half of the lead-in: half of the first pose of the clip, which is the rest pose here.
        all.positions_at(0.5, &mut out);
        assert_eq!(Vec3::from_slice(&out[27..]), Vec3::splat(5.0));
        assert!(all.moving());
    }

    #[test]
    fn a_few_vertices_move_as_in_the_whole() {
        for (all, few) in [(three(), vec![1, 3, 5, 6, 8]), (more(), vec![0, 3, 5, 6, 8, 9, 11]), (more(), vec![7])] {
            let part = all.only(&few);
            assert_eq!((part.vertices(), part.triangles().len()), (few.len(), 0));
            for time_s in [-1.0, 0.0, 0.4, 0.75, 1.1, 9.0] {
                let (mut whole, mut own) = (Vec::new(), Vec::new());
                all.positions_at(time_s, &mut whole);
                part.positions_at(time_s, &mut own);
                let expected: Vec<f32> = few.iter().flat_map(|&v| whole[3 * v as usize..][..3].to_vec()).collect();
                assert_eq!(own, expected, "{few:?} at {time_s} s");
            }
            let (positions, _) = part.arrays();
            let again = Obstacles::from_parts(part.header().clone(), positions.to_vec(), Vec::new());
            assert_eq!(again.as_ref(), Some(&part));
        }
        assert!(three().only(&[]).is_empty());
    }

    #[test]
    fn vertices_that_are_always_at_one_place_are_one_for_contacts() {
        let all = more();
        assert_eq!(all.welded_triangles(), all.triangles(), "none is doubled");
        let frames = vec![vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::X, Vec3::X]; 3];
        let playback = Playback { start_s: 0.0, rate: 1.0, repeats: false, lead_in_s: 0.0, length_s: 1.0 };
        let mut moved = frames.clone();
        moved[2][4] = Vec3::Z;
        let cache = Movement::Cached(Cache { playback, times_s: vec![0.0, 1.0], frames: moved }.into());
        let seam = Obstacle {
            positions: frames[0].clone(),
            triangles: vec![[0, 1, 2], [0, 3, 2], [0, 4, 2]],
            ..triangle("seam", 0.0, cache)
        };
        assert_eq!(Obstacles::new(&[seam]).welded_triangles(), [[0, 1, 2], [0, 1, 2], [0, 4, 2]]);
    }

    #[test]
    fn apart_and_together_again() {
        let all = three();
        let (positions, triangles) = all.arrays();
        assert_eq!(positions.len(), 3 * (3 + 3 + 9));
        let config = bincode::config::standard();
        let bytes = bincode::serde::encode_to_vec(all.header(), config).unwrap();
        let (header, _): (ObstacleHeader, _) = bincode::serde::decode_from_slice(&bytes, config).unwrap();
        let (positions, triangles) = (positions.to_vec(), triangles.to_vec());
        assert_eq!(Obstacles::from_parts(header.clone(), positions.clone(), triangles.clone()).as_ref(), Some(&all));
        assert_eq!(Obstacles::from_parts(header.clone(), positions[1..].to_vec(), triangles.clone()), None);
        assert_eq!(Obstacles::from_parts(header.clone(), positions.clone(), triangles[1..].to_vec()), None);
        assert_eq!(Obstacles::from_parts(header, positions, vec![[0, 1, 9]; 3]), None);
    }
}
