//! Errors of the library as Python exceptions, one class per kind. The classes are defined in
//! `splatvk/errors.py`, where they derive from Python's own.
use pyo3::prelude::*;
use splatvk::Error;
use std::any::Any;

/// The exception of an error.
pub fn exception(py: Python<'_>, error: &Error) -> PyErr {
    named(py, class(error), error.to_string())
}

/// An exception of a class in `splatvk.errors`.
pub fn named(py: Python<'_>, class: &str, message: String) -> PyErr {
    let made = py.import("splatvk.errors").and_then(|module| module.getattr(class)?.call1((message,)));
    made.map_or_else(|failure| failure, PyErr::from_value)
}

fn class(error: &Error) -> &'static str {
    match error {
        Error::Input(_) => "InputError",
        Error::Io { .. } => "FileError",
        Error::Unwritable { .. } => "UnwritableError",
        Error::Missing(_) => "MissingError",
        Error::MissingModel { .. } => "MissingModelError",
        Error::NoDevice { .. } => "NoDeviceError",
        Error::DeviceLost { .. } => "DeviceLostError",
        Error::OutOfDeviceMemory { .. } => "OutOfDeviceMemoryError",
        Error::Gpu { .. } => "GpuError",
        Error::Work(_) => "WorkError",
        Error::Cancelled => "Cancelled",
        _ => "Error",
    }
}

/// The exception of a panic, a fault of the library.
pub fn internal(py: Python<'_>, panic: &(dyn Any + Send)) -> PyErr {
    let text = panic.downcast_ref::<&str>().map(|t| (*t).to_owned());
    let text = text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
    named(py, "Error", format!("internal error: {text}"))
}
