//! Device features: the offered ones, the enabled ones, and the shader capabilities that follow.
use crate::choice;
use crate::choice::Candidate;
use crate::enabled::EnabledFeatures;
use crate::error::vk_error;
use crate::info::{DeviceInfo, Options};
use crate::module::Capability;
use crate::select;
use crate::{Error, Result};
use ash::vk;
use std::collections::BTreeSet;

/// The features that a physical device offers.
#[derive(Clone, Copy, Default)]
struct AvailableFeatures {
    base: vk::PhysicalDeviceFeatures,
    storage8: bool,
    float16: bool,
    int8: bool,
    storage16: bool,
    synchronization2: bool,
    atomic_float_add: bool,
    subgroup_control: bool,
    full_subgroups: bool,
}

fn available(instance: &ash::Instance, candidate: &Candidate) -> AvailableFeatures {
    let list = select::extensions(instance, candidate.physical);
    let core13 = candidate.properties.api_version >= vk::API_VERSION_1_3;
    let mut v11 = vk::PhysicalDeviceVulkan11Features::default();
    let mut v12 = vk::PhysicalDeviceVulkan12Features::default();
    let mut sync2 = vk::PhysicalDeviceSynchronization2Features::default();
    let mut atomics = vk::PhysicalDeviceShaderAtomicFloatFeaturesEXT::default();
    let mut control = vk::PhysicalDeviceSubgroupSizeControlFeatures::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut v11).push_next(&mut v12);
    if core13 || select::has_extension(&list, ash::khr::synchronization2::NAME) {
        features = features.push_next(&mut sync2);
    }
    if select::has_extension(&list, ash::ext::shader_atomic_float::NAME) {
        features = features.push_next(&mut atomics);
    }
    if core13 || select::has_extension(&list, ash::ext::subgroup_size_control::NAME) {
        features = features.push_next(&mut control);
    }
    // SAFETY: the chain holds only structures whose version or extension the device has.
    unsafe { instance.get_physical_device_features2(candidate.physical, &mut features) };
    let base = features.features;
    AvailableFeatures {
        base,
        storage8: v12.storage_buffer8_bit_access == vk::TRUE,
        float16: v12.shader_float16 == vk::TRUE,
        int8: v12.shader_int8 == vk::TRUE,
        storage16: v11.storage_buffer16_bit_access == vk::TRUE,
        synchronization2: sync2.synchronization2 == vk::TRUE,
        atomic_float_add: atomics.shader_buffer_float32_atomic_add == vk::TRUE
            && atomics.shader_buffer_float32_atomics == vk::TRUE,
        subgroup_control: control.subgroup_size_control == vk::TRUE,
        full_subgroups: control.compute_full_subgroups == vk::TRUE,
    }
}

/// Creates the logical device with every offered feature that some shader may use.
pub(crate) fn create(
    instance: &ash::Instance,
    candidate: &Candidate,
    queue_family: u32,
    options: &Options,
) -> Result<(ash::Device, DeviceInfo)> {
    let offer = available(instance, candidate);
    if !offer.synchronization2 {
        return Err(Error::no_device(format!(
            "{} lacks synchronization2: update the driver",
            candidate.name
        )));
    }
    let core13 = candidate.properties.api_version >= vk::API_VERSION_1_3;
    let atomics_on = offer.atomic_float_add && options.allows_float_atomics();
    let mut extensions = Vec::new();
    if !core13 {
        extensions.push(ash::khr::synchronization2::NAME.as_ptr());
        if offer.subgroup_control {
            extensions.push(ash::ext::subgroup_size_control::NAME.as_ptr());
        }
    }
    if atomics_on {
        extensions.push(ash::ext::shader_atomic_float::NAME.as_ptr());
    }
    let base = vk::PhysicalDeviceFeatures {
        shader_int64: offer.base.shader_int64,
        shader_int16: offer.base.shader_int16,
        shader_float64: offer.base.shader_float64,
        ..Default::default()
    };
    let mut v11 = vk::PhysicalDeviceVulkan11Features::default().storage_buffer16_bit_access(offer.storage16);
    let mut v12 = vk::PhysicalDeviceVulkan12Features::default()
        .storage_buffer8_bit_access(offer.storage8)
        .shader_float16(offer.float16)
        .shader_int8(offer.int8);
    let mut sync2 = vk::PhysicalDeviceSynchronization2Features::default().synchronization2(true);
    let mut atomics = vk::PhysicalDeviceShaderAtomicFloatFeaturesEXT::default()
        .shader_buffer_float32_atomics(true)
        .shader_buffer_float32_atomic_add(true);
    let mut control = vk::PhysicalDeviceSubgroupSizeControlFeatures::default()
        .subgroup_size_control(true)
        .compute_full_subgroups(offer.full_subgroups);
    let queues =
        [vk::DeviceQueueCreateInfo::default().queue_family_index(queue_family).queue_priorities(&[1.0])];
    let mut info = vk::DeviceCreateInfo::default()
        .queue_create_infos(&queues)
        .enabled_extension_names(&extensions)
        .enabled_features(&base)
        .push_next(&mut v11)
        .push_next(&mut v12)
        .push_next(&mut sync2);
    if atomics_on {
        info = info.push_next(&mut atomics);
    }
    if offer.subgroup_control {
        info = info.push_next(&mut control);
    }
    // SAFETY: everything enabled was offered, and all pointers outlive the call.
    let device = unsafe { instance.create_device(candidate.physical, &info, None) }
        .map_err(vk_error(format!("opening {}", candidate.name)))?;
    let described = describe(instance, candidate, &offer, queue_family, options, atomics_on);
    Ok((device, described))
}

/// The description of a device that the host made: the enabled features are the offered ones.
pub(crate) fn adopted(
    instance: &ash::Instance,
    candidate: &Candidate,
    enabled: &EnabledFeatures,
    queue_family: u32,
    options: &Options,
) -> DeviceInfo {
    let offer = AvailableFeatures {
        base: enabled.base,
        storage8: enabled.storage8,
        float16: enabled.float16,
        int8: enabled.int8,
        storage16: enabled.storage16,
        synchronization2: enabled.synchronization2,
        atomic_float_add: enabled.atomic_float_add,
        subgroup_control: enabled.subgroup_control,
        full_subgroups: enabled.full_subgroups,
    };
    let atomics = offer.atomic_float_add && options.allows_float_atomics();
    describe(instance, candidate, &offer, queue_family, options, atomics)
}

/// The public description; `doctor` also prints it for devices that it does not open.
fn describe(
    instance: &ash::Instance,
    candidate: &Candidate,
    offer: &AvailableFeatures,
    queue_family: u32,
    options: &Options,
    float_atomics: bool,
) -> DeviceInfo {
    let core13 = candidate.properties.api_version >= vk::API_VERSION_1_3;
    let mut v11 = vk::PhysicalDeviceVulkan11Properties::default();
    let mut v12 = vk::PhysicalDeviceVulkan12Properties::default();
    let mut control = vk::PhysicalDeviceSubgroupSizeControlProperties::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut v11).push_next(&mut v12);
    if core13 || offer.subgroup_control {
        properties = properties.push_next(&mut control);
    }
    // SAFETY: plain queries on a physical device of this instance, with structures of its version.
    let (families, memory) = unsafe {
        instance.get_physical_device_properties2(candidate.physical, &mut properties);
        (
            instance.get_physical_device_queue_family_properties(candidate.physical),
            instance.get_physical_device_memory_properties(candidate.physical),
        )
    };
    let own = |heap: &&vk::MemoryHeap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL);
    let memory = memory.memory_heaps_as_slice().iter().filter(own).map(|heap| heap.size).max().unwrap_or(0);
    let limits = candidate.properties.limits;
    let most_bound = options.max_binding.unwrap_or(u64::MAX);
    let pins = offer.subgroup_control
        && control.required_subgroup_size_stages.contains(vk::ShaderStageFlags::COMPUTE);
    let size = v11.subgroup_size;
    let has_timestamps = families.get(queue_family as usize).is_some_and(|f| f.timestamp_valid_bits > 0);
    let is_cpu = candidate.properties.device_type == vk::PhysicalDeviceType::CPU;
    let version = candidate.properties.api_version;
    let text = |t: std::result::Result<&std::ffi::CStr, _>| {
        t.map(|t: &std::ffi::CStr| t.to_string_lossy().into_owned()).unwrap_or_default()
    };
    let driver: (String, String) =
        (text(v12.driver_name_as_c_str().map_err(drop)), text(v12.driver_info_as_c_str().map_err(drop)));
    DeviceInfo {
        name: candidate.name.clone(),
        uuid: choice::uuid_text(candidate.uuid),
        pci: candidate.pci.map(|pci| pci.to_string()),
        driver: format!("{} {}", driver.0, driver.1).trim().to_owned(),
        api_version: (
            vk::api_version_major(version),
            vk::api_version_minor(version),
            vk::api_version_patch(version),
        ),
        is_cpu,
        mapped: is_cpu && !options.staging,
        subgroup_size: size,
        subgroup_sizes: if pins {
            (control.min_subgroup_size, control.max_subgroup_size)
        } else {
            (size, size)
        },
        subgroup_control: pins,
        float_atomics,
        deterministic: options.deterministic,
        disabled: options.disabled.clone(),
        preferred: options.preferred.clone(),
        capabilities: capabilities(offer, &v11, float_atomics),
        max_storage_range: u64::from(limits.max_storage_buffer_range).min(most_bound),
        max_buffer: v11.max_memory_allocation_size.min(most_bound),
        memory,
        max_groups: limits.max_compute_work_group_count,
        max_workgroup_threads: limits.max_compute_work_group_invocations,
        shared_memory: limits.max_compute_shared_memory_size,
        max_bindings: limits.max_per_stage_descriptor_storage_buffers,
        timestamp_period: if has_timestamps { f64::from(limits.timestamp_period) } else { 0.0 },
    }
}

fn capabilities(
    offer: &AvailableFeatures,
    v11: &vk::PhysicalDeviceVulkan11Properties<'_>,
    float_atomics: bool,
) -> BTreeSet<Capability> {
    use Capability::*;
    let subgroups = |bit: vk::SubgroupFeatureFlags| {
        v11.subgroup_supported_stages.contains(vk::ShaderStageFlags::COMPUTE)
            && v11.subgroup_supported_operations.contains(bit)
    };
    [
        (Int64, offer.base.shader_int64 == vk::TRUE),
        (Int16, offer.base.shader_int16 == vk::TRUE),
        (Float64, offer.base.shader_float64 == vk::TRUE),
        (Float16, offer.float16),
        (Int8, offer.int8),
        (Storage16, offer.storage16),
        (Storage8, offer.storage8),
        (SubgroupBasic, subgroups(vk::SubgroupFeatureFlags::BASIC)),
        (SubgroupVote, subgroups(vk::SubgroupFeatureFlags::VOTE)),
        (SubgroupArithmetic, subgroups(vk::SubgroupFeatureFlags::ARITHMETIC)),
        (SubgroupBallot, subgroups(vk::SubgroupFeatureFlags::BALLOT)),
        (SubgroupShuffle, subgroups(vk::SubgroupFeatureFlags::SHUFFLE)),
        (SubgroupShuffleRelative, subgroups(vk::SubgroupFeatureFlags::SHUFFLE_RELATIVE)),
        (AtomicFloatAdd, float_atomics),
    ]
    .into_iter()
    .filter_map(|(capability, there)| there.then_some(capability))
    .collect()
}

/// The description of a device without opening it, or why it cannot be used.
pub(crate) fn survey(
    instance: &ash::Instance,
    candidate: &Candidate,
    options: &Options,
) -> std::result::Result<DeviceInfo, String> {
    if let Some(reason) = &candidate.unusable {
        return Err(reason.clone());
    }
    let offer = available(instance, candidate);
    let family = select::queue_family(instance, candidate.physical).ok_or("it has no compute queue")?;
    let options = options.for_device(&candidate.properties);
    let atomics = offer.atomic_float_add && options.allows_float_atomics();
    Ok(describe(instance, candidate, &offer, family, &options, atomics))
}
