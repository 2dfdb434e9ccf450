//! Vulkan results as errors.
use crate::Error;
use ash::vk;

/// Turns a Vulkan result into an error that says what was being done, of the kind that it is.
pub(super) fn vk_error(what: impl std::fmt::Display) -> impl FnOnce(vk::Result) -> Error {
    move |e| Error::vulkan(what.to_string(), e)
}
