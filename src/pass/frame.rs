//! Buffers of one frame, and the gradients that its backward pass stores per entry of the tile
//! lists.
use super::bands::Bands;
use super::channels::{Block, blocks};
use super::tile_lists::{TILE, TileLists};
use crate::Result;
use crate::gpu::{self, Buffer, Device, KernelVariant, VariantPair, shaders};
use crate::sync::lock;
use std::ops::Range;

/// Buffers of one frame. Pixel planes are planar [C, H, W], f32; H is the stored rows of a band
/// where there are several bands.
pub struct FrameBuffers {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Bands of the image; one if it fits.
    pub bands: Bands,
    /// d.
    pub feature_dim: usize,
    /// [4 + d, H, W]: RGB on the background, Σ w z, features. Written by the forward pass.
    pub planes: Buffer<f32>,
    /// [H, W] final transmittance T_f; alpha = 1 − T_f.
    pub transmittance: Buffer<f32>,
    /// [4 + d + 1, H, W]: gradient of the loss by `planes` and, last, by alpha. Zero at first; a
    /// loss overwrites the planes that it uses. Read by the backward pass.
    pub planes_grad: Buffer<f32>,
    /// [10]: gradient by the left pose twist (ρ, θ) and by fx, fy, cx, cy. Written by the backward
    /// pass.
    pub camera_grad: Buffer<f32>,
    /// [3] u32: tile-list entries of this frame; the number needed if a frame did not fit since the
    /// last `grow`, else 0; the longest tile list so far, with [`super::TileBinning::Counting`].
    pub status: Buffer<u32>,
    pub(super) projected: Buffer<f32>,
    pub(super) projected_grad: Buffer<f32>,
    pub(super) camera_parts: Buffer<f32>,
    pub(super) summation: GradientReduction,
    pub(super) tile_sums: TileSums,
    pub(super) gradient_entries: GradientEntries,
    pub(super) codes: Buffer<f32>,
    pub(super) codes_grad: Buffer<f32>,
    pub(super) depth_pairs: Buffer<u32>,
    pub(super) lists: TileLists,
}

/// Rows of tiles of a raster pass.
#[derive(Clone)]
pub(super) struct Tiles {
    pub rows: Range<u32>,
    /// First row of tiles in the lists.
    pub list_row: u32,
    /// First row of pixels in the planes.
    pub top: u32,
}

impl FrameBuffers {
    /// Pixels of the planes: those of the image, or of a band.
    pub fn pixels(&self) -> u32 {
        self.bands.pixels() as u32
    }

    /// [N, 3] gradient by the colour of every splat in the last backward pass: `∂L/∂c_i = Σ_px
    /// w_i(px) ∂L/∂C(px)`, so that an upstream of ones gives the blending weights.
    pub fn colour_gradients(&self, splats: usize) -> Result<Vec<[f32; 3]>> {
        const FIRST: usize = shaders::shared::layout::MOMENTS as usize;
        let sums = self.projected_grad.read_range(0..GRADIENT_FLOATS * splats)?;
        Ok(sums.chunks_exact(GRADIENT_FLOATS).map(|g| [g[FIRST], g[FIRST + 1], g[FIRST + 2]]).collect())
    }

    /// Tiles along x and y.
    pub(super) fn tiles(&self) -> [u32; 2] {
        [self.width.div_ceil(TILE), self.height.div_ceil(TILE)]
    }

    /// Floats per splat in `codes`: d, rounded up to whole vectors.
    pub(super) fn code_stride(&self) -> u32 {
        (self.feature_dim as u32).next_multiple_of(4)
    }
}

/// Floats per splat in the gradient buffer: moments, RGB and z in whole vectors.
pub(super) const GRADIENT_FLOATS: usize = shaders::shared::layout::GRADIENT_FLOATS as usize;
/// Floats per splat on the screen.
pub(super) const PROJECTED_FLOATS: usize = shaders::shared::layout::PROJECTED_FLOATS as usize;
/// Gradient by the camera: twist (ρ, θ), fx, fy, cx, cy.
pub(super) const CAMERA_GRADIENTS: usize = shaders::shared::layout::CAMERA_GRADIENTS as usize;

/// Bytes per entry of the widest buffer of [`GradientReduction::Entries`]: the features of one
/// dispatch.
pub(super) fn entry_bytes(feature_dim: usize) -> usize {
    4 * GRADIENT_FLOATS.max(4 * widest_block(feature_dim) as usize)
}

/// Vectors of features in the widest dispatch.
fn widest_block(feature_dim: usize) -> u32 {
    blocks(feature_dim as u32).iter().map(Block::vectors).max().unwrap_or(0)
}

/// Reduction of the gradients of one splat over its tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GradientReduction {
    /// Float atomics: no memory, but the order of the additions, and so the last digits, differ
    /// from run to run.
    Atomics,
    /// Every tile stores its gradients per entry, and a second pass sums them per splat: the same
    /// bits on every run, for 48 bytes per entry and about a tenth more time per step (lavapipe,
    /// 100,000 splats).
    Entries,
}

/// Reduction of the gradients of one splat over the pixels of a tile, for the base channels and
/// [`GradientReduction::Atomics`]. Blocks of features and stored entries use shuffles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TileSums {
    /// Butterflies of shuffles, for CPU devices: a barrier takes about a microsecond there.
    Shuffles,
    /// Sums over numbers per splat and pixel in shared memory, for GPUs.
    Shared,
}

impl TileSums {
    /// The faster reduction for the device, unless it is disabled.
    pub fn of(device: &Device) -> TileSums {
        match VariantPair::TILE_SUMS.chosen(device.info()) {
            KernelVariant::ShuffledSums => TileSums::Shuffles,
            _ => TileSums::Shared,
        }
    }
}

/// Gradients per entry of the tile lists; allocated at first use, since rendering does not need
/// them.
#[derive(Default)]
pub(super) struct GradientEntries(std::sync::Mutex<Option<EntryBuffers>>);

#[derive(Clone)]
pub(super) struct EntryBuffers {
    capacity: usize,
    /// [capacity, 12] as `projected_grad`, and [capacity, vectors of a block] for one block after
    /// the other.
    pub splats: Buffer<f32>,
    pub codes: Buffer<f32>,
}

impl GradientReduction {
    /// The faster reduction, unless it is disabled or the device was opened as deterministic.
    pub fn of(device: &Device) -> GradientReduction {
        let info = device.info();
        match VariantPair::GRADIENTS.chosen(info) {
            KernelVariant::AtomicGradients if !info.deterministic => GradientReduction::Atomics,
            _ => GradientReduction::Entries,
        }
    }
}

impl GradientEntries {
    /// Buffers for the present capacity of the tile lists.
    pub fn buffers(&self, device: &Device, frame: &FrameBuffers) -> gpu::Result<EntryBuffers> {
        let mut made = lock(&self.0);
        let capacity = frame.lists.capacity;
        if let Some(buffers) = made.as_ref().filter(|b| b.capacity == capacity) {
            return Ok(buffers.clone());
        }
        let floats = |name, each: usize| device.buffer::<f32>(name, (capacity * each).max(4));
        let buffers = EntryBuffers {
            capacity,
            splats: floats("gradient entries", GRADIENT_FLOATS)?,
            codes: floats("code gradient entries", 4 * widest_block(frame.feature_dim) as usize)?,
        };
        *made = Some(buffers.clone());
        Ok(buffers)
    }
}
