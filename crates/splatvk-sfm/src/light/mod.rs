//! Photometric calibration of photos (exposure, white balance, vignetting) from common points.
//!
//! In linear light, a Lambertian point p has the same radiance a_p in all directions, and photo v
//! shows it as `ln I = ln a_p + ln gain_v + falloff · (r², r⁴)`. Differences between two photos of
//! a point eliminate a_p; a small linear problem remains. It is solved robustly, because highlights
//! and wrong matches are not Lambertian: they may be most of the points as long as they agree less
//! on one difference than the matt ones. The mean of the channels in log light gives exposure and
//! vignetting, and its differences to red and blue give white balance. These are separate problems,
//! since texture that two views sample differently changes all channels together.
mod sample;
mod solve;
#[cfg(test)]
mod tests;

use super::SparseModel;
use crate::photo::{Light, Photo};
use crate::progress::Progress;
use rayon::prelude::*;
use sample::{Pair, pairs_of};
use solve::{Solution, System, exposure};

/// Fewest points for an estimate.
const MIN_POINTS: usize = 50;

/// Corrects the photos to one exposure, white balance and vignetting; warns of a poor fit.
pub fn equalised(mut photos: Vec<Photo>, model: &SparseModel, progress: &dyn Progress) -> Vec<Photo> {
    let found = estimate(&photos, model);
    photos.par_iter_mut().zip(&found).for_each(|(photo, light)| {
        if !light.is_none() {
            photo.image = light.removed(&photo.image);
        }
        photo.light = *light;
    });
    warn_of_unexplained(&photos, progress);
    photos
}

/// Corrects the photos after the first `known` ones to the mean light of those.
pub fn in_light_of(
    mut photos: Vec<Photo>,
    known: usize,
    model: &SparseModel,
    progress: &dyn Progress,
) -> Vec<Photo> {
    // The vignetting of known photos is already corrected, even of a camera of new ones.
    let mut fitted = model.fitted.clone();
    let mut cameras: Vec<usize> = fitted.iter().skip(known).map(|f| f.camera).collect();
    cameras.sort_unstable();
    cameras.dedup();
    for (view, own) in fitted.iter_mut().enumerate() {
        own.camera = if view < known { 0 } else { 1 + cameras.partition_point(|c| *c < own.camera) };
    }
    let found = estimate(&photos, &SparseModel { fitted, ..model.clone() });
    let mean_log_gain = |channel: usize| {
        let logs = found[..known].iter().map(|l| l.gain[channel].ln());
        logs.sum::<f64>() / known.max(1) as f64
    };
    let scene = [0, 1, 2].map(mean_log_gain);
    for (photo, light) in photos.iter_mut().zip(&found).skip(known) {
        let gain = [0, 1, 2].map(|c| light.gain[c] / scene[c].exp());
        let light = Light { gain, ..*light };
        if !light.is_none() {
            photo.image = light.removed(&photo.image);
        }
        photo.light = light;
    }
    warn_of_unexplained(&photos[known..], progress);
    photos
}

fn warn_of_unexplained(photos: &[Photo], progress: &dyn Progress) {
    let unexplained = photos.iter().filter(|p| !p.light.explains_the_photo());
    let names: Vec<String> =
        unexplained.map(|p| format!("{} (±{:.0} %)", p.stem, 100.0 * p.light.unexplained.exp_m1())).collect();
    if !names.is_empty() {
        progress.warn(&format!(
            "parts of these photos are lit differently than in the others, beyond exposure, white balance and vignetting \
             (flash, a moving shadow, highlights): {}; colours there are uncertain",
            names.join(", ")
        ));
    }
}

/// Exposure, white balance and vignetting of registered photos, one entry per photo; no correction
/// if none is significant.
pub fn estimate(photos: &[Photo], model: &SparseModel) -> Vec<Light> {
    let pairs = pairs_of(photos, model);
    if photos.len() < 2 || pairs.iter().map(|p| p.share).sum::<f64>() < 0.5 * MIN_POINTS as f64 {
        return vec![Light::NONE; photos.len()];
    }
    // Photos of one lens share their vignetting.
    let lenses = match model.fitted.as_slice() {
        [] => crate::photo::cameras_by_file(photos),
        fitted => fitted.iter().map(|f| f.camera).collect(),
    };
    let brightness = System { pairs: &pairs, views: photos.len(), lenses: &lenses, channel: 0 };
    let exposure = exposure(&brightness);
    // A highlight in one photo is no evidence for its white balance either.
    let matt: Vec<Pair> = pairs
        .iter()
        .zip(&exposure.agreement)
        .filter(|(_, agreement)| **agreement > 0.0)
        .map(|(p, agreement)| Pair { share: p.share * agreement, ..*p })
        .collect();
    let colour =
        [1, 2].map(|channel| System { channel, pairs: &matt, ..brightness }.gains(exposure.reference));
    let coloured = colour.iter().any(Solution::gains_matter);
    let unexplained = brightness.unexplained(&exposure);
    let mut lights: Vec<Light> = (0..photos.len())
        .map(|v| {
            let [red, blue] = [0, 1].map(|k| if coloured { colour[k].gain[v] } else { 0.0 });
            let e = exposure.gain[v];
            Light {
                gain: [e + red, e - red - blue, e + blue].map(f64::exp),
                falloff: exposure.falloff[lenses[v]],
                sigma_ev: exposure.sigma[v] / std::f64::consts::LN_2,
                sigma_corner: exposure.corner_sigma[lenses[v]],
                unexplained: unexplained[v],
            }
        })
        .collect();
    if lights.iter().all(Light::is_none) {
        lights = unexplained.iter().map(|u| Light { unexplained: *u, ..Light::NONE }).collect();
    }
    lights
}
