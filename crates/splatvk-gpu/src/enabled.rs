//! Features of a device that the host made.
use ash::vk;

/// Features that the host's device was made with. Only `synchronization2` is indispensable; each
/// other one that is there allows faster shaders, and `timeline_semaphore` is needed for
/// [`crate::external::Sync`].
#[derive(Clone, Copy, Debug, Default)]
pub struct EnabledFeatures {
    /// Vulkan 1.0 features.
    pub base: vk::PhysicalDeviceFeatures,
    /// `storageBuffer16BitAccess`
    pub storage16: bool,
    /// `storageBuffer8BitAccess`
    pub storage8: bool,
    /// `shaderFloat16`
    pub float16: bool,
    /// `shaderInt8`
    pub int8: bool,
    /// `synchronization2`
    pub synchronization2: bool,
    /// `shaderBufferFloat32Atomics` and `shaderBufferFloat32AtomicAdd`
    pub atomic_float_add: bool,
    /// `subgroupSizeControl`
    pub subgroup_control: bool,
    /// `computeFullSubgroups`
    pub full_subgroups: bool,
    /// `timelineSemaphore`
    pub timeline_semaphore: bool,
}

impl EnabledFeatures {
    /// Reads a chain that starts with `VkPhysicalDeviceFeatures2`, as it was given to
    /// `vkCreateDevice`. Unknown structures are skipped.
    ///
    /// # Safety
    /// `chain` is null or a valid chain of Vulkan structures.
    pub unsafe fn read(chain: *const std::ffi::c_void) -> EnabledFeatures {
        let on = |v: vk::Bool32| v == vk::TRUE;
        let mut f = EnabledFeatures::default();
        let mut next = chain.cast::<vk::BaseInStructure<'_>>();
        while !next.is_null() {
            // SAFETY: a valid chain, per the contract; each structure has the type that its
            // `s_type` says.
            unsafe {
                match (*next).s_type {
                    vk::StructureType::PHYSICAL_DEVICE_FEATURES_2 => {
                        f.base = (*next.cast::<vk::PhysicalDeviceFeatures2<'_>>()).features;
                    }
                    vk::StructureType::PHYSICAL_DEVICE_VULKAN_1_1_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDeviceVulkan11Features<'_>>();
                        f.storage16 |= on(v.storage_buffer16_bit_access);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_VULKAN_1_2_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDeviceVulkan12Features<'_>>();
                        f.storage8 |= on(v.storage_buffer8_bit_access);
                        f.float16 |= on(v.shader_float16);
                        f.int8 |= on(v.shader_int8);
                        f.timeline_semaphore |= on(v.timeline_semaphore);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_VULKAN_1_3_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDeviceVulkan13Features<'_>>();
                        f.synchronization2 |= on(v.synchronization2);
                        f.subgroup_control |= on(v.subgroup_size_control);
                        f.full_subgroups |= on(v.compute_full_subgroups);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_16BIT_STORAGE_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDevice16BitStorageFeatures<'_>>();
                        f.storage16 |= on(v.storage_buffer16_bit_access);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_8BIT_STORAGE_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDevice8BitStorageFeatures<'_>>();
                        f.storage8 |= on(v.storage_buffer8_bit_access);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_SHADER_FLOAT16_INT8_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDeviceShaderFloat16Int8Features<'_>>();
                        f.float16 |= on(v.shader_float16);
                        f.int8 |= on(v.shader_int8);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_SYNCHRONIZATION_2_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDeviceSynchronization2Features<'_>>();
                        f.synchronization2 |= on(v.synchronization2);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_SUBGROUP_SIZE_CONTROL_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDeviceSubgroupSizeControlFeatures<'_>>();
                        f.subgroup_control |= on(v.subgroup_size_control);
                        f.full_subgroups |= on(v.compute_full_subgroups);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_TIMELINE_SEMAPHORE_FEATURES => {
                        let v = &*next.cast::<vk::PhysicalDeviceTimelineSemaphoreFeatures<'_>>();
                        f.timeline_semaphore |= on(v.timeline_semaphore);
                    }
                    vk::StructureType::PHYSICAL_DEVICE_SHADER_ATOMIC_FLOAT_FEATURES_EXT => {
                        let v = &*next.cast::<vk::PhysicalDeviceShaderAtomicFloatFeaturesEXT<'_>>();
                        f.atomic_float_add |=
                            on(v.shader_buffer_float32_atomics) && on(v.shader_buffer_float32_atomic_add);
                    }
                    _ => {}
                }
                next = (*next).p_next;
            }
        }
        f
    }
}
