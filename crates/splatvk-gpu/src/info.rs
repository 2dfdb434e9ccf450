//! Options of a device, and its description.
use crate::cache::{Cache, Driver};
use crate::module::Capability;
use crate::native::Native;
use ash::vk;
use std::collections::BTreeSet;
use std::sync::Arc;

/// The name under which [`Options::disabled`] switches native float atomics off.
pub const NATIVE_FLOAT_ATOMICS: &str = "native float atomics";

/// How a device is opened.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// `uuid:…` (its beginning), `pci:…` as of `lspci -D`, index in the order of preference, or part
    /// of the name that no other device has; `None` takes the first usable one.
    pub choice: Option<String>,
    /// As CUDA's variable `CUDA_VISIBLE_DEVICES`: the devices of NVIDIA that may be used, as UUIDs
    /// or as numbers along the PCI bus. `None`: all.
    pub cuda_visible: Option<String>,
    /// Khronos validation layer with synchronization validation.
    pub validation: bool,
    /// With validation: shaders also check every access to a buffer. A test takes minutes instead
    /// of seconds.
    pub gpu_assisted: bool,
    /// Keep buffers out of host-visible memory, as on a GPU, even on a CPU device (to test the
    /// staging path).
    pub staging: bool,
    /// Only passes that give the same bits on every run of this device, even where others are
    /// faster.
    pub deterministic: bool,
    /// No buffer larger than this, bytes, although the device would bind more: to test what is done
    /// in blocks.
    pub max_binding: Option<u64>,
    /// Keeps compiled pipelines, and the kernel variants that are disabled or preferred on a
    /// device, from one process to the next. Not used on a host's device.
    pub cache: Option<Arc<dyn Cache>>,
    /// Native code in place of shaders, where the device is the processor and buffers are mapped.
    /// Not used on a host's device.
    pub natives: &'static [Native],
    /// Names of kernel variants not to be used. The crate itself knows [`NATIVE_FLOAT_ATOMICS`];
    /// the others are the program's, which finds them in [`DeviceInfo::disabled`].
    pub disabled: BTreeSet<String>,
    /// Names of kernel variants to be used in place of the defaults, which the program finds in
    /// [`DeviceInfo::preferred`]; `None`: those that the cache keeps.
    pub preferred: Option<BTreeSet<String>>,
}

/// Rounds after which lavapipe leaves the loops of a shader, all of them together, and says nothing
/// (`LP_MAX_TGSI_LOOP_ITERATIONS`, Mesa 22 to 25). Passes share work among lanes so that no lane
/// comes near, on any device.
pub const LOOP_ROUNDS: usize = 65_535;

/// A device's properties, limits and features.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub struct DeviceInfo {
    /// As the driver reports it.
    pub name: String,
    /// 8-4-4-4-12 hexadecimal digits.
    pub uuid: String,
    /// Address on the PCI bus, "0000:3b:00.0"; `None` where the driver reports none.
    pub pci: Option<String>,
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
    /// Smallest and largest size that can be pinned; both `subgroup_size` without subgroup size
    /// control.
    pub subgroup_sizes: (u32, u32),
    /// Subgroup sizes can be pinned per pipeline.
    pub subgroup_control: bool,
    /// Asked to give the same bits on every run ([`Options::deterministic`]).
    pub deterministic: bool,
    /// `atomicAdd` on float in storage buffers is native, and used.
    pub float_atomics: bool,
    /// Names of the kernel variants that are not used here ([`Options::disabled`]).
    pub disabled: BTreeSet<String>,
    /// Names of the kernel variants that were faster here than the defaults; `None` where nothing
    /// is remembered ([`Options::preferred`]).
    pub preferred: Option<BTreeSet<String>>,
    /// Capabilities that shaders may use here.
    pub capabilities: BTreeSet<Capability>,
    /// Largest buffer a shader can see, bytes.
    pub max_storage_range: u64,
    /// Largest buffer, bytes: more than a shader can see where native code takes the place of
    /// shaders.
    pub max_buffer: u64,
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

impl DeviceInfo {
    /// The driver leaves loops after [`LOOP_ROUNDS`]: lavapipe, whose devices have this name.
    pub fn leaves_long_loops(&self) -> bool {
        self.name.starts_with("llvmpipe")
    }
}

impl Options {
    /// The options with the variants that the cache names as disabled or preferred on a device.
    pub(crate) fn for_device(&self, properties: &vk::PhysicalDeviceProperties) -> Options {
        let mut options = self.clone();
        if let Some(cache) = &self.cache {
            let driver = Driver::new(properties);
            options.disabled.extend(driver.disabled(cache.as_ref()));
            options.preferred = options.preferred.or_else(|| driver.preferred(cache.as_ref()));
        }
        options
    }

    /// Native float atomics may be used where the device has them.
    pub(crate) fn allows_float_atomics(&self) -> bool {
        !self.disabled.contains(NATIVE_FLOAT_ATOMICS)
    }
}
