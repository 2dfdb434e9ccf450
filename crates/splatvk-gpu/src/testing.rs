//! Devices for tests, with validation on, and a cache for them.
use crate::Result;
use crate::cache::Cache;
use crate::device::Device;
use crate::executor::Executor;
use crate::info::Options;
use crate::sync::lock;
use std::collections::BTreeMap;
use std::io;
use std::ops::Deref;
use std::sync::{Arc, Mutex, OnceLock};

/// A device with validation on. Dropping it fails the test if the layer has reported anything.
pub struct TestDevice(Device);

impl TestDevice {
    /// The device that all tests of a process share. The first call opens it with these options.
    ///
    /// # Panics
    /// If there is no device or no validation layer: such tests fail, they are not skipped.
    #[allow(clippy::panic)]
    pub fn shared(options: &Options) -> TestDevice {
        static SHARED: OnceLock<Result<Device>> = OnceLock::new();
        let opened = SHARED.get_or_init(|| TestDevice::open(options).map(|device| device.0.clone()));
        match opened {
            Ok(device) => TestDevice(device.clone()),
            Err(e) => panic!("tests need a Vulkan device with validation: {e}"),
        }
    }

    /// A device of its own.
    ///
    /// # Errors
    /// Those of [`Device::open`].
    pub fn open(options: &Options) -> Result<TestDevice> {
        Device::open(&Options { validation: true, cache: None, ..options.clone() }).map(TestDevice)
    }

    /// A device whose programs are run by an executor, with the shaders for one subgroup size,
    /// native float atomics unless the options say no, and the choices for GPUs. Buffers must be
    /// mapped. No validation: nothing is recorded, and the layer (1.3.239) crashes now and then
    /// where one thread opens or closes devices, as tests do by the thousand, while another works.
    pub fn executed_by(
        executor: Box<dyn Executor>,
        subgroup_size: u32,
        options: &Options,
    ) -> Result<TestDevice> {
        let mut device =
            TestDevice(Device::open(&Options { validation: false, cache: None, ..options.clone() })?);
        if let Some(inner) = Arc::get_mut(&mut device.0.0) {
            inner.info.subgroup_size = subgroup_size;
            inner.info.subgroup_sizes = (subgroup_size, subgroup_size);
            inner.info.float_atomics = options.allows_float_atomics();
            inner.info.timestamp_period = 0.0;
            inner.info.is_cpu = false;
            inner.stand_in = Some(executor);
        }
        Ok(device)
    }
}

impl Device {
    /// Uses up the time after which a compilation counts as long ([`crate::on_long_compilation`]).
    pub fn expect_long_compilations(&self) {
        self.0.compile_time.use_up();
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

/// A cache that ends with the test.
#[derive(Debug, Default)]
pub struct InMemoryCache(Mutex<BTreeMap<String, Vec<u8>>>);

impl InMemoryCache {
    /// Whether nothing was written.
    pub fn is_empty(&self) -> bool {
        lock(&self.0).is_empty()
    }
}

impl Cache for InMemoryCache {
    fn read(&self, name: &str) -> Option<Vec<u8>> {
        lock(&self.0).get(name).cloned()
    }

    fn write(&self, name: &str, data: &[u8]) -> io::Result<()> {
        lock(&self.0).insert(name.to_owned(), data.to_vec());
        Ok(())
    }
}
