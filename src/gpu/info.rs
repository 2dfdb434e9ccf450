//! What a device is asked for and what it is.
use super::module::Capability;
use super::ways::{self, Way};
use ash::vk;
use std::collections::BTreeSet;
use std::path::PathBuf;

/// How a device is opened.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Index in the order of preference, or part of the name; `None` takes the first usable one.
    pub choice: Option<String>,
    /// Khronos validation layer with synchronization validation.
    pub validation: bool,
    /// With validation: shaders also check every access to a buffer. A test takes minutes instead of seconds.
    pub gpu_assisted: bool,
    /// Keep buffers out of host-visible memory, as on a GPU, even on a CPU device (to test the staging path).
    pub staging: bool,
    /// Only passes that give the same bits on every run of this device, even where others are faster.
    pub deterministic: bool,
    /// No buffer larger than this, bytes, although the device would bind more: to test what is done in blocks.
    pub max_binding: Option<u64>,
    /// Folder that keeps compiled pipelines, and what is switched off on a device, from one process to the next; `None`
    /// keeps nothing and knows of nothing. Not used on a host's device.
    pub cache: Option<PathBuf>,
    /// Ways not to be used although the device has them.
    pub without: BTreeSet<Way>,
}

impl Options {
    /// `choice` or else `SPLATVK_DEVICE`; validation when `SPLATVK_VALIDATION` is `1`, GPU-assisted when it is `gpu`; staging when
    /// `SPLATVK_STAGING` is `1`; `SPLATVK_MAX_BINDING` in MiB; the cache in the program's own folder, where there is one.
    pub fn from_env(choice: Option<&str>) -> Self {
        let variable = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
        let validation = variable("SPLATVK_VALIDATION");
        let validation = validation.as_deref();
        Options {
            choice: choice.map(str::to_owned).or_else(|| variable("SPLATVK_DEVICE")),
            validation: validation.is_some_and(|v| v == "1" || v == "gpu"),
            gpu_assisted: validation.is_some_and(|v| v == "gpu"),
            staging: variable("SPLATVK_STAGING").is_some_and(|v| v == "1"),
            max_binding: variable("SPLATVK_MAX_BINDING")
                .and_then(|v| v.parse::<u64>().ok())
                .map(|mib| mib.saturating_mul(1 << 20)),
            cache: crate::files::home().ok().map(|home| home.join("cache")),
            ..Options::default()
        }
    }
}

/// Rounds after which lavapipe leaves the loops of a shader, all of them together, and says nothing
/// (`LP_MAX_TGSI_LOOP_ITERATIONS`, Mesa 22 to 25). Passes share work among lanes so that no lane comes near, on any device.
pub const LOOP_ROUNDS: usize = 65_535;

/// What the device is and can do.
#[derive(Clone, Debug)]
#[non_exhaustive]
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
    /// `atomicAdd` on float in storage buffers is native, and used.
    pub float_atomics: bool,
    /// Ways that are not used here ([`DeviceInfo::way`]).
    pub without: BTreeSet<Way>,
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

impl DeviceInfo {
    /// The way that suits the device, or its replacement where that is switched off here.
    pub fn way(&self, preferred: Way) -> Way {
        let other = preferred.replacement();
        if self.without.contains(&preferred) && !self.without.contains(&other) { other } else { preferred }
    }

    /// The driver leaves loops after [`LOOP_ROUNDS`]: lavapipe, whose devices have this name.
    pub fn leaves_long_loops(&self) -> bool {
        self.name.starts_with("llvmpipe")
    }
}

impl Options {
    /// Also without what is switched off on a device, where a cache is kept.
    pub(super) fn for_device(&self, properties: &vk::PhysicalDeviceProperties) -> Options {
        let mut options = self.clone();
        if let Some(folder) = &self.cache {
            options.without.extend(ways::read(folder, properties));
        }
        options
    }
}
