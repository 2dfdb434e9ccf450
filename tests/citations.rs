//! Citations in the documents: every `docs/<folder>/<name>.md#<anchor>` in sources and documents,
//! and every relative link of a Markdown file, leads to an existing file and heading. No compiler
//! checks comments, so a renamed section would go unnoticed.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Searched places, relative to the repository.
const PLACES: [&str; 14] = [
    "src",
    "crates",
    "examples",
    "glsl",
    "lab",
    "tests",
    "tools",
    "docs",
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "CHANGELOG.md",
    "THIRD_PARTY.md",
    "build.rs",
];

/// Fewer citations than this mean that the search is broken.
const MIN_CITATIONS: usize = 50;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Every text file of [`PLACES`] with its content; files that are not UTF-8 are skipped.
fn texts() -> Vec<(PathBuf, String)> {
    let mut all = Vec::new();
    PLACES.iter().for_each(|place| collect(&root().join(place), &mut all));
    assert!(!all.is_empty());
    all
}

fn collect(path: &Path, all: &mut Vec<(PathBuf, String)>) {
    if path.is_dir() {
        let mut inside: Vec<PathBuf> = std::fs::read_dir(path).unwrap().map(|e| e.unwrap().path()).collect();
        inside.sort();
        inside.iter().for_each(|p| collect(p, all));
    } else if let Ok(text) = std::fs::read_to_string(path) {
        all.push((path.to_path_buf(), text));
    }
}

/// Place in a message: "src/lib.rs:12".
fn place(path: &Path, line: usize) -> String {
    format!("{}:{line}", path.strip_prefix(root()).unwrap_or(path).display())
}

/// Leading letters, digits, `-`, `_` and characters of `more` of a text.
fn word<'a>(text: &'a str, more: &str) -> &'a str {
    let end = text.find(|c: char| !(c.is_alphanumeric() || c == '-' || c == '_' || more.contains(c)));
    &text[..end.unwrap_or(text.len())]
}

/// (file, anchor) of the citations in a line.
fn citations(line: &str) -> Vec<(String, &str)> {
    let mut all = Vec::new();
    for (at, start) in line.match_indices("docs/") {
        let rest = &line[at + start.len()..];
        let name = word(rest, "/");
        if let Some(anchor) = rest[name.len()..].strip_prefix(".md#").filter(|_| !name.is_empty()) {
            all.push((format!("docs/{name}.md"), word(anchor, "")));
        }
    }
    all
}

/// Targets of the Markdown links in a line.
fn links(line: &str) -> Vec<&str> {
    let starts = line.match_indices("](").map(|(at, start)| &line[at + start.len()..]);
    starts.filter_map(|rest| Some(&rest[..rest.find(')')?])).collect()
}

/// Lines of a Markdown file outside fenced code, numbered from 1.
fn prose(text: &str) -> Vec<(usize, &str)> {
    let (mut lines, mut fenced) = (Vec::new(), false);
    for (at, line) in text.lines().enumerate() {
        if line.trim_start().starts_with("```") {
            fenced = !fenced;
        } else if !fenced {
            lines.push((at + 1, line));
        }
    }
    lines
}

/// Anchor of a heading on GitHub: lower case, spaces to `-`, punctuation dropped.
fn slug(heading: &str) -> String {
    let kept = heading.chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
    kept.flat_map(char::to_lowercase).map(|c| if c == ' ' { '-' } else { c }).collect()
}

/// Anchors of a Markdown file; repeated headings get a number.
fn anchors(text: &str) -> Vec<String> {
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    let mut all = Vec::new();
    for (_, line) in prose(text) {
        let title = line.trim_start_matches('#');
        if !(1..=6).contains(&(line.len() - title.len())) || !title.starts_with(' ') {
            continue;
        }
        let own = slug(title.trim());
        let before = seen.entry(own.clone()).or_default();
        all.push(if *before == 0 { own } else { format!("{own}-{before}") });
        *before += 1;
    }
    all
}

/// Fault of a reference to a file, or to a heading in it.
fn fault(file: &Path, anchor: Option<&str>) -> Option<String> {
    if !file.exists() {
        return Some("there is no such file".to_owned());
    }
    let anchor = anchor.filter(|_| file.extension().is_some_and(|e| e == "md"))?;
    let text = std::fs::read_to_string(file).unwrap();
    let there = anchors(&text).iter().any(|a| a == anchor);
    (!there).then(|| "there is no such heading".to_owned())
}

#[test]
fn citations_lead_to_headings() {
    let (mut faults, mut count) = (Vec::new(), 0);
    for (path, text) in texts() {
        for (at, line) in text.lines().enumerate() {
            for (file, anchor) in citations(line) {
                count += 1;
                let found = fault(&root().join(&file), Some(anchor));
                faults.extend(found.map(|f| format!("{}: {file}#{anchor}: {f}", place(&path, at + 1))));
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    assert!(count >= MIN_CITATIONS, "only {count} citations were found");
}

#[test]
fn relative_links_lead_to_files() {
    let mut faults = Vec::new();
    for (path, text) in texts().iter().filter(|(p, _)| p.extension().is_some_and(|e| e == "md")) {
        for (at, line) in prose(text) {
            for target in links(line).into_iter().filter(|t| !t.contains("://")) {
                let (file, anchor) = target.split_once('#').map_or((target, None), |(f, a)| (f, Some(a)));
                let file = if file.is_empty() { path.clone() } else { path.with_file_name(file) };
                faults.extend(fault(&file, anchor).map(|f| format!("{}: {target}: {f}", place(path, at))));
            }
        }
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

/// Comments once cited a document that is not public, before docs/internals/method.md existed.
#[test]
fn citations_stay_in_repository() {
    let word = ["ALGO", "RITHMS"].concat();
    let mut faults = Vec::new();
    for (path, text) in texts() {
        let named = text.lines().enumerate().filter(|(_, line)| line.contains(&word));
        faults.extend(named.map(|(at, line)| format!("{}: {}", place(&path, at + 1), line.trim())));
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}

#[test]
fn headings_become_github_anchors() {
    assert_eq!(slug("Forward rasterisation"), "forward-rasterisation");
    assert_eq!(slug("3D-OVS"), "3d-ovs");
    assert_eq!(slug("Language beside a file: `NAME.language.npz`"), "language-beside-a-file-namelanguagenpz");
    let text = "# One\n## Über `x`\n```sh\n# no heading\n```\n#none\n### One\n";
    assert_eq!(anchors(text), ["one", "über-x", "one-1"]);
}

#[test]
fn citations_and_links_are_recognised() {
    // In two pieces, as this line would be a citation itself.
    let line =
        ["as docs/", "internals/method.md#code-length, step 1; docs/", "data.md has no anchor"].concat();
    assert_eq!(citations(&line), [("docs/internals/method.md".to_owned(), "code-length")]);
    assert_eq!(links("a [b](c.md#d), [e](#f) and [g] (h)"), ["c.md#d", "#f"]);
}

/// Headings of the troubleshooting page are parts of messages of the program.
#[test]
fn troubleshooting_has_sentences_of_the_program() {
    let page = std::fs::read_to_string(root().join("docs/use/troubleshooting.md")).unwrap();
    let sentences: Vec<&str> =
        page.lines().filter_map(|l| l.strip_prefix("### `")?.strip_suffix('`')).collect();
    assert!(sentences.len() > 20);
    let mut sources = String::new();
    for (path, text) in texts().iter().filter(|(p, _)| p.extension().is_some_and(|e| e == "rs")) {
        let in_tests = path.strip_prefix(root()).is_ok_and(|p| p.starts_with("tests"));
        if !in_tests {
            sources.push_str(text);
        }
    }
    // A literal may continue in the next line.
    let sources = sources.replace("\\\n", "");
    let words: Vec<&str> = sources.split_whitespace().collect();
    let sources = words.join(" ");
    let gone: Vec<&&str> = sentences.iter().filter(|s| !sources.contains(**s)).collect();
    assert!(gone.is_empty(), "the program prints none of these: {gone:#?}");
}
