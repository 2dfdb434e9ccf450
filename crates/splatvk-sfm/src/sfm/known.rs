//! Triangulation of sparse points for known cameras.
use super::detectors::{detect_features, keypoints};
use super::finish::inlier_matches;
use super::model::{MIN_ANGLE_DEGREES, Model, RefinedIntrinsics, Track, TrackElement};
use super::tracks;
use super::verify::{THRESHOLD, putative_matches};
use crate::bundle::{Intrinsics, IntrinsicsPrior};
use crate::matching::Keypoints;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{Camera, Lens};
use crate::{Error, Result};
use crate::{SparseModel, SparsePoint};
use glam::DVec2;

/// Fewest points that determine the depth range of a scene.
const MIN_POINTS: usize = 20;
/// Least share of the putative matches that obey the given cameras: chance gives about 2 % (a band
/// of 2 × 3 px in 480), true cameras 20 % and more.
const MIN_AGREEMENT: f64 = 0.1;

/// Triangulates points for given cameras (one per photo, at working resolution). The cameras keep
/// their intrinsics, relative poses and unit of length; the world frame becomes that of camera 0.
pub fn with_cameras(
    photos: &[Photo],
    cameras: &[Camera],
    features: &[Keypoints],
    progress: &dyn Progress,
) -> Result<SparseModel> {
    if photos.len() < 2 || photos.len() != cameras.len() {
        return Err(Error::input("known cameras need one camera per photo and at least two photos"));
    }
    let detectors = detect_features(photos, features, progress)?;
    let long = photos[0].image.width.max(photos[0].image.height) as f64;
    let threshold = THRESHOLD * long;
    let back = cameras[0].pose.inverse();
    // The model has one focal length per camera and principal points at the origin.
    let mut model = Model {
        poses: cameras.iter().map(|c| Some(c.pose.compose(&back))).collect(),
        centres: vec![DVec2::ZERO; cameras.len()],
        camera_ids: (0..cameras.len()).collect(),
        camera_ids_by_file: (0..cameras.len()).collect(),
        camera_ids_by_exif: (0..cameras.len()).collect(),
        zoom: vec![1.0; cameras.len()],
        intrinsics: cameras
            .iter()
            .map(|c| Intrinsics {
                focal: mean_focal(c),
                lens: Lens::NONE,
                principal_point_offset: DVec2::ZERO,
            })
            .collect(),
        priors: vec![IntrinsicsPrior::default(); cameras.len()],
        refined: RefinedIntrinsics::Focal,
        tracks: Vec::new(),
        // No samples are drawn with known cameras.
        seed: 0,
    };
    let mut putative = putative_matches(photos, &detectors, progress)?;
    for pair in &mut putative {
        let (a, b) = (&cameras[pair.first], &cameras[pair.second]);
        pair.list.iter_mut().for_each(|m| (m.0, m.1) = (to_isotropic(a, m.0), to_isotropic(b, m.1)));
    }
    let tried: usize = putative.iter().map(|p| p.list.len()).sum();
    let mut links = inlier_matches(&model, &putative, threshold);
    let agreement = links.len() as f64 / tried.max(1) as f64;
    let keypoints: Vec<Vec<TrackElement>> = (0..photos.len())
        .map(|v| {
            let mut all = keypoints(&detectors, v);
            all.iter_mut().for_each(|s| s.pixel = to_isotropic(&cameras[v], s.pixel));
            all
        })
        .collect();
    model.tracks = tracks::join(&mut links, &keypoints)
        .into_iter()
        .map(|elements| Track { position: None, elements })
        .collect();
    model.triangulate_all(threshold);
    model.prune(threshold);
    if model.tracks.len() < MIN_POINTS || agreement < MIN_AGREEMENT {
        return Err(Error::input(format!(
            "the given cameras and the photos do not fit: only {:.0} % of the matches between the photos and {} points \
             (rays at least {MIN_ANGLE_DEGREES}° apart) agree with them; check that the cameras belong to these photos",
            100.0 * agreement,
            model.tracks.len()
        )));
    }
    let registered: Vec<Camera> = cameras
        .iter()
        .zip(&model.poses)
        .map(|(c, p)| Camera { pose: p.unwrap_or(c.pose), ..c.clone() })
        .collect();
    let points = model
        .tracks
        .iter()
        .filter_map(|t| {
            let views: Vec<(usize, DVec2)> = t
                .elements
                .iter()
                .map(|s| {
                    let (c, p) = (&cameras[s.view], s.pixel / mean_focal(&cameras[s.view]));
                    (s.view, DVec2::new(p.x * c.fx + c.cx, p.y * c.fy + c.cy))
                })
                .collect();
            let (v, p) = *views.first()?;
            Some(SparsePoint { position: t.position?, colour: photos[v].image.nearest(p), views })
        })
        .collect();
    Ok(SparseModel { cameras: registered, points, focal_log_sigma: None, fitted: Vec::new(), flat: false })
}

fn mean_focal(c: &Camera) -> f64 {
    0.5 * (c.fx + c.fy)
}

/// Maps a pixel to the camera of focal length [`mean_focal`] with the principal point at the
/// origin.
fn to_isotropic(c: &Camera, p: DVec2) -> DVec2 {
    DVec2::new((p.x - c.cx) / c.fx, (p.y - c.cy) / c.fy) * mean_focal(c)
}
