//! Output files of commands: placed by the rule of [`check_place`], complete or not at all.
use crate::files::{self, Kind, Partial, check_place, check_spared};
use crate::format::scene_files;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// An output file, written whole or not at all. While it is reserved, no other command writes
/// there.
pub struct WrittenFile {
    place: PathBuf,
    force: bool,
    partial: Partial,
}

impl WrittenFile {
    /// Reserves the place before any work.
    ///
    /// # Errors
    /// Bad input for a place that may not be written or is one of the `inputs`.
    pub fn open(place: &Path, force: bool, inputs: &[&Path]) -> Result<WrittenFile> {
        check_file(place, force, inputs)?;
        Ok(WrittenFile { place: place.to_path_buf(), force, partial: Partial::beside(place)? })
    }

    /// Writes the file.
    pub fn keep(self, write: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
        let WrittenFile { place, force, partial } = self;
        write(partial.path())?;
        // A file that appeared meanwhile is not overwritten.
        check_place(&place, Kind::File, force)?;
        partial.finish(|path| std::fs::rename(path, &place).map_err(Error::unwritable(&place)))
    }
}

/// Refuses a file that may not be written.
pub fn check_file(place: &Path, force: bool, inputs: &[&Path]) -> Result<()> {
    if place.file_name().is_none() {
        return Err(Error::input(format!("{}: not a file name; choose one", place.display())));
    }
    check_place(place, Kind::File, force)?;
    check_spared(place, inputs.iter().copied())
}

/// Output files of a command in a folder. They are written into a hidden folder, beside a new
/// folder or inside an existing one; dropped without [`WrittenFiles::keep`], it is removed with its
/// content.
pub struct WrittenFiles {
    folder: PathBuf,
    force: bool,
    partial: Partial,
    /// Inputs of the command, canonical paths.
    inputs: Vec<PathBuf>,
    names: Vec<PathBuf>,
    /// Existing files that are removed after the new ones are in place.
    outdated: Vec<PathBuf>,
}

impl WrittenFiles {
    /// Reserves a folder, creating it where needed; with `force` it may contain files, but no
    /// `inputs` are replaced.
    ///
    /// # Errors
    /// Bad input for a place that cannot be written, or that another command writes to.
    pub fn open(folder: &Path, force: bool, inputs: &[&Path]) -> Result<WrittenFiles> {
        check_place(folder, Kind::Folder, force)?;
        let partial = if folder.exists() {
            // Another command may be replacing the folder as a whole.
            files::check_free(folder)?;
            Partial::inside(folder)?
        } else {
            Partial::beside(folder)?
        };
        std::fs::create_dir(partial.path()).map_err(Error::unwritable(folder))?;
        let inputs = inputs.iter().filter_map(|input| input.canonicalize().ok()).collect();
        let (names, outdated) = (Vec::new(), Vec::new());
        Ok(WrittenFiles { folder: folder.to_path_buf(), force, partial, inputs, names, outdated })
    }

    /// Marks files for removal that hold the same data in another form and would contradict the new
    /// ones.
    pub fn outdate<'a>(&mut self, names: impl Iterator<Item = &'a str>) {
        self.outdated.extend(names.map(PathBuf::from));
    }

    /// The hidden folder, for writers of several files: [`WrittenFiles::keep`] finds them.
    pub fn folder(&self) -> &Path {
        self.partial.path()
    }

    /// Path to write `name` to, which may contain folders.
    pub fn file(&mut self, name: &str) -> Result<PathBuf> {
        let path = self.partial.path().join(name);
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent).map_err(Error::unwritable(parent))?;
        }
        self.names.push(name.into());
        Ok(path)
    }

    /// Moves the written files to their places, over ordinary files of their names only, and
    /// returns their paths: those of [`WrittenFiles::file`] first, in their order.
    pub fn keep(self) -> Result<Vec<PathBuf>> {
        let WrittenFiles { folder, force, partial, inputs, mut names, outdated } = self;
        let mut found = Vec::new();
        collect_files(partial.path(), Path::new(""), &mut found)?;
        found.retain(|name| !names.contains(name));
        found.sort();
        names.extend(found);
        // All refusals come before the first move. Files that appeared meanwhile are not
        // overwritten.
        check_ours(&folder, force)?;
        for name in &names {
            for part in name.ancestors().skip(1).filter(|p| !p.as_os_str().is_empty()) {
                check_place(&folder.join(part), Kind::Folder, true)?;
            }
            check_place(&folder.join(name), Kind::File, true)?;
            check_unread(&folder, &folder.join(name), &inputs)?;
        }
        let outdated: Vec<PathBuf> =
            outdated.iter().map(|name| folder.join(name)).filter(|p| p.symlink_metadata().is_ok()).collect();
        outdated.iter().try_for_each(|place| check_place(place, Kind::File, true))?;
        let places: Vec<PathBuf> = names.iter().map(|name| folder.join(name)).collect();
        partial.finish(|from| {
            // One rename, so that a killed process leaves all or nothing.
            if !folder.exists() {
                return std::fs::rename(from, &folder).map_err(Error::unwritable(&folder));
            }
            for (name, place) in names.iter().zip(&places) {
                let parent = place.parent().unwrap_or(&folder);
                std::fs::create_dir_all(parent).map_err(Error::unwritable(parent))?;
                std::fs::rename(from.join(name), place).map_err(Error::unwritable(place))?;
            }
            outdated.iter().try_for_each(|p| std::fs::remove_file(p).map_err(Error::unwritable(p)))
        })?;
        files::sweep(&folder);
        Ok(places)
    }
}

/// Refuses, without `force`, a folder with other files than the hidden ones of this program.
fn check_ours(folder: &Path, force: bool) -> Result<()> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let is_hidden = |p: &PathBuf| p.as_os_str().as_encoded_bytes().ends_with(files::HIDDEN.as_bytes());
    match entries.filter(|p| !is_hidden(p)).min() {
        Some(other) if !force => Err(Error::input(format!(
            "{}: came there while this command worked; choose another folder, or --force to replace files of the same names",
            other.display()
        ))),
        _ => Ok(()),
    }
}

/// Refuses to replace an input: a given file, a file of a given scene, or a file of a given folder
/// that the command writes into.
fn check_unread(folder: &Path, place: &Path, inputs: &[PathBuf]) -> Result<()> {
    let (Ok(whole), Ok(folder)) = (place.canonicalize(), folder.canonicalize()) else { return Ok(()) };
    let reads = |input: &PathBuf| *input == whole || *input == folder || scene_files::is_own(input, &whole);
    match inputs.iter().any(reads) {
        true => Err(Error::input(format!(
            "{}: is there already, among what this command reads, and stays; choose another --out",
            place.display()
        ))),
        false => Ok(()),
    }
}

/// Collects the files below `below`, relative to `root`.
fn collect_files(root: &Path, below: &Path, found: &mut Vec<PathBuf>) -> Result<()> {
    let folder = root.join(below);
    for entry in std::fs::read_dir(&folder).map_err(Error::io(&folder))? {
        let entry = entry.map_err(Error::io(&folder))?;
        let name = below.join(entry.file_name());
        match entry.path().is_dir() {
            true => collect_files(root, &name, found)?,
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
    fn written_files_are_all_or_nothing() {
        let base = tempfile::tempdir().unwrap();
        let out = base.path().join("a/b");
        let mut o = WrittenFiles::open(&out, false, &[]).unwrap();
        std::fs::write(o.file("x/y.png").unwrap(), "1").unwrap();
        drop(o);
        assert!(!base.path().join("a").exists());
        let mut o = WrittenFiles::open(&out, false, &[]).unwrap();
        std::fs::write(o.file("y.png").unwrap(), "1").unwrap();
        std::fs::write(o.folder().join("found.png"), "1").unwrap();
        assert!(!out.join("y.png").exists(), "not before all is written");
        assert_eq!(o.keep().unwrap(), [out.join("y.png"), out.join("found.png")]);
        assert!(refused(WrittenFiles::open(&out, false, &[])).contains("--force"));
        let mut o = WrittenFiles::open(&out, true, &[]).unwrap();
        std::fs::write(o.file("y.png").unwrap(), "2").unwrap();
        std::fs::write(o.file("z.png").unwrap(), "2").unwrap();
        drop(o);
        assert_eq!(std::fs::read_to_string(out.join("y.png")).unwrap(), "1");
        assert_eq!(std::fs::read_dir(&out).unwrap().count(), 2);
        refused(WrittenFiles::open(&out.join("y.png/deeper"), true, &[]));
    }

    #[cfg(unix)]
    #[test]
    fn written_files_do_not_follow_links() {
        let base = tempfile::tempdir().unwrap();
        let (out, precious) = (base.path().join("out"), base.path().join("precious"));
        std::fs::create_dir_all(&out).unwrap();
        std::fs::create_dir(&precious).unwrap();
        std::fs::write(precious.join("a.png"), "precious").unwrap();
        std::os::unix::fs::symlink(&precious, out.join("lemon")).unwrap();
        std::os::unix::fs::symlink(precious.join("a.png"), out.join("a.png")).unwrap();
        for name in ["lemon/a.png", "a.png"] {
            let mut o = WrittenFiles::open(&out, true, &[]).unwrap();
            std::fs::write(o.file("first.png").unwrap(), "1").unwrap();
            std::fs::write(o.file(name).unwrap(), "1").unwrap();
            assert!(refused(o.keep()).contains("symbolic link"), "{name}");
            assert!(!out.join("first.png").exists(), "nothing is moved where one cannot be");
        }
        assert_eq!(std::fs::read_to_string(precious.join("a.png")).unwrap(), "precious");
        assert_eq!(std::fs::read_dir(&out).unwrap().count(), 2);
    }

    #[test]
    fn outputs_refuse_second_writer_and_inputs() {
        let base = tempfile::tempdir().unwrap();
        let path = |name: &str| base.path().join(name);
        for out in [path("new"), base.path().to_path_buf()] {
            let first = WrittenFiles::open(&out, true, &[]).unwrap();
            assert!(
                refused(WrittenFiles::open(&out, true, &[])).contains("another splatvk is writing there")
            );
            drop(first);
        }
        // Another program creates the folder meanwhile.
        let mut o = WrittenFiles::open(&path("new"), false, &[]).unwrap();
        std::fs::write(o.file("a.png").unwrap(), "1").unwrap();
        std::fs::create_dir(path("new")).unwrap();
        std::fs::write(path("new/a.png"), "precious").unwrap();
        assert!(refused(o.keep()).contains("while this command worked"));
        for input in [path("new"), path("new/a.png")] {
            let mut o = WrittenFiles::open(&path("new"), true, &[&input]).unwrap();
            std::fs::write(o.file("a.png").unwrap(), "1").unwrap();
            assert!(refused(o.keep()).contains("what this command reads"));
        }
        assert_eq!(std::fs::read_to_string(path("new/a.png")).unwrap(), "precious");
        assert!(
            refused(WrittenFile::open(&path("new/a.png"), true, &[&path("new/a.png")])).contains("is read")
        );
        let first = WrittenFile::open(&path("new/a.png"), true, &[]).unwrap();
        assert!(refused(WrittenFile::open(&path("new/a.png"), true, &[])).contains("another splatvk"));
        first.keep(|file| std::fs::write(file, "2").map_err(Error::io(file))).unwrap();
        assert_eq!(std::fs::read_to_string(path("new/a.png")).unwrap(), "2");
        assert_eq!(std::fs::read_dir(path("new")).unwrap().count(), 1);
    }
}
