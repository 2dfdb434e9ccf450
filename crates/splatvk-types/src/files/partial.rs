//! Unfinished output in a hidden folder that its owner has marked and locked. It is removed when
//! the work fails or the process is stopped; after a kill, by the next process that writes to the
//! place.
use super::owner::{self, Found, Held, NEW, PREVIEW};
use crate::sync::lock;
use crate::{Error, Result};
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard};

/// Unfinished outputs of this process: the hidden folder, and the folders that were created for it,
/// deepest first.
static UNFINISHED: Mutex<Vec<(PathBuf, Vec<PathBuf>)>> = Mutex::new(Vec::new());
/// Whether this process has finished any output that a user requested.
static FINISHED: AtomicBool = AtomicBool::new(false);

/// Ending of the names of hidden folders. Each place has one such name, so that only one process at
/// a time writes to it.
pub const HIDDEN: &str = ".partial-splatvk";
/// Longest name, in bytes, that is kept in the name of the hidden folder: file systems take 255.
const LONGEST_NAME: usize = 200;

fn unfinished() -> MutexGuard<'static, Vec<(PathBuf, Vec<PathBuf>)>> {
    // A panic while the lock is held leaves the list consistent.
    lock(&UNFINISHED)
}

/// A file or folder that is being written. Dropped without [`Partial::finish`], it is removed
/// together with the folders that were created for it. While it lives, no other process or thread
/// can write to its place.
#[derive(Debug)]
pub struct Partial {
    path: PathBuf,
    /// `None` once the folder is removed.
    held: Option<Held>,
}

impl Partial {
    /// Output of one file or folder, beside `place`; missing folders are created. [`Error::Input`]
    /// where another process writes to the place.
    pub fn beside(place: &Path) -> Result<Partial> {
        let mut partial = Partial::reserve(parent(place), &hidden_beside(place), place)?;
        // Keeps its own name: writers choose the format by its extension.
        std::fs::create_dir(&partial.path).map_err(Error::unwritable(place))?;
        partial.path.push(place.file_name().unwrap_or_default());
        Ok(partial)
    }

    /// Output of several files, inside `folder`, which is created where it is missing.
    pub fn inside(folder: &Path) -> Result<Partial> {
        Partial::reserve(folder, &folder.join(HIDDEN), folder)
    }

    fn reserve(parent: &Path, hidden: &Path, place: &Path) -> Result<Partial> {
        // An exit waits for the lock: between the two calls it would leave the folders.
        let mut list = unfinished();
        let made = create_missing(parent).map_err(Error::unwritable(place))?;
        match Held::take(hidden, place, false) {
            Ok(held) => {
                list.push((hidden.to_path_buf(), made));
                Ok(Partial { path: hidden.join(NEW), held: Some(held) })
            }
            Err(e) => {
                remove_empty(&made);
                Err(e)
            }
        }
    }

    /// Path to write to: nothing is there, and its folder exists.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Path for the replaced output between two moves.
    pub fn aside(&self) -> PathBuf {
        self.held.as_ref().map(Held::aside).unwrap_or_default()
    }

    /// Place for a preview of the output, beside it in the hidden folder, with which it goes.
    pub fn preview(&self) -> PathBuf {
        self.held.as_ref().map(Held::preview).unwrap_or_default()
    }

    /// Preview of the output that a living process writes to `place`, where there is one.
    pub fn preview_of_running(place: &Path) -> Option<PathBuf> {
        let hidden = hidden_beside(place);
        let preview = hidden.join(PREVIEW);
        (preview.is_dir() && !is_leftover(&hidden)).then_some(preview)
    }

    /// Moves the output to its place by `rename`, then removes the rest at [`Partial::path`] and
    /// [`Partial::aside`]. An exit waits for the move.
    pub fn finish<E>(self, rename: impl FnOnce(&Path) -> Result<(), E>) -> Result<(), E> {
        self.keep(|path| {
            rename(path)?;
            note_finished();
            Ok(())
        })
    }

    /// Like [`Partial::finish`], for an output that no user requested.
    pub fn keep<E>(mut self, rename: impl FnOnce(&Path) -> Result<(), E>) -> Result<(), E> {
        let list = unfinished();
        rename(&self.path)?;
        drop(list);
        self.take_apart();
        Ok(())
    }

    fn take_apart(&mut self) {
        let Some(held) = self.held.take() else { return };
        let hidden = held.folder().to_path_buf();
        let position_in =
            |list: &[(PathBuf, Vec<PathBuf>)]| list.iter().position(|(path, _)| *path == hidden);
        if position_in(&unfinished()).is_none() {
            // Already removed by [`remove_unfinished`].
            return;
        }
        // The first error is the one to report, and a result at its place is complete; the next
        // process sweeps the rest.
        let _ = held.clear();
        let mut list = unfinished();
        if let Some(at) = position_in(&list) {
            remove_empty(&list.swap_remove(at).1);
        }
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        self.take_apart();
    }
}

/// Folder of a place.
fn parent(place: &Path) -> &Path {
    match place.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    }
}

/// Hidden folder for an output that is written as a whole.
fn hidden_beside(place: &Path) -> PathBuf {
    let mut own = OsString::from(".");
    match place.file_name().unwrap_or_default() {
        name if name.len() <= LONGEST_NAME => own.push(name),
        name => own.push(&super::sha256(name.as_encoded_bytes())[..32]),
    }
    own.push(HIDDEN);
    parent(place).join(own)
}

/// Creates the missing folders of a path; returns them, deepest first. A `..` behind a missing
/// folder is refused.
fn create_missing(folder: &Path) -> std::io::Result<Vec<PathBuf>> {
    let missing = folder.ancestors().take_while(|p| !p.as_os_str().is_empty() && !p.exists());
    let missing: Vec<PathBuf> = missing.map(Path::to_path_buf).collect();
    if missing.iter().any(|p| p.ends_with("..")) {
        return Err(std::io::ErrorKind::NotFound.into());
    }
    std::fs::create_dir_all(folder).inspect_err(|_| remove_empty(&missing))?;
    Ok(missing)
}

/// Removes folders that are empty; one that others wrote into stays.
fn remove_empty(folders: &[PathBuf]) {
    for folder in folders {
        let _ = std::fs::remove_dir(folder);
    }
}

/// Refuses a place for a whole output if another process writes to it.
pub fn check_free(place: &Path) -> Result<()> {
    check_hidden(place, &hidden_beside(place))
}

/// Refuses a folder into which another process writes.
pub fn check_free_inside(folder: &Path) -> Result<()> {
    check_hidden(folder, &folder.join(HIDDEN))
}

fn check_hidden(place: &Path, hidden: &Path) -> Result<()> {
    match owner::look(hidden) {
        Found::Busy(owner) => Err(owner::busy(place, hidden, owner.as_ref())),
        _ => Ok(()),
    }
}

/// Restores a result that a killed process had moved aside from `place`.
pub fn restore(place: &Path) {
    if let Found::Left(held) = owner::look(&hidden_beside(place)) {
        held.put_back();
    }
}

/// Removes all unfinished outputs of this process, for exits that run no destructors.
pub fn remove_unfinished() {
    for (hidden, made) in unfinished().drain(..) {
        let _ = owner::clear(&hidden);
        remove_empty(&made);
    }
}

/// Records that this process has finished an output that a user requested.
pub fn note_finished() {
    FINISHED.store(true, Ordering::SeqCst);
}

/// Whether this process has finished no requested output.
pub fn nothing_finished() -> bool {
    !FINISHED.load(Ordering::SeqCst)
}

/// Whether a path is a hidden folder with a mark whose owner is gone.
pub fn is_leftover(path: &Path) -> bool {
    let named = path.file_name().is_some_and(|n| n.as_encoded_bytes().ends_with(HIDDEN.as_bytes()));
    named && matches!(owner::look(path), Found::Left(_) | Found::Blank(_))
}

/// Hidden folders in `folder` whose owners are gone.
pub fn leftovers(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = entries.map(|e| e.path()).filter(|p| is_leftover(p)).collect();
    found.sort();
    found
}

/// Removes one of [`leftovers`], unless a process has begun to work in it; restores a result that
/// was moved aside.
pub fn remove_leftover(path: &Path) -> std::io::Result<()> {
    owner::remove(path, owner::look(path))
}

/// Removes [`leftovers`] in a folder, and the one beside it of an output in its place.
pub fn sweep(folder: &Path) {
    for path in leftovers(folder).into_iter().chain([hidden_beside(folder)]) {
        // Another process may have swept it, or it belongs to another user.
        let _ = remove_leftover(&path);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dropped_partial_removes_created_folders() {
        let base = tempfile::tempdir().unwrap();
        let place = base.path().join("a/b/c.ply");
        let partial = Partial::beside(&place).unwrap();
        std::fs::write(partial.path(), "half").unwrap();
        drop(partial);
        assert!(!base.path().join("a").exists());
        let partial = Partial::beside(&place).unwrap();
        std::fs::write(partial.path(), "whole").unwrap();
        partial.finish(|path| std::fs::rename(path, &place)).unwrap();
        assert_eq!(std::fs::read_to_string(&place).unwrap(), "whole");
        assert_eq!(std::fs::read_dir(base.path().join("a/b")).unwrap().count(), 1);
        assert!(!nothing_finished(), "a command that is stopped from now on says that something is kept");
        let partial = Partial::beside(&base.path().join("x/y")).unwrap();
        std::fs::create_dir(partial.path()).unwrap();
        std::fs::write(base.path().join("x/letter"), "another's").unwrap();
        drop(partial);
        assert_eq!(std::fs::read_dir(base.path().join("x")).unwrap().count(), 1);
    }

    #[test]
    fn second_writer_of_place_is_refused() {
        let base = tempfile::tempdir().unwrap();
        let place = base.path().join("a.ply");
        let first = Partial::beside(&place).unwrap();
        let refusal = Partial::beside(&place).unwrap_err();
        let me = format!("process {}", std::process::id());
        assert!(refusal.exit_code() == 2 && refusal.to_string().contains(&me), "{refusal}");
        assert!(check_free(&place).is_err() && check_free(&base.path().join("b.ply")).is_ok());
        // The first writer is not affected.
        std::fs::write(first.path(), "one").unwrap();
        first.finish(|path| std::fs::rename(path, &place)).unwrap();
        drop(Partial::beside(&place).unwrap());
        let inside = Partial::inside(base.path()).unwrap();
        assert!(Partial::inside(base.path()).is_err() && check_free_inside(base.path()).is_err());
        drop(inside);
        assert_eq!(std::fs::read_dir(base.path()).unwrap().count(), 1);
    }

    #[test]
    fn dot_dot_behind_missing_folder_fails() {
        let base = tempfile::tempdir().unwrap();
        let e = Partial::beside(&base.path().join("a/../b.ply")).unwrap_err();
        assert_eq!(e.exit_code(), 2, "{e}");
        assert_eq!(std::fs::read_dir(base.path()).unwrap().count(), 0);
    }

    #[test]
    fn longest_names_are_written() {
        let base = tempfile::tempdir().unwrap();
        let place = base.path().join("n".repeat(255));
        let partial = Partial::beside(&place).unwrap();
        std::fs::write(partial.path(), "x").unwrap();
        partial.finish(|path| std::fs::rename(path, &place)).unwrap();
        assert!(place.is_file());
    }
}
