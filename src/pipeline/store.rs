//! Outputs of stages on disk, by everything that they depend on.
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

/// Bytes that the folder may hold: the stages of some twenty scenes of four photos.
const CAPACITY: u64 = 4 << 30;

/// Extension of the files.
const EXTENSION: &str = "stage";

/// Identifies an output by everything that it depends on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key(String);

impl Key {
    /// From the stage's name, what it depends on, and the keys of its inputs.
    pub(super) fn of(name: &str, settings: &[&str], inputs: &[&Key]) -> Key {
        let mut digest = Sha256::new();
        let all = std::iter::once(&name).chain(settings).copied().chain(inputs.iter().map(|k| k.0.as_str()));
        for text in all {
            digest.update((text.len() as u64).to_le_bytes());
            digest.update(text);
        }
        // The number of settings is fixed, that of inputs is not.
        Key(files::hex(&digest.finalize())[..32].to_owned())
    }
}

/// Turns outputs into bytes and back.
pub struct Codec<T> {
    /// To bytes.
    pub write: fn(&T) -> Result<Vec<u8>>,
    /// Back; `None` where the bytes are not such an output.
    pub read: fn(&[u8]) -> Option<T>,
}

/// The codec of everything that serde can write.
pub fn kept<T: Serialize + DeserializeOwned>() -> Option<Codec<T>> {
    let write = |value: &T| postcard::to_stdvec(value).map_err(unwritable);
    Some(Codec { write, read: |bytes| postcard::from_bytes(bytes).ok() })
}

fn unwritable(e: postcard::Error) -> Error {
    Error::work(format!("stage store: {e}"))
}

/// Outputs by everything that they depend on. In a folder, any odd file is made again and written
/// over.
#[derive(Default)]
pub struct Store {
    folder: Option<PathBuf>,
    resume: bool,
    every: Duration,
    passing: &'static [&'static str],
    memory: Option<Mutex<BTreeMap<String, Made>>>,
    /// Whether it was said that outputs are not kept.
    told: AtomicBool,
}

/// An output in memory.
struct Made {
    /// Gone once [`Store::forget_unused`] or the rules of the store say so.
    value: Option<Value>,
    /// That it took to make.
    seconds: f64,
    /// Since [`Store::forget_unused`] was last called.
    used: bool,
}

impl Store {
    /// Keeps nothing.
    pub fn none() -> Store {
        Store::default()
    }

    /// Keeps every output of the graphs that run with it, as long as it lives or until
    /// [`Store::forget_unused`].
    pub fn in_memory() -> Store {
        Store { memory: Some(Mutex::default()), ..Store::default() }
    }

    /// The same without the outputs of these stages: large ones that no other graph needs.
    pub fn in_memory_without(stages: &'static [&'static str]) -> Store {
        Store { passing: stages, ..Store::in_memory() }
    }

    /// Drops from memory what no graph has used since this was last called.
    pub fn forget_unused(&self) {
        let Some(memory) = &self.memory else { return };
        for made in lock(memory).values_mut() {
            if !std::mem::take(&mut made.used) {
                made.value = None;
            }
        }
    }

    /// Keeps outputs in `folder`, and the state of training every so often; with `resume` what is
    /// there is used.
    pub fn at(folder: impl Into<PathBuf>, resume: bool, every: Duration) -> Store {
        Store { folder: Some(folder.into()), resume, every, ..Store::default() }
    }

    /// What this process has made.
    pub(super) fn memory_get(&self, key: &Key) -> Option<Value> {
        let mut memory = lock(self.memory.as_ref()?);
        let made = memory.get_mut(&key.0)?;
        made.used = true;
        made.value.clone()
    }

    /// Seconds that it took, if this process has made it in this store; 0 otherwise.
    pub(super) fn seconds(&self, key: &Key) -> f64 {
        let memory = self.memory.as_ref().map(|m| lock(m));
        memory.and_then(|m| m.get(&key.0).map(|made| made.seconds)).unwrap_or(0.0)
    }

    /// Keeps it for [`Store::memory_get`], in a store that does.
    pub(super) fn memory_put(&self, name: &str, key: &Key, value: &Value, seconds: f64) {
        if let Some(memory) = &self.memory {
            let value = (!self.passing.contains(&name)).then(|| value.clone());
            let made = Made { value, seconds, used: true };
            lock(memory).insert(key.0.clone(), made);
        }
    }

    /// Where a stage keeps its state while it works.
    pub(super) fn checkpoint(&self, name: &str, key: &Key) -> Option<Checkpoint> {
        let file = Store::file(self.folder.as_ref()?, &format!("{name}-state"), key);
        Some(Checkpoint::new(file, self.every, self.resume))
    }

    fn file(folder: &Path, name: &str, key: &Key) -> PathBuf {
        folder.join(format!("{name}-{}.{EXTENSION}", key.0))
    }

    /// What was warned of while it was made, and the output.
    pub(super) fn load<T>(&self, name: &str, key: &Key, codec: &Codec<T>) -> Option<(Vec<String>, T)> {
        let folder = self.folder.as_ref().filter(|_| self.resume)?;
        let bytes = files::read_with_checksum(&Store::file(folder, name, key))?;
        let (warnings, body) = postcard::take_from_bytes(&bytes).ok()?;
        Some((warnings, (codec.read)(body)?))
    }

    /// Whether it is there now: a disk that is full costs the next run time, not this one its
    /// result. `warn` gets the first reason why one is not.
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
            Err(_) if self.told.swap(true, Ordering::Relaxed) => {}
            Err(e) => warn(&format!(
                "stages are not kept, so that --resume will find nothing: {}: {}",
                folder.display(),
                words(e)
            )),
        }
        Ok(written.is_ok())
    }

    /// What is kept in a folder, with sizes in bytes.
    pub fn list(folder: &Path) -> Vec<(PathBuf, u64)> {
        files::in_folder(folder, EXTENSION)
    }
}
