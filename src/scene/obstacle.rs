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
    use crate::scene::Keyframe;

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
