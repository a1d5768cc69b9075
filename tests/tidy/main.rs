//! House rules that a compiler does not check: import order, siblings of kernels, headers of files, citations, lengths,
//! machine paths. Every rule is a function from text to findings and is itself tested on a bad snippet.
//!
//! It reads source text, not a syntax tree: code that goes out of its way (macros that paste paths) can hide from it.

mod circles;
mod source;

use std::collections::BTreeSet;
use std::process::Command;

use source::{Source, blank, project, text_of};

/// Longest file in lines. The aim is 400; past this limit a file is split.
const LINES_MAX: usize = 600;

// ---- rules ----

/// `use crate::x`, `crate::x::y` and `super::super::x` that name a module below the file's own in `order`.
fn upward_imports(file: &Source, order: &[String]) -> Vec<String> {
    let Some(inside) = file.path.strip_prefix("src/").and_then(|path| path.strip_suffix(".rs")) else {
        return Vec::new();
    };
    let parts: Vec<&str> = inside.split('/').filter(|part| *part != "mod").collect();
    let Some(own) = order.iter().position(|name| name == parts[0]) else { return Vec::new() };
    let code = blank(&file.text);
    let mut used = Vec::new();
    for (at, _) in code.match_indices("crate::") {
        used.extend(names_after(&code, at + "crate::".len()));
    }
    // As many `super` as the file is deep lead to the root; inside an inline module to its parent, whose children have
    // other names.
    let climb = "super::".repeat(parts.len());
    for (at, _) in code.match_indices(&climb) {
        used.extend(names_after(&code, at + climb.len()));
    }
    let below =
        used.into_iter().filter(|(_, name)| order.iter().position(|other| other == name).is_some_and(|i| i > own));
    below
        .map(|(at, name)| {
            file.finding(at, &format!("{} imports {name}, which stands below it in src/lib.rs", order[own]))
        })
        .collect()
}

/// First path segments at `at`: one name, or those of a `{..}` group.
fn names_after(code: &str, at: usize) -> Vec<(usize, String)> {
    let name_at = |start: usize| {
        let rest = &code[start..];
        let lead = rest.len() - rest.trim_start().len();
        let name: String = rest[lead..].chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
        (start + lead, name)
    };
    if !code[at..].starts_with('{') {
        return vec![name_at(at)];
    }
    let (mut names, mut depth) = (vec![name_at(at + 1)], 0);
    for (offset, c) in code[at..].char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 1 => names.push(name_at(at + offset + 1)),
            _ => {}
        }
        if depth == 0 {
            break;
        }
    }
    names
}

/// Module names in the order of `src/lib.rs`, without those for tests alone.
fn module_order(lib: &str) -> Vec<String> {
    let code = blank(lib);
    let declared =
        |line: &str| line.trim().trim_start_matches("pub ").strip_prefix("mod ")?.strip_suffix(';').map(str::to_string);
    let before = std::iter::once("").chain(code.lines());
    let lines = before.zip(code.lines()).filter(|(before, _)| before.trim() != "#[cfg(test)]");
    lines.filter_map(|(_, line)| declared(line)).collect()
}

/// A kernel `x.wgsl` without its host wrapper `x.rs` or its native twin `x_cpu.rs`. Shader text without an entry point is
/// shared by kernels and needs neither; probes of the executor itself (`src/gpu/*.wgsl`) simulate nothing and need no twin.
/// A shader that draws lies in `src/gpu/` too, because drawing needs wgpu; its native twin is where pictures are made, so
/// a line `// twin FILE` (path from its own folder) names it.
fn lonely_kernels(files: &[Source]) -> Vec<String> {
    let paths: BTreeSet<&str> = files.iter().map(|file| file.path.as_str()).collect();
    let mut findings = Vec::new();
    for file in files.iter().filter(|file| file.text.contains("@compute")) {
        let Some(stem) = file.path.strip_suffix(".wgsl").filter(|stem| stem.starts_with("src/")) else { continue };
        let probe = stem.strip_prefix("src/gpu/").is_some_and(|name| !name.contains('/'));
        let siblings = [Some(format!("{stem}.rs")), (!probe).then(|| format!("{stem}_cpu.rs"))];
        let missing = siblings.into_iter().flatten().filter(|sibling| !paths.contains(sibling.as_str()));
        findings.extend(missing.map(|sibling| format!("{}: {sibling} is missing", file.path)));
    }
    for file in files.iter().filter(|file| file.text.contains("@fragment")) {
        let Some(stem) = file.path.strip_suffix(".wgsl") else { continue };
        if !paths.contains(format!("{stem}.rs").as_str()) {
            findings.push(format!("{}: {stem}.rs is missing", file.path));
        }
        match file.text.lines().find_map(|line| line.strip_prefix("// twin ")) {
            None => findings.push(format!("{}: no line `// twin FILE` names its native twin", file.path)),
            Some(twin) => {
                let twin = sibling(&file.path, twin.trim());
                if !paths.contains(twin.as_str()) {
                    findings.push(format!("{}: its twin {twin} is missing", file.path));
                }
            }
        }
    }
    findings
}

/// The path that `relative` means in the folder of `path`.
fn sibling(path: &str, relative: &str) -> String {
    let mut parts: Vec<&str> = path.split('/').collect();
    parts.pop();
    for part in relative.split('/') {
        if part == ".." {
            parts.pop();
        } else {
            parts.push(part);
        }
    }
    parts.join("/")
}

/// A Rust file that does not open with `//!`, or a shader that does not open with `//`.
fn missing_header(file: &Source) -> Vec<String> {
    let header = if file.has_extension(".rs") { "//!" } else { "//" };
    let wanted = file.has_extension(".rs") || file.has_extension(".wgsl");
    if wanted && !file.text.starts_with(header) {
        return vec![file.finding(0, &format!("the file does not open with {header} and what it is"))];
    }
    Vec::new()
}

/// Unfinished code and tests that never run.
fn unfinished(file: &Source) -> Vec<String> {
    if !file.has_extension(".rs") {
        return Vec::new();
    }
    let code = blank(&file.text);
    let mut findings = Vec::new();
    for word in ["todo!", "unimplemented!", "#[ignore"] {
        findings.extend(
            code.match_indices(word).map(|(at, _)| file.finding(at, &format!("{word} is not for committed code"))),
        );
    }
    if file.path.starts_with("src/") {
        findings.extend(
            code.match_indices("allow(dead_code").map(|(at, _)| file.finding(at, "dead code is removed, not allowed")),
        );
    }
    findings
}

/// Macros of the standard library that panic when stdout or stderr is closed or full, outside tests.
fn panicking_output(file: &Source) -> Vec<String> {
    let product = file.path.starts_with("src/") || file.path.starts_with("bin/");
    let tests = file.path.ends_with("tests.rs") || file.path.ends_with("test_support.rs");
    if !product || tests || !file.has_extension(".rs") {
        return Vec::new();
    }
    let code = blank(&file.text);
    let end = code.find("#[cfg(test)]").unwrap_or(code.len());
    let found = ["print!(", "println!("].into_iter().flat_map(|word| code[..end].match_indices(word));
    found.map(|(at, _)| file.finding(at, "it panics when nobody reads the stream: use os::console")).collect()
}

/// More than [`LINES_MAX`] lines.
fn too_long(file: &Source) -> Vec<String> {
    let lines = file.text.lines().count();
    if (file.has_extension(".rs") || file.has_extension(".wgsl")) && lines > LINES_MAX {
        return vec![format!("{}: {lines} lines; split it ({LINES_MAX} at most)", file.path)];
    }
    Vec::new()
}

/// Citations such as `[Li et al. 2020, Sec. 3.1; Harmon et al. 2008]` whose key (`li2020`) is not in the bibliography.
fn unknown_citations(file: &Source, bibliography: &str) -> Vec<String> {
    let mut findings = Vec::new();
    for (open, _) in file.text.match_indices('[') {
        let rest = &file.text[open + 1..];
        let Some(close) = rest.find(']').filter(|close| *close < 300) else { continue };
        // A citation may go over a line's end inside a comment.
        let flat: Vec<&str> = rest[..close]
            .split_whitespace()
            .filter(|word| !matches!(*word, "//" | "///" | "//!" | "#" | "*"))
            .collect();
        for key in flat.join(" ").split(';').flat_map(keys_of) {
            if !bibliography.contains(&format!("{{{key},")) {
                findings.push(file.finding(open, &format!("docs/references.bib has no entry {key}")));
            }
        }
    }
    findings
}

/// Bibliography keys of one citation: "Narain et al. 2012, 2013" -> narain2012, narain2013; nothing if it is none.
fn keys_of(citation: &str) -> Vec<String> {
    let citation = citation.trim();
    // 2020, or 2020b for a second paper of that name and year.
    let is_year = |word: &str| {
        let digits = word.strip_suffix(|c: char| c.is_ascii_lowercase()).unwrap_or(word);
        digits.len() == 4
            && (digits.starts_with("19") || digits.starts_with("20"))
            && digits.bytes().all(|b| b.is_ascii_digit())
    };
    let words: Vec<&str> = citation.split(' ').map(|word| word.trim_end_matches(',')).collect();
    let Some(first_year) = words.iter().position(|word| is_year(word)) else { return Vec::new() };
    let name = |word: &str| {
        // RFC 1951 has no author.
        word.starts_with(char::is_uppercase)
            && word.contains(char::is_lowercase)
            && word.chars().all(|c| c.is_alphabetic() || c == '-')
    };
    let joins = |word: &str| matches!(word, "et" | "al." | "and" | "&") || name(word);
    if first_year == 0 || !name(words[0]) || !words[..first_year].iter().all(|word| joins(word)) {
        return Vec::new();
    }
    let surname = words[0].to_lowercase();
    words[first_year..].iter().take_while(|word| is_year(word)).map(|year| format!("{surname}{year}")).collect()
}

/// Commands without an example in the README.
fn missing_commands<'a>(readme: &str, commands: &[&'a str]) -> Vec<&'a str> {
    commands.iter().copied().filter(|name| !readme.contains(&format!("`loomtree {name} "))).collect()
}

/// Names in the first column of a Markdown table, among `known`, in the order of their rows.
fn rows_of<'a>(markdown: &'a str, known: &[String]) -> Vec<&'a str> {
    let name = |line: &'a str| line.strip_prefix("| `")?.split_once("` |").map(|(name, _)| name);
    markdown.lines().filter_map(name).filter(|name| known.iter().any(|other| other == name)).collect()
}

/// Paths that exist on one machine only.
fn machine_paths(file: &Source) -> Vec<String> {
    // Put together here, so that this file does not find itself.
    let roots = ["work/", "home/", "root/", "Users/"].map(|folder| format!("/{folder}"));
    let mut findings = Vec::new();
    for root in &roots {
        for (at, _) in file.text.match_indices(root.as_str()) {
            let before = file.text[..at].chars().next_back();
            // ../home/ and example.org/home/ are no paths of a machine.
            if !before.is_some_and(|c| c.is_alphanumeric() || matches!(c, '.' | '_' | '-' | '/' | '}')) {
                findings.push(file.finding(at, &format!("{root}.. exists on one machine only")));
            }
        }
    }
    findings
}

fn assert_tidy(rule: impl Fn(&Source) -> Vec<String>) {
    let files = project();
    assert!(files.iter().any(|file| file.path == "src/lib.rs"), "the project's text was not found");
    let findings: Vec<String> = files.iter().flat_map(rule).collect();
    assert!(findings.is_empty(), "\n{}\n", findings.join("\n"));
}

// ---- the tree ----

#[test]
fn modules_import_only_what_stands_above_them() {
    let order = module_order(&text_of("src/lib.rs"));
    assert!(order.len() > 10 && order[0] == "math", "src/lib.rs was not understood: {order:?}");
    assert_tidy(|file| upward_imports(file, &order));
}

#[test]
fn files_of_a_folder_use_each_other_in_one_direction() {
    let files = project();
    let findings = circles::circles(&files);
    assert!(findings.is_empty(), "\n{}\n", findings.join("\n"));
}

#[test]
fn kernels_have_a_wrapper_and_a_native_twin() {
    let findings = lonely_kernels(&project());
    assert!(findings.is_empty(), "\n{}\n", findings.join("\n"));
}

#[test]
fn files_say_what_they_are() {
    assert_tidy(missing_header);
}

#[test]
fn nothing_is_unfinished() {
    assert_tidy(unfinished);
}

#[test]
fn output_survives_the_loss_of_its_reader() {
    assert_tidy(panicking_output);
}

#[test]
fn files_fit_a_head() {
    assert_tidy(too_long);
}

#[test]
fn citations_are_in_the_bibliography() {
    let bibliography = text_of("docs/references.bib");
    assert_tidy(|file| unknown_citations(file, &bibliography));
}

#[test]
fn no_file_names_a_path_of_one_machine() {
    assert_tidy(machine_paths);
}

#[test]
fn the_readme_shows_every_command() {
    let help = Command::new(env!("CARGO_BIN_EXE_loomtree")).arg("--help").output().expect("the program starts");
    let help = String::from_utf8_lossy(&help.stdout);
    let listed = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let commands: Vec<&str> =
        listed.filter_map(|line| line.split_whitespace().next()).filter(|name| *name != "help").collect();
    assert!(commands.contains(&"run"), "the help was not understood:\n{help}");
    assert_eq!(missing_commands(&text_of("README.md"), &commands), [""; 0], "README.md has no example of them");
}

#[test]
fn the_architecture_page_shows_every_module_in_order() {
    let order = module_order(&text_of("src/lib.rs"));
    assert_eq!(rows_of(&text_of("ARCHITECTURE.md"), &order), order, "table of modules in ARCHITECTURE.md");
}

// ---- the rules on bad snippets ----

fn order() -> Vec<String> {
    module_order(
        "//! pub mod not_this;\n#[cfg(test)]\nmod help;\npub mod math;\npub mod gpu;\nmod solver;\npub mod output;\n",
    )
}

#[test]
fn upward_imports_are_found() {
    assert_eq!(order(), ["math", "gpu", "solver", "output"]);
    let found = |path: &str, text: &str| upward_imports(&Source::new(path, text), &order());
    assert_eq!(
        found("src/gpu/vec.rs", "//! x\nuse crate::solver::Pcg;\n"),
        ["src/gpu/vec.rs:2: gpu imports solver, which stands below it in src/lib.rs"]
    );
    assert_eq!(found("src/gpu.rs", "use crate::{math, solver::{Pcg, gpu}, output};").len(), 2);
    assert_eq!(found("src/gpu/mod.rs", "fn f() -> crate::output::Frame {}").len(), 1);
    assert_eq!(found("src/gpu/vec.rs", "use super::super::solver;").len(), 1);
    let fine = "//! crate::solver\nuse crate::math; /* crate::output /* */ crate::output */\nfn f<'a>(c: char) { let _ = (\"crate::output\", r#\"crate::\"output\"#, '\"', crate::gpu::X); }";
    assert_eq!(found("src/gpu/vec.rs", fine), [""; 0]);
    assert_eq!(found("src/output.rs", "use crate::{math, gpu, solver};"), [""; 0]);
}

#[test]
fn lonely_kernels_are_found() {
    let kernels = ["src/solver/spmv.wgsl", "src/solver/spmv.rs", "src/gpu/probe.wgsl"];
    let mut files: Vec<Source> = kernels.iter().map(|path| Source::new(path, "@compute fn main() {}")).collect();
    files.push(Source::new("src/gpu/prelude.wgsl", "fn helper() {}"));
    assert_eq!(
        lonely_kernels(&files),
        ["src/solver/spmv.wgsl: src/solver/spmv_cpu.rs is missing", "src/gpu/probe.wgsl: src/gpu/probe.rs is missing"]
    );
    let drawing = |header: &str| {
        let text = format!("// Draws.\n{header}\n@fragment fn main() {{}}");
        let paths = ["src/gpu/draw.rs", "src/output/shade.rs"].map(|path| Source::new(path, ""));
        lonely_kernels(&[&[Source::new("src/gpu/draw.wgsl", &text)], &paths[..]].concat())
    };
    assert_eq!(drawing("// twin ../output/shade.rs"), [""; 0]);
    assert_eq!(drawing("// twin draw_cpu.rs"), ["src/gpu/draw.wgsl: its twin src/gpu/draw_cpu.rs is missing"]);
    assert_eq!(drawing(""), ["src/gpu/draw.wgsl: no line `// twin FILE` names its native twin"]);
}

#[test]
fn missing_headers_are_found() {
    assert_eq!(missing_header(&Source::new("src/a.rs", "use std::fs;")).len(), 1);
    assert_eq!(missing_header(&Source::new("src/a.wgsl", "fn main() {}")).len(), 1);
    assert!(missing_header(&Source::new("src/a.rs", "//! What it is.\n")).is_empty());
    assert!(missing_header(&Source::new("README.md", "# Loomtree")).is_empty());
}

#[test]
fn unfinished_code_is_found() {
    let bad = "#[test]\n#[ignore = \"slow\"]\nfn f() { todo!() }\n#[allow(dead_code)]\nfn g() { unimplemented!() }";
    assert_eq!(unfinished(&Source::new("src/a.rs", bad)).len(), 4);
    assert!(unfinished(&Source::new("src/a.rs", "// todo!\nlet text = \"unimplemented!\";")).is_empty());
}

#[test]
fn panicking_output_is_found() {
    let found = |path: &str, text: &str| panicking_output(&Source::new(path, text)).len();
    assert_eq!(found("src/a.rs", "fn f() { println!(\"x\"); eprint!(\"y\"); }"), 2);
    assert_eq!(
        found("src/a.rs", "fn f() { note(\"println!()\"); }\n#[cfg(test)]\nmod t { fn f() { print!(\"\"); } }"),
        0
    );
    assert_eq!(found("tests/a.rs", "fn f() { println!(\"x\"); }"), 0);
}

#[test]
fn long_files_are_found() {
    assert_eq!(too_long(&Source::new("src/a.rs", &"\n".repeat(LINES_MAX + 1))).len(), 1);
    assert!(too_long(&Source::new("src/a.rs", &"\n".repeat(LINES_MAX))).is_empty());
}

#[test]
fn unknown_citations_are_found() {
    let found =
        |text: &str| unknown_citations(&Source::new("src/a.rs", text), "@article{li2020,\n@article{narain2012,\n");
    // Years apart from names, so that these are no citations of this file.
    let with_year = |text: &str| text.replace("YEAR", "2020").replace("OTHER", "2012");
    assert_eq!(
        found(&with_year("//! x [Li et al. YEAR, Sec. 3]\n//! [Nobody and Else YEAR,\n//! Fig. 2]")),
        ["src/a.rs:2: docs/references.bib has no entry nobody2020"]
    );
    assert_eq!(
        found(&with_year("[Narain et al. OTHER, YEAR]")),
        ["src/a.rs:1: docs/references.bib has no entry narain2020"]
    );
    assert_eq!(found(&with_year("[Li et al. YEAR; Missing OTHER]")).len(), 1);
    assert_eq!(found(&with_year("[Li et al. YEARb]")), ["src/a.rs:1: docs/references.bib has no entry li2020b"]);
    assert!(found("[RFC 1951] let a = [1, 2020]; [x.y](z 2020) [Vec; 2020] [See 12 of 2020]").is_empty());
}

#[test]
fn missing_commands_are_found() {
    assert_eq!(missing_commands("| `run` | `loomtree run x.toml` |", &["run", "doctor"]), ["doctor"]);
}

#[test]
fn missing_and_misplaced_modules_are_found() {
    let table = "| Module | |\n|---|---|\n| `gpu` | x |\n| `math` | x |\n| `coming` | x |\n";
    assert_eq!(rows_of(table, &order()), ["gpu", "math"]);
}

#[test]
fn machine_paths_are_found() {
    let path = |folder: &str| format!("let a = \"/{folder}/x\";");
    for folder in ["work", "home", "root"] {
        assert_eq!(machine_paths(&Source::new("src/a.rs", &path(folder))).len(), 1, "{folder}");
    }
    assert!(machine_paths(&Source::new("docs/a.md", "https://example.org/home/x ../work/ /tmp/x")).is_empty());
}
