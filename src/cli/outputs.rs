//! What a command writes where the user says: by the rule of [`check_place`], and all of it or none.
use crate::files::{Kind, Partial, check_place};
use crate::format::write_whole_file;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Refuses a file that may not be written, before any work.
pub fn check_file(file: &Path, force: bool) -> Result<()> {
    if file.file_name().is_none() {
        return Err(Error::input(format!("{}: not a file name; choose one", file.display())));
    }
    check_place(file, Kind::File, force)?;
    // Only writing tells whether a folder takes files; what is made for it goes again.
    let partial = Partial::beside(file, false).map_err(Error::unwritable(file))?;
    std::fs::File::create(partial.path()).map(drop).map_err(Error::unwritable(file))
}

/// Writes a file that appears whole or not at all.
pub fn write_file(file: &Path, force: bool, write: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
    write_whole_file(file, |partial| {
        write(partial)?;
        // What came there while it was written is not ours.
        check_place(file, Kind::File, force)
    })
}

/// Files of a command that writes into a folder. They are written into a hidden folder, beside one that is to be made, else in it;
/// dropped without [`WrittenFiles::keep`], it vanishes with all that is in it.
pub struct WrittenFiles {
    folder: PathBuf,
    partial: Partial,
    names: Vec<PathBuf>,
    /// Files of the folder that go once those are there.
    outdated: Vec<PathBuf>,
}

impl WrittenFiles {
    /// Opens a folder for writing, creating it where needed; with `force` it may have files already. A place that cannot be
    /// written is bad input.
    pub fn open(folder: &Path, force: bool) -> Result<WrittenFiles> {
        check_place(folder, Kind::Folder, force)?;
        let partial = if folder.exists() { Partial::inside(folder) } else { Partial::beside(folder, true) };
        let partial = partial.map_err(Error::unwritable(folder))?;
        std::fs::create_dir(partial.path()).map_err(Error::unwritable(folder))?;
        Ok(WrittenFiles { folder: folder.to_path_buf(), partial, names: Vec::new(), outdated: Vec::new() })
    }

    /// Files of these names say the same in another form: what the folder has of them would contradict what is written.
    pub fn outdate<'a>(&mut self, names: impl Iterator<Item = &'a str>) {
        self.outdated.extend(names.map(PathBuf::from));
    }

    /// The hidden folder, for what writes several files itself: [`WrittenFiles::keep`] finds them.
    pub fn folder(&self) -> &Path {
        self.partial.path()
    }

    /// Where to write `name`, which may have folders of its own.
    pub fn file(&mut self, name: &str) -> Result<PathBuf> {
        let path = self.partial.path().join(name);
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).map_err(Error::unwritable(parent))?;
        }
        self.names.push(name.into());
        Ok(path)
    }

    /// Everything is written: moves the files to their places, over ordinary files of their names only, and returns them; those of
    /// [`WrittenFiles::file`] first, in their order.
    pub fn keep(self) -> Result<Vec<PathBuf>> {
        let WrittenFiles { folder, partial, mut names, outdated } = self;
        let mut found = Vec::new();
        list(partial.path(), Path::new(""), &mut found)?;
        found.retain(|name| !names.contains(name));
        found.sort();
        names.extend(found);
        // Everything that may be refused comes before the first file is moved.
        for name in &names {
            for part in name.ancestors().skip(1).filter(|p| !p.as_os_str().is_empty()) {
                check_place(&folder.join(part), Kind::Folder, true)?;
            }
            check_place(&folder.join(name), Kind::File, true)?;
        }
        let outdated: Vec<PathBuf> =
            outdated.iter().map(|name| folder.join(name)).filter(|p| p.symlink_metadata().is_ok()).collect();
        outdated.iter().try_for_each(|place| check_place(place, Kind::File, true))?;
        let places: Vec<PathBuf> = names.iter().map(|name| folder.join(name)).collect();
        partial.finish(|from| {
            // In one step, so that a process that is killed here leaves all or nothing.
            if !folder.exists() {
                return std::fs::rename(from, &folder).map_err(Error::unwritable(&folder));
            }
            for (name, place) in names.iter().zip(&places) {
                let parent = place.parent().unwrap_or(&folder);
                std::fs::create_dir_all(parent).map_err(Error::unwritable(parent))?;
                std::fs::rename(from.join(name), place).map_err(Error::unwritable(place))?;
            }
            outdated.iter().try_for_each(|p| std::fs::remove_file(p).map_err(Error::unwritable(p)))?;
            std::fs::remove_dir_all(from).map_err(Error::io(from))
        })?;
        Ok(places)
    }
}

/// The files below a folder of `root`, relative to `root`.
fn list(root: &Path, below: &Path, found: &mut Vec<PathBuf>) -> Result<()> {
    let folder = root.join(below);
    for entry in std::fs::read_dir(&folder).map_err(Error::io(&folder))? {
        let entry = entry.map_err(Error::io(&folder))?;
        let name = below.join(entry.file_name());
        match entry.path().is_dir() {
            true => list(root, &name, found)?,
            false => found.push(name),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused<T>(outcome: Result<T>) -> String {
        let error = outcome.err().unwrap();
        assert_eq!(error.exit_code(), 2, "{error}");
        error.to_string()
    }

    #[test]
    fn all_or_nothing() {
        let base = tempfile::tempdir().unwrap();
        let out = base.path().join("a/b");
        let mut o = WrittenFiles::open(&out, false).unwrap();
        std::fs::write(o.file("x/y.png").unwrap(), "1").unwrap();
        drop(o);
        assert!(!base.path().join("a").exists());
        let mut o = WrittenFiles::open(&out, false).unwrap();
        std::fs::write(o.file("y.png").unwrap(), "1").unwrap();
        std::fs::write(o.folder().join("found.png"), "1").unwrap();
        assert!(!out.join("y.png").exists(), "not before all is written");
        assert_eq!(o.keep().unwrap(), [out.join("y.png"), out.join("found.png")]);
        assert!(refused(WrittenFiles::open(&out, false)).contains("--force"));
        let mut o = WrittenFiles::open(&out, true).unwrap();
        std::fs::write(o.file("y.png").unwrap(), "2").unwrap();
        std::fs::write(o.file("z.png").unwrap(), "2").unwrap();
        drop(o);
        assert_eq!(std::fs::read_to_string(out.join("y.png")).unwrap(), "1");
        assert_eq!(std::fs::read_dir(&out).unwrap().count(), 2);
        refused(WrittenFiles::open(&out.join("y.png/deeper"), true));
    }

    #[cfg(unix)]
    #[test]
    fn links_in_the_folder_are_not_followed() {
        let base = tempfile::tempdir().unwrap();
        let (out, precious) = (base.path().join("out"), base.path().join("precious"));
        std::fs::create_dir_all(&out).unwrap();
        std::fs::create_dir(&precious).unwrap();
        std::fs::write(precious.join("a.png"), "precious").unwrap();
        std::os::unix::fs::symlink(&precious, out.join("lemon")).unwrap();
        std::os::unix::fs::symlink(precious.join("a.png"), out.join("a.png")).unwrap();
        for name in ["lemon/a.png", "a.png"] {
            let mut o = WrittenFiles::open(&out, true).unwrap();
            std::fs::write(o.file("first.png").unwrap(), "1").unwrap();
            std::fs::write(o.file(name).unwrap(), "1").unwrap();
            assert!(refused(o.keep()).contains("symbolic link"), "{name}");
            assert!(!out.join("first.png").exists(), "nothing is moved where one cannot be");
        }
        assert_eq!(std::fs::read_to_string(precious.join("a.png")).unwrap(), "precious");
        assert_eq!(std::fs::read_dir(&out).unwrap().count(), 2);
    }
}
