//! Registration that leaves out photos that do not fit (docs/internals/method.md#photos-left-out).
//! A photo with a wrong pose spoils the scene: splats are trained to explain it from there.
use super::SparseModel;
use super::choose::{LeftOut, Reason};
use super::confidence::DOUBTFUL;
use super::matching::Keypoints;
use super::sfm::{self, Unregistered};
use super::still;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::{Error, Result};

/// Registered photos and those left out.
pub struct Placed {
    /// The registered photos.
    pub photos: Vec<Photo>,
    /// Their cameras and points.
    pub model: SparseModel,
    /// The others, in the order in which they were left out.
    pub left_out: Vec<LeftOut>,
}

/// Structure from motion that leaves out photos that it cannot register with confidence, as long as
/// more than half remain: agreement of fewer is no evidence against the others. `features` are one
/// per photo, or empty.
pub fn place(
    mut photos: Vec<Photo>,
    mut features: Vec<Keypoints>,
    seed: u64,
    progress: &dyn Progress,
) -> Result<Placed> {
    let given = photos.len();
    let mut left_out = Vec::new();
    loop {
        let found = sfm::reconstruct(&photos, &features, seed, progress);
        if let Ok(model) = &found
            && still::clear_scene(&mut photos, &model.cameras)
        {
            continue;
        }
        let views: Vec<(usize, Reason)> = match &found {
            Ok(model) => least_confident(model).into_iter().collect(),
            Err(Unregistered { views, .. }) => views.clone(),
        };
        let rest = photos.len() - views.len();
        if views.is_empty() || rest < 2 || 2 * rest <= given {
            let model = found.map_err(|unregistered| with_overlay(unregistered.error, &photos))?;
            return Ok(Placed { photos, model, left_out });
        }
        for (view, reason) in views.into_iter().rev() {
            let photo = remove_photo(&mut photos, &mut features, view);
            progress.warn(&message(&photo.stem, &reason));
            left_out.push(LeftOut { photo: photo.stem, reason });
        }
    }
}

/// Adds the description of an overlay to an error about the input, as its possible cause.
fn with_overlay(error: Error, photos: &[Photo]) -> Error {
    match (still::description(photos), error) {
        (Some(overlay), Error::Input(text)) => Error::input(format!(
            "{text}; something stands still in every photo and does not count ({overlay}): give the photos without it"
        )),
        (_, error) => error,
    }
}

/// Removes a photo and its features, if there are any.
fn remove_photo(photos: &mut Vec<Photo>, features: &mut Vec<Keypoints>, view: usize) -> Photo {
    if view < features.len() {
        features.remove(view);
    }
    photos.remove(view)
}

/// The photo with the lowest agreement, if that is below [`DOUBTFUL`].
fn least_confident(model: &SparseModel) -> Option<(usize, Reason)> {
    let shares = model.fitted.iter().map(|f| f.agreement).enumerate();
    let (view, share) = shares.filter(|s| s.1 < DOUBTFUL).min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some((view, Reason::Doubtful((100.0 * share).round() as u8)))
}

/// Warning for a photo that is left out.
pub(super) fn message(stem: &str, reason: &Reason) -> String {
    const JOIN: &str = "a photo from between it and the others would join it to them";
    match reason {
        Reason::Duplicate(other) => format!("{stem} is left out: it is the same picture as {other}"),
        Reason::Doubtful(percent) => format!(
            "{stem} is left out: only {percent} % of its matches with the other photos agree with the place that was found \
             for it; {JOIN}"
        ),
        _ => format!("{stem} is left out: it shares too little with the other photos; {JOIN}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::{Recorded, Silent};
    use crate::scene::RgbImage;
    use crate::testing;

    fn grey(photo: &Photo) -> Photo {
        let mut sky = photo.clone();
        sky.stem = "sky".into();
        sky.image.data.iter_mut().enumerate().for_each(|(i, c)| *c = [0.4, 0.6, 0.5 + 1e-7 * i as f32]);
        sky
    }

    #[test]
    fn place_leaves_out_unrelated_photo() {
        let truth = testing::train(&testing::folder());
        let mut photos = truth.photos.clone();
        photos.insert(1, grey(&photos[0]));
        let recorded = Recorded::new(&Silent);
        let placed = place(photos, Vec::new(), 0, &recorded).unwrap();
        let names: Vec<&str> = placed.photos.iter().map(|p| p.stem.as_str()).collect();
        assert_eq!(names, ["train_00", "train_01", "train_02", "train_03"]);
        assert_eq!(placed.left_out, [LeftOut { photo: "sky".into(), reason: Reason::NoOverlap }]);
        assert!(recorded.warnings()[0].starts_with("sky is left out: it shares too little"));
        let e = crate::align::pose_errors(&placed.model.cameras, &truth.cameras, truth.mean_depth);
        assert!(e.rotation_degrees.iter().all(|v| *v < 0.05), "{e:?}");
    }

    #[test]
    fn place_error_names_large_overlay() {
        let mut photos = testing::small_train().photos[..2].to_vec();
        for photo in &mut photos {
            // The overlay covers all but a strip.
            let (width, height) = (photo.image.width, photo.image.height);
            let data = (0..width * height).map(|i| i / width > 20).collect();
            photo.set_overlay(Some(crate::scene::Image { width, height, data }));
        }
        let error = place(photos, Vec::new(), 0, &Silent).err().unwrap();
        assert!(error.exit_code() == 2, "{error}");
        assert!(
            error.to_string().contains("something stands still in every photo and does not count"),
            "{error}"
        );
    }

    #[test]
    fn place_keeps_more_than_half() {
        // Two photos that overlap, and two unrelated ones.
        let mut photos = testing::small_train().photos[..2].to_vec();
        let sky = grey(&photos[0]);
        let mut dusk = Photo { stem: "dusk".into(), ..sky.clone() };
        dusk.image.data.iter_mut().for_each(|c| *c = c.map(|v| v - 0.3));
        photos.extend([sky, dusk]);
        let error = place(photos, Vec::new(), 0, &Silent).err().unwrap();
        assert!(error.to_string().contains("do not overlap") && error.exit_code() == 2, "{error}");
    }

    #[test]
    fn remove_photo_removes_its_features() {
        let photo = |stem: &str| {
            let image = RgbImage { width: 64, height: 64, data: vec![[0.5; 3]; 64 * 64] };
            crate::photo::from_pixels(stem.as_ref(), &image, None, 64).unwrap()
        };
        let mut photos = ["a", "b", "c"].map(photo).to_vec();
        let mut features = [8, 16, 24].map(|dim| Keypoints { dim, ..Keypoints::default() }).to_vec();
        assert_eq!(remove_photo(&mut photos, &mut features, 1).stem, "b");
        let left: Vec<_> = photos.iter().zip(&features).map(|(p, f)| (p.stem.as_str(), f.dim)).collect();
        assert_eq!(left, [("a", 8), ("c", 24)]);
    }

    #[test]
    fn least_confident_has_lowest_agreement() {
        let fitted = |agreement| crate::Fitted { agreement, ..Default::default() };
        let model = |shares: &[f64]| SparseModel {
            fitted: shares.iter().map(|s| fitted(*s)).collect(),
            ..SparseModel::default()
        };
        assert_eq!(least_confident(&model(&[0.93, 0.98, 0.86])), None);
        assert_eq!(least_confident(&model(&[0.8, 0.98, 0.3])), Some((2, Reason::Doubtful(30))));
    }
}
