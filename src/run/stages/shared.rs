//! Helpers of several stages.
use crate::Result;
use crate::fit::Photos;
use crate::infer::Registry;
use crate::infer::installed::Installed;
use crate::infer::xfeat::{self, XFeat};
use crate::photo::Photo;
use crate::pose::{self, Keypoints};
use crate::scene::{Camera, Coverage, DepthMap, Outside, RgbImage};
use glam::DVec2;
use rayon::prelude::*;

/// The working images of photos.
pub(super) fn images(photos: &[Photo]) -> Vec<RgbImage> {
    photos.iter().map(|p| p.image.clone()).collect()
}

/// Targets of renders and their used pixels. The other pixels continue the used ones, so that no
/// colour of an occluder gets into the target.
pub(super) fn targets(photos: &[Photo]) -> (Vec<RgbImage>, Vec<Option<Coverage>>) {
    photos.par_iter().map(target).unzip()
}

fn target(photo: &Photo) -> (RgbImage, Option<Coverage>) {
    let mut image = photo.target();
    if photo.coverage.as_ref().is_some_and(|c| c.outside == Outside::Unknown) {
        image.fill_from_used(|i| photo.uses(i));
    }
    (image, photo.coverage.clone())
}

/// Input of training.
pub(super) fn posed<'a>(
    images: &'a [RgbImage],
    cameras: &'a [Camera],
    depths: Option<&'a [DepthMap]>,
    coverage: &'a [Option<Coverage>],
) -> Photos<'a> {
    Photos { images, cameras, depths, coverage }
}

/// Name and file checksums of an installed network, for [`crate::pipeline::Stage::settings`].
pub fn identity(model: &Installed) -> Result<String> {
    let sums: Vec<String> = model.files()?.into_iter().map(|f| f.sha256).collect();
    Ok(format!("{} {sums:?}", model.name))
}

/// The built-in keypoint detector of structure from motion.
pub fn keypoints(registry: &Registry) -> Result<impl FnMut(&RgbImage) -> Result<Keypoints> + use<>> {
    let mut xfeat = XFeat::load(registry)?;
    Ok(move |image: &RgbImage| {
        let found = xfeat.detect(image, pose::MAX_KEYPOINTS)?;
        let point = |k: &[f32; 2]| DVec2::new(f64::from(k[0]), f64::from(k[1]));
        Ok(Keypoints {
            points: found.keypoints.iter().map(point).collect(),
            dim: xfeat::DIM,
            descriptors: found.descriptors,
        })
    })
}
