//! Errors, by what a program may do about them.
use ash::vk;
use std::fmt;

/// The result of this crate's functions.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// An error. The message alone is complete; [`source`](std::error::Error::source) gives the text of
/// the loader or driver.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// No Vulkan loader, driver or device can be used.
    #[error("{message}")]
    NoDevice {
        /// The missing part and how to get it.
        message: String,
        /// The error of the loader or the driver, if there is one.
        source: Option<Box<dyn std::error::Error + Send + Sync + 'static>>,
    },
    /// [`Options::choice`](crate::Options::choice) matches no device.
    #[error("{0}")]
    Choice(String),
    /// The validation layer is not installed.
    #[error("{0}")]
    NoValidationLayer(String),
    /// The host's device, or a target on it, cannot be used.
    #[error("{0}")]
    Host(String),
    /// The device was lost: reset by its driver, removed, or asleep. Its buffers are gone. A new
    /// [`Device`](crate::Device) may work.
    #[error("Vulkan: {doing}: the device was lost ({source})")]
    DeviceLost {
        /// The operation that failed.
        doing: String,
        /// The driver's result.
        source: VulkanError,
    },
    /// The device or its driver has no memory left.
    #[error("Vulkan: {doing}: {source}")]
    OutOfMemory {
        /// The operation that failed, with its size where one is known.
        doing: String,
        /// The driver's result.
        source: VulkanError,
    },
    /// A buffer exceeds a limit of the device, however much memory is free.
    #[error("{0}")]
    TooLarge(String),
    /// The driver refused something else, or a recording is wrong.
    #[error("Vulkan: {message}")]
    Refused {
        /// The refused operation and the reason.
        message: String,
        /// The driver's result, if it was asked.
        source: Option<VulkanError>,
    },
}

impl Error {
    /// [`Error::Refused`] without a cause.
    pub fn refused(message: impl Into<String>) -> Self {
        Error::Refused { message: message.into(), source: None }
    }

    /// [`Error::NoDevice`] without a cause.
    pub(crate) fn no_device(message: impl Into<String>) -> Self {
        Error::NoDevice { message: message.into(), source: None }
    }

    /// A `VkResult` as the kind of error that it is; `doing` names the operation.
    pub fn vulkan(doing: impl Into<String>, source: VulkanError) -> Self {
        let doing = doing.into();
        match source.0 {
            vk::Result::ERROR_DEVICE_LOST => Error::DeviceLost { doing, source },
            vk::Result::ERROR_OUT_OF_DEVICE_MEMORY | vk::Result::ERROR_OUT_OF_HOST_MEMORY => {
                Error::OutOfMemory { doing, source }
            }
            _ => Error::Refused { message: format!("{doing}: {source}"), source: Some(source) },
        }
    }
}

/// A `VkResult` that is an error.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct VulkanError(vk::Result);

impl VulkanError {
    /// From the number that Vulkan gives it, such as −4 for `VK_ERROR_DEVICE_LOST`.
    pub fn from_code(code: i32) -> Self {
        VulkanError(vk::Result::from_raw(code))
    }

    /// The number that Vulkan gives it.
    pub fn code(self) -> i32 {
        self.0.as_raw()
    }
}

impl fmt::Display for VulkanError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl fmt::Debug for VulkanError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(&self.0, f)
    }
}

impl std::error::Error for VulkanError {}

/// For `map_err`: a `VkResult` as an error of the operation `doing`.
pub(crate) fn vk_error(doing: impl fmt::Display) -> impl FnOnce(vk::Result) -> Error {
    move |e| Error::vulkan(doing.to_string(), VulkanError(e))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::error::Error as _;

    #[test]
    fn results_become_the_errors_that_programs_react_to() {
        let of = |code: vk::Result| Error::vulkan("step 7", VulkanError(code));
        let lost = of(vk::Result::ERROR_DEVICE_LOST);
        assert!(
            matches!(&lost, Error::DeviceLost { doing, source } if doing == "step 7" && source.code() == -4)
        );
        assert!(lost.source().is_some_and(|s| s.downcast_ref() == Some(&VulkanError::from_code(-4))));
        assert!(matches!(of(vk::Result::ERROR_OUT_OF_DEVICE_MEMORY), Error::OutOfMemory { .. }));
        assert!(matches!(of(vk::Result::ERROR_OUT_OF_HOST_MEMORY), Error::OutOfMemory { .. }));
        let other = of(vk::Result::ERROR_INITIALIZATION_FAILED);
        assert!(matches!(&other, Error::Refused { source: Some(_), .. }));
        assert!(other.to_string().starts_with("Vulkan: step 7: "), "{other}");
    }
}
