//! What a path is answered with.

use serde::Serialize;

/// Status, content type and bytes of an answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Answer {
    /// HTTP status.
    pub status: u16,
    /// Content type.
    pub kind: &'static str,
    /// The bytes.
    pub body: Vec<u8>,
}

impl Answer {
    pub(super) fn text(kind: &'static str, text: &str) -> Answer {
        Answer { status: 200, kind, body: text.as_bytes().to_vec() }
    }

    pub(super) fn bytes(body: Vec<u8>) -> Answer {
        Answer { status: 200, kind: "application/octet-stream", body }
    }

    pub(super) fn json(value: &impl Serialize) -> Answer {
        match serde_json::to_vec(value) {
            Ok(body) => Answer { status: 200, kind: "application/json", body },
            Err(error) => Answer::refused(500, error),
        }
    }

    /// What the page may ask for and cannot have now, such as a trace that was not kept: no error, but a sentence
    /// why. (A status of 404 would be an error in the browser's console.)
    pub(super) fn unavailable(why: impl std::fmt::Display) -> Answer {
        Answer { status: 200, ..Answer::refused(404, why) }
    }

    /// An error, with one sentence for the page to show.
    pub(super) fn refused(status: u16, why: impl std::fmt::Display) -> Answer {
        let body = serde_json::json!({ "error": why.to_string() }).to_string().into_bytes();
        Answer { status, kind: "application/json", body }
    }
}
