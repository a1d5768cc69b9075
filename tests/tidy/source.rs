//! The project's text, and Rust text without what is no code.

use std::fs;
use std::path::{Path, PathBuf};

/// Where the project's own text lies, besides the files at the top.
const FOLDERS: [&str; 10] =
    ["src", "bin", "tests", "examples", "benches", "docs", "scenes", "topology", "scripts", ".ci"];

/// A text file of the project; `path` is relative to the root, with slashes.
#[derive(Clone)]
pub(crate) struct Source {
    pub path: String,
    pub text: String,
}

impl Source {
    pub(crate) fn new(path: &str, text: &str) -> Source {
        Source { path: path.into(), text: text.into() }
    }

    pub(crate) fn has_extension(&self, extension: &str) -> bool {
        self.path.ends_with(extension)
    }

    /// A finding at byte `at`.
    pub(crate) fn finding(&self, at: usize, what: &str) -> String {
        let line = self.text[..at.min(self.text.len())].matches('\n').count() + 1;
        format!("{}:{line}: {what}", self.path)
    }
}

/// Rust text with comments, strings and characters replaced by blanks; line ends and lengths stay.
pub(crate) fn blank(text: &str) -> String {
    let bytes = text.as_bytes();
    let mut out = bytes.to_vec();
    let mut i = 0;
    while i < bytes.len() {
        let end = end_of_token(bytes, i);
        if end == i {
            i += 1;
            continue;
        }
        out[i..end].iter_mut().filter(|b| **b != b'\n').for_each(|b| *b = b' ');
        i = end;
    }
    String::from_utf8(out).expect("whole tokens are blanked, and they begin and end between characters")
}

/// End of the comment, string or character that begins at `i`; `i` if none does.
fn end_of_token(bytes: &[u8], i: usize) -> usize {
    let rest = &bytes[i..];
    let find =
        |needle: &[u8], from: usize| rest[from..].windows(needle.len()).position(|w| w == needle).map(|p| from + p);
    if rest.starts_with(b"//") {
        return i + find(b"\n", 0).unwrap_or(rest.len());
    }
    if rest.starts_with(b"/*") {
        let (mut depth, mut at) = (1, 2);
        while depth > 0 && at < rest.len() {
            let (step, change) = if rest[at..].starts_with(b"/*") {
                (2, 1)
            } else if rest[at..].starts_with(b"*/") {
                (2, -1)
            } else {
                (1, 0)
            };
            depth += change;
            at += step;
        }
        return i + at;
    }
    if rest[0] == b'r' && (i == 0 || !is_word(bytes[i - 1]) || bytes[i - 1] == b'b') {
        let hashes = rest[1..].iter().take_while(|b| **b == b'#').count();
        if rest.get(1 + hashes) == Some(&b'"') {
            let close = [b"\"".as_slice(), &b"#".repeat(hashes)].concat();
            return i + find(&close, 2 + hashes).map_or(rest.len(), |at| at + close.len());
        }
        return i;
    }
    if rest[0] == b'"' {
        return i + quoted(rest, b'"');
    }
    // 'a' and '\n' are characters, 'a without a closing quote is a lifetime.
    let width = rest.get(1).map_or(1, |b| (b.leading_ones() as usize).max(1));
    if rest[0] == b'\'' && (rest.get(1) == Some(&b'\\') || rest.get(1 + width) == Some(&b'\'')) {
        return i + quoted(rest, b'\'');
    }
    i
}

pub(crate) fn is_word(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_'
}

/// Length of a literal from its opening to its closing quote.
fn quoted(rest: &[u8], quote: u8) -> usize {
    let mut at = 1;
    while at < rest.len() && rest[at] != quote {
        at += if rest[at] == b'\\' { 2 } else { 1 };
    }
    (at + 1).min(rest.len())
}

/// All text of the project. Files that are not UTF-8 are not text.
pub(crate) fn project() -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut paths: Vec<PathBuf> = children(root).into_iter().filter(|path| path.is_file()).collect();
    let mut folders: Vec<PathBuf> = FOLDERS.iter().map(|folder| root.join(folder)).collect();
    while let Some(folder) = folders.pop() {
        for path in children(&folder) {
            if path.is_dir() { folders.push(path) } else { paths.push(path) }
        }
    }
    paths.sort();
    let relative =
        |path: &Path| path.strip_prefix(root).map(|p| p.to_string_lossy().replace('\\', "/")).unwrap_or_default();
    // .git is a file in a linked checkout and holds a path by design.
    let own = paths.iter().filter(|path| relative(path) != ".git");
    own.filter_map(|path| Some(Source { path: relative(path), text: fs::read_to_string(path).ok()? })).collect()
}

fn children(folder: &Path) -> Vec<PathBuf> {
    fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect()
}

pub(crate) fn text_of(path: &str) -> String {
    fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path))
        .unwrap_or_else(|error| panic!("{path}: {error}"))
}
