//! What several stages need.
use crate::Result;
use crate::fit::Photos;
use crate::infer::installed::Installed;
use crate::photo::Photo;
use crate::scene::{Camera, Coverage, DepthMap, RgbImage};

/// The working images of photos.
pub(super) fn images(photos: &[Photo]) -> Vec<RgbImage> {
    photos.iter().map(|p| p.image.clone()).collect()
}

/// What renders of photos are compared with, and which pixels of it count.
pub(super) fn targets(photos: &[Photo]) -> (Vec<RgbImage>, Vec<Option<Coverage>>) {
    photos.iter().map(|p| (p.target(), p.coverage.clone())).unzip()
}

/// What training compares with.
pub(super) fn posed<'a>(
    images: &'a [RgbImage],
    cameras: &'a [Camera],
    depths: Option<&'a [DepthMap]>,
    coverage: &'a [Option<Coverage>],
) -> Photos<'a> {
    Photos { images, cameras, depths, coverage }
}

/// What an installed network is, for [`crate::pipeline::Stage::settings`].
pub fn identity(model: &Installed) -> Result<String> {
    let sums: Vec<String> = model.files()?.into_iter().map(|f| f.sha256).collect();
    Ok(format!("{} {sums:?}", model.name))
}
