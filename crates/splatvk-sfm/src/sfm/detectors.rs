//! Keypoints per detector and photo.
use super::model::TrackElement;
use crate::Result;
use crate::matching::{self, Keypoints};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::Image;
use crate::{affine, sift};
use rayon::prelude::*;

/// Most corners per photo, the strongest: matching stays below a second for four photos.
const MAX_CORNERS: usize = 4000;

/// Pixels next to the image edge without keypoints: their neighbourhood is cut off.
pub(super) const MARGIN: usize = 4;

/// Most corners per compressed copy of a photo: matching then takes seconds per pair.
const MAX_AFFINE: usize = 700;

/// Keypoints of one detector in all photos.
pub(super) struct DetectorFeatures {
    /// Matches are nearest neighbours whose distance is below this share of that to the second-best
    /// elsewhere.
    pub(super) ratio: f32,
    pub(super) keypoints: Vec<Keypoints>,
}

/// Features of the built-in corner detector, then the learned ones if given.
pub(super) fn detect_features(
    photos: &[Photo],
    features: &[Keypoints],
    progress: &dyn Progress,
) -> Result<Vec<DetectorFeatures>> {
    progress.check()?;
    let mut detectors =
        vec![DetectorFeatures { ratio: 0.85, keypoints: detect_all(photos, MAX_CORNERS, sift::detect) }];
    progress.check()?;
    if features.len() == photos.len() {
        // Learned descriptors are compared more leniently: their second-best is close by design of
        // the training.
        detectors.push(DetectorFeatures { ratio: 0.97, keypoints: masked(photos, features) });
    }
    Ok(detectors)
}

/// Affine-invariant corners of all photos.
pub(super) fn affine_features(photos: &[Photo]) -> DetectorFeatures {
    DetectorFeatures { ratio: 0.85, keypoints: detect_all(photos, MAX_AFFINE, affine::detect) }
}

fn detect_all(
    photos: &[Photo],
    limit: usize,
    detect: impl Fn(&Image<f32>, &Image<bool>, usize) -> Keypoints + Sync,
) -> Vec<Keypoints> {
    photos.par_iter().map(|p| detect(&p.image.luma(), &valid(p), limit)).collect()
}

/// Mask of the pixels of a photo where keypoints may lie.
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

/// Keypoints of all photos on valid pixels.
pub(super) fn masked(photos: &[Photo], features: &[Keypoints]) -> Vec<Keypoints> {
    photos.par_iter().zip(features).map(|(p, f)| within(f, &valid(p))).collect()
}

/// Keypoints of a view over all detectors, numbered as in [`super::tracks::KeypointMatch`].
pub(super) fn keypoints(detectors: &[DetectorFeatures], view: usize) -> Vec<TrackElement> {
    let all =
        detectors.iter().enumerate().flat_map(|(k, f)| f.keypoints[view].points.iter().map(move |p| (k, *p)));
    all.map(|(detector, pixel)| TrackElement { view, pixel, sigma: 1.0, detector }).collect()
}
