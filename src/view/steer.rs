//! Passes requests of the page on to a run that is steered, and its answers back.

use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::path::Path;
use std::time::Duration;

use super::Answer;
use crate::coordinator::live::connect;

/// Longest wait for an answer: a request is met between two steps.
const PATIENCE: Duration = Duration::from_secs(60);

/// Asks the run in `path`; `body` is a line of its protocol.
///
/// # Errors
/// A sentence: nobody listens, or the page may not ask for this.
pub(super) fn ask(path: &Path, body: &[u8]) -> Result<Answer, String> {
    let line = std::str::from_utf8(body).map_err(|_| "this is not UTF-8")?.trim();
    if line.contains(['\n', '\r']) {
        return Err("a request is one line".into());
    }
    // Who sees the page may not write anywhere but into the run directory.
    let value: serde_json::Value = serde_json::from_str(line).unwrap_or_default();
    if value["file"].as_str().is_some_and(|file| file.contains(['/', '\\'])) {
        return Err("field `file`: the page saves into the run directory; give a name alone".into());
    }
    let mut stream = connect(path).map_err(|error| error.to_string())?;
    let lost = |error: std::io::Error| match error.kind() {
        ErrorKind::WouldBlock | ErrorKind::TimedOut => {
            "the run is busy with a long step; the request waits".to_string()
        }
        _ => format!("the connection to the run was lost: {error}"),
    };
    stream.set_read_timeout(Some(PATIENCE)).map_err(lost)?;
    stream.write_all(format!("{line}\n").as_bytes()).map_err(lost)?;
    let mut answer = String::new();
    match BufReader::new(stream).read_line(&mut answer).map_err(lost)? {
        0 => Err("the run has ended".into()),
        _ => Ok(Answer { status: 200, kind: "application/json", body: answer.into_bytes() }),
    }
}
