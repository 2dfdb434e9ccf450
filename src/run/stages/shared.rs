//! What several stages need.
use crate::Result;
use crate::fit::Photos;
use crate::infer::Registry;
use crate::infer::installed::Installed;
use crate::infer::xfeat::{self, XFeat};
use crate::photo::Photo;
use crate::pose::{self, Keypoints};
use crate::scene::{Camera, Coverage, DepthMap, Outside, RgbImage};
use glam::DVec2;

/// The working images of photos.
pub(super) fn images(photos: &[Photo]) -> Vec<RgbImage> {
    photos.iter().map(|p| p.image.clone()).collect()
}

/// Targets of renders, and their pixels that count; the others continue them, so that no colour of
/// what hides the scene gets into it.
pub(super) fn targets(photos: &[Photo]) -> (Vec<RgbImage>, Vec<Option<Coverage>>) {
    let target = |p: &Photo| {
        let mut image = p.target();
        if p.coverage.as_ref().is_some_and(|c| c.outside == Outside::Unknown) {
            image.fill_from_used(|i| p.uses(i));
        }
        (image, p.coverage.clone())
    };
    photos.iter().map(target).unzip()
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

/// The built-in keypoint detector, for the search of cameras.
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
