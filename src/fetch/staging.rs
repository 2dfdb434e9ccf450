//! Where a model is put together: a hidden folder beside its place, which no search for models looks into. It outlives a killed
//! process, so that the next fetch goes on from it; one process at a time holds it.
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};

use crate::files::{restore, swap};
use crate::{Error, Result};

/// What the names of such folders begin with.
const PREFIX: &str = ".fetch-";

/// The folder in which one model comes into being.
pub(super) struct Staging {
    root: PathBuf,
    place: PathBuf,
    name: String,
    _lock: File,
}

impl Staging {
    /// That of model `name` in a model folder, as an earlier process left it.
    pub fn open(folder: &Path, name: &str) -> Result<Staging> {
        let root = root(folder, name);
        std::fs::create_dir_all(&root).map_err(Error::unwritable(&root))?;
        let lock = lock(&root)?.ok_or_else(|| {
            Error::input(format!("{name}: another splatvk is fetching it into {}", folder.display()))
        })?;
        let staging = Staging { root, place: folder.join(name), name: name.to_owned(), _lock: lock };
        restore(&staging.place);
        for part in [staging.model(), staging.work()] {
            std::fs::create_dir_all(&part).map_err(Error::unwritable(&part))?;
        }
        Ok(staging)
    }

    /// The hidden folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// The model's folder to be.
    pub fn model(&self) -> PathBuf {
        self.root.join(&self.name)
    }

    /// For partial files, checkpoints and what exports need.
    pub fn work(&self) -> PathBuf {
        self.root.join("work")
    }

    /// Starts the model's folder afresh.
    pub fn clear_model(&self) -> Result<()> {
        let model = self.model();
        std::fs::remove_dir_all(&model)
            .and_then(|()| std::fs::create_dir(&model))
            .map_err(Error::unwritable(&model))
    }

    /// Removes some files of the model.
    pub fn discard<'a>(&self, files: impl Iterator<Item = &'a str>) {
        // Reached on the way out of an error, which is the one to report.
        files.for_each(|name| drop(std::fs::remove_file(self.model().join(name))));
    }

    /// Moves the model to its place. One that is there is only removed after that, and comes back if the move fails.
    pub fn install(self) -> Result<PathBuf> {
        let moved = match self.place.symlink_metadata() {
            Ok(_) => swap(&self.model(), &self.place),
            Err(_) => std::fs::rename(self.model(), &self.place),
        };
        moved.map_err(Error::io(&self.place))?;
        // The move must be on disk before what it replaces goes.
        if let Some(folder) = self.place.parent() {
            let _ = File::open(folder).and_then(|f| f.sync_all());
        }
        std::fs::remove_dir_all(&self.root).map_err(Error::io(&self.root))?;
        Ok(self.place)
    }
}

/// The hidden folder of a model.
pub(super) fn root(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{PREFIX}{name}"))
}

fn lock(root: &Path) -> Result<Option<File>> {
    let path = root.join("lock");
    let file = File::create(&path).map_err(Error::unwritable(&path))?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Ok(None),
        Err(TryLockError::Error(e)) => Err(Error::io(&path)(e)),
    }
}

/// What interrupted fetches left in a model folder: each hidden folder that no process holds, with its bytes.
pub fn leftovers(folder: &Path) -> Vec<(PathBuf, u64)> {
    let list = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let ours = |p: &PathBuf| p.is_dir() && name(p).is_some();
    let mut all: Vec<PathBuf> = list.filter(ours).collect();
    all.sort();
    all.retain(|root| matches!(lock(root), Ok(Some(_))));
    all.into_iter()
        .map(|root| {
            let size = bytes(&root);
            (root, size)
        })
        .collect()
}

/// Removes one of [`leftovers`]; a model that a killed process had taken out to replace it goes back to its place.
pub fn sweep(root: &Path) -> Result<()> {
    let (Some(folder), Some(name)) = (root.parent(), name(root)) else { return Ok(()) };
    let Some(_held) = lock(root)? else { return Ok(()) };
    restore(&folder.join(name));
    std::fs::remove_dir_all(root).map_err(Error::io(root))
}

/// The model whose hidden folder this is.
pub(super) fn name(root: &Path) -> Option<String> {
    root.file_name()?.to_str()?.strip_prefix(PREFIX).filter(|n| !n.is_empty()).map(str::to_owned)
}

fn bytes(path: &Path) -> u64 {
    let Ok(entries) = std::fs::read_dir(path) else {
        return path.symlink_metadata().map_or(0, |m| m.len());
    };
    entries.flatten().map(|e| if e.path().is_symlink() { 0 } else { bytes(&e.path()) }).sum()
}
