//! The rule that the files of one folder use each other in one direction. It looks at `use` declarations and at paths
//! in code; it does not see what macros paste together, and not what a method call leads to.

use std::collections::{BTreeMap, BTreeSet};

use crate::source::{Source, blank, is_word};

/// A module as names from the root of the crate; the root itself is empty.
type Path = Vec<String>;

/// A module with its own file.
struct Module<'a> {
    file: &'a Source,
    /// Code without comments, strings and what only tests see.
    code: String,
    children: BTreeSet<String>,
    /// Names that the file imports, and the full paths of what they stand for.
    aliases: BTreeMap<String, Path>,
}

/// Two files or folders side by side, of which one uses the other.
type Edge = (String, String);

/// Files of `src` that use each other in a circle, one finding per circle. A folder is judged by itself: its nodes are
/// its files and its sub-folders, and the file that declares them (`mod.rs` or its namesake beside the folder). What a
/// file re-exports (`pub use`) belongs to the file that it comes from. A native twin `x_cpu.rs` may use its wrapper
/// `x.rs`.
pub(crate) fn circles(files: &[Source]) -> Vec<String> {
    let modules = modules(files);
    let mut graphs: BTreeMap<Path, BTreeMap<Edge, String>> = BTreeMap::new();
    for (own, module) in &modules {
        for (at, path, re_exported) in paths(own, module) {
            if re_exported {
                continue;
            }
            let target = resolve(&modules, path);
            let shared = own.iter().zip(&target).take_while(|(a, b)| a == b).count();
            let node = |path: &Path| path.get(shared).cloned().unwrap_or_else(|| "mod".into());
            let edge = (node(own), node(&target));
            let twin = edge.0.strip_suffix("_cpu") == Some(edge.1.as_str());
            // The order of the modules in src/lib.rs is a rule of its own.
            if shared > 0 && edge.0 != edge.1 && !twin {
                let line = module.file.text[..at].matches('\n').count() + 1;
                let place = format!("{}:{line} uses {}", module.file.path, edge.1);
                graphs.entry(own[..shared].to_vec()).or_default().entry(edge).or_insert(place);
            }
        }
    }
    let mut findings = Vec::new();
    for (folder, edges) in &mut graphs {
        while let Some(circle) = shortest_circle(edges) {
            let places: Vec<&str> = circle.iter().map(|edge| edges[edge].as_str()).collect();
            findings.push(format!("src/{}: a circle: {}", folder.join("/"), places.join(", ")));
            circle.iter().for_each(|edge| drop(edges.remove(edge)));
        }
    }
    findings
}

/// All modules with files under `src`, by path.
fn modules(files: &[Source]) -> BTreeMap<Path, Module<'_>> {
    let mut modules = BTreeMap::new();
    let mut tests = BTreeSet::new();
    for file in files {
        let Some(inside) = file.path.strip_prefix("src/").and_then(|path| path.strip_suffix(".rs")) else { continue };
        let path: Path = inside.split('/').filter(|part| !matches!(*part, "mod" | "lib")).map(str::to_string).collect();
        let (code, only_tests) = without_tests(&blank(&file.text));
        tests.extend(only_tests.into_iter().map(|name| [&path[..], &[name]].concat()));
        modules.insert(path, Module { file, code, children: BTreeSet::new(), aliases: BTreeMap::new() });
    }
    modules.retain(|path, _| !(1..=path.len()).any(|end| tests.contains(&path[..end])));
    let paths_of_all: Vec<Path> = modules.keys().cloned().collect();
    for path in &paths_of_all {
        let Some((name, parent)) = path.split_last() else { continue };
        if let Some(parent) = modules.get_mut(parent) {
            parent.children.insert(name.clone());
        }
    }
    for path in &paths_of_all {
        let aliases = aliases(path, &modules[path]);
        modules.get_mut(path).expect("it was there").aliases = aliases;
    }
    modules
}

/// Code without items under `#[cfg(test)]`, and the names of modules in files of their own among them.
fn without_tests(code: &str) -> (String, Vec<String>) {
    const MARK: &str = "#[cfg(test)]";
    let (mut out, mut names) = (code.as_bytes().to_vec(), Vec::new());
    for (at, _) in code.match_indices(MARK) {
        let mut depth = 0i32;
        let mut end = code.len();
        for (offset, c) in code[at + MARK.len()..].char_indices() {
            match c {
                '{' | '(' | '[' => depth += 1,
                '}' | ')' | ']' => depth -= 1,
                _ => {}
            }
            if depth == 0 && matches!(c, ';' | '}') {
                end = at + MARK.len() + offset + 1;
                break;
            }
        }
        let item = code[at + MARK.len()..end].trim().trim_start_matches("pub ");
        names.extend(item.strip_prefix("mod ").and_then(|rest| rest.strip_suffix(';')).map(|name| name.trim().into()));
        out[at..end].iter_mut().filter(|b| **b != b'\n').for_each(|b| *b = b' ');
    }
    (String::from_utf8(out).expect("blanked between characters"), names)
}

/// Names that a module's file imports, with what they stand for.
fn aliases(own: &Path, module: &Module) -> BTreeMap<String, Path> {
    let mut aliases = BTreeMap::new();
    for (at, _) in module.code.match_indices("use ").filter(|(at, _)| starts_word(&module.code, *at)) {
        for (_, path, name) in tree(&module.code, at + "use ".len(), &[]) {
            if let Some(path) = absolute(own, module, &path) {
                aliases.insert(name, path);
            }
        }
    }
    aliases
}

/// Paths of a file that lead somewhere in the crate: place, full path, whether it is a re-export.
fn paths(own: &Path, module: &Module) -> Vec<(usize, Path, bool)> {
    let code = &module.code;
    let mut found = Vec::new();
    let mut skip_to = 0;
    for at in 0..code.len() {
        if at < skip_to || !code.is_char_boundary(at) || !starts_word(code, at) {
            continue;
        }
        let first: String = code[at..].chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
        let local = module.children.contains(&first);
        let leads = matches!(first.as_str(), "crate" | "super" | "self") || local;
        if !leads || !code[at + first.len()..].starts_with("::") || code[..at].trim_end().ends_with("::") {
            continue;
        }
        let line = code[..at].rfind(['\n', ';', '}']).map_or(0, |end| end + 1);
        let before = code[line..at].trim();
        let re_exported = before.starts_with("pub") && before.ends_with("use");
        for (place, path, _) in tree(code, at, &[]) {
            found.extend(absolute(own, module, &path).map(|path| (place, path, re_exported)));
            skip_to = skip_to.max(place);
        }
    }
    found
}

fn starts_word(code: &str, at: usize) -> bool {
    let bytes = code.as_bytes();
    is_word(bytes[at]) && (at == 0 || !is_word(bytes[at - 1]))
}

/// All paths of the tree at `at`: place and names of each, and the name it is known by.
fn tree(code: &str, at: usize, prefix: &[String]) -> Vec<(usize, Path, String)> {
    let start = at + (code[at..].len() - code[at..].trim_start().len());
    let rest = &code[start..];
    if rest.starts_with('{') {
        let (mut depth, mut from, mut found) = (0, start + 1, Vec::new());
        for (offset, c) in rest.char_indices() {
            match c {
                '{' => depth += 1,
                '}' => depth -= 1,
                _ => {}
            }
            if (c == ',' && depth == 1) || depth == 0 {
                if !code[from..start + offset].trim().is_empty() {
                    found.extend(tree(code, from, prefix));
                }
                from = start + offset + 1;
            }
            if depth == 0 {
                break;
            }
        }
        return found;
    }
    let name: String = rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
    if name.is_empty() {
        return vec![(start, prefix.to_vec(), "*".into())];
    }
    let mut path = prefix.to_vec();
    // `a::{self}` is `a`.
    if prefix.is_empty() || name != "self" {
        path.push(name.clone());
    }
    let after = &rest[name.len()..];
    if let Some(more) = after.strip_prefix("::").filter(|more| !more.starts_with('<')) {
        return tree(code, code.len() - more.len(), &path);
    }
    let renamed = after.trim_start().strip_prefix("as ").map(|rest| rest.trim_start());
    let known: String = renamed
        .map(|rest| rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect())
        .unwrap_or_else(|| path.last().cloned().unwrap_or_default());
    vec![(start, path, known)]
}

/// The path from the root of the crate; none for what comes from other crates.
fn absolute(own: &Path, module: &Module, path: &[String]) -> Option<Path> {
    let first = path.first()?;
    let (mut base, mut rest) = match first.as_str() {
        "crate" => (Vec::new(), &path[1..]),
        "self" => (own.clone(), &path[1..]),
        "super" => (own.clone(), path),
        name if module.children.contains(name) => (own.clone(), path),
        _ => return None,
    };
    while rest.first().is_some_and(|name| name == "super") {
        base.pop()?;
        rest = &rest[1..];
    }
    Some([&base[..], rest].concat())
}

/// The module that a path leads to, through names that modules import.
fn resolve(modules: &BTreeMap<Path, Module>, mut path: Path) -> Path {
    // More re-exports in a row than a tidy crate has.
    for _ in 0..8 {
        let depth = (0..=path.len()).rev().find(|end| modules.contains_key(&path[..*end])).unwrap_or(0);
        let next = path.get(depth).and_then(|name| modules.get(&path[..depth])?.aliases.get(name));
        let Some(alias) = next else { return path[..depth].to_vec() };
        path = [&alias[..], &path[depth + 1..]].concat();
    }
    path
}

/// The shortest circle of edges, in order; none if there is no circle.
fn shortest_circle(edges: &BTreeMap<Edge, String>) -> Option<Vec<Edge>> {
    let nodes: BTreeSet<&String> = edges.keys().flat_map(|(from, to)| [from, to]).collect();
    let circles = nodes.into_iter().filter_map(|start| {
        let mut before: BTreeMap<&String, &String> = BTreeMap::new();
        let mut front = vec![start];
        while !front.is_empty() && !before.contains_key(start) {
            let mut next = Vec::new();
            for node in front {
                for (_, to) in edges.keys().filter(|(from, _)| from == node) {
                    before.entry(to).or_insert_with(|| {
                        next.push(to);
                        node
                    });
                }
            }
            front = next;
        }
        let mut circle = Vec::new();
        let mut node = start;
        loop {
            let from = before.get(node)?;
            circle.push((from.to_string(), node.clone()));
            node = from;
            if node == start {
                circle.reverse();
                return Some(circle);
            }
        }
    });
    circles.min_by_key(Vec::len)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(files: &[(&str, &str)]) -> Vec<String> {
        let files: Vec<Source> = files.iter().map(|(path, text)| Source::new(path, text)).collect();
        circles(&files)
    }

    #[test]
    fn circles_of_files_are_found() {
        let root = ("src/lib.rs", "pub mod a;");
        let two = [root, ("src/a/mod.rs", "mod b;\nmod c;\n"), ("src/a/b.rs", "//! B\nuse super::c::C;")];
        assert_eq!(
            found(&[&two[..], &[("src/a/c.rs", "fn f() -> crate::a::b::B {}")]].concat()),
            ["src/a: a circle: src/a/b.rs:2 uses c, src/a/c.rs:1 uses b"]
        );
        assert_eq!(found(&[&two[..], &[("src/a/c.rs", "// super::b\nuse super::{super::z, d};")]].concat()), [""; 0]);
        // A folder and the file that declares it.
        let parent = [root, ("src/a.rs", "mod b;\nfn f() { b::g() }"), ("src/a/b.rs", "use super::f;")];
        assert_eq!(found(&parent).len(), 1);
        // Through a sub-folder, and through a name that the parent imports.
        let deep = [root, ("src/a/mod.rs", "mod b;\nmod c;\npub use c::{C, x::X};\n")];
        let deeper = ("src/a/c/mod.rs", "pub mod x;\npub struct C;");
        let up = ("src/a/c/x.rs", "use crate::a::b;");
        assert_eq!(found(&[&deep[..], &[deeper, up, ("src/a/b.rs", "use super::X;")]].concat()).len(), 1);
        assert_eq!(found(&[&deep[..], &[deeper, up, ("src/a/b.rs", "use super::Y;")]].concat()), [""; 0]);
    }

    #[test]
    fn twins_tests_and_re_exports_are_no_circles() {
        let root = ("src/lib.rs", "pub mod a;");
        let folder = ("src/a/mod.rs", "mod k;\nmod k_cpu;\npub use k::K;\nfn g() {}\n#[cfg(test)]\nmod t;");
        let kernel = ("src/a/k.rs", "use super::{g, k_cpu};\n#[cfg(test)]\nmod tests { use super::super::t; }");
        let twin = ("src/a/k_cpu.rs", "use super::k::Params;");
        let tests = ("src/a/t.rs", "use super::*;");
        assert_eq!(found(&[root, folder, kernel, twin, tests]), [""; 0]);
        let files = [root, folder, ("src/a/k.rs", "use super::K;"), twin, tests];
        assert_eq!(found(&files), [""; 0], "a file may name itself by way of its folder");
    }
}
