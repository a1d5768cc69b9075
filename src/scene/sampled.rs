//! Meshes of a file whose points, and the transforms above them, have samples at times of their own. Their positions
//! are brought to common times, between which every vertex goes straight.

use crate::math::{DAffine3, DVec3, Vec3};

/// A transform that turns bends the way of a vertex between two samples. Positions are added in the middle until the
/// way is this straight, as a share of the size of the body.
const BEND: f64 = 1e-5;
/// How often an interval between two samples is halved at most.
const HALVINGS: u32 = 8;
/// No positions are added beyond this number of them (240 MB).
const MOST_ADDED: usize = 20_000_000;

/// A mesh.
pub(super) struct SampledMesh<'a> {
    /// Its name in the file, for messages.
    pub name: String,
    /// Vertex indices, all valid.
    pub triangles: Vec<[u32; 3]>,
    /// Times of all samples that move it, ascending, seconds; empty if it stands still.
    pub times_s: Vec<f64>,
    /// True if a transform above it moves, so that its vertices may not go straight between the samples.
    pub turns: bool,
    /// Positions of its vertices at rest, if the file gives them.
    pub rest: Option<Vec<Vec3>>,
    /// Positions of its vertices at a time, in the coordinates of the file.
    pub at: Box<dyn Fn(f64) -> Result<Vec<Vec3>, String> + 'a>,
}

/// All meshes as one.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct SampledBody {
    pub triangles: Vec<[u32; 3]>,
    /// Times of the frames, ascending, seconds; a single one if nothing moves.
    pub times_s: Vec<f64>,
    /// Positions of all vertices at these times.
    pub frames: Vec<Vec<Vec3>>,
    /// Positions at rest where the file gives them.
    pub rest: Option<Vec<Vec3>>,
    /// Names of the meshes.
    pub names: Vec<String>,
}

/// Joins meshes; at most `most` positions are held. An error is half a sentence.
pub(super) fn sampled(meshes: Vec<SampledMesh>, most: usize) -> Result<SampledBody, String> {
    let mut body = SampledBody::default();
    let mut times_s: Vec<f64> = meshes.iter().flat_map(|mesh| mesh.times_s.iter().copied()).collect();
    if let Some(time) = times_s.iter().find(|time| !time.is_finite() || time.abs() > 1e9) {
        return Err(format!("has a sample at the time {time}"));
    }
    times_s.sort_by(f64::total_cmp);
    // Two clocks round the same time differently.
    times_s.dedup_by(|b, a| (*b - *a).abs() < 1e-9);
    if times_s.is_empty() {
        times_s.push(0.0);
    }
    let at = |time_s: f64| -> Result<Vec<Vec3>, String> {
        let mut all = Vec::new();
        for mesh in &meshes {
            let points = (mesh.at)(time_s)?;
            if let Some(at) = points.iter().position(|p| !p.is_finite()) {
                return Err(format!("point {at} (from 0) of `{}` at {time_s} s is not a finite number", mesh.name));
            }
            all.extend(points);
        }
        Ok(all)
    };
    let first = at(times_s[0])?;
    let mut first_vertex = 0;
    for mesh in &meshes {
        body.triangles.extend(mesh.triangles.iter().map(|corners| corners.map(|v| v + first_vertex)));
        first_vertex += (mesh.at)(times_s[0])?.len() as u32;
        body.names.push(mesh.name.clone());
    }
    let vertices = first.len();
    let held = |frames: usize| frames.saturating_mul(vertices);
    if held(times_s.len()) > most {
        return Err(format!("has {} samples, which are too many: at most {most} positions are held", times_s.len()));
    }
    let rest = meshes.iter().map(|mesh| mesh.rest.clone()).collect::<Option<Vec<Vec<Vec3>>>>();
    body.rest = rest.map(|rest| rest.concat()).filter(|rest| rest.len() == first.len());
    let turns = meshes.iter().any(|mesh| mesh.turns);
    let bend = BEND * crate::mesh::extent(&first);
    body.frames.push(first);
    body.times_s.push(times_s[0]);
    for &end_s in &times_s[1..] {
        let end = at(end_s)?;
        // Later halves wait; the next one to be looked at is the last.
        let mut waiting = vec![(end_s, end, 0)];
        while let Some((end_s, end, halvings)) = waiting.pop() {
            let last = body.frames.len() - 1;
            let middle_s = (body.times_s[last] + end_s) / 2.0;
            if turns && halvings < HALVINGS && held(body.frames.len() + waiting.len() + 2) <= most.min(MOST_ADDED) {
                let middle = at(middle_s)?;
                let straight = |i: usize| (body.frames[last][i] + end[i]) / 2.0;
                if middle.iter().enumerate().any(|(i, p)| f64::from(p.distance(straight(i))) > bend) {
                    waiting.push((end_s, end, halvings + 1));
                    waiting.push((middle_s, middle, halvings + 1));
                    continue;
                }
            }
            body.frames.push(end);
            body.times_s.push(end_s);
        }
    }
    Ok(body)
}

/// True if a path is that of an object, or of one below it. `name`: a whole path, or one name in it.
pub(super) fn is_below(path: &str, name: &str) -> bool {
    let inner = name.trim_matches('/');
    let path = path.trim_start_matches('/');
    match name.contains('/') {
        true => path.strip_prefix(inner).is_some_and(|rest| rest.is_empty() || rest.starts_with('/')),
        false => path.split('/').any(|part| part == inner),
    }
}

/// The two samples around a time and the share of the second; both are one at a sample and beyond the ends. Two times
/// that differ by rounding are one.
pub(super) fn around(times_s: &[f64], time_s: f64) -> (usize, usize, f64) {
    let after = times_s.partition_point(|&time| time <= time_s + 1e-9);
    let before = after.max(1) - 1;
    match times_s.get(after) {
        Some(next) if after > 0 && time_s - times_s[before] > 1e-9 => {
            (before, after, (time_s - times_s[before]) / (next - times_s[before]))
        }
        _ => (before, before, 0.0),
    }
}

/// Points between two samples, moved by a transform; bit for bit those of the file where there is nothing to do.
pub(super) fn placed(from: &[Vec3], to: &[Vec3], share: f64, transform: &DAffine3) -> Vec<Vec3> {
    let is_plain = *transform == DAffine3::IDENTITY;
    let between = |(a, b): (&Vec3, &Vec3)| {
        let (a, b): (DVec3, DVec3) = (a.as_dvec3(), b.as_dvec3());
        let p = if share > 0.0 { a + share * (b - a) } else { a };
        (if is_plain { p } else { transform.transform_point3(p) }).as_vec3()
    };
    from.iter().zip(to).map(between).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::DQuat;

    #[test]
    fn objects_are_named_by_name_or_path() {
        for (path, name, is) in [
            ("/a/b", "b", true),
            ("/a/b", "a", true),
            ("/a/b", "/a", true),
            ("/a/b", "/b", false),
            ("/ab/c", "a", false),
            ("/ab/c", "/a", false),
            ("/a/b", "a/b", true),
        ] {
            assert_eq!(is_below(path, name), is, "{path} {name}");
        }
    }

    #[test]
    fn samples_around_a_time() {
        let times = [1.0, 2.0, 4.0];
        assert_eq!(around(&times, 0.0), (0, 0, 0.0));
        assert_eq!(around(&times, 1.0), (0, 0, 0.0));
        assert_eq!(around(&times, 2.0 - 1e-12), (1, 1, 0.0), "rounding");
        assert_eq!(around(&times, 3.0), (1, 2, 0.5));
        assert_eq!(around(&times, 9.0), (2, 2, 0.0));
    }

    /// A point at the end of an arm that turns by a right angle within a second, and one that goes straight meanwhile.
    #[test]
    fn what_turns_gets_samples_in_between() {
        let arm = |time_s: f64| (DQuat::from_rotation_y(time_s * 1.5) * DVec3::X).as_vec3();
        let mesh = |turns| SampledMesh {
            name: "arm".into(),
            triangles: vec![[0, 1, 2]],
            times_s: vec![0.0, 1.0],
            turns,
            rest: None,
            at: Box::new(move |time_s| Ok(vec![arm(time_s), Vec3::splat(time_s as f32), Vec3::ZERO])),
        };
        let plain = sampled(vec![mesh(false)], 1000).unwrap();
        assert_eq!(plain.times_s, [0.0, 1.0]);
        let body = sampled(vec![mesh(true), mesh(false)], 10_000).unwrap();
        assert_eq!(body.triangles, [[0, 1, 2], [3, 4, 5]]);
        assert!(body.times_s.len() > 64 && body.times_s.len() <= 257, "{:?}", body.times_s);
        assert!(body.times_s.windows(2).all(|pair| pair[0] < pair[1]));
        for (pair, times) in body.frames.windows(2).zip(body.times_s.windows(2)) {
            let off = ((pair[0][0] + pair[1][0]) / 2.0).distance(arm((times[0] + times[1]) / 2.0));
            assert!(off < 1.1e-5, "{off}");
        }
        let few = sampled(vec![mesh(true)], 9).unwrap();
        assert_eq!(few.times_s.len(), 3, "no more positions than allowed");
        assert!(sampled(vec![mesh(false)], 5).unwrap_err().contains("2 samples"));
    }
}
