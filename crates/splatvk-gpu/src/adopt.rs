//! Working on a Vulkan device that the host program made and keeps.
use crate::choice::Candidate;
use crate::device::{Device, QueueLock, Setup};
use crate::enabled::EnabledFeatures;
use crate::features;
use crate::info::Options;
use crate::select;
use crate::{Error, Result};
use ash::vk;
use std::ffi::{CStr, CString};

/// The host's Vulkan objects. They must outlive the [`Device`] made from them and everything made
/// on it.
pub struct HostDevice {
    /// Where the host has its Vulkan functions from; `None` loads the system's loader.
    pub get_instance_proc_addr: Option<vk::PFN_vkGetInstanceProcAddr>,
    /// Made for Vulkan 1.2 or newer.
    pub instance: vk::Instance,
    /// One with Vulkan 1.2 and synchronization2 (see [`crate::survey`]).
    pub physical_device: vk::PhysicalDevice,
    /// Made with `synchronization2`.
    pub device: vk::Device,
    /// A queue with compute of `queue_family`.
    pub queue: vk::Queue,
    /// Family of the queue.
    pub queue_family: u32,
    /// Device extensions that the host enabled.
    pub extensions: Vec<CString>,
    /// Features that the host enabled: see [`EnabledFeatures`].
    pub features: EnabledFeatures,
    /// Without one, the host does not use the queue while a call into this crate runs.
    pub queue_lock: Option<QueueLock>,
}

impl Device {
    /// Works on the host's device; it is not destroyed with the [`Device`]. Of `options` only
    /// `staging`, `deterministic`, `disabled` and `preferred` count.
    ///
    /// # Safety
    /// The handles are valid, belong together, were made as `host` says, and outlive everything
    /// made from the result. The queue is used as [`HostDevice::queue_lock`] says.
    pub unsafe fn adopt(host: HostDevice, options: &Options) -> Result<Device> {
        let refuse = |what: &str| Err(Error::Host(format!("the host's Vulkan device: {what}")));
        let null = host.instance == vk::Instance::null()
            || host.physical_device == vk::PhysicalDevice::null()
            || host.device == vk::Device::null()
            || host.queue == vk::Queue::null();
        if null {
            return refuse("a handle is null; give instance, physical device, device and queue");
        }
        let entry = match host.get_instance_proc_addr {
            // SAFETY: the contract requires this of the host's function.
            Some(get) => unsafe { ash::Entry::from_static_fn(ash::StaticFn { get_instance_proc_addr: get }) },
            None => select::load()?,
        };
        // A missing function becomes a stub that aborts when called, so ask for the newest ones
        // that are used.
        // SAFETY: a live instance, per the contract, and a name that ends with zero.
        let instance_has =
            |name: &CStr| unsafe { entry.get_instance_proc_addr(host.instance, name.as_ptr()) };
        if instance_has(c"vkGetPhysicalDeviceProperties2").is_none() {
            return refuse("its instance is older than Vulkan 1.1; make it with apiVersion 1.2");
        }
        // SAFETY: a live instance and device, per the contract.
        let (instance, device) = unsafe {
            let instance = ash::Instance::load(entry.static_fn(), host.instance);
            let device = ash::Device::load(instance.fp_v1_0(), host.device);
            (instance, device)
        };
        let candidate = select::candidate(&instance, host.physical_device);
        if let Some(reason) = &candidate.unusable {
            return refuse(reason);
        }
        // SAFETY: a live device, per the contract.
        let device_has = |name: &CStr| unsafe { instance.get_device_proc_addr(host.device, name.as_ptr()) };
        let extension = host.extensions.iter().any(|e| e.as_c_str() == ash::khr::synchronization2::NAME);
        let core = device_has(c"vkCmdPipelineBarrier2").is_some();
        let khr = extension && device_has(c"vkCmdPipelineBarrier2KHR").is_some();
        if !host.features.synchronization2 || !(core || khr) {
            return refuse("synchronization2 is off; make the device with that feature");
        }
        check_queue(&instance, &candidate, host.queue_family)?;
        let info = features::adopted(&instance, &candidate, &host.features, host.queue_family, options);
        let setup = Setup {
            instance,
            device,
            info,
            queue: host.queue,
            queue_family: host.queue_family,
            sync2_extension: !core,
            timeline: host.features.timeline_semaphore,
            queue_lock: host.queue_lock,
            owned: false,
            cache: None,
            natives: &[],
        };
        Device::assemble(entry, candidate.physical, None, setup)
    }
}

fn check_queue(instance: &ash::Instance, candidate: &Candidate, family: u32) -> Result<()> {
    // SAFETY: the physical device belongs to the instance.
    let families = unsafe { instance.get_physical_device_queue_family_properties(candidate.physical) };
    let compute =
        families.get(family as usize).is_some_and(|f| f.queue_flags.contains(vk::QueueFlags::COMPUTE));
    if compute {
        return Ok(());
    }
    Err(Error::Host(format!(
        "the host's Vulkan device: queue family {family} of {} has no compute",
        candidate.name
    )))
}
