//! Language feature of a splat on one level in five bytes: two codes and a mixing share.
use crate::math::dot_f32 as dot;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Steps of [`CodeMix::share`] from 0 to 1. The nearer code comes first, so the share is at most
/// half: a byte.
const SHARE_STEPS: f32 = 510.0;

/// Shortest feature of a splat that has one: lifting leaves exact zeros, training moves them by
/// less than this.
pub const MIN_LENGTH: f32 = 0.1;

/// A unit feature as the nearest mix of its nearest code with another. Blending and decoding read a
/// feature only through its cosines to the codes, and a splat between two things mixes two of them;
/// docs/internals/method.md#feature-storage states the error of this.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CodeMix {
    /// Nearest code; the number of codes where the splat has no feature.
    pub first: u16,
    /// Code that comes nearest to the feature together with the first.
    pub second: u16,
    /// Share of the second code, in units of 1/510.
    pub share: u8,
}

impl CodeMix {
    /// Mix for a feature [d] of any length among codes [K, d].
    fn nearest(feature: &[f32], codes: &[f32]) -> CodeMix {
        let count = codes.len() / feature.len();
        let none = CodeMix { first: count as u16, second: count as u16, share: 0 };
        let length = feature.iter().map(|v| v * v).sum::<f32>().sqrt();
        // False for NaN, too.
        let carried = length >= MIN_LENGTH;
        if !carried {
            return none;
        }
        let d = feature.len();
        let cosine = |k: usize| dot(feature, row(codes, k, d)) / length;
        let Some((a, first)) = (0..count).map(|k| (cosine(k), k)).max_by(|x, y| x.0.total_cmp(&y.0)) else {
            return none;
        };
        // Weights of the combination of the two codes that is nearest to the feature (least squares
        // of unit vectors), and the gain over the first code alone.
        let gain_of = |k: usize| {
            let (b, ab) = (cosine(k), dot(row(codes, first, d), row(codes, k, d)));
            let weight = (b - ab * a).max(0.0);
            (weight * weight / (1.0 - ab * ab).max(f32::EPSILON), k, a - ab * b, weight)
        };
        let best = (0..count).filter(|k| *k != first).map(gain_of).max_by(|x, y| x.0.total_cmp(&y.0));
        let (_, second, first_weight, second_weight) = best.unwrap_or((0.0, first, 1.0, 0.0));
        let share = second_weight / (first_weight + second_weight).max(f32::MIN_POSITIVE);
        let share = (SHARE_STEPS * share).round().clamp(0.0, 255.0) as u8;
        let second = if share == 0 { first } else { second };
        CodeMix { first: first as u16, second: second as u16, share }
    }

    /// Writes the unit feature [d] of the mix; zeros where there is none.
    fn write(self, codes: &[f32], out: &mut [f32]) {
        out.fill(0.0);
        let count = codes.len() / out.len();
        if usize::from(self.first) >= count || usize::from(self.second) >= count {
            return;
        }
        let share = f32::from(self.share) / SHARE_STEPS;
        let (first, second) =
            (row(codes, self.first.into(), out.len()), row(codes, self.second.into(), out.len()));
        for ((value, a), b) in out.iter_mut().zip(first).zip(second) {
            *value = (1.0 - share) * a + share * b;
        }
        let length = dot(out, out).sqrt();
        if length > 0.0 {
            out.iter_mut().for_each(|v| *v /= length);
        }
    }
}

/// Mixes of codes [K, d] nearest to features [N, d]; empty where there are more codes than a mix
/// can index.
pub fn mixes(features: &[f32], codes: &[f32], d: usize) -> Vec<CodeMix> {
    if d == 0 || codes.len() / d >= usize::from(u16::MAX) {
        return Vec::new();
    }
    features.par_chunks_exact(d).map(|f| CodeMix::nearest(f, codes)).collect()
}

/// Unit features [N, d] of mixes of codes [K, d].
pub fn features(mixes: &[CodeMix], codes: &[f32], d: usize) -> Vec<f32> {
    let mut out = vec![0.0; mixes.len() * d];
    if d > 0 {
        out.par_chunks_exact_mut(d).zip(mixes).for_each(|(f, mix)| mix.write(codes, f));
    }
    out
}

fn row(codes: &[f32], k: usize, d: usize) -> &[f32] {
    &codes[k * d..(k + 1) * d]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn code_mix_survives_round_trip() {
        let codes = [1.0, 0.0, 0.0, 0.6, 0.8, 0.0, 0.0, 0.0, 1.0];
        let mut random = Random::new(1000);
        for _ in 0..200 {
            let (t, length) = (0.5 * random.uniform() as f32, 0.2 + random.uniform() as f32);
            let (a, b) = (random.below(3), random.below(3));
            let mixed: Vec<f32> =
                row(&codes, a, 3).iter().zip(row(&codes, b, 3)).map(|(x, y)| (1.0 - t) * x + t * y).collect();
            let norm = dot(&mixed, &mixed).sqrt();
            let feature: Vec<f32> = mixed.iter().map(|v| length * v / norm).collect();
            let mix = mixes(&feature, &codes, 3);
            let back = features(&mix, &codes, 3);
            // Half a step of the share moves a unit vector by at most 1/510 of the codes' distance.
            assert!(dot(&back, &feature) / length > 1.0 - 1e-5, "{a} {b} {t}: {back:?} of {feature:?}");
            // Storing a stored feature changes nothing.
            assert_eq!(features(&mixes(&back, &codes, 3), &codes, 3), back);
        }
        let none = mixes(&[0.05, 0.0, 0.0, f32::NAN, 0.0, 0.0], &codes, 3);
        assert_eq!(features(&none, &codes, 3), [0.0; 6]);
    }

    #[test]
    fn code_mix_of_extremes_is_unit() {
        let stored = |feature: &[f32], codes: &[f32]| features(&mixes(feature, codes, 3), codes, 3);
        assert_eq!(stored(&[0.3, 0.4, 0.0], &[0.0, 1.0, 0.0]), [0.0, 1.0, 0.0]);
        assert_eq!(stored(&[0.5, 0.5, 0.0], &[1.0, 0.0, 0.0, -1.0, 0.0, 0.0]), [1.0, 0.0, 0.0]);
    }
}
