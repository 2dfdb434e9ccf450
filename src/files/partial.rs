//! What is being written, under a name that says by whom: it goes when the work fails, when the process is stopped, and, where the
//! process was killed, with the next one that comes by.
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// What this process has begun: the place, and the folders that were made for it, deepest first.
static UNFINISHED: Mutex<Vec<(PathBuf, Vec<PathBuf>)>> = Mutex::new(Vec::new());
/// Whether this process has finished anything that a user asked for.
static FINISHED: AtomicBool = AtomicBool::new(false);

/// Between the name of what is written and the number of the process.
const MARK: &str = ".partial-";

fn unfinished() -> MutexGuard<'static, Vec<(PathBuf, Vec<PathBuf>)>> {
    // A panic while holding the lock leaves a list that is still right.
    UNFINISHED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A file or folder that is being written beside its place. Dropped without [`Partial::finish`], it vanishes, and with it the
/// folders that were made for it.
#[derive(Debug)]
pub struct Partial {
    path: PathBuf,
    done: bool,
}

impl Partial {
    /// A free name beside `place`, whose folders are made where they are missing; with `hidden`, one that listings leave out.
    pub fn beside(place: &Path, hidden: bool) -> std::io::Result<Partial> {
        let name = place.file_name().unwrap_or_default();
        let parent = match place.parent() {
            Some(p) if !p.as_os_str().is_empty() => p,
            _ => Path::new("."),
        };
        let mut own = OsString::from(if hidden { "." } else { "" });
        own.push(name);
        Partial::named(parent, own, Some(name))
    }

    /// A free name inside of `folder`, which is made where it is missing.
    #[cfg(feature = "cli")]
    pub fn inside(folder: &Path) -> std::io::Result<Partial> {
        Partial::named(folder, OsString::new(), None)
    }

    fn named(parent: &Path, own: OsString, of: Option<&OsStr>) -> std::io::Result<Partial> {
        let missing = parent.ancestors().take_while(|p| !p.as_os_str().is_empty() && !p.exists());
        let made: Vec<PathBuf> = missing.map(Path::to_path_buf).collect();
        // Noted first: an exit between the two would leave the folders.
        let mut list = unfinished();
        let taken = |path: &PathBuf| list.iter().any(|(other, _)| other == path);
        let numbered = |n: usize| {
            let mut name = own.clone();
            name.push(format!("{MARK}{}", std::process::id()));
            // Other threads may write to the same place.
            name.push(if n == 0 { String::new() } else { format!(".{n}") });
            parent.join(name)
        };
        let path = (0..).map(numbered).find(|p| !taken(p)).unwrap_or_default();
        list.push((path.clone(), made));
        drop(list);
        let partial = Partial { path, done: false };
        std::fs::create_dir_all(parent)?;
        sweep(parent, of);
        // Of an earlier process of the same number, or a link that waits to be written through.
        let _ = remove_any(&partial.path);
        Ok(partial)
    }

    /// Where to write.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Moves what was written to its place, by `rename`. An exit waits for it.
    pub fn finish<E>(mut self, rename: impl FnOnce(&Path) -> Result<(), E>) -> Result<(), E> {
        let mut list = unfinished();
        rename(&self.path)?;
        list.retain(|(path, _)| *path != self.path);
        self.done = true;
        FINISHED.store(true, Ordering::SeqCst);
        Ok(())
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        if self.done {
            return;
        }
        let mut list = unfinished();
        if let Some(at) = list.iter().position(|(path, _)| *path == self.path) {
            remove(&list.swap_remove(at));
        }
    }
}

/// The error on the way out is the one to report; a folder that others wrote into stays, as it is not empty.
fn remove((path, made): &(PathBuf, Vec<PathBuf>)) {
    let _ = remove_any(path);
    for folder in made {
        let _ = std::fs::remove_dir(folder);
    }
}

/// Removes a file or a folder with all that is in it.
pub fn remove_any(path: &Path) -> std::io::Result<()> {
    match path.symlink_metadata()?.is_dir() {
        true => std::fs::remove_dir_all(path),
        false => std::fs::remove_file(path),
    }
}

/// Removes everything unfinished of this process, for exits that run no destructors; whether nothing that a user asked for had been
/// finished before.
#[cfg(feature = "cli")]
pub fn remove_unfinished() -> bool {
    unfinished().drain(..).for_each(|entry| remove(&entry));
    nothing_finished()
}

/// Whether this process has finished nothing that a user asked for.
#[cfg(feature = "cli")]
fn nothing_finished() -> bool {
    !FINISHED.load(Ordering::SeqCst)
}

/// What processes that are gone have left in a folder: all of it, or that of one name.
pub fn leftovers(folder: &Path, of: Option<&OsStr>) -> Vec<PathBuf> {
    let of = of.map(|n| n.to_string_lossy().into_owned());
    let ours = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let Some((stem, process)) = name.rsplit_once(MARK) else { return false };
        let stem = stem.strip_prefix('.').unwrap_or(stem);
        let process = process.split_once('.').map_or(process, |(process, _)| process);
        of.as_deref().is_none_or(|of| stem == of) && process.parse().is_ok_and(is_gone)
    };
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut found: Vec<PathBuf> = entries.map(|e| e.path()).filter(ours).collect();
    found.sort();
    found
}

/// Removes [`leftovers`].
pub fn sweep(folder: &Path, of: Option<&OsStr>) {
    for path in leftovers(folder, of) {
        // Another process may have swept it, or it is another user's.
        let _ = remove_any(&path);
    }
}

/// Without /proc nobody can tell whether another process still lives: it may.
pub(super) fn is_gone(process: u32) -> bool {
    Path::new("/proc/self").exists() && !Path::new(&format!("/proc/{process}")).exists()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_finished_goes_with_the_folders_made_for_it() {
        let base = tempfile::tempdir().unwrap();
        let place = base.path().join("a/b/c.ply");
        let partial = Partial::beside(&place, false).unwrap();
        std::fs::write(partial.path(), "half").unwrap();
        drop(partial);
        assert!(!base.path().join("a").exists());
        let partial = Partial::beside(&place, false).unwrap();
        std::fs::write(partial.path(), "whole").unwrap();
        partial.finish(|path| std::fs::rename(path, &place)).unwrap();
        assert_eq!(std::fs::read_to_string(&place).unwrap(), "whole");
        #[cfg(feature = "cli")]
        assert!(!nothing_finished(), "a command that is stopped from now on says that something is kept");
        let partial = Partial::beside(&base.path().join("x/y"), true).unwrap();
        std::fs::create_dir(partial.path()).unwrap();
        std::fs::write(base.path().join("x/letter"), "another's").unwrap();
        drop(partial);
        assert_eq!(std::fs::read_dir(base.path().join("x")).unwrap().count(), 1);
    }

    #[test]
    fn threads_that_write_to_one_place_do_not_share_what_is_unfinished() {
        let base = tempfile::tempdir().unwrap();
        let place = base.path().join("a.ply");
        let two = [0; 2].map(|_| Partial::beside(&place, false).unwrap());
        assert_ne!(two[0].path(), two[1].path());
        for (partial, text) in two.into_iter().zip(["one", "two"]) {
            std::fs::write(partial.path(), text).unwrap();
            partial.finish(|path| std::fs::rename(path, &place)).unwrap();
            assert_eq!(std::fs::read_to_string(&place).unwrap(), text);
        }
        std::fs::write(base.path().join("a.ply.partial-4000000000.3"), "half").unwrap();
        sweep(base.path(), Some("a.ply".as_ref()));
        assert_eq!(std::fs::read_dir(base.path()).unwrap().count(), 1);
    }

    #[test]
    fn leftovers_of_processes_that_are_gone_are_swept_and_those_of_living_ones_stay() {
        let base = tempfile::tempdir().unwrap();
        let at = |name: &str| base.path().join(name);
        let own = format!("a.ply.partial-{}", std::process::id());
        for name in ["a.ply.partial-4000000000", "b.ply.partial-4000000000", &own, "a.partial-x", "a.ply"] {
            std::fs::write(at(name), "x").unwrap();
        }
        std::fs::create_dir(at(".a.ply.partial-4000000001")).unwrap();
        sweep(base.path(), Some("a.ply".as_ref()));
        assert!(!at("a.ply.partial-4000000000").exists() && !at(".a.ply.partial-4000000001").exists());
        assert_eq!(leftovers(base.path(), None), [at("b.ply.partial-4000000000")]);
        assert!(at(&own).exists() && at("a.partial-x").exists() && at("a.ply").exists());
    }
}
