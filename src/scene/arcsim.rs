//! stub
use super::*;
pub(super) fn parse(_t: &str, path: &Path, _o: &Overrides) -> Result<Scene, SceneError> {
    Err(SceneError::File { path: path.into(), what: "".into() })
}
