//! The training-facing render: parameters and gradients in GPU buffers, forward and backward as
//! recorded commands.
//!
//! ```no_run
//! # use splatvk::{gpu::{self, Recorder}, pass::rasterizer::*, pass::view::View, scene::{Camera, Splats}};
//! # fn step(splats: &Splats, camera: &Camera) -> splatvk::Result<()> {
//! let device = gpu::open(None)?;
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
//! let twist = raster.frame().camera_grad.read()?; // ρ (3), θ (3), fx, fy, cx, cy
//! # Ok(())
//! # }
//! ```
//!
//! A whole step may also be one [`crate::gpu::Program`]: [`Rasterizer::record_forward`], loss,
//! [`Rasterizer::record_backward`], optimiser. It can be run again for other views after
//! [`Rasterizer::set_view`]. Then check [`Rasterizer::overflow`] after each run: if the lists did
//! not fit, that step saw an image without any splats; call [`Rasterizer::grow`], record again and
//! repeat the step (an optimiser pass can read `frame().status[1]` on the GPU and do nothing when
//! it is not 0).
//!
//! Recordings hold the buffers they were made with: record again after `grow`, after changing the
//! number of splats, the SH degree or the options.
//!
//! An image that is too large for the device is rendered in bands ([`super::bands`]), one after the
//! other in the same planes: [`Rasterizer::record_projection`], then for every band
//! [`Rasterizer::record_band`], loss, [`Rasterizer::record_band_backward`], and at the end
//! [`Rasterizer::record_gradients`]. An image that fits is one band.
use super::bands::{Band, Bands};
use super::channels::BASE_CHANNELS;
use super::frame::{
    CAMERA_GRADIENTS, GRADIENT_FLOATS, GradientEntries, GradientReduction, PROJECTED_FLOATS, Tiles,
    entry_bytes,
};
use super::sort::Sort;
use super::tile_lists::{self, LONGEST_LIST, TILE, TileBinning, TileLists};
use super::view::View;
use super::{bin, project, project_backward, raster_backward, raster_forward};
use crate::gpu::shaders::structs::CameraView;
use crate::gpu::{Buffer, Device, Recorder};
use crate::{Error, Result};
use std::ops::Range;

pub use super::frame::FrameBuffers;
pub use super::options::RasterOptions;
pub use super::splat_buffers::SplatBuffers;

/// Choices among passes that lead to the same result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceChoices {
    /// How tile lists are made.
    pub grouping: TileBinning,
    /// How gradients of several tiles are added up.
    pub summation: GradientReduction,
}

impl DeviceChoices {
    /// What suits the device.
    pub fn of(device: &Device) -> DeviceChoices {
        DeviceChoices { grouping: TileBinning::of(device), summation: GradientReduction::of(device) }
    }
}

/// Entries that the device takes at once, with the gradients that some ways of adding up keep for
/// each.
fn most_entries(
    device: &Device,
    (grouping, tiles): (TileBinning, usize),
    summation: GradientReduction,
    feature_dim: usize,
) -> usize {
    let gradients = match summation {
        GradientReduction::Atomics => usize::MAX,
        GradientReduction::Entries => device.info().max_storage_range as usize / entry_bytes(feature_dim),
    };
    tile_lists::most_entries(device, grouping, tiles).min(gradients)
}

/// Renders up to N splats with d features at a fixed image size, and back.
pub struct Rasterizer {
    device: Device,
    capacity: usize,
    camera: Buffer<CameraView>,
    frame: FrameBuffers,
    grouping: TileBinning,
    /// Rows of tiles whose lists are made at once.
    strip: u32,
    sort: Sort,
    /// [1] u32: N, where the sort reads it.
    count: Buffer<u32>,
}

impl Rasterizer {
    /// Room for `capacity` splats with `feature_dim` features (0, or as the splats have), images of
    /// width × height.
    pub fn new(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        width: u32,
        height: u32,
    ) -> Result<Rasterizer> {
        Rasterizer::with(device, capacity, feature_dim, width, height, DeviceChoices::of(device))
    }

    /// [`Rasterizer::new`] with ways that may not be the device's best: for tests and benchmarks.
    pub fn with(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        width: u32,
        height: u32,
        ways: DeviceChoices,
    ) -> Result<Rasterizer> {
        if width == 0 || height == 0 {
            return Err(Error::work("an image of zero size cannot be rendered"));
        }
        let planes = BASE_CHANNELS + feature_dim;
        let bands = Bands::new(device.info(), width as usize, height as usize, planes)?;
        let (pixels, strip) = (bands.pixels(), (bands.rows as u32).div_ceil(TILE));
        let tiles = width.div_ceil(TILE) as usize * strip as usize;
        let splats = capacity.max(1);
        let stride = feature_dim.next_multiple_of(4);
        // About five entries per splat on the seeded scene; `forward` grows the list if that is too
        // few.
        let most = most_entries(device, (ways.grouping, tiles), ways.summation, feature_dim);
        let entries = (8 * splats + 4 * tiles).min(most);
        let frame = FrameBuffers {
            width,
            height,
            bands,
            feature_dim,
            planes: device.buffer::<f32>("planes", planes * pixels)?,
            transmittance: device.buffer::<f32>("transmittance", pixels)?,
            planes_grad: device.buffer::<f32>("planes_grad", (planes + 1) * pixels)?,
            camera_grad: device.buffer::<f32>("camera_grad", CAMERA_GRADIENTS)?,
            status: device.buffer::<u32>("status", 3)?,
            projected: device.buffer::<f32>("projected", PROJECTED_FLOATS * splats)?,
            projected_grad: device.buffer::<f32>("projected_grad", GRADIENT_FLOATS * splats)?,
            camera_parts: device.buffer::<f32>(
                "camera_parts",
                CAMERA_GRADIENTS * project_backward::groups(device, splats) as usize,
            )?,
            summation: ways.summation,
            gradient_entries: GradientEntries::default(),
            codes: device.buffer::<f32>("codes", (stride * splats).max(4))?,
            codes_grad: device.buffer::<f32>("codes_grad", (stride * splats).max(4))?,
            depth_pairs: device.buffer::<u32>("depth_pairs", 2 * splats)?,
            lists: TileLists::new(device, ways.grouping, splats, tiles, entries)?,
        };
        let camera = device.buffer::<CameraView>("camera", 1)?;
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

    /// One [`CameraView`]: what later runs of any recording render.
    pub fn camera(&self) -> &Buffer<CameraView> {
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
        Ok(self.camera.write(&[view.to_gpu()])?)
    }

    /// Records projection, depth sort, binning and blending of an image that is one band.
    pub fn record_forward(&self, rec: &mut Recorder, params: &SplatBuffers, options: &RasterOptions) {
        self.refuse_bands(rec);
        self.record_projection(rec, params, options);
        self.record_band(rec, params, &self.frame.bands.get(0));
    }

    /// Records the way back from `frame().planes_grad` to `gradients` (overwritten; zero for unseen
    /// splats) and `frame().camera_grad`. Needs the results of a forward pass with the same
    /// parameters, view and options.
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
        // Keys are the bits of camera z. The sort is stable, so equal depths keep the order of the
        // splats.
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

    /// Records the way back from `frame().planes_grad` of the band that was blended last to the
    /// splats on the screen: the first band overwrites, the others add.
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
        if band.index == 0 && !(all && self.frame.summation == GradientReduction::Entries) {
            raster_backward::record_clear(rec, &self.frame);
        }
        let inner = self.strips(band, band.inner.clone());
        let strips = match listed.as_slice() {
            // The lists are still there. Sums by entries read every entry, so that the halo writes
            // its zeros.
            [one] if self.frame.summation == GradientReduction::Entries => vec![one.clone()],
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

    /// Records the rest of the way, from the splats on the screen to `gradients` (overwritten; zero
    /// for unseen splats) and `frame().camera_grad`.
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
        let rows = pixels.start as u32 / TILE..(pixels.end as u32).div_ceil(TILE);
        rows.clone()
            .step_by(self.strip.max(1) as usize)
            .map(|first| Tiles {
                rows: first..(first + self.strip).min(rows.end),
                list_row: first,
                top: band.top as u32,
            })
            .collect()
    }

    /// Runs the forward pass of an image that is one band; grows the tile lists and repeats when
    /// they were too short.
    pub fn forward(&mut self, params: &SplatBuffers, options: &RasterOptions) -> Result<()> {
        let bands = self.frame.bands.count();
        if bands > 1 {
            let (w, h) = (self.frame.width, self.frame.height);
            return Err(Error::work(format!("an image of {w} × {h} is rendered in {bands} bands here")));
        }
        self.forward_bands(params, options, |_, _| Ok(()))
    }

    /// Runs the forward pass band by band, and shows every band; grows the tile lists when they
    /// were too short.
    pub fn forward_bands(
        &mut self,
        params: &SplatBuffers,
        options: &RasterOptions,
        mut seen: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        for index in 0..self.frame.bands.count() {
            let band = self.frame.bands.get(index);
            self.forward_band(params, options, &band)?;
            seen(&self.frame, &band)?;
        }
        Ok(())
    }

    /// Runs the forward pass of one band, after those above it.
    pub(super) fn forward_band(
        &mut self,
        params: &SplatBuffers,
        options: &RasterOptions,
        band: &Band,
    ) -> Result<()> {
        self.check(params)?;
        loop {
            let mut rec = Recorder::new(&self.device, "forward");
            if band.index == 0 {
                self.record_projection(&mut rec, params, options);
            }
            self.record_band(&mut rec, params, band);
            rec.download(&self.frame.status);
            rec.run()?;
            match self.overflow()? {
                Some(needed) => self.grow(needed)?,
                None => return Ok(()),
            }
        }
    }

    /// Entries that a frame needed since the last [`Rasterizer::grow`], if they did not fit; `None`
    /// when all was well. An error where a tile has more splats than the device goes through: it
    /// would leave out the farthest of them.
    pub fn overflow(&self) -> Result<Option<usize>> {
        let status = self.frame.status.read()?;
        let (needed, longest) = (status[1] as usize, status[2]);
        if longest > LONGEST_LIST && self.device.info().leaves_long_loops() {
            self.frame.status.write(&[0; 3])?;
            return Err(Error::gpu(format!(
                "{longest} splats lie on {TILE} × {TILE} pixels, and {} goes through {LONGEST_LIST} at most: a larger image, \
                 a nearer camera, fewer splats or another device",
                self.device.info().name
            )));
        }
        Ok((needed > 0).then_some(needed))
    }

    /// Makes room for tile lists of `needed` entries and a quarter more, or lists fewer rows of
    /// tiles at once where the device binds no longer lists. Earlier recordings must not be run
    /// again.
    pub fn grow(&mut self, needed: usize) -> Result<()> {
        let tiles = self.frame.tiles()[0] as usize * (self.frame.bands.rows as u32).div_ceil(TILE) as usize;
        let lists = (self.grouping, tiles);
        let most = most_entries(&self.device, lists, self.frame.summation, self.frame.feature_dim);
        let wanted = needed + needed / 4;
        if needed > most {
            if self.strip <= 1 {
                return Err(Error::gpu(format!(
                    "{needed} entries of one row of tiles are more than {} takes at once ({most}): fewer splats or a smaller \
                     --max-size",
                    self.device.info().name
                )));
            }
            self.strip = ((u64::from(self.strip) * most as u64 / wanted as u64) as u32).max(1);
        }
        let splats = self.capacity.max(1);
        let capacity = wanted.min(most);
        self.frame.lists = TileLists::new(&self.device, self.grouping, splats, tiles, capacity)?;
        Ok(self.frame.status.write(&[0; 3])?)
    }

    /// The tile lists of the last forward pass, row by row of tiles, nearest splat first. For tests
    /// and statistics.
    pub fn tile_lists(&self) -> Result<Vec<Vec<u32>>> {
        let ranges = self.frame.lists.ranges.read()?;
        let splats = self.frame.lists.splats.read()?;
        let list =
            |r: &[u32]| splats[2 * r[0] as usize..2 * r[1] as usize].iter().step_by(2).copied().collect();
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
