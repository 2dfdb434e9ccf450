//! Photos as training takes them, also at half their resolution.
use crate::scene::{Camera, Coverage, DepthMap, Image, RgbImage};

/// Inputs of training: photos with cameras, depth and coverage.
#[derive(Clone, Copy)]
pub(crate) struct Photos<'a> {
    pub(crate) images: &'a [RgbImage],
    /// One per photo.
    pub(crate) cameras: &'a [Camera],
    /// One per photo, if any.
    pub(crate) depths: Option<&'a [DepthMap]>,
    /// Used pixels of each photo; empty where all pixels are used.
    pub(crate) coverage: &'a [Option<Coverage>],
}

/// [`Photos`] that own their data.
#[derive(Default)]
pub(super) struct OwnedPhotos {
    pub(super) images: Vec<RgbImage>,
    pub(super) cameras: Vec<Camera>,
    pub(super) depths: Option<Vec<DepthMap>>,
    pub(super) coverage: Vec<Option<Coverage>>,
}

impl OwnedPhotos {
    /// Photos at half their resolution.
    pub(super) fn at_half_res(photos: &Photos) -> OwnedPhotos {
        let Photos { images, cameras, depths, coverage } = *photos;
        let image = |i: &RgbImage| i.resized_by_area(half(i.width), half(i.height));
        let camera = |c: &Camera| c.resized(half(c.width as usize) as u32, half(c.height as usize) as u32);
        let covered = |c: &Coverage| Coverage {
            share: c.share.resized_by_area(half(c.share.width), half(c.share.height)),
            ..c.clone()
        };
        let depth = |d: &DepthMap| DepthMap { depth: sampled(&d.depth), confidence: sampled(&d.confidence) };
        OwnedPhotos {
            images: images.iter().map(image).collect(),
            cameras: cameras.iter().map(camera).collect(),
            depths: depths.map(|all| all.iter().map(depth).collect()),
            coverage: coverage.iter().map(|c| c.as_ref().map(covered)).collect(),
        }
    }

    pub(super) fn photos(&self) -> Photos<'_> {
        let (images, cameras, coverage) = (&self.images, &self.cameras, &self.coverage);
        Photos { images, cameras, depths: self.depths.as_deref(), coverage }
    }
}

fn half(size: usize) -> usize {
    size.div_ceil(2)
}

/// Samples every second value: a mean of near and far depths would be on no surface.
fn sampled(plane: &Image<f32>) -> Image<f32> {
    let (width, height) = (half(plane.width), half(plane.height));
    let sample = |i: usize| plane.at(i % width * plane.width / width, i / width * plane.height / height);
    Image { width, height, data: (0..width * height).map(sample).collect() }
}
