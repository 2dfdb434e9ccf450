//! The folder of a batch: results, failures, attempts and events.
//!
//! `ID/` is a finished row, `_failed/ID.json` and `.log` the last failure of another one,
//! `_attempts` holds unfinished work, and `events.jsonl` is only appended to.
use super::child::Ending;
use crate::files::{self, Partial, swap};
use crate::sync::lock;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{SystemTime, UNIX_EPOCH};

/// File of a finished row, written last.
pub const SUCCESS: &str = "_SUCCESS.json";
const FAILED: &str = "_failed";
const ATTEMPTS: &str = "_attempts";

/// Kinds of failures, by the use of another attempt.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FailureKind {
    /// The input or the options are unusable; another attempt would end alike.
    Refused,
    /// A device, a model or a library is missing.
    Missing,
    /// A place cannot be written.
    Unwritable,
    /// The device has no memory left.
    Memory,
    /// The device was lost, or another program ended the process.
    Transient,
    /// The attempt took longer than allowed.
    Timeout,
    /// Another failure while working.
    Failed,
}

impl FailureKind {
    /// As in the files.
    pub fn name(self) -> &'static str {
        match self {
            FailureKind::Refused => "refused",
            FailureKind::Missing => "missing",
            FailureKind::Unwritable => "unwritable",
            FailureKind::Memory => "memory",
            FailureKind::Transient => "transient",
            FailureKind::Timeout => "timeout",
            FailureKind::Failed => "failed",
        }
    }
}

/// The last failure of a row.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Failure {
    /// Row.
    pub id: String,
    /// Key of the row; empty where it is not known.
    pub key: String,
    /// Kind.
    pub kind: FailureKind,
    /// Reason.
    pub message: String,
    /// Exit code of the attempt; `None` if a signal ended it.
    pub exit_code: Option<u8>,
    /// Attempts in this batch.
    pub attempts: usize,
}

impl Failure {
    /// Failure of an attempt; `None` for one that is done or was stopped.
    pub fn of(id: &str, key: &str, attempts: usize, ending: &Ending) -> Option<Failure> {
        let (kind, message, exit_code) = match ending {
            Ending::Done | Ending::Stopped => return None,
            Ending::TimedOut => (FailureKind::Timeout, "took longer than --timeout".to_owned(), None),
            Ending::Killed(signal) => {
                (FailureKind::Transient, format!("signal {signal} ended the process"), None)
            }
            Ending::Failed { code, message, kind } => {
                let kind = match (code, kind.as_str()) {
                    (2, _) => FailureKind::Refused,
                    (3, _) => FailureKind::Missing,
                    (4, _) => FailureKind::Unwritable,
                    (5, "memory") => FailureKind::Memory,
                    (5, _) => FailureKind::Transient,
                    _ => FailureKind::Failed,
                };
                (kind, message.clone(), Some(*code))
            }
        };
        let (id, key) = (id.to_owned(), key.to_owned());
        Some(Failure { id, key, kind, message, exit_code, attempts })
    }
}

/// The folder of a batch.
pub struct Store {
    root: PathBuf,
    /// Open for appending while a batch works.
    events: Mutex<Option<File>>,
}

/// A row or a file that this process works on; others find it locked.
pub struct Claim {
    file: File,
    path: PathBuf,
}

impl Drop for Claim {
    fn drop(&mut self) {
        // While it is locked: whoever opened it before looks again.
        let _ = std::fs::remove_file(&self.path);
        let _ = self.file.unlock();
    }
}

impl Store {
    /// The folder at a place, which may not exist yet.
    pub fn at(root: &Path) -> Result<Store> {
        let root = std::path::absolute(root).map_err(Error::io(root))?;
        Ok(Store { root, events: Mutex::new(None) })
    }

    /// Makes the folder, with `events` as the name of the file for events.
    pub fn open(&self, events: &str) -> Result<()> {
        for folder in [self.root.clone(), self.root.join(FAILED), self.root.join(ATTEMPTS)] {
            std::fs::create_dir_all(&folder).map_err(Error::unwritable(&folder))?;
        }
        let path = self.root.join(events);
        let file = OpenOptions::new().create(true).append(true).open(&path);
        *lock(&self.events) = Some(file.map_err(Error::unwritable(&path))?);
        Ok(())
    }

    /// Appends an event; the time is in seconds since 1970.
    pub fn event(&self, event: &str, mut fields: Value) -> Result<()> {
        fields["event"] = event.into();
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        fields["time"] = ((now.as_secs_f64() * 1e3).round() / 1e3).into();
        let line = format!("{fields}\n");
        match lock(&self.events).as_mut() {
            Some(file) => file.write_all(line.as_bytes()).map_err(Error::unwritable(&self.root)),
            None => Ok(()),
        }
    }

    /// Free bytes of the file system.
    pub fn free(&self) -> Option<u64> {
        let found = rustix::fs::statvfs(&self.root).ok()?;
        Some(found.f_bavail.saturating_mul(found.f_frsize))
    }

    /// Folder of a finished row.
    pub fn place(&self, id: &str) -> PathBuf {
        self.root.join(id)
    }

    /// Refuses a place where something else than a result is.
    pub fn check_place(&self, id: &str) -> Result<()> {
        let place = self.place(id);
        if place.symlink_metadata().is_err() || place.join(SUCCESS).is_file() {
            return Ok(());
        }
        Err(Error::input(format!(
            "{}: exists and is no result of a batch; move it away, or choose another --out",
            place.display()
        )))
    }

    /// Folder and log of an attempt.
    pub fn attempt(&self, id: &str, key: &str, number: usize) -> (PathBuf, PathBuf) {
        let name = format!("{id}-{}-{number}", key.get(..16).unwrap_or(key));
        let folder = self.root.join(ATTEMPTS);
        (folder.join(&name), folder.join(format!("{name}.log")))
    }

    /// `_SUCCESS.json` of a row, if it is finished.
    pub fn success(&self, id: &str) -> Option<Value> {
        serde_json::from_slice(&std::fs::read(self.place(id).join(SUCCESS)).ok()?).ok()
    }

    /// The last failure of a row that is not finished since.
    pub fn failure(&self, id: &str) -> Option<Failure> {
        serde_json::from_slice(&std::fs::read(self.failed(id, "json")).ok()?).ok()
    }

    fn failed(&self, id: &str, ending: &str) -> PathBuf {
        self.root.join(FAILED).join(format!("{id}.{ending}"))
    }

    /// Locks a row against other processes and removes what a killed one has left; `None` if
    /// another process has it.
    pub fn claim(&self, id: &str) -> Result<Option<Claim>> {
        let claim = self.lock(id, false)?;
        claim.is_some().then(|| self.sweep(id)).transpose()?;
        Ok(claim)
    }

    /// Does short work on files of all rows while no other process of the batch does.
    pub fn alone<T>(&self, work: impl FnOnce() -> Result<T>) -> Result<T> {
        // No row has this name.
        let _claim = self.lock("_files", true)?;
        work()
    }

    /// Locks a name; unless it is to wait, `None` if another process has it.
    fn lock(&self, name: &str, wait: bool) -> Result<Option<Claim>> {
        let path = self.root.join(ATTEMPTS).join(format!("{name}.lock"));
        loop {
            let file = OpenOptions::new().create(true).truncate(false).write(true).open(&path);
            let file = file.map_err(Error::unwritable(&path))?;
            match file.try_lock() {
                Ok(()) => {}
                Err(std::fs::TryLockError::WouldBlock) if wait => file.lock().map_err(Error::io(&path))?,
                Err(std::fs::TryLockError::WouldBlock) => return Ok(None),
                Err(std::fs::TryLockError::Error(e)) => return Err(Error::io(&path)(e)),
            }
            // Its last owner may have removed it between the two calls.
            let same = |a: std::fs::Metadata, b: std::fs::Metadata| (a.dev(), a.ino()) == (b.dev(), b.ino());
            if let (Ok(a), Ok(b)) = (file.metadata(), path.metadata())
                && same(a, b)
            {
                return Ok(Some(Claim { file, path }));
            }
        }
    }

    /// Removes the attempts of a row.
    fn sweep(&self, id: &str) -> Result<()> {
        let folder = self.root.join(ATTEMPTS);
        for entry in std::fs::read_dir(&folder).map_err(Error::io(&folder))?.flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            // ID-KEY16-N, and ID-KEY16-N.log; ids have dashes, too.
            let mut parts = name.rsplitn(3, '-');
            let (_, key) = (parts.next(), parts.next());
            if parts.next() == Some(id)
                && key.is_some_and(|k| k.len() == 16 && k.bytes().all(|b| b.is_ascii_hexdigit()))
            {
                remove(&entry.path())?;
            }
        }
        Ok(())
    }

    /// Moves a finished attempt to its place; an older result is replaced whole.
    pub fn publish(&self, id: &str, attempt: &Path, log: &Path) -> Result<()> {
        self.check_place(id)?;
        let place = self.place(id);
        let unwritable = Error::unwritable(&place);
        let moved = std::fs::rename(log, attempt.join("log.jsonl"));
        moved.map_err(Error::unwritable(log))?;
        if place.symlink_metadata().is_err() {
            std::fs::rename(attempt, &place).map_err(unwritable)?;
        } else {
            let mut aside = attempt.as_os_str().to_owned();
            aside.push(".old");
            let aside = PathBuf::from(aside);
            swap(attempt, &place, &aside).map_err(unwritable)?;
            remove(attempt)?;
            remove(&aside)?;
        }
        files::note_finished();
        self.forget_failure(id)
    }

    /// Removes the record of the last failure.
    pub fn forget_failure(&self, id: &str) -> Result<()> {
        ["json", "log"].iter().try_for_each(|ending| remove(&self.failed(id, ending)))
    }

    /// Keeps the failure of a row with its log, and removes the attempt.
    pub fn fail(&self, failure: &Failure, attempt: Option<(&Path, &Path)>) -> Result<()> {
        let place = self.failed(&failure.id, "json");
        if let Some((folder, log)) = attempt {
            let kept = self.failed(&failure.id, "log");
            std::fs::rename(log, &kept).map_err(Error::unwritable(kept))?;
            remove(folder)?;
        }
        let text = format!("{:#}\n", json!(failure));
        self.alone(|| write(&place, text.as_bytes()))
    }

    /// Writes a file of the batch whole.
    pub fn write(&self, name: &str, text: &[u8]) -> Result<()> {
        write(&self.root.join(name), text)
    }
}

/// Writes a file whole, or not at all.
pub fn write(place: &Path, text: &[u8]) -> Result<()> {
    let partial = Partial::beside(place)?;
    std::fs::write(partial.path(), text).map_err(Error::unwritable(place))?;
    partial.keep(|from| std::fs::rename(from, place)).map_err(Error::unwritable(place))
}

/// Removes a file or a folder, if it is there.
pub fn remove(path: &Path) -> Result<()> {
    let outcome = if path.is_dir() && !path.is_symlink() {
        std::fs::remove_dir_all(path)
    } else {
        std::fs::remove_file(path)
    };
    match outcome {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(Error::unwritable(path)(e)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEY: &str = "0123456789abcdef0123";

    fn attempt(store: &Store, id: &str, key: &str) -> (PathBuf, PathBuf) {
        let (folder, log) = store.attempt(id, key, 1);
        std::fs::create_dir(&folder).unwrap();
        std::fs::write(folder.join(SUCCESS), format!("{{\"key\": \"{key}\"}}")).unwrap();
        std::fs::write(&log, "log").unwrap();
        (folder, log)
    }

    fn names(folder: &Path) -> Vec<String> {
        let mut all: Vec<_> = std::fs::read_dir(folder)
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .collect();
        all.sort();
        all
    }

    #[test]
    fn results_are_replaced_whole_and_foreign_folders_stay() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::at(folder.path()).unwrap();
        store.open("events.jsonl").unwrap();
        let missing = Ending::Failed { code: 3, message: "no device".into(), kind: String::new() };
        let failure = Failure::of("a", KEY, 1, &missing).unwrap();
        store.fail(&failure, None).unwrap();
        assert_eq!(store.failure("a").unwrap().kind, FailureKind::Missing);
        for key in [KEY, "fedcba9876543210"] {
            let (attempt, log) = attempt(&store, "a", key);
            store.publish("a", &attempt, &log).unwrap();
            assert_eq!(store.success("a").unwrap()["key"], key);
        }
        assert!(store.failure("a").is_none() && names(&folder.path().join(ATTEMPTS)).is_empty());
        assert_eq!(names(&store.place("a")), [SUCCESS, "log.jsonl"]);

        std::fs::create_dir(store.place("b")).unwrap();
        std::fs::write(store.place("b").join("letter"), "precious").unwrap();
        let (attempt, log) = attempt(&store, "b", KEY);
        let error = store.publish("b", &attempt, &log).unwrap_err();
        assert!(error.exit_code() == 2 && error.to_string().contains("no result of a batch"), "{error}");
        assert_eq!(names(&store.place("b")), ["letter"]);
    }

    #[test]
    fn claim_is_exclusive_and_sweeps_attempts_of_its_row_alone() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::at(folder.path()).unwrap();
        store.open("events.jsonl").unwrap();
        attempt(&store, "a", KEY);
        attempt(&store, "a-b", KEY);
        let claim = store.claim("a").unwrap().unwrap();
        assert!(store.claim("a").unwrap().is_none());
        let left = names(&folder.path().join(ATTEMPTS));
        assert_eq!(left, ["a-b-0123456789abcdef-1", "a-b-0123456789abcdef-1.log", "a.lock"]);
        drop(claim);
        assert!(store.claim("a").unwrap().is_some());
        assert!(!names(&folder.path().join(ATTEMPTS)).contains(&"a.lock".to_owned()));
    }

    #[test]
    fn tables_are_written_one_after_the_other() {
        let folder = tempfile::tempdir().unwrap();
        Store::at(folder.path()).unwrap().open("events.jsonl").unwrap();
        std::thread::scope(|scope| {
            for shard in 0..4 {
                let place = folder.path();
                scope.spawn(move || {
                    let store = Store::at(place).unwrap();
                    for _ in 0..50 {
                        store.alone(|| store.write("summary.csv", &[b'0' + shard; 1000])).unwrap();
                    }
                });
            }
        });
        let table = std::fs::read(folder.path().join("summary.csv")).unwrap();
        assert!(table.len() == 1000 && table.iter().all(|b| *b == table[0]));
        assert_eq!(names(folder.path()), ["_attempts", "_failed", "events.jsonl", "summary.csv"]);
    }
}
