//! The one rule for places that a user names to be written to.
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// What is to be written at a place.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One file. Only commands are told to write one: the library writes scenes.
    #[cfg_attr(not(feature = "cli"), allow(dead_code))]
    File,
    /// A folder of files.
    Folder,
}

/// Refuses a place where writing would lose something. An ordinary file, and files in a folder that is not empty, are written
/// over with `force` only; a symbolic link, a device, a pipe and what is of the other kind never are. A link further up the path is
/// the user's way to name a folder and is followed.
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

fn is_empty(folder: &Path) -> Result<bool> {
    super::partial::sweep(folder, None);
    Ok(std::fs::read_dir(folder).map_err(Error::io(folder))?.next().is_none())
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
}
