//! Compute pipelines.
use crate::error::vk_error;
use crate::info::DeviceInfo;
use crate::module::Module;
use crate::{Error, Result};
use ash::vk;

pub(crate) struct Pipeline {
    pub raw: vk::Pipeline,
    pub layout: vk::PipelineLayout,
    pub set_layout: vk::DescriptorSetLayout,
    module: vk::ShaderModule,
}

impl Pipeline {
    /// Compiles a module for a device.
    pub fn new(
        device: &ash::Device,
        info: &DeviceInfo,
        cache: vk::PipelineCache,
        module: &Module,
    ) -> Result<Pipeline> {
        check(info, module)?;
        let mut made = Pipeline {
            raw: vk::Pipeline::null(),
            layout: vk::PipelineLayout::null(),
            set_layout: vk::DescriptorSetLayout::null(),
            module: vk::ShaderModule::null(),
        };
        if let Err(e) = made.create(device, info, cache, module) {
            // SAFETY: nothing was recorded with it.
            unsafe { made.destroy(device) };
            return Err(e);
        }
        Ok(made)
    }

    fn create(
        &mut self,
        device: &ash::Device,
        info: &DeviceInfo,
        cache: vk::PipelineCache,
        module: &Module,
    ) -> Result<()> {
        let error = || vk_error(format!("shader {}", module.name));
        let code = ash::util::read_spv(&mut std::io::Cursor::new(module.spirv))
            .map_err(|e| Error::refused(format!("shader {}: {e}", module.name)))?;
        let bindings: Vec<_> = module
            .bindings
            .iter()
            .map(|b| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(b.number)
                    .descriptor_type(vk::DescriptorType::STORAGE_BUFFER)
                    .descriptor_count(1)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let push = [vk::PushConstantRange::default()
            .stage_flags(vk::ShaderStageFlags::COMPUTE)
            .size(module.push_bytes)];
        // SAFETY: plain object creation on a live device; all pointers outlive the calls.
        unsafe {
            self.module = device
                .create_shader_module(&vk::ShaderModuleCreateInfo::default().code(&code), None)
                .map_err(error())?;
            self.set_layout = device
                .create_descriptor_set_layout(
                    &vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings),
                    None,
                )
                .map_err(error())?;
            let sets = [self.set_layout];
            let layout = vk::PipelineLayoutCreateInfo::default()
                .set_layouts(&sets)
                .push_constant_ranges(if module.push_bytes > 0 { &push } else { &[] });
            self.layout = device.create_pipeline_layout(&layout, None).map_err(error())?;
        }
        let mut pinned = vk::PipelineShaderStageRequiredSubgroupSizeCreateInfo::default();
        let mut stage = vk::PipelineShaderStageCreateInfo::default()
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(self.module)
            .name(c"main");
        if let (Some(size), true) = (module.subgroup_size, info.subgroup_control) {
            pinned = pinned.required_subgroup_size(size);
            stage = stage.push_next(&mut pinned);
        }
        let create = vk::ComputePipelineCreateInfo::default().stage(stage).layout(self.layout);
        // SAFETY: as above.
        let pipelines = unsafe { device.create_compute_pipelines(cache, &[create], None) }
            .map_err(|(_, e)| error()(e))?;
        self.raw = pipelines.first().copied().unwrap_or_default();
        Ok(())
    }

    /// # Safety
    /// No command buffer that uses the pipeline is pending.
    pub unsafe fn destroy(&self, device: &ash::Device) {
        // SAFETY: per the contract; null handles are allowed.
        unsafe {
            device.destroy_pipeline(self.raw, None);
            device.destroy_pipeline_layout(self.layout, None);
            device.destroy_descriptor_set_layout(self.set_layout, None);
            device.destroy_shader_module(self.module, None);
        }
    }
}

/// Whether the device can run it at all.
fn check(info: &DeviceInfo, module: &Module) -> Result<()> {
    let fail = |what: String| Err(Error::refused(format!("shader {} {what} ({})", module.name, info.name)));
    if let Some(missing) = module.capabilities.iter().find(|c| !info.capabilities.contains(c)) {
        return fail(format!("needs {missing:?}, which this device lacks"));
    }
    if module.bindings.len() as u32 > info.max_bindings {
        return fail(format!(
            "binds {} buffers, the device allows {}",
            module.bindings.len(),
            info.max_bindings
        ));
    }
    let threads = module.workgroup.iter().product::<u32>();
    if threads > info.max_workgroup_threads {
        return fail(format!(
            "has {threads} threads a group, the device allows {}",
            info.max_workgroup_threads
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::module::{Access, Binding, Capability};

    static MODULE: Module = Module {
        name: "double[SIZE=4]",
        variant: &[4],
        subgroup_size: None,
        float_atomics: None,
        workgroup: [64, 1, 1],
        push_bytes: 0,
        capabilities: &[Capability::Int64],
        bindings: &[Binding {
            number: 0,
            name: "values",
            access: Access { read: true, write: true },
            element: "u32",
        }],
        spirv: &[],
    };

    #[test]
    fn a_module_beyond_the_device_is_refused_by_name() {
        let info = DeviceInfo {
            capabilities: [Capability::Int64].into(),
            max_bindings: 4,
            max_workgroup_threads: 64,
            ..DeviceInfo::default()
        };
        assert!(check(&info, &MODULE).is_ok());
        let refused = |info: DeviceInfo, reason: &str| {
            let message = check(&info, &MODULE).unwrap_err().to_string();
            assert!(message.contains(MODULE.name) && message.contains(reason), "{message}");
        };
        refused(DeviceInfo { capabilities: [].into(), ..info.clone() }, "needs Int64");
        refused(DeviceInfo { max_bindings: 0, ..info.clone() }, "the device allows 0");
        refused(DeviceInfo { max_workgroup_threads: 1, ..info.clone() }, "the device allows 1");
    }
}
