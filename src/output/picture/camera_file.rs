//! Cameras as files that people edit: `loomtree render --camera` and `--save-camera`.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::camera::Camera;
use crate::math::{DVec3, Vec3};

/// A camera, or one that moves from key to key.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CameraFile {
    /// Focal length for a sensor 24 mm high, millimeters, where a key says nothing else.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lens_mm: Option<f64>,
    /// Ascending by frame.
    pub key: Vec<CameraKey>,
}

/// Where the camera is at a frame. Between keys all values change evenly; before the first and after the last key they
/// stay.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct CameraKey {
    /// Number of the frame.
    #[serde(default)]
    pub frame: u32,
    /// Position, meters.
    pub eye: [f64; 3],
    /// A point in the middle of the picture, meters.
    pub target: [f64; 3],
    /// Direction of the picture's top; the scene's up axis if missing.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up: Option<[f64; 3]>,
    /// Focal length for a sensor 24 mm high, millimeters.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lens_mm: Option<f64>,
}

impl CameraFile {
    /// Reads a camera from TOML.
    ///
    /// # Errors
    /// One sentence with the file: it cannot be read, a value is missing or wrong, or the camera sees nothing.
    pub fn read(path: &Path) -> Result<CameraFile, String> {
        let text = std::fs::read_to_string(path).map_err(|error| format!("{}: {error}", path.display()))?;
        CameraFile::parse(&text).map_err(|what| format!("{}: {what}", path.display()))
    }

    fn parse(text: &str) -> Result<CameraFile, String> {
        let file: CameraFile = toml::from_str(text).map_err(|error| {
            let line = error.span().map_or(1, |span| text[..span.start.min(text.len())].matches('\n').count() + 1);
            format!("line {line}: {}", error.message().replace('\n', ", "))
        })?;
        if file.key.is_empty() {
            return Err("a camera needs a [[key]] with eye and target".into());
        }
        if file.key.windows(2).any(|pair| pair[0].frame >= pair[1].frame) {
            return Err("the frames of keys must rise".into());
        }
        for (i, key) in file.key.iter().enumerate() {
            let [eye, target] = [key.eye, key.target].map(DVec3::from_array);
            let up = key.up.map(DVec3::from_array);
            let lens = key.lens_mm.or(file.lens_mm).unwrap_or(50.0);
            let wrong = |what: &str| Err(format!("key {i}: {what}"));
            if !eye.is_finite() || !target.is_finite() || (target - eye).length() < 1e-6 {
                return wrong("eye and target must be two points");
            }
            if up.is_some_and(|up| !up.is_finite() || up.cross(target - eye).length() < 1e-9) {
                return wrong("up must not point along the line of sight");
            }
            if !(1.0..=10_000.0).contains(&lens) {
                return wrong("lens_mm must be from 1 to 10000");
            }
        }
        Ok(file)
    }

    /// The file of one camera. `origin_m`: where the scene's origin is for it.
    pub(super) fn of(camera: &Camera, distance_m: f32, origin_m: DVec3) -> CameraFile {
        // A tenth of a millimeter; and values that people can read.
        let rounded = |v: DVec3| v.to_array().map(|x| (x * 1e4).round() / 1e4);
        let eye = camera.eye.as_dvec3();
        let target = eye + (camera.forward * distance_m).as_dvec3();
        let key = CameraKey {
            frame: 0,
            eye: rounded(eye + origin_m),
            target: rounded(target + origin_m),
            up: None,
            lens_mm: None,
        };
        CameraFile { lens_mm: Some((f64::from(camera.lens_mm()) * 100.0).round() / 100.0), key: vec![key] }
    }

    /// As a file with a comment.
    pub fn text(&self) -> String {
        let head = "# A camera of `loomtree render --camera`: meters, and the lens for a sensor 24 mm high.\n\
                    # More keys with rising frames make it move; `up = [x, y, z]` in a key tilts it.\n";
        format!("{head}{}", toml::to_string(self).unwrap_or_default())
    }

    /// Eye, target, top of the picture and lens at a frame, about `origin_m`.
    pub(super) fn at(&self, frame: u32, world_up: Vec3, origin_m: DVec3, lens_mm: f32) -> ([Vec3; 3], f32) {
        let of = |key: &CameraKey| {
            let about = |p: [f64; 3]| (DVec3::from_array(p) - origin_m).as_vec3();
            let up = key.up.map_or(world_up, |up| DVec3::from_array(up).normalize_or(DVec3::Z).as_vec3());
            let lens = key.lens_mm.or(self.lens_mm).map_or(lens_mm, |lens| lens as f32);
            ([about(key.eye), about(key.target), up], lens)
        };
        let next = self.key.partition_point(|key| key.frame <= frame);
        let (before, after) = (&self.key[next.saturating_sub(1)], &self.key[next.min(self.key.len() - 1)]);
        if after.frame <= before.frame {
            return of(before);
        }
        let share = (frame - before.frame) as f32 / (after.frame - before.frame) as f32;
        let ((from, from_lens), (to, to_lens)) = (of(before), of(after));
        let blended = std::array::from_fn(|i| Vec3::lerp(from[i], to[i], share));
        (blended, from_lens + (to_lens - from_lens) * share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_blended_and_stay_at_both_ends() {
        let text = "lens_mm = 50\n[[key]]\nframe = 10\neye = [0, 0, 0]\ntarget = [1, 0, 0]\n[[key]]\nframe = 20\n\
                    eye = [2, 0, 0]\ntarget = [1, 4, 0]\nlens_mm = 100";
        let file = CameraFile::parse(text).unwrap();
        let at = |frame| file.at(frame, Vec3::Z, DVec3::X, 35.0);
        let x = Vec3::new(-1.0, 0.0, 0.0);
        assert_eq!(at(0), ([x, Vec3::ZERO, Vec3::Z], 50.0));
        assert_eq!(at(15), ([Vec3::ZERO, Vec3::new(0.0, 2.0, 0.0), Vec3::Z], 75.0));
        assert_eq!(at(99), ([Vec3::X, Vec3::new(0.0, 4.0, 0.0), Vec3::Z], 100.0));
        assert_eq!(CameraFile::parse(&file.text()).unwrap(), file);
    }

    #[test]
    fn a_wrong_camera_is_one_sentence() {
        for (text, what) in [
            ("", "missing field `key`"),
            ("key = []", "needs a [[key]]"),
            ("[[key]]\neye = [0, 0, 0]\ntarget = [0, 0, 0]", "key 0: eye and target must be two points"),
            ("[[key]]\neye = [0, 0]\ntarget = [0, 0, 1]", "line 2: "),
            ("[[key]]\neye = [0, 0, 0]\ntarget = [0, 0, 1]\nup = [0, 0, 2]", "up must not point along"),
            ("[[key]]\neye = [0, 0, 0]\ntarget = [0, 0, 1]\nlens_mm = 0", "lens_mm must be from 1"),
            ("[[key]]\neye = [0, 0, 0]\ntarget = [0, 0, 1]\nzoom = 2", "line 4: unknown field `zoom`"),
        ] {
            let error = CameraFile::parse(text).unwrap_err();
            assert!(error.contains(what) && !error.contains('\n'), "{error}");
        }
    }
}
