//! Differentiable rasteriser for training: parameters and gradients in GPU buffers, forward and
//! backward pass as recorded commands.
//!
//! ```no_run
//! # use splatvk::gpu::{self, Recorder};
//! # use splatvk::{pass::rasterizer::*, pass::view::View, scene::{Camera, Splats}};
//! # fn step(splats: &Splats, camera: &Camera) -> splatvk::Result<()> {
//! let device = gpu::open(None)?;
//! let params = SplatBuffers::upload(&device, splats, &[], 0)?;
//! let grads = params.zeros_like(&device)?;
//! let (count, dim) = (params.count, params.feature_dim);
//! let mut raster = Rasterizer::new(&device, count, dim, camera.width, camera.height)?;
//! let options = RasterOptions::default();
//!
//! raster.set_view(&View::new(camera, 0.02))?;
//! raster.forward(&params, &options)?; // grows lists that are too short and repeats
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
//! [`Rasterizer::set_view`]. Check [`Rasterizer::overflow`] after each run: if the lists did not
//! fit, the step rendered an image without splats; call [`Rasterizer::grow`], record again and
//! repeat the step. An optimiser pass reads `frame().status[1]` on the GPU and skips the step when
//! it is not 0.
//!
//! Recordings hold their buffers: record again after `grow` and after a change of the number of
//! splats, the SH degree or the options.
//!
//! An image that is too large for the device is rendered in bands ([`super::bands`]), one after the
//! other in the same planes: [`Rasterizer::record_projection`], then for every band
//! [`Rasterizer::record_band`], loss, [`Rasterizer::record_band_backward`], and at the end
//! [`Rasterizer::record_gradients`]. An image that fits is one band.
use super::bands::{Band, Bands};
use super::channels::BASE_CHANNELS;
use super::frame::{GradientReduction, Tiles, entry_bytes};
use super::fused_update::{self, SplatAdam};
use super::project::DEPTH_BITS;
use super::project_backward::ShGradientKernel;
use super::sort::{Moves, Prepared, Sort};
use super::tile_lists::{self, LONGEST_LIST, Lists, TILE, TileBinning, TileLists};
use super::view::View;
use super::{bin, project, project_backward, raster_backward, raster_forward};
use crate::gpu::shaders::structs::CameraView;
use crate::gpu::{Buffer, Device, Recorder};
use crate::{Error, Result};
use std::ops::Range;

pub use super::choices::DeviceChoices;
pub use super::frame::FrameBuffers;
pub use super::options::RasterOptions;
pub use super::splat_buffers::SplatBuffers;

/// Most tile-list entries that the device holds at once, including the gradients per entry of
/// [`GradientReduction::Entries`].
fn most_entries(
    device: &Device,
    (grouping, splats, tiles): (TileBinning, usize, usize),
    summation: GradientReduction,
    feature_dim: usize,
) -> usize {
    let gradients = match summation {
        GradientReduction::Atomics => usize::MAX,
        GradientReduction::Entries => device.info().max_storage_range as usize / entry_bytes(feature_dim),
    };
    tile_lists::most_entries(device, grouping, splats, tiles).min(gradients)
}

/// Renders up to N splats with d features, and back-propagates gradients.
pub struct Rasterizer {
    pub(super) device: Device,
    capacity: usize,
    /// Most pixels of a band, and tiles.
    room: [usize; 2],
    pub(super) camera: Buffer<CameraView>,
    pub(super) frame: FrameBuffers,
    grouping: TileBinning,
    sh_gradients: ShGradientKernel,
    projection_groups: u32,
    /// Most rows of tiles that are binned at once.
    strip: u32,
    sort: Sort,
    /// Number of visible splats, and of all.
    pub(super) count: Buffer<u32>,
}

impl Rasterizer {
    /// Allocates for `capacity` splats with `feature_dim` features (0 or that of the splats) and
    /// images of width × height pixels.
    ///
    /// # Errors
    /// Where the size is zero, or the image is too wide for the device.
    pub fn new(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        width: u32,
        height: u32,
    ) -> Result<Rasterizer> {
        Rasterizer::with(device, capacity, feature_dim, width, height, DeviceChoices::of(device))
    }

    /// [`Rasterizer::new`] with given choices, for tests and benchmarks.
    pub fn with(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        width: u32,
        height: u32,
        choices: DeviceChoices,
    ) -> Result<Rasterizer> {
        let mut made = Rasterizer::allocate(device, capacity, feature_dim, &[[width, height]], choices)?;
        made.allocate_gradients()?;
        Ok(made)
    }

    /// [`Rasterizer::new`] for images of several (width, height), the first until
    /// [`Rasterizer::set_size`].
    pub fn for_sizes(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        sizes: &[[u32; 2]],
    ) -> Result<Rasterizer> {
        let mut made = Rasterizer::for_viewing(device, capacity, feature_dim, sizes)?;
        made.allocate_gradients()?;
        Ok(made)
    }

    /// [`Rasterizer::for_sizes`] without the buffers of the backward pass, which
    /// [`Rasterizer::allocate_gradients`] makes.
    pub fn for_viewing(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        sizes: &[[u32; 2]],
    ) -> Result<Rasterizer> {
        Rasterizer::allocate(device, capacity, feature_dim, sizes, DeviceChoices::of(device))
    }

    fn allocate(
        device: &Device,
        capacity: usize,
        feature_dim: usize,
        sizes: &[[u32; 2]],
        choices: DeviceChoices,
    ) -> Result<Rasterizer> {
        let planes = BASE_CHANNELS + feature_dim;
        let bands: Vec<Bands> =
            sizes.iter().map(|size| bands_of(device, *size, planes)).collect::<Result<_>>()?;
        let most = |count: fn(&Bands) -> usize| bands.iter().map(count).max().unwrap_or(0);
        let room = [most(Bands::pixels), most(tiles_of)];
        let (size, bands) = match (sizes, bands.into_iter().next()) {
            ([first, ..], Some(bands)) => (*first, bands),
            _ => return Err(Error::work("a rasterizer without an image size")),
        };
        let splats = capacity.max(1);
        let lists = (choices.grouping, splats, room[1]);
        let most = most_entries(device, lists, choices.summation, feature_dim);
        let entries = tile_lists::first_entries(splats, room[1]).min(most);
        let frame = FrameBuffers::new(device, (size, bands), feature_dim, &choices, (splats, room, entries))?;
        Ok(Rasterizer {
            device: device.clone(),
            capacity,
            room,
            camera: device.buffer::<CameraView>("camera", 1)?,
            frame,
            grouping: choices.grouping,
            sh_gradients: choices.sh_gradients,
            projection_groups: choices.projection_groups,
            strip: u32::MAX,
            sort: Sort::new(device, splats)?,
            count: device.buffer::<u32>("splat count", 2)?,
        })
    }

    /// Allocates the buffers of the backward pass, unless they exist. Recordings of the forward pass
    /// may still be run.
    pub fn allocate_gradients(&mut self) -> Result<()> {
        let groups = project_backward::groups(self.capacity.max(1), self.projection_groups);
        self.frame.allocate_gradients(&self.device, self.capacity.max(1), self.room[0], groups as usize)
    }

    /// Sets the image size of later recordings and reads. A recording keeps its own. Planes of an
    /// image of another size keep its values until a pass writes them.
    ///
    /// # Errors
    /// Where the size is larger than those allocated.
    pub fn set_size(&mut self, [width, height]: [u32; 2]) -> Result<()> {
        if [self.frame.width, self.frame.height] == [width, height] {
            return Ok(());
        }
        let planes = BASE_CHANNELS + self.frame.feature_dim;
        let bands = bands_of(&self.device, [width, height], planes)?;
        if bands.pixels() > self.room[0] || tiles_of(&bands) > self.room[1] {
            return Err(Error::work(format!("a rasterizer has no room for {width} × {height} pixels")));
        }
        (self.frame.width, self.frame.height, self.frame.bands) = (width, height, bands);
        Ok(())
    }

    /// Output and gradient planes.
    pub fn frame(&self) -> &FrameBuffers {
        &self.frame
    }

    /// Camera of later runs of any recording, one [`CameraView`].
    pub fn camera(&self) -> &Buffer<CameraView> {
        &self.camera
    }

    /// Sets the view of later runs.
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

    /// Records the backward pass from `frame().planes_grad` to `gradients` (overwritten; zero for
    /// splats without pixels) and `frame().camera_grad`. Needs the results of a forward pass with
    /// the same parameters, view and options.
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
        let sort = (&self.sort, &self.count);
        project::record(rec, params, &self.camera, &self.frame, sh_degree, sort);
        project::record_features(rec, params, &self.frame, options.feature_mode);
        rec.pass("depth sort");
        // The sort is stable: equal keys keep the order of the splats.
        let moves = match self.frame.summation {
            GradientReduction::Atomics => Moves::Visible,
            // The sums per entry overwrite the gradients of all splats.
            GradientReduction::Entries => Moves::All,
        };
        let pairs = &self.frame.depth_pairs;
        self.sort.record_prepared(rec, pairs, (&self.count, moves), DEPTH_BITS, Prepared::Cleared);
    }

    /// Records binning and blending of a band. In a recording, band 0 directly follows
    /// [`Rasterizer::record_projection`], which clears its lists.
    pub fn record_band(&self, rec: &mut Recorder, params: &SplatBuffers, band: &Band) {
        let mut state = if band.index == 0 { Lists::Cleared } else { Lists::Used };
        for tiles in self.strips(band, band.top..band.top + band.rows) {
            self.record_lists(rec, params, &tiles, state);
            state = Lists::Used;
            rec.pass("raster forward");
            raster_forward::record(rec, &self.camera, &self.frame, &tiles);
        }
    }

    /// Records the backward pass from `frame().planes_grad` of the band that was blended last to
    /// the screen-space splats: the first band overwrites their gradients, the others add to them.
    pub fn record_band_backward(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        options: &RasterOptions,
        band: &Band,
    ) {
        self.frame.require_gradients(rec);
        rec.pass("raster backward");
        let coupled = options.features_move_geometry;
        let by_entries = self.frame.summation == GradientReduction::Entries;
        let stored = self.strips(band, band.top..band.top + band.rows);
        let inner = self.strips(band, band.inner.clone());
        // The lists of the forward pass hold its last strip: several strips are binned again.
        let [only] = stored.as_slice() else {
            if band.index == 0 {
                raster_backward::record_clear(rec, &self.frame);
            }
            for tiles in inner {
                self.record_lists(rec, params, &tiles, Lists::Used);
                rec.pass("raster backward");
                raster_backward::record(rec, &self.frame, &tiles, params.count, coupled, false);
            }
            return;
        };
        let all = self.frame.bands.count() == 1;
        if band.index == 0 && !(all && by_entries) {
            raster_backward::record_clear(rec, &self.frame);
        }
        let tiles = if by_entries {
            // Every stored entry is summed, so the halo must store its zeros.
            only.clone()
        } else {
            let rows = inner.first().map_or(0, |t| t.rows.start)..inner.last().map_or(0, |t| t.rows.end);
            Tiles { rows, ..*only }
        };
        raster_backward::record(rec, &self.frame, &tiles, params.count, coupled, all);
    }

    /// Records the backward pass from the screen-space splats to `gradients` (overwritten; zero for
    /// splats without pixels) and `frame().camera_grad`.
    pub fn record_gradients(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        options: &RasterOptions,
        gradients: &SplatBuffers,
    ) {
        self.record_splat_gradients(rec, params, options, gradients);
        self.record_feature_gradients(rec, params, options, &gradients.features);
    }

    /// Records the part of [`Rasterizer::record_gradients`] for all parameters but the features.
    pub fn record_splat_gradients(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        options: &RasterOptions,
        gradients: &SplatBuffers,
    ) {
        self.frame.require_gradients(rec);
        let sh_degree = options.sh_degree.min(params.sh_degree);
        rec.pass("projection backward");
        let kernel = (self.sh_gradients, self.projection_groups);
        project_backward::record(rec, params, &self.camera, &self.frame, sh_degree, kernel, gradients);
    }

    /// Records the part of [`Rasterizer::record_gradients`] for the features; nothing without
    /// features.
    pub fn record_feature_gradients(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        options: &RasterOptions,
        features_grad: &Buffer<f32>,
    ) {
        self.frame.require_gradients(rec);
        rec.pass("feature backward");
        project_backward::record_features(rec, params, &self.frame, options.feature_mode, features_grad);
    }

    /// Records the backward pass from the screen-space splats to Adam's step of all parameters but
    /// the features, and to `frame().camera_grad`; the step is void where `frame().status[1] ≠ 0`.
    /// Needs the results of a forward pass with all stored SH coefficients.
    pub fn record_update(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        options: &RasterOptions,
        state: &SplatAdam,
    ) {
        if options.sh_degree < params.sh_degree {
            let (used, stored) = (options.sh_degree, params.sh_degree);
            rec.fail(format!(
                "the update of SH degree {stored} was asked for after a render of degree {used}"
            ));
        }
        self.frame.require_gradients(rec);
        rec.pass(fused_update::PASS);
        fused_update::record(rec, params, &self.camera, &self.frame, self.projection_groups, state);
    }

    pub(super) fn record_lists(
        &self,
        rec: &mut Recorder,
        params: &SplatBuffers,
        tiles: &Tiles,
        state: Lists,
    ) {
        rec.pass("binning");
        bin::record(rec, &self.frame, &tiles.rows, (params.count, &self.count), state);
    }

    /// Divides rows of pixels of a band into strips of tiles that are binned at once.
    pub(super) fn strips(&self, band: &Band, pixels: Range<usize>) -> Vec<Tiles> {
        let rows = pixels.start as u32 / TILE..(pixels.end as u32).div_ceil(TILE);
        let strip = self.strip.min(rows.len() as u32).max(1);
        rows.clone()
            .step_by(strip as usize)
            .map(|first| Tiles {
                rows: first..(first + strip).min(rows.end),
                list_row: first,
                top: band.top as u32,
            })
            .collect()
    }

    /// Runs the forward pass of an image that is one band; grows tile lists that are too short and
    /// repeats the pass.
    pub fn forward(&mut self, params: &SplatBuffers, options: &RasterOptions) -> Result<()> {
        let bands = self.frame.bands.count();
        if bands > 1 {
            let (w, h) = (self.frame.width, self.frame.height);
            return Err(Error::work(format!("an image of {w} × {h} is rendered in {bands} bands here")));
        }
        self.forward_bands(params, options, |_, _| Ok(()))
    }

    /// Runs the forward pass band by band and calls `visit` after each; grows tile lists that are
    /// too short.
    pub fn forward_bands(
        &mut self,
        params: &SplatBuffers,
        options: &RasterOptions,
        mut visit: impl FnMut(&FrameBuffers, &Band) -> Result<()>,
    ) -> Result<()> {
        for index in 0..self.frame.bands.count() {
            let band = self.frame.bands.get(index);
            self.forward_band(params, options, &band)?;
            visit(&self.frame, &band)?;
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

    /// Number of entries that a frame needed since the last [`Rasterizer::grow`], if they did not
    /// fit; else `None`.
    ///
    /// # Errors
    /// Where a tile has more splats than the loops of the device reach: it would omit the farthest.
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

    /// Allocates tile lists for `needed` entries and a quarter more, or bins fewer rows of tiles at
    /// once where the device binds no longer lists. Earlier recordings must not be run again.
    pub fn grow(&mut self, needed: usize) -> Result<()> {
        let (tiles, splats) = (self.room[1], self.capacity.max(1));
        let lists = (self.grouping, splats, tiles);
        let most = most_entries(&self.device, lists, self.frame.summation, self.frame.feature_dim);
        let wanted = needed + needed / 4;
        if needed > most {
            let strip = self.strip.min((self.frame.bands.rows as u32).div_ceil(TILE));
            if strip <= 1 {
                return Err(Error::gpu(format!(
                    "{needed} entries of one row of tiles are more than {} takes at once ({most}): fewer splats or a smaller \
                     --max-size",
                    self.device.info().name
                )));
            }
            self.strip = ((u64::from(strip) * most as u64 / wanted as u64) as u32).max(1);
        }
        let capacity = wanted.min(most);
        let summation = self.frame.summation;
        self.frame.lists = TileLists::new(&self.device, self.grouping, summation, splats, tiles, capacity)?;
        Ok(self.frame.status.write(&[0; 3])?)
    }

    /// Tile lists of the last forward pass, row by row of tiles, nearest splat first. For tests and
    /// statistics.
    pub fn tile_lists(&self) -> Result<Vec<Vec<u32>>> {
        let ranges = self.frame.lists.ranges.read_range(0..tiles_of(&self.frame.bands) + 1)?;
        let splats = self.frame.lists.splats.read()?;
        let list = |r: &[u32]| {
            splats[2 * r[0] as usize..2 * r[1] as usize].iter().skip(1).step_by(2).copied().collect()
        };
        Ok(ranges.windows(2).map(list).collect())
    }

    pub(super) fn check(&self, params: &SplatBuffers) -> Result<()> {
        if params.count > self.capacity || params.feature_dim != self.frame.feature_dim {
            return Err(Error::work(format!(
                "{} splats with {} features do not fit a rasterizer for {} with {}",
                params.count, params.feature_dim, self.capacity, self.frame.feature_dim
            )));
        }
        Ok(())
    }
}

fn bands_of(device: &Device, [width, height]: [u32; 2], planes: usize) -> Result<Bands> {
    if width == 0 || height == 0 {
        return Err(Error::work("an image of zero size cannot be rendered"));
    }
    Bands::new(device.info(), width as usize, height as usize, planes)
}

/// Tiles of a band.
fn tiles_of(bands: &Bands) -> usize {
    bands.width.div_ceil(TILE as usize) * bands.rows.div_ceil(TILE as usize)
}
