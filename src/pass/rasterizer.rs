//! The training-facing render: parameters and gradients in GPU buffers, forward and backward as recorded commands.
//!
//! ```no_run
//! # use splatvk::{gpu::{Device, Recorder}, pass::rasterizer::*, pass::view::View, scene::{Camera, Splats}};
//! # fn step(splats: &Splats, camera: &Camera) -> splatvk::Result<()> {
//! let device = Device::open(None)?;
//! let params = SplatBuffers::upload(&device, splats, &[], 0)?;
//! let grads = params.zeros_like(&device)?;
//! let mut raster = Rasterizer::new(&device, params.count, params.feature_dim, camera.width, camera.height)?;
//! let options = RasterOptions::default();
//!
//! raster.set_view(&View::new(camera, 0.02))?;
//! raster.forward(&params, &options)?;               // runs; grows its lists and repeats if they were too short
//! let mut rec = Recorder::new(&device, "step");
//! // … a loss pass reads raster.frame().planes and writes raster.frame().planes_grad …
//! raster.record_backward(&mut rec, &params, &options, &grads);
//! // … an optimiser pass reads grads and writes params …
//! rec.run()?;
//! let twist = raster.frame().camera_grad.read::<f32>()?; // ρ (3), θ (3), fx, fy, cx, cy
//! # Ok(())
//! # }
//! ```
//!
//! A whole step may also be one [`crate::gpu::Program`]: [`Rasterizer::record_forward`], loss,
//! [`Rasterizer::record_backward`], optimiser. It can be run again for other views after [`Rasterizer::set_view`].
//! Then check [`Rasterizer::overflow`] after each run: if the lists did not fit, that step saw an image without any
//! splats; call [`Rasterizer::grow`], record again and repeat the step (an optimiser pass can read
//! `frame().status[1]` on the GPU and do nothing when it is not 0).
//!
//! Recordings hold the buffers they were made with: record again after `grow`, after changing the number of splats,
//! the SH degree or the options.
//!
//! An image that is too large for the device is rendered in bands ([`super::bands`]), one after the other in the same
//! planes: [`Rasterizer::record_projection`], then for every band [`Rasterizer::record_band`], loss,
//! [`Rasterizer::record_band_backward`], and at the end [`Rasterizer::record_gradients`]. An image that fits is one band.
use super::bands::{Band, Bands};
use super::bin::{Grouping, TileLists};
use super::raster_backward::{GradientEntries, Summation};
use super::sort::Sort;
use super::twin::FeatureMode;
use super::view::{VIEW_FLOATS, View};
use super::{bin, project, project_backward, raster_backward, raster_forward};
use crate::gpu::{Buffer, Device, Recorder};
use crate::scene::{Splats, sh_coefficients};
use crate::{Error, Result};
use std::ops::Range;

/// Raw parameters of N splats, or gradients by them, on the GPU.
#[derive(Clone)]
pub struct SplatBuffers {
    /// N. Buffers may be longer (after pruning); only the first N splats are used.
    pub count: usize,
    /// Degree of the stored coefficients, 0–3.
    pub sh_degree: u32,
    /// d.
    pub feature_dim: usize,
    /// [N, 3] f32, world units.
    pub means: Buffer,
    /// [N, 3] f32, natural logs.
    pub log_scales: Buffer,
    /// [N, 4] f32 (w, x, y, z), not necessarily normalised.
    pub quats: Buffer,
    /// [N] f32.
    pub opacity_logits: Buffer,
    /// [N, (sh_degree+1)², 3] f32, DC first, RGB interleaved.
    pub sh: Buffer,
    /// [N, d] f32 raw features (a single unused float when d = 0).
    pub features: Buffer,
}

impl SplatBuffers {
    /// Copies splats and their features [N, d] to the GPU (`features` empty and d = 0 for none).
    pub fn upload(
        device: &Device,
        splats: &Splats,
        features: &[f32],
        feature_dim: usize,
    ) -> Result<SplatBuffers> {
        let n = splats.len();
        let lengths = [splats.log_scales.len(), splats.quats.len(), splats.opacity_logits.len()];
        if lengths.iter().any(|&l| l != n) || splats.sh.len() != n * 3 * splats.sh_len() {
            return Err(Error::work(format!("splats with {n} means have other arrays of different lengths")));
        }
        if features.len() != n * feature_dim {
            let given = features.len();
            return Err(Error::work(format!("{given} feature values do not make {n} × {feature_dim}")));
        }
        let out = SplatBuffers::zeros(device, "splats", n, splats.sh_degree, feature_dim)?;
        if n > 0 {
            out.means.write(&splats.means)?;
            out.log_scales.write(&splats.log_scales)?;
            out.quats.write(&splats.quats)?;
            out.opacity_logits.write(&splats.opacity_logits)?;
            out.sh.write(&splats.sh)?;
        }
        if !features.is_empty() {
            out.features.write(features)?;
        }
        Ok(out)
    }

    /// Zero-filled buffers for `count` splats; `label` begins their names.
    pub fn zeros(
        device: &Device,
        label: &str,
        count: usize,
        sh_degree: u32,
        feature_dim: usize,
    ) -> Result<SplatBuffers> {
        let make =
            |name: &str, floats: usize| device.buffer::<f32>(&format!("{label} {name}"), floats.max(4));
        Ok(SplatBuffers {
            count,
            sh_degree,
            feature_dim,
            means: make("means", 3 * count)?,
            log_scales: make("log_scales", 3 * count)?,
            quats: make("quats", 4 * count)?,
            opacity_logits: make("opacity_logits", count)?,
            sh: make("sh", 3 * count * sh_coefficients(sh_degree))?,
            features: make("features", count * feature_dim)?,
        })
    }

    /// Zero-filled buffers of the same shape, for gradients or optimiser moments.
    pub fn zeros_like(&self, device: &Device) -> Result<SplatBuffers> {
        SplatBuffers::zeros(device, "gradient", self.count, self.sh_degree, self.feature_dim)
    }

    /// SH coefficients per channel.
    pub fn sh_len(&self) -> usize {
        sh_coefficients(self.sh_degree)
    }

    /// Back to the host: splats and features [N, d].
    pub fn download(&self) -> Result<(Splats, Vec<f32>)> {
        let n = self.count;
        let floats = |b: &Buffer, len: usize| b.read_range::<f32>(0..len);
        let splats = Splats {
            means: triples(&floats(&self.means, 3 * n)?),
            log_scales: triples(&floats(&self.log_scales, 3 * n)?),
            quats: floats(&self.quats, 4 * n)?.chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]).collect(),
            opacity_logits: floats(&self.opacity_logits, n)?,
            sh_degree: self.sh_degree,
            sh: floats(&self.sh, 3 * n * self.sh_len())?,
        };
        Ok((splats, floats(&self.features, n * self.feature_dim)?))
    }
}

fn triples(values: &[f32]) -> Vec<[f32; 3]> {
    values.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect()
}

/// How to render.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RasterOptions {
    /// Degree used, at most the stored one.
    pub sh_degree: u32,
    /// From stored to rendered features.
    pub feature_mode: FeatureMode,
    /// Whether the loss on the features reaches means, scales, rotations and opacities.
    pub features_move_geometry: bool,
}

impl Default for RasterOptions {
    /// Degree 0; ε = 1e-3 as in docs/method.md#feature-gauge.
    fn default() -> Self {
        RasterOptions {
            sh_degree: 0,
            feature_mode: FeatureMode::Gauge { epsilon: 1e-3, blocks: 1 },
            features_move_geometry: true,
        }
    }
}

/// Buffers of one frame; pixel planes are planar [C, H, W], f32, with H the rows of one band where there are several.
pub struct FrameBuffers {
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// How the image is divided; one band if it fits.
    pub bands: Bands,
    /// d.
    pub feature_dim: usize,
    /// [4 + d, H, W]: RGB on the background, Σ w z, features. Written by the forward pass.
    pub planes: Buffer,
    /// [H, W] final transmittance T_f; alpha = 1 − T_f.
    pub transmittance: Buffer,
    /// [H, W] camera z where T falls below ½, 0 where it does not.
    pub median_depth: Buffer,
    /// [4 + d + 1, H, W]: the loss's gradient by `planes` and, last, by alpha. Zero at first; a loss overwrites the planes
    /// it uses. Read by the backward pass.
    pub planes_grad: Buffer,
    /// [10]: gradient by the left pose twist (ρ, θ) and by fx, fy, cx, cy. Written by the backward pass.
    pub camera_grad: Buffer,
    /// [2] u32: tile-list entries of this frame; the number needed if a frame did not fit since the last `grow`, else 0.
    pub status: Buffer,
    pub(super) projected: Buffer,
    pub(super) projected_grad: Buffer,
    pub(super) camera_parts: Buffer,
    pub(super) summation: Summation,
    pub(super) gradient_entries: GradientEntries,
    pub(super) codes: Buffer,
    pub(super) codes_grad: Buffer,
    pub(super) depth_pairs: Buffer,
    pub(super) lists: TileLists,
}

/// Rows of tiles of the image that a raster pass works on.
#[derive(Clone)]
pub(super) struct Tiles {
    pub rows: Range<u32>,
    /// First row of tiles in the lists.
    pub list_row: u32,
    /// First row of pixels in the planes.
    pub top: u32,
}

impl FrameBuffers {
    /// Pixels that the planes hold: the image's, or a band's.
    pub fn pixels(&self) -> u32 {
        self.bands.pixels() as u32
    }

    /// Tiles along x and y.
    pub(super) fn tiles(&self) -> [u32; 2] {
        [self.width.div_ceil(bin::TILE), self.height.div_ceil(bin::TILE)]
    }
    /// Floats per splat in `codes`: d, rounded up to whole vectors.
    pub(super) fn code_stride(&self) -> u32 {
        (self.feature_dim as u32).next_multiple_of(4)
    }
}

/// Choices among passes that lead to the same result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ways {
    /// How tile lists are made.
    pub grouping: Grouping,
    /// How gradients of several tiles are added up.
    pub summation: Summation,
}

impl Ways {
    /// What suits the device.
    pub fn of(device: &Device) -> Ways {
        Ways { grouping: Grouping::of(device), summation: Summation::of(device) }
    }
}

/// Entries that the device binds, with the gradients that some ways of adding up keep for each.
fn most_entries(device: &Device, summation: Summation, feature_dim: usize) -> usize {
    let gradients = match summation {
        Summation::Atomics => usize::MAX,
        Summation::Entries => {
            device.info().max_storage_range as usize / raster_backward::entry_bytes(feature_dim)
        }
    };
    bin::most_entries(device).min(gradients)
}

/// Renders up to N splats with d features at a fixed image size, and back.
pub struct Rasterizer {
    device: Device,
    capacity: usize,
    camera: Buffer,
    frame: FrameBuffers,
    grouping: Grouping,
    /// Rows of tiles whose lists are made at once.
    strip: u32,
    sort: Sort,
    /// [1] u32: N, where the sort reads it.
    count: Buffer,
}

impl Rasterizer {
    /// Room for `capacity` splats with `feature_dim` features (0, or as the splats have), images of width × height.
    pub fn new(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        width: u32,
        height: u32,
    ) -> Result<Rasterizer> {
        Rasterizer::with(device, capacity, feature_dim, width, height, Ways::of(device))
    }

    /// [`Rasterizer::new`] with ways that may not be the device's best: for tests and benchmarks.
    pub fn with(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        width: u32,
        height: u32,
        ways: Ways,
    ) -> Result<Rasterizer> {
        if width == 0 || height == 0 {
            return Err(Error::work("an image of zero size cannot be rendered"));
        }
        let planes = raster_forward::BASE_CHANNELS + feature_dim;
        let bands = Bands::new(device.info(), width as usize, height as usize, planes)?;
        let (pixels, strip) = (bands.pixels(), (bands.rows as u32).div_ceil(bin::TILE));
        let tiles = width.div_ceil(bin::TILE) as usize * strip as usize;
        let splats = capacity.max(1);
        let stride = feature_dim.next_multiple_of(4);
        // About five entries per splat on the seeded scene; `forward` grows the list if that is too few.
        let entries = (8 * splats + 4 * tiles).min(most_entries(device, ways.summation, feature_dim));
        let frame = FrameBuffers {
            width,
            height,
            bands,
            feature_dim,
            planes: device.buffer::<f32>("planes", planes * pixels)?,
            transmittance: device.buffer::<f32>("transmittance", pixels)?,
            median_depth: device.buffer::<f32>("median_depth", pixels)?,
            planes_grad: device.buffer::<f32>("planes_grad", (planes + 1) * pixels)?,
            camera_grad: device.buffer::<f32>("camera_grad", 10)?,
            status: device.buffer::<u32>("status", 2)?,
            projected: device.buffer::<f32>("projected", 12 * splats)?,
            projected_grad: device
                .buffer::<f32>("projected_grad", raster_backward::GRADIENT_FLOATS * splats)?,
            camera_parts: device.buffer::<f32>("camera_parts", 10 * project_backward::CAMERA_PARTS)?,
            summation: ways.summation,
            gradient_entries: GradientEntries::default(),
            codes: device.buffer::<f32>("codes", (stride * splats).max(4))?,
            codes_grad: device.buffer::<f32>("codes_grad", (stride * splats).max(4))?,
            depth_pairs: device.buffer::<[u32; 2]>("depth_pairs", splats)?,
            lists: TileLists::new(device, ways.grouping, splats, tiles, entries)?,
        };
        let camera = device.buffer::<f32>("camera", VIEW_FLOATS)?;
        let sort = Sort::new(device, splats)?;
        let count = device.buffer::<u32>("splat count", 1)?;
        Ok(Rasterizer {
            device: device.clone(),
            capacity,
            camera,
            frame,
            grouping: ways.grouping,
            strip,
            sort,
            count,
        })
    }

    /// The output and gradient planes.
    pub fn frame(&self) -> &FrameBuffers {
        &self.frame
    }

    /// [6] rows of four floats, layout of [`View::to_gpu`]: what later runs of any recording render.
    pub fn camera(&self) -> &Buffer {
        &self.camera
    }

    /// Chooses the view that later runs render.
    pub fn set_view(&self, view: &View) -> Result<()> {
        if view.size != [self.frame.width, self.frame.height] {
            return Err(Error::work(format!(
                "a view of {} × {} does not fit a rasterizer of {} × {}",
                view.size[0], view.size[1], self.frame.width, self.frame.height
            )));
        }
        self.camera.write(&view.to_gpu())
    }

    /// Records projection, depth sort, binning and blending of an image that is one band.
    pub fn record_forward(&self, rec: &mut Recorder, params: &SplatBuffers, options: &RasterOptions) {
        self.refuse_bands(rec);
        self.record_projection(rec, params, options);
        self.record_band(rec, params, &self.frame.bands.get(0));
    }

    /// Records the way back from `frame().planes_grad` to `gradients` (overwritten; zero for unseen splats) and
    /// `frame().camera_grad`. Needs the results of a forward pass with the same parameters, view and options.
    pub fn record_backward(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        options: &RasterOptions,
        gradients: &SplatBuffers,
    ) {
        self.refuse_bands(rec);
        self.record_band_backward(rec, params, options, &self.frame.bands.get(0));
        self.record_gradients(rec, params, options, gradients);
    }

    fn refuse_bands(&self, rec: &mut Recorder) {
        if self.frame.bands.count() > 1 {
            let (w, h, n) = (self.frame.width, self.frame.height, self.frame.bands.count());
            rec.fail(format!("an image of {w} × {h} is rendered in {n} bands here, not at once"));
        }
    }

    /// Records projection and depth sort, which all bands share.
    pub fn record_projection(&self, rec: &mut Recorder, params: &SplatBuffers, options: &RasterOptions) {
        let sh_degree = options.sh_degree.min(params.sh_degree);
        rec.pass("projection");
        project::record(rec, params, &self.camera, &self.frame, sh_degree);
        project::record_features(rec, params, &self.frame, options.feature_mode);
        rec.pass("depth sort");
        // Keys are the bits of camera z. The sort is stable, so equal depths keep the order of the splats.
        rec.fill(&self.count, params.count as u32);
        self.sort.record(rec, &self.frame.depth_pairs, &self.count, 32);
    }

    /// Records binning and blending of a band.
    pub fn record_band(&self, rec: &mut Recorder, params: &SplatBuffers, band: &Band) {
        for tiles in self.strips(band, band.top..band.top + band.rows) {
            self.record_lists(rec, params, &tiles);
            rec.pass("raster forward");
            raster_forward::record(rec, &self.camera, &self.frame, &tiles);
        }
    }

    /// Records the way back from `frame().planes_grad` of the band that was blended last to the splats on the screen: the
    /// first band overwrites, the others add.
    pub fn record_band_backward(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        options: &RasterOptions,
        band: &Band,
    ) {
        rec.pass("raster backward");
        let listed = self.strips(band, band.top..band.top + band.rows);
        let all = self.frame.bands.count() == 1 && listed.len() == 1;
        if band.index == 0 && !(all && self.frame.summation == Summation::Entries) {
            raster_backward::record_clear(rec, &self.frame);
        }
        let inner = self.strips(band, band.inner.clone());
        let strips = match listed.as_slice() {
            // The lists are still there. Sums by entries read every entry, so that the halo writes its zeros.
            [one] if self.frame.summation == Summation::Entries => vec![one.clone()],
            [one] => {
                let rows = inner.first().map_or(0, |t| t.rows.start)..inner.last().map_or(0, |t| t.rows.end);
                vec![Tiles { rows, ..*one }]
            }
            _ => inner,
        };
        for tiles in strips {
            if listed.len() > 1 {
                self.record_lists(rec, params, &tiles);
                rec.pass("raster backward");
            }
            let coupled = options.features_move_geometry;
            raster_backward::record(rec, &self.frame, &tiles, params.count, coupled, all);
        }
    }

    /// Records the rest of the way, from the splats on the screen to `gradients` (overwritten; zero for unseen splats) and
    /// `frame().camera_grad`.
    pub fn record_gradients(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        options: &RasterOptions,
        gradients: &SplatBuffers,
    ) {
        let sh_degree = options.sh_degree.min(params.sh_degree);
        rec.pass("projection backward");
        let camera_grad = &self.frame.camera_grad;
        project_backward::record(rec, params, &self.camera, &self.frame, sh_degree, gradients, camera_grad);
        project_backward::record_features(rec, params, &self.frame, options.feature_mode, gradients);
    }

    fn record_lists(&self, rec: &mut Recorder, params: &SplatBuffers, tiles: &Tiles) {
        rec.pass("binning");
        bin::record(rec, &self.frame, &tiles.rows, params.count, &self.count);
    }

    /// Some rows of pixels of a band as rows of tiles, as many at once as have room in the lists.
    fn strips(&self, band: &Band, pixels: Range<usize>) -> Vec<Tiles> {
        let rows = pixels.start as u32 / bin::TILE..(pixels.end as u32).div_ceil(bin::TILE);
        rows.clone()
            .step_by(self.strip.max(1) as usize)
            .map(|first| Tiles {
                rows: first..(first + self.strip).min(rows.end),
                list_row: first,
                top: band.top as u32,
            })
            .collect()
    }

    /// Runs the forward pass of an image that is one band; grows the tile lists and repeats when they were too short.
    pub fn forward(&mut self, params: &SplatBuffers, options: &RasterOptions) -> Result<()> {
        let bands = self.frame.bands.count();
        if bands > 1 {
            let (w, h) = (self.frame.width, self.frame.height);
            return Err(Error::work(format!("an image of {w} × {h} is rendered in {bands} bands here")));
        }
        self.forward_bands(params, options, |_, _| Ok(()))
    }

    /// Runs the forward pass band by band, and shows every band; grows the tile lists when they were too short.
    pub fn forward_bands(
        &mut self,
        params: &SplatBuffers,
        options: &RasterOptions,
        mut seen: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        self.check(params)?;
        for index in 0..self.frame.bands.count() {
            let band = self.frame.bands.get(index);
            loop {
                let mut rec = Recorder::new(&self.device, "forward");
                if index == 0 {
                    self.record_projection(&mut rec, params, options);
                }
                self.record_band(&mut rec, params, &band);
                rec.run()?;
                match self.overflow()? {
                    Some(needed) => self.grow(needed)?,
                    None => break,
                }
            }
            seen(&self.frame, &band)?;
        }
        Ok(())
    }

    /// Entries that a frame needed since the last [`Rasterizer::grow`], if they did not fit; `None` when all was well.
    pub fn overflow(&self) -> Result<Option<usize>> {
        let needed = self.frame.status.read::<u32>()?[1] as usize;
        Ok((needed > 0).then_some(needed))
    }

    /// Makes room for tile lists of `needed` entries and a quarter more, or lists fewer rows of tiles at once where the
    /// device binds no longer lists. Earlier recordings must not be run again.
    pub fn grow(&mut self, needed: usize) -> Result<()> {
        let most = most_entries(&self.device, self.frame.summation, self.frame.feature_dim);
        let wanted = needed + needed / 4;
        if needed > most {
            if self.strip <= 1 {
                return Err(Error::gpu(format!(
                    "{needed} entries of one row of tiles are more than {} binds ({most}): fewer splats or a smaller \
                     --max-size",
                    self.device.info().name
                )));
            }
            self.strip = ((u64::from(self.strip) * most as u64 / wanted as u64) as u32).max(1);
        }
        let splats = self.capacity.max(1);
        let tiles =
            self.frame.tiles()[0] as usize * (self.frame.bands.rows as u32).div_ceil(bin::TILE) as usize;
        let capacity = wanted.min(most);
        self.frame.lists = TileLists::new(&self.device, self.grouping, splats, tiles, capacity)?;
        self.frame.status.write(&[0u32, 0])
    }

    /// The tile lists of the last forward pass, row by row of tiles, nearest splat first. For tests and statistics.
    pub fn tile_lists(&self) -> Result<Vec<Vec<u32>>> {
        let ranges = self.frame.lists.ranges.read::<u32>()?;
        let splats = self.frame.lists.splats.read::<[u32; 2]>()?;
        let list = |r: &[u32]| splats[r[0] as usize..r[1] as usize].iter().map(|s| s[0]).collect();
        Ok(ranges.windows(2).map(list).collect())
    }

    fn check(&self, params: &SplatBuffers) -> Result<()> {
        if params.count > self.capacity || params.feature_dim != self.frame.feature_dim {
            return Err(Error::work(format!(
                "{} splats with {} features do not fit a rasterizer for {} with {}",
                params.count, params.feature_dim, self.capacity, self.frame.feature_dim
            )));
        }
        Ok(())
    }
}
