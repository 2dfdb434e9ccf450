//! The training views in GPU memory, and one rasteriser per image size.
use crate::gpu::{Buffer, Device};
use crate::pass::metrics::planar;
use crate::pass::rasterizer::{RasterOptions, Rasterizer};
use crate::pass::ssim_l1::SsimL1;
use crate::pass::view::View;
use crate::scene::{Camera, DepthMap, RgbImage};
use crate::{Error, Result};

use super::model::Model;

/// One training view.
pub(super) struct TrainView {
    /// Index into [`Views::stages`].
    pub(super) stage: usize,
    /// [3, H, W] photo.
    pub(super) target: Buffer,
    /// [H, W] depth where it is trusted, else 0; and the number of trusted pixels.
    pub(super) depth: Option<(Buffer, usize)>,
}

/// What views of one size share.
pub(super) struct Stage {
    pub(super) raster: Rasterizer,
    pub(super) loss: SsimL1,
    /// Σ|x−y|, ΣSSIM, language loss.
    pub(super) sums: Buffer,
}

/// All views.
pub(super) struct Views {
    device: Device,
    pub(super) list: Vec<TrainView>,
    pub(super) stages: Vec<Stage>,
    near: f64,
}

impl Views {
    /// Uploads photos (and depth) and makes the rasterisers, for `capacity` splats with `feature_dim` features.
    pub(super) fn new(
        device: &Device,
        images: &[RgbImage],
        cameras: &[Camera],
        depths: Option<(&[DepthMap], f32)>,
        capacity: usize,
        feature_dim: usize,
        near: f64,
    ) -> Result<Self> {
        check_inputs(images, cameras)?;
        let mut views = Views { device: device.clone(), list: Vec::new(), stages: Vec::new(), near };
        for (i, image) in images.iter().enumerate() {
            let size = [image.width as u32, image.height as u32];
            let same = |s: &Stage| [s.raster.frame().width, s.raster.frame().height] == size;
            let stage = match views.stages.iter().position(same) {
                Some(found) => found,
                None => {
                    views.stages.push(Stage {
                        raster: Rasterizer::new(device, capacity, feature_dim, size[0], size[1])?,
                        loss: SsimL1::new(device, image.width, image.height)?,
                        sums: device.buffer::<f32>("loss sums", 4)?,
                    });
                    views.stages.len() - 1
                }
            };
            let depth = match depths {
                Some((maps, least)) => maps.get(i).map(|m| trusted(m, least, image)).transpose()?.flatten(),
                None => None,
            };
            let depth = match depth {
                Some((map, count)) => Some((device.buffer_from("stereo depth", &map)?, count)),
                None => None,
            };
            views.list.push(TrainView { stage, target: device.buffer_from("photo", &planar(image))?, depth });
        }
        Ok(views)
    }

    /// The stage of a view.
    pub(super) fn stage(&self, view: usize) -> &Stage {
        &self.stages[self.list[view].stage]
    }

    /// Chooses what the next run renders.
    pub(super) fn set_camera(&self, view: usize, camera: &Camera) -> Result<()> {
        self.stage(view).raster.set_view(&View::new(camera, self.near))
    }

    /// Makes the rasterisers anew for another number of splats.
    pub(super) fn resize(&mut self, capacity: usize, feature_dim: usize) -> Result<()> {
        for stage in &mut self.stages {
            let (w, h) = (stage.raster.frame().width, stage.raster.frame().height);
            stage.raster = Rasterizer::new(&self.device, capacity, feature_dim, w, h)?;
        }
        Ok(())
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
        let at = self.list[view].stage;
        let stage = &mut self.stages[at];
        stage.raster.forward(&model.values, options)?;
        self.shown(view)
    }

    /// What the view's rasteriser last rendered: colours clipped to [0, 1].
    pub(super) fn shown(&self, view: usize) -> Result<RgbImage> {
        let frame = self.stage(view).raster.frame();
        let (width, height) = (frame.width as usize, frame.height as usize);
        let pixels = width * height;
        let planes = frame.planes.read_range::<f32>(0..3 * pixels)?;
        let data = (0..pixels).map(|i| [0, 1, 2].map(|c| planes[c * pixels + i].clamp(0.0, 1.0))).collect();
        Ok(RgbImage { width, height, data })
    }
}

/// Depth where confidence suffices, and how many pixels that are; `None` when there are none.
fn trusted(map: &DepthMap, least: f32, image: &RgbImage) -> Result<Option<(Vec<f32>, usize)>> {
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
