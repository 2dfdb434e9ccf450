//! Keypoints per detector and photo.
use super::model::Sighting;
use crate::Result;
use crate::photo::Photo;
use crate::pose::matching::{self, Keypoints};
use crate::pose::sift;
use crate::progress::Progress;
use crate::scene::Plane;
use rayon::prelude::*;

/// Strongest corners kept per photo: matching stays below a second for four photos.
const MAX_CORNERS: usize = 4000;

/// Pixels next to the image edge that hold no features: their neighbourhood is cut off.
pub(super) const MARGIN: usize = 4;

/// Keypoints per detector family (built-in corners first, then the learned ones if given) and photo.
pub(super) fn corner_families(
    photos: &[Photo],
    features: &[Keypoints],
    progress: &dyn Progress,
) -> Result<Vec<Vec<Keypoints>>> {
    progress.check()?;
    let own: Vec<Keypoints> = photos
        .par_iter()
        .map(|p| {
            sift::detect(&p.image.luma(), &matching::valid_area(&p.image, p.border, MARGIN), MAX_CORNERS)
        })
        .collect();
    progress.check()?;
    let mut families = vec![own];
    if features.len() == photos.len() {
        families.push(masked(photos, features));
    }
    Ok(families)
}

/// Keypoints on valid pixels.
fn within(f: &Keypoints, valid: &Plane<bool>) -> Keypoints {
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
    photos
        .iter()
        .zip(features)
        .map(|(p, f)| within(f, &matching::valid_area(&p.image, p.border, MARGIN)))
        .collect()
}

/// All keypoints of a view, numbered as the links number them.
pub(super) fn keypoints(families: &[Vec<Keypoints>], view: usize) -> Vec<Sighting> {
    let all = families.iter().enumerate().flat_map(|(k, f)| f[view].points.iter().map(move |p| (k, *p)));
    all.map(|(family, pixel)| Sighting { view, pixel, sigma: 1.0, family }).collect()
}
