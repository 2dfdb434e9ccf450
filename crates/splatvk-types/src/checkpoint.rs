//! The state of work under way on disk, so that it goes on where it was killed.
use crate::sync::lock;
use crate::{Error, Result, files};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// A place for one state, which the next replaces; reached through
/// [`crate::progress::Progress::checkpoint`].
pub struct Checkpoint {
    file: PathBuf,
    every: Duration,
    last: Mutex<Instant>,
    resume: bool,
    /// The steps that the state on disk has behind it, as far as this process knows; [`UNKNOWN`]
    /// otherwise.
    done: AtomicU64,
}

const UNKNOWN: u64 = u64::MAX;

impl Checkpoint {
    /// A state in `file`, renewed after `every`; an old one is used only with `resume`.
    pub fn new(file: PathBuf, every: Duration, resume: bool) -> Checkpoint {
        Checkpoint { file, every, last: Mutex::new(Instant::now()), resume, done: AtomicU64::new(UNKNOWN) }
    }

    /// The state of an earlier process, if there is one.
    pub fn load<T: DeserializeOwned>(&self) -> Option<T> {
        let bytes = self.resume.then(|| files::read_with_checksum(&self.file))??;
        postcard::from_bytes(&bytes).ok()
    }

    /// What the state on disk, of this process or an earlier one, is a state of; `None` where there
    /// is none.
    pub fn named(&self, stage: &str) -> Option<String> {
        self.file.is_file().then(|| match self.done.load(Ordering::Relaxed) {
            UNKNOWN => format!("the state of stage {stage}"),
            done => format!("stage {stage} after step {done}"),
        })
    }

    /// The state that was loaded has so many steps behind it.
    pub fn went_on_from(&self, done: usize) {
        self.done.store(done as u64, Ordering::Relaxed);
    }

    /// Whether it is time for the next.
    pub fn due(&self) -> bool {
        lock(&self.last).elapsed() >= self.every
    }

    /// Writes the state after `done` steps. A disk that is full costs the next process time, not
    /// this one its result.
    pub fn save<T: Serialize>(&self, done: usize, state: &T) -> Result<()> {
        let bytes = postcard::to_stdvec(state).map_err(|e| Error::work(format!("checkpoint: {e}")))?;
        if files::write_with_checksum(&self.file, &bytes).is_ok() {
            self.done.store(done as u64, Ordering::Relaxed);
        }
        *lock(&self.last) = Instant::now();
        Ok(())
    }

    /// The work is done.
    pub fn remove(&self) {
        // Most work ends before its first checkpoint.
        let _ = std::fs::remove_file(&self.file);
    }
}
