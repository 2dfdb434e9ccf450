//! Which of the scene's large planes a colour belongs to.
use crate::scene::RgbImage;

/// Bins per channel; finer ones stay empty for small planes.
const BINS: usize = 12;
/// Pixels added to every bin: a colour of no consistent pixel gives no evidence.
const PRIOR: f32 = 2.0;

/// Colour histogram of the consistent pixels on one surface, normalised against all consistent
/// pixels.
pub struct ColourModel {
    share: Vec<f32>,
}

fn bin(colour: [f32; 3]) -> usize {
    colour.iter().fold(0, |b, &c| b * BINS + ((c * BINS as f32) as usize).min(BINS - 1))
}

impl ColourModel {
    /// From the pixels on the surface and all consistent pixels (which include them).
    pub fn new(guide: &RgbImage, on: &[u32], consistent: &[u32]) -> ColourModel {
        let count = |pixels: &[u32]| {
            let mut bins = vec![0.0f32; BINS * BINS * BINS];
            for &k in pixels {
                bins[bin(guide.data[k as usize])] += 1.0;
            }
            blurred(&bins)
        };
        let (on, all) = (count(on), count(consistent));
        ColourModel { share: on.iter().zip(&all).map(|(o, a)| (o + 0.5 * PRIOR) / (a + PRIOR)).collect() }
    }

    /// Share of the consistent pixels of this colour that lie on the surface, 0 to 1; near 0.5 for
    /// unknown colours.
    pub fn share(&self, colour: [f32; 3]) -> f32 {
        self.share[bin(colour)]
    }
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
