//! A line of the protocol of a live run, and the answers.

use serde_json::{Map, Value, json};
use toml::Table;

/// What a client asks for.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Request {
    /// Stand still after the step under way.
    Pause,
    /// Go on.
    Continue,
    /// Make this many steps, then stand still.
    Steps(u32),
    /// End the run as Ctrl-C does.
    Stop,
    /// Say where the run is and what can be changed.
    Status,
    /// Write the scene with the changes so far as this file.
    Save(String),
    /// Change the scene.
    Change(Table),
}

/// Most steps of one request.
const STEPS_MOST: u64 = 1_000_000_000;

impl Request {
    /// Reads a line.
    ///
    /// # Errors
    /// One sentence.
    pub(super) fn read(line: &str) -> Result<Request, String> {
        let value: Value = serde_json::from_str(line).map_err(|error| format!("this is not JSON: {error}"))?;
        let Value::Object(mut fields) = value else {
            return Err("a request is a JSON object, such as {\"do\": \"pause\"}".into());
        };
        let Some(what) = fields.get("do").and_then(Value::as_str).map(str::to_owned) else {
            return Err("field `do`: is missing; it says what to do, such as \"pause\" or \"gravity\"".into());
        };
        let only = |fields: &Map<String, Value>, known: &str| {
            let other = fields.keys().find(|key| *key != "do" && *key != known);
            other.map_or(Ok(()), |key| Err(format!("field `{key}`: does not belong to `{what}`")))
        };
        match &what[..] {
            "pause" => only(&fields, "").map(|()| Request::Pause),
            "continue" | "resume" => only(&fields, "").map(|()| Request::Continue),
            "stop" => only(&fields, "").map(|()| Request::Stop),
            "status" => only(&fields, "").map(|()| Request::Status),
            "step" => {
                only(&fields, "steps")?;
                let steps = fields.get("steps").map_or(Some(1), Value::as_u64);
                match steps.filter(|steps| (1..=STEPS_MOST).contains(steps)) {
                    Some(steps) => Ok(Request::Steps(steps as u32)),
                    None => Err(format!("field `steps`: must be a whole number from 1 to {STEPS_MOST}")),
                }
            }
            "save" => {
                only(&fields, "file")?;
                match fields.get("file").and_then(Value::as_str) {
                    Some(file) if file.ends_with(".toml") => Ok(Request::Save(file.into())),
                    _ => Err("field `file`: must be the name of a file that ends in .toml".into()),
                }
            }
            _ => {
                // The kind comes first in the record.
                fields.remove("do");
                let mut table = Table::new();
                table.insert("do".into(), what.clone().into());
                for (key, value) in fields {
                    let value = to_toml(value).map_err(|why| format!("field `{key}`: {why}"))?;
                    table.insert(key, value);
                }
                Ok(Request::Change(table))
            }
        }
    }
}

fn to_toml(value: Value) -> Result<toml::Value, String> {
    Ok(match value {
        Value::Null => return Err("must not be null; leave it out".into()),
        Value::Bool(value) => value.into(),
        Value::String(text) => text.into(),
        Value::Number(number) => match (number.as_i64(), number.as_f64()) {
            (Some(whole), _) => whole.into(),
            (None, Some(number)) => number.into(),
            (None, None) => return Err("must be a number that fits 64 bits".into()),
        },
        Value::Array(entries) => toml::Value::Array(entries.into_iter().map(to_toml).collect::<Result<_, _>>()?),
        Value::Object(fields) => {
            let entry = |(key, value)| to_toml(value).map(|value| (key, value));
            toml::Value::Table(fields.into_iter().map(entry).collect::<Result<_, _>>()?)
        }
    })
}

/// The answer to a request that was met after `step`.
pub(super) fn accepted(step: u32) -> Value {
    json!({ "ok": true, "step": step })
}

/// The answer to a request that cannot be met.
pub(super) fn refused(why: &str) -> Value {
    json!({ "error": why })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_requests() {
        assert_eq!(Request::read(r#"{"do":"pause"}"#), Ok(Request::Pause));
        assert_eq!(Request::read(r#" {"do":"resume"} "#), Ok(Request::Continue));
        assert_eq!(Request::read(r#"{"do":"step"}"#), Ok(Request::Steps(1)));
        assert_eq!(Request::read(r#"{"steps":12,"do":"step"}"#), Ok(Request::Steps(12)));
        assert_eq!(Request::read(r#"{"do":"save","file":"a.toml"}"#), Ok(Request::Save("a.toml".into())));
        let Ok(Request::Change(table)) = Request::read(r#"{"do":"wind","wind_m_s":[1,0.5,0],"b":{"c":[1]}}"#) else {
            panic!("a change")
        };
        let expected: Table = "do = \"wind\"\nwind_m_s = [1, 0.5, 0]\nb = { c = [1] }".parse().unwrap();
        assert_eq!(table, expected);
    }

    #[test]
    fn other_lines_are_sentences() {
        for (line, sentence) in [
            ("", "this is not JSON"),
            ("{", "this is not JSON"),
            ("pause", "this is not JSON"),
            ("[1]", "a request is a JSON object"),
            ("{}", "field `do`: is missing"),
            (r#"{"do":3}"#, "field `do`: is missing"),
            (r#"{"do":"pause","steps":1}"#, "field `steps`: does not belong to `pause`"),
            (r#"{"do":"step","steps":0}"#, "must be a whole number from 1"),
            (r#"{"do":"step","steps":-1}"#, "must be a whole number from 1"),
            (r#"{"do":"save","file":"a.txt"}"#, "ends in .toml"),
            (r#"{"do":"wind","wind_m_s":null}"#, "field `wind_m_s`: must not be null"),
        ] {
            let error = Request::read(line).unwrap_err();
            assert!(error.contains(sentence) && !error.contains('\n'), "{line}: {error}");
        }
        // Deep nesting is refused by the reader, not by the stack.
        assert!(Request::read(&"[".repeat(100_000)).unwrap_err().contains("not JSON"));
    }
}
