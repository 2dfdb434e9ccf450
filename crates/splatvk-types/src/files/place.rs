//! The one rule for places that a user names to be written to.
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

/// Refuses a place where writing would lose something. An ordinary file, and files in a folder that
/// is not empty, are written over with `force` only; a symbolic link, a device, a pipe and what is
/// of the other kind never are. A link further up the path is the user's way to name a folder and
/// is followed.
pub fn check_place(place: &Path, kind: Kind, force: bool) -> Result<()> {
    let bad = |what: &str| Err(Error::input(format!("{}: {what}", place.display())));
    // With a slash behind it, a link would be looked through.
    let bare: PathBuf = place.components().collect();
    let file_type = match bare.symlink_metadata() {
        Ok(meta) => meta.file_type(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        // A file where the path needs a folder, or a folder that may not be looked into.
        Err(e) => return Err(Error::unwritable(place)(e)),
    };
    match kind {
        _ if file_type.is_symlink() => {
            bad("a symbolic link, which is never written over; choose another place")
        }
        _ if !file_type.is_file() && !file_type.is_dir() => {
            bad("a device or a pipe, which is never written over; choose another place")
        }
        Kind::File if file_type.is_dir() => bad("a folder is in the way; choose another place"),
        Kind::File if !force => bad("is already there; choose another place, or --force to replace it"),
        Kind::Folder if file_type.is_file() => bad("a file is in the way; choose another place"),
        Kind::Folder if !force && !is_empty(&bare)? => bad(
            "the folder is not empty; choose another, or --force to replace files in it of the same names",
        ),
        _ => Ok(()),
    }
}

/// Leftovers of killed processes do not count: they go once the place is used.
fn is_empty(folder: &Path) -> Result<bool> {
    super::check_free_inside(folder)?;
    let mut entries = std::fs::read_dir(folder).map_err(Error::io(folder))?;
    Ok(entries.all(|e| e.is_ok_and(|e| super::is_leftover(&e.path()))))
}

/// Most names that a message lists.
const LISTED: usize = 8;

/// What is in `folder` and nobody knows, relative to it and with `/`: `own` gets such a name, and
/// whether it is a folder; what is in a folder that it does not know is not looked at. Leftovers of
/// killed processes do not count, nor what file managers write.
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

/// The names for a message: the first of them, and how many more there are.
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

/// A free place beside another one: its name with the next number, `scene-2`, `scene-3`, ….
pub fn next_free(place: &Path) -> PathBuf {
    let full = place.canonicalize().unwrap_or_else(|_| place.to_path_buf());
    let name = full.file_name().map_or_else(|| "scene".to_owned(), |n| n.to_string_lossy().into_owned());
    let numbered =
        name.rsplit_once('-').and_then(|(stem, n)| Some((stem.to_owned(), n.parse::<u32>().ok()?)));
    let (stem, first) = numbered.map_or((name, 2), |(stem, n)| (stem, n.saturating_add(1)));
    // Of "." and "scene/.." only the full path has a parent.
    let parent = if place.file_name().is_some() { place.parent() } else { full.parent() };
    let parent = parent.unwrap_or(Path::new(""));
    let free = |p: &PathBuf| p.symlink_metadata().is_err() && super::check_free(p).is_ok();
    let mut all = (first..=u32::MAX).map(|n| parent.join(format!("{stem}-{n}")));
    all.find(free).unwrap_or_else(|| place.with_extension("more"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(place: &Path, kind: Kind, force: bool) -> String {
        let error = check_place(place, kind, force).unwrap_err();
        assert_eq!((error.exit_code(), error.to_string().lines().count()), (2, 1), "{error}");
        error.to_string()
    }

    #[test]
    fn what_is_there_needs_force_and_what_is_of_another_kind_is_never_written_over() {
        let base = tempfile::tempdir().unwrap();
        let at = |name: &str| base.path().join(name);
        for (kind, force) in [Kind::File, Kind::Folder].into_iter().flat_map(|k| [(k, false), (k, true)]) {
            check_place(&at("nothing"), kind, force).unwrap();
            check_place(&at("deep/nothing"), kind, force).unwrap();
        }
        std::fs::write(at("file"), "x").unwrap();
        assert!(said(&at("file"), Kind::File, false).contains("--force"));
        check_place(&at("file"), Kind::File, true).unwrap();
        assert!(said(&at("file"), Kind::Folder, true).contains("a file is in the way"));
        assert!(said(&at("file/below"), Kind::File, true).contains("cannot be written"));
        std::fs::create_dir(at("folder")).unwrap();
        check_place(&at("folder"), Kind::Folder, false).unwrap();
        assert!(said(&at("folder"), Kind::File, true).contains("a folder is in the way"));
        std::fs::write(at("folder/letter"), "x").unwrap();
        assert!(said(&at("folder"), Kind::Folder, false).contains("not empty"));
        check_place(&at("folder"), Kind::Folder, true).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn links_and_devices_stay_as_they_are() {
        let base = tempfile::tempdir().unwrap();
        let at = |name: &str| base.path().join(name);
        std::fs::write(at("file"), "x").unwrap();
        std::fs::create_dir(at("folder")).unwrap();
        for (name, target) in [("to-file", "file"), ("to-folder", "folder"), ("to-nothing", "nothing")] {
            std::os::unix::fs::symlink(at(target), at(name)).unwrap();
        }
        for kind in [Kind::File, Kind::Folder] {
            for name in ["to-file", "to-folder", "to-folder/", "to-nothing"] {
                assert!(said(&at(name), kind, true).contains("symbolic link"), "{name}");
            }
            assert!(said(Path::new("/dev/null"), kind, true).contains("device"));
        }
        check_place(&at("to-folder/new"), Kind::File, false).unwrap();
    }

    #[test]
    fn the_next_place_gets_the_next_free_number() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in ["cup", "cup-2", "cup-7"] {
            std::fs::create_dir(at(name)).unwrap();
        }
        assert_eq!(next_free(&at("cup")), at("cup-3"));
        assert_eq!(next_free(&at("cup-2")), at("cup-3"));
        assert_eq!(next_free(&at("cup-7")), at("cup-8"));
        let _writing = super::super::Partial::beside(&at("cup-3")).unwrap();
        assert_eq!(next_free(&at("cup")), at("cup-4"), "another command is about to take the first");
    }

    #[test]
    fn foreign_entries_are_found_at_any_depth() {
        let base = tempfile::tempdir().unwrap();
        let at = |name: &str| base.path().join(name);
        std::fs::create_dir_all(at("a/b")).unwrap();
        std::fs::create_dir_all(at("c/d")).unwrap();
        for name in ["own", "a/own", "a/b/mine", "c/own", ".DS_Store"] {
            std::fs::write(at(name), "x").unwrap();
        }
        let own = |name: &str, folder: bool| name.ends_with("own") || folder && name.starts_with('a');
        assert_eq!(foreign(base.path(), &own), ["a/b/mine", "c"]);
        let names: Vec<String> = (0..10).map(|k| k.to_string()).collect();
        assert_eq!(
            (listed(&names[..2]), listed(&names)),
            ("0, 1".into(), "0, 1, 2, 3, 4, 5, 6, 7 and 2 more".into())
        );
        check_spared(&at("a"), [at("own").as_path(), &at("nothing")]).unwrap();
        let e = check_spared(&at("a"), [at("own").as_path(), &at("c/../a/own")]).unwrap_err();
        assert!(e.exit_code() == 2 && e.to_string().contains("c/../a/own: is read"), "{e}");
    }
}
