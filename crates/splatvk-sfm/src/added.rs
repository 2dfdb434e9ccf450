//! Registration of new photos to a scene (docs/internals/method.md#photos-added-later).
use super::matching::Detect;
use super::sfm::{self, Known};
use super::{Confidence, Fitted, SolvedCameras, learned_features, light};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::Camera;
use crate::{Error, Result};

/// Photos of a scene with their cameras; one entry per photo in each list. The photos are
/// undistorted and photometrically equalised.
#[derive(Clone, Debug)]
pub struct KnownPhotos {
    /// Photos at working resolution.
    pub photos: Vec<Photo>,
    /// Cameras of the working images.
    pub cameras: Vec<Camera>,
    /// Estimated intrinsics and fit quality.
    pub fitted: Vec<Fitted>,
}

/// Registers `new` photos in the world frame of the `known` ones. Returns all photos, the known
/// ones first; the new ones are undistorted and in the light of the scene. The error names a photo
/// that cannot be registered with confidence.
pub fn add(
    known: &KnownPhotos,
    new: Vec<Photo>,
    detect: &mut Detect,
    seed: u64,
    progress: &dyn Progress,
) -> Result<SolvedCameras> {
    let count = known.photos.len();
    let mut photos: Vec<Photo> = known.photos.iter().cloned().chain(new).collect();
    let features = learned_features(&photos, detect, progress)?;
    let cameras = Known { cameras: &known.cameras, fitted: &known.fitted };
    let model = sfm::with_added(&photos, cameras, &features, seed, progress)?;
    for (photo, fitted) in photos.iter().zip(&model.fitted).skip(count) {
        check_confidence(&photo.stem, fitted)?;
    }
    for ((photo, fitted), camera) in photos.iter_mut().zip(&model.fitted).zip(&model.cameras).skip(count) {
        // The fine image only serves the registration.
        photo.fine = None;
        photo.straighten(fitted.lens, camera);
    }
    let photos = light::in_light_of(photos, count, &model, progress);
    Ok(SolvedCameras {
        photos,
        model,
        left_out: Vec::new(),
        method: "matches with the scene + stereo".into(),
    })
}

/// Returns an error if the confidence is low.
fn check_confidence(stem: &str, fitted: &Fitted) -> Result<()> {
    if fitted.confidence() > Confidence::Low {
        return Ok(());
    }
    Err(Error::input(format!(
        "{stem}: only {:.0} % of its matches with the scene's photos agree with the place that was found for it, its direction \
         is open by ±{:.1}°; add a photo from between it and the scene's photos first",
        100.0 * fitted.agreement,
        fitted.rotation_sigma.to_degrees()
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn check_confidence_refuses_low_by_name() {
        let sure = Fitted { agreement: 0.97, rotation_sigma: 0.002, ..Fitted::default() };
        assert!(check_confidence("late", &sure).is_ok());
        let refusal = |fitted: Fitted| check_confidence("late", &fitted).unwrap_err().to_string();
        let contradicted = refusal(Fitted { agreement: 0.6, ..sure });
        assert!(contradicted.starts_with("late: only 60 % of its matches"), "{contradicted}");
        let open = refusal(Fitted { rotation_sigma: 0.06, ..sure });
        assert!(open.starts_with("late: ") && open.contains("its direction is open by ±3.4°"), "{open}");
    }
}
