//! The logical device and everything that lives as long as it.
use crate::Result;
use crate::cache::{Cache, Driver};
use crate::compile_time::CompileTime;
use crate::counts::Transfers;
use crate::error::vk_error;
use crate::executor::Executor;
use crate::info::DeviceInfo;
use crate::memory::{Heap, Memory};
use crate::module::Module;
use crate::native::Native;
use crate::pipeline::Pipeline;
use crate::staging::Staging;
use crate::sync::lock;
use crate::validation::Sink;
use ash::vk;
use std::collections::{BTreeSet, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// Runs a closure while nothing else uses the host's queue.
pub type QueueLock = Box<dyn Fn(&mut dyn FnMut()) + Send + Sync>;

/// A logical device, made by us or by the host, ready for [`Device::assemble`].
pub(crate) struct Setup {
    pub instance: ash::Instance,
    pub device: ash::Device,
    pub info: DeviceInfo,
    pub queue: vk::Queue,
    pub queue_family: u32,
    /// synchronization2 comes from the extension instead of Vulkan 1.3.
    pub sync2_extension: bool,
    pub timeline: bool,
    pub queue_lock: Option<QueueLock>,
    pub owned: bool,
    pub cache: Option<Arc<dyn Cache>>,
    pub natives: &'static [Native],
}

/// A Vulkan device; clones share it.
#[derive(Clone)]
pub struct Device(pub(crate) Arc<Inner>);

pub(crate) struct Inner {
    pub info: DeviceInfo,
    pub device: ash::Device,
    pub queue_family: u32,
    pub queue: Mutex<vk::Queue>,
    /// Keeps the host off a queue that it shares with us.
    pub queue_lock: Option<QueueLock>,
    /// Timeline semaphores may be used.
    pub timeline: bool,
    /// Device and instance are ours to destroy.
    pub owned: bool,
    pub heap: Heap,
    submissions: AtomicU64,
    pub transfers: Transfers,
    /// Runs programs instead of the queue, in tests.
    pub stand_in: Option<Box<dyn Executor>>,
    /// Native code in place of shaders.
    pub natives: &'static [Native],
    /// The submission from which on the device is lost.
    #[cfg(feature = "testing")]
    lost_from: AtomicU64,
    /// Locked while something is submitted, so that what waits in it keeps its place in the queue.
    pub staging: Mutex<Staging>,
    /// By name and code: modules of a program may share a name with the engine's.
    pipelines: Mutex<HashMap<(&'static str, usize), Arc<Pipeline>>>,
    pub compile_time: CompileTime,
    pipeline_cache: vk::PipelineCache,
    driver: Driver,
    cache: Option<Arc<dyn Cache>>,
    /// Set where synchronization2 comes from the extension instead of Vulkan 1.3.
    sync2: Option<ash::khr::synchronization2::Device>,
    messenger: Option<(ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    instance: ash::Instance,
    sink: Option<Sink>,
    /// Keeps the loader library open.
    _entry: ash::Entry,
}

impl Device {
    /// Adds this crate's part to a logical device. On failure the device is destroyed if it is
    /// ours; the instance stays with the caller.
    pub(crate) fn assemble(
        entry: ash::Entry,
        physical: vk::PhysicalDevice,
        sink: Option<Sink>,
        setup: Setup,
    ) -> Result<Device> {
        let Setup { instance, device, mut info, queue, queue_family, timeline, queue_lock, owned, .. } =
            setup;
        let sync2 =
            setup.sync2_extension.then(|| ash::khr::synchronization2::Device::new(&instance, &device));
        // SAFETY: the physical device belongs to the instance.
        let driver = Driver::new(&unsafe { instance.get_physical_device_properties(physical) });
        let cache = setup.cache;
        let finish = || -> Result<(vk::PipelineCache, Heap)> {
            let kept = cache.as_ref().map(|c| driver.pipelines(c.as_ref())).unwrap_or_default();
            let create = |data: &[u8]| {
                let info = vk::PipelineCacheCreateInfo::default().initial_data(data);
                // SAFETY: the device is alive; the data is what its driver gave, by checksum and
                // header, or empty.
                unsafe { device.create_pipeline_cache(&info, None) }
            };
            let pipelines = create(&kept).or_else(|_| create(&[])).map_err(vk_error("pipeline cache"))?;
            Heap::new(&instance, &device, physical).map(|heap| (pipelines, heap)).inspect_err(|_| {
                // SAFETY: the cache was never used.
                unsafe { device.destroy_pipeline_cache(pipelines, None) };
            })
        };
        let (pipeline_cache, heap) = match finish() {
            Ok(parts) => parts,
            Err(e) => {
                if owned {
                    // SAFETY: the device has no other user.
                    unsafe { device.destroy_device(None) };
                }
                return Err(e);
            }
        };
        // Native code works on mapped buffers, and is faster where the device is the processor.
        let natives: &[Native] = if info.is_cpu && info.mapped { setup.natives } else { &[] };
        if natives.is_empty() {
            info.max_buffer = info.max_storage_range;
        }
        let messenger = sink.as_ref().and_then(|sink| {
            let debug = ash::ext::debug_utils::Instance::new(&entry, &instance);
            // SAFETY: the sink outlives the messenger (see Drop).
            let raw = unsafe { debug.create_debug_utils_messenger(&sink.messenger_info(), None) }.ok()?;
            Some((debug, raw))
        });
        Ok(Device(Arc::new(Inner {
            info,
            device,
            queue_family,
            queue: Mutex::new(queue),
            queue_lock,
            timeline,
            owned,
            heap,
            submissions: AtomicU64::new(0),
            transfers: Transfers::default(),
            stand_in: None,
            natives,
            #[cfg(feature = "testing")]
            lost_from: AtomicU64::new(u64::MAX),
            staging: Mutex::default(),
            pipelines: Mutex::new(HashMap::new()),
            compile_time: CompileTime::new(),
            pipeline_cache,
            driver,
            cache,
            sync2,
            messenger,
            instance,
            sink,
            _entry: entry,
        })))
    }

    /// Disables these kernel variants and no others, for each process that opens this device with
    /// its driver and this cache ([`crate::Options::cache`]).
    ///
    /// # Errors
    /// Those of the cache.
    pub fn disable(&self, cache: &dyn Cache, names: &BTreeSet<String>) -> std::io::Result<()> {
        self.0.driver.disable(cache, names)
    }

    /// Prefers these kernel variants to the defaults, for each process that opens this device with
    /// its driver and this cache; `None` forgets them.
    ///
    /// # Errors
    /// Those of the cache.
    pub fn prefer(&self, cache: &dyn Cache, names: Option<&BTreeSet<String>>) -> std::io::Result<()> {
        self.0.driver.prefer(cache, names)
    }

    /// Preferred kernel variants that a cache keeps for this device and driver; `None` without any.
    pub fn preferred(&self, cache: &dyn Cache) -> Option<BTreeSet<String>> {
        self.0.driver.preferred(cache)
    }

    /// Names of the shaders that were run so far.
    #[cfg(feature = "testing")]
    pub fn shaders_run(&self) -> BTreeSet<&'static str> {
        lock(&self.0.pipelines).keys().map(|key| key.0).collect()
    }

    /// The device's properties, limits and features.
    pub fn info(&self) -> &DeviceInfo {
        &self.0.info
    }

    /// Memory of all buffers made on this device.
    pub fn memory(&self) -> Memory {
        self.0.heap.figures()
    }

    /// Submissions to the queue so far: a call of the driver each, and nearly always a wait.
    pub fn submissions(&self) -> u64 {
        self.0.submissions.load(Ordering::Relaxed)
    }

    /// Makes the driver say, after so many more submissions, that the device is lost.
    #[cfg(feature = "testing")]
    pub fn lose_after(&self, submissions: u64) {
        self.0.lost_from.store(self.submissions() + submissions, Ordering::Relaxed);
    }

    /// Makes the driver say, after so many more buffers, that the device has no memory left.
    #[cfg(feature = "testing")]
    pub fn exhaust_after(&self, buffers: u64) {
        self.0.heap.exhaust_after(buffers);
    }

    /// Starts measuring [`Memory::peak`] anew.
    pub fn reset_peak_memory(&self) {
        self.0.heap.reset_peak();
    }

    #[cfg(test)]
    pub(crate) fn driver(&self) -> Driver {
        self.0.driver.clone()
    }

    /// Messages of the validation layer so far; always empty without validation.
    pub fn validation_messages(&self) -> Vec<String> {
        self.0.sink.as_ref().map(Sink::messages).unwrap_or_default()
    }

    /// For tests: panics with the messages if the validation layer has said anything.
    #[doc(hidden)]
    #[allow(clippy::panic)] // this is an assertion
    pub fn assert_no_validation_messages(&self) {
        let messages = self.validation_messages();
        assert!(messages.is_empty(), "Vulkan validation:\n{}", messages.join("\n"));
    }

    /// The pipeline of a module, made on first use (20–300 ms on lavapipe).
    pub(crate) fn pipeline(&self, module: &'static Module) -> Result<Arc<Pipeline>> {
        let mut known = lock(&self.0.pipelines);
        let key = (module.name, module.spirv.as_ptr() as usize);
        if let Some(pipeline) = known.get(&key) {
            return Ok(pipeline.clone());
        }
        let info = self.info();
        let make = || Pipeline::new(&self.0.device, info, self.0.pipeline_cache, module);
        let made = Arc::new(self.0.compile_time.during(&info.name, make)?);
        known.insert(key, made.clone());
        Ok(made)
    }

    /// Records with synchronization2, wherever it comes from.
    pub(crate) fn cmd_barrier(&self, commands: vk::CommandBuffer, dependency: &vk::DependencyInfo<'_>) {
        // SAFETY: the caller records `commands`, and synchronization2 is enabled on every device
        // opened.
        unsafe {
            match &self.0.sync2 {
                Some(extension) => extension.cmd_pipeline_barrier2(commands, dependency),
                None => self.0.device.cmd_pipeline_barrier2(commands, dependency),
            }
        }
    }

    /// Submits; the fence is unsignalled and ours.
    pub(crate) fn queue_submit(
        &self,
        infos: &[vk::SubmitInfo<'_>],
        fence: vk::Fence,
    ) -> std::result::Result<(), vk::Result> {
        let _number = self.0.submissions.fetch_add(1, Ordering::Relaxed);
        #[cfg(feature = "testing")]
        if _number >= self.0.lost_from.load(Ordering::Relaxed) {
            return Err(vk::Result::ERROR_DEVICE_LOST);
        }
        let queue = lock(&self.0.queue);
        let mut outcome = Ok(());
        // SAFETY: our threads are kept apart by the lock, the host's by `queue_lock` or its promise
        // (see HostDevice).
        let mut submit = || outcome = unsafe { self.0.device.queue_submit(*queue, infos, fence) };
        match &self.0.queue_lock {
            Some(host) => host(&mut submit),
            None => submit(),
        }
        outcome
    }
}

impl std::fmt::Debug for Device {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Device({})", self.info().name)
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: buffers and programs hold the device, so only the parts below are left, and
        // nothing runs: every submit waits.
        unsafe {
            if self.owned {
                // Every submit was waited for; this is for what a driver may do on its own. On the
                // host's device it would take all of the host's queues.
                let _ = self.device.device_wait_idle();
            }
            if let Some(cache) = &self.cache
                && let Ok(data) = self.device.get_pipeline_cache_data(self.pipeline_cache)
            {
                self.driver.keep_pipelines(cache.as_ref(), &data);
            }
            for (_, pipeline) in lock(&self.pipelines).drain() {
                pipeline.destroy(&self.device);
            }
            self.device.destroy_pipeline_cache(self.pipeline_cache, None);
            lock(&self.staging).close(&self.device, &self.heap);
            self.heap.close();
            if !self.owned {
                return;
            }
            self.device.destroy_device(None);
            if let Some((debug, messenger)) = self.messenger.take() {
                debug.destroy_debug_utils_messenger(messenger, None);
            }
            self.instance.destroy_instance(None);
        }
    }
}
