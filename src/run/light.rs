//! Photometric correction of the photos, in run.json, the report and the closing table.
use crate::photo::{Light, Photo};
use crate::report::Figure;
use serde_json::{Value, json};

/// Entries of run.json per photo; `None` if no photo was corrected.
pub(super) fn record(photos: &[Photo]) -> Option<Value> {
    any_corrected(photos).then(|| photos.iter().map(light_json).collect())
}

fn light_json(photo: &Photo) -> Value {
    let Light { gain, falloff, sigma_ev, sigma_corner, unexplained } = photo.light;
    json!({
        "photo": photo.stem, "exposure_ev": photo.light.exposure_ev(), "exposure_doubt_ev": sigma_ev,
        "red_to_green": gain[0] / gain[1], "blue_to_green": gain[2] / gain[1],
        "corner": photo.light.corner(), "corner_doubt": sigma_corner, "gain": gain, "falloff": falloff, "unexplained": unexplained,
    })
}

/// Line of the closing table: the range over the photos.
pub(super) fn figure(photos: &[Photo]) -> Option<Figure> {
    if !any_corrected(photos) {
        return None;
    }
    let (dark, bright) = range(photos, Light::exposure_ev);
    let sigma = range(photos, |l| l.sigma_ev).1;
    let colour_percent = |k: usize| {
        let (low, high) = range(photos, |l| l.white_balance()[k]);
        100.0 * (high / low - 1.0)
    };
    let corner = 100.0 * (1.0 - range(photos, Light::corner).0);
    let text = format!(
        "exposures {:.2} ± {sigma:.2} EV apart, colours {:.0} %, corners −{corner:.0} %: evened out",
        bright - dark,
        colour_percent(0).max(colour_percent(1)),
    );
    Some(Figure::new(
        "light",
        text,
        "Differences of exposure, white balance and vignetting among the photos.",
    ))
}

/// Minimum and maximum of a figure over the photos.
fn range(photos: &[Photo], figure: impl Fn(&Light) -> f64) -> (f64, f64) {
    let values = photos.iter().map(|p| figure(&p.light));
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)))
}

fn any_corrected(photos: &[Photo]) -> bool {
    photos.iter().any(|p| !p.light.is_none())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::RgbImage;

    #[test]
    fn light_is_recorded_only_if_corrected() {
        let image = RgbImage { width: 64, height: 64, data: vec![[0.5; 3]; 64 * 64] };
        let photo = |name: &str| {
            crate::photo::from_pixels(name.as_ref(), &image, None, crate::photo::MAX_SIZE).unwrap()
        };
        let mut photos = vec![photo("a.png"), photo("b.png")];
        assert!(record(&photos).is_none() && figure(&photos).is_none());
        photos[1].light = Light {
            gain: [2.2, 2.0, 2.0],
            falloff: [-0.2, 0.0],
            sigma_ev: 0.04,
            sigma_corner: 0.01,
            unexplained: 0.0,
        };
        let json = record(&photos).unwrap();
        assert_eq!((&json[0]["exposure_ev"], &json[1]["photo"]), (&json!(0.0), &json!("b")));
        assert!((json[1]["corner"].as_f64().unwrap() - (-0.2f64).exp()).abs() < 1e-12);
        let text = figure(&photos).unwrap().value;
        assert_eq!(text, "exposures 1.05 ± 0.04 EV apart, colours 10 %, corners −18 %: evened out");
    }
}
