//! The Vulkan device of the process, opened by the first call that needs one.
use crate::errors;
use pyo3::prelude::*;
use splatvk::gpu::{self, Device};
use std::sync::{Mutex, MutexGuard, PoisonError};

struct Opened {
    choice: Option<String>,
    process: u32,
    device: Device,
}

static OPENED: Mutex<Option<Opened>> = Mutex::new(None);

fn opened() -> MutexGuard<'static, Option<Opened>> {
    OPENED.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The process that a device was opened in. Vulkan does not survive a fork: calls in the child
/// would wait for threads that it does not have.
#[derive(Clone, Copy, PartialEq)]
pub struct Process(u32);

impl Process {
    pub fn current() -> Process {
        Process(std::process::id())
    }

    /// Refuses a call in a forked child.
    pub fn check(self, py: Python<'_>) -> PyResult<()> {
        if self == Process::current() {
            return Ok(());
        }
        Err(errors::named(
            py,
            "ForkError",
            "this process was forked after splatvk had opened its Vulkan device, which the child cannot use; \
             start processes with multiprocessing.get_context(\"spawn\")"
                .to_owned(),
        ))
    }
}

/// The device of a choice; a device that is already open serves `None`.
pub fn device(py: Python<'_>, choice: Option<&str>) -> PyResult<Device> {
    if let Some(open) = opened().as_ref() {
        Process(open.process).check(py)?;
        if choice.is_none() || choice == open.choice.as_deref() {
            return Ok(open.device.clone());
        }
    }
    let choice = choice.map(str::to_owned);
    let device = crate::work::unobserved(py, || gpu::open(choice.as_deref()))?;
    *opened() = Some(Opened { choice, process: std::process::id(), device: device.clone() });
    Ok(device)
}

/// Name of the Vulkan device, which is opened if none is.
#[pyfunction]
#[pyo3(signature = (choice = None))]
pub fn device_name(py: Python<'_>, choice: Option<&str>) -> PyResult<String> {
    Ok(device(py, choice)?.info().name.clone())
}

/// Closes the device as soon as no scene uses it any more; the next call opens one anew.
#[pyfunction]
pub fn close_device() {
    *opened() = None;
}
