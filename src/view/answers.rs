//! From the path of a request to its answer. Paths name files of the page, runs by their place on the command line,
//! and frames by number; no part of a path becomes the name of a file.

use std::sync::Mutex;

use serde_json::json;

use super::{Answer, Watched, layer, page, state::state, steer};
use crate::time_parallel::Comparison;

/// Answers for some runs.
pub struct Answers {
    runs: Vec<Watched>,
    /// For the mesh of the first two runs.
    comparison: Mutex<Option<(Vec<[u32; 3]>, Comparison)>>,
}

impl Answers {
    /// For these runs, which the page shows side by side.
    pub fn new(runs: Vec<Watched>) -> Answers {
        Answers { runs, comparison: Mutex::new(None) }
    }

    /// The answer to a path after the token, such as `run/0/frame/12` or `app.js`; `query` is what follows `?`.
    pub fn of(&self, path: &str, query: &str) -> Answer {
        let mut parts = path.split('/');
        let first = parts.next().unwrap_or_default();
        let rest: Vec<&str> = parts.collect();
        match (first, &rest[..]) {
            ("runs", []) => Answer::json(&json!({ "runs": self.runs.len() })),
            ("run", [run, rest @ ..]) => match run.parse().ok().and_then(|run: usize| self.runs.get(run)) {
                Some(run) => self.of_run(run, rest, query),
                None => Answer::refused(404, "no such run"),
            },
            ("compare", [frame]) => match frame.parse() {
                Ok(frame) => result(self.compare(frame)),
                Err(_) => unknown(),
            },
            (name, []) => page::file(name).unwrap_or_else(unknown),
            _ => unknown(),
        }
    }

    /// The answer to a request for a run that is steered: its protocol, a line each way.
    pub fn of_request(&self, path: &str, body: &[u8]) -> Answer {
        let run = path.strip_prefix("run/").and_then(|rest| rest.strip_suffix("/live"));
        match run.and_then(|run| run.parse().ok()).and_then(|run: usize| self.runs.get(run)) {
            Some(run) => steer::ask(run.path(), body).unwrap_or_else(Answer::unavailable),
            None => Answer::refused(405, "this page is only read, but for runs with --live"),
        }
    }

    fn of_run(&self, run: &Watched, rest: &[&str], query: &str) -> Answer {
        let wanted = |name: &str| query.split('&').find_map(|pair| pair.strip_prefix(name)?.strip_prefix('='));
        match rest {
            ["state"] => Answer::json(&state(run, wanted("have").map(percent_decoded).as_deref())),
            ["names"] => result(run.known(|known| Ok(Answer::json(&known.names())))),
            ["mesh"] => layer::mesh(run.path(), None),
            ["mesh", number] => mesh_of(run.path(), number),
            ["coarse", "mesh"] => layer::mesh(&run.preview(), None),
            ["coarse", "mesh", number] => mesh_of(&run.preview(), number),
            ["frame", number] => frame_of(run.path(), number, wanted("obstacles")),
            ["coarse", "frame", number] => frame_of(&run.preview(), number, wanted("obstacles")),
            ["values", "rank"] => result(run.known(|known| Ok(Answer::bytes(layer::values(&known.ranks()))))),
            ["values", what @ ("strain" | "contact"), number] => match number.parse() {
                Ok(number) => result(values(run, what, number)),
                Err(_) => unknown(),
            },
            ["links"] => match &*run.lanes() {
                Ok(lanes) => Answer::json(&lanes.links()),
                Err(why) => Answer::unavailable(why),
            },
            ["lanes", step] => match (step.parse(), &*run.lanes()) {
                (Err(_), _) => unknown(),
                (Ok(_), Err(why)) => Answer::unavailable(why),
                (Ok(step), Ok(lanes)) => match lanes.step(step) {
                    Some(lanes) => Answer::json(&lanes),
                    None => Answer::unavailable(format!("step {step} was not traced")),
                },
            },
            _ => unknown(),
        }
    }

    /// The figures of `loomtree compare` for a frame of the first two runs.
    fn compare(&self, frame: u32) -> Result<Answer, String> {
        let [a, b, ..] = &self.runs[..] else { return Err("only one run is shown".into()) };
        let [a, b] = [a, b].map(|run| {
            let frames = layer::open(run.path())?;
            let there = frames.numbers().binary_search(&frame).is_ok();
            if there { frames.read(frame).map_err(|error| error.to_string()) } else { Err("no such frame".into()) }
        });
        let (a, b) = (a?, b?);
        if a.triangles != b.triangles || a.positions.len() != b.positions.len() {
            return Err("the two runs have different meshes, so there are no distances between them".into());
        }
        let mut comparison = self.comparison.lock().map_err(|error| error.to_string())?;
        if comparison.as_ref().is_none_or(|(triangles, _)| *triangles != a.triangles) {
            *comparison = Some((a.triangles.clone(), Comparison::new(a.triangles)));
        }
        let Some((_, comparison)) = &*comparison else { return Err("no comparison".into()) };
        let distance = comparison.distance(&a.positions, &b.positions);
        let bits = |x: &crate::math::Vec3| x.to_array().map(f32::to_bits);
        Ok(Answer::json(&json!({
            "frame": frame,
            "equal_bits": a.positions.iter().map(bits).eq(b.positions.iter().map(bits)),
            "rms_m": distance.rms_m,
            "max_m": distance.max_m,
            "max_vertex": distance.max_vertex,
            "aligned_rms_m": distance.aligned_rms_m,
            "eq17_theta": distance.eq17_theta,
            "eq17_curvature": distance.eq17_curvature,
        })))
    }
}

fn unknown() -> Answer {
    Answer::refused(404, "there is nothing at this address")
}

fn result(result: Result<Answer, String>) -> Answer {
    result.unwrap_or_else(Answer::unavailable)
}

fn mesh_of(path: &std::path::Path, number: &str) -> Answer {
    number.parse().map_or_else(|_| unknown(), |number| layer::mesh(path, Some(number)))
}

fn frame_of(path: &std::path::Path, number: &str, have: Option<&str>) -> Answer {
    match number.parse() {
        Ok(number) => layer::frame(path, number, have.and_then(|hash| u64::from_str_radix(hash, 16).ok())),
        Err(_) => unknown(),
    }
}

/// A value per vertex of the mesh.
fn values(run: &Watched, what: &str, frame: u32) -> Result<Answer, String> {
    let frames = layer::open(run.path())?;
    run.known(|known| {
        let frames = known.frames(frames);
        if frames.numbers().binary_search(&frame).is_err() {
            return Err(format!("frame {frame} is not there"));
        }
        let positions = frames.read(frame).map_err(|error| error.to_string())?.positions;
        let values = match what {
            "strain" => known.strain(&positions)?,
            _ => known.contact(&positions, frame)?,
        };
        Ok(Answer::bytes(layer::values(&values)))
    })
}

/// The page encodes the characters of a version that an address may not have.
fn percent_decoded(text: &str) -> String {
    let mut bytes = Vec::new();
    let mut rest = text.as_bytes();
    while let Some((&byte, after)) = rest.split_first() {
        let code = after.get(..2).and_then(|code| std::str::from_utf8(code).ok());
        match code.and_then(|code| u8::from_str_radix(code, 16).ok()).filter(|_| byte == b'%') {
            Some(decoded) => (bytes, rest) = ([bytes, vec![decoded]].concat(), &after[2..]),
            None => (bytes, rest) = ([bytes, vec![byte]].concat(), after),
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_path_leads_to_a_file_of_the_machine() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join("run/frames")).unwrap();
        std::fs::write(folder.path().join("secret.ply"), "no").unwrap();
        std::fs::write(folder.path().join("run/secret.txt"), "no").unwrap();
        let answers = Answers::new(vec![Watched::new(&folder.path().join("run"))]);
        assert_eq!(
            (answers.of("", "").status, answers.of("app.js", "").kind.starts_with("text/javascript")),
            (200, true)
        );
        assert_eq!(answers.of("run/0/state", "").status, 200);
        for path in [
            "secret.txt",
            "../secret.ply",
            "run/0/../../secret.ply",
            "run/0/secret.txt",
            "run/0/frame/../secret",
            "run/1/state",
            "run/-1/state",
            "run/0/frame/0x1",
            "run/0/frame/",
            "run/0/values/other/1",
            "/etc/passwd",
            "run",
            "run/0",
            "compare/one",
            "app.js/",
            "run/0/coarse/frame/%2e%2e",
            "run/0/frame/99999999999",
            "run/0/mesh/one",
            "run/0/live",
            "run/0/lanes/first",
        ] {
            let answer = answers.of(path, "");
            assert_eq!(answer.status, 404, "{path}");
            assert!(String::from_utf8_lossy(&answer.body).starts_with("{\"error\":"), "{path}");
        }
    }

    #[test]
    fn what_is_not_there_is_said_and_is_no_error() {
        let folder = tempfile::tempdir().unwrap();
        let answers = Answers::new(vec![Watched::new(&folder.path().join("run"))]);
        for path in [
            "run/0/mesh",
            "run/0/mesh/1",
            "run/0/frame/1",
            "run/0/names",
            "run/0/links",
            "run/0/lanes/1",
            "run/0/values/rank",
            "compare/1",
        ] {
            let answer = answers.of(path, "");
            assert_eq!((answer.status, answer.kind), (200, "application/json"), "{path}");
            assert!(answer.body.starts_with(b"{\"error\":"), "{path}");
        }
    }

    #[test]
    fn only_runs_are_steered() {
        let folder = tempfile::tempdir().unwrap();
        let answers = Answers::new(vec![Watched::new(folder.path())]);
        for path in ["", "runs", "run/0", "run/0/state", "run/1/live", "run/x/live", "run/0/live/"] {
            assert_eq!(answers.of_request(path, b"{}").status, 405, "{path}");
        }
        let text = |body: &str| {
            let answer = answers.of_request("run/0/live", body.as_bytes());
            (answer.status, String::from_utf8_lossy(&answer.body).into_owned())
        };
        assert!(text(r#"{"do":"status"}"#).1.contains("no live run listens"));
        assert!(text("{\n}").1.contains("one line"));
        for file in ["../a.toml", "/tmp/a.toml", "a/b.toml"] {
            let (status, body) = text(&format!(r#"{{"do":"save","file":"{file}"}}"#));
            assert!(status == 200 && body.contains("a name alone"), "{body}");
        }
    }

    #[test]
    fn versions_survive_the_address() {
        assert_eq!(percent_decoded("%5B1a%2C%202%5D"), "[1a, 2]");
        assert_eq!(percent_decoded("a%b%"), "a%b%");
    }
}
