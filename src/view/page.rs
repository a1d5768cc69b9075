//! The files of the page, which are part of the program.

use super::Answer;

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const ICON: &str = "image/svg+xml";

/// Name, content type and text of every file; the first one is the page.
const FILES: [(&str, &str, &str); 15] = [
    ("", HTML, include_str!("page/index.html")),
    ("style.css", CSS, include_str!("page/style.css")),
    ("icon.svg", ICON, include_str!("page/icon.svg")),
    ("app.js", SCRIPT, include_str!("page/app.js")),
    ("camera.js", SCRIPT, include_str!("page/camera.js")),
    ("colors.js", SCRIPT, include_str!("page/colors.js")),
    ("curves.js", SCRIPT, include_str!("page/curves.js")),
    ("decode.js", SCRIPT, include_str!("page/decode.js")),
    ("dock.js", SCRIPT, include_str!("page/dock.js")),
    ("gl.js", SCRIPT, include_str!("page/gl.js")),
    ("live.js", SCRIPT, include_str!("page/live.js")),
    ("lanes.js", SCRIPT, include_str!("page/lanes.js")),
    ("panel.js", SCRIPT, include_str!("page/panel.js")),
    ("run.js", SCRIPT, include_str!("page/run.js")),
    ("scrub.js", SCRIPT, include_str!("page/scrub.js")),
];

/// The file of this name, if it is one of the page.
pub(super) fn file(name: &str) -> Option<Answer> {
    FILES.iter().find(|(known, ..)| *known == name).map(|(_, kind, text)| Answer::text(kind, text))
}
