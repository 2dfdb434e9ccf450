//! What build.rs knows about the compiled shaders, as data.

/// How a module touches a buffer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Access {
    /// Some load or atomic reads it.
    pub read: bool,
    /// Some store or atomic writes it.
    pub write: bool,
}

/// One storage buffer of a module (descriptor set 0).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Binding {
    /// `layout(binding = number)`.
    pub number: u32,
    /// Block name in snake case.
    pub name: &'static str,
    /// What this variant does with it.
    pub access: Access,
    /// What its block holds: `f32`, `i32`, `u32` or a structure of `shaders::structs`, as the element of [`crate::Buffer`].
    /// Floats that are added to atomically are `f32` also where the module keeps their bits.
    pub element: &'static str,
}

/// What a module needs beyond Vulkan 1.2's minimum.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[allow(missing_docs)]
#[non_exhaustive]
pub enum Capability {
    Float16,
    Float64,
    Int64,
    Int16,
    Int8,
    Storage16,
    Storage8,
    SubgroupBasic,
    SubgroupVote,
    SubgroupArithmetic,
    SubgroupBallot,
    SubgroupShuffle,
    SubgroupShuffleRelative,
    AtomicFloatAdd,
}

/// One compiled variant of a shader file.
#[derive(Debug)]
pub struct Module {
    /// Unique: file and macros, e.g. `raster[CHANNELS=4,SUBGROUP_SIZE=8]`.
    pub name: &'static str,
    /// Values of [`Family::axes`].
    pub variant: &'static [u32],
    /// The subgroup size it was compiled for, when the file has a `// subgroups:` line.
    pub subgroup_size: Option<u32>,
    /// Native atomics or CAS loop, when the file includes `shared/atomic_float.glsl`.
    pub float_atomics: Option<bool>,
    /// `local_size`.
    pub workgroup: [u32; 3],
    /// Size of the push constant block.
    pub push_bytes: u32,
    /// Device features it needs.
    pub capabilities: &'static [Capability],
    /// Storage buffers, by number.
    pub bindings: &'static [Binding],
    /// Optimised SPIR-V 1.5.
    pub spirv: &'static [u8],
}

/// All variants of one shader file.
#[derive(Debug)]
pub struct Family {
    /// File stem.
    pub name: &'static str,
    /// The macros that the host chooses.
    pub axes: &'static [&'static str],
    /// Every combination of variant, subgroup size and atomics.
    pub modules: &'static [Module],
}
