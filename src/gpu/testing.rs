//! Device of the tests.
use super::options::options;
use splatvk_gpu::TestDevice;

/// Device that all tests of a process share, with validation on; `SPLATVK_DEVICE` chooses it.
pub fn test_device() -> TestDevice {
    TestDevice::shared(&options(None))
}
