//! The JSON Schema of scene files, for editors.

use serde_json::Value;

/// The schema. It names every field that the reader knows; which of them go together is checked by the reader alone.
pub const SCHEMA: &str = include_str!("schema.json");

/// Whether the field at a path (as `--set` has it, without numbers and names that choose one of several) may be a
/// list of such values. A field that the schema does not know counts as one, so that the reader refuses it as it is.
pub(super) fn takes_list(names: &[&str], values: &[toml::Value]) -> bool {
    let Ok(root) = serde_json::from_str::<Value>(SCHEMA) else { return true };
    let mut node = &root;
    for name in names {
        node = resolved(node, &root);
        let next = match node.get("items") {
            Some(items) => Some(items),
            None => node.get("properties").and_then(|fields| fields.get(name)),
        };
        match next {
            Some(next) => node = next,
            None => return true,
        }
    }
    alternatives(node, &root).into_iter().any(|one| {
        let Some(items) = one.get("items") else { return false };
        let items = alternatives(items, &root);
        values.iter().all(|value| {
            items.iter().any(|item| match item.get("type").and_then(Value::as_str) {
                Some("array") => value.is_array(),
                Some("object") => value.is_table(),
                _ => !value.is_array() && !value.is_table(),
            })
        })
    })
}

fn resolved<'a>(node: &'a Value, root: &'a Value) -> &'a Value {
    let place = node.get("$ref").and_then(Value::as_str);
    place.and_then(|place| root.pointer(place.trim_start_matches('#'))).unwrap_or(node)
}

/// The forms that a value may have.
fn alternatives<'a>(node: &'a Value, root: &'a Value) -> Vec<&'a Value> {
    let node = resolved(node, root);
    match node.get("oneOf").and_then(Value::as_array) {
        Some(forms) => forms.iter().map(|form| resolved(form, root)).collect(),
        None => vec![node],
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use super::*;
    use crate::scene::change::CHANGE_FIELDS;
    use crate::scene::cloth_file::{CLOTH_FIELDS, FABRIC_FIELDS, GARMENT_FIELDS, SHEET_FIELDS};
    use crate::scene::force_file::FORCE_FIELDS;
    use crate::scene::obstacle_file::OBSTACLE_FIELDS;
    use crate::scene::pin_file::PIN_FIELDS;
    use crate::scene::settings_file::{AIR_FIELDS, SIMULATION_FIELDS};

    fn schema() -> Value {
        serde_json::from_str(SCHEMA).unwrap()
    }

    #[test]
    fn the_schema_has_the_fields_of_the_reader() {
        let schema = schema();
        let fields = |place: &str| -> BTreeSet<String> {
            let properties = schema.pointer(&format!("/properties/{place}")).unwrap();
            properties.as_object().unwrap().keys().cloned().collect()
        };
        let known = |names: &[&str]| names.iter().map(|name| name.to_string()).collect::<BTreeSet<String>>();
        assert_eq!(fields("simulation/properties"), known(&SIMULATION_FIELDS));
        assert_eq!(fields("air/properties"), known(&AIR_FIELDS));
        assert_eq!(fields("fabric/items/properties"), known(&FABRIC_FIELDS));
        assert_eq!(fields("cloth/items/properties"), known(&CLOTH_FIELDS));
        assert_eq!(fields("cloth/items/properties/sheet/properties"), known(&SHEET_FIELDS));
        assert_eq!(fields("cloth/items/properties/garment/properties"), known(&GARMENT_FIELDS));
        assert_eq!(fields("pin/items/properties"), known(&PIN_FIELDS));
        assert_eq!(fields("obstacle/items/properties"), known(&OBSTACLE_FIELDS));
        assert_eq!(fields("change/items/properties"), known(&CHANGE_FIELDS));
        assert_eq!(fields("force/items/properties"), known(&FORCE_FIELDS));
    }

    /// The words of JSON Schema that the schema uses.
    fn fits(value: &Value, schema: &Value, root: &Value) -> bool {
        let schema = match schema.get("$ref").and_then(Value::as_str) {
            Some(place) => root.pointer(place.trim_start_matches('#')).unwrap(),
            None => schema,
        };
        schema.as_object().unwrap().iter().all(|(word, wanted)| match &word[..] {
            "type" => match wanted.as_str().unwrap() {
                "object" => value.is_object(),
                "array" => value.is_array(),
                "string" => value.is_string(),
                "boolean" => value.is_boolean(),
                "integer" => value.is_u64() || value.is_i64(),
                "number" => value.is_number(),
                other => panic!("{other}"),
            },
            "properties" => {
                let fits = |(name, of): (&String, &Value)| value.get(name).is_none_or(|value| fits(value, of, root));
                wanted.as_object().unwrap().iter().all(fits)
            }
            "additionalProperties" => {
                let known = schema["properties"].as_object().unwrap();
                value.as_object().is_none_or(|value| value.keys().all(|name| known.contains_key(name)))
            }
            "required" => wanted.as_array().unwrap().iter().all(|name| value.get(name.as_str().unwrap()).is_some()),
            // Words about other types than that of the value say nothing.
            "items" => value.as_array().is_none_or(|value| value.iter().all(|value| fits(value, wanted, root))),
            "minItems" => value.as_array().is_none_or(|value| value.len() as u64 >= wanted.as_u64().unwrap()),
            "maxItems" => value.as_array().is_none_or(|value| value.len() as u64 <= wanted.as_u64().unwrap()),
            "minimum" => value.as_f64().is_none_or(|value| value >= wanted.as_f64().unwrap()),
            "maximum" => value.as_f64().is_none_or(|value| value <= wanted.as_f64().unwrap()),
            "exclusiveMinimum" => value.as_f64().is_none_or(|value| value > wanted.as_f64().unwrap()),
            "exclusiveMaximum" => value.as_f64().is_none_or(|value| value < wanted.as_f64().unwrap()),
            "enum" => wanted.as_array().unwrap().contains(value),
            "const" => value == wanted,
            "oneOf" => wanted.as_array().unwrap().iter().filter(|one| fits(value, one, root)).count() == 1,
            "$schema" | "title" | "description" | "definitions" => true,
            other => panic!("{other}"),
        })
    }

    #[test]
    fn the_shipped_scenes_fit_and_mistakes_do_not() {
        let schema = schema();
        let json = |text: &str| serde_json::to_value(text.parse::<toml::Table>().unwrap()).unwrap();
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes");
        let mut scenes = 0;
        for file in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            if file.extension().is_some_and(|extension| extension == "toml") {
                let text = std::fs::read_to_string(&file).unwrap();
                assert!(fits(&json(&text), &schema, &schema), "{}", file.display());
                scenes += 1;
            }
        }
        assert!(scenes >= 10, "{scenes}");
        let cloth = "[[cloth]]\nsheet = { size_m = [1, 1] }\n";
        assert!(fits(&json(cloth), &schema, &schema));
        for mistake in [
            "resolution = 100\n",
            &format!("{cloth}[air]\nwind_m_s = [{{ time_s = 1, value = 3 }}]\n"),
            &format!("{cloth}[simulation]\nfrictoin = 1\n"),
            &format!("{cloth}[simulation]\nfriction = -1\n"),
            &format!("{cloth}[simulation]\nsubsteps = \"many\"\n"),
            &format!("{cloth}[[pin]]\nedge = \"middle\"\n"),
            "[[cloth]]\nsheet = { size_m = [1] }\n",
        ] {
            assert!(!fits(&json(mistake), &schema, &schema), "{mistake}");
        }
    }
}
