//! What networks said about a photo, kept by the content of the photo and of the model: a second run asks nobody.
//!
//! The folder is a cache: anything odd about a file, and it is computed and written again. The least recently used files go
//! when it grows beyond its capacity.
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use sha2::{Digest, Sha256};

use super::graph::GraphFile;
use super::registry::{content_hash, home, sha256};
use crate::Result;

/// Bytes that the folder may hold: the pointmaps and descriptors of a dozen scenes, or the masks of hundreds.
const CAPACITY: u64 = 4 << 30;

/// Identifies a result by everything that it depends on.
pub struct Key {
    kind: &'static str,
    digest: Sha256,
}

impl Key {
    /// A kind of result; the word is part of the file name.
    pub fn new(kind: &'static str) -> Key {
        // Another version may prepare photos otherwise.
        Key { kind, digest: Sha256::new() }.text(kind).text(env!("CARGO_PKG_VERSION"))
    }

    /// Depends on a text.
    pub fn text(mut self, text: &str) -> Key {
        self.digest.update((text.len() as u64).to_le_bytes());
        self.digest.update(text);
        self
    }

    /// Depends on values.
    pub fn values<T: bytemuck::NoUninit>(mut self, values: &[T]) -> Key {
        self.digest.update((values.len() as u64).to_le_bytes());
        self.digest.update(bytemuck::cast_slice::<T, u8>(values));
        self
    }

    /// Depends on the content of a model's files and on how they are spoken to.
    pub fn model(mut self, graph: &GraphFile) -> Result<Key> {
        for file in std::iter::once(&graph.path).chain(&graph.external) {
            self = self.text(&fingerprint(file).map_err(crate::Error::io(file))?);
        }
        Ok(self.text(&format!("{:?}", graph.binding)))
    }

    /// 16 hexadecimal digits.
    pub fn short(self) -> String {
        let mut hash = sha256(&self.digest.finalize());
        hash.truncate(16);
        hash
    }

    fn file(self) -> PathBuf {
        let kind = self.kind;
        home().join("cache").join(format!("{kind}-{}.f32", self.short()))
    }
}

thread_local! {
    static OFF: Cell<bool> = const { Cell::new(false) };
}

/// No cache on this thread while this lives: what is measured or tested must be computed.
pub(crate) struct Off {
    before: bool,
}

/// Computes everything until the result is dropped.
pub(crate) fn off() -> Off {
    Off { before: OFF.replace(true) }
}

impl Drop for Off {
    fn drop(&mut self) {
        OFF.set(self.before);
    }
}

/// `compute`, or what it gave the last time with the same key.
pub fn remember(key: Key, compute: impl FnOnce() -> Result<Vec<f32>>) -> Result<Vec<f32>> {
    if OFF.get() {
        return compute();
    }
    let file = key.file();
    if let Some(values) = read(&file) {
        return Ok(values);
    }
    let values = compute()?;
    // Not being able to keep it costs time only.
    let body: &[u8] = bytemuck::cast_slice(&values);
    if write(&file, &[sha256(body).as_bytes(), body].concat()).is_ok() {
        prune(&file);
    }
    Ok(values)
}

fn read(file: &Path) -> Option<Vec<f32>> {
    let bytes = std::fs::read(file).ok()?;
    let (sum, body) = bytes.split_at_checked(64)?;
    if body.len() % 4 != 0 || *sum != *sha256(body).as_bytes() {
        return None;
    }
    // Remembers the use, for `prune`; a folder that cannot be written to prunes nothing either.
    let _ = std::fs::File::options().append(true).open(file).and_then(|f| f.set_modified(SystemTime::now()));
    Some(bytemuck::pod_collect_to_vec(body))
}

fn write(file: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let partial = file.with_extension(format!("partial-{}", std::process::id()));
    let kept = std::fs::create_dir_all(file.parent().unwrap_or(file))
        .and_then(|()| std::fs::write(&partial, bytes))
        .and_then(|()| std::fs::rename(&partial, file));
    kept.inspect_err(|_| {
        let _ = std::fs::remove_file(&partial);
    })
}

/// Removes what was not used for longest until the rest fits.
fn prune(newest: &Path) {
    let Some(folder) = newest.parent() else { return };
    let entry = |e: std::fs::DirEntry| {
        let meta = e.metadata().ok()?;
        Some((meta.modified().ok()?, meta.len(), e.path()))
    };
    let list = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<_> =
        list.filter_map(entry).filter(|f| f.2.extension().is_some_and(|e| e == "f32")).collect();
    files.sort();
    let mut total: u64 = files.iter().map(|f| f.1).sum();
    for (_, size, path) in files {
        if total <= CAPACITY || path == newest {
            break;
        }
        if std::fs::remove_file(&path).is_ok() {
            total -= size;
        }
    }
}

/// sha256 of a file, remembered across processes by its place, size and time of change: hashing gigabytes takes seconds.
pub(super) fn fingerprint(path: &Path) -> std::io::Result<String> {
    let meta = std::fs::metadata(path)?;
    let age = meta.modified()?.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let stamp = format!("{}:{}:{}", path.canonicalize()?.display(), meta.len(), age.as_nanos());
    let note = home().join("cache").join("sums").join(&sha256(stamp.as_bytes())[..16]);
    if let Ok(known) = std::fs::read_to_string(&note)
        && known.len() == 64
    {
        return Ok(known);
    }
    let hash = content_hash(path)?;
    let _ = write(&note, hash.as_bytes());
    Ok(hash)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_damaged_file_is_computed_again() {
        let key = || Key::new("test").text("damaged").values(&[std::process::id()]);
        let file = key().file();
        let count = std::cell::Cell::new(0);
        let ask = || {
            remember(key(), || {
                count.set(count.get() + 1);
                Ok(vec![1.0, 2.0])
            })
        };
        assert_eq!(ask().unwrap(), [1.0, 2.0]);
        assert_eq!(ask().unwrap(), [1.0, 2.0]);
        assert_eq!(count.get(), 1, "the second answer comes from the file");
        let mut bytes = std::fs::read(&file).unwrap();
        bytes[70] ^= 1;
        std::fs::write(&file, &bytes).unwrap();
        assert_eq!(ask().unwrap(), [1.0, 2.0]);
        assert_eq!(count.get(), 2);
        std::fs::remove_file(&file).unwrap();
        assert_ne!(Key::new("test").text("a").text("b").file(), Key::new("test").text("ab").text("").file());
    }
}
