//! Exposure, white balance and vignetting of the photos, from how bright they show the same points.
//!
//! In linear light, a matt point p looks as bright from every side, and photo v shows it as `ln I =
//! ln a_p + ln gain_v + falloff · (r², r⁴)`. Differences between two photos of a point leave out
//! a_p; what is left is a small linear problem, solved robustly because highlights and wrong
//! matches are no matt points: they may be most of the points, as long as they agree less on one
//! difference than the matt ones do. The mean of the channels in log light gives exposure and
//! vignetting, its differences to red and blue the white balance: these are separate problems,
//! since texture that two views sample differently moves all channels together.
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

/// Fewest points that separate light from content.
const MIN_POINTS: usize = 50;

/// The photos in one light, as far as exposure, white balance and vignetting explain the
/// differences; warns of the rest.
pub fn equalised(mut photos: Vec<Photo>, model: &SparseModel, progress: &dyn Progress) -> Vec<Photo> {
    let found = estimate(&photos, model);
    photos.par_iter_mut().zip(&found).for_each(|(photo, light)| {
        if !light.is_none() {
            photo.image = light.removed(&photo.image);
        }
        photo.light = *light;
    });
    warn_of_odd(&photos, progress);
    photos
}

/// The photos behind the first `known` ones brought into the light that those have in common.
pub fn in_light_of(
    mut photos: Vec<Photo>,
    known: usize,
    model: &SparseModel,
    progress: &dyn Progress,
) -> Vec<Photo> {
    // The vignetting of the known photos is taken out already, whichever camera they share with the
    // new ones.
    let mut fitted = model.fitted.clone();
    let mut cameras: Vec<usize> = fitted.iter().skip(known).map(|f| f.camera).collect();
    cameras.sort_unstable();
    cameras.dedup();
    for (view, own) in fitted.iter_mut().enumerate() {
        own.camera = if view < known { 0 } else { 1 + cameras.partition_point(|c| *c < own.camera) };
    }
    let found = estimate(&photos, &SparseModel { fitted, ..model.clone() });
    let log_gain = |channel: usize| {
        let logs = found[..known].iter().map(|l| l.gain[channel].ln());
        logs.sum::<f64>() / known.max(1) as f64
    };
    let scene = [0, 1, 2].map(log_gain);
    for (photo, light) in photos.iter_mut().zip(&found).skip(known) {
        let gain = [0, 1, 2].map(|c| light.gain[c] / scene[c].exp());
        let light = Light { gain, ..*light };
        if !light.is_none() {
            photo.image = light.removed(&photo.image);
        }
        photo.light = light;
    }
    warn_of_odd(&photos[known..], progress);
    photos
}

fn warn_of_odd(photos: &[Photo], progress: &dyn Progress) {
    let odd = photos.iter().filter(|p| !p.light.explains_the_photo());
    let odd: Vec<String> =
        odd.map(|p| format!("{} (±{:.0} %)", p.stem, 100.0 * p.light.unexplained.exp_m1())).collect();
    if !odd.is_empty() {
        progress.warn(&format!(
            "parts of these photos are lit differently than in the others, beyond exposure, white balance and vignetting \
             (flash, a moving shadow, highlights): {}; colours there are uncertain",
            odd.join(", ")
        ));
    }
}

/// Exposure, white balance and vignetting of placed photos, one per photo; none are stated when
/// none is significant.
pub fn estimate(photos: &[Photo], model: &SparseModel) -> Vec<Light> {
    let pairs = pairs_of(photos, model);
    if photos.len() < 2 || pairs.iter().map(|p| p.share).sum::<f64>() < 0.5 * MIN_POINTS as f64 {
        return vec![Light::NONE; photos.len()];
    }
    // Photos taken through the same lens share their vignetting.
    let lenses = match model.fitted.as_slice() {
        [] => crate::photo::cameras_by_file(photos),
        fitted => fitted.iter().map(|f| f.camera).collect(),
    };
    let grey = System { pairs: &pairs, views: photos.len(), lenses: &lenses, channel: 0 };
    let exposure = exposure(&grey);
    // What shows a highlight in one photo says nothing of its white balance either.
    let matt: Vec<Pair> = pairs
        .iter()
        .zip(&exposure.agreement)
        .filter(|(_, agreement)| **agreement > 0.0)
        .map(|(p, agreement)| Pair { share: p.share * agreement, ..*p })
        .collect();
    let colour = [1, 2].map(|channel| System { channel, pairs: &matt, ..grey }.gains(exposure.reference));
    let coloured = colour.iter().any(Solution::gains_matter);
    let unexplained = grey.unexplained(&exposure);
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
