//! Disk cache of network outputs, keyed by the content of photo and model.
//!
//! A damaged file is computed and written again. The least recently used files are removed when the
//! folder exceeds its capacity.
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use sha2::{Digest, Sha256};

use crate::Result;
use crate::files::home;
use crate::files::{self, content_hash, sha256};

/// Capacity of the folder, bytes: the pointmaps and descriptors of a dozen scenes, or the masks of
/// hundreds.
const CAPACITY: u64 = 4 << 30;

/// Extension of the files.
const EXTENSION: &str = "f32";

/// Hash of everything that a result depends on.
pub struct OutputKey {
    kind: &'static str,
    digest: Sha256,
}

impl OutputKey {
    /// Begins the key of a kind of result; `kind` is part of the file name.
    pub fn new(kind: &'static str) -> OutputKey {
        // Another version may preprocess photos differently.
        OutputKey { kind, digest: Sha256::new() }.text(kind).text(env!("CARGO_PKG_VERSION"))
    }

    /// Adds a text.
    pub fn text(mut self, text: &str) -> OutputKey {
        self.digest.update((text.len() as u64).to_le_bytes());
        self.digest.update(text);
        self
    }

    /// Adds values.
    pub fn values<T: bytemuck::NoUninit>(mut self, values: &[T]) -> OutputKey {
        self.digest.update((values.len() as u64).to_le_bytes());
        self.digest.update(bytemuck::cast_slice::<T, u8>(values));
        self
    }

    /// First 16 hexadecimal digits of the hash.
    pub fn short(self) -> String {
        let mut hash = sha256(&self.digest.finalize());
        hash.truncate(16);
        hash
    }

    fn file(self) -> Result<PathBuf> {
        let kind = self.kind;
        Ok(folder()?.join(format!("{kind}-{}.{EXTENSION}", self.short())))
    }
}

/// Folder of the cache.
pub fn folder() -> Result<PathBuf> {
    Ok(home()?.join("cache"))
}

/// Files of the cache, with sizes in bytes.
pub fn files(folder: &Path) -> Vec<(PathBuf, u64)> {
    files::in_folder(folder, EXTENSION)
}

/// Returns the cached result of `key`, else computes and stores it.
pub(super) fn remember(key: OutputKey, compute: impl FnOnce() -> Result<Vec<f32>>) -> Result<Vec<f32>> {
    // Without a home folder nothing is cached.
    let Ok(file) = key.file() else { return compute() };
    if let Some(body) = files::read_with_checksum(&file).filter(|b| b.len() % 4 == 0) {
        return Ok(bytemuck::pod_collect_to_vec(&body));
    }
    let values = compute()?;
    // A failed write costs only time.
    if files::write_with_checksum(&file, bytemuck::cast_slice(&values)).is_ok() {
        files::prune(&file, EXTENSION, CAPACITY);
    }
    Ok(values)
}

/// sha256 of a file, cached across processes by path, size and time of change: hashing gigabytes
/// takes seconds.
pub(super) fn fingerprint(path: &Path) -> std::io::Result<String> {
    let meta = std::fs::metadata(path)?;
    let age = meta.modified()?.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    let stamp = format!("{}:{}:{}", path.canonicalize()?.display(), meta.len(), age.as_nanos());
    let Ok(folder) = folder() else { return content_hash(path) };
    let note = folder.join("sums").join(&sha256(stamp.as_bytes())[..16]);
    let known = files::read_with_checksum(&note).and_then(|known| String::from_utf8(known).ok());
    if let Some(known) = known {
        return Ok(known);
    }
    let hash = content_hash(path)?;
    let _ = files::write_with_checksum(&note, hash.as_bytes());
    Ok(hash)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn remember_damaged_file_is_recomputed() {
        let key = || OutputKey::new("test").text("damaged").values(&[std::process::id()]);
        let file = key().file().unwrap();
        let count = std::cell::Cell::new(0);
        let cached = || {
            remember(key(), || {
                count.set(count.get() + 1);
                Ok(vec![1.0, 2.0])
            })
        };
        assert_eq!(cached().unwrap(), [1.0, 2.0]);
        assert_eq!(cached().unwrap(), [1.0, 2.0]);
        assert_eq!(count.get(), 1, "the second answer comes from the file");
        let mut bytes = std::fs::read(&file).unwrap();
        bytes[70] ^= 1;
        std::fs::write(&file, &bytes).unwrap();
        assert_eq!(cached().unwrap(), [1.0, 2.0]);
        assert_eq!(count.get(), 2);
        std::fs::remove_file(&file).unwrap();
        assert_ne!(
            OutputKey::new("test").text("a").text("b").file().unwrap(),
            OutputKey::new("test").text("ab").text("").file().unwrap()
        );
    }
}
