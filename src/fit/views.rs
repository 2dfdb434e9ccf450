//! Training views in GPU memory, in the bands that the device binds, and one rasteriser per image
//! size.
use crate::gpu::{self, Buffer, Device};
use crate::pass::bands::Band;
use crate::pass::metrics::planar;
use crate::pass::ssim_l1::SsimL1;
use crate::pass::view::View;
use crate::pass::{FrameBuffers, RasterOptions, Rasterizer};
use crate::scene::{Camera, DepthMap, Outside, RgbImage};
use crate::{Error, Result};

use super::losses::Losses;
use super::model::Model;
use super::photos::Photos;

/// One training view.
pub(super) struct TrainView {
    /// Index into [`Views::stages`].
    pub(super) stage: usize,
    /// Per band [3, rows, W] of the photo, or [4, rows, W] with pixel weights where some are
    /// unused.
    pub(super) target: Vec<Buffer<f32>>,
    /// Sum of the pixel weights, where there are some.
    pub(super) covered: Option<f64>,
    /// Per band [rows, W] the wanted alpha, −1 in the halo, and its weight per pixel
    /// ([`Losses::wanted_alpha`]).
    pub(super) alpha: Option<(Vec<Buffer<f32>>, f64)>,
    /// Per band [rows, W] depth where it is confident, 0 elsewhere and in the halo; and the number
    /// of confident pixels.
    pub(super) depth: Option<(Vec<Buffer<f32>>, usize)>,
}

/// Buffers that views of one size share.
pub(super) struct SizeBuffers {
    pub(super) raster: Rasterizer,
    pub(super) loss: SsimL1,
    /// Per band Σ|x−y|, ΣSSIM, language loss, unused: [`SUMS`] floats.
    pub(super) sums: Buffer<f32>,
}

/// Loss sums of a band.
pub(super) const SUMS: usize = 4;

impl SizeBuffers {
    fn new(device: &Device, capacity: usize, feature_dim: usize, size: [u32; 2]) -> Result<SizeBuffers> {
        let raster = Rasterizer::new(device, capacity, feature_dim, size[0], size[1])?;
        let loss = SsimL1::new(device, &raster.frame().bands)?;
        let sums = device.buffer::<f32>("loss sums", SUMS * raster.frame().bands.count())?;
        Ok(SizeBuffers { raster, loss, sums })
    }

    /// Slot of the first sum of a band.
    pub(super) fn slot(&self, band: &Band) -> u32 {
        (SUMS * band.index) as u32
    }

    /// The [`SUMS`] sums, added up over the bands.
    pub(super) fn total(&self) -> Result<[f64; SUMS]> {
        let sums = self.sums.read()?;
        Ok(std::array::from_fn(|k| sums.iter().skip(k).step_by(SUMS).map(|v| f64::from(*v)).sum()))
    }
}

/// All training views.
pub(super) struct Views {
    pub(super) list: Vec<TrainView>,
    pub(super) stages: Vec<SizeBuffers>,
    near: f64,
}

impl Views {
    /// Uploads the photos and the inputs of the losses, and allocates the rasterisers, for
    /// `capacity` splats with `feature_dim` features. Depth is used from `min_confidence` on.
    pub(super) fn new(
        device: &Device,
        photos: Photos,
        losses: (&Losses, f32),
        capacity: usize,
        feature_dim: usize,
        near: f64,
    ) -> Result<Self> {
        let mut views = Views { list: Vec::new(), stages: Vec::new(), near };
        views.add(device, photos, losses, capacity, feature_dim)?;
        Ok(views)
    }

    /// Adds photos behind the others.
    pub(super) fn add(
        &mut self,
        device: &Device,
        Photos { images, cameras, depths, coverage }: Photos,
        (losses, min_confidence): (&Losses, f32),
        capacity: usize,
        feature_dim: usize,
    ) -> Result<()> {
        let depths = depths.filter(|_| losses.depth.is_some());
        check_inputs(images, cameras)?;
        for (i, image) in images.iter().enumerate() {
            let size = [image.width as u32, image.height as u32];
            let same = |s: &SizeBuffers| [s.raster.frame().width, s.raster.frame().height] == size;
            let stage = match self.stages.iter().position(same) {
                Some(found) => found,
                None => {
                    self.stages.push(SizeBuffers::new(device, capacity, feature_dim, size)?);
                    self.stages.len() - 1
                }
            };
            let depth = depths.and_then(|maps| maps.get(i));
            let depth = depth.map(|m| confident_depth(m, min_confidence, image)).transpose()?.flatten();
            let bands = &self.stages[stage].raster.frame().bands;
            let depth = match depth {
                Some((map, count)) => {
                    let band = |b| device.buffer_from("stereo depth", &bands.cut_inner(&b, &map, 0.0));
                    Some((bands.iter().map(band).collect::<gpu::Result<_>>()?, count))
                }
                None => None,
            };
            let coverage = coverage.get(i).and_then(Option::as_ref);
            let mut photo = planar(image);
            let covered = match coverage {
                Some(c) if c.outside == Outside::Unknown => {
                    let weights = c.weights().data;
                    photo.extend(&weights);
                    // Without used pixels the loss is 0, also divided by 1.
                    Some(weights.iter().map(|w| f64::from(*w)).sum::<f64>().max(1.0))
                }
                _ => None,
            };
            let target = bands.iter().map(|b| device.buffer_from("photo", &bands.cut(&b, &photo)));
            let target = target.collect::<gpu::Result<_>>()?;
            let alpha = match losses.wanted_alpha(image.data.len(), coverage) {
                Some((alpha, weight)) => {
                    let band = |b| device.buffer_from("wanted alpha", &bands.cut_inner(&b, &alpha, -1.0));
                    Some((bands.iter().map(band).collect::<gpu::Result<_>>()?, weight))
                }
                None => None,
            };
            self.list.push(TrainView { stage, target, covered, alpha, depth });
        }
        Ok(())
    }

    /// Buffers of the size of a view.
    pub(super) fn stage(&self, view: usize) -> &SizeBuffers {
        &self.stages[self.list[view].stage]
    }

    /// [`Views::stage`], mutable.
    pub(super) fn stage_mut(&mut self, view: usize) -> &mut SizeBuffers {
        &mut self.stages[self.list[view].stage]
    }

    /// Sets the camera of the next run on a view.
    pub(super) fn set_camera(&self, view: usize, camera: &Camera) -> Result<()> {
        self.stage(view).raster.set_view(&View::new(camera, self.near))
    }

    /// Renders the model from a camera: colours clipped to [0, 1].
    pub(super) fn render(
        &mut self,
        view: usize,
        camera: &Camera,
        model: &Model,
        options: &RasterOptions,
    ) -> Result<RgbImage> {
        self.set_camera(view, camera)?;
        let (width, height) = (camera.width as usize, camera.height as usize);
        let mut image = RgbImage { width, height, data: Vec::with_capacity(width * height) };
        let read = |frame: &FrameBuffers, band: &Band| {
            image.data.extend(colours(frame, band)?);
            Ok(())
        };
        self.stage_mut(view).raster.forward_bands(&model.values, options, read)?;
        Ok(image)
    }

    /// Last render of the rasteriser of a view, with colours clipped to [0, 1]; `None` where the
    /// image has several bands.
    pub(super) fn last_render(&self, view: usize) -> Result<Option<RgbImage>> {
        let frame = self.stage(view).raster.frame();
        if frame.bands.count() > 1 {
            return Ok(None);
        }
        let data = colours(frame, &frame.bands.get(0))?;
        Ok(Some(RgbImage { width: frame.width as usize, height: frame.height as usize, data }))
    }
}

/// Colours of the inner pixels of a band, clipped to [0, 1].
fn colours(frame: &FrameBuffers, band: &Band) -> Result<Vec<[f32; 3]>> {
    let (stride, rows) = (frame.bands.pixels(), frame.bands.stored(band));
    let planes = frame.planes.read_range(0..3 * stride)?;
    Ok(rows.map(|i| [0, 1, 2].map(|c| planes[c * stride + i].clamp(0.0, 1.0))).collect())
}

/// Depth where its confidence is at least `least`, and the number of such pixels; `None` without
/// any.
fn confident_depth(map: &DepthMap, least: f32, image: &RgbImage) -> Result<Option<(Vec<f32>, usize)>> {
    if map.depth.data.len() != image.data.len() || map.confidence.data.len() != image.data.len() {
        return Err(Error::work("a depth map does not have the size of its photo"));
    }
    let depth: Vec<f32> = map
        .depth
        .data
        .iter()
        .zip(&map.confidence.data)
        .map(|(&z, &c)| if c >= least && z > 0.0 && z.is_finite() { z } else { 0.0 })
        .collect();
    let count = depth.iter().filter(|z| **z > 0.0).count();
    Ok((count > 0).then_some((depth, count)))
}

fn check_inputs(images: &[RgbImage], cameras: &[Camera]) -> Result<()> {
    if images.is_empty() || images.len() != cameras.len() {
        return Err(Error::work(format!(
            "training needs one camera per photo and got {} photos and {} cameras",
            images.len(),
            cameras.len()
        )));
    }
    for (image, camera) in images.iter().zip(cameras) {
        if image.width != camera.width as usize || image.height != camera.height as usize {
            return Err(Error::work(format!(
                "photo {} is {} × {} but its camera is for {} × {}",
                camera.name, image.width, image.height, camera.width, camera.height
            )));
        }
    }
    Ok(())
}
