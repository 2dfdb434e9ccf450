//! Dependencies between the folders of `src`: in one direction, and without circles between files.
//! Tests are exempt.
#![allow(clippy::unwrap_used)] // a panic is how a test fails

#[path = "support/sources.rs"]
mod sources;

use sources::Crate;
use std::collections::BTreeSet;
use std::path::Path;

/// Each folder of `src`, and the folders that it uses. A folder comes after those that it uses.
const FOLDERS: &[(&str, &str)] = &[
    ("gpu", ""),
    ("pass", "gpu"),
    ("check", "gpu pass"),
    ("fetch", ""),
    ("fit", "gpu pass"),
    ("eval", "pass"),
    ("report", ""),
    ("synth", "eval"),
    ("pipeline", "gpu"),
    ("run", "gpu pass eval fit report pipeline"),
    ("ablate", "gpu eval fit report synth pipeline run"),
    ("bench", "gpu pass eval fit run"),
    ("capi", "gpu pass run"),
    ("cli", "gpu check fetch eval report synth pipeline run ablate bench"),
];

fn all() -> Crate {
    Crate::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"))
}

#[test]
fn folders_use_what_stands_above_them_and_nothing_else() {
    let mut stated = BTreeSet::new();
    for (k, (folder, used)) in FOLDERS.iter().enumerate() {
        for other in used.split_whitespace() {
            assert!(
                FOLDERS[..k].iter().any(|f| f.0 == other),
                "{folder} uses {other}, which must stand above it"
            );
            stated.insert((folder.to_string(), other.to_string()));
        }
    }
    let mut found = BTreeSet::new();
    for (file, used) in all().edges() {
        for other in used.iter().filter(|o| o[0] != file[0]) {
            let edge = (file[0].clone(), other[0].clone());
            let (file, other) = (file.join("/"), other.join("/"));
            assert!(stated.contains(&edge), "{file} uses {other}, but {} may not use {}", edge.0, edge.1);
            found.insert(edge);
        }
    }
    let unused: Vec<_> = stated.difference(&found).collect();
    assert!(unused.is_empty(), "no longer used, take them out of FOLDERS: {unused:?}");
}

#[test]
fn files_do_not_use_each_other_in_circles() {
    let circles: Vec<String> = all().circles().into_iter().map(|c| c.join(" ")).collect();
    assert!(circles.is_empty(), "files that use each other in a circle: {circles:#?}");
}
