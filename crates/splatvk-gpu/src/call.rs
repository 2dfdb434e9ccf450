//! A shader with everything that one call needs.
use crate::buffer::Buffer;
use crate::info::DeviceInfo;
use crate::module::{Family, Module};
use crate::{Error, Result};
use std::collections::BTreeSet;

/// A shader with its buffers and push constants, built by the generated `call` functions.
#[derive(Clone, Debug)]
pub struct Call {
    pub(crate) family: &'static Family,
    pub(crate) variant: Vec<u32>,
    pub(crate) buffers: Vec<(u32, Buffer)>,
    pub(crate) push: Vec<u8>,
}

impl Call {
    /// A call of a shader of one's own: one of the family's variants, a buffer per binding number,
    /// and the push constants as the shader lays them out. Generated `shaders::NAME::call`
    /// functions check all of that at compile time; here a missing buffer is an error when the
    /// recording is compiled.
    pub fn new(
        family: &'static Family,
        variant: Vec<u32>,
        buffers: Vec<(u32, Buffer)>,
        push: Vec<u8>,
    ) -> Self {
        Call { family, variant, buffers, push }
    }

    /// Its buffers by binding number.
    #[doc(hidden)]
    pub fn buffers(&self) -> &[(u32, Buffer)] {
        &self.buffers
    }

    /// Its push constants, as the shader lays them out.
    #[doc(hidden)]
    pub fn push(&self) -> &[u8] {
        &self.push
    }

    /// The compiled variant that serves it on a device.
    pub(crate) fn resolve(&self, info: &DeviceInfo) -> Result<&'static Module> {
        let family = self.family;
        let named: Vec<&Module> = family.modules.iter().filter(|m| m.variant == self.variant).collect();
        if named.is_empty() {
            let known: BTreeSet<&[u32]> = family.modules.iter().map(|m| m.variant).collect();
            return Err(Error::refused(format!(
                "{}.comp was not compiled for {:?} = {:?}, only for {known:?}: extend its `// variants:` line",
                family.name, family.axes, self.variant
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
                Error::refused(format!(
                    "{}.comp has no variant for subgroups of {low} to {high} threads ({}): extend its `// subgroups:` line",
                    family.name, info.name
                ))
            })
    }
}
