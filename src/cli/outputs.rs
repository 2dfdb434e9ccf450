//! Files of a command that writes into a folder: all of them stay, or none.
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Keeps track of what was written; dropped without [`WrittenFiles::keep`], it removes those files and the folders it made.
pub struct WrittenFiles {
    folder: PathBuf,
    files: Vec<PathBuf>,
    folders: Vec<PathBuf>,
    kept: bool,
}

impl WrittenFiles {
    /// Opens a folder for writing, creating it where needed. A place that cannot be written is bad input.
    pub fn open(folder: &Path) -> Result<WrittenFiles> {
        let mut outputs =
            WrittenFiles { folder: folder.to_path_buf(), files: vec![], folders: vec![], kept: false };
        outputs.make(folder).map_err(Error::unwritable(folder))?;
        Ok(outputs)
    }

    fn make(&mut self, folder: &Path) -> std::io::Result<()> {
        let missing = folder.ancestors().take_while(|p| !p.as_os_str().is_empty() && !p.exists());
        let missing: Vec<PathBuf> = missing.map(Path::to_path_buf).collect();
        std::fs::create_dir_all(folder)?;
        self.folders.extend(missing.into_iter().rev());
        Ok(())
    }

    /// Where to write `name`, which may have folders of its own.
    pub fn file(&mut self, name: &str) -> Result<PathBuf> {
        let path = self.folder.join(name);
        if let Some(parent) = path.parent() {
            self.make(parent).map_err(Error::unwritable(parent))?;
        }
        self.files.push(path.clone());
        Ok(path)
    }

    /// Everything is written: returns the files in order.
    pub fn keep(mut self) -> Vec<PathBuf> {
        self.kept = true;
        std::mem::take(&mut self.files)
    }
}

impl Drop for WrittenFiles {
    fn drop(&mut self) {
        if self.kept {
            return;
        }
        // The error on the way out is the one to report; a folder that others wrote into stays, as it is not empty.
        for file in &self.files {
            let _ = std::fs::remove_file(file);
        }
        for folder in self.folders.iter().rev() {
            let _ = std::fs::remove_dir(folder);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_or_nothing() {
        let base = tempfile::tempdir().unwrap();
        let out = base.path().join("a/b");
        let mut o = WrittenFiles::open(&out).unwrap();
        std::fs::write(o.file("x/y.png").unwrap(), "1").unwrap();
        drop(o);
        assert!(!base.path().join("a").exists());
        let mut o = WrittenFiles::open(&out).unwrap();
        std::fs::write(o.file("y.png").unwrap(), "1").unwrap();
        assert_eq!(o.keep(), [out.join("y.png")]);
        let mut o = WrittenFiles::open(&out).unwrap();
        std::fs::write(o.file("z.png").unwrap(), "1").unwrap();
        drop(o);
        assert!(out.join("y.png").exists() && !out.join("z.png").exists());
        assert_eq!(WrittenFiles::open(&out.join("y.png/deeper")).err().unwrap().exit_code(), 2);
    }
}
