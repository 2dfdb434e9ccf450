//! Replacement of a folder by another; a process that is killed at any moment leaves one of them.
use std::path::Path;

/// Moves the folder `new` to `place`, where another folder is; that one is at `new` or `aside`
/// afterwards. Atomic where the system can exchange two folders; otherwise a process that is killed
/// between the two moves leaves it at `aside`, and nothing at the place.
pub fn swap(new: &Path, place: &Path, aside: &Path) -> std::io::Result<()> {
    match exchange(new, place) {
        Ok(()) => Ok(()),
        Err(e) if unsupported(&e) => by_renaming(new, place, aside),
        Err(e) => Err(e),
    }
}

fn by_renaming(new: &Path, place: &Path, aside: &Path) -> std::io::Result<()> {
    std::fs::rename(place, aside)?;
    std::fs::rename(new, place).inspect_err(|_| {
        let _ = std::fs::rename(aside, place);
    })
}

/// Whether the file system or kernel cannot exchange two folders.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn unsupported(e: &std::io::Error) -> bool {
    [libc::EINVAL, libc::ENOSYS, libc::EOPNOTSUPP].map(Some).contains(&e.raw_os_error())
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn exchange(a: &Path, b: &Path) -> std::io::Result<()> {
    use std::os::unix::ffi::OsStrExt;
    let text = |p: &Path| std::ffi::CString::new(p.as_os_str().as_bytes());
    let (a, b) = (text(a)?, text(b)?);
    // SAFETY: two zero-terminated texts that outlive the call.
    match unsafe {
        libc::renameat2(libc::AT_FDCWD, a.as_ptr(), libc::AT_FDCWD, b.as_ptr(), libc::RENAME_EXCHANGE)
    } {
        0 => Ok(()),
        _ => Err(std::io::Error::last_os_error()),
    }
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn unsupported(e: &std::io::Error) -> bool {
    e.kind() == std::io::ErrorKind::Unsupported
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn exchange(_: &Path, _: &Path) -> std::io::Result<()> {
    Err(std::io::ErrorKind::Unsupported.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(path: &Path, content: &str) {
        std::fs::create_dir(path).unwrap();
        std::fs::write(path.join("a"), content).unwrap();
    }

    fn content(path: &Path) -> String {
        std::fs::read_to_string(path.join("a")).unwrap()
    }

    #[test]
    fn exchanged_and_renamed_folders_are_whole() {
        for swap in [swap, by_renaming] {
            let base = tempfile::tempdir().unwrap();
            let path_of = |name: &str| base.path().join(name);
            let (new, place, aside) = (path_of("new"), path_of("scene"), path_of("old"));
            folder(&new, "new");
            folder(&place, "old");
            swap(&new, &place, &aside).unwrap();
            let old = if new.exists() { &new } else { &aside };
            assert_eq!((content(&place), content(old)), ("new".into(), "old".into()));
            assert_eq!(std::fs::read_dir(base.path()).unwrap().count(), 2);
            std::fs::remove_dir_all(old).unwrap();
            assert!(swap(&new, &place, &aside).is_err());
            assert_eq!(content(&place), "new", "the old one stays where nothing can replace it");
            assert_eq!(std::fs::read_dir(base.path()).unwrap().count(), 1);
        }
    }
}
