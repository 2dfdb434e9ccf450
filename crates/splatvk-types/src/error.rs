//! The one error type. Every message is a single line: what is wrong, where, and what to do next.
mod system;

pub use system::words;

use std::path::{Path, PathBuf};
use system::advice;

/// Result with the crate's error.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Underlying cause of an error.
pub type Cause = Box<dyn std::error::Error + Send + Sync + 'static>;

/// Errors by how a program may react to them. The message is complete without the cause; [`source`]
/// returns the error of the system or the driver. [`Error::exit_code`] maps an error to the process
/// exit code.
///
/// [`source`]: std::error::Error::source
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// Unusable argument or file of the user: the message names it and states what to do.
    #[error("{0}")]
    Input(String),
    /// A file could not be read, or could not be written for a reason that only the cause
    /// determines.
    #[error("{}: {}{}", path.display(), words(source), advice(source))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// A file cannot be written at a place: the disk is full, or the folder or file system does not
    /// allow it. Nothing half-written stays there; the same work succeeds once there is space, or
    /// elsewhere.
    #[error("{}: cannot be written: {}{}", path.display(), words(source), elsewhere(source))]
    Unwritable {
        /// The file or folder.
        path: PathBuf,
        /// Error of the operating system; its [`kind`](std::io::Error::kind) separates a full disk
        /// from a missing permission.
        source: std::io::Error,
    },
    /// The inference library, a program or another installable part is missing or cannot be used.
    #[error("{0}")]
    Missing(String),
    /// A model, or one of its files, is missing, corrupt or of the wrong type.
    #[error("{message}")]
    MissingModel {
        /// Name in the model table, name of its folder, or path of the file.
        model: String,
        /// The fault and how to get the model.
        message: String,
    },
    /// No Vulkan loader, driver or device that can be used.
    #[error("{message}")]
    NoDevice {
        /// The missing part and how to get it.
        message: String,
        /// The error of the loader or the driver, if there is one.
        source: Option<Cause>,
    },
    /// The Vulkan device was lost: reset by its driver, removed, or asleep. Its contents are gone
    /// and no further call succeeds; a new [`crate::gpu::Device`] may work.
    #[error("Vulkan: {doing}: the device was lost ({source}); {}", after_loss(kept))]
    DeviceLost {
        /// The operation that failed.
        doing: String,
        /// Last state on disk, from which the same run continues with `resume`: "stage splats after
        /// step 120".
        kept: Option<String>,
        /// The driver's error.
        source: Cause,
    },
    /// The Vulkan device or its driver has no memory left.
    #[error(
        "Vulkan: {doing}: {source}; use fewer splats, smaller photos or another device{}",
        once_there_is_memory(kept)
    )]
    OutOfDeviceMemory {
        /// The operation that failed, with its size where one is known.
        doing: String,
        /// As in [`Error::DeviceLost`].
        kept: Option<String>,
        /// The driver's error.
        source: Cause,
    },
    /// The Vulkan driver refused another operation, or the device does not support it.
    #[error("Vulkan: {message}")]
    Gpu {
        /// The refused operation and the reason.
        message: String,
        /// Error of the driver, if the driver was called.
        source: Option<Cause>,
    },
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
    /// Shorthand for [`Error::MissingModel`].
    pub fn missing_model(model: impl std::fmt::Display, message: impl Into<String>) -> Self {
        Error::MissingModel { model: model.to_string(), message: message.into() }
    }
    /// Shorthand for [`Error::NoDevice`] without a cause.
    pub fn no_device(message: impl Into<String>) -> Self {
        Error::NoDevice { message: message.into(), source: None }
    }
    /// Shorthand for [`Error::Gpu`] without a cause.
    pub fn gpu(message: impl Into<String>) -> Self {
        Error::Gpu { message: message.into(), source: None }
    }
    /// Attaches the path to an I/O error: `.map_err(Error::io(path))`. Kinds that occur only in
    /// writing become [`Error::Unwritable`].
    pub fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Error {
        use std::io::ErrorKind as K;
        let path = path.as_ref().to_path_buf();
        move |source| match source.kind() {
            K::StorageFull | K::QuotaExceeded | K::FileTooLarge | K::ReadOnlyFilesystem => {
                Error::Unwritable { path, source }
            }
            _ => Error::Io { path, source },
        }
    }
    /// Attaches the path to an I/O error of writing, of any kind.
    pub fn unwritable(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Error {
        let path = path.as_ref().to_path_buf();
        move |source| Error::Unwritable { path, source }
    }
    /// Adds the last state on disk, unless one is set already.
    pub fn keeping(mut self, last: Option<String>) -> Self {
        if let Error::DeviceLost { kept, .. } | Error::OutOfDeviceMemory { kept, .. } = &mut self
            && kept.is_none()
        {
            *kept = last;
        }
        self
    }
    /// Kind of the error in the log, finer than the exit code.
    pub fn kind(&self) -> &'static str {
        match self {
            Error::Input(_) => "input",
            Error::Io { .. } => "io",
            Error::Unwritable { .. } => "unwritable",
            Error::Missing(_) | Error::MissingModel { .. } => "missing",
            Error::NoDevice { .. } => "no-device",
            Error::DeviceLost { .. } => "device-lost",
            Error::OutOfDeviceMemory { .. } => "memory",
            Error::Gpu { .. } => "gpu",
            Error::Work(_) => "work",
            Error::Cancelled => "cancelled",
        }
    }
    /// Process exit code, by the next step of a script: 2 for bad usage or refused input (change the
    /// command), 3 for a missing part (install it), 4 for a place that cannot be written, also a
    /// full disk (make space), 5 for a lost device or one without memory (try again, or smaller), 1
    /// for another failure while working; 130 when stopped by the user.
    pub fn exit_code(&self) -> u8 {
        match self {
            Error::Input(_) => 2,
            Error::Io { source, .. } if !advice(source).is_empty() => 2,
            Error::Missing(_) | Error::MissingModel { .. } | Error::NoDevice { .. } => 3,
            // A wrong path is a wrong command.
            Error::Unwritable { source, .. } if is_no_place(source) => 2,
            Error::Unwritable { .. } => 4,
            Error::DeviceLost { .. } | Error::OutOfDeviceMemory { .. } => 5,
            Error::Io { .. } | Error::Gpu { .. } | Error::Work(_) => 1,
            Error::Cancelled => 130,
        }
    }
}

#[cfg(feature = "gpu")]
impl From<splatvk_gpu::Error> for Error {
    fn from(error: splatvk_gpu::Error) -> Self {
        use splatvk_gpu::Error as Gpu;
        match error {
            Gpu::NoDevice { message, source } => Error::NoDevice { message, source },
            Gpu::Choice(message) | Gpu::Host(message) | Gpu::TooLarge(message) => Error::Input(message),
            Gpu::NoValidationLayer(message) => Error::Missing(message),
            Gpu::DeviceLost { doing, source } => {
                Error::DeviceLost { doing, kept: None, source: Box::new(source) }
            }
            Gpu::OutOfMemory { doing, source } => {
                Error::OutOfDeviceMemory { doing, kept: None, source: Box::new(source) }
            }
            Gpu::Refused { message, source } => {
                Error::Gpu { message, source: source.map(|s| Box::new(s) as Cause) }
            }
            other => Error::Gpu { message: other.to_string(), source: None },
        }
    }
}

/// Advice for a place that cannot be written.
fn elsewhere(e: &std::io::Error) -> &'static str {
    match advice(e) {
        // "check the name" does not fit a path that was about to be created.
        advice if !advice.is_empty() && !is_no_place(e) => advice,
        _ => "; choose another folder",
    }
}

/// Whether no file can have this path.
fn is_no_place(e: &std::io::Error) -> bool {
    use std::io::ErrorKind as K;
    matches!(e.kind(), K::NotFound | K::NotADirectory | K::IsADirectory)
}

/// Advice after a lost device.
fn after_loss(kept: &Option<String>) -> String {
    match kept {
        Some(last) => format!("the same command with --resume goes on from {last}"),
        None => {
            "try again; if it happens again, update the driver or choose another device with --device".into()
        }
    }
}

/// Advice after device memory ran out, where a state is on disk.
fn once_there_is_memory(kept: &Option<String>) -> String {
    let resume = |last| format!("; once there is memory, the same command with --resume goes on from {last}");
    kept.as_ref().map(resume).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::error::Error as _;
    use std::io::{Error as IoError, ErrorKind};

    #[test]
    fn error_keeps_cause_and_exit_code() {
        let lost = Error::DeviceLost { doing: "step 7".into(), kept: None, source: "lost".into() };
        assert!(lost.source().is_some_and(|s| s.to_string() == "lost"));
        assert!(!lost.to_string().contains("--resume"), "{lost}");
        let lost = lost.keeping(Some("stage splats after step 6".into())).keeping(Some("cameras".into()));
        let text = lost.to_string();
        assert!(
            text.contains("step 7") && text.ends_with("--resume goes on from stage splats after step 6"),
            "{lost}"
        );
        let full = Error::OutOfDeviceMemory { doing: "buffer".into(), kept: None, source: "full".into() };
        assert!(full.to_string().ends_with("or another device"), "{full}");
        let full = full.keeping(Some("cameras".into()));
        assert!(full.to_string().ends_with("--resume goes on from cameras"), "{full}");
        let other = Error::gpu("fence");
        assert_eq!([&lost, &full, &other].map(Error::exit_code), [5, 5, 1]);

        let disk = Error::io("a/b")(IoError::from(ErrorKind::StorageFull));
        assert!(matches!(&disk, Error::Unwritable { path, .. } if path == Path::new("a/b")));
        let cause = disk.source().and_then(|s| s.downcast_ref::<IoError>());
        assert_eq!(cause.map(IoError::kind), Some(ErrorKind::StorageFull));
        assert!(disk.exit_code() == 4 && disk.to_string().contains("free some space"), "{disk}");
        let absent = Error::io("a/b")(IoError::from(ErrorKind::NotFound));
        assert!(matches!(absent, Error::Io { .. }) && absent.exit_code() == 2);
        // A file in the place of a folder, and the reverse, are errors of the user.
        for kind in [ErrorKind::NotADirectory, ErrorKind::IsADirectory] {
            let e = Error::io("a/b")(IoError::from(kind));
            assert!(e.exit_code() == 2 && e.to_string().ends_with("; check the name"), "{e}");
        }
        let none = Error::NoDevice { message: "no loader".into(), source: Some("libvulkan.so.1".into()) };
        assert!(none.exit_code() == 3 && none.source().is_some_and(|s| s.to_string() == "libvulkan.so.1"));
        assert_eq!(Error::missing_model("text", "model text: is missing").exit_code(), 3);
    }

    #[cfg(feature = "gpu")]
    #[test]
    fn gpu_error_keeps_kind_and_cause() {
        use splatvk_gpu::VulkanError;
        let converted =
            |code| Error::from(splatvk_gpu::Error::vulkan("step 7", VulkanError::from_code(code)));
        let lost = converted(-4);
        assert!(matches!(&lost, Error::DeviceLost { doing, kept: None, .. } if doing == "step 7"));
        let cause = lost.source().and_then(|s| s.downcast_ref::<VulkanError>());
        assert_eq!(cause, Some(&VulkanError::from_code(-4)));
        assert!(matches!(converted(-2), Error::OutOfDeviceMemory { .. }));
        assert!(matches!(converted(-3), Error::Gpu { source: Some(_), .. }));
        let unknown = Error::from(splatvk_gpu::Error::Choice("no such device".into()));
        assert_eq!(unknown.exit_code(), 2);
    }
}
