//! Confidence in an estimated camera (docs/internals/method.md#confidence).
use super::Fitted;
use serde::{Deserialize, Serialize};

/// Share of inlier matches below which confidence is low: 0.93 and more where all cameras are right
/// on the tuning sets, 0.28 to 0.8 where one is wrong.
pub(super) const DOUBTFUL: f64 = 0.85;
/// Share of inlier matches below which confidence is at most medium.
const AGREED: f64 = 0.9;
/// σ of a rotation above which confidence is at most medium, degrees: a few pixels of a photo.
const UNSURE_ROTATION: f64 = 0.5;
/// σ of a rotation above which confidence is low, degrees: surfaces behind near objects then appear
/// in other places.
pub(super) const DOUBTFUL_ROTATION: f64 = 2.0;
/// σ of ln f above which confidence is at most medium: depth is uncertain.
pub(super) const UNSURE_FOCAL: f64 = 0.05;

/// Confidence in pose and focal length of a camera. Its accuracy on generated photos is in
/// docs/internals/accuracy.md.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Confidence {
    /// May be wrong by degrees.
    Low,
    /// Correct, but not to a fraction of a degree, or with an uncertain focal length.
    Medium,
    /// Correct.
    High,
}

impl Confidence {
    /// Lower-case name.
    pub fn name(self) -> &'static str {
        match self {
            Confidence::Low => "low",
            Confidence::Medium => "medium",
            Confidence::High => "high",
        }
    }
}

impl Fitted {
    /// Confidence from the standard deviations and the share of inlier matches.
    pub fn confidence(&self) -> Confidence {
        let rotation = self.rotation_sigma.to_degrees();
        if self.agreement < DOUBTFUL || self.unconfirmed || rotation > DOUBTFUL_ROTATION {
            Confidence::Low
        } else if self.agreement < AGREED || rotation > UNSURE_ROTATION || self.sigmas[0] > UNSURE_FOCAL {
            Confidence::Medium
        } else {
            Confidence::High
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn confidence_follows_the_worst_measure() {
        let good = Fitted { agreement: 0.97, rotation_sigma: 0.002, ..Fitted::default() };
        let level = |f: Fitted| f.confidence();
        assert_eq!(level(good), Confidence::High);
        assert_eq!(level(Fitted { sigmas: [0.06, 0.0, 0.0, 0.0, 0.0], ..good }), Confidence::Medium);
        assert_eq!(level(Fitted { rotation_sigma: 0.01, ..good }), Confidence::Medium);
        assert_eq!(level(Fitted { rotation_sigma: 0.04, ..good }), Confidence::Low);
        assert_eq!(level(Fitted { agreement: 0.87, ..good }), Confidence::Medium);
        assert_eq!(level(Fitted { agreement: 0.8, ..good }), Confidence::Low);
        assert_eq!(level(Fitted { unconfirmed: true, ..good }), Confidence::Low);
        assert!(Confidence::Low < Confidence::Medium && Confidence::Medium < Confidence::High);
    }
}
