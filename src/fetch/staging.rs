//! Staging of a model: a hidden folder beside its place that searches for models skip. It survives
//! a killed process, so that the next fetch resumes; one process at a time holds it.
use std::fs::File;
use std::path::{Path, PathBuf};

use crate::files::{Found, Held, look, swap};
use crate::{Error, Result};

/// Prefix of the names of these folders.
const PREFIX: &str = ".fetch-";

/// Staging folder of one model.
pub(super) struct Staging {
    held: Held,
    place: PathBuf,
    name: String,
}

impl Staging {
    /// Opens the staging folder of model `name` in a model folder, with the leftovers of an earlier
    /// process.
    pub fn open(folder: &Path, name: &str) -> Result<Staging> {
        let root = root(folder, name);
        std::fs::create_dir_all(folder).map_err(Error::unwritable(folder))?;
        let place = folder.join(name);
        let staging = Staging { held: Held::take(&root, &place, true)?, place, name: name.to_owned() };
        staging.held.put_back();
        for part in [staging.model(), staging.work()] {
            std::fs::create_dir_all(&part).map_err(Error::unwritable(&part))?;
        }
        Ok(staging)
    }

    /// The hidden folder.
    pub fn root(&self) -> &Path {
        self.held.folder()
    }

    /// Folder of the new model.
    pub fn model(&self) -> PathBuf {
        self.root().join(&self.name)
    }

    /// Folder of partial files, checkpoints and exports.
    pub fn work(&self) -> PathBuf {
        self.root().join("work")
    }

    /// Empties the model's folder.
    pub fn clear_model(&self) -> Result<()> {
        let model = self.model();
        std::fs::remove_dir_all(&model)
            .and_then(|()| std::fs::create_dir(&model))
            .map_err(Error::unwritable(&model))
    }

    /// Removes some files of the model.
    pub fn discard<'a>(&self, files: impl Iterator<Item = &'a str>) {
        // Called on an error, which is the one to report.
        files.for_each(|name| drop(std::fs::remove_file(self.model().join(name))));
    }

    /// Moves the model to its place. An old one is removed only afterwards, and restored if the
    /// move fails.
    pub fn install(self) -> Result<PathBuf> {
        let moved = match self.place.symlink_metadata() {
            Ok(_) => swap(&self.model(), &self.place, &self.held.aside()),
            Err(_) => std::fs::rename(self.model(), &self.place),
        };
        moved.map_err(Error::io(&self.place))?;
        // The move must be on disk before the old model is removed.
        if let Some(folder) = self.place.parent() {
            let _ = File::open(folder).and_then(|f| f.sync_all());
        }
        let root = self.root().to_path_buf();
        self.held.clear().map_err(Error::io(root))?;
        Ok(self.place)
    }
}

/// Staging folder of a model.
pub(super) fn root(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{PREFIX}{name}"))
}

/// Staging folders in a model folder whose process is gone, with their sizes in bytes.
pub fn leftovers(folder: &Path) -> Vec<(PathBuf, u64)> {
    let list = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let is_leftover = |p: &PathBuf| name(p).is_some() && matches!(look(p), Found::Left(_) | Found::Blank(_));
    let mut all: Vec<PathBuf> = list.filter(is_leftover).collect();
    all.sort();
    all.into_iter()
        .map(|root| {
            let size = bytes(&root);
            (root, size)
        })
        .collect()
}

/// Name of the model of a staging folder.
pub(super) fn name(root: &Path) -> Option<String> {
    root.file_name()?.to_str()?.strip_prefix(PREFIX).filter(|n| !n.is_empty()).map(str::to_owned)
}

fn bytes(path: &Path) -> u64 {
    let Ok(entries) = std::fs::read_dir(path) else {
        return path.symlink_metadata().map_or(0, |m| m.len());
    };
    entries.flatten().map(|e| if e.path().is_symlink() { 0 } else { bytes(&e.path()) }).sum()
}
