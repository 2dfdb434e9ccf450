//! Lengths in the scene against the true ones: accuracy of measurements once one length is known.
use crate::math::{Random, quantile};
use glam::DVec3;
use serde::Serialize;

/// Relative errors of lengths when any other length gave the scene its scale.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct LengthScore {
    /// Number of compared lengths.
    pub lengths: usize,
    /// Median of |l / l_true − 1|.
    pub median: f64,
    /// 90th percentile of |l / l_true − 1|.
    pub p90: f64,
}

/// Drawn pairs of lengths: their quantiles are accurate to a few hundredths of their value.
const DRAWN: usize = 20_000;

/// Scores the distances of all pairs of `places`, (scene, truth), whose true distance is at least
/// `least`; the true places of a pair differ. `None` with fewer than two lengths.
pub(super) fn length_score(places: &[(DVec3, DVec3)], least: f64) -> Option<LengthScore> {
    let pairs = (0..places.len()).flat_map(|j| (0..j).map(move |i| (i, j)));
    let ratio = |(i, j): (usize, usize)| {
        let truth = places[i].1.distance(places[j].1);
        let scene = places[i].0.distance(places[j].0);
        (truth >= least && truth > 0.0 && scene > 0.0).then(|| (scene / truth).ln())
    };
    let ratios: Vec<f64> = pairs.filter_map(ratio).collect();
    if ratios.len() < 2 {
        return None;
    }
    let mut random = Random::new(0);
    let mut errors: Vec<f64> = (0..DRAWN)
        .map(|_| {
            let [stated, measured] = random.sample::<2>(ratios.len()).map(|k| ratios[k]);
            ((measured - stated).exp() - 1.0).abs()
        })
        .collect();
    Some(LengthScore {
        lengths: ratios.len(),
        median: quantile(&mut errors, 0.5)?,
        p90: quantile(&mut errors, 0.9)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Random places, stretched in the scene: (scene, truth).
    fn places(stretch: DVec3) -> Vec<(DVec3, DVec3)> {
        let mut random = Random::new(1);
        (0..40)
            .map(|_| {
                let p = DVec3::new(random.uniform(), random.uniform(), random.uniform());
                (3.0 * p * stretch, p)
            })
            .collect()
    }

    #[test]
    fn length_score_ignores_scale_not_stretch() {
        let exact = length_score(&places(DVec3::ONE), 0.1).unwrap();
        assert!(exact.p90 < 1e-9 && exact.lengths > 500, "{exact:?}");
        // One axis is 10 % too long: lengths disagree by up to as much.
        let deep = length_score(&places(DVec3::new(1.0, 1.0, 1.1)), 0.1).unwrap();
        assert!(deep.median > 0.01 && deep.median < 0.05 && deep.p90 < 0.1, "{deep:?}");
        assert_eq!(length_score(&places(DVec3::ONE)[..2], 0.0), None);
    }
}
