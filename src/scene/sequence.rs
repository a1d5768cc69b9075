//! `dir/frame_%04d.obj`: patterns of numbered files, and the meshes of one deforming obstacle in them.

use std::path::{Path, PathBuf};

use crate::math::Vec3;
use crate::mesh::{Surface, read_surface};

use super::SceneError;

/// Most numbers that all positions of one sequence have: 4 GiB.
const MOST_VALUES: usize = 1 << 30;
/// Widest number in a pattern.
const WIDEST: usize = 9;

/// A file name with one number in it, as C's printf writes it: `%d` or `%04d`.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Pattern {
    before: String,
    width: usize,
    after: String,
}

impl Pattern {
    /// None if the text has no number or more than one, or a `%` that is none.
    pub fn parse(text: &str) -> Option<Pattern> {
        let (before, rest) = text.split_once('%')?;
        let (width, after) = rest.split_once('d')?;
        let digits = width.strip_prefix('0').unwrap_or(if width.is_empty() { "1" } else { "x" });
        let width: usize = digits.parse().ok().filter(|width| (1..=WIDEST).contains(width))?;
        let plain = !after.contains('%') && digits.bytes().all(|c| c.is_ascii_digit());
        plain.then(|| Pattern { before: before.into(), width, after: after.into() })
    }

    /// The name with this number.
    pub fn name(&self, number: u32) -> String {
        format!("{}{number:0width$}{}", self.before, self.after, width = self.width)
    }

    /// The existing files with numbers from 0 or 1 up to the first that is missing; `resolve` says where a name is.
    pub fn files(&self, resolve: impl Fn(&str) -> Option<PathBuf>) -> Vec<PathBuf> {
        let first = u32::from(resolve(&self.name(0)).is_none());
        (first..).map_while(|number| resolve(&self.name(number))).collect()
    }
}

/// Reads the frames; every one must have the vertices and triangles of the first. The positions as `place` puts them.
pub(super) fn read_frames(
    files: &[PathBuf],
    place: impl Fn(&mut [Vec3]),
) -> Result<(Surface, Vec<Vec<Vec3>>), SceneError> {
    let fault = |path: &Path, what: String| SceneError::File { path: path.into(), what };
    let mut first: Option<Surface> = None;
    let mut later = Vec::new();
    for path in files {
        let mut frame = read_surface(path)?;
        place(&mut frame.positions);
        if let Some(vertex) = frame.positions.iter().position(|p| !p.is_finite()) {
            return Err(fault(path, format!("at its place in the scene, vertex {} is not finite", vertex + 1)));
        }
        let Some(first) = &first else {
            if files.len().saturating_mul(3 * frame.positions.len()) > MOST_VALUES {
                let what = format!("{} frames of {} vertices are too many", files.len(), frame.positions.len());
                return Err(fault(path, format!("{what}: at most {} positions are held", MOST_VALUES / 3)));
            }
            first = Some(frame);
            continue;
        };
        if (frame.positions.len(), &frame.triangles) != (first.positions.len(), &first.triangles) {
            let what = format!(
                "has other vertices or triangles ({}, {}) than the first of its sequence, {} ({}, {})",
                frame.positions.len(),
                frame.triangles.len(),
                files[0].display(),
                first.positions.len(),
                first.triangles.len()
            );
            return Err(fault(path, what));
        }
        later.push(frame.positions);
    }
    let first = first.ok_or_else(|| fault(Path::new(""), "a sequence has no file".into()))?;
    Ok((first, later))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_have_one_number() {
        let pattern = Pattern::parse("a/b_%04d.obj").unwrap();
        assert_eq!((pattern.name(7), pattern.name(12345)), ("a/b_0007.obj".into(), "a/b_12345.obj".into()));
        assert_eq!(Pattern::parse("%d").unwrap().name(10), "10");
        for wrong in ["a.obj", "%s", "%", "a%5d", "%00d", "%012d", "%d_%d", "%0-3d", "%0+3d", "%04"] {
            assert_eq!(Pattern::parse(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn numbers_run_from_zero_or_one_to_the_first_gap() {
        let there = |names: &'static [&str]| move |name: &str| names.contains(&name).then(|| PathBuf::from(name));
        let files = |names| Pattern::parse("%02d").unwrap().files(there(names)).len();
        assert_eq!(files(&["00", "01", "02", "04"]), 3);
        assert_eq!(files(&["01", "02"]), 2);
        assert_eq!(files(&["02"]), 0);
    }
}
