//! Training first at half the photos' size: there a step costs less than half, and what it fits is what matters early on.
use crate::scene::{Camera, DepthMap, Plane, RgbImage};

/// What training compares with.
#[derive(Clone, Copy)]
pub(crate) struct Photos<'a> {
    pub(crate) images: &'a [RgbImage],
    /// One per photo.
    pub(crate) cameras: &'a [Camera],
    /// One per photo, if any.
    pub(crate) depths: Option<&'a [DepthMap]>,
}

/// The same at half the size.
pub(super) struct HalfSizePhotos {
    images: Vec<RgbImage>,
    cameras: Vec<Camera>,
    depths: Option<Vec<DepthMap>>,
}

impl HalfSizePhotos {
    pub(super) fn of(photos: &Photos) -> HalfSizePhotos {
        let Photos { images, cameras, depths } = *photos;
        let image = |i: &RgbImage| i.resized_by_area(half(i.width), half(i.height));
        let camera = |c: &Camera| c.resized(half(c.width as usize) as u32, half(c.height as usize) as u32);
        let depth = |d: &DepthMap| DepthMap { depth: sampled(&d.depth), confidence: sampled(&d.confidence) };
        HalfSizePhotos {
            images: images.iter().map(image).collect(),
            cameras: cameras.iter().map(camera).collect(),
            depths: depths.map(|all| all.iter().map(depth).collect()),
        }
    }

    pub(super) fn photos(&self) -> Photos<'_> {
        Photos { images: &self.images, cameras: &self.cameras, depths: self.depths.as_deref() }
    }
}

fn half(size: usize) -> usize {
    size.div_ceil(2)
}

/// Every second value: between a near and a far surface there is no depth to average.
fn sampled(plane: &Plane<f32>) -> Plane<f32> {
    let (width, height) = (half(plane.width), half(plane.height));
    let at = |i: usize| plane.at(i % width * plane.width / width, i / width * plane.height / height);
    Plane { width, height, data: (0..width * height).map(at).collect() }
}
