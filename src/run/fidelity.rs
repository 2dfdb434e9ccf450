//! PSNR of a scene against the photos that it was made from.
use super::view::DecodedFrame;
use crate::fit::MOST_PSNR;
use crate::pass::metrics;
use crate::photo::Photo;
use crate::pose::Confidence;
use crate::progress::{Progress, Recorded};
use crate::report::Figure;
use crate::scene::Coverage;
use rayon::prelude::*;

/// PSNR gap to the best photo, dB, from which a photo is reported. It doubles the error amplitude,
/// more than texture does among photos of one place.
const FAR_BELOW: f64 = 6.0;
/// PSNR, dB, from which a photo is never reported, however much better others are: photos that were
/// added last have had the fewest steps, and photos that something hides are at 13 to 25 dB.
const GOOD: f64 = 30.0;
/// Mean PSNR, dB, below which the scene does not reproduce its photos.
const POOR: f64 = 22.0;
/// Mean PSNR, dB, below which the scene is useless and its cameras are as doubtful.
const BAD: f64 = 18.0;

/// PSNR of the frames of a finished scene against its photos, dB: the language stage has moved the
/// splats since the colours were trained.
pub(super) fn psnr(frames: &[DecodedFrame], photos: &[Photo]) -> Vec<f64> {
    frames.par_iter().zip(photos).map(|(frame, photo)| masked_psnr(frame, photo)).collect()
}

/// PSNR over the used pixels of a photo, dB, at most [`MOST_PSNR`].
fn masked_psnr(frame: &DecodedFrame, photo: &Photo) -> f64 {
    let weights = photo.coverage.as_ref().map(Coverage::weights);
    let is_used = |i: usize| weights.as_ref().is_none_or(|w| w.data[i] > 0.0);
    metrics::psnr_masked(&frame.rendered.rgb, &photo.target(), is_used).min(MOST_PSNR)
}

/// Mean over the photos and their range, for the closing table.
pub(super) fn figure(psnr: &[f64]) -> Figure {
    let (low, high) = range(psnr);
    let text = format!("{:.2} dB ({low:.1} to {high:.1})", mean(psnr));
    let meaning = "How closely the scene repeats its photos: 30 dB or more is good, below 22 dB the scene is doubtful. \
                   It says nothing of places between the photos.";
    Figure::that_matters("train PSNR", text, meaning)
}

/// Warns if the scene shows all of its photos badly, and names single photos that it shows badly.
pub(super) fn warn(photos: &[Photo], psnr: &[f64], progress: &Recorded) {
    if let Some(text) = warning_about(photos.iter().map(|p| p.stem.as_str()), psnr) {
        progress.warn(&text);
    }
    if let Some(text) = overall_warning(psnr) {
        progress.warn_first(&text);
    }
}

/// First line of a summary if the scene shows all of its photos badly, else empty.
pub(super) fn heading(psnr: &[f64]) -> String {
    overall_warning(psnr).map_or_else(String::new, |text| format!("  warning: {text}\n"))
}

/// Warning for a low mean PSNR, which a comparison among the photos does not find.
fn overall_warning(psnr: &[f64]) -> Option<String> {
    (ceiling(psnr) < Confidence::High).then(|| {
        format!(
            "photos are reproduced at {:.1} dB only ({GOOD:.0} or more is usual): the cameras may be wrong, or much of what the \
             photos show moved, hides the scene or stands still in the frame; compare the previews with the photos",
            mean(psnr)
        )
    })
}

/// Highest confidence in the cameras at this PSNR: correct cameras show the photos well.
pub(super) fn ceiling(psnr: &[f64]) -> Confidence {
    match mean(psnr) {
        _ if psnr.is_empty() => Confidence::High,
        mean if mean < BAD => Confidence::Low,
        mean if mean < POOR => Confidence::Medium,
        _ => Confidence::High,
    }
}

/// Warning with the photos that the scene shows far worse than the best one.
fn warning_about<'a>(names: impl Iterator<Item = &'a str>, psnr: &[f64]) -> Option<String> {
    let (_, best) = range(psnr);
    let poor: Vec<String> = names
        .zip(psnr)
        .filter(|(_, psnr)| **psnr < GOOD.min(best - FAR_BELOW))
        .map(|(name, psnr)| format!("{name} ({psnr:.1} dB)"))
        .collect();
    (!poor.is_empty()).then(|| {
        format!(
            "the scene shows {} far worse than the best photo ({best:.1} dB): something in it moved or hides the rest, or its \
             camera is wrong; look at its preview, and leave it out if that is so",
            poor.join(", ")
        )
    })
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

fn range(values: &[f64]) -> (f64, f64) {
    values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |r, v| (r.0.min(*v), r.1.max(*v)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pass::renderer::RenderedFrame;
    use crate::scene::RgbImage;

    #[test]
    fn warning_names_only_hidden_photo() {
        let warning = |psnr: [f64; 4]| warning_about(["a", "b", "c", "d"].into_iter(), &psnr);
        assert_eq!(warning([32.0, 30.0, 26.1, 31.0]), None);
        assert_eq!(warning([38.0, 30.1, 36.0, 37.0]), None);
        let text = warning([32.0, 13.3, 34.0, 31.0]).unwrap();
        assert!(text.contains("shows b (13.3 dB) far worse than the best photo (34.0 dB)"), "{text}");
    }

    #[test]
    fn low_mean_psnr_limits_confidence() {
        assert_eq!(overall_warning(&[25.0, 27.0, 24.0]), None);
        assert_eq!(ceiling(&[25.0, 27.0, 24.0]), Confidence::High);
        let text = overall_warning(&[9.4, 9.6]).unwrap();
        assert!(text.starts_with("photos are reproduced at 9.5 dB only (30 or more is usual)"), "{text}");
        assert_eq!((ceiling(&[9.4, 9.6]), ceiling(&[20.0, 21.0])), (Confidence::Low, Confidence::Medium));
        assert_eq!(ceiling(&[]), Confidence::High);
    }

    #[test]
    fn psnr_compares_photo_with_finished_scene() {
        let image = |v: f32| RgbImage { width: 64, height: 64, data: vec![[v; 3]; 4096] };
        let frame = |v: f32| {
            let rendered = RenderedFrame { rgb: image(v), ..RenderedFrame::default() };
            DecodedFrame::new(rendered, Vec::new(), None).unwrap()
        };
        let photos =
            ["a.png", "b.png"].map(|n| crate::photo::from_pixels(n.as_ref(), &image(0.5), None, 64).unwrap());
        let found = psnr(&[frame(0.6), frame(0.5)], &photos);
        assert!((found[0] - 20.0).abs() < 1e-3 && found[1] == MOST_PSNR, "{found:?}");
    }

    #[test]
    fn figure_states_mean_and_range() {
        assert_eq!(figure(&[32.0, 34.0]).value, "33.00 dB (32.0 to 34.0)");
    }
}
