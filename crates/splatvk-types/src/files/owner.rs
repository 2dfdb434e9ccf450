//! Ownership of folders with unfinished work. A mark file in the folder names the owner, and the
//! owner locks it as long as it lives. Only a folder with such a mark, whose owner has certainly
//! ended, is ever removed.
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fs::{File, TryLockError};
use std::io::{ErrorKind, Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The file in a folder of unfinished work that names its owner.
const MARK: &str = "owner";
/// Folder of the output; some outputs are in the marked folder itself.
pub(super) const NEW: &str = "new";
/// Folder that holds the replaced result meanwhile, on file systems that cannot exchange two
/// folders.
const OLD: &str = "old";
/// Folder that holds a preview of the output.
pub(super) const PREVIEW: &str = "preview";
/// Most bytes of a mark: ten times a long one.
const LONGEST_MARK: u64 = 1 << 14;
/// Number and interval of attempts: another process holds the lock of a dead owner only while it
/// reads the mark or sweeps.
const LOCK_RETRIES: (u32, Duration) = (100, Duration::from_millis(20));

/// The process that works in a folder, as recorded in its mark.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Owner {
    /// Constant that identifies the file: marks of other programs have no such field.
    splatvk: String,
    /// Name of the marked folder: a mark that was moved to another folder is invalid.
    folder: String,
    /// Name of the output; empty for several files.
    place: String,
    host: String,
    /// Boot id of the kernel; empty where it cannot be read.
    boot: String,
    /// PID namespace in which the process number is valid.
    processes: String,
    process: u32,
    /// Start time of the process, in ticks after the start of the kernel: process numbers are
    /// reused.
    started: u64,
}

/// The value of [`Owner::splatvk`].
const UNFINISHED: &str = "unfinished work";

impl Owner {
    /// The current process, as owner of a folder.
    fn this(folder: &Path, place: &Path) -> Owner {
        let trimmed = |path: &str| std::fs::read_to_string(path).unwrap_or_default().trim().to_owned();
        let namespace = std::fs::read_link("/proc/self/ns/pid").unwrap_or_default();
        let process = std::process::id();
        Owner {
            splatvk: UNFINISHED.to_owned(),
            folder: name(folder),
            place: name(place),
            host: trimmed("/proc/sys/kernel/hostname"),
            boot: trimmed("/proc/sys/kernel/random/boot_id"),
            processes: namespace.to_string_lossy().into_owned(),
            process,
            started: started(process).unwrap_or(0),
        }
    }

    /// Whether the process number is valid on this machine, boot and namespace.
    fn is_near(&self) -> bool {
        let here = Owner::this(Path::new(""), Path::new(""));
        let known = !here.boot.is_empty() && !here.processes.is_empty();
        known && (&self.host, &self.boot, &self.processes) == (&here.host, &here.boot, &here.processes)
    }

    /// Whether the process has certainly ended; for a process elsewhere only its lock decides that.
    fn has_ended(&self) -> bool {
        self.is_near() && started(self.process) != Some(self.started)
    }

    /// Whether nobody works in `folder` any more. `locked`: the mark's lock was free and this call
    /// holds it; false on a file system without locks.
    fn is_gone(&self, locked: bool, folder: &Path) -> bool {
        match self.is_near() {
            // A folder that this process works in is locked.
            true => self.has_ended() || self.process == std::process::id() && locked,
            false => locked && locks_reach_everybody(folder),
        }
    }

    /// Name of the process in messages.
    fn text(&self) -> String {
        match self.is_near() {
            true => format!("process {}", self.process),
            false => format!("process {} of {}", self.process, self.host),
        }
    }
}

/// The last part of a path.
fn name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Start time of a living process, in ticks after the start of the kernel; `None` without such a
/// process or without /proc.
fn started(process: u32) -> Option<u64> {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The second field, the name, may hold anything; the 22nd is the time (proc(5)).
    stat.rsplit_once(')')?.1.split_whitespace().nth(19)?.parse().ok()
}

/// Whether a lock that is free here is free for every machine that mounts the folder: true for
/// local file systems, not for every network file system.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn locks_reach_everybody(folder: &Path) -> bool {
    use std::os::unix::ffi::OsStrExt;
    // ext2 to 4, XFS, Btrfs, tmpfs, ramfs, F2FS, ZFS, bcachefs, overlay, FAT, exFAT and NTFS
    // (linux/magic.h).
    const LOCAL: [u64; 12] = [
        0xef53,
        0x5846_5342,
        0x9123_683e,
        0x0102_1994,
        0x8584_58f6,
        0xf2f5_2010,
        0x2fc1_2fc1,
        0xca45_1a4e,
        0x794c_7630,
        0x4d44,
        0x2011_bab0,
        0x7366_746e,
    ];
    let Ok(path) = std::ffi::CString::new(folder.as_os_str().as_bytes()) else { return false };
    let mut found = std::mem::MaybeUninit::<libc::statfs>::uninit();
    // SAFETY: a zero-terminated text, and a structure of the required type for the result, both
    // alive during the call.
    if unsafe { libc::statfs(path.as_ptr(), found.as_mut_ptr()) } != 0 {
        return false;
    }
    // SAFETY: the call has filled it, as it returned 0.
    let kind = unsafe { found.assume_init() }.f_type as u64 & 0xffff_ffff;
    LOCAL.contains(&kind)
}

/// Without /proc only locks identify a living process.
#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn locks_reach_everybody(_: &Path) -> bool {
    !cfg!(target_os = "linux")
}

/// State of a folder of unfinished work.
pub enum Found {
    /// The folder does not exist.
    Nothing,
    /// An empty folder, or one with an empty mark: its owner was killed before it wrote the mark,
    /// or is about to write it.
    Blank(Option<File>),
    /// Its owner is gone. While this value lives, no other process sweeps the folder.
    Left(Held),
    /// A process works in it, or may work in it.
    Busy(Option<Owner>),
    /// It has no valid mark.
    Foreign,
}

/// Examines a folder without changing it. Links are not followed.
pub fn look(folder: &Path) -> Found {
    match folder.symlink_metadata() {
        Err(e) if e.kind() == ErrorKind::NotFound => return Found::Nothing,
        Ok(meta) if meta.is_dir() => {}
        _ => return Found::Foreign,
    }
    let mark = folder.join(MARK);
    let has_entries =
        |wanted: usize| std::fs::read_dir(folder).is_ok_and(|all| all.take(2).count() == wanted);
    match mark.symlink_metadata() {
        Err(_) if has_entries(0) => return Found::Blank(None),
        Ok(meta) if meta.is_file() => {}
        _ => return Found::Foreign,
    }
    let Ok(mut lock) = File::options().read(true).write(true).open(&mark) else { return Found::Busy(None) };
    let locked = match lock.try_lock() {
        Ok(()) => true,
        Err(TryLockError::Error(_)) => false,
        Err(TryLockError::WouldBlock) => return Found::Busy(read(&mut lock, folder)),
    };
    if !is_at(&lock, &mark) {
        // Swept and created anew since it was opened.
        return Found::Busy(None);
    }
    match read(&mut lock, folder) {
        Some(owner) if owner.is_gone(locked, folder) => {
            Found::Left(Held { folder: folder.to_path_buf(), place: owner.place, lock })
        }
        Some(owner) => Found::Busy(Some(owner)),
        None if locked && lock.metadata().is_ok_and(|m| m.len() == 0) && has_entries(1) => {
            Found::Blank(Some(lock))
        }
        None => Found::Foreign,
    }
}

/// Owner that a mark names; `None` if it is not the mark of this folder.
fn read(mark: &mut File, folder: &Path) -> Option<Owner> {
    let mut text = String::new();
    mark.take(LONGEST_MARK).read_to_string(&mut text).ok()?;
    // First of possibly two values: taking a folder over overwrites the mark, then truncates it.
    let owner: Owner = serde_json::Deserializer::from_str(&text).into_iter().next()?.ok()?;
    (owner.splatvk == UNFINISHED && owner.folder == name(folder)).then_some(owner)
}

/// Whether a path still leads to an open file.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let id = |m: &std::fs::Metadata| (m.dev(), m.ino());
    matches!((file.metadata(), path.symlink_metadata()), (Ok(a), Ok(b)) if id(&a) == id(&b))
}

/// On other systems an open file keeps its name.
#[cfg(not(unix))]
fn is_at(_: &File, _: &Path) -> bool {
    true
}

/// A folder of unfinished work that this process holds.
#[derive(Debug)]
pub struct Held {
    folder: PathBuf,
    place: String,
    /// Locked as long as this value lives.
    lock: File,
}

impl Held {
    /// Takes `folder` to work on `place`: creates it, or takes it over where its owner is gone,
    /// with its contents if `keep`. [`Error::Input`] where another process works in it or a folder
    /// without a mark is there.
    pub fn take(folder: &Path, place: &Path, keep: bool) -> Result<Held> {
        for _ in 0..LOCK_RETRIES.0 {
            match std::fs::create_dir(folder) {
                Ok(()) => {
                    if let Some(held) = Held::mark(folder, place).map_err(Error::unwritable(place))? {
                        return Ok(held);
                    }
                    continue;
                }
                Err(e) if e.kind() == ErrorKind::AlreadyExists => {}
                Err(e) => return Err(Error::unwritable(place)(e)),
            }
            match look(folder) {
                Found::Nothing => {}
                Found::Left(held) if keep => return held.renewed(place).map_err(Error::unwritable(place)),
                left @ (Found::Left(_) | Found::Blank(_)) => {
                    remove(folder, left).map_err(Error::unwritable(place))?;
                }
                Found::Busy(Some(owner)) if !owner.has_ended() => {
                    return Err(busy(place, folder, Some(&owner)));
                }
                Found::Busy(_) => std::thread::sleep(LOCK_RETRIES.1),
                Found::Foreign => return Err(foreign(folder)),
            }
        }
        Err(busy(place, folder, None))
    }

    /// Marks a folder that this process has just created; `None` where another process has swept it
    /// meanwhile.
    fn mark(folder: &Path, place: &Path) -> std::io::Result<Option<Held>> {
        let mark = folder.join(MARK);
        let mut lock = match File::options().read(true).write(true).create_new(true).open(&mark) {
            Ok(file) => file,
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::AlreadyExists) => return Ok(None),
            Err(e) => {
                let _ = std::fs::remove_dir(folder);
                return Err(e);
            }
        };
        // Without locks other processes check the process number.
        if matches!(lock.try_lock(), Err(TryLockError::WouldBlock)) || !is_at(&lock, &mark) {
            return Ok(None);
        }
        write(&mut lock, folder, place).inspect_err(|_| {
            let _ = clear(folder);
        })?;
        Ok(Some(Held { folder: folder.to_path_buf(), place: name(place), lock }))
    }

    /// Writes this process into the mark of the same folder.
    fn renewed(mut self, place: &Path) -> std::io::Result<Held> {
        std::io::Seek::rewind(&mut self.lock)?;
        write(&mut self.lock, &self.folder, place)?;
        let end = std::io::Seek::stream_position(&mut self.lock)?;
        self.lock.set_len(end)?;
        self.place = name(place);
        Ok(self)
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Place of the replaced result between two moves, where the system needs two.
    pub fn aside(&self) -> PathBuf {
        self.folder.join(OLD)
    }

    /// Place of a preview of the output.
    pub fn preview(&self) -> PathBuf {
        self.folder.join(PREVIEW)
    }

    /// Restores a result that a killed process had moved aside; returns whether none is left here.
    pub fn put_back(&self) -> bool {
        let old = self.aside();
        if old.symlink_metadata().is_err() {
            return true;
        }
        let Some(place) = self.folder.parent().map(|parent| parent.join(&self.place)) else { return false };
        // A name that is not UTF-8 cannot be restored. If something else is at the place and the
        // new result was not moved there, the old one stays: it may be the last copy of a scene.
        let named = !self.place.is_empty() && !self.place.contains(char::REPLACEMENT_CHARACTER);
        let result_moved = || [NEW, ""].iter().all(|part| !self.folder.join(part).join(&self.place).exists());
        named
            && if place.symlink_metadata().is_ok() {
                result_moved()
            } else {
                std::fs::rename(&old, place).is_ok()
            }
    }

    /// Removes the folder with its contents.
    pub fn clear(self) -> std::io::Result<()> {
        clear(&self.folder)
    }
}

/// Writes and syncs the mark before anything else is in the folder, so that it has an owner even
/// after a power cut.
fn write(mark: &mut File, folder: &Path, place: &Path) -> std::io::Result<()> {
    let text = serde_json::to_string_pretty(&Owner::this(folder, place)).map_err(std::io::Error::other)?;
    mark.write_all((text + "\n").as_bytes())?;
    mark.sync_all()
}

/// Removes a leftover that was just examined, while its lock is held; restores a result that was
/// moved aside first.
pub fn remove(folder: &Path, found: Found) -> std::io::Result<()> {
    match found {
        Found::Left(held) if held.put_back() => held.clear(),
        Found::Blank(lock) => {
            if lock.is_some() {
                std::fs::remove_file(folder.join(MARK))?;
            }
            // Only an empty folder is removed: another process may have just created it.
            match std::fs::remove_dir(folder) {
                Err(e) if !matches!(e.kind(), ErrorKind::NotFound | ErrorKind::DirectoryNotEmpty) => Err(e),
                _ => Ok(()),
            }
        }
        _ => Ok(()),
    }
}

/// Removes a folder of unfinished work, its mark last, so that a kill in between leaves a marked
/// folder.
pub(super) fn clear(folder: &Path) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path != folder.join(MARK) {
            remove_any(&path)?;
        }
    }
    std::fs::remove_file(folder.join(MARK))?;
    std::fs::remove_dir(folder)
}

/// Removes a file, a link, or a folder with its contents; links are not followed.
pub fn remove_any(path: &Path) -> std::io::Result<()> {
    match path.symlink_metadata()?.is_dir() {
        true => std::fs::remove_dir_all(path),
        false => std::fs::remove_file(path),
    }
}

/// Error for a place at which another process works.
pub fn busy(place: &Path, folder: &Path, owner: Option<&Owner>) -> Error {
    let who = owner.map_or(String::new(), |owner| format!(" ({})", owner.text()));
    let unsure = match owner {
        Some(owner) if owner.is_near() => String::new(),
        _ => format!("; if it has ended, remove {}", folder.display()),
    };
    Error::input(format!(
        "{}: another splatvk is writing there{who}; wait until it is done, or choose another place{unsure}",
        place.display()
    ))
}

fn foreign(folder: &Path) -> Error {
    Error::input(format!(
        "{}: is in the way and bears no mark of splatvk, so it stays; move it, or choose another place",
        folder.display()
    ))
}

/// Creates a folder with a file in it, as a killed process leaves it. For tests.
#[doc(hidden)]
pub fn leave(folder: &Path) -> std::io::Result<()> {
    // No process has this number: the kernel's largest is 2²².
    leave_by(folder, |owner| Owner { process: 4_000_000_000, ..owner })
}

fn leave_by(folder: &Path, by: fn(Owner) -> Owner) -> std::io::Result<()> {
    std::fs::create_dir(folder)?;
    let owner = by(Owner::this(folder, &folder.with_file_name("a.ply")));
    std::fs::write(folder.join(MARK), serde_json::to_string(&owner)?)?;
    std::fs::write(folder.join("half"), "x")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(target_os = "linux")]
    #[test]
    fn owner_is_gone_only_for_certain() {
        let base = tempfile::tempdir().unwrap();
        let path_of = |name: &str| base.path().join(name);
        type Case = (&'static str, fn(Owner) -> Owner, bool);
        let local = locks_reach_everybody(base.path());
        let cases: [Case; 6] = [
            ("ended", |o| Owner { process: 4_000_000_000, ..o }, true),
            ("number used again", |o| Owner { process: 1, started: 1, ..o }, true),
            ("living", |o| Owner { process: 1, started: started(1).unwrap(), ..o }, false),
            ("before the power cut", |o| Owner { boot: "another".into(), ..o }, local),
            ("another container", |o| Owner { processes: "pid:[1]".into(), ..o }, local),
            ("own, let go", |o| o, true),
        ];
        for (name, by, gone) in cases {
            leave_by(&path_of(name), by).unwrap();
            assert_eq!(matches!(look(&path_of(name)), Found::Left(_)), gone, "{name}");
            // A process that holds the lock is alive, wherever it runs.
            let lock = File::open(path_of(name).join(MARK)).unwrap();
            lock.lock().unwrap();
            assert!(matches!(look(&path_of(name)), Found::Busy(Some(_))), "{name}, locked");
            drop(lock);
            let found = look(&path_of(name));
            remove(&path_of(name), found).unwrap();
            assert_eq!(path_of(name).exists(), !gone, "{name}");
        }
    }

    #[test]
    fn unmarked_folders_and_links_are_foreign() {
        let base = tempfile::tempdir().unwrap();
        let path_of = |name: &str| base.path().join(name);
        leave(&path_of(".a.partial-splatvk")).unwrap();
        let mark = std::fs::read(path_of(".a.partial-splatvk").join(MARK)).unwrap();
        // A note, an empty mark with something beside it, and the mark of another folder.
        for (name, text) in [("note", &b"a note"[..]), ("cut off", b""), ("moved", &mark)] {
            std::fs::create_dir(path_of(name)).unwrap();
            std::fs::write(path_of(name).join(MARK), text).unwrap();
            std::fs::write(path_of(name).join("photo.jpg"), "precious").unwrap();
        }
        std::fs::create_dir(path_of("unmarked")).unwrap();
        std::fs::write(path_of("unmarked/photo.jpg"), "precious").unwrap();
        std::fs::write(path_of("file"), "precious").unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(path_of(".a.partial-splatvk"), path_of("link")).unwrap();
        for name in ["note", "cut off", "moved", "unmarked", "file", "link"] {
            let Found::Foreign = look(&path_of(name)) else {
                assert!(name == "link" && !cfg!(unix), "{name}");
                continue;
            };
            remove(&path_of(name), look(&path_of(name))).unwrap();
            assert!(path_of(name).exists());
            let e = Held::take(&path_of(name), &path_of("a"), false).unwrap_err();
            assert!(e.exit_code() == 2 && e.to_string().contains("no mark of splatvk"), "{e}");
        }
        assert!(path_of(".a.partial-splatvk/half").exists());
    }

    #[test]
    fn blank_folder_is_taken_over() {
        let base = tempfile::tempdir().unwrap();
        let folder = base.path().join("x");
        for marked in [false, true] {
            std::fs::create_dir(&folder).unwrap();
            if marked {
                std::fs::write(folder.join(MARK), "").unwrap();
            }
            assert!(matches!(look(&folder), Found::Blank(_)));
            Held::take(&folder, &base.path().join("a"), false).unwrap().clear().unwrap();
            assert!(!folder.exists());
        }
    }

    #[test]
    fn folder_moved_aside_comes_back() {
        let base = tempfile::tempdir().unwrap();
        let path_of = |name: &str| base.path().join(name);
        for there in [false, true] {
            leave(&path_of("x")).unwrap();
            std::fs::create_dir(path_of("x").join(OLD)).unwrap();
            std::fs::write(path_of("x").join(OLD).join("scene.json"), "old").unwrap();
            if there {
                std::fs::create_dir(path_of("a.ply")).unwrap();
            }
            remove(&path_of("x"), look(&path_of("x"))).unwrap();
            assert!(!path_of("x").exists());
            assert_eq!(path_of("a.ply/scene.json").exists(), !there, "nothing is written over");
            std::fs::remove_dir_all(path_of("a.ply")).unwrap();
        }
        // Another file came to the place while both results were moved: the one aside is the only
        // copy.
        leave(&path_of("x")).unwrap();
        std::fs::create_dir_all(path_of("x").join(NEW).join("a.ply")).unwrap();
        std::fs::create_dir(path_of("x").join(OLD)).unwrap();
        std::fs::create_dir(path_of("a.ply")).unwrap();
        remove(&path_of("x"), look(&path_of("x"))).unwrap();
        assert!(path_of("x").join(OLD).exists());
    }

    #[test]
    fn folder_taken_over_keeps_its_content() {
        let base = tempfile::tempdir().unwrap();
        let folder = base.path().join("x");
        leave(&folder).unwrap();
        // Killed before it truncated a longer mark.
        let mark = std::fs::read_to_string(folder.join(MARK)).unwrap();
        std::fs::write(folder.join(MARK), format!("{mark}}}\n")).unwrap();
        let held = Held::take(&folder, &base.path().join("b"), true).unwrap();
        assert!(folder.join("half").exists());
        let text = std::fs::read_to_string(folder.join(MARK)).unwrap();
        assert_eq!(serde_json::from_str::<Owner>(&text).unwrap().process, std::process::id());
        assert!(Held::take(&folder, &base.path().join("b"), true).is_err());
        held.clear().unwrap();
    }
}
