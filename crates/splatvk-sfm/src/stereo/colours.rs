//! Colour model of a large plane.
use crate::scene::RgbImage;

/// Bins per channel; smaller bins stay empty for small planes.
const BINS: usize = 12;
/// Pixels added to every bin, so that an unobserved colour gives no evidence.
const PRIOR: f32 = 2.0;

/// Colours of the consistent pixels on one surface as a share of those of all consistent pixels.
pub struct ColourModel {
    share: Vec<f32>,
}

fn bin(colour: [f32; 3]) -> usize {
    colour.iter().fold(0, |b, &c| b * BINS + ((c * BINS as f32) as usize).min(BINS - 1))
}

impl ColourModel {
    /// Model from the pixels `on` the surface and all `consistent` pixels (which include them).
    pub fn new(guide: &RgbImage, on: &[u32], consistent: &[u32]) -> ColourModel {
        let (on, all) = (histogram(guide, on), histogram(guide, consistent));
        ColourModel { share: on.iter().zip(&all).map(|(o, a)| (o + 0.5 * PRIOR) / (a + PRIOR)).collect() }
    }

    /// Share of the consistent pixels of this colour on the surface; near 0.5 for unknown colours.
    pub fn share(&self, colour: [f32; 3]) -> f32 {
        self.share[bin(colour)]
    }
}

/// Blurred colour histogram of some pixels.
fn histogram(guide: &RgbImage, pixels: &[u32]) -> Vec<f32> {
    let mut bins = vec![0.0f32; BINS * BINS * BINS];
    for &k in pixels {
        bins[bin(guide.data[k as usize])] += 1.0;
    }
    blurred(&bins)
}

/// Mean over the 3 × 3 × 3 bins around each: soft bin edges.
fn blurred(bins: &[f32]) -> Vec<f32> {
    let mut out = bins.to_vec();
    for stride in [1, BINS, BINS * BINS] {
        let before = out.clone();
        for k in 0..out.len() {
            let position = k / stride % BINS;
            let low = if position > 0 { before[k - stride] } else { before[k] };
            let high = if position + 1 < BINS { before[k + stride] } else { before[k] };
            out[k] = (low + before[k] + high) / 3.0;
        }
    }
    out
}
