//! `splatvk clean`: what earlier runs left to be used again, and how to free it.
use super::args::CleanArgs;
use super::print::{print, print_json};
use crate::fetch;
use crate::infer::{Registry, cache};
use crate::pipeline::Store;
use crate::{Error, Result};
use serde_json::json;
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
            things: Store::list(&stages),
            folder: stages,
            remove,
        },
        KeptRow { what: "answers of networks", things: answers, folder, remove },
    ];
    rows.extend(Registry::places(args.models.as_deref()).into_iter().map(|folder| KeptRow {
        what: "models that were fetched in part",
        things: fetch::leftovers(&folder),
        folder,
        remove: fetch::sweep,
    }));
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

/// A file that another process has removed meanwhile is no error.
fn remove(file: &Path) -> Result<()> {
    match std::fs::remove_file(file) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::io(file)(e)),
        _ => Ok(()),
    }
}
