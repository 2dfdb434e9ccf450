//! What stands in the way of cameras for all photos.
use crate::Error;
use crate::choose::Reason;

/// Why there are no cameras for all photos.
#[derive(Debug)]
pub struct Unplaced {
    /// Photos without which the others may have cameras, ascending, each with what is wrong with
    /// it; empty if that is not known.
    pub views: Vec<(usize, Reason)>,
    /// The same in words.
    pub error: Error,
}

impl From<Error> for Unplaced {
    fn from(error: Error) -> Unplaced {
        Unplaced { views: Vec::new(), error }
    }
}

impl From<Unplaced> for Error {
    fn from(unplaced: Unplaced) -> Error {
        unplaced.error
    }
}
