//! The device of the tests.
use super::options::options;
use splatvk_gpu::TestDevice;

/// The device that all tests of a process share, with validation on. `SPLATVK_DEVICE` picks another
/// one than the first.
pub fn test_device() -> TestDevice {
    TestDevice::shared(&options(None))
}
