//! Devices of the tests.
use super::options::options;
use splatvk_gpu::TestDevice;
#[cfg(test)]
use splatvk_gpu::{Executor, Op};

/// Device that all tests of a process share, with validation on; `SPLATVK_DEVICE` chooses it.
pub fn test_device() -> TestDevice {
    TestDevice::shared(&options(None))
}

/// Runs nothing: commands and buffers count, not their content.
#[cfg(test)]
struct Idle;

#[cfg(test)]
impl Executor for Idle {
    fn run(&self, _: &[&Op]) -> Result<(), String> {
        Ok(())
    }
}

/// A device with the choices for GPUs that runs nothing.
#[cfg(test)]
pub(crate) fn idle_device() -> TestDevice {
    TestDevice::executed_by(Box::new(Idle), 32, &options(None)).expect("a device")
}
