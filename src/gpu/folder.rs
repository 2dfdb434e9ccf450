//! The cache of a device in a folder: one file per name, with a checksum.
use crate::files;
use splatvk_gpu::Cache;
use std::io;
use std::path::{Path, PathBuf};

/// Most bytes of all compiled pipelines together; the least recently used ones are removed.
const CAPACITY: u64 = 256 << 20;
const PIPELINES: &str = "pipelines";

/// A folder that keeps compiled pipelines and the names of disabled kernel variants.
#[derive(Clone, Debug)]
pub(crate) struct FolderCache(PathBuf);

impl FolderCache {
    /// `cache` in the program's own folder; `None` where the program has none.
    pub fn own() -> Option<FolderCache> {
        files::home().ok().map(|home| FolderCache(home.join("cache")))
    }

    /// Path of the folder.
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Cache for FolderCache {
    fn read(&self, name: &str) -> Option<Vec<u8>> {
        files::read_with_checksum(&self.0.join(name))
    }

    fn write(&self, name: &str, data: &[u8]) -> io::Result<()> {
        let path = self.0.join(name);
        files::write_with_checksum(&path, data)?;
        files::prune(&path, PIPELINES, CAPACITY);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damaged_entries_are_absent() {
        let folder = tempfile::tempdir().unwrap();
        let cache = FolderCache(folder.path().join("cache"));
        assert_eq!(cache.read("a.pipelines"), None);
        cache.write("a.pipelines", b"compiled").unwrap();
        assert_eq!(cache.read("a.pipelines").as_deref(), Some(&b"compiled"[..]));
        std::fs::write(cache.path().join("a.pipelines"), b"compiled").unwrap();
        assert_eq!(cache.read("a.pipelines"), None, "without its checksum");
    }
}
