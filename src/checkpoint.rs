//! The state of work under way on disk, so that it goes on where it was killed.
use crate::{Error, Result, files};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// A place for one state, which the next replaces; reached through [`crate::progress::Progress::checkpoint`].
pub struct Checkpoint {
    file: PathBuf,
    every: Duration,
    last: Mutex<Instant>,
    resume: bool,
}

impl Checkpoint {
    /// A state in `file`, renewed after `every`; an old one is used only with `resume`.
    pub fn new(file: PathBuf, every: Duration, resume: bool) -> Checkpoint {
        Checkpoint { file, every, last: Mutex::new(Instant::now()), resume }
    }

    /// The state of an earlier process, if there is one.
    pub fn load<T: DeserializeOwned>(&self) -> Option<T> {
        let bytes = self.resume.then(|| files::read_with_checksum(&self.file))??;
        postcard::from_bytes(&bytes).ok()
    }

    /// Whether there is a state on disk, of this process or an earlier one.
    pub(crate) fn exists(&self) -> bool {
        self.file.is_file()
    }

    /// Whether it is time for the next.
    pub fn due(&self) -> bool {
        self.last.lock().unwrap_or_else(PoisonError::into_inner).elapsed() >= self.every
    }

    /// Writes the state. A disk that is full costs the next process time, not this one its result.
    pub fn save<T: Serialize>(&self, state: &T) -> Result<()> {
        let bytes = postcard::to_stdvec(state).map_err(|e| Error::work(format!("checkpoint: {e}")))?;
        let _ = files::write_with_checksum(&self.file, &bytes);
        *self.last.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
        Ok(())
    }

    /// The work is done.
    pub(crate) fn remove(&self) {
        // Most work ends before its first checkpoint.
        let _ = std::fs::remove_file(&self.file);
    }
}
