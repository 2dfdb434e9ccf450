//! The one rule for output places that a user names.
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// Kind of the output at a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One file.
    File,
    /// A folder of files.
    Folder,
}

/// Refuses a place where writing would lose something. A regular file, and files in a folder that
/// is not empty, are overwritten with `force` only; a symbolic link, a device, a pipe and an entry
/// of the other kind never are. Links further up the path are followed.
pub fn check_place(place: &Path, kind: Kind, force: bool) -> Result<()> {
    let refuse = |what: &str| Err(Error::input(format!("{}: {what}", place.display())));
    // With a trailing slash a link would be followed.
    let bare: PathBuf = place.components().collect();
    let file_type = match bare.symlink_metadata() {
        Ok(meta) => meta.file_type(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        // A file where the path needs a folder, or a folder without access.
        Err(e) => return Err(Error::unwritable(place)(e)),
    };
    match kind {
        _ if file_type.is_symlink() => {
            refuse("a symbolic link, which is never written over; choose another place")
        }
        _ if !file_type.is_file() && !file_type.is_dir() => {
            refuse("a device or a pipe, which is never written over; choose another place")
        }
        Kind::File if file_type.is_dir() => refuse("a folder is in the way; choose another place"),
        Kind::File if !force => refuse("is already there; choose another place, or --force to replace it"),
        Kind::Folder if file_type.is_file() => refuse("a file is in the way; choose another place"),
        Kind::Folder if !force && !is_empty(&bare)? => refuse(
            "the folder is not empty; choose another, or --force to replace files in it of the same names",
        ),
        _ => Ok(()),
    }
}

/// Whether a folder is empty; leftovers of killed processes do not count, as the next writer
/// removes them.
fn is_empty(folder: &Path) -> Result<bool> {
    super::check_free_inside(folder)?;
    let mut entries = std::fs::read_dir(folder).map_err(Error::io(folder))?;
    Ok(entries.all(|e| e.is_ok_and(|e| super::is_leftover(&e.path()))))
}

/// Largest number of names that a message lists.
const LISTED: usize = 8;

/// Entries of `folder` that are not the program's, relative to it and with `/`. `own(name,
/// is_folder)` accepts an entry; foreign folders are not entered. Leftovers of killed processes and
/// files of file managers do not count.
pub fn foreign(folder: &Path, own: &dyn Fn(&str, bool) -> bool) -> Vec<String> {
    const OF_FILE_MANAGERS: [&str; 3] = [".DS_Store", "Thumbs.db", "desktop.ini"];
    let (mut found, mut open) = (Vec::new(), vec![String::new()]);
    while let Some(below) = open.pop() {
        let Ok(entries) = std::fs::read_dir(folder.join(&below)) else {
            found.push(below);
            continue;
        };
        for entry in entries.flatten() {
            let (plain, kind) = (entry.file_name().to_string_lossy().into_owned(), entry.file_type());
            let name = if below.is_empty() { plain.clone() } else { format!("{below}/{plain}") };
            let is_folder = kind.as_ref().is_ok_and(|k| k.is_dir());
            let is_link = kind.is_ok_and(|k| k.is_symlink());
            if OF_FILE_MANAGERS.contains(&plain.as_str()) && !is_folder || super::is_leftover(&entry.path()) {
                continue;
            }
            match !is_link && own(&name, is_folder) {
                true if is_folder => open.push(name),
                true => {}
                false => found.push(name),
            }
        }
    }
    found.sort();
    found
}

/// Names for a message: the first ones, and the number of the others.
pub fn listed(names: &[impl AsRef<str>]) -> String {
    let more = names.len().saturating_sub(LISTED);
    let first = names.iter().take(LISTED).map(AsRef::as_ref).collect::<Vec<_>>().join(", ");
    if more == 0 { first } else { format!("{first} and {more} more") }
}

/// Refuses inputs that would be replaced.
pub fn check_spared<'a>(place: &Path, inputs: impl IntoIterator<Item = &'a Path>) -> Result<()> {
    let Ok(whole) = place.canonicalize() else { return Ok(()) };
    let lies_there = |input: &&Path| input.canonicalize().is_ok_and(|input| input.starts_with(&whole));
    match inputs.into_iter().find(lies_there) {
        Some(input) => Err(Error::input(format!(
            "{}: is read, and lies in what would be replaced ({}); choose another --out",
            input.display(),
            place.display()
        ))),
        None => Ok(()),
    }
}

/// Free place beside another one: its name with the next number, `scene-2`, `scene-3`, ….
pub fn next_free(place: &Path) -> PathBuf {
    let full = place.canonicalize().unwrap_or_else(|_| place.to_path_buf());
    let name = full.file_name().map_or_else(|| "scene".to_owned(), |n| n.to_string_lossy().into_owned());
    let numbered =
        name.rsplit_once('-').and_then(|(stem, n)| Some((stem.to_owned(), n.parse::<u32>().ok()?)));
    let (stem, first) = numbered.map_or((name, 2), |(stem, n)| (stem, n.saturating_add(1)));
    // For "." and "scene/.." only the full path has a parent.
    let parent = if place.file_name().is_some() { place.parent() } else { full.parent() };
    let parent = parent.unwrap_or(Path::new(""));
    let free = |p: &PathBuf| p.symlink_metadata().is_err() && super::check_free(p).is_ok();
    let mut all = (first..=u32::MAX).map(|n| parent.join(format!("{stem}-{n}")));
    all.find(free).unwrap_or_else(|| place.with_extension("more"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(place: &Path, kind: Kind, force: bool) -> String {
        let error = check_place(place, kind, force).unwrap_err();
        assert_eq!((error.exit_code(), error.to_string().lines().count()), (2, 1), "{error}");
        error.to_string()
    }

    #[test]
    fn overwriting_needs_force_and_same_kind() {
        let base = tempfile::tempdir().unwrap();
        let path_of = |name: &str| base.path().join(name);
        for (kind, force) in [Kind::File, Kind::Folder].into_iter().flat_map(|k| [(k, false), (k, true)]) {
            check_place(&path_of("nothing"), kind, force).unwrap();
            check_place(&path_of("deep/nothing"), kind, force).unwrap();
        }
        std::fs::write(path_of("file"), "x").unwrap();
        assert!(refusal(&path_of("file"), Kind::File, false).contains("--force"));
        check_place(&path_of("file"), Kind::File, true).unwrap();
        assert!(refusal(&path_of("file"), Kind::Folder, true).contains("a file is in the way"));
        assert!(refusal(&path_of("file/below"), Kind::File, true).contains("cannot be written"));
        std::fs::create_dir(path_of("folder")).unwrap();
        check_place(&path_of("folder"), Kind::Folder, false).unwrap();
        assert!(refusal(&path_of("folder"), Kind::File, true).contains("a folder is in the way"));
        std::fs::write(path_of("folder/letter"), "x").unwrap();
        assert!(refusal(&path_of("folder"), Kind::Folder, false).contains("not empty"));
        check_place(&path_of("folder"), Kind::Folder, true).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn links_and_devices_are_never_overwritten() {
        let base = tempfile::tempdir().unwrap();
        let path_of = |name: &str| base.path().join(name);
        std::fs::write(path_of("file"), "x").unwrap();
        std::fs::create_dir(path_of("folder")).unwrap();
        for (name, target) in [("to-file", "file"), ("to-folder", "folder"), ("to-nothing", "nothing")] {
            std::os::unix::fs::symlink(path_of(target), path_of(name)).unwrap();
        }
        for kind in [Kind::File, Kind::Folder] {
            for name in ["to-file", "to-folder", "to-folder/", "to-nothing"] {
                assert!(refusal(&path_of(name), kind, true).contains("symbolic link"), "{name}");
            }
            assert!(refusal(Path::new("/dev/null"), kind, true).contains("device"));
        }
        check_place(&path_of("to-folder/new"), Kind::File, false).unwrap();
    }

    #[test]
    fn next_free_place_counts_up() {
        let folder = tempfile::tempdir().unwrap();
        let path_of = |name: &str| folder.path().join(name);
        for name in ["cup", "cup-2", "cup-7"] {
            std::fs::create_dir(path_of(name)).unwrap();
        }
        assert_eq!(next_free(&path_of("cup")), path_of("cup-3"));
        assert_eq!(next_free(&path_of("cup-2")), path_of("cup-3"));
        assert_eq!(next_free(&path_of("cup-7")), path_of("cup-8"));
        let _writing = super::super::Partial::beside(&path_of("cup-3")).unwrap();
        assert_eq!(
            next_free(&path_of("cup")),
            path_of("cup-4"),
            "another command is about to take the first"
        );
    }

    #[test]
    fn foreign_lists_entries_at_any_depth() {
        let base = tempfile::tempdir().unwrap();
        let path_of = |name: &str| base.path().join(name);
        std::fs::create_dir_all(path_of("a/b")).unwrap();
        std::fs::create_dir_all(path_of("c/d")).unwrap();
        for name in ["own", "a/own", "a/b/mine", "c/own", ".DS_Store"] {
            std::fs::write(path_of(name), "x").unwrap();
        }
        let own = |name: &str, folder: bool| name.ends_with("own") || folder && name.starts_with('a');
        assert_eq!(foreign(base.path(), &own), ["a/b/mine", "c"]);
        let names: Vec<String> = (0..10).map(|k| k.to_string()).collect();
        assert_eq!(
            (listed(&names[..2]), listed(&names)),
            ("0, 1".into(), "0, 1, 2, 3, 4, 5, 6, 7 and 2 more".into())
        );
        check_spared(&path_of("a"), [path_of("own").as_path(), &path_of("nothing")]).unwrap();
        let e = check_spared(&path_of("a"), [path_of("own").as_path(), &path_of("c/../a/own")]).unwrap_err();
        assert!(e.exit_code() == 2 && e.to_string().contains("c/../a/own: is read"), "{e}");
    }
}
