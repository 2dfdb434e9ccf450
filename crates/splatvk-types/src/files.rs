//! Bounded reading of files, atomic writing (beside the place, then renamed), some with a checksum
//! in front, and the rule for overwriting.
mod guard;
mod hash;
mod home;
mod owner;
mod partial;
mod place;
mod program;
mod replace;
mod within;

pub use guard::guarded;
pub use guard::panic_text;
pub use hash::{hex, sha256};
pub use home::home;
#[doc(hidden)]
pub use owner::leave;
pub use owner::{Found, Held, look};
pub use partial::{HIDDEN, leftovers, note_finished, nothing_finished, remove_leftover, remove_unfinished};
pub use partial::{Partial, check_free, check_free_inside, is_leftover, restore, sweep};
pub use place::{Kind, check_place, check_spared, foreign, listed, next_free};
pub use program::{installed, own_file};
pub use replace::swap;
pub use within::within;

use crate::error::words;
use crate::sync::lock;
use crate::{Error, Result};
use serde::Deserialize;
use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock};
use std::time::SystemTime;

/// Memory that a reader may take beyond four times the bytes of its file, bytes
/// (docs/use/formats.md#limits).
pub const ROOM: u64 = 64 << 20;

/// Most bytes of a text or JSON file: ten times the cameras of 10,000 photos.
const LONGEST_TEXT: u64 = 64 << 20;

/// Most values and keys of a JSON file. A value takes 32 bytes of memory and as few as two in the
/// file, so the bound on the bytes would not hold the memory; the cameras of 10,000 photos have
/// 450,000.
const MOST_VALUES: usize = 1 << 20;

/// Largest ratio of content to file size of a compressed file: Gaussians and features reach 5.
const EXPANSION: u64 = 16;

/// Most bytes that a compressed file of `size` bytes may hold.
pub fn most_content(size: usize) -> u64 {
    (size as u64).saturating_mul(EXPANSION).saturating_add(ROOM)
}

/// Opens a file for reading; returns it with its size in bytes. Devices, pipes and folders are
/// refused: their size is unknown or unbounded.
pub fn open(path: &Path) -> Result<(File, u64)> {
    // Checked before opening, too: opening a pipe blocks until a writer opens it.
    regular_size(&std::fs::metadata(path).map_err(unreadable(path))?, path)?;
    let file = File::open(path).map_err(unreadable(path))?;
    let size = regular_size(&file.metadata().map_err(Error::io(path))?, path)?;
    Ok((file, size))
}

/// Error for a file that cannot be opened.
fn unreadable(path: &Path) -> impl Fn(std::io::Error) -> Error {
    move |e| match e.kind() {
        std::io::ErrorKind::NotFound => Error::io(path)(e),
        _ => Error::input(format!(
            "{}: {}; check the name and that you may read it",
            path.display(),
            words(&e)
        )),
    }
}

/// Size of a regular file in bytes; refuses everything else.
fn regular_size(meta: &std::fs::Metadata, path: &Path) -> Result<u64> {
    if meta.is_file() {
        return Ok(meta.len());
    }
    let kind = if meta.is_dir() { "a folder" } else { "a device or pipe" };
    Err(Error::input(format!("{}: is {kind}, not a file; give a file", path.display())))
}

/// Reads a whole file: as many bytes as it has when it is opened. All whole-file reads go through
/// here.
pub fn read(path: &Path) -> Result<Vec<u8>> {
    read_within(path, u64::MAX)
}

fn read_within(path: &Path, most: u64) -> Result<Vec<u8>> {
    let (file, size) = open(path)?;
    if size > most {
        return Err(Error::input(format!(
            "{}: {size} bytes are too many for a file of this kind (at most {most}); check that it is the right one",
            path.display()
        )));
    }
    read_open(file, size, path)
}

fn read_open(file: File, size: u64, path: &Path) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let room = usize::try_from(size).ok().and_then(|n| bytes.try_reserve_exact(n.checked_add(1)?).ok());
    room.ok_or_else(|| Error::work(format!("{}: no memory for its {size} bytes", path.display())))?;
    // One byte more than announced: files of /proc announce none, and some have no end.
    file.take(size.saturating_add(1)).read_to_end(&mut bytes).map_err(Error::io(path))?;
    if bytes.len() as u64 != size {
        return Err(Error::input(format!(
            "{}: has another length than it states ({size} bytes); try again once it is complete",
            path.display()
        )));
    }
    Ok(bytes)
}

/// Reads a text file.
pub fn read_text(path: &Path) -> Result<String> {
    let bytes = read_within(path, LONGEST_TEXT)?;
    let text = plain_text(&bytes).map_err(|e| Error::input(format!("{}: {e}", path.display())))?;
    Ok(text.to_owned())
}

/// Text of a file's bytes, without the byte-order mark that editors of Windows put in front.
pub fn plain_text(bytes: &[u8]) -> Result<&str, String> {
    // JSON, TOML and tables of numbers begin with ASCII; in UTF-16 its other byte is zero.
    let ascii = |byte: u8| byte.is_ascii_graphic() || byte.is_ascii_whitespace();
    let utf16 = match bytes {
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => true,
        [a, 0, b, 0, ..] | [0, a, 0, b, ..] => ascii(*a) && ascii(*b),
        _ => false,
    };
    if utf16 {
        return Err("is UTF-16 text; save it as UTF-8".to_owned());
    }
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    std::str::from_utf8(bytes).map_err(|_| "is not text (UTF-8); check that it is the right file".to_owned())
}

/// Reads a JSON file; `advice` ends the message where it cannot be parsed.
pub fn read_json<T: serde::de::DeserializeOwned>(path: &Path, advice: &str) -> Result<T> {
    let bytes = read_within(path, LONGEST_TEXT)?;
    parse_json(&bytes).map_err(|e| Error::input(format!("{}: {e}; {advice}", path.display())))
}

/// Parses JSON with a bounded number of values.
pub fn parse_json<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, String> {
    let text = plain_text(bytes)?;
    let bytes = text.as_bytes();
    let (mut values, mut quoted, mut escaped) = (1usize, false, false);
    for byte in bytes {
        match byte {
            _ if escaped => escaped = false,
            b'\\' if quoted => escaped = true,
            b'"' => quoted = !quoted,
            b',' | b':' | b'[' | b'{' if !quoted => values += 1,
            _ => {}
        }
    }
    if values > MOST_VALUES {
        return Err(format!("holds {values} values, more than the {MOST_VALUES} that are read"));
    }
    serde_json::from_str(text).map_err(|e| e.to_string())
}

/// Number of hexadecimal digits of the checksum.
const CHECKSUM_DIGITS: usize = 64;

/// sha256 of a file in lower-case hex; cached per path, size and modification time.
pub fn content_hash(path: &Path) -> std::io::Result<String> {
    type HashCache = HashMap<PathBuf, (u64, SystemTime, String)>;
    static CACHE: OnceLock<Mutex<HashCache>> = OnceLock::new();
    let known = CACHE.get_or_init(Mutex::default);
    let meta = std::fs::metadata(path)?;
    let stamp = (meta.len(), meta.modified()?);
    if let Ok(known) = known.lock()
        && let Some((size, time, hash)) = known.get(path)
        && (*size, *time) == stamp
    {
        return Ok(hash.clone());
    }
    let mut file = File::open(path)?;
    let (mut digest, mut block) = (Sha256::new(), vec![0u8; 1 << 18]);
    loop {
        match file.read(&mut block)? {
            0 => break,
            n => digest.update(&block[..n]),
        }
    }
    let hash = hex(&digest.finalize());
    if let Ok(mut known) = known.lock() {
        known.insert(path.to_path_buf(), (stamp.0, stamp.1, hash.clone()));
    }
    Ok(hash)
}

/// Writes `parts` one after the other to a private file of the program, atomically, readable by its
/// user only; creates its folder, and removes leftovers of killed processes there.
pub fn write(path: &Path, parts: &[&[u8]]) -> std::io::Result<()> {
    // One thread at a time: of two that write the same file the second would be refused.
    static WRITING: Mutex<()> = Mutex::new(());
    let _turn = lock(&WRITING);
    let folder = path.parent().unwrap_or(path);
    private_folder(folder)?;
    sweep(folder);
    let partial = Partial::beside(path).map_err(std::io::Error::other)?;
    let mut file = private_file(partial.path())?;
    parts.iter().try_for_each(|part| std::io::Write::write_all(&mut file, part))?;
    drop(file);
    partial.keep(|from| std::fs::rename(from, path))
}

/// Creates a folder with its parents, accessible by its user only; an existing folder keeps its
/// mode.
fn private_folder(folder: &Path) -> std::io::Result<()> {
    let mut builder = std::fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.recursive(true).create(folder)
}

/// Creates a file that only its user can read and write.
fn private_file(path: &Path) -> std::io::Result<File> {
    let mut options = File::options();
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.write(true).create_new(true).open(path)
}

/// Whether only the user or root can have written a file: one of them owns it, and group and others
/// may not write to it.
#[cfg(unix)]
fn is_own(meta: &std::fs::Metadata) -> bool {
    use std::os::unix::fs::MetadataExt;
    meta.mode() & 0o022 == 0 && user().is_none_or(|user| [0, user].contains(&meta.uid()))
}

/// Files of other systems have no such modes.
#[cfg(not(unix))]
fn is_own(_: &std::fs::Metadata) -> bool {
    true
}

/// Effective user id of the process; `None` on systems where it is not read.
#[cfg(unix)]
fn user() -> Option<u32> {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: takes nothing and cannot fail.
    return Some(unsafe { libc::geteuid() });
    #[cfg(not(all(target_os = "linux", target_env = "gnu")))]
    None
}

/// [`write`] with the checksum of `body` in front.
pub fn write_with_checksum(path: &Path, body: &[u8]) -> std::io::Result<()> {
    write(path, &[sha256(body).as_bytes(), body])
}

/// Body of a file of [`write_with_checksum`]; `None` if it is missing or damaged, or if another
/// user may have written it. Counts as a use for [`prune`].
pub fn read_with_checksum(path: &Path) -> Option<Vec<u8>> {
    let (file, size) = open(path).ok()?;
    if !is_own(&file.metadata().ok()?) {
        return None;
    }
    let mut bytes = read_open(file, size, path).ok()?;
    let (sum, body) = bytes.split_at_checked(CHECKSUM_DIGITS)?;
    if *sum != *sha256(body).as_bytes() {
        return None;
    }
    // In a read-only folder nothing is pruned either.
    let _ = std::fs::File::options().append(true).open(path).and_then(|f| f.set_modified(SystemTime::now()));
    bytes.drain(..CHECKSUM_DIGITS);
    Some(bytes)
}

/// The files of a folder with this extension and their sizes in bytes, by name.
pub fn in_folder(folder: &Path, extension: &str) -> Vec<(PathBuf, u64)> {
    let size = |path: PathBuf| std::fs::metadata(&path).ok().map(|m| (path, m.len()));
    let paths = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let mut all: Vec<_> =
        paths.filter(|p| p.extension().is_some_and(|e| e == extension)).filter_map(size).collect();
    all.sort();
    all
}

/// Removes the least recently used files of a folder with this extension until the rest fits into
/// `capacity` bytes; never removes `newest`.
pub fn prune(newest: &Path, extension: &str, capacity: u64) {
    let Some(folder) = newest.parent() else { return };
    let list = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<_> =
        list.filter_map(age_and_size).filter(|f| f.2.extension().is_some_and(|e| e == extension)).collect();
    files.sort();
    let mut total: u64 = files.iter().map(|f| f.1).sum();
    for (_, size, path) in files {
        if total <= capacity || path == newest {
            break;
        }
        // Another thread may have removed it.
        let removed = std::fs::remove_file(&path);
        if removed.is_ok() || removed.is_err_and(|e| e.kind() == std::io::ErrorKind::NotFound) {
            total -= size;
        }
    }
}

/// Modification time, size in bytes and path of an entry.
fn age_and_size(entry: std::fs::DirEntry) -> Option<(SystemTime, u64, PathBuf)> {
    let meta = entry.metadata().ok()?;
    Some((meta.modified().ok()?, meta.len(), entry.path()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[1]` in UTF-16, with or without a byte-order mark.
    fn utf16(order: fn(u16) -> [u8; 2], mark: bool) -> Vec<u8> {
        let marks = if mark { "\u{feff}" } else { "" };
        format!("{marks}[1]").encode_utf16().flat_map(order).collect()
    }

    #[test]
    fn read_refuses_irregular_or_long_files() {
        let folder = tempfile::tempdir().unwrap();
        let path_of = |name: &str| folder.path().join(name);
        let refused = |path: &Path, words: &str| {
            let e = read(path).unwrap_err();
            assert!(e.exit_code() == 2 && e.to_string().contains(words), "{e}");
        };
        std::fs::write(path_of("a"), b"abc").unwrap();
        assert_eq!(read(&path_of("a")).unwrap(), b"abc");
        std::fs::write(path_of("none"), b"").unwrap();
        assert_eq!(read(&path_of("none")).unwrap(), b"");
        refused(folder.path(), "is a folder");
        refused(&path_of("b"), "check the name");
        let e = read_within(&path_of("a"), 2).unwrap_err();
        assert!(e.to_string().contains("3 bytes are too many"), "{e}");
        std::fs::write(path_of("binary"), b"\xff\xd8").unwrap();
        assert!(read_text(&path_of("binary")).unwrap_err().to_string().contains("not text"));
        #[cfg(target_os = "linux")]
        {
            use std::os::unix::fs::symlink;
            symlink("/dev/zero", path_of("zero")).unwrap();
            refused(&path_of("zero"), "is a device or pipe");
            symlink(path_of("loop"), path_of("loop")).unwrap();
            refused(&path_of("loop"), "check the name and that you may read it");
            // Announces no bytes but has some.
            refused(Path::new("/proc/self/status"), "another length");
        }
    }

    #[test]
    fn text_strips_bom_refuses_utf16() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.json");
        std::fs::write(&file, b"\xef\xbb\xbf[1, 2]\r\n").unwrap();
        assert_eq!(read_text(&file).unwrap(), "[1, 2]\r\n");
        assert_eq!(read_json::<Vec<u8>>(&file, "").unwrap(), [1, 2]);
        for bytes in [
            utf16(u16::to_le_bytes, true),
            utf16(u16::to_be_bytes, true),
            utf16(u16::to_le_bytes, false),
            utf16(u16::to_be_bytes, false),
        ] {
            std::fs::write(&file, bytes).unwrap();
            for e in [read_text(&file).unwrap_err(), read_json::<Vec<u8>>(&file, "").unwrap_err()] {
                assert!(e.exit_code() == 2 && e.to_string().contains("save it as UTF-8"), "{e}");
            }
        }
    }

    #[test]
    fn json_beyond_value_limit_is_refused() {
        let many = format!("[0{}]", ",0".repeat(MOST_VALUES));
        assert!(parse_json::<serde_json::Value>(many.as_bytes()).unwrap_err().contains("values"));
        let text = format!("[\"{}\\\"{}\"]", ",".repeat(MOST_VALUES), "[".repeat(MOST_VALUES));
        assert_eq!(parse_json::<Vec<String>>(text.as_bytes()).unwrap()[0].len(), 2 * MOST_VALUES + 1);
    }

    #[test]
    fn damaged_checksum_file_reads_as_none() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("deep/a.kept");
        assert_eq!(read_with_checksum(&file), None);
        write_with_checksum(&file, b"body").unwrap();
        assert_eq!(read_with_checksum(&file).as_deref(), Some(&b"body"[..]));
        let mut bytes = std::fs::read(&file).unwrap();
        bytes.pop();
        std::fs::write(&file, &bytes).unwrap();
        assert_eq!(read_with_checksum(&file), None);
        std::fs::write(&file, b"short").unwrap();
        assert_eq!(read_with_checksum(&file), None);
    }

    #[cfg(unix)]
    #[test]
    fn kept_files_are_private_and_own() {
        use std::os::unix::fs::{MetadataExt, PermissionsExt};
        let base = tempfile::tempdir().unwrap();
        let file = base.path().join("stages/a.kept");
        write_with_checksum(&file, b"body").unwrap();
        let mode = |path: &Path| path.metadata().unwrap().mode() & 0o777;
        assert_eq!((mode(&file), mode(file.parent().unwrap())), (0o600, 0o700));
        for (mode, own) in [(0o600, true), (0o644, true), (0o620, false), (0o602, false), (0o666, false)] {
            std::fs::set_permissions(&file, std::fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(read_with_checksum(&file).is_some(), own, "{mode:o}");
        }
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o600)).unwrap();
        // Only root can give a file away.
        if std::os::unix::fs::chown(&file, Some(65534), None).is_ok() {
            assert_eq!(read_with_checksum(&file), None, "of another user");
        }
    }

    #[test]
    fn write_sweeps_leftovers_and_serialises_threads() {
        let folder = tempfile::tempdir().unwrap();
        leave(&folder.path().join(".rgb-1.stage.partial-splatvk")).unwrap();
        let file = folder.path().join("a.kept");
        std::thread::scope(|s| {
            for k in 0..8u8 {
                s.spawn({
                    let file = &file;
                    move || write_with_checksum(file, &vec![k; 1 << 16]).unwrap()
                });
            }
        });
        assert_eq!(read_with_checksum(&file).map(|body| body.len()), Some(1 << 16));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn prune_removes_least_recently_used() {
        let folder = tempfile::tempdir().unwrap();
        let path_of = |name: &str| folder.path().join(name);
        for (age, name) in ["old.kept", "used.kept", "new.kept", "other.txt"].iter().enumerate() {
            std::fs::write(path_of(name), [0; 100]).unwrap();
            let time = SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(age as u64);
            std::fs::File::options().append(true).open(path_of(name)).unwrap().set_modified(time).unwrap();
        }
        prune(&path_of("new.kept"), "kept", 250);
        let there: Vec<bool> =
            ["old.kept", "used.kept", "new.kept", "other.txt"].iter().map(|n| path_of(n).exists()).collect();
        assert_eq!(there, [false, true, true, true]);
        prune(&path_of("new.kept"), "kept", 0);
        assert!(!path_of("used.kept").exists() && path_of("new.kept").exists());
    }
}
