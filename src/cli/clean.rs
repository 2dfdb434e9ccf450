//! `splatvk clean`: lists and frees files of earlier runs that later runs would reuse.
use super::args::CleanArgs;
use super::print::{print, print_json};
use crate::fetch;
use crate::files::{leftovers, remove_leftover};
use crate::infer::{Registry, cache};
use crate::pipeline::Store;
use crate::{Error, Result};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Maximum number of listed files per kind.
const LISTED: usize = 20;

/// Kept files of one kind.
struct KeptFiles {
    kind: &'static str,
    folder: PathBuf,
    files: Vec<(PathBuf, u64)>,
}

impl KeptFiles {
    fn bytes(&self) -> u64 {
        self.files.iter().map(|f| f.1).sum()
    }

    fn json(&self) -> Value {
        let paths: Vec<String> = self.files.iter().map(|(path, _)| path.display().to_string()).collect();
        json!({
            "what": self.kind, "folder": self.folder, "files": self.files.len(), "bytes": self.bytes(), "paths": paths,
        })
    }

    /// A line per file, up to [`LISTED`].
    fn listing(&self) -> String {
        let line = |(path, _): &(PathBuf, u64)| format!("  {}\n", path.display());
        let more = match self.files.len().saturating_sub(LISTED) {
            0 => String::new(),
            more => format!("  and {more} more\n"),
        };
        self.files.iter().take(LISTED).map(line).collect::<String>() + &more
    }
}

pub fn clean(args: &CleanArgs) -> Result<()> {
    let (stages, answers) = (crate::run::stage_folder()?, cache::folder()?);
    let mut rows = vec![
        KeptFiles {
            kind: "stages of runs, for --resume",
            files: [Store::list(&stages), unfinished_in(&stages)].concat(),
            folder: stages,
        },
        KeptFiles {
            kind: "answers of networks",
            files: [cache::files(&answers), unfinished_in(&answers), unfinished_in(&answers.join("sums"))]
                .concat(),
            folder: answers,
        },
    ];
    rows.extend(Registry::places(args.models.as_deref())?.into_iter().map(|folder| KeptFiles {
        kind: "models that were fetched in part",
        files: fetch::leftovers(&folder),
        folder,
    }));
    rows.push(KeptFiles {
        kind: "unfinished files of commands that were killed",
        files: unfinished(&args.folders)?,
        folder: PathBuf::from("."),
    });
    if args.delete {
        for row in &rows {
            row.files.iter().try_for_each(|(path, _)| remove(path))?;
        }
    }
    if args.json {
        let kept: Vec<_> = rows.iter().map(KeptFiles::json).collect();
        return print_json(&json!({ "deleted": args.delete, "kept": kept }));
    }
    let verb = if args.delete { "freed" } else { "holds" };
    for r in &rows {
        let size = r.bytes() as f64 / f64::from(1 << 20);
        print(&format!(
            "{}: {verb} {size:.1} MiB in {} files ({})\n",
            r.kind,
            r.files.len(),
            r.folder.display()
        ))?;
        if !args.delete {
            print(&r.listing())?;
        }
    }
    match args.delete {
        true => Ok(()),
        false => print(
            "splatvk clean --delete frees it; runs then start from their photos, fetches from the first byte\n",
        ),
    }
}

/// Unfinished files of dead processes in a folder of the program, with their sizes.
fn unfinished_in(folder: &Path) -> Vec<(PathBuf, u64)> {
    leftovers(folder).into_iter().map(|path| (path.clone(), size(&path))).collect()
}

/// Unfinished files of dead processes in the current folder, in out/ and in `folders`, and in the
/// folders directly below each.
fn unfinished(folders: &[PathBuf]) -> Result<Vec<(PathBuf, u64)>> {
    let mut found = BTreeMap::new();
    for folder in [Path::new("."), Path::new("out")].into_iter().chain(folders.iter().map(PathBuf::as_path)) {
        let entries = match std::fs::read_dir(folder) {
            Ok(entries) => entries,
            Err(_) if folder == Path::new("out") => continue,
            Err(e) => return Err(Error::io(folder)(e)),
        };
        // Links are not followed: they lead elsewhere.
        let below = entries.flatten().filter(|e| e.file_type().is_ok_and(|t| t.is_dir())).map(|e| e.path());
        for folder in below.chain([folder.to_path_buf()]) {
            // Each folder once, by its canonical path.
            let Ok(whole) = folder.canonicalize() else { continue };
            found.entry(whole).or_insert_with(|| unfinished_in(&folder));
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

/// Removes a file, or a marked folder of unfinished work. One that another process removed
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
