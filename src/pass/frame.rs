//! Buffers of one frame, and the gradients that its backward pass stores per entry of the tile
//! lists.
use super::bands::Bands;
use super::channels::{BASE_CHANNELS, Block, blocks};
use super::choices::DeviceChoices;
use super::tile_lists::{TILE, TileLists};
use crate::Result;
use crate::gpu::{self, Buffer, Device, KernelVariant, Recorder, VariantPair, shaders};
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
    /// loss overwrites the planes that it uses. Read by the backward pass. Empty in a rasterizer
    /// for viewing.
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
    /// Allocates the buffers of the forward pass for images of up to `room` pixels and tiles, the
    /// first of this size, and tile lists of `entries`. Those of the backward pass are empty.
    pub(super) fn new(
        device: &Device,
        ([width, height], bands): ([u32; 2], Bands),
        feature_dim: usize,
        choices: &DeviceChoices,
        (splats, [pixels, tiles], entries): (usize, [usize; 2], usize),
    ) -> Result<FrameBuffers> {
        let floats = |name, len| device.buffer::<f32>(name, len);
        let codes = code_floats(feature_dim, splats);
        Ok(FrameBuffers {
            width,
            height,
            bands,
            feature_dim,
            planes: floats("planes", (BASE_CHANNELS + feature_dim) * pixels)?,
            transmittance: floats("transmittance", pixels)?,
            planes_grad: floats("planes_grad", 0)?,
            camera_grad: floats("camera_grad", 0)?,
            status: device.buffer::<u32>("status", 3)?,
            projected: floats("projected", PROJECTED_FLOATS * splats)?,
            projected_grad: floats("projected_grad", 0)?,
            camera_parts: floats("camera_parts", 0)?,
            summation: choices.summation,
            tile_sums: choices.tile_sums,
            gradient_entries: GradientEntries::default(),
            codes: floats("codes", codes)?,
            codes_grad: floats("codes_grad", 0)?,
            depth_pairs: device.buffer::<u32>("depth_pairs", 2 * splats)?,
            lists: TileLists::new(device, choices.grouping, choices.summation, splats, tiles, entries)?,
        })
    }

    /// Allocates the buffers of the backward pass, unless they exist; `groups` of its projection
    /// write partial gradients by the camera.
    pub(super) fn allocate_gradients(
        &mut self,
        device: &Device,
        splats: usize,
        pixels: usize,
        groups: usize,
    ) -> Result<()> {
        if !self.planes_grad.is_empty() {
            return Ok(());
        }
        let floats = |name, len| device.buffer::<f32>(name, len);
        self.camera_grad = floats("camera_grad", CAMERA_GRADIENTS)?;
        self.camera_parts = floats("camera_parts", CAMERA_GRADIENTS * groups)?;
        self.projected_grad = floats("projected_grad", GRADIENT_FLOATS * splats)?;
        self.codes_grad = floats("codes_grad", code_floats(self.feature_dim, splats))?;
        // Last, since the others exist where it does.
        self.planes_grad = floats("planes_grad", (BASE_CHANNELS + self.feature_dim + 1) * pixels)?;
        Ok(())
    }

    /// Refuses a recording of the backward pass without its buffers.
    pub(super) fn require_gradients(&self, rec: &mut Recorder) {
        if self.planes_grad.is_empty() {
            rec.fail("a rasterizer for viewing has no buffers of the backward pass");
        }
    }

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

/// Floats of the codes of all splats; some without features, since shaders bind them.
fn code_floats(feature_dim: usize, splats: usize) -> usize {
    (feature_dim.next_multiple_of(4) * splats).max(4)
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
