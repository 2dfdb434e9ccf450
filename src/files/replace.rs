//! One folder in the place of another, so that a process that is killed at any moment leaves one of them there.
use std::ffi::OsString;
use std::path::{Path, PathBuf};

/// Puts the folder `new` at `place`, where another one is; that one is at `new` afterwards. In one step where the system can.
pub fn swap(new: &Path, place: &Path) -> std::io::Result<()> {
    match exchange(new, place) {
        Ok(()) => Ok(()),
        Err(e) if unsupported(&e) => by_renaming(new, place),
        Err(e) => Err(e),
    }
}

/// Brings back what a process that was killed in the middle of [`by_renaming`] had moved aside.
pub fn restore(place: &Path) {
    if place.symlink_metadata().is_ok() {
        return;
    }
    let (Some(folder), Some(name)) = (place.parent(), place.file_name()) else { return };
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let mark = aside(name.as_ref(), "").to_string_lossy().into_owned();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let own = entry.file_name().to_string_lossy().into_owned();
        let gone = own
            .strip_prefix(&mark)
            .and_then(|process| process.parse().ok())
            .is_some_and(super::partial::is_gone);
        if gone && std::fs::rename(entry.path(), place).is_ok() {
            return;
        }
    }
}

/// `.NAME.old-PROCESS` beside a place.
fn aside(place: &Path, process: &str) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(place.file_name().unwrap_or_default());
    name.push(format!(".old-{process}"));
    place.with_file_name(name)
}

/// Killed after the first step, it leaves nothing at the place, and what [`restore`] needs.
fn by_renaming(new: &Path, place: &Path) -> std::io::Result<()> {
    let old = aside(place, &std::process::id().to_string());
    std::fs::rename(place, &old)?;
    if let Err(e) = std::fs::rename(new, place) {
        std::fs::rename(&old, place)?;
        return Err(e);
    }
    std::fs::rename(&old, new)
}

/// File systems and kernels without it say so in these ways.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn unsupported(e: &std::io::Error) -> bool {
    [libc::EINVAL, libc::ENOSYS, libc::EOPNOTSUPP].map(Some).contains(&e.raw_os_error())
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn exchange(a: &Path, b: &Path) -> std::io::Result<()> {
    use std::os::unix::ffi::OsStrExt;
    let text = |p: &Path| std::ffi::CString::new(p.as_os_str().as_bytes());
    let (a, b) = (text(a)?, text(b)?);
    // SAFETY: two texts that end with a zero byte and outlive the call.
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
    fn either_way_both_folders_are_whole() {
        for swap in [swap, by_renaming] {
            let base = tempfile::tempdir().unwrap();
            let (new, place) = (base.path().join(".scene.partial-1"), base.path().join("scene"));
            folder(&new, "new");
            folder(&place, "old");
            swap(&new, &place).unwrap();
            assert_eq!((content(&place), content(&new)), ("new".into(), "old".into()));
            assert_eq!(std::fs::read_dir(base.path()).unwrap().count(), 2);
            std::fs::remove_dir_all(&new).unwrap();
            assert!(swap(&new, &place).is_err());
            assert_eq!(content(&place), "new", "what is there stays where nothing can replace it");
            assert_eq!(std::fs::read_dir(base.path()).unwrap().count(), 1);
        }
    }

    #[test]
    fn what_a_killed_process_had_moved_aside_comes_back() {
        let base = tempfile::tempdir().unwrap();
        let place = base.path().join("scene");
        let living = aside(&place, &std::process::id().to_string());
        folder(&living, "of a living process");
        folder(&base.path().join(".scene2.old-4000000000"), "another");
        restore(&place);
        assert!(!place.exists() && living.exists());
        folder(&aside(&place, "4000000000"), "old");
        restore(&place);
        assert_eq!(content(&place), "old");
        folder(&aside(&place, "4000000001"), "older");
        restore(&place);
        assert_eq!(content(&place), "old", "nothing is written over");
    }
}
