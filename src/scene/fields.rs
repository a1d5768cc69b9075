//! Reads a TOML document field by field, so that every error names the file, the line and the field.
//!
//! serde's derive is not used because value checks (a negative thickness, an unknown fabric) need the line too, and
//! serde reports the line of type errors only.

use std::path::Path;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::math::{DQuat, DVec3};

use super::error::{Place, SceneError};

/// The document, for places in errors.
pub(super) struct Source<'a> {
    path: &'a Path,
    /// Byte offsets of the line breaks, ascending. Every table has a place, so a search from the start of the text would
    /// take time in the square of its length.
    line_breaks: Vec<usize>,
}

impl<'a> Source<'a> {
    pub(super) fn new(path: &'a Path, text: &str) -> Source<'a> {
        let line_breaks = text.bytes().zip(0..).filter(|&(byte, _)| byte == b'\n').map(|(_, at)| at).collect();
        Source { path, line_breaks }
    }

    /// An error at byte `offset` of the text.
    pub(super) fn error(&self, offset: Option<usize>, field: &str, what: impl Into<String>) -> SceneError {
        self.place(offset, field).error(what)
    }

    fn place(&self, offset: Option<usize>, field: &str) -> Place {
        Place { path: self.path.into(), line: self.line(offset), field: field.into() }
    }

    fn line(&self, offset: Option<usize>) -> Option<usize> {
        offset.map(|at| 1 + self.line_breaks.partition_point(|&line_break| line_break < at))
    }
}

/// A table of the document. An absent table behaves like an empty one.
pub(super) struct Fields<'a> {
    source: &'a Source<'a>,
    path: String,
    offset: Option<usize>,
    table: Option<&'a DeTable<'a>>,
}

impl<'a> Fields<'a> {
    /// The top-level table. Fields other than `known` are refused.
    pub(super) fn root(
        source: &'a Source<'a>,
        table: &'a DeTable<'a>,
        known: &[&str],
    ) -> Result<Fields<'a>, SceneError> {
        Fields { source, path: String::new(), offset: None, table: Some(table) }.only(known)
    }

    /// Refuses fields that are not `known`.
    fn only(self, known: &[&str]) -> Result<Fields<'a>, SceneError> {
        for key in self.table.iter().flat_map(|table| table.keys()) {
            let name: &str = key.get_ref();
            if !known.contains(&name) {
                let what = format!("unknown field; known here: {}", known.join(", "));
                return Err(self.source.error(Some(key.span().start), &self.name_of(name), what));
            }
        }
        Ok(self)
    }

    fn name_of(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }

    /// An error about the whole table.
    pub(super) fn error(&self, what: impl Into<String>) -> SceneError {
        self.source.error(self.offset, &self.path, what)
    }

    /// An error about a field, which may be absent.
    pub(super) fn error_at(&self, key: &str, what: impl Into<String>) -> SceneError {
        match self.get(key) {
            Some(value) => value.error(what),
            None => self.source.error(self.offset, &self.name_of(key), what),
        }
    }

    /// The position of a field, which may be absent.
    pub(super) fn place_at(&self, key: &str) -> Place {
        match self.get(key) {
            Some(value) => value.place(),
            None => self.source.place(self.offset, &self.name_of(key)),
        }
    }

    /// The field, if present.
    pub(super) fn get(&self, key: &str) -> Option<Value<'a>> {
        let value = self.table?.get(key)?;
        Some(Value { source: self.source, name: self.name_of(key), value })
    }

    /// The field; an error if it is absent.
    pub(super) fn required(&self, key: &str) -> Result<Value<'a>, SceneError> {
        self.get(key).ok_or_else(|| self.error_at(key, "is missing"))
    }

    /// Reads a field with `read`, if present.
    pub(super) fn optional<T>(
        &self,
        key: &str,
        read: impl FnOnce(&Value<'a>) -> Result<T, SceneError>,
    ) -> Result<Option<T>, SceneError> {
        self.get(key).map(|value| read(&value)).transpose()
    }

    /// Reads a field with `read`; `default` if it is absent.
    pub(super) fn or<T>(
        &self,
        key: &str,
        default: T,
        read: impl FnOnce(&Value<'a>) -> Result<T, SceneError>,
    ) -> Result<T, SceneError> {
        Ok(self.optional(key, read)?.unwrap_or(default))
    }

    /// The table `key`; an empty one if it is absent.
    pub(super) fn table(&self, key: &str, known: &[&str]) -> Result<Fields<'a>, SceneError> {
        match self.get(key) {
            Some(value) => value.table(known),
            None => Ok(Fields { source: self.source, path: self.name_of(key), offset: self.offset, table: None }),
        }
    }

    /// The tables `[[key]]`; none if they are absent.
    pub(super) fn tables(&self, key: &str, known: &[&str]) -> Result<Vec<Fields<'a>>, SceneError> {
        match self.get(key) {
            Some(value) => value.array()?.iter().map(|entry| entry.table(known)).collect(),
            None => Ok(Vec::new()),
        }
    }
}

/// A value and its position in the document.
pub(super) struct Value<'a> {
    source: &'a Source<'a>,
    name: String,
    value: &'a Spanned<DeValue<'a>>,
}

impl<'a> Value<'a> {
    /// An error about this value.
    pub(super) fn error(&self, what: impl Into<String>) -> SceneError {
        self.place().error(what)
    }

    /// The position of this value.
    pub(super) fn place(&self) -> Place {
        self.source.place(Some(self.value.span().start), &self.name)
    }

    fn expected<T>(&self, what: &str) -> Result<T, SceneError> {
        let found = match self.value.get_ref() {
            DeValue::String(text) => format!("\"{}\"", text.chars().take(40).collect::<String>()),
            DeValue::Integer(number) => number.to_string(),
            DeValue::Float(number) => number.to_string(),
            DeValue::Boolean(value) => value.to_string(),
            other => format!("a value of type {}", other.type_str()),
        };
        Err(self.error(format!("must be {what}, not {found}")))
    }

    fn as_f64(&self) -> Option<f64> {
        match self.value.get_ref() {
            DeValue::Integer(number) => i64::from_str_radix(number.as_str(), number.radix()).ok().map(|n| n as f64),
            DeValue::Float(number) => number.as_str().parse().ok(),
            _ => None,
        }
    }

    /// A finite number that f32 can hold.
    pub(super) fn number(&self) -> Result<f64, SceneError> {
        match self.as_f64() {
            Some(number) if (number as f32).is_finite() => Ok(number),
            _ => self.expected("a finite number"),
        }
    }

    /// A number above 0.
    pub(super) fn positive(&self) -> Result<f64, SceneError> {
        match self.as_f64() {
            Some(number) if number > 0.0 && (number as f32).is_finite() => Ok(number),
            _ => self.expected("a number above 0"),
        }
    }

    /// A number of at least 0.
    pub(super) fn not_negative(&self) -> Result<f64, SceneError> {
        match self.as_f64() {
            Some(number) if number >= 0.0 && (number as f32).is_finite() => Ok(number),
            _ => self.expected("a number of at least 0"),
        }
    }

    /// A whole number in a range.
    pub(super) fn whole(&self, range: std::ops::RangeInclusive<u64>) -> Result<u64, SceneError> {
        let number = match self.value.get_ref() {
            DeValue::Integer(number) => u64::from_str_radix(number.as_str(), number.radix()).ok(),
            _ => None,
        };
        match number {
            Some(number) if range.contains(&number) => Ok(number),
            _ => self.expected(&format!("a whole number from {} to {}", range.start(), range.end())),
        }
    }

    /// A text that is not empty.
    pub(super) fn text(&self) -> Result<&'a str, SceneError> {
        match self.value.get_ref() {
            DeValue::String(text) if !text.is_empty() => Ok(text),
            _ => self.expected("a text"),
        }
    }

    /// The choice whose name the value gives.
    pub(super) fn choice<T: Copy>(&self, choices: &[(&str, T)]) -> Result<T, SceneError> {
        let names: Vec<&str> = choices.iter().map(|choice| choice.0).collect();
        let found = self.value.get_ref().as_str().and_then(|text| choices.iter().find(|choice| choice.0 == text));
        found.map_or_else(|| self.expected(&format!("one of {}", names.join(", "))), |choice| Ok(choice.1))
    }

    /// The entries of an array. Their names carry an index if there are several.
    pub(super) fn array(&self) -> Result<Vec<Value<'a>>, SceneError> {
        let DeValue::Array(entries) = self.value.get_ref() else {
            return self.expected("an array");
        };
        let entry = |(i, value)| {
            let name = if entries.len() > 1 { format!("{}[{i}]", self.name) } else { self.name.clone() };
            Value { source: self.source, name, value }
        };
        Ok(entries.iter().enumerate().map(entry).collect())
    }

    /// Exactly `N` finite numbers.
    pub(super) fn numbers<const N: usize>(&self) -> Result<[f64; N], SceneError> {
        let entries = match self.value.get_ref() {
            DeValue::Array(_) => self.array()?,
            _ => Vec::new(),
        };
        let numbers: Vec<f64> = entries.iter().map(Value::number).collect::<Result<_, _>>()?;
        numbers.try_into().or_else(|_| self.expected(&format!("an array of {N} numbers")))
    }

    /// A vector `[x, y, z]`.
    pub(super) fn vector(&self) -> Result<DVec3, SceneError> {
        Ok(DVec3::from(self.numbers::<3>()?))
    }

    /// A rotation `[degrees, axis x, axis y, axis z]`.
    pub(super) fn rotation(&self) -> Result<DQuat, SceneError> {
        let (axis, degrees) = self.turn()?;
        Ok(DQuat::from_axis_angle(axis, degrees.to_radians()))
    }

    /// A rotation as unit axis and degrees.
    pub(super) fn turn(&self) -> Result<(DVec3, f64), SceneError> {
        let [degrees, x, y, z] = self.numbers::<4>()?;
        let axis = DVec3::new(x, y, z).try_normalize();
        let axis = axis.ok_or_else(|| self.error("the axis of `[degrees, x, y, z]` must not be zero"))?;
        Ok((axis, degrees))
    }

    /// True or false.
    pub(super) fn boolean(&self) -> Result<bool, SceneError> {
        match self.value.get_ref() {
            DeValue::Boolean(value) => Ok(*value),
            _ => self.expected("true or false"),
        }
    }

    /// A table that has `known` fields only.
    pub(super) fn table(&self, known: &[&str]) -> Result<Fields<'a>, SceneError> {
        let DeValue::Table(table) = self.value.get_ref() else {
            return self.expected("a table");
        };
        let offset = Some(self.value.span().start);
        Fields { source: self.source, path: self.name.clone(), offset, table: Some(table) }.only(known)
    }

    /// True for the field with this name.
    pub(super) fn is_named(&self, key: &str) -> bool {
        self.name.rsplit('.').next() == Some(key)
    }

    /// True for an array with entries of any type.
    pub(super) fn is_array(&self) -> bool {
        self.value.get_ref().is_array()
    }

    /// True for a table.
    pub(super) fn is_table(&self) -> bool {
        self.value.get_ref().is_table()
    }

    /// True for a string.
    pub(super) fn is_text(&self) -> bool {
        self.value.get_ref().is_str()
    }
}
