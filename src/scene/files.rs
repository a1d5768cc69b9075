//! Finds and reads files that a scene names.

use std::io::Read;
use std::path::{Path, PathBuf};

use crate::input::{Input, Streams};

use super::error::SceneError;

/// Longest text that is read. Scenes are written by hand and stay far below it.
const LONGEST_TEXT_BYTES: u64 = 16 << 20;

/// Reads the text of a scene file or of a file that it names. Pipes, devices and text that is not UTF-8 are refused.
pub(super) fn read_text(path: &Path) -> Result<String, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    let unreadable = |error: std::io::Error| fault(format!("cannot be read: {error}"));
    let input = Input::open(path, Streams::Refused).map_err(unreadable)?;
    let mut bytes = Vec::new();
    input.reader.take(LONGEST_TEXT_BYTES + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > LONGEST_TEXT_BYTES {
        return Err(fault(format!("is longer than {LONGEST_TEXT_BYTES} bytes, which no scene is")));
    }
    String::from_utf8(bytes).map_err(|_| fault("is not UTF-8 text".into()))
}

/// Looks up a file that a scene names, beside the scene and then in the working directory.
pub(super) fn find(scene: &Path, name: &str) -> Result<PathBuf, String> {
    let beside = scene.parent().unwrap_or(Path::new("")).join(name);
    let found = [beside, PathBuf::from(name)].into_iter().find(|path| path.is_file());
    found.ok_or_else(|| format!("no file `{name}` beside the scene or in the working directory"))
}
