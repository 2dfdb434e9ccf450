//! The logical device and everything that lives as long as it.
use super::adopt::QueueLock;
use super::module::{Call, Capability, Module};
use super::pipeline::Pipeline;
use super::select;
use super::validation::Sink;
use crate::{Error, Result};
use ash::vk;
use gpu_allocator::vulkan::{Allocator, AllocatorCreateDesc};
use std::collections::{BTreeSet, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

/// How a device is opened.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Index in the order of preference, or part of the name; `None` takes the first usable one.
    pub choice: Option<String>,
    /// Khronos validation layer with synchronization validation.
    pub validation: bool,
    /// Keep buffers out of host-visible memory, as on a GPU, even on a CPU device (to test the staging path).
    pub staging: bool,
    /// Only passes that give the same bits on every run of this device, even where others are faster.
    pub deterministic: bool,
    /// No buffer larger than this, bytes, although the device would bind more: to test what is done in blocks.
    pub max_binding: Option<u64>,
    /// Use the compare-and-swap loop although the device has float atomics (to test it).
    pub no_float_atomics: bool,
}

impl Options {
    /// `choice` or else `SPLATVK_DEVICE`; validation when `SPLATVK_VALIDATION` is `1`; `SPLATVK_MAX_BINDING` in MiB.
    pub fn from_env(choice: Option<&str>) -> Self {
        let variable = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
        Options {
            choice: choice.map(str::to_owned).or_else(|| variable("SPLATVK_DEVICE")),
            validation: variable("SPLATVK_VALIDATION").is_some_and(|v| v == "1"),
            max_binding: variable("SPLATVK_MAX_BINDING")
                .and_then(|v| v.parse::<u64>().ok())
                .map(|mib| mib.saturating_mul(1 << 20)),
            ..Options::default()
        }
    }
}

/// What the device is and can do.
#[derive(Clone, Debug)]
pub struct DeviceInfo {
    /// As the driver reports it.
    pub name: String,
    /// Driver name and version.
    pub driver: String,
    /// Vulkan version of the device: major, minor, patch.
    pub api_version: (u32, u32, u32),
    /// A software device on the CPU.
    pub is_cpu: bool,
    /// Buffers are mapped directly instead of staged.
    pub mapped: bool,
    /// Default subgroup size.
    pub subgroup_size: u32,
    /// Smallest and largest size that can be pinned; both `subgroup_size` without subgroup size control.
    pub subgroup_sizes: (u32, u32),
    /// Subgroup sizes can be pinned per pipeline.
    pub subgroup_control: bool,
    /// Asked to give the same bits on every run ([`Options::deterministic`]).
    pub deterministic: bool,
    /// `atomicAdd` on float in storage buffers is native.
    pub float_atomics: bool,
    /// Capabilities that shaders may use here.
    pub capabilities: BTreeSet<Capability>,
    /// Largest buffer a shader can see, bytes.
    pub max_storage_range: u64,
    /// Memory of the largest heap that is the device's own, bytes.
    pub memory: u64,
    /// Largest dispatch, in workgroups.
    pub max_groups: [u32; 3],
    /// Threads in a workgroup at most.
    pub max_workgroup_threads: u32,
    /// Shared memory per workgroup, bytes.
    pub shared_memory: u32,
    /// Storage buffers in one shader at most.
    pub max_bindings: u32,
    /// Nanoseconds per timestamp tick; 0 when the queue has no timestamps.
    pub timestamp_period: f64,
}

/// Memory of the buffers of a device, staging included.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Memory {
    /// Bytes now.
    pub current: u64,
    /// Most bytes at any time since the device was opened or [`Device::reset_peak_memory`].
    pub peak: u64,
    /// Buffers made so far.
    pub allocations: u64,
}

/// [`Memory`] as it is counted.
#[derive(Default)]
pub(super) struct MemoryCount {
    current: AtomicU64,
    peak: AtomicU64,
    allocations: AtomicU64,
}

impl MemoryCount {
    pub fn add(&self, bytes: u64) {
        let now = self.current.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.peak.fetch_max(now, Ordering::Relaxed);
        self.allocations.fetch_add(1, Ordering::Relaxed);
    }
    pub fn remove(&self, bytes: u64) {
        self.current.fetch_sub(bytes, Ordering::Relaxed);
    }
}

/// A logical device, made by us or by the host, ready for [`Device::assemble`].
pub(super) struct Setup {
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
}

/// A Vulkan device; clones share it.
#[derive(Clone)]
pub struct Device(pub(super) Arc<Inner>);

pub(super) struct Inner {
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
    /// `None` only while dropping: it must go before the device.
    pub allocator: Mutex<Option<Allocator>>,
    pub memory: MemoryCount,
    pub pipelines: Mutex<HashMap<&'static str, Arc<Pipeline>>>,
    pub pipeline_cache: vk::PipelineCache,
    /// Set where synchronization2 comes from the extension instead of Vulkan 1.3.
    sync2: Option<ash::khr::synchronization2::Device>,
    messenger: Option<(ash::ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    instance: ash::Instance,
    sink: Option<Sink>,
    /// Keeps the loader library open.
    _entry: ash::Entry,
}

/// Turns a Vulkan result into an error that says what was being done.
pub(super) fn vk_error(what: impl std::fmt::Display) -> impl FnOnce(vk::Result) -> Error {
    move |e| Error::gpu(format!("{what}: {e}"))
}

/// Locks, ignoring poison: the guarded values stay consistent, a panic elsewhere is reported by its own thread.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|poisoned| poisoned.into_inner())
}

impl Device {
    /// Opens the preferred device (discrete, integrated, virtual, CPU), or the one whose index or name part is `choice`.
    /// `SPLATVK_DEVICE` is used when `choice` is `None`; `SPLATVK_VALIDATION=1` turns the validation layer on.
    pub fn open(choice: Option<&str>) -> Result<Device> {
        Self::with(&Options::from_env(choice))
    }

    /// Opens a device with all options spelled out.
    pub fn with(options: &Options) -> Result<Device> {
        let entry = select::load()?;
        let sink = options.validation.then(Sink::default);
        let instance = select::instance(&entry, sink.as_ref())?;
        // A clone keeps the loader in memory: `build` drops its entry on failure, and the instance must be destroyed after.
        match Self::build(entry.clone(), &instance, sink, options) {
            Ok(device) => Ok(device),
            Err(e) => {
                // SAFETY: nothing made from the instance is alive after the failure.
                unsafe { instance.destroy_instance(None) };
                Err(e)
            }
        }
    }

    fn build(
        entry: ash::Entry,
        instance: &ash::Instance,
        sink: Option<Sink>,
        options: &Options,
    ) -> Result<Device> {
        let candidate = select::choose(select::candidates(instance)?, options.choice.as_deref())?;
        let physical = candidate.physical;
        let queue_family = select::queue_family(instance, physical)
            .ok_or_else(|| Error::gpu(format!("{} has no compute queue", candidate.name)))?;
        let (device, info) = super::features::create(instance, &candidate, queue_family, options)?;
        // SAFETY: the queue was requested in `create`.
        let queue = unsafe { device.get_device_queue(queue_family, 0) };
        let setup = Setup {
            instance: instance.clone(),
            device,
            info,
            queue,
            queue_family,
            sync2_extension: candidate.properties.api_version < vk::API_VERSION_1_3,
            timeline: false,
            queue_lock: None,
            owned: true,
        };
        Self::assemble(entry, physical, sink, setup)
    }

    /// Adds what splatvk keeps beside a logical device. On failure the device is destroyed if it is ours; the instance
    /// stays with the caller.
    pub(super) fn assemble(
        entry: ash::Entry,
        physical: vk::PhysicalDevice,
        sink: Option<Sink>,
        setup: Setup,
    ) -> Result<Device> {
        let Setup { instance, device, info, queue, queue_family, timeline, queue_lock, owned, .. } = setup;
        let sync2 =
            setup.sync2_extension.then(|| ash::khr::synchronization2::Device::new(&instance, &device));
        let finish = || -> Result<(vk::PipelineCache, Allocator)> {
            // SAFETY: the device is alive.
            let cache =
                unsafe { device.create_pipeline_cache(&vk::PipelineCacheCreateInfo::default(), None) }
                    .map_err(vk_error("pipeline cache"))?;
            let allocator = Allocator::new(&AllocatorCreateDesc {
                instance: instance.clone(),
                device: device.clone(),
                physical_device: physical,
                debug_settings: gpu_allocator::AllocatorDebugSettings::default(),
                buffer_device_address: false,
                allocation_sizes: gpu_allocator::AllocationSizes::default(),
            });
            allocator.map(|a| (cache, a)).map_err(|e| {
                // SAFETY: the cache was never used.
                unsafe { device.destroy_pipeline_cache(cache, None) };
                Error::gpu(format!("memory allocator: {e}"))
            })
        };
        let (pipeline_cache, allocator) = match finish() {
            Ok(parts) => parts,
            Err(e) => {
                if owned {
                    // SAFETY: the device has no other user.
                    unsafe { device.destroy_device(None) };
                }
                return Err(e);
            }
        };
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
            allocator: Mutex::new(Some(allocator)),
            memory: MemoryCount::default(),
            pipelines: Mutex::new(HashMap::new()),
            pipeline_cache,
            sync2,
            messenger,
            instance,
            sink,
            _entry: entry,
        })))
    }

    /// What the device is and can do.
    pub fn info(&self) -> &DeviceInfo {
        &self.0.info
    }

    /// Memory of all buffers made on this device.
    pub fn memory(&self) -> Memory {
        let count = &self.0.memory;
        Memory {
            current: count.current.load(Ordering::Relaxed),
            peak: count.peak.load(Ordering::Relaxed),
            allocations: count.allocations.load(Ordering::Relaxed),
        }
    }

    /// Starts measuring [`Memory::peak`] anew.
    pub fn reset_peak_memory(&self) {
        let now = self.0.memory.current.load(Ordering::Relaxed);
        self.0.memory.peak.store(now, Ordering::Relaxed);
    }

    /// What the validation layer has said so far; always empty without validation.
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

    /// The compiled variant that serves a call on this device.
    pub(super) fn resolve(&self, call: &Call) -> Result<&'static Module> {
        let family = call.family;
        let info = self.info();
        let named: Vec<&Module> = family.modules.iter().filter(|m| m.variant == call.variant).collect();
        if named.is_empty() {
            let known: BTreeSet<&[u32]> = family.modules.iter().map(|m| m.variant).collect();
            return Err(Error::gpu(format!(
                "glsl/{}.comp was not compiled for {:?} = {:?}, only for {known:?}: extend its `// variants:` line",
                family.name, family.axes, call.variant
            )));
        }
        let (low, high) = info.subgroup_sizes;
        named
            .iter()
            .filter(|m| m.float_atomics.is_none_or(|native| native == info.float_atomics))
            .filter(|m| m.subgroup_size.is_none_or(|s| (low..=high).contains(&s)))
            // The device's own size first, then the largest that can be pinned.
            .max_by_key(|m| m.subgroup_size.map_or((true, 0), |s| (s == info.subgroup_size, s)))
            .copied()
            .ok_or_else(|| {
                Error::gpu(format!(
                    "glsl/{}.comp has no variant for subgroups of {low} to {high} threads ({}): extend its `// subgroups:` line",
                    family.name, info.name
                ))
            })
    }

    /// Records with synchronization2, wherever it comes from.
    pub(super) fn cmd_barrier(&self, commands: vk::CommandBuffer, dependency: &vk::DependencyInfo<'_>) {
        // SAFETY: the caller records `commands`, and synchronization2 is enabled on every device opened.
        unsafe {
            match &self.0.sync2 {
                Some(extension) => extension.cmd_pipeline_barrier2(commands, dependency),
                None => self.0.device.cmd_pipeline_barrier2(commands, dependency),
            }
        }
    }

    /// Submits; the fence is unsignalled and ours.
    pub(super) fn queue_submit(
        &self,
        infos: &[vk::SubmitInfo<'_>],
        fence: vk::Fence,
    ) -> std::result::Result<(), vk::Result> {
        let queue = lock(&self.0.queue);
        let mut outcome = Ok(());
        // SAFETY: our threads are kept apart by the lock, the host's by `queue_lock` or its promise (see HostDevice).
        let mut submit = || outcome = unsafe { self.0.device.queue_submit(*queue, infos, fence) };
        match &self.0.queue_lock {
            Some(host) => host(&mut submit),
            None => submit(),
        }
        outcome
    }

    /// Submits and waits until the device is done.
    pub(super) fn submit(&self, commands: vk::CommandBuffer, fence: vk::Fence, what: &str) -> Result<()> {
        let device = &self.0.device;
        let commands = [commands];
        let submit = vk::SubmitInfo::default().command_buffers(&commands);
        self.queue_submit(&[submit], fence).map_err(vk_error(what))?;
        // SAFETY: the fence was submitted above.
        unsafe { device.wait_for_fences(&[fence], true, u64::MAX) }.map_err(vk_error(what))?;
        // SAFETY: the fence is signalled and not in use.
        unsafe { device.reset_fences(&[fence]) }.map_err(vk_error(what))
    }
}

impl std::fmt::Debug for Device {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Device({})", self.info().name)
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: buffers and programs hold the device, so only the parts below are left, and nothing runs: every submit waits.
        unsafe {
            if self.owned {
                // Every submit was waited for; this is for what a driver may do on its own. On the host's device it would
                // take all of the host's queues.
                let _ = self.device.device_wait_idle();
            }
            for (_, pipeline) in lock(&self.pipelines).drain() {
                pipeline.destroy(&self.device);
            }
            self.device.destroy_pipeline_cache(self.pipeline_cache, None);
            drop(lock(&self.allocator).take());
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
