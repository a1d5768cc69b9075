//! Reads JSON with comments (ARCSim's files), so that errors name the file and the field, or the line for bad syntax.

use std::path::Path;

use serde_json::Value;

use crate::math::{DQuat, DVec3};

use super::error::{Place, SceneError};

/// Deepest nesting that is accepted, because the parser recurses once per level.
const DEEPEST: usize = 64;

/// Parses JSON with comments, trailing commas and single quotes.
pub(super) fn parse_json(text: &str, path: &Path) -> Result<Value, SceneError> {
    let fault = |what: String| SceneError::File { path: path.into(), what };
    if nesting(text) > DEEPEST {
        return Err(fault(format!("brackets are nested more than {DEEPEST} deep")));
    }
    json5::from_str(text.trim_start_matches('\u{feff}')).map_err(|error| {
        let line = error.position().map(|at| at.line + 1);
        let what = error.code().map_or_else(|| error.to_string(), |code| code.to_string());
        SceneError::Syntax { path: path.into(), line, what }
    })
}

/// Depth of the brackets outside strings and comments.
fn nesting(text: &str) -> usize {
    let (mut depth, mut deepest) = (0usize, 0);
    let mut bytes = text.bytes().peekable();
    while let Some(c) = bytes.next() {
        match (c, bytes.peek()) {
            (b'[' | b'{', _) => depth += 1,
            (b']' | b'}', _) => depth = depth.saturating_sub(1),
            (quote @ (b'"' | b'\''), _) => {
                while let Some(c) = bytes.next().filter(|&c| c != quote) {
                    if c == b'\\' {
                        bytes.next();
                    }
                }
            }
            (b'/', Some(b'/')) => while bytes.next().is_some_and(|c| c != b'\n' && c != b'\r') {},
            (b'/', Some(b'*')) => {
                bytes.next();
                while let Some(c) = bytes.next() {
                    if c == b'*' && bytes.peek() == Some(&b'/') {
                        break;
                    }
                }
            }
            _ => {}
        }
        deepest = deepest.max(depth);
    }
    deepest
}

/// A value and its path in the file.
#[derive(Clone)]
pub(super) struct Json<'a> {
    pub file: &'a Path,
    pub name: String,
    pub value: &'a Value,
}

impl<'a> Json<'a> {
    pub(super) fn root(file: &'a Path, value: &'a Value) -> Json<'a> {
        Json { file, name: String::new(), value }
    }

    pub(super) fn error(&self, what: impl Into<String>) -> SceneError {
        self.place().error(what)
    }

    pub(super) fn place(&self) -> Place {
        Place { path: self.file.into(), line: None, field: self.name.clone() }
    }

    fn named(&self, key: &str) -> String {
        if self.name.is_empty() { key.to_owned() } else { format!("{}.{key}", self.name) }
    }

    /// The field, if present and not null.
    pub(super) fn get(&self, key: &str) -> Option<Json<'a>> {
        let value = self.value.get(key).filter(|value| !value.is_null())?;
        Some(Json { file: self.file, name: self.named(key), value })
    }

    pub(super) fn required(&self, key: &str) -> Result<Json<'a>, SceneError> {
        let missing = || Json { file: self.file, name: self.named(key), value: self.value }.error("is missing");
        self.get(key).ok_or_else(missing)
    }

    pub(super) fn or<T>(
        &self,
        key: &str,
        default: T,
        read: impl FnOnce(&Json<'a>) -> Result<T, SceneError>,
    ) -> Result<T, SceneError> {
        self.get(key).map_or(Ok(default), |value| read(&value))
    }

    /// The entries of the array `key`; none if it is absent.
    pub(super) fn entries(&self, key: &str) -> Result<Vec<Json<'a>>, SceneError> {
        self.or(key, Vec::new(), |value| value.array())
    }

    pub(super) fn array(&self) -> Result<Vec<Json<'a>>, SceneError> {
        let entries = self.value.as_array().ok_or_else(|| self.error("must be an array"))?;
        let entry = |(i, value)| Json { file: self.file, name: format!("{}[{i}]", self.name), value };
        Ok(entries.iter().enumerate().map(entry).collect())
    }

    pub(super) fn text(&self) -> Result<&'a str, SceneError> {
        self.value.as_str().filter(|text| !text.is_empty()).ok_or_else(|| self.error("must be a text"))
    }

    pub(super) fn number(&self) -> Result<f64, SceneError> {
        let number = self.value.as_f64().filter(|&number| (number as f32).is_finite());
        number.ok_or_else(|| self.error("must be a finite number"))
    }

    pub(super) fn positive(&self) -> Result<f64, SceneError> {
        let number = self.value.as_f64().filter(|&number| number > 0.0 && (number as f32).is_finite());
        number.ok_or_else(|| self.error("must be a number above 0"))
    }

    pub(super) fn not_negative(&self) -> Result<f64, SceneError> {
        let number = self.value.as_f64().filter(|&number| number >= 0.0 && (number as f32).is_finite());
        number.ok_or_else(|| self.error("must be a number of at least 0"))
    }

    /// A whole number from `least` to `u32::MAX`. The json5 parser can return whole numbers as floats.
    pub(super) fn whole(&self, least: u32) -> Result<u32, SceneError> {
        let number =
            self.value.as_f64().filter(|&n| n.fract() == 0.0 && n >= f64::from(least) && n <= f64::from(u32::MAX));
        number.map(|n| n as u32).ok_or_else(|| self.error(format!("must be a whole number of at least {least}")))
    }

    fn numbers<const N: usize>(&self) -> Option<[f64; N]> {
        let numbers = self.value.as_array()?.iter().map(|v| v.as_f64().filter(|&n| (n as f32).is_finite()));
        numbers.collect::<Option<Vec<f64>>>()?.try_into().ok()
    }

    /// A pair of numbers.
    pub(super) fn pair(&self) -> Result<[f64; 2], SceneError> {
        self.numbers::<2>().ok_or_else(|| self.error("must be an array of 2 numbers"))
    }

    pub(super) fn vector(&self) -> Result<DVec3, SceneError> {
        self.numbers::<3>().map(DVec3::from).ok_or_else(|| self.error("must be an array of 3 numbers"))
    }

    /// `R` rows of `C` numbers.
    pub(super) fn table<const R: usize, const C: usize>(&self) -> Result<[[f64; C]; R], SceneError> {
        let rows =
            self.value.as_array().map(|rows| rows.iter().map(|value| Json { value, ..self.clone() }.numbers::<C>()));
        let rows = rows.and_then(|rows| rows.collect::<Option<Vec<[f64; C]>>>()).and_then(|rows| rows.try_into().ok());
        rows.ok_or_else(|| self.error(format!("must be a table of {R} rows of {C} numbers")))
    }

    /// ARCSim's rotation: `[degrees, axis x, y, z]`.
    pub(super) fn rotation(&self) -> Result<DQuat, SceneError> {
        let Some([degrees, x, y, z]) = self.numbers::<4>() else {
            return Err(self.error("must be an array `[degrees, axis x, axis y, axis z]`"));
        };
        // ARCSim writes the identity with a zero axis and a zero angle.
        match DVec3::new(x, y, z).try_normalize() {
            Some(axis) => Ok(DQuat::from_axis_angle(axis, degrees.to_radians())),
            None if degrees == 0.0 => Ok(DQuat::IDENTITY),
            None => Err(self.error("the axis of `[degrees, x, y, z]` must not be zero")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn brackets_in_strings_and_comments_do_not_count() {
        assert_eq!(nesting("[{}, [1]] // [[[\n /* [[ ]] */ '[\\'[' \"{\""), 2);
        assert_eq!(nesting("[/*]*/[/*]*/[\"]\"["), 4);
        let deep = "[".repeat(100_000);
        assert!(parse_json(&deep, Path::new("a.json")).unwrap_err().to_string().ends_with("nested more than 64 deep"));
    }

    #[test]
    fn syntax_errors_name_the_line() {
        let error = parse_json("{\n  a: 1,\n  b 2\n}", Path::new("a.json")).unwrap_err();
        assert_eq!(error.to_string(), "a.json, line 3: expected colon");
    }
}
