//! The one error type. Every message is a single line that says what is wrong, where, and what to do next.
use std::path::{Path, PathBuf};

/// The crate's result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Everything that can go wrong. [`Error::exit_code`] maps it to the process exit code.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// What the user typed or supplied cannot be used: the message names it and says what to do.
    #[error("{0}")]
    Input(String),
    /// A file could not be read or written.
    #[error("{}: {source}{}", path.display(), advice(source))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the operating system said.
        source: std::io::Error,
    },
    /// A model file, the inference library or another installable part is missing or corrupt.
    #[error("{0}")]
    Missing(String),
    /// The Vulkan loader, device or driver refused something.
    #[error("Vulkan: {0}")]
    Gpu(String),
    /// Something failed while working on valid input.
    #[error("{0}")]
    Work(String),
    /// The user stopped the run.
    #[error("stopped; nothing was written")]
    Cancelled,
}

impl Error {
    /// Shorthand for [`Error::Input`].
    pub fn input(message: impl Into<String>) -> Self {
        Error::Input(message.into())
    }
    /// Shorthand for [`Error::Work`].
    pub fn work(message: impl Into<String>) -> Self {
        Error::Work(message.into())
    }
    /// Shorthand for [`Error::Missing`].
    pub fn missing(message: impl Into<String>) -> Self {
        Error::Missing(message.into())
    }
    /// Shorthand for [`Error::Gpu`].
    pub fn gpu(message: impl Into<String>) -> Self {
        Error::Gpu(message.into())
    }
    /// Attaches the path to an I/O error: `.map_err(Error::io(path))`.
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Error {
        let path = path.as_ref().to_path_buf();
        move |source| Error::Io { path, source }
    }
    /// 2 for bad usage, bad input, a missing part or a place that cannot be written (also a full disk); 1 for a failure
    /// while working; 130 when stopped by the user.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Input(_) | Error::Missing(_) => 2,
            Error::Io { source, .. } if !advice(source).is_empty() => 2,
            Error::Io { .. } | Error::Gpu(_) | Error::Work(_) => 1,
            Error::Cancelled => 130,
        }
    }
}

/// What the user can do about an I/O error; empty where only its cause can tell.
fn advice(e: &std::io::Error) -> &'static str {
    use std::io::ErrorKind as K;
    match e.kind() {
        K::StorageFull | K::QuotaExceeded => "; free some space there, or choose a folder on another disk",
        K::FileTooLarge => "; the file size limit (ulimit -f) is too small for this file",
        K::PermissionDenied | K::ReadOnlyFilesystem => "; choose a folder that you may write to",
        K::NotFound => "; check the name",
        _ => "",
    }
}
