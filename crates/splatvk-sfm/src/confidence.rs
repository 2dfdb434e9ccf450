//! How far the place of a photo's camera is to be trusted (docs/internals/method.md#confidence).
use super::Fitted;
use serde::Serialize;

/// Share of a photo's matches with the others that agree with the cameras, below which its place is
/// in doubt: 0.93 and more where all are right on the tuning sets, 0.28 to 0.8 where one is wrong.
pub(super) const DOUBTFUL: f64 = 0.85;
/// Below this share it is not sure.
const AGREED: f64 = 0.9;
/// σ of a rotation above which the place of a camera is not sure, degrees: a few pixels of a photo.
const UNSURE_ROTATION: f64 = 0.5;
/// σ above which it is in doubt, degrees: what is hidden behind near things comes out elsewhere.
pub(super) const DOUBTFUL_ROTATION: f64 = 2.0;
/// σ of ln f above which depth is not sure.
pub(super) const UNSURE_FOCAL: f64 = 0.05;

/// Trust in the place of a camera. What each level was worth on generated photos is in
/// docs/use/photos.md.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Confidence {
    /// May be wrong by degrees.
    Low,
    /// Right, but not to a fraction of a degree, or the focal length is open.
    Medium,
    /// Right.
    High,
}

impl Confidence {
    /// Its word.
    pub fn name(self) -> &'static str {
        match self {
            Confidence::Low => "low",
            Confidence::Medium => "medium",
            Confidence::High => "high",
        }
    }
}

impl Fitted {
    /// What the stated deviations and the agreement of the matches come to.
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
    fn the_worst_of_what_is_known_decides() {
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
