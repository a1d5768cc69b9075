//! Numbered files (`dir/frame_%04d.obj`) and the deforming obstacle whose meshes they hold.

use std::path::{Path, PathBuf};

use crate::math::Vec3;
use crate::mesh::{Surface, needles, read_file};

use super::SceneError;

/// Limit of the coordinates of all frames of a sequence: 4 GiB.
pub(super) const MOST_VALUES: usize = 1 << 30;
/// Most digits of a number in a pattern.
const WIDEST: usize = 9;

/// A file name with one number in the notation of C's printf: `%d` or `%04d`.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Pattern {
    before: String,
    width: usize,
    after: String,
}

impl Pattern {
    /// None if the text has no number, several numbers or another use of `%`.
    pub(super) fn parse(text: &str) -> Option<Pattern> {
        let (before, rest) = text.split_once('%')?;
        let (width, after) = rest.split_once('d')?;
        let digits = width.strip_prefix('0').unwrap_or(if width.is_empty() { "1" } else { "x" });
        let width: usize = digits.parse().ok().filter(|width| (1..=WIDEST).contains(width))?;
        let plain = !after.contains('%') && digits.bytes().all(|c| c.is_ascii_digit());
        plain.then(|| Pattern { before: before.into(), width, after: after.into() })
    }

    /// The file name with this number.
    pub(super) fn name(&self, number: u32) -> String {
        format!("{}{number:0width$}{}", self.before, self.after, width = self.width)
    }

    /// The files from the number `first` (none: the smallest) to the largest existing one, beside the scene or else in
    /// the working directory.
    ///
    /// # Errors
    /// There are no files, or a number in between is missing. The error is half a sentence.
    pub(super) fn files(&self, scene: &Path, first: Option<u32>) -> Result<Vec<PathBuf>, String> {
        let beside = scene.parent().unwrap_or(Path::new(""));
        let found =
            [beside, Path::new("")].into_iter().map(|root| (root, self.numbers(root))).find(|(_, n)| !n.is_empty());
        let Some((root, mut numbers)) = found else {
            return Err(format!(
                "there is no file such as `{}` beside the scene or in the working directory",
                self.name(first.unwrap_or(1))
            ));
        };
        if let Some(first) = first {
            let [least, most] = [numbers[0], numbers[numbers.len() - 1]];
            numbers.retain(|&number| number >= first);
            if numbers.first() != Some(&first) {
                let name = self.name(first);
                return Err(format!("number {first} is missing: there are numbers {least} to {most}, but no `{name}`"));
            }
        }
        if let Some(pair) = numbers.windows(2).find(|pair| pair[1] != pair[0] + 1) {
            let (missing, next) = (pair[0] + 1, pair[1]);
            let name = self.name(missing);
            return Err(match next - missing {
                1 => format!(
                    "number {missing} is missing: there are `{}` and `{}`, but no `{name}`",
                    self.name(missing - 1),
                    self.name(next)
                ),
                count => format!(
                    "numbers {missing} to {} are missing ({count} files): there is `{}`, but no `{name}`",
                    next - 1,
                    self.name(next)
                ),
            });
        }
        Ok(numbers.into_iter().map(|number| root.join(self.name(number))).collect())
    }

    /// The smallest number of at least `least` that has a file below the folder `root`.
    pub(super) fn next_from(&self, root: &Path, least: u32) -> Option<u32> {
        self.numbers(root).into_iter().find(|&number| number >= least)
    }

    /// Numbers of the existing files below the folder `root`, ascending.
    fn numbers(&self, root: &Path) -> Vec<u32> {
        // The number can be part of a folder name.
        let (folder, start) =
            self.before.rsplit_once('/').map_or(("", &self.before[..]), |(folder, start)| (folder, start));
        let folder =
            if self.before.starts_with('/') && folder.is_empty() { Path::new("/") } else { &root.join(folder) };
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let end = self.after.split('/').next().unwrap_or_default();
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        let number = |entry: std::fs::DirEntry| -> Option<u32> {
            let name = entry.file_name().into_string().ok()?;
            let digits = name.strip_prefix(start)?.strip_suffix(end)?;
            let number = digits.parse().ok().filter(|_| digits.bytes().all(|c| c.is_ascii_digit()))?;
            // The digits must be those that the pattern writes.
            (format!("{number:0width$}", width = self.width) == digits && root.join(self.name(number)).is_file())
                .then_some(number)
        };
        let mut numbers: Vec<u32> = entries.filter_map(number).collect();
        numbers.sort_unstable();
        numbers
    }
}

/// Meshes of a sequence.
pub(super) struct Frames {
    pub first: Surface,
    /// Positions of the frames after the first.
    pub later: Vec<Vec<Vec3>>,
    /// A sentence about triangles that are left out.
    pub left_out: Option<String>,
}

/// Reads the frames, in units of `unit_m` meters, and moves their positions by `place`. Every frame must have the
/// vertices and triangles of the first. Triangles without area in one of the frames are left out.
pub(super) fn read_frames(files: &[PathBuf], unit_m: f64, place: impl Fn(&mut Surface)) -> Result<Frames, SceneError> {
    let fault = |path: &Path, what: String| SceneError::File { path: path.into(), what };
    let mut first: Option<Surface> = None;
    let (mut later, mut flat) = (Vec::new(), Vec::new());
    for path in files {
        let mut frame = read_file(path, unit_m)?;
        place(&mut frame);
        if let Some(vertex) = frame.positions.iter().position(|p| !p.is_finite()) {
            return Err(fault(path, format!("at its place in the scene, vertex {} is not finite", vertex + 1)));
        }
        let needles = needles(&frame.positions, &frame.triangles);
        let Some(first) = &first else {
            if files.len().saturating_mul(3 * frame.positions.len()) > MOST_VALUES {
                let what = format!("{} frames of {} vertices are too many", files.len(), frame.positions.len());
                return Err(fault(path, format!("{what}: at most {} positions are held", MOST_VALUES / 3)));
            }
            flat = needles;
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
        flat.iter_mut().zip(needles).for_each(|(flat, needle)| *flat |= needle);
        later.push(frame.positions);
    }
    let mut first = first.ok_or_else(|| fault(Path::new(""), "a sequence has no file".into()))?;
    if !flat.contains(&false) {
        return Err(fault(&files[0], "the sequence has no triangle that has an area in every frame".into()));
    }
    let left_out = first.leave_out(&flat, &files[0]);
    Ok(Frames { first, later, left_out })
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
    fn the_first_number_is_free_and_a_gap_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("s.toml");
        let files = |pattern: &str, names: &[&str]| {
            for name in names {
                let path = folder.path().join(name);
                std::fs::create_dir_all(path.parent().unwrap()).unwrap();
                std::fs::write(path, "").unwrap();
            }
            Pattern::parse(pattern).unwrap().files(&scene, None).map(|files| files.len())
        };
        let from = |pattern: &str, first: u32| {
            Pattern::parse(pattern).unwrap().files(&scene, Some(first)).map(|files| files.len())
        };
        assert_eq!(
            files("a_%02d.obj", &["a_00.obj", "a_01.obj", "a_02.obj", "a_1.obj", "a_002.obj", "a_x.obj"]),
            Ok(3)
        );
        assert_eq!(files("b.%04d.obj", &["b.1001.obj", "b.1002.obj"]), Ok(2), "film counts from 1001");
        assert_eq!(from("b.%04d.obj", 1002), Ok(1));
        assert_eq!(
            from("b.%04d.obj", 1000).unwrap_err(),
            "number 1000 is missing: there are numbers 1001 to 1002, but no `b.1000.obj`"
        );
        assert_eq!(files("shot_%d/body.obj", &["shot_9/body.obj", "shot_10/body.obj", "shot_11/other.obj"]), Ok(2));
        assert_eq!(
            files("a_%02d.obj", &["a_04.obj"]).unwrap_err(),
            "number 3 is missing: there are `a_02.obj` and `a_04.obj`, but no `a_03.obj`"
        );
        assert_eq!(
            files("b.%04d.obj", &["b.1240.obj"]).unwrap_err(),
            "numbers 1003 to 1239 are missing (237 files): there is `b.1240.obj`, but no `b.1003.obj`"
        );
        assert!(files("none_%02d.obj", &[]).unwrap_err().contains("`none_01.obj`"));
    }
}
