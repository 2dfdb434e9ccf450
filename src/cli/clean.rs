//! `splatvk clean`: what earlier runs left to be used again, and how to free it.
use super::args::CleanArgs;
use super::print::{print, print_json};
use crate::fetch;
use crate::files::{leftovers, remove_leftover};
use crate::infer::{Registry, cache};
use crate::pipeline::Store;
use crate::{Error, Result};
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Most things of a kind that are listed.
const LISTED: usize = 20;

/// Kept things of one kind.
struct KeptRow {
    what: &'static str,
    folder: PathBuf,
    things: Vec<(PathBuf, u64)>,
}

impl KeptRow {
    fn bytes(&self) -> u64 {
        self.things.iter().map(|f| f.1).sum()
    }

    /// A line for each thing, or for the first of many.
    fn listed(&self) -> String {
        let line = |(path, _): &(PathBuf, u64)| format!("  {}\n", path.display());
        let more = match self.things.len().saturating_sub(LISTED) {
            0 => String::new(),
            more => format!("  and {more} more\n"),
        };
        self.things.iter().take(LISTED).map(line).collect::<String>() + &more
    }
}

pub fn clean(args: &CleanArgs) -> Result<()> {
    let (stages, answers) = (crate::run::stage_folder()?, cache::folder()?);
    let mut rows = vec![
        KeptRow {
            what: "stages of runs, for --resume",
            things: [Store::list(&stages), partial(&stages)].concat(),
            folder: stages,
        },
        KeptRow {
            what: "answers of networks",
            things: [cache::files(&answers), partial(&answers), partial(&answers.join("sums"))].concat(),
            folder: answers,
        },
    ];
    rows.extend(Registry::places(args.models.as_deref())?.into_iter().map(|folder| KeptRow {
        what: "models that were fetched in part",
        things: fetch::leftovers(&folder),
        folder,
    }));
    rows.push(KeptRow {
        what: "unfinished files of commands that were killed",
        things: unfinished(&args.folders)?,
        folder: PathBuf::from("."),
    });
    if args.delete {
        for row in &rows {
            row.things.iter().try_for_each(|(path, _)| remove(path))?;
        }
    }
    if args.json {
        let one = |r: &KeptRow| {
            let paths: Vec<String> = r.things.iter().map(|(path, _)| path.display().to_string()).collect();
            json!({ "what": r.what, "folder": r.folder, "files": r.things.len(), "bytes": r.bytes(), "paths": paths })
        };
        return print_json(
            &json!({ "deleted": args.delete, "kept": rows.iter().map(one).collect::<Vec<_>>() }),
        );
    }
    let verb = if args.delete { "freed" } else { "holds" };
    for r in &rows {
        let size = r.bytes() as f64 / f64::from(1 << 20);
        print(&format!(
            "{}: {verb} {size:.1} MiB in {} files ({})\n",
            r.what,
            r.things.len(),
            r.folder.display()
        ))?;
        if !args.delete {
            print(&r.listed())?;
        }
    }
    match args.delete {
        true => Ok(()),
        false => print(
            "splatvk clean --delete frees it; runs then start from their photos, fetches from the first byte\n",
        ),
    }
}

/// What processes that are gone have begun in a folder of the program's own.
fn partial(folder: &Path) -> Vec<(PathBuf, u64)> {
    leftovers(folder).into_iter().map(|path| (path.clone(), size(&path))).collect()
}

/// What processes that are gone have begun in the current folder, in out/ and in `folders`, and in
/// the folders of each.
fn unfinished(folders: &[PathBuf]) -> Result<Vec<(PathBuf, u64)>> {
    let mut found = BTreeMap::new();
    for folder in [Path::new("."), Path::new("out")].into_iter().chain(folders.iter().map(PathBuf::as_path)) {
        let entries = match std::fs::read_dir(folder) {
            Ok(entries) => entries,
            Err(_) if folder == Path::new("out") => continue,
            Err(e) => return Err(Error::io(folder)(e)),
        };
        // Links are not followed: what they lead to is not below.
        let below = entries.flatten().filter(|e| e.file_type().is_ok_and(|t| t.is_dir())).map(|e| e.path());
        for folder in below.chain([folder.to_path_buf()]) {
            // Each folder once, under whichever name.
            let Ok(whole) = folder.canonicalize() else { continue };
            found.entry(whole).or_insert_with(|| partial(&folder));
        }
    }
    Ok(found.into_values().flatten().collect())
}

/// Bytes of a file, or of all files in a folder.
fn size(path: &Path) -> u64 {
    match path.symlink_metadata() {
        Ok(meta) if meta.is_dir() => {
            std::fs::read_dir(path).into_iter().flatten().flatten().map(|e| size(&e.path())).sum()
        }
        Ok(meta) => meta.len(),
        Err(_) => 0,
    }
}

/// Removes a file, or, by its mark, a folder of unfinished work. What another process has removed
/// meanwhile is no error.
fn remove(path: &Path) -> Result<()> {
    let removed = match path.symlink_metadata() {
        Ok(meta) if meta.is_dir() => remove_leftover(path),
        Ok(_) => std::fs::remove_file(path),
        Err(e) => Err(e),
    };
    match removed {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path)(e)),
        _ => Ok(()),
    }
}
