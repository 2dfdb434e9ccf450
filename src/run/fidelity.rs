//! How well a scene shows the photos that it was made from.
use super::view::DecodedFrame;
use crate::fit::MOST_PSNR;
use crate::pass::metrics;
use crate::photo::Photo;
use crate::pose::Confidence;
use crate::progress::{Progress, Recorded};
use crate::scene::Coverage;
use rayon::prelude::*;

/// A photo this much below the best one, dB, is not shown as it should be: half the amplitude of
/// the error is more than texture makes among photos of one place.
const FAR_BELOW: f64 = 6.0;
/// A photo that is shown this well, dB, is not said to be shown badly, however much better others
/// are: photos that were added last have seen the fewest steps, and photos that something hides are
/// at 13 to 25 dB.
const GOOD: f64 = 30.0;
/// Photos that come out below this on average, dB, are not what the scene shows: …
const POOR: f64 = 22.0;
/// … and below this the scene is of no use, and its cameras are as doubtful.
const BAD: f64 = 18.0;

/// How well the frames of a finished scene show its photos, dB: the language stage has moved its
/// splats since the colours were trained.
pub(super) fn psnr(frames: &[DecodedFrame], photos: &[Photo]) -> Vec<f64> {
    let one = |(f, p): (&DecodedFrame, &Photo)| {
        let weights = p.coverage.as_ref().map(Coverage::weights);
        let counts = |i: usize| weights.as_ref().is_none_or(|w| w.data[i] > 0.0);
        metrics::psnr_masked(&f.rendered.rgb, &p.target(), counts).min(MOST_PSNR)
    };
    frames.par_iter().zip(photos).map(one).collect()
}

/// Mean over the photos and their range, for the closing table.
pub(super) fn figure(psnr: &[f64]) -> (String, String) {
    let (low, high) = range(psnr);
    let text = format!("{:.2} dB ({low:.1} to {high:.1})", mean(psnr));
    ("train PSNR".to_owned(), text)
}

/// Warns where the scene shows its photos badly: first of all if that is true of all of them, then
/// by name.
pub(super) fn warn(photos: &[Photo], psnr: &[f64], progress: &Recorded) {
    if let Some(text) = warning_about(photos.iter().map(|p| p.stem.as_str()), psnr) {
        progress.warn(&text);
    }
    if let Some(text) = overall_warning(psnr) {
        progress.warn_first(&text);
    }
}

/// The line that a summary begins with where the scene shows all of its photos badly.
pub(super) fn heading(psnr: &[f64]) -> String {
    overall_warning(psnr).map_or_else(String::new, |text| format!("  warning: {text}\n"))
}

/// Says that the scene shows all of its photos badly, which a comparison among them cannot tell.
fn overall_warning(psnr: &[f64]) -> Option<String> {
    (ceiling(psnr) < Confidence::High).then(|| {
        format!(
            "photos are reproduced at {:.1} dB only ({GOOD:.0} or more is usual): the cameras may be wrong, or much of what the \
             photos show moved, hides the scene or stands still in the frame; compare the previews with the photos",
            mean(psnr)
        )
    })
}

/// The most confidence in the cameras of a scene that shows its photos so: cameras that are right
/// show them well.
pub(super) fn ceiling(psnr: &[f64]) -> Confidence {
    match mean(psnr) {
        _ if psnr.is_empty() => Confidence::High,
        mean if mean < BAD => Confidence::Low,
        mean if mean < POOR => Confidence::Medium,
        _ => Confidence::High,
    }
}

/// Names the photos that the scene shows far worse than the best one.
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
    fn a_hidden_photo_is_named_and_others_are_not() {
        let warning = |psnr: [f64; 4]| warning_about(["a", "b", "c", "d"].into_iter(), &psnr);
        assert_eq!(warning([32.0, 30.0, 26.1, 31.0]), None);
        assert_eq!(warning([38.0, 30.1, 36.0, 37.0]), None);
        let text = warning([32.0, 13.3, 34.0, 31.0]).unwrap();
        assert!(text.contains("shows b (13.3 dB) far worse than the best photo (34.0 dB)"), "{text}");
    }

    #[test]
    fn photos_all_shown_badly_are_said_so() {
        assert_eq!(overall_warning(&[25.0, 27.0, 24.0]), None);
        assert_eq!(ceiling(&[25.0, 27.0, 24.0]), Confidence::High);
        let text = overall_warning(&[9.4, 9.6]).unwrap();
        assert!(text.starts_with("photos are reproduced at 9.5 dB only (30 or more is usual)"), "{text}");
        assert_eq!((ceiling(&[9.4, 9.6]), ceiling(&[20.0, 21.0])), (Confidence::Low, Confidence::Medium));
        assert_eq!(ceiling(&[]), Confidence::High);
    }

    #[test]
    fn a_photo_is_compared_with_the_frame_of_the_finished_scene() {
        let image = |v: f32| RgbImage { width: 64, height: 64, data: vec![[v; 3]; 4096] };
        let frame = |v: f32| DecodedFrame {
            rendered: RenderedFrame { rgb: image(v), ..RenderedFrame::default() },
            codes: Vec::new(),
        };
        let photos =
            ["a.png", "b.png"].map(|n| crate::photo::from_pixels(n.as_ref(), &image(0.5), None, 64).unwrap());
        let found = psnr(&[frame(0.6), frame(0.5)], &photos);
        assert!((found[0] - 20.0).abs() < 1e-3 && found[1] == MOST_PSNR, "{found:?}");
    }

    #[test]
    fn the_figure_states_mean_and_range() {
        assert_eq!(figure(&[32.0, 34.0]).1, "33.00 dB (32.0 to 34.0)");
    }
}
