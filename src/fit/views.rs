//! Training views in GPU memory, in the bands that the device binds, with one rasteriser.
use crate::gpu::{self, Buffer, Device};
use crate::pass::bands::{Band, Bands};
use crate::pass::metrics::planar;
use crate::pass::ssim_l1::SsimL1;
use crate::pass::sum::{self, PARTIALS};
use crate::pass::view::View;
use crate::pass::{FrameBuffers, RasterOptions, Rasterizer};
use crate::scene::{Camera, DepthMap, Outside, RgbImage};
use crate::{Error, Result};

use super::losses::Losses;
use super::model::Model;
use super::photos::Photos;

/// One training view.
pub(super) struct TrainView {
    /// Width and height, pixels.
    pub(super) size: [u32; 2],
    pub(super) bands: Bands,
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

/// All training views. Rasteriser and scratch memory have room for the largest; the rasteriser has
/// the size of one view at a time.
pub(super) struct Views {
    pub(super) list: Vec<TrainView>,
    pub(super) raster: Rasterizer,
    pub(super) loss: SsimL1,
    /// Per band Σ|x−y|, ΣSSIM, language loss, unused: [`SUMS`] sums in [`PARTIALS`] parts each.
    pub(super) sums: Buffer<f32>,
    near: f64,
}

/// Loss sums of a band.
const SUMS: usize = 4;

/// Slot of the first sum of a band ([`crate::pass::sum`]).
pub(super) fn slot(band: &Band) -> u32 {
    (SUMS * band.index) as u32
}

impl Views {
    /// Uploads photos with the inputs of their losses, and allocates for `capacity` splats with
    /// `feature_dim` features.
    pub(super) fn new(
        device: &Device,
        groups: &[(Photos, &Losses)],
        capacity: usize,
        feature_dim: usize,
        near: f64,
    ) -> Result<Self> {
        groups.iter().try_for_each(|(photos, _)| check_inputs(photos))?;
        let images = groups.iter().flat_map(|(photos, _)| photos.images);
        let sizes: Vec<[u32; 2]> = images.map(|i| [i.width as u32, i.height as u32]).collect();
        let mut raster = Rasterizer::for_sizes(device, capacity, feature_dim, &sizes)?;
        let mut list = Vec::with_capacity(sizes.len());
        for (photos, losses) in groups {
            for photo in 0..photos.images.len() {
                let size = sizes[list.len()];
                raster.set_size(size)?;
                let bands = raster.frame().bands.clone();
                list.push(upload(device, photos, photo, losses, size, bands)?);
            }
        }
        let bands: Vec<Bands> = list.iter().map(|view| view.bands.clone()).collect();
        let most_bands = bands.iter().map(Bands::count).max().unwrap_or(0);
        let loss = SsimL1::new(device, &bands)?;
        let sums = device.buffer::<f32>("loss sums", PARTIALS * SUMS * most_bands)?;
        Ok(Views { list, raster, loss, sums, near })
    }

    /// Most pixels of a band.
    pub(super) fn most_pixels(&self) -> usize {
        self.list.iter().map(|view| view.bands.pixels()).max().unwrap_or(0)
    }

    /// Whether views have several sizes: gradients that one leaves lie in other planes of the next.
    pub(super) fn have_several_sizes(&self) -> bool {
        self.list.windows(2).any(|pair| pair[0].size != pair[1].size)
    }

    /// The [`SUMS`] sums of the last step, on `view`, added up over its bands.
    pub(super) fn total(&self, view: usize) -> Result<[f64; SUMS]> {
        let bands = self.list[view].bands.count();
        let sums = self.sums.read_range(0..PARTIALS * SUMS * bands)?;
        Ok(std::array::from_fn(|k| (0..bands).map(|band| sum::total(&sums, SUMS * band + k)).sum()))
    }

    /// Sets size and camera of the next recording and run on a view.
    pub(super) fn set_camera(&mut self, view: usize, camera: &Camera) -> Result<()> {
        self.raster.set_size(self.list[view].size)?;
        self.raster.set_view(&View::new(camera, self.near))
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
        self.raster.forward_bands(&model.values, options, read)?;
        Ok(image)
    }

    /// Last render, with colours clipped to [0, 1]; `None` where the image has several bands.
    pub(super) fn last_render(&self) -> Result<Option<RgbImage>> {
        let frame = self.raster.frame();
        if frame.bands.count() > 1 {
            return Ok(None);
        }
        let data = colours(frame, &frame.bands.get(0))?;
        Ok(Some(RgbImage { width: frame.width as usize, height: frame.height as usize, data }))
    }
}

/// One photo with the inputs of its losses.
fn upload(
    device: &Device,
    Photos { images, depths, coverage, .. }: &Photos,
    photo: usize,
    losses: &Losses,
    size: [u32; 2],
    bands: Bands,
) -> Result<TrainView> {
    let image = &images[photo];
    let depth = depths.filter(|_| losses.depth.is_some()).and_then(|maps| maps.get(photo));
    let depth = depth.map(|m| known_depth(m, image)).transpose()?.flatten();
    let inner = |name, plane: &[f32], void: f32| -> Result<Vec<Buffer<f32>>> {
        let band = |b| device.buffer_from(name, &bands.cut_inner(&b, plane, void));
        Ok(bands.iter().map(band).collect::<gpu::Result<_>>()?)
    };
    let depth = match depth {
        Some((map, count)) => Some((inner("stereo depth", &map, 0.0)?, count)),
        None => None,
    };
    let coverage = coverage.get(photo).and_then(Option::as_ref);
    let mut planes = planar(image);
    let covered = match coverage {
        Some(c) if c.outside == Outside::Unknown => {
            let weights = c.weights().data;
            planes.extend(&weights);
            // Without used pixels the loss is 0, also divided by 1.
            Some(weights.iter().map(|w| f64::from(*w)).sum::<f64>().max(1.0))
        }
        _ => None,
    };
    let target = bands.iter().map(|b| device.buffer_from("photo", &bands.cut(&b, &planes)));
    let target = target.collect::<gpu::Result<_>>()?;
    let alpha = match losses.wanted_alpha(image.data.len(), coverage) {
        Some((alpha, weight)) => Some((inner("wanted alpha", &alpha, -1.0)?, weight)),
        None => None,
    };
    Ok(TrainView { size, bands, target, covered, alpha, depth })
}

/// Colours of the inner pixels of a band, clipped to [0, 1].
fn colours(frame: &FrameBuffers, band: &Band) -> Result<Vec<[f32; 3]>> {
    let (stride, rows) = (frame.bands.pixels(), frame.bands.stored(band));
    let planes = frame.planes.read_range(0..3 * stride)?;
    Ok(rows.map(|i| [0, 1, 2].map(|c| planes[c * stride + i].clamp(0.0, 1.0))).collect())
}

/// Depth where it has a confidence, and the number of such pixels; `None` without any. Depth that
/// stereo only filled counts, too: without texture nothing else holds the splats on the surface.
fn known_depth(map: &DepthMap, image: &RgbImage) -> Result<Option<(Vec<f32>, usize)>> {
    if map.depth.data.len() != image.data.len() || map.confidence.data.len() != image.data.len() {
        return Err(Error::work("a depth map does not have the size of its photo"));
    }
    let depth: Vec<f32> = map
        .depth
        .data
        .iter()
        .zip(&map.confidence.data)
        .map(|(&z, &c)| if c > 0.0 && z > 0.0 && z.is_finite() { z } else { 0.0 })
        .collect();
    let count = depth.iter().filter(|z| **z > 0.0).count();
    Ok((count > 0).then_some((depth, count)))
}

fn check_inputs(Photos { images, cameras, .. }: &Photos) -> Result<()> {
    if images.is_empty() || images.len() != cameras.len() {
        return Err(Error::work(format!(
            "training needs one camera per photo and got {} photos and {} cameras",
            images.len(),
            cameras.len()
        )));
    }
    for (image, camera) in images.iter().zip(*cameras) {
        if image.width != camera.width as usize || image.height != camera.height as usize {
            return Err(Error::work(format!(
                "photo {} is {} × {} but its camera is for {} × {}",
                camera.name, image.width, image.height, camera.width, camera.height
            )));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Image;

    #[test]
    fn filled_depth_is_known_too() {
        let row = |data: [f32; 4]| Image { width: 4, height: 1, data: data.to_vec() };
        let map = DepthMap { depth: row([2.0, 3.0, f32::NAN, 4.0]), confidence: row([0.1, 0.9, 0.9, 0.0]) };
        let image = RgbImage { width: 4, height: 1, data: vec![[0.0; 3]; 4] };
        assert_eq!(known_depth(&map, &image).unwrap(), Some((vec![2.0, 3.0, 0.0, 0.0], 2)));
        let unknown = DepthMap { confidence: row([0.0; 4]), ..map.clone() };
        assert_eq!(known_depth(&unknown, &image).unwrap(), None);
        assert!(known_depth(&map, &RgbImage { width: 1, height: 1, data: vec![[0.0; 3]] }).is_err());
    }
}
