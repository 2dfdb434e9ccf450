//! What files say of the optics of their photos.
use super::model::{Freedom, Model};
use crate::photo::Photo;
use crate::pose::bundle::{Optics, OpticsPrior};
use crate::pose::vanishing::{self, LogFocal};
use crate::scene::Lens;
use glam::DVec2;

/// ln f of a photo without EXIF: 0.9 × the long side covers phones (0.8) to normal lenses (1.2) within one σ.
const FOCAL_GUESS: f64 = 0.9;
const FOCAL_SIGMA: f64 = 0.35;
/// EXIF focal lengths are rounded and sensors are cropped.
const EXIF_SIGMA: f64 = 0.05;
/// Radial distortion at the corner of a photo, as a share of the radius: below a hundredth where a phone has corrected it, a
/// twentieth for plain wide lenses.
const LENS_SIGMA: f64 = 0.05;
/// Principal point from the middle, as a share of the long side: stabilised sensors move by up to a hundredth.
const SHIFT_SIGMA: f64 = 0.007;

/// Cameras, numbered in any way, if photos share one only where their files name it and its zoom. What such photos say against
/// it is then image stabilisation, which moves the lens from photo to photo, and no other camera.
fn separable(photos: &[Photo], group: &[usize]) -> Vec<usize> {
    let named = |p: &Photo| p.camera_model.is_some() && p.exif_focal.is_some();
    let first = |v: usize| group.iter().position(|g| *g == group[v]).unwrap_or(v);
    photos.iter().enumerate().map(|(v, p)| if named(p) { first(v) } else { v }).collect()
}

/// Groups and priors of the optics from the files.
pub(super) fn empty_model(photos: &[Photo], seed: u64) -> Model {
    let zoom: Vec<f64> = photos.iter().map(Photo::zoom).collect();
    let long = |v: usize| photos[v].original_size.0.max(photos[v].original_size.1);
    let group = crate::photo::cameras_by_file(photos);
    // The first photo of each group stands for it.
    let cameras = group.iter().max().map_or(0, |g| g + 1);
    let firsts: Vec<usize> = (0..cameras).filter_map(|g| group.iter().position(|o| *o == g)).collect();
    let priors: Vec<OpticsPrior> = firsts
        .iter()
        .enumerate()
        .map(|(g, &v)| {
            let members = || photos.iter().zip(&group).filter(|m| *m.1 == g).map(|m| m.0);
            let log_focal = match photos[v].original_focal() {
                Some(f) => (f.ln(), EXIF_SIGMA),
                None => {
                    let guess = LogFocal { mean: FOCAL_GUESS.ln(), sigma: FOCAL_SIGMA };
                    let LogFocal { mean, sigma } =
                        vanishing::log_focal(members().map(|p| &p.image), guess).unwrap_or(guess);
                    (mean + (long(v) as f64).ln(), sigma)
                }
            };
            let short = photos[v].original_size.0.min(photos[v].original_size.1);
            let corner = 0.5 * f64::hypot(long(v) as f64, short as f64) / log_focal.0.exp();
            // Upright photos of a camera that was turned hold its principal point in other places.
            let one_way = members().all(|p| p.original_size == photos[v].original_size);
            OpticsPrior {
                log_focal,
                lens: [LENS_SIGMA / corner.powi(2), 0.5 * LENS_SIGMA / corner.powi(4)],
                shift: if one_way { SHIFT_SIGMA * long(v) as f64 } else { 0.0 },
            }
        })
        .collect();
    Model {
        poses: vec![None; photos.len()],
        centres: photos
            .iter()
            .map(|p| DVec2::new(p.image.width as f64, p.image.height as f64) * 0.5)
            .collect(),
        alike: group.clone(),
        separable: separable(photos, &group),
        group,
        zoom,
        optics: priors
            .iter()
            .map(|p| Optics { focal: p.log_focal.0.exp(), lens: Lens::NONE, shift: DVec2::ZERO })
            .collect(),
        priors,
        freedom: Freedom::Focal,
        tracks: Vec::new(),
        seed,
    }
}
