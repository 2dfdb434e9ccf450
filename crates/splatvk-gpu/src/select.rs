//! Vulkan loader, instance and physical devices.
use crate::choice::{self, Candidate, INSTALL, Pci};
use crate::validation;
use crate::{Error, Options, Result};
use ash::vk;
use std::ffi::CStr;

fn no_device(message: String, cause: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Error {
    Error::NoDevice { message, source: Some(cause.into()) }
}

pub(crate) fn load() -> Result<ash::Entry> {
    // SAFETY: the system's Vulkan loader is trusted to be a Vulkan loader.
    unsafe { ash::Entry::load() }.map_err(|e| no_device(format!("no Vulkan loader ({e}); {INSTALL}"), e))
}

/// An instance, with validation layer, synchronization validation and debug messenger when asked
/// for.
pub(crate) fn instance(entry: &ash::Entry, sink: Option<&validation::Sink>) -> Result<ash::Instance> {
    // SAFETY: a plain query.
    let version =
        unsafe { entry.try_enumerate_instance_version() }.ok().flatten().unwrap_or(vk::API_VERSION_1_0);
    if version < vk::API_VERSION_1_2 {
        return Err(Error::no_device(format!("the Vulkan loader is older than 1.2; {INSTALL}")));
    }
    let application = vk::ApplicationInfo::default()
        .engine_name(c"splatvk-gpu")
        .api_version(version.min(vk::API_VERSION_1_3));
    let mut layers = Vec::new();
    let mut extensions = Vec::new();
    let mut info = vk::InstanceCreateInfo::default().application_info(&application);
    let mut messenger;
    let mut features;
    if let Some(sink) = sink {
        validation::require_layer(entry)?;
        layers.push(validation::LAYER.as_ptr());
        extensions.push(ash::ext::debug_utils::NAME.as_ptr());
        extensions.push(ash::ext::validation_features::NAME.as_ptr());
        messenger = sink.messenger_info();
        features = vk::ValidationFeaturesEXT::default()
            .enabled_validation_features(sink.features())
            .disabled_validation_features(sink.without());
        info = info.push_next(&mut messenger).push_next(&mut features);
    }
    let info = info.enabled_layer_names(&layers).enabled_extension_names(&extensions);
    // SAFETY: all pointers in `info` outlive the call.
    unsafe { entry.create_instance(&info, None) }
        .map_err(|e| no_device(format!("no Vulkan instance ({e}); {INSTALL}"), e))
}

/// The visible physical devices, best first: discrete, integrated, virtual, CPU.
pub(crate) fn candidates(instance: &ash::Instance, options: &Options) -> Result<Vec<Candidate>> {
    // SAFETY: the instance is alive.
    let devices = unsafe { instance.enumerate_physical_devices() }
        .map_err(|e| no_device(format!("the Vulkan drivers list no device ({e}); {INSTALL}"), e))?;
    let mut all: Vec<Candidate> = devices.into_iter().map(|physical| candidate(instance, physical)).collect();
    best_first(&mut all);
    choice::visible(all, options.cuda_visible.as_deref())
}

/// Devices of one kind keep the driver's order.
fn best_first(all: &mut [Candidate]) {
    all.sort_by_key(|c| match c.properties.device_type {
        vk::PhysicalDeviceType::DISCRETE_GPU => 0,
        vk::PhysicalDeviceType::INTEGRATED_GPU => 1,
        vk::PhysicalDeviceType::VIRTUAL_GPU => 2,
        vk::PhysicalDeviceType::CPU => 3,
        _ => 4,
    });
}

pub(crate) fn candidate(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Candidate {
    // SAFETY: `physical` belongs to `instance`.
    let properties = unsafe { instance.get_physical_device_properties(physical) };
    let name = properties.device_name_as_c_str().unwrap_or_default().to_string_lossy().into_owned();
    let unusable = if properties.api_version < vk::API_VERSION_1_2 {
        Some("Vulkan 1.2 is needed: update the driver".to_owned())
    } else if properties.api_version < vk::API_VERSION_1_3
        && !has_extension(&extensions(instance, physical), ash::khr::synchronization2::NAME)
    {
        Some("VK_KHR_synchronization2 is missing: update the driver".to_owned())
    } else if queue_family(instance, physical).is_none() {
        Some("it has no compute queue".to_owned())
    } else {
        None
    };
    let (uuid, pci) = identity(instance, physical, properties.api_version);
    Candidate { physical, properties, name, uuid, pci, unusable }
}

/// UUID and PCI address.
fn identity(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
    api_version: u32,
) -> ([u8; 16], Option<Pci>) {
    if api_version < vk::API_VERSION_1_1 {
        return ([0; 16], None);
    }
    let on_bus = has_extension(&extensions(instance, physical), ash::ext::pci_bus_info::NAME);
    let mut id = vk::PhysicalDeviceIDProperties::default();
    let mut bus = vk::PhysicalDevicePCIBusInfoPropertiesEXT::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut id);
    if on_bus {
        properties = properties.push_next(&mut bus);
    }
    // SAFETY: the chain holds only structures whose version or extension the device has.
    unsafe { instance.get_physical_device_properties2(physical, &mut properties) };
    let address = Pci([bus.pci_domain, bus.pci_bus, bus.pci_device, bus.pci_function]);
    (id.device_uuid, on_bus.then_some(address))
}

pub(crate) fn extensions(
    instance: &ash::Instance,
    physical: vk::PhysicalDevice,
) -> Vec<vk::ExtensionProperties> {
    // SAFETY: `physical` belongs to `instance`.
    unsafe { instance.enumerate_device_extension_properties(physical) }.unwrap_or_default()
}

pub(crate) fn has_extension(list: &[vk::ExtensionProperties], name: &CStr) -> bool {
    list.iter().any(|e| e.extension_name_as_c_str() == Ok(name))
}

/// A queue family with compute; one without graphics is preferred on GPUs that have it, since
/// nothing else uses it.
pub(crate) fn queue_family(instance: &ash::Instance, physical: vk::PhysicalDevice) -> Option<u32> {
    // SAFETY: `physical` belongs to `instance`.
    let families = unsafe { instance.get_physical_device_queue_family_properties(physical) };
    let compute = |f: &vk::QueueFamilyProperties| f.queue_flags.contains(vk::QueueFlags::COMPUTE);
    families
        .iter()
        .position(|f| {
            compute(f) && !f.queue_flags.contains(vk::QueueFlags::GRAPHICS) && f.timestamp_valid_bits > 0
        })
        .or_else(|| families.iter().position(compute))
        .map(|i| i as u32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ash::vk::PhysicalDeviceType as Kind;

    fn made_up(name: &str, kind: Kind) -> Candidate {
        Candidate {
            physical: vk::PhysicalDevice::null(),
            properties: vk::PhysicalDeviceProperties { device_type: kind, ..Default::default() },
            name: name.to_owned(),
            uuid: [0; 16],
            pci: None,
            unusable: None,
        }
    }

    #[test]
    fn a_discrete_gpu_comes_first_and_the_cpu_last() {
        let kinds = [
            ("other", Kind::OTHER),
            ("llvmpipe", Kind::CPU),
            ("virtual", Kind::VIRTUAL_GPU),
            ("integrated", Kind::INTEGRATED_GPU),
            ("discrete", Kind::DISCRETE_GPU),
            ("second", Kind::DISCRETE_GPU),
        ];
        let mut all: Vec<Candidate> = kinds.iter().map(|(name, kind)| made_up(name, *kind)).collect();
        best_first(&mut all);
        let names: Vec<&str> = all.iter().map(|c| c.name.as_str()).collect();
        assert_eq!(names, ["discrete", "second", "integrated", "virtual", "llvmpipe", "other"]);
    }
}
