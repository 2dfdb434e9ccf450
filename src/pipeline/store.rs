//! Outputs of stages on disk and in memory, by their dependencies.
use super::output::Value;
use crate::checkpoint::Checkpoint;
use crate::error::words;
use crate::files;
use crate::sync::lock;
use crate::{Error, Result};
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Most bytes in the folder: the stages of some twenty scenes of four photos.
const CAPACITY: u64 = 4 << 30;

/// Extension of the files.
const EXTENSION: &str = "stage";

/// Checksum of all dependencies of an output.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key(String);

impl Key {
    /// Key from the name of a stage, its settings, and the keys of its inputs.
    pub(super) fn of(name: &str, settings: &[&str], inputs: &[&Key]) -> Key {
        let mut digest = Sha256::new();
        let all = std::iter::once(&name).chain(settings).copied().chain(inputs.iter().map(|k| k.0.as_str()));
        for text in all {
            digest.update((text.len() as u64).to_le_bytes());
            digest.update(text);
        }
        // The number of settings is fixed, so the inputs need no separator.
        Key(files::hex(&digest.finalize())[..32].to_owned())
    }
}

/// Conversion of outputs to bytes and back.
pub struct Codec<T> {
    /// Writes an output to bytes.
    pub write: fn(&T) -> Result<Vec<u8>>,
    /// Reads an output; `None` where the bytes are invalid.
    pub read: fn(&[u8]) -> Option<T>,
}

/// Codec of every type that serde can write.
pub fn kept<T: Serialize + DeserializeOwned>() -> Option<Codec<T>> {
    let write = |value: &T| postcard::to_stdvec(value).map_err(unwritable);
    Some(Codec { write, read: |bytes| postcard::from_bytes(bytes).ok() })
}

fn unwritable(e: postcard::Error) -> Error {
    Error::work(format!("stage store: {e}"))
}

/// Outputs by their [`Key`]. Damaged files of a folder are computed again and overwritten.
#[derive(Default)]
pub struct Store {
    folder: Option<PathBuf>,
    resume: bool,
    every: Duration,
    /// Stages whose outputs are not kept in memory.
    passing: &'static [&'static str],
    memory: Option<Mutex<BTreeMap<String, Made>>>,
    /// Whether the warning was given that outputs are not kept.
    warned: AtomicBool,
}

/// An output in memory.
struct Made {
    /// `None` after [`Store::forget_unused`], or where the store does not keep the stage.
    value: Option<Value>,
    /// Seconds that the stage ran.
    seconds: f64,
    /// Whether a graph used it since the last [`Store::forget_unused`].
    used: bool,
}

impl Store {
    /// A store that keeps nothing.
    pub fn none() -> Store {
        Store::default()
    }

    /// A store in memory of every output of its graphs, until [`Store::forget_unused`].
    pub fn in_memory() -> Store {
        Store { memory: Some(Mutex::default()), ..Store::default() }
    }

    /// [`Store::in_memory`] without the outputs of these stages: large ones that no other graph
    /// needs.
    pub fn in_memory_without(stages: &'static [&'static str]) -> Store {
        Store { passing: stages, ..Store::in_memory() }
    }

    /// Drops from memory the outputs that no graph has used since the last call.
    pub fn forget_unused(&self) {
        let Some(memory) = &self.memory else { return };
        for made in lock(memory).values_mut() {
            if !std::mem::take(&mut made.used) {
                made.value = None;
            }
        }
    }

    /// A store in `folder`, which also keeps the state of training at the interval `every`; with
    /// `resume`, graphs read the files that are there.
    pub fn at(folder: impl Into<PathBuf>, resume: bool, every: Duration) -> Store {
        Store { folder: Some(folder.into()), resume, every, ..Store::default() }
    }

    /// Output in memory, if this store has it.
    pub(super) fn memory_get(&self, key: &Key) -> Option<Value> {
        let mut memory = lock(self.memory.as_ref()?);
        let made = memory.get_mut(&key.0)?;
        made.used = true;
        made.value.clone()
    }

    /// Seconds that the stage ran in this process; 0 otherwise.
    pub(super) fn seconds(&self, key: &Key) -> f64 {
        let memory = self.memory.as_ref().map(|m| lock(m));
        memory.and_then(|m| m.get(&key.0).map(|made| made.seconds)).unwrap_or(0.0)
    }

    /// Keeps an output for [`Store::memory_get`], in a store in memory.
    pub(super) fn memory_put(&self, name: &str, key: &Key, value: &Value, seconds: f64) {
        if let Some(memory) = &self.memory {
            let value = (!self.passing.contains(&name)).then(|| value.clone());
            let made = Made { value, seconds, used: true };
            lock(memory).insert(key.0.clone(), made);
        }
    }

    /// Checkpoint of a running stage.
    pub(super) fn checkpoint(&self, name: &str, key: &Key) -> Option<Checkpoint> {
        let file = Store::file(self.folder.as_ref()?, &format!("{name}-state"), key);
        Some(Checkpoint::new(file, self.every, self.resume))
    }

    fn file(folder: &Path, name: &str, key: &Key) -> PathBuf {
        folder.join(format!("{name}-{}.{EXTENSION}", key.0))
    }

    /// Reads an output with the warnings that were given while it was made.
    pub(super) fn load<T>(&self, name: &str, key: &Key, codec: &Codec<T>) -> Option<(Vec<String>, T)> {
        let folder = self.folder.as_ref().filter(|_| self.resume)?;
        let bytes = files::read_with_checksum(&Store::file(folder, name, key))?;
        let (warnings, body) = postcard::take_from_bytes(&bytes).ok()?;
        Some((warnings, (codec.read)(body)?))
    }

    /// Writes an output and returns whether it succeeded: a full disk costs the next run time, but
    /// not this run its result. `warn` gets the first reason of a failure.
    pub(super) fn save<T>(
        &self,
        name: &str,
        key: &Key,
        codec: &Codec<T>,
        warnings: &[String],
        value: &T,
        warn: &dyn Fn(&str),
    ) -> Result<bool> {
        let Some(folder) = &self.folder else { return Ok(false) };
        let file = Store::file(folder, name, key);
        let warnings = postcard::to_stdvec(warnings).map_err(unwritable)?;
        let body = [warnings, (codec.write)(value)?].concat();
        let written = files::write_with_checksum(&file, &body);
        match &written {
            Ok(()) => files::prune(&file, EXTENSION, CAPACITY),
            Err(_) if self.warned.swap(true, Ordering::Relaxed) => {}
            Err(e) => warn(&format!(
                "stages are not kept, so that --resume will find nothing: {}: {}",
                folder.display(),
                words(e)
            )),
        }
        Ok(written.is_ok())
    }

    /// Kept files of a folder, with sizes in bytes.
    pub fn list(folder: &Path) -> Vec<(PathBuf, u64)> {
        files::in_folder(folder, EXTENSION)
    }
}
