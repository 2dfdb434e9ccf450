//! Photometric calibration of one photo: exposure, white balance and vignetting relative to the
//! scene, and their removal.
use crate::scene::{RgbImage, to_linear, to_srgb};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// The photo is `gain[c] · exp(falloff[0] r² + falloff[1] r⁴)` times the scene, in linear light; r
/// is the distance from the image centre in half diagonals, 1 in the corners.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Light {
    /// Per channel; 1 = as in the scene.
    pub gain: [f64; 3],
    /// Vignetting as ln per r² and r⁴; 0 = none.
    pub falloff: [f64; 2],
    /// One standard deviation of the exposure, EV; 0 where nothing was estimated.
    pub sigma_ev: f64,
    /// One standard deviation of the corner's brightness, relative to it; 0 where nothing was
    /// estimated.
    pub sigma_corner: f64,
    /// Remaining difference to the brightness of the other photos, ln, in the tenth of the photo's
    /// parts that fits worst; 0 where nothing was estimated.
    pub unexplained: f64,
}

impl Default for Light {
    fn default() -> Self {
        Light::NONE
    }
}

impl Light {
    /// The scene's own light: no correction.
    pub const NONE: Light =
        Light { gain: [1.0; 3], falloff: [0.0; 2], sigma_ev: 0.0, sigma_corner: 0.0, unexplained: 0.0 };
    /// Largest unexplained difference without a warning, ln: half an f-stop.
    const UNEXPLAINED: f64 = 0.35;

    /// Whether the model fits the photo; false where parts are lit differently than in the other
    /// photos: highlights, flash, a moving shadow.
    pub fn explains_the_photo(&self) -> bool {
        self.unexplained <= Light::UNEXPLAINED
    }

    /// Whether the photo needs no correction.
    pub fn is_none(&self) -> bool {
        self.gain == [1.0; 3] && self.falloff == [0.0; 2]
    }

    /// Exposure relative to the scene, EV: the mean over the channels in log light.
    pub fn exposure_ev(&self) -> f64 {
        self.gain.iter().map(|g| g.log2()).sum::<f64>() / 3.0
    }

    /// Red and blue relative to green; 1 = as in the scene.
    pub fn white_balance(&self) -> [f64; 2] {
        [self.gain[0] / self.gain[1], self.gain[2] / self.gain[1]]
    }

    /// Brightness of the corners relative to the centre.
    pub fn corner(&self) -> f64 {
        (self.falloff[0] + self.falloff[1]).exp()
    }

    /// Non-zero terms at this precision: "+0.31 EV, red +3 %, blue −2 %, corners −17 %"; empty for
    /// [`Light::NONE`].
    pub fn summary(&self) -> String {
        let percent = |v: f64| (100.0 * (v - 1.0)).round();
        let signed = |v: f64| if v < 0.0 { format!("−{}", -v) } else { format!("+{v}") };
        let ev = (100.0 * self.exposure_ev()).round() / 100.0;
        let mut parts = Vec::new();
        if ev != 0.0 {
            parts.push(format!("{} EV", signed(ev)));
        }
        let [red, blue] = self.white_balance().map(percent);
        for (name, value) in [("red", red), ("blue", blue), ("corners", percent(self.corner()))] {
            if value != 0.0 {
                parts.push(format!("{name} {} %", signed(value)));
            }
        }
        parts.join(", ")
    }

    /// ln of the vignetting at r².
    fn ln_vignetting(&self, r2: f64) -> f64 {
        (self.falloff[0] + self.falloff[1] * r2) * r2
    }

    /// The image with the corrections applied. Values may exceed 1 where the correction brightens
    /// the photo, so that nothing is clipped.
    pub fn removed(&self, image: &RgbImage) -> RgbImage {
        self.scaled(image, -1.0)
    }

    /// Inverse of [`Light::removed`]: a corrected image as this photo shows it.
    pub fn applied(&self, image: &RgbImage) -> RgbImage {
        self.scaled(image, 1.0)
    }

    fn scaled(&self, image: &RgbImage, sign: f64) -> RgbImage {
        if self.is_none() {
            return image.clone();
        }
        let size = (image.width, image.height);
        let gains = self.gain.map(|g| g.powf(sign));
        let mut out = image.clone();
        out.data.par_chunks_mut(image.width.max(1)).enumerate().for_each(|(y, line)| {
            for (x, colour) in line.iter_mut().enumerate() {
                let lens = (sign * self.ln_vignetting(radius2(x as f64 + 0.5, y as f64 + 0.5, size))).exp();
                for (v, g) in colour.iter_mut().zip(gains) {
                    *v = to_srgb(to_linear(*v) * (g * lens) as f32);
                }
            }
        });
        out
    }
}

/// Squared distance of a pixel position from the image centre, half diagonals.
pub fn radius2(x: f64, y: f64, (width, height): (usize, usize)) -> f64 {
    let (w, h) = (width as f64, height as f64);
    ((2.0 * x - w).powi(2) + (2.0 * y - h).powi(2)) / (w * w + h * h)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> RgbImage {
        let data = (0..40 * 30).map(|k| [(k % 40) as f32 / 39.0, (k / 40) as f32 / 29.0, 0.3]).collect();
        RgbImage { width: 40, height: 30, data }
    }

    #[test]
    fn light_removal_inverts_application() {
        let light = Light { gain: [1.4, 0.7, 1.1], falloff: [-0.3, -0.1], ..Light::NONE };
        let (image, lit) = (picture(), light.applied(&picture()));
        let back = light.removed(&lit);
        for (a, b) in back.data.iter().flatten().zip(image.data.iter().flatten()) {
            // A few f32 roundings of two powers.
            assert!((a - b).abs() < 1e-5, "{a} {b}");
        }
        // In linear light, the centre changes by the gain and the outermost pixel nearly by gain
        // and corner.
        let ratio = |x: usize, y: usize, c: usize| to_linear(lit.at(x, y)[c]) / to_linear(image.at(x, y)[c]);
        assert!((ratio(20, 15, 2) - 1.1).abs() < 2e-3 && (ratio(20, 15, 0) - 1.4).abs() < 2e-3);
        let r2 = radius2(39.5, 29.5, (40, 30));
        let expected = 1.1 * (-0.3 * r2 - 0.1 * r2 * r2).exp();
        assert!((ratio(39, 29, 2) as f64 - expected).abs() < 1e-4);
        assert!((light.exposure_ev() - (1.4f64 * 0.7 * 1.1).log2() / 3.0).abs() < 1e-12);
        assert!((light.corner() - (-0.4f64).exp()).abs() < 1e-12);
    }

    #[test]
    fn light_summary_lists_nonzero_terms() {
        let light = Light { gain: [1.1, 1.0, 0.95], falloff: [-0.2, 0.0], ..Light::NONE };
        assert_eq!(light.summary(), "+0.02 EV, red +10 %, blue −5 %, corners −18 %");
        assert_eq!(Light::NONE.summary(), "");
    }

    #[test]
    fn light_none_changes_nothing() {
        assert_eq!(Light::NONE.removed(&picture()), picture());
        assert!(Light::default().is_none());
    }

    #[test]
    fn colours_above_one_are_kept() {
        let light = Light { gain: [0.5; 3], ..Light::NONE };
        let white = RgbImage { width: 1, height: 1, data: vec![[1.0; 3]] };
        assert!((to_linear(light.removed(&white).data[0][0]) - 2.0).abs() < 1e-5);
    }
}
