//! Devices for tests, with validation on.
use super::device::Device;
use super::info::Options;
use crate::Result;
use std::ops::Deref;
use std::sync::OnceLock;

/// The device that all tests of a process share, with validation on. Dropping the handle fails the test if the layer has
/// said anything so far.
pub struct TestDevice(Device);

/// See [`TestDevice`]. `SPLATVK_DEVICE` picks another device than the first.
#[allow(clippy::panic)] // for tests only: a missing device or layer must fail them, not skip them
pub fn test_device() -> TestDevice {
    static SHARED: OnceLock<Result<Device>> = OnceLock::new();
    let opened =
        SHARED.get_or_init(|| TestDevice::with(&Options::from_env(None)).map(|device| device.0.clone()));
    match opened {
        Ok(device) => TestDevice(device.clone()),
        Err(e) => panic!("tests need a Vulkan device with validation: {e}"),
    }
}

impl TestDevice {
    /// A device of its own for tests that need other options than the shared one.
    pub fn with(options: &Options) -> Result<TestDevice> {
        Device::with(&Options { validation: true, cache: None, ..options.clone() }).map(TestDevice)
    }
}

impl Deref for TestDevice {
    type Target = Device;
    fn deref(&self) -> &Device {
        &self.0
    }
}

impl Drop for TestDevice {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.0.assert_no_validation_messages();
        }
    }
}
