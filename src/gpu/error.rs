//! Vulkan results as errors, and locks that outlive a panic.
use crate::Error;
use ash::vk;
use std::sync::{Mutex, MutexGuard};

/// Turns a Vulkan result into an error that says what was being done, of the kind that it is.
pub(super) fn vk_error(what: impl std::fmt::Display) -> impl FnOnce(vk::Result) -> Error {
    move |e| Error::vulkan(what.to_string(), e)
}

/// Locks, ignoring poison: the guarded values stay consistent, a panic elsewhere is reported by its own thread.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}
