//! Camera estimation and dense stereo as single calls (docs/internals/method.md#geometry).
use super::choose::LeftOut;
use super::confidence::{DOUBTFUL, DOUBTFUL_ROTATION, UNSURE_FOCAL};
use super::leave_out::{self, Placed};
use super::matching::Detect;
use super::sharpness::warn_of_blur;
use super::stereo::{self, Dense, PlaneSweep, StereoOptions};
use super::{Geometry, Keypoints, SparseModel, given, light, sfm, still};
use crate::Result;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{DepthPrior, GivenCamera};
use glam::DVec2;
use rayon::prelude::*;

/// Registered photos and their cameras, the input of all later stages.
pub struct SolvedCameras {
    /// Undistorted and photometrically equalised photos.
    pub photos: Vec<Photo>,
    /// Their cameras and sparse points.
    pub model: SparseModel,
    /// Photos that could not be registered with confidence.
    pub left_out: Vec<LeftOut>,
    /// Source of the cameras, for run.json.
    pub method: String,
}

/// Estimates the cameras of photos (`cameras` = `None`; `seed` draws the samples of RANSAC) or
/// assigns given ones; then undistorts and equalises the photos. `detect` finds keypoints. Without
/// given cameras, photos that cannot be registered with confidence are left out.
pub fn place(
    mut photos: Vec<Photo>,
    cameras: Option<&[GivenCamera]>,
    detect: &mut Detect,
    seed: u64,
    progress: &dyn Progress,
) -> Result<SolvedCameras> {
    let known = cameras.map(|given| given::assign(&mut photos, given, progress)).transpose()?;
    warn_of_blur(&photos, progress);
    still::mark(&mut photos);
    let features = learned_features(&photos, detect, progress)?;
    let Placed { photos, model, left_out } = match known {
        Some(known) => {
            still::clear_scene(&mut photos, &known);
            let model = sfm::with_cameras(&photos, &known, &features, progress)?;
            Placed { photos, model, left_out: Vec::new() }
        }
        None => leave_out::place(photos, features, seed, progress)?,
    };
    if let Some(overlay) = still::description(&photos) {
        progress.warn(&format!(
            "something stands still in every photo while the scene moves ({overlay}): it is left out of the scene; photos without it \
             serve better"
        ));
    }
    warn_of_doubt(&photos, &model, progress);
    warn_of_misfits(&photos, &model, progress);
    progress.check()?;
    let mut photos = photos;
    // Fine images and overlays only serve camera estimation.
    photos.iter_mut().for_each(|p| (p.fine, p.overlay) = (None, None));
    photos
        .par_iter_mut()
        .zip(&model.fitted)
        .zip(&model.cameras)
        .for_each(|((photo, fitted), camera)| photo.straighten(fitted.lens, camera));
    let photos = light::equalised(photos, &model, progress);
    let method = if cameras.is_some() { "cameras + stereo" } else { "sfm (corners + XFeat) + stereo" };
    Ok(SolvedCameras { photos, model, left_out, method: method.into() })
}

/// Warns of unconfirmed cameras, an uncertain focal length and uncertain rotations.
fn warn_of_doubt(photos: &[Photo], model: &SparseModel, progress: &dyn Progress) {
    let named = |test: &dyn Fn(&super::Fitted) -> bool| {
        let all = photos.iter().zip(&model.fitted).filter(|(_, f)| test(f));
        all.map(|(p, _)| p.stem.as_str()).collect::<Vec<_>>().join(", ")
    };
    let unconfirmed = named(&|f| f.unconfirmed);
    if !unconfirmed.is_empty() {
        progress.warn(&format!(
            "the cameras of {unconfirmed} may be wrong: they rest on one pair of photos, whose matches are few or mostly \
             contradict each other; photos from between would settle it"
        ));
    }
    let rotation = |f: &super::Fitted| f.rotation_sigma.to_degrees();
    let doubtful = |f: &super::Fitted| rotation(f) > DOUBTFUL_ROTATION;
    let worst = model.fitted.iter().filter(|f| doubtful(f)).map(rotation).fold(0.0, f64::max);
    if let Some(sigma) = model.focal_log_sigma.filter(|s| *s > UNSURE_FOCAL) {
        let angles = match worst > 0.0 {
            true => format!(", and with it the angles between the cameras by up to ±{worst:.0}°"),
            false => String::new(),
        };
        let why = match model.flat {
            true => "what the photos show is flat, which leaves",
            false => "the photos leave",
        };
        progress.warn(&format!(
            "{why} the focal length open by ±{:.0} %{angles}: depth may be stretched; photos from more different directions, or \
             with EXIF focal length, would settle it",
            100.0 * sigma
        ));
    } else if worst > 0.0 {
        progress.warn(&format!(
            "the photos leave the direction of {} open by up to ±{worst:.0}°: photos from between would settle it",
            named(&doubtful)
        ));
    }
}

/// Depth maps and points of registered photos by multi-view stereo. `priors` (one optional entry
/// per photo, or empty) guide depth where matching fails.
pub fn dense(
    sweep: &dyn PlaneSweep,
    photos: &[Photo],
    priors: &[Option<DepthPrior>],
    model: SparseModel,
    method: String,
    options: &StereoOptions,
    progress: &dyn Progress,
) -> Result<Geometry> {
    let images: Vec<_> = photos.iter().map(|p| p.image.clone()).collect();
    let coverage: Vec<_> = photos.iter().map(|p| p.coverage.clone()).collect();
    let positions: Vec<_> = model.points.iter().map(|p| p.position).collect();
    let Dense { depths, points, sky } =
        stereo::dense(sweep, &images, &coverage, &model.cameras, &positions, priors, options, progress)?;
    let SparseModel { cameras, focal_log_sigma, fitted, .. } = model;
    Ok(Geometry { cameras, depths, points, focal_log_sigma, fitted, sky, method })
}

/// Least residual of a photo that does not fit the model, as a multiple of the median of the
/// others.
const STRANGE: f64 = 4.0;
/// Least residual of such a photo, share of the long side (half a pixel at 640).
const STRANGE_SHARE: f64 = 0.5 / 640.0;

/// Least offset of the principal point that is reported, share of the long side: stabilised sensors
/// move by a hundredth.
const OFF_CENTRE: f64 = 0.03;

/// Distance of the principal point from the image centre, working pixels. Bars that were cut off
/// may lie over a photo or frame a whole one, so the centre is the nearest point between that of
/// the picture and that of the file.
fn off_middle(photo: &Photo, principal_point: DVec2) -> f64 {
    let picture = DVec2::new(photo.image.width as f64, photo.image.height as f64) * 0.5;
    let (w, h) = photo.original_size;
    let to_file = DVec2::from(photo.to_working.apply([0.5 * f64::from(w), 0.5 * f64::from(h)])) - picture;
    let way = to_file.dot(principal_point - picture) / to_file.length_squared().max(1e-9);
    (principal_point - picture - way.clamp(0.0, 1.0) * to_file).length()
}

/// Warns of photos with few inliers, an off-centre principal point or large residuals.
fn warn_of_misfits(photos: &[Photo], model: &SparseModel, progress: &dyn Progress) {
    for (v, ((photo, own), camera)) in photos.iter().zip(&model.fitted).zip(&model.cameras).enumerate() {
        let (stem, long) = (&photo.stem, photo.image.width.max(photo.image.height) as f64);
        if own.agreement < DOUBTFUL {
            progress.warn(&format!(
                "{stem}: only {:.0} % of its matches with other photos agree with the cameras that were found; its place, or \
                 the others', is doubtful: leave it out, or add photos between it and the others",
                100.0 * own.agreement
            ));
        }
        let off = off_middle(photo, DVec2::new(camera.cx, camera.cy)) / long;
        if off > OFF_CENTRE {
            progress.warn(&format!(
                "{stem}: its optical axis was found {:.0} % of the photo away from the middle; either it is cut out of a larger \
                 photo, which would serve better, or the cameras are doubtful",
                100.0 * off
            ));
        }
        let others = model.fitted.iter().enumerate().filter(|(o, _)| *o != v);
        let Some(usual) = crate::math::median(&mut others.map(|(_, f)| f.residual).collect::<Vec<_>>())
        else {
            continue;
        };
        if own.residual > STRANGE * usual && own.residual > STRANGE_SHARE * long {
            progress.warn(&format!(
                "{stem}: its matches miss the model by {:.1} px, those of the other photos by {usual:.1}; something moved, or \
                 its lens is not what radial distortion explains",
                own.residual
            ));
        }
    }
}

/// Most keypoints per photo.
pub const MAX_KEYPOINTS: usize = 4096;

/// Keypoints of all photos by `detect`.
pub fn learned_features(
    photos: &[Photo],
    detect: &mut Detect,
    progress: &dyn Progress,
) -> Result<Vec<Keypoints>> {
    progress.begin("features", photos.len() as u64);
    let mut out = Vec::with_capacity(photos.len());
    for (k, p) in photos.iter().enumerate() {
        progress.check()?;
        out.push(detect(&p.image)?);
        progress.step(k as u64 + 1, &p.stem);
    }
    progress.end();
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photo::{Light, PlainBorder};
    use crate::progress::{Recorded, Silent};
    use crate::scene::{Lens, RgbImage};
    use crate::{Fitted, testing};

    #[test]
    fn off_middle_accepts_file_centre() {
        let image = RgbImage { width: 640, height: 480, data: vec![[0.5; 3]; 640 * 480] };
        let mut photo = crate::photo::from_pixels("a.png".as_ref(), &image, None, 640).unwrap();
        assert!((off_middle(&photo, DVec2::new(330.0, 240.0)) - 10.0).abs() < 1e-9);
        photo.cut(PlainBorder { bottom: 80, ..PlainBorder::default() });
        // The centre of the picture is at 200, that of the file at 240.
        for (y, off) in [(190.0, 10.0), (200.0, 0.0), (225.0, 0.0), (240.0, 0.0), (252.0, 12.0)] {
            assert!((off_middle(&photo, DVec2::new(320.0, y)) - off).abs() < 1e-9, "{y}");
        }
    }

    #[test]
    fn warn_of_misfits_names_each_cause() {
        let truth = testing::train(&testing::folder());
        let good = Fitted { agreement: 0.98, residual: 0.1, ..Fitted::default() };
        let mut model =
            SparseModel { cameras: truth.cameras.clone(), fitted: vec![good; 4], ..Default::default() };
        let warned = |model: &SparseModel| {
            let recorded = Recorded::new(&Silent);
            warn_of_misfits(&truth.photos, model, &recorded);
            recorded.warnings()
        };
        assert!(warned(&model).is_empty());
        model.fitted[0].agreement = 0.28;
        model.cameras[1].cx += 40.0;
        model.fitted[2].residual = 2.0;
        let all = warned(&model);
        assert_eq!(all.len(), 3, "{all:?}");
        assert!(all[0].starts_with("train_00: only 28 % of its matches"), "{}", all[0]);
        assert!(
            all[1].starts_with("train_01: its optical axis was found 6 % of the photo away"),
            "{}",
            all[1]
        );
        assert!(all[2].starts_with("train_02: its matches miss the model by 2.0 px"), "{}", all[2]);
    }

    #[test]
    fn warn_of_doubt_names_unconfirmed_cameras() {
        let truth = testing::train(&testing::folder());
        let mut model = SparseModel { fitted: vec![Fitted::default(); 4], ..Default::default() };
        let warned = |model: &SparseModel| {
            let recorded = Recorded::new(&Silent);
            warn_of_doubt(&truth.photos, model, &recorded);
            recorded.warnings()
        };
        assert!(warned(&model).is_empty());
        model.fitted[2].unconfirmed = true;
        let all = warned(&model);
        assert!(all.len() == 1 && all[0].starts_with("the cameras of train_02 may be wrong"), "{all:?}");
    }

    fn grey_photo() -> Photo {
        let image = RgbImage { width: 80, height: 64, data: vec![[0.5; 3]; 80 * 64] };
        crate::photo::from_pixels("a.png".as_ref(), &image, None, 80).unwrap()
    }

    #[test]
    fn warn_of_doubt_states_focal_sigma() {
        let photos = [grey_photo(), grey_photo()];
        let warned_of = |focal_log_sigma, rotation_sigma, flat| {
            let fitted = vec![Fitted { rotation_sigma, ..Fitted::default() }; 2];
            let recorded = Recorded::new(&Silent);
            let model = SparseModel { focal_log_sigma, fitted, flat, ..Default::default() };
            warn_of_doubt(&photos, &model, &recorded);
            recorded.warnings()
        };
        let warned = |focal, rotation| warned_of(focal, rotation, false);
        assert!(warned(Some(0.03), 0.0).is_empty());
        let all = warned_of(Some(0.3), 0.0, true);
        let said = "what the photos show is flat, which leaves the focal length open by ±30 %: depth may be stretched";
        assert!(all.len() == 1 && all[0].starts_with(said), "{all:?}");
        let all = warned(Some(0.12), 0.0);
        let said = "the photos leave the focal length open by ±12 %: depth may be stretched";
        assert!(all.len() == 1 && all[0].starts_with(said), "{all:?}");
        let all = warned(Some(0.12), 0.06);
        assert!(all.len() == 1 && all[0].contains("the angles between the cameras by up to ±3°"), "{all:?}");
    }

    fn psnr(a: &RgbImage, b: &RgbImage) -> f64 {
        let squares =
            a.data.iter().flatten().zip(b.data.iter().flatten()).map(|(a, b)| f64::from(a - b).powi(2));
        -10.0 * (squares.sum::<f64>() / (3 * a.data.len()) as f64).log10()
    }

    #[test]
    #[ignore = "takes long: tools/test-long"]
    fn place_undistorts_and_equalises_photos() {
        let truth = testing::train(&testing::folder());
        let registry = splatvk_infer::Registry::open(None).unwrap();
        let mut xfeat = splatvk_infer::xfeat::XFeat::load(&registry).unwrap();
        let lens = Lens::radial(-0.12, 0.03);
        let mut photos: Vec<Photo> =
            truth.photos.iter().map(|p| testing::lensed(p, truth.cameras[0].fx, lens)).collect();
        let dim = Light { gain: [0.7; 3], ..Light::NONE };
        photos[1].image = dim.applied(&photos[1].image);
        let before = psnr(&photos[1].image, &truth.photos[1].image);
        let placed = place(photos, None, &mut |i| Ok(testing::keypoints(&mut xfeat, i)), 0, &Silent).unwrap();
        // Against the undistorted photo with the gain of the others.
        for (photo, original) in placed.photos.iter().zip(&truth.photos) {
            let agreed = psnr(&photo.image, &original.image);
            println!("{}: {agreed:.1} dB, before {before:.1}", photo.stem);
            // Measured: 41.6 to 42.5 dB; interpolating twice costs the rest.
            assert!(agreed > 38.0, "{}: {agreed}, before {before}", photo.stem);
            assert!(photo.lens().k1 < -0.1 && photo.fine.is_none());
        }
        // The original camera has the size of the file.
        let original = placed.photos[0].original_camera(&placed.model.cameras[0]);
        assert_eq!((original.width, original.height), (640, 480));
        assert!((original.fx / truth.cameras[0].fx - 1.0).abs() < 0.005);
    }
}
