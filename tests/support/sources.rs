//! What the source files use of each other, by their text.
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

pub type Module = Vec<String>;

/// A source file: names that it binds by `use`, and all paths that it mentions.
#[derive(Default)]
pub struct Source {
    /// Name to path, and whether other modules see it.
    pub bound: BTreeMap<String, (bool, Module)>,
    pub paths: Vec<Module>,
    /// Modules that only tests have.
    pub tests: Vec<String>,
}

/// Words and marks, without comments, strings and lifetimes; `::` is one mark.
fn tokens(text: &str) -> Vec<String> {
    let (chars, mut out, mut i): (Vec<char>, Vec<String>, usize) = (text.chars().collect(), Vec::new(), 0);
    let word = |c: char| c.is_alphanumeric() || c == '_';
    let at = |i: usize, s: &str| s.chars().enumerate().all(|(k, c)| chars.get(i + k) == Some(&c));
    while i < chars.len() {
        let start = i;
        let hashes = chars[i + 1..].iter().take_while(|c| **c == '#').count();
        if at(i, "//") {
            while i < chars.len() && chars[i] != '\n' {
                i += 1;
            }
        } else if at(i, "/*") {
            let mut depth = 0;
            while i < chars.len() && (i == start || depth > 0) {
                depth += i32::from(at(i, "/*")) - i32::from(at(i, "*/"));
                i += if at(i, "/*") || at(i, "*/") { 2 } else { 1 };
            }
        } else if chars[i] == 'r' && chars.get(i + 1 + hashes) == Some(&'"') {
            let end = format!("\"{}", "#".repeat(hashes));
            i += hashes + 2;
            while i < chars.len() && !at(i, &end) {
                i += 1;
            }
            i += end.len();
        } else if chars[i] == '"' {
            i += 1;
            while i < chars.len() && chars[i] != '"' {
                i += if chars[i] == '\\' { 2 } else { 1 };
            }
            i += 1;
        } else if chars[i] == '\'' {
            // 'x', '\n' and '\u{1f}' end with a quote, a lifetime does not.
            let escaped = chars.get(i + 1) == Some(&'\\');
            let end = (i + 2..i + 12).find(|k| chars.get(*k) == Some(&'\'') && (escaped || *k == i + 2));
            i = end.map_or(i + 1, |k| if at(k + 1, "'") && escaped { k + 2 } else { k + 1 });
        } else if word(chars[i]) {
            while i < chars.len() && word(chars[i]) {
                i += 1;
            }
            out.push(chars[start..i].iter().collect());
        } else {
            i += if at(i, "::") { 2 } else { 1 };
            if !chars[start].is_whitespace() {
                out.push(chars[start..i].iter().collect());
            }
        }
    }
    out
}

/// The index behind the bracket that closes the one at `open`.
fn behind(all: &[String], open: usize) -> usize {
    let mut depth = 0;
    for (k, token) in all.iter().enumerate().skip(open) {
        depth += i32::from("{[(".contains(token.as_str())) - i32::from("}])".contains(token.as_str()));
        if depth == 0 {
            return k + 1;
        }
    }
    all.len()
}

/// The tokens without items under `#[cfg(test)]`, and the modules among those.
fn without_tests(all: &[String]) -> (Vec<String>, Vec<String>) {
    let (mut kept, mut tests, mut i) = (Vec::new(), Vec::new(), 0);
    let is = |i: usize, s: &str| all.get(i).is_some_and(|t| t == s);
    while i < all.len() {
        if !(is(i, "#") && is(i + 1, "[")) {
            kept.push(all[i].clone());
            i += 1;
            continue;
        }
        let end = behind(all, i + 1);
        let attribute = &all[i + 2..end];
        let of_tests = attribute[0] == "cfg"
            && attribute.iter().any(|t| t == "test")
            && !attribute.contains(&"not".into());
        i = end;
        while of_tests && i < all.len() {
            if is(i, "mod") {
                tests.push(all[i + 1].clone());
            }
            let opens = "{[(".contains(all[i].as_str());
            let last = is(i, "{") || is(i, ";");
            i = if opens { behind(all, i) } else { i + 1 };
            if last {
                break;
            }
        }
    }
    (kept, tests)
}

/// The paths of a use tree from `all[*i]` on, each with the name that it binds.
fn tree(all: &[String], i: &mut usize, prefix: &Module, out: &mut Vec<(String, Module)>) {
    let mut path = prefix.clone();
    loop {
        match all[*i].as_str() {
            "{" => {
                *i += 1;
                while all[*i] != "}" {
                    tree(all, i, &path, out);
                    *i += usize::from(all[*i] == ",");
                }
                *i += 1;
                return;
            }
            "::" => {}
            "as" => {
                out.push((all[*i + 1].clone(), path));
                *i += 2;
                return;
            }
            "," | ";" | "}" => break,
            "self" if !path.is_empty() => {}
            name => path.push(name.to_string()),
        }
        *i += 1;
    }
    out.push((path.last().cloned().unwrap_or_default(), path));
}

pub fn parse(text: &str) -> Source {
    let (all, tests) = without_tests(&tokens(text));
    let (mut source, mut i) = (Source { tests, ..Source::default() }, 0);
    let is = |i: usize, s: &str| all.get(i).is_some_and(|t| t == s);
    while i < all.len() {
        if is(i, "use") && !is(i + 1, "<") {
            let (mut found, public) = (Vec::new(), i > 0 && (is(i - 1, "pub") || is(i - 1, ")")));
            i += 1;
            tree(&all, &mut i, &Vec::new(), &mut found);
            source.paths.extend(found.iter().map(|f| f.1.clone()));
            source.bound.extend(found.into_iter().map(|(name, path)| (name, (public, path))));
        } else if is(i + 1, "::") && !(i > 0 && is(i - 1, "::")) {
            let mut path = vec![all[i].clone()];
            while is(i + 1, "::")
                && all.get(i + 2).is_some_and(|t| t.chars().all(|c| c.is_alphanumeric() || c == '_'))
            {
                path.push(all[i + 2].clone());
                i += 2;
            }
            source.paths.push(path);
        }
        i += 1;
    }
    source
}

pub struct Crate(pub BTreeMap<Module, Source>);

impl Crate {
    pub fn read(root: &Path) -> Crate {
        let (mut files, mut folders) = (BTreeMap::new(), vec![PathBuf::new()]);
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(root.join(&folder)).unwrap() {
                let path = folder.join(entry.unwrap().file_name());
                if root.join(&path).is_dir() {
                    folders.push(path);
                } else if path.extension().is_some_and(|e| e == "rs") && path != Path::new("main.rs") {
                    let mut module: Module =
                        path.with_extension("").iter().map(|p| p.to_string_lossy().into()).collect();
                    if module.last().is_some_and(|n| n == "mod" || n == "lib") {
                        module.pop();
                    }
                    files.insert(module, parse(&std::fs::read_to_string(root.join(&path)).unwrap()));
                }
            }
        }
        let of = |(module, source): (&Module, &Source)| -> Vec<Module> {
            source.tests.iter().map(|t| [module.as_slice(), std::slice::from_ref(t)].concat()).collect()
        };
        let tests: Vec<Module> = files.iter().flat_map(of).collect();
        files.retain(|module, _| !tests.iter().any(|t| module.starts_with(t)));
        Crate(files)
    }

    /// The file that holds what `path` means in `module`; none for other crates.
    fn resolve(&self, module: &[String], path: &[String], depth: usize) -> Option<Module> {
        let (first, rest) = path.split_first()?;
        let join = |base: &[String], rest: &[String]| [base, rest].concat();
        let whole = match first.as_str() {
            "crate" => rest.to_vec(),
            "self" => join(module, rest),
            "super" => {
                let up = path.iter().take_while(|p| *p == "super").count();
                join(&module[..module.len().checked_sub(up)?], &path[up..])
            }
            name if self.0.contains_key(&join(module, &path[..1]))
                && !self.0[module].bound.contains_key(name) =>
            {
                join(module, path)
            }
            name => {
                let bound = &self.0[module].bound.get(name).filter(|b| depth < 9 && b.1 != path)?.1;
                return self.resolve(module, &join(bound, rest), depth + 1);
            }
        };
        let known = (0..=whole.len()).rev().find(|k| self.0.contains_key(&whole[..*k]))?;
        let (file, inside) = whole.split_at(known);
        // What is not public only this module and those inside it see.
        match inside.first().and_then(|n| self.0[file].bound.get(n)) {
            Some((public, bound)) if depth < 9 && (*public || module.starts_with(file)) => {
                self.resolve(file, &join(bound, &inside[1..]), depth + 1)
            }
            _ => Some(file.to_vec()),
        }
    }

    /// The files that each file uses.
    pub fn edges(&self) -> BTreeMap<&Module, BTreeSet<Module>> {
        let of = |(module, source): (&Module, &Source)| -> BTreeSet<Module> {
            source
                .paths
                .iter()
                .filter_map(|p| self.resolve(module, p, 0))
                .filter(|m| m != module && !m.is_empty())
                .collect()
        };
        self.0.iter().filter(|f| !f.0.is_empty()).map(|f| (f.0, of(f))).collect()
    }

    /// Sets of files that all use each other, in order.
    pub fn circles(&self) -> BTreeSet<Vec<String>> {
        let edges = self.edges();
        let reached = |from: &Module| {
            let (mut found, mut left) = (BTreeSet::new(), vec![from.clone()]);
            while let Some(next) = left.pop().and_then(|m| edges.get(&m)) {
                left.extend(next.iter().filter(|m| found.insert((*m).clone())).cloned());
            }
            found
        };
        let reach: BTreeMap<&Module, BTreeSet<Module>> = edges.keys().map(|m| (*m, reached(m))).collect();
        let circle =
            |m: &Module| reach[m].iter().filter(|o| reach[o].contains(m)).map(|o| o.join("/")).collect();
        reach.keys().filter(|m| reach[**m].contains(**m)).map(|m| circle(m)).collect()
    }
}

fn path(text: &str) -> Module {
    text.split("::").map(String::from).collect()
}

#[test]
fn comments_strings_and_tests_use_nothing() {
    let source = parse(
        r###"
        // use crate::a;
        /* crate::a::f(); /* nested */ crate::a::g() */
        const S: (&str, &str, char, char) = ("crate::a\"", r#"crate::a""#, '"', '\'');
        fn f<'a>(x: &'a str) -> impl Iterator<Item = &'a str> + use<'a> { crate::b::g(x) }
        #[cfg(test)]
        #[path = "other.rs"]
        mod tests;
        #[cfg(test)]
        pub(super) fn h(x: [u8; 2]) -> u8 { crate::a::k(x) }
        #[cfg(not(test))]
        use crate::c::d;
        "###,
    );
    assert_eq!(source.tests, ["tests"]);
    assert_eq!(source.paths, [path("crate::b::g"), path("crate::c::d")]);
}

#[test]
fn names_lead_to_the_file_that_holds_them() {
    let files = [
        ("a", "mod child; pub use child::{Thing as Other, deep::{self, X}}; fn own() { child::f() }"),
        (
            "a::child",
            "use super::own; use std::fmt; fn f() { fmt::write(); super::Other::new(); crate::b::Name::new() }",
        ),
        ("a::child::deep", "fn g() { super::super::own() }"),
        ("c", "use crate::b::own; use self::f as g; fn f() {}"),
        (
            "b",
            "use crate::error::own; pub use crate::a::Other as Name; use crate::a; fn f() { a::deep::g(); self::own() }",
        ),
        ("", "pub use b::Name;"),
    ];
    let modules = files.map(|(m, text)| (if m.is_empty() { Vec::new() } else { path(m) }, parse(text)));
    let all = Crate(modules.into_iter().collect());
    let of = |m: &str| all.edges()[&path(m)].iter().map(|o| o.join("::")).collect::<Vec<_>>();
    assert_eq!(of("a"), ["a::child", "a::child::deep"]);
    assert_eq!(of("a::child"), ["a"]);
    assert_eq!(of("a::child::deep"), ["a"]);
    assert_eq!(of("b"), ["a", "a::child", "a::child::deep"]);
    assert_eq!(of("c"), ["b"]);
    assert_eq!(all.circles(), [["a", "a/child", "a/child/deep"].map(String::from).to_vec()].into());
}
