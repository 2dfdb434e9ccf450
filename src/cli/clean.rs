//! `splatvk clean`: what earlier runs left to be used again, and how to free it.
use super::args::CleanArgs;
use super::print::{print, print_json};
use crate::fetch;
use crate::files::{leftovers, remove_any};
use crate::infer::{Registry, cache};
use crate::pipeline::Store;
use crate::{Error, Result};
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Kept things of one kind, and how one of them goes.
struct KeptRow {
    what: &'static str,
    folder: PathBuf,
    things: Vec<(PathBuf, u64)>,
    remove: fn(&Path) -> Result<()>,
}

impl KeptRow {
    fn bytes(&self) -> u64 {
        self.things.iter().map(|f| f.1).sum()
    }
}

pub fn clean(args: &CleanArgs) -> Result<()> {
    let stages = crate::run::stage_folder();
    let (answers, folder) = (cache::files(), cache::folder());
    let mut rows = vec![
        KeptRow {
            what: "stages of runs, for --resume",
            things: [Store::list(&stages), partial(&stages)].concat(),
            folder: stages,
            remove,
        },
        KeptRow { what: "answers of networks", things: [answers, partial(&folder)].concat(), folder, remove },
    ];
    rows.extend(Registry::places(args.models.as_deref()).into_iter().map(|folder| KeptRow {
        what: "models that were fetched in part",
        things: fetch::leftovers(&folder),
        folder,
        remove: fetch::sweep,
    }));
    rows.push(KeptRow {
        what: "unfinished files of commands that were killed",
        things: unfinished(&args.folders)?,
        folder: PathBuf::from("."),
        remove: |path| gone(remove_any(path), path),
    });
    if args.delete {
        for row in &rows {
            row.things.iter().try_for_each(|(path, _)| (row.remove)(path))?;
        }
    }
    if args.json {
        let one = |r: &KeptRow| json!({ "what": r.what, "folder": r.folder, "files": r.things.len(), "bytes": r.bytes() });
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
    leftovers(folder, None).into_iter().map(|path| (path.clone(), size(&path))).collect()
}

/// What processes that are gone have begun in the current folder, in out/ and in `folders`, and in the folders of each.
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
        for path in below.chain([folder.to_path_buf()]).flat_map(|f| leftovers(&f, None)) {
            found.insert(path.canonicalize().unwrap_or_else(|_| path.clone()), size(&path));
        }
    }
    Ok(found.into_iter().collect())
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

fn remove(file: &Path) -> Result<()> {
    gone(std::fs::remove_file(file), file)
}

/// What another process has removed meanwhile is no error.
fn gone(outcome: std::io::Result<()>, path: &Path) -> Result<()> {
    match outcome {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(path)(e)),
        _ => Ok(()),
    }
}
