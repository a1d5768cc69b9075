//! Sentences about what of an ARCSim scene is left out.

use super::super::json::Json;

/// Collects sentences about features that are left out, each sentence once.
pub(super) struct LeftOut<'a> {
    /// Modules that the scene itself turns off.
    pub disabled: Vec<&'a str>,
    /// The sentences, in the order in which they were added.
    pub lines: Vec<String>,
}

impl LeftOut<'_> {
    /// Adds a sentence unless it is already there.
    pub(super) fn say(&mut self, line: impl Into<String>) {
        let line = line.into();
        if !self.lines.contains(&line) {
            self.lines.push(line);
        }
    }

    /// Adds a sentence about a module of ARCSim, unless the scene disables that module.
    pub(super) fn module(&mut self, module: &str, line: &str) {
        if !self.disabled.contains(&module) {
            self.say(line);
        }
    }

    /// Adds sentences about unknown or unused fields of the scene and of `magic`.
    pub(super) fn whole_scene(&mut self, root: &Json) {
        self.module("popfilter", "popfilter: left out, the mesh keeps its triangles and nothing pops");
        if root.get("implicit").is_some_and(|value| value.value.as_bool() == Some(false)) {
            self.say("implicit = false: left out, every step is implicit here");
        }
        let known = [
            "frame_time",
            "frame_steps",
            "end_time",
            "duration",
            "end_frame",
            "cloths",
            "handles",
            "motions",
            "obstacles",
            "gravity",
            "wind",
            "friction",
            "obs_friction",
            "disable",
            "magic",
            "implicit",
        ];
        let mut unknown: Vec<&str> = Vec::new();
        if let Some(object) = root.value.as_object() {
            unknown.extend(object.keys().map(String::as_str).filter(|key| !known.contains(key)));
        }
        let mut magic: Vec<&str> = Vec::new();
        if let Some(object) = root.get("magic").and_then(|magic| magic.value.as_object()) {
            magic.extend(object.keys().map(String::as_str).filter(|&key| key != "repulsion_thickness"));
        }
        for (names, what) in
            [(unknown, "this importer does not know it"), (magic, "a number of ARCSim's own methods (magic)")]
        {
            for name in names {
                let name: String = name.chars().take(40).collect();
                self.say(format!("{name}: left out, {what}"));
            }
        }
    }
}
