//! Kernel variants of the rasteriser.
use super::frame::{GradientReduction, TileSums};
use super::project_backward::{self, ShGradientKernel};
use super::tile_lists::TileBinning;
use crate::gpu::Device;

/// Choices among kernel variants that compute the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceChoices {
    /// Binning of the tile lists.
    pub grouping: TileBinning,
    /// Reduction of the gradients over tiles.
    pub summation: GradientReduction,
    /// Reduction of the gradients over the pixels of a tile.
    pub tile_sums: TileSums,
    /// Writing of the gradients by the SH coefficients.
    pub sh_gradients: ShGradientKernel,
    /// Most workgroups of the backward pass of the projection.
    pub projection_groups: u32,
}

impl DeviceChoices {
    /// Fastest choices for the device.
    pub fn of(device: &Device) -> DeviceChoices {
        DeviceChoices {
            grouping: TileBinning::of(device),
            summation: GradientReduction::of(device),
            tile_sums: TileSums::of(device),
            sh_gradients: ShGradientKernel::of(device),
            projection_groups: project_backward::most_groups(device),
        }
    }
}
