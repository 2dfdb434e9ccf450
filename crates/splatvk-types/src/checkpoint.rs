//! State of unfinished work on disk, from which a killed process resumes.
use crate::sync::lock;
use crate::{Error, Result, files};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// A file for one state, replaced at each save; reached through
/// [`crate::progress::Progress::checkpoint`].
pub struct Checkpoint {
    file: PathBuf,
    every: Duration,
    last: Mutex<Instant>,
    resume: bool,
    /// Number of finished steps in the state on disk; [`UNKNOWN`] until this process has loaded or
    /// saved one.
    done: AtomicU64,
}

const UNKNOWN: u64 = u64::MAX;

impl Checkpoint {
    /// A state in `file`, saved again after `every`; a state of an earlier process is used only
    /// with `resume`.
    pub fn new(file: PathBuf, every: Duration, resume: bool) -> Checkpoint {
        Checkpoint { file, every, last: Mutex::new(Instant::now()), resume, done: AtomicU64::new(UNKNOWN) }
    }

    /// The state of an earlier process, if there is one.
    pub fn load<T: DeserializeOwned>(&self) -> Option<T> {
        let bytes = self.resume.then(|| files::read_with_checksum(&self.file))??;
        postcard::from_bytes(&bytes).ok()
    }

    /// Description of the state on disk, of this process or an earlier one; `None` without a file.
    pub fn named(&self, stage: &str) -> Option<String> {
        self.file.is_file().then(|| match self.done.load(Ordering::Relaxed) {
            UNKNOWN => format!("the state of stage {stage}"),
            done => format!("stage {stage} after step {done}"),
        })
    }

    /// Records the number of finished steps of the state that was loaded.
    pub fn went_on_from(&self, done: usize) {
        self.done.store(done as u64, Ordering::Relaxed);
    }

    /// Whether the next save is due.
    pub fn due(&self) -> bool {
        lock(&self.last).elapsed() >= self.every
    }

    /// Writes the state after `done` steps. A full disk is no error: the result of this process
    /// does not depend on the file.
    pub fn save<T: Serialize>(&self, done: usize, state: &T) -> Result<()> {
        let bytes = postcard::to_stdvec(state).map_err(|e| Error::work(format!("checkpoint: {e}")))?;
        if files::write_with_checksum(&self.file, &bytes).is_ok() {
            self.done.store(done as u64, Ordering::Relaxed);
        }
        *lock(&self.last) = Instant::now();
        Ok(())
    }

    /// Removes the state once the work is done.
    pub fn remove(&self) {
        // Most work ends before its first checkpoint.
        let _ = std::fs::remove_file(&self.file);
    }
}
