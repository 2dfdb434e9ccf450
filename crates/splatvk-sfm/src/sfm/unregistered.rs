//! Failure to register all photos.
use crate::Error;
use crate::choose::Reason;

/// Error of a reconstruction that could not register all photos.
#[derive(Debug)]
pub struct Unregistered {
    /// Photos without which the others may be registered, ascending, each with its reason; empty if
    /// unknown.
    pub views: Vec<(usize, Reason)>,
    /// Message for the user.
    pub error: Error,
}

impl From<Error> for Unregistered {
    fn from(error: Error) -> Unregistered {
        Unregistered { views: Vec::new(), error }
    }
}

impl From<Unregistered> for Error {
    fn from(unregistered: Unregistered) -> Error {
        unregistered.error
    }
}
