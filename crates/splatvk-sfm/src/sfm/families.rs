//! Keypoints per detector and photo.
use super::model::Sighting;
use crate::Result;
use crate::matching::{self, Keypoints};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::Image;
use crate::{affine, sift};
use rayon::prelude::*;

/// Strongest corners kept per photo: matching stays below a second for four photos.
const MAX_CORNERS: usize = 4000;

/// Pixels next to the image edge that hold no features: their neighbourhood is cut off.
pub(super) const MARGIN: usize = 4;

/// Strongest corners kept per compressed version of a photo: matching then takes seconds per pair.
const MAX_AFFINE: usize = 700;

/// What one detector found in all photos.
pub(super) struct Family {
    /// Matches are nearest neighbours whose distance is below this share of that to the second-best
    /// elsewhere.
    pub(super) ratio: f32,
    /// Per photo.
    pub(super) keypoints: Vec<Keypoints>,
}

/// Built-in corners, then the learned ones if given.
pub(super) fn corner_families(
    photos: &[Photo],
    features: &[Keypoints],
    progress: &dyn Progress,
) -> Result<Vec<Family>> {
    progress.check()?;
    let mut families = vec![Family { ratio: 0.85, keypoints: of_all(photos, MAX_CORNERS, sift::detect) }];
    progress.check()?;
    if features.len() == photos.len() {
        // Learned descriptors are compared more leniently: their second-best is close by design of
        // the training.
        families.push(Family { ratio: 0.97, keypoints: masked(photos, features) });
    }
    Ok(families)
}

/// Corners of all photos as they look from the side.
pub(super) fn affine_family(photos: &[Photo]) -> Family {
    Family { ratio: 0.85, keypoints: of_all(photos, MAX_AFFINE, affine::detect) }
}

fn of_all(
    photos: &[Photo],
    limit: usize,
    detect: impl Fn(&Image<f32>, &Image<bool>, usize) -> Keypoints + Sync,
) -> Vec<Keypoints> {
    let one = |p: &Photo| detect(&p.image.luma(), &valid(p), limit);
    photos.par_iter().map(one).collect()
}

/// Where features of a photo may lie.
fn valid(photo: &Photo) -> Image<bool> {
    matching::valid_area(&photo.image, photo.border, photo.coverage.as_ref(), MARGIN)
}

/// Keypoints on valid pixels.
fn within(f: &Keypoints, valid: &Image<bool>) -> Keypoints {
    let mut out = Keypoints { dim: f.dim, ..Default::default() };
    for (k, p) in f.points.iter().enumerate() {
        let (x, y) = (p.x.max(0.0) as usize, p.y.max(0.0) as usize);
        if x < valid.width && y < valid.height && valid.at(x, y) {
            out.points.push(*p);
            out.descriptors.extend_from_slice(&f.descriptors[k * f.dim..(k + 1) * f.dim]);
        }
    }
    out
}

/// Masked features of all detectors, per family and photo.
pub(super) fn masked(photos: &[Photo], features: &[Keypoints]) -> Vec<Keypoints> {
    photos.iter().zip(features).map(|(p, f)| within(f, &valid(p))).collect()
}

/// All keypoints of a view, numbered as the links number them.
pub(super) fn keypoints(families: &[Family], view: usize) -> Vec<Sighting> {
    let all =
        families.iter().enumerate().flat_map(|(k, f)| f.keypoints[view].points.iter().map(move |p| (k, *p)));
    all.map(|(family, pixel)| Sighting { view, pixel, sigma: 1.0, family }).collect()
}
