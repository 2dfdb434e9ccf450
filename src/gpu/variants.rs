//! Kernel variants that compute the same. One replaces another that gave wrong results on a device,
//! or that was slower there.
use splatvk_gpu::{DeviceInfo, NATIVE_FLOAT_ATOMICS};
use std::collections::BTreeSet;

/// One of two or more implementations of a pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum KernelVariant {
    /// Native `atomicAdd` on float for the sums of gradients, where the device has it.
    FloatAtomics,
    /// Gradients of several tiles summed by atomics ([`crate::pass::GradientReduction::Atomics`]).
    /// Without native float atomics a compare-and-swap loop emulates them.
    AtomicGradients,
    /// Gradients stored per tile and summed in order ([`crate::pass::GradientReduction::Entries`]).
    StoredGradients,
    /// Gradients of a tile reduced by shuffles ([`crate::pass::TileSums::Shuffles`]).
    ShuffledSums,
    /// Gradients of a tile reduced in shared memory ([`crate::pass::TileSums::Shared`]).
    SharedSums,
    /// Radix sort with a chunk per lane ([`crate::pass::sort::SortAlgorithm::Chunks`]).
    ChunkSort,
    /// OneSweep radix sort ([`crate::pass::sort::SortAlgorithm::Sweep`]).
    SweepSort,
    /// Tile lists by counters ([`crate::pass::TileBinning::Counting`]).
    CountedLists,
    /// Tile lists by a sort ([`crate::pass::TileBinning::Sorting`]).
    SortedLists,
    /// SSIM with a strip of a row per thread ([`crate::pass::ssim_l1::SsimRowKernel::Strips`]).
    SsimStrips,
    /// SSIM with a span of a row per workgroup ([`crate::pass::ssim_l1::SsimRowKernel::Shared`]).
    SsimShared,
    /// SH gradients written by the thread of their splat
    /// ([`crate::pass::ShGradientKernel::PerThread`]).
    ShPerThread,
    /// SH gradients written by a workgroup in the order of memory
    /// ([`crate::pass::ShGradientKernel::Shared`]).
    ShShared,
    /// Gradients of the parameters in memory between the backward pass of the projection and Adam
    /// ([`crate::pass::UpdateKernel::Separate`]).
    SeparateUpdate,
    /// Both in one pass ([`crate::pass::UpdateKernel::Fused`]).
    FusedUpdate,
    /// Plane sweep of stereo by the processor ([`crate::pass::plane_sweep_cpu`]).
    HostSweep,
    /// Plane sweep of stereo by shaders ([`crate::pass::plane_sweep`]).
    DeviceSweep,
    /// Search of frames for text queries by the processor ([`crate::query::frame::HostSearch`]).
    HostQuery,
    /// Search of frames for text queries by shaders ([`crate::pass::query_peaks`]).
    DeviceQuery,
    /// Native code in place of shaders where the device is the processor ([`crate::native`]).
    NativePasses,
    /// Shaders everywhere.
    ShaderPasses,
}

impl KernelVariant {
    /// All of them.
    pub const ALL: [KernelVariant; 21] = [
        KernelVariant::FloatAtomics,
        KernelVariant::AtomicGradients,
        KernelVariant::StoredGradients,
        KernelVariant::ShuffledSums,
        KernelVariant::SharedSums,
        KernelVariant::ChunkSort,
        KernelVariant::SweepSort,
        KernelVariant::CountedLists,
        KernelVariant::SortedLists,
        KernelVariant::SsimStrips,
        KernelVariant::SsimShared,
        KernelVariant::ShPerThread,
        KernelVariant::ShShared,
        KernelVariant::SeparateUpdate,
        KernelVariant::FusedUpdate,
        KernelVariant::HostSweep,
        KernelVariant::DeviceSweep,
        KernelVariant::HostQuery,
        KernelVariant::DeviceQuery,
        KernelVariant::NativePasses,
        KernelVariant::ShaderPasses,
    ];

    /// The name that `splatvk doctor` prints and [`crate::gpu::Options::disabled`] takes.
    pub fn name(self) -> &'static str {
        match self {
            KernelVariant::FloatAtomics => NATIVE_FLOAT_ATOMICS,
            KernelVariant::AtomicGradients => "gradients by atomics",
            KernelVariant::StoredGradients => "gradients by stored entries",
            KernelVariant::ShuffledSums => "tile sums by shuffles",
            KernelVariant::SharedSums => "tile sums in shared memory",
            KernelVariant::ChunkSort => "sort in chunks",
            KernelVariant::SweepSort => "sort in one sweep",
            KernelVariant::CountedLists => "tile lists by counters",
            KernelVariant::SortedLists => "tile lists by sorting",
            KernelVariant::SsimStrips => "rows in strips",
            KernelVariant::SsimShared => "rows in shared memory",
            KernelVariant::ShPerThread => "SH gradients per thread",
            KernelVariant::ShShared => "SH gradients in shared memory",
            KernelVariant::SeparateUpdate => "update in two passes",
            KernelVariant::FusedUpdate => "update in one pass",
            KernelVariant::HostSweep => "plane sweep on the host",
            KernelVariant::DeviceSweep => "plane sweep on the device",
            KernelVariant::HostQuery => "text queries on the host",
            KernelVariant::DeviceQuery => "text queries on the device",
            KernelVariant::NativePasses => "native passes",
            KernelVariant::ShaderPasses => "shader passes",
        }
    }

    /// The variant that takes its place where it is disabled.
    pub fn replacement(self) -> KernelVariant {
        match self {
            KernelVariant::FloatAtomics => KernelVariant::AtomicGradients,
            KernelVariant::AtomicGradients => KernelVariant::StoredGradients,
            KernelVariant::StoredGradients => KernelVariant::AtomicGradients,
            KernelVariant::ShuffledSums => KernelVariant::SharedSums,
            KernelVariant::SharedSums => KernelVariant::ShuffledSums,
            KernelVariant::ChunkSort => KernelVariant::SweepSort,
            KernelVariant::SweepSort => KernelVariant::ChunkSort,
            KernelVariant::CountedLists => KernelVariant::SortedLists,
            KernelVariant::SortedLists => KernelVariant::CountedLists,
            KernelVariant::SsimStrips => KernelVariant::SsimShared,
            KernelVariant::SsimShared => KernelVariant::SsimStrips,
            KernelVariant::ShPerThread => KernelVariant::ShShared,
            KernelVariant::ShShared => KernelVariant::ShPerThread,
            KernelVariant::SeparateUpdate => KernelVariant::FusedUpdate,
            KernelVariant::FusedUpdate => KernelVariant::SeparateUpdate,
            KernelVariant::HostSweep => KernelVariant::DeviceSweep,
            KernelVariant::DeviceSweep => KernelVariant::HostSweep,
            KernelVariant::HostQuery => KernelVariant::DeviceQuery,
            KernelVariant::DeviceQuery => KernelVariant::HostQuery,
            KernelVariant::NativePasses => KernelVariant::ShaderPasses,
            KernelVariant::ShaderPasses => KernelVariant::NativePasses,
        }
    }

    /// This variant, or its replacement where it alone is disabled.
    pub fn or_replacement(self, info: &DeviceInfo) -> KernelVariant {
        let other = self.replacement();
        let disabled = |variant: KernelVariant| info.disabled.contains(variant.name());
        if disabled(self) && !disabled(other) { other } else { self }
    }
}

/// Two kernel variants that replace each other: the defaults by kind of device, and the replacement
/// of a default.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct VariantPair {
    /// Default on CPU devices.
    pub on_cpu: KernelVariant,
    /// Default on GPUs.
    pub on_gpu: KernelVariant,
}

const fn pair(on_cpu: KernelVariant, on_gpu: KernelVariant) -> VariantPair {
    VariantPair { on_cpu, on_gpu }
}

impl VariantPair {
    /// Radix sorts.
    pub const SORTS: VariantPair = pair(KernelVariant::ChunkSort, KernelVariant::SweepSort);
    /// Binnings of the tile lists.
    pub const LISTS: VariantPair = pair(KernelVariant::CountedLists, KernelVariant::SortedLists);
    /// Reductions of gradients over the pixels of a tile.
    pub const TILE_SUMS: VariantPair = pair(KernelVariant::ShuffledSums, KernelVariant::SharedSums);
    /// Reductions of gradients over tiles. Atomics are the default everywhere.
    pub const GRADIENTS: VariantPair = pair(KernelVariant::AtomicGradients, KernelVariant::AtomicGradients);
    /// Kernels of the SH gradients.
    pub const SH: VariantPair = pair(KernelVariant::ShPerThread, KernelVariant::ShShared);
    /// Updates of the parameters.
    pub const UPDATES: VariantPair = pair(KernelVariant::SeparateUpdate, KernelVariant::FusedUpdate);
    /// Row kernels of SSIM.
    pub const SSIM_ROWS: VariantPair = pair(KernelVariant::SsimStrips, KernelVariant::SsimShared);
    /// Plane sweeps of stereo.
    pub const SWEEPS: VariantPair = pair(KernelVariant::HostSweep, KernelVariant::DeviceSweep);
    /// Searches for text queries.
    pub const QUERIES: VariantPair = pair(KernelVariant::HostQuery, KernelVariant::DeviceQuery);

    /// Pairs that are timed on a device, those first that later ones build on.
    pub const TIMED: [VariantPair; 7] = [
        VariantPair::SORTS,
        VariantPair::LISTS,
        VariantPair::TILE_SUMS,
        VariantPair::GRADIENTS,
        VariantPair::SH,
        VariantPair::UPDATES,
        VariantPair::SSIM_ROWS,
    ];

    /// The default on CPU devices or on GPUs, and its replacement.
    pub fn variants(self, is_cpu: bool) -> [KernelVariant; 2] {
        let default = if is_cpu { self.on_cpu } else { self.on_gpu };
        [default, default.replacement()]
    }

    /// The default, or its replacement where that is among `preferred` names.
    pub fn preferred(self, is_cpu: bool, preferred: &BTreeSet<String>) -> KernelVariant {
        let [default, other] = self.variants(is_cpu);
        if preferred.contains(other.name()) { other } else { default }
    }

    /// The variant to use on a device: the preferred one, unless it alone is disabled.
    ///
    /// A deterministic device keeps the defaults, so that its bits depend on no timing. So does one
    /// on which native code replaces the shaders: only the defaults have native code, and
    /// preferences are those of shaders.
    pub fn chosen(self, info: &DeviceInfo) -> KernelVariant {
        let nothing = BTreeSet::new();
        let keeps_defaults = info.deterministic || replaces_shaders(info, &info.disabled);
        let preferred = info.preferred.as_ref().filter(|_| !keeps_defaults).unwrap_or(&nothing);
        self.preferred(info.is_cpu, preferred).or_replacement(info)
    }
}

/// Whether native code replaces shaders on a device with these disabled variants.
pub fn replaces_shaders(info: &DeviceInfo, disabled: &BTreeSet<String>) -> bool {
    info.is_cpu && info.mapped && !disabled.contains(KernelVariant::NativePasses.name())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, TestDevice, options, test_device};
    use crate::pass::sort::SortAlgorithm;
    use crate::pass::ssim_l1::SsimRowKernel;
    use crate::pass::{GradientReduction, ShGradientKernel, TileBinning, TileSums, UpdateKernel};

    #[test]
    fn disabled_variants_are_replaced() {
        let usual = test_device();
        let without = |disabled: &[KernelVariant]| {
            let disabled = disabled.iter().map(|v| v.name().to_owned()).collect();
            TestDevice::open(&Options { disabled, ..options(None) }).unwrap()
        };
        let most: Vec<_> =
            KernelVariant::ALL.into_iter().filter(|v| *v != KernelVariant::SweepSort).collect();
        let device = without(&most);
        assert_eq!(SortAlgorithm::of(&device), SortAlgorithm::Sweep);
        assert_eq!(SsimRowKernel::of(&device), SsimRowKernel::of(&usual));
        assert_eq!(TileSums::of(&device), TileSums::of(&usual));
        assert!(!device.info().float_atomics);
        // Both variants are disabled, so neither replaces the other.
        assert_eq!(GradientReduction::of(&device), GradientReduction::of(&usual));
        assert_eq!(TileBinning::of(&device), TileBinning::of(&usual));
        let device = without(&[
            KernelVariant::AtomicGradients,
            KernelVariant::CountedLists,
            KernelVariant::ShuffledSums,
        ]);
        assert_eq!(TileSums::of(&device), TileSums::Shared);
        assert_eq!(GradientReduction::of(&device), GradientReduction::Entries);
        assert_eq!(TileBinning::of(&device), TileBinning::Sorting);
        assert_eq!(device.info().float_atomics, usual.info().float_atomics);
        let other = if usual.info().is_cpu { KernelVariant::ShPerThread } else { KernelVariant::ShShared };
        assert_ne!(ShGradientKernel::of(&without(&[other])), ShGradientKernel::of(&usual));
    }

    /// A device that runs shaders and prefers the variants that are no defaults on it.
    fn preferring_others(disabled: &[KernelVariant], deterministic: bool) -> TestDevice {
        let is_cpu = test_device().info().is_cpu;
        let names = |variants: &[KernelVariant]| variants.iter().map(|v| v.name().to_owned()).collect();
        let preferred: BTreeSet<String> = names(&VariantPair::TIMED.map(|pair| pair.variants(is_cpu)[1]));
        let disabled = names(disabled);
        let preferred = Some(preferred);
        TestDevice::open(&Options { disabled, preferred, deterministic, ..options(None) }).unwrap()
    }

    #[test]
    fn preferred_variants_replace_defaults() {
        let usual = test_device();
        let device = preferring_others(&[KernelVariant::NativePasses], false);
        assert_ne!(SortAlgorithm::of(&device), SortAlgorithm::of(&usual));
        assert_ne!(SsimRowKernel::of(&device), SsimRowKernel::of(&usual));
        assert_ne!(TileSums::of(&device), TileSums::of(&usual));
        assert_ne!(TileBinning::of(&device), TileBinning::of(&usual));
        assert_ne!(ShGradientKernel::of(&device), ShGradientKernel::of(&usual));
        assert_ne!(UpdateKernel::of(device.info()), UpdateKernel::of(usual.info()));
        assert_eq!(GradientReduction::of(&device), GradientReduction::Entries);
    }

    #[test]
    fn disabled_beats_preferred() {
        let usual = test_device();
        let [_, other] = VariantPair::SORTS.variants(usual.info().is_cpu);
        let off = [KernelVariant::NativePasses, other, KernelVariant::StoredGradients];
        let device = preferring_others(&off, false);
        assert_eq!(SortAlgorithm::of(&device), SortAlgorithm::of(&usual));
        assert_eq!(GradientReduction::of(&device), GradientReduction::Atomics);
        assert_ne!(TileSums::of(&device), TileSums::of(&usual));
    }

    #[test]
    fn deterministic_and_native_keep_defaults() {
        let usual = test_device();
        let defaults = |device: &TestDevice| {
            for pair in VariantPair::TIMED {
                assert_eq!(pair.chosen(device.info()), pair.variants(device.info().is_cpu)[0]);
            }
        };
        defaults(&preferring_others(&[KernelVariant::NativePasses], true));
        if replaces_shaders(usual.info(), &BTreeSet::new()) {
            defaults(&preferring_others(&[], false));
        }
    }
}
