//! Choice of the SH degree of a scene by cross-validation.
use serde::{Deserialize, Serialize};

/// Least mean gain of left-out photos that supports a degree, dB: a degree multiplies the colours
/// of a file by 4 to 16, and a smaller gain is invisible.
const LEAST_GAIN: f64 = 0.1;

/// Result of the cross-validation of one degree.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DegreeTrial {
    /// SH degree.
    pub degree: u32,
    /// Mean gain in PSNR of left-out photos, dB.
    pub gain: f64,
    /// Standard error of that mean, dB.
    pub error: f64,
}

impl DegreeTrial {
    /// Trial from the PSNR of every photo with and without the degree, dB; two photos at least.
    pub(super) fn of(degree: u32, with: &[f64], without: &[f64]) -> Self {
        let n = with.len() as f64;
        let gains: Vec<f64> = with.iter().zip(without).map(|(a, b)| a - b).collect();
        let gain = gains.iter().sum::<f64>() / n;
        let variance = gains.iter().map(|g| (g - gain).powi(2)).sum::<f64>() / (n - 1.0);
        DegreeTrial { degree, gain, error: (variance / n).sqrt() }
    }

    /// Whether the gain is large enough and significant, at two standard errors.
    pub fn supported(&self) -> bool {
        self.gain > LEAST_GAIN && self.gain > 2.0 * self.error
    }
}

/// SH degree of a scene, with the trials that it was chosen by.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewDependence {
    /// SH degree of the scene.
    pub degree: u32,
    /// Degrees tried, the highest first; none where the degree was given, the photos are too few,
    /// or they show the same points equally bright.
    pub trials: Vec<DegreeTrial>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn degree_needs_large_and_significant_gain() {
        let trial = |gains: &[f64]| DegreeTrial::of(2, gains, &vec![0.0; gains.len()]);
        assert!(trial(&[0.5, 0.7, 0.6, 0.4]).supported());
        assert!(!trial(&[0.04, 0.05, 0.06, 0.05]).supported(), "nobody sees it");
        assert!(!trial(&[2.0, -1.0, 0.2, -0.4]).supported(), "one photo alone");
        let t = trial(&[1.0, 3.0]);
        assert!((t.gain - 2.0).abs() < 1e-12 && (t.error - 1.0).abs() < 1e-12);
    }
}
