//! Files that are whole or not there: written beside their place and renamed into it, some with a checksum in front; and the rule
//! for what may be written over.
mod partial;
mod place;

pub(crate) use partial::Partial;
#[cfg(feature = "cli")]
pub(crate) use partial::{leftovers, remove_any, remove_unfinished};
pub(crate) use place::{Kind, check_place};

use sha2::{Digest, Sha256};
use std::collections::HashMap;
use std::fmt::Write as _;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock};
use std::time::SystemTime;

/// The folder that set-up fills: `SPLATVK_HOME`, else `splatvk` in the user's data folder.
pub fn home() -> PathBuf {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let data =
        || set("XDG_DATA_HOME").unwrap_or_else(|| set("HOME").unwrap_or_default().join(".local/share"));
    set("SPLATVK_HOME").unwrap_or_else(|| data().join("splatvk"))
}

/// Hexadecimal digits of the checksum.
const CHECKSUM_DIGITS: usize = 64;

/// Lower-case hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, b| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{b:02x}");
        text
    })
}

/// sha256 in lower-case hex.
pub(crate) fn sha256(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// sha256 of a file in lower-case hex; remembered per path, size and modification time.
pub(crate) fn content_hash(path: &Path) -> std::io::Result<String> {
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
    let mut file = std::fs::File::open(path)?;
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

/// Writes `parts` one after the other to a file that appears whole or not at all; makes its folder.
pub(crate) fn write(path: &Path, parts: &[&[u8]]) -> std::io::Result<()> {
    let partial = path.with_extension(format!("partial-{}", std::process::id()));
    let all = || -> std::io::Result<()> {
        let mut file = std::fs::File::create(&partial)?;
        parts.iter().try_for_each(|part| std::io::Write::write_all(&mut file, part))
    };
    let kept = std::fs::create_dir_all(path.parent().unwrap_or(path))
        .and_then(|()| all())
        .and_then(|()| std::fs::rename(&partial, path));
    kept.inspect_err(|_| {
        let _ = std::fs::remove_file(&partial);
    })
}

/// [`write`] with the checksum of `body` in front.
pub(crate) fn write_with_checksum(path: &Path, body: &[u8]) -> std::io::Result<()> {
    write(path, &[sha256(body).as_bytes(), body])
}

/// What [`write_with_checksum`] wrote; `None` if it is not there or not what was written. Counts as a use for [`prune`].
pub(crate) fn read_with_checksum(path: &Path) -> Option<Vec<u8>> {
    let mut bytes = std::fs::read(path).ok()?;
    let (sum, body) = bytes.split_at_checked(CHECKSUM_DIGITS)?;
    if *sum != *sha256(body).as_bytes() {
        return None;
    }
    // A folder that cannot be written to prunes nothing either.
    let _ = std::fs::File::options().append(true).open(path).and_then(|f| f.set_modified(SystemTime::now()));
    bytes.drain(..CHECKSUM_DIGITS);
    Some(bytes)
}

/// The files of a folder with this extension and their sizes in bytes, by name.
pub(crate) fn in_folder(folder: &Path, extension: &str) -> Vec<(PathBuf, u64)> {
    let size = |path: PathBuf| std::fs::metadata(&path).ok().map(|m| (path, m.len()));
    let paths = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|e| e.path());
    let mut all: Vec<_> =
        paths.filter(|p| p.extension().is_some_and(|e| e == extension)).filter_map(size).collect();
    all.sort();
    all
}

/// Removes the files of a folder with this extension that were not used for longest, until the rest fits into `capacity`
/// bytes; never `newest`.
pub(crate) fn prune(newest: &Path, extension: &str, capacity: u64) {
    let Some(folder) = newest.parent() else { return };
    let entry = |e: std::fs::DirEntry| {
        let meta = e.metadata().ok()?;
        Some((meta.modified().ok()?, meta.len(), e.path()))
    };
    let list = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<_> =
        list.filter_map(entry).filter(|f| f.2.extension().is_some_and(|e| e == extension)).collect();
    files.sort();
    let mut total: u64 = files.iter().map(|f| f.1).sum();
    for (_, size, path) in files {
        if total <= capacity || path == newest {
            break;
        }
        if std::fs::remove_file(&path).is_ok() {
            total -= size;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_damaged_or_half_written_is_not_there() {
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

    #[test]
    fn the_least_recently_used_go_first_and_other_files_stay() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for (age, name) in ["old.kept", "used.kept", "new.kept", "other.txt"].iter().enumerate() {
            std::fs::write(at(name), [0; 100]).unwrap();
            let time = SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(age as u64);
            std::fs::File::options().append(true).open(at(name)).unwrap().set_modified(time).unwrap();
        }
        prune(&at("new.kept"), "kept", 250);
        let there: Vec<bool> =
            ["old.kept", "used.kept", "new.kept", "other.txt"].iter().map(|n| at(n).exists()).collect();
        assert_eq!(there, [false, true, true, true]);
        prune(&at("new.kept"), "kept", 0);
        assert!(!at("used.kept").exists() && at("new.kept").exists());
    }
}
