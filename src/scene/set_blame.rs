//! Which `--set` a refused scene is due to.

use super::SceneError;

/// The error of a scene whose text was made from a file and the fields `set`: it names the flag that it is due to, or
/// the line of the file if it is due to none. `attempt`: the error with other fields of `set`, if there is one.
pub fn blame(error: SceneError, set: &[String], attempt: impl Fn(&[String]) -> Option<SceneError>) -> SceneError {
    if set.is_empty() || matches!(error, SceneError::File { .. } | SceneError::Mesh(_)) {
        return error;
    }
    let same = |other: &Option<SceneError>| other.as_ref().is_some_and(|other| sentence(other) == sentence(&error));
    // Later flags replace what earlier ones have set.
    for (i, flag) in set.iter().enumerate().rev() {
        let without: Vec<String> = set.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, f)| f.clone()).collect();
        if !same(&attempt(&without)) {
            return of_flag(error, flag);
        }
    }
    let plain = attempt(&[]);
    match plain {
        Some(plain) if sentence(&plain) == sentence(&error) => plain,
        _ => without_line(error),
    }
}

/// What is wrong with which field.
fn sentence(error: &SceneError) -> String {
    match error {
        SceneError::Field { field, what, .. } => format!("{field}: {what}"),
        SceneError::Crossing { field, crossings, .. } => format!("{field}: {crossings}"),
        other => other.what(),
    }
}

fn of_flag(error: SceneError, flag: &str) -> SceneError {
    match error {
        SceneError::Field { path, field, what, .. } => {
            SceneError::File { path, what: format!("--set {flag}: field `{field}`: {what}") }
        }
        SceneError::Syntax { path, what, .. } => SceneError::File { path, what: format!("--set {flag}: {what}") },
        other => without_line(other),
    }
}

fn without_line(mut error: SceneError) -> SceneError {
    match &mut error {
        SceneError::Syntax { line, .. } | SceneError::Field { line, .. } | SceneError::Crossing { line, .. } => {
            *line = None
        }
        SceneError::File { .. } | SceneError::Mesh(_) => {}
    }
    error
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::scene::{read_str, set_fields};

    const SCENE: &str = "[simulation]\nfriction = 0.1\n[[cloth]]\nsheet = { size_m = [1, 1] }\n";

    fn refused(text: &str, set: &[&str]) -> String {
        let set: Vec<String> = set.iter().map(|flag| flag.to_string()).collect();
        let attempt = |set: &[String]| read_str(&set_fields(text, set).unwrap(), Path::new("a.toml")).map(|_| ()).err();
        blame(attempt(&set).unwrap(), &set, attempt).to_string()
    }

    #[test]
    fn the_flag_is_named_and_otherwise_the_line_of_the_file() {
        let error = refused(SCENE, &["name=a", "simulation.friction=-1", "cloth.0.name=b"]);
        assert!(error.starts_with("a.toml: --set simulation.friction=-1: field `simulation.friction`: "), "{error}");
        let error = refused(SCENE, &["simulation.frictoin=1", "simulation.friction=1"]);
        assert!(error.starts_with("a.toml: --set simulation.frictoin=1: field `simulation.frictoin`: "), "{error}");
        // The last of two values counts.
        let error = refused(SCENE, &["simulation.friction=1", "simulation.friction=-1"]);
        assert!(error.contains("--set simulation.friction=-1: "), "{error}");
        let wrong = SCENE.replace("friction = 0.1", "\n\nfriction = -2");
        let error = refused(&wrong, &["name=a"]);
        assert!(error.starts_with("a.toml, line 4: field `simulation.friction`: "), "{error}");
    }
}
