//! `splatvk clean`: what earlier runs left to be used again, and how to free it.
use super::args::CleanArgs;
use super::print::{print, print_json};
use crate::infer::cache;
use crate::pipeline::Store;
use crate::{Error, Result};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Kept things of one kind.
struct KeptRow {
    what: &'static str,
    folder: PathBuf,
    files: Vec<(PathBuf, u64)>,
}

impl KeptRow {
    fn bytes(&self) -> u64 {
        self.files.iter().map(|f| f.1).sum()
    }
}

pub fn clean(args: &CleanArgs) -> Result<()> {
    let stages = crate::run::stage_folder();
    let rows = [
        KeptRow { what: "stages of runs, for --resume", files: Store::list(&stages), folder: stages },
        KeptRow { what: "answers of networks", files: cache::files(), folder: cache::folder() },
    ];
    if args.delete {
        for (file, _) in rows.iter().flat_map(|r| &r.files) {
            remove(file)?;
        }
    }
    if args.json {
        let one = |r: &KeptRow| json!({ "what": r.what, "folder": r.folder, "files": r.files.len(), "bytes": r.bytes() });
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
            r.files.len(),
            r.folder.display()
        ))?;
    }
    match args.delete {
        true => Ok(()),
        false => print("splatvk clean --delete frees it; runs then start from their photos\n"),
    }
}

/// A file that another process has removed meanwhile is no error.
fn remove(file: &Path) -> Result<()> {
    match std::fs::remove_file(file) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(file)(e)),
        _ => Ok(()),
    }
}
