//! Devices for tests, with validation on.
use super::device::Device;
use super::executor::{Attached, Executor};
use super::info::Options;
use super::ways::Way;
use crate::Result;
use std::ops::Deref;
use std::sync::{Arc, OnceLock};

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

    /// A device whose programs are run by an executor, with the shaders for one subgroup size, native float atomics unless
    /// the options say no, and the choices for GPUs. Buffers must be mapped. No validation: nothing is recorded, and the layer
    /// (1.3.239) crashes now and then where one thread opens or closes devices, as tests do by the thousand, while another works.
    pub fn executed_by(
        executor: Box<dyn Executor>,
        subgroup_size: u32,
        options: &Options,
    ) -> Result<TestDevice> {
        let mut device =
            TestDevice(Device::with(&Options { validation: false, cache: None, ..options.clone() })?);
        if let Some(inner) = Arc::get_mut(&mut device.0.0) {
            inner.info.subgroup_size = subgroup_size;
            inner.info.subgroup_sizes = (subgroup_size, subgroup_size);
            inner.info.float_atomics = !options.without.contains(&Way::FloatAtomics);
            inner.info.timestamp_period = 0.0;
            inner.info.is_cpu = false;
            let attached: Attached = executor;
            inner.stand_in = Some(Box::new(attached));
        }
        Ok(device)
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
