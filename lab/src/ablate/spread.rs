//! Means over scenes and seeds, and the significance of differences between rows.
use serde::Serialize;
use std::collections::BTreeMap;

/// Mean and standard deviation of a figure over scenes and seeds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Sample standard deviation over scenes and seeds; `None` for a single value.
    pub sd: Option<f64>,
    /// Number of values.
    pub n: usize,
}

impl Spread {
    /// Computes mean and standard deviation of values; `None` without values.
    pub fn of(values: &[f64]) -> Option<Spread> {
        let n = values.len();
        let mean = values.iter().sum::<f64>() / n as f64;
        let square = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
        let sd = (n > 1).then(|| (square / (n - 1) as f64).sqrt());
        (n > 0).then_some(Spread { mean, sd, n })
    }
}

/// Difference of a row from its reference row, on the same scenes and seeds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Mean over scenes of the means over seeds.
    pub mean: f64,
    /// Half of the 95 % confidence interval for scenes of this kind; `None` for a single scene.
    pub half: Option<f64>,
    /// Number of scenes.
    pub scenes: usize,
    /// Sample standard deviation over scenes; `None` for a single scene.
    pub sd: Option<f64>,
}

/// Difference of mIoU that matters: one point.
pub const MARGIN: f64 = 0.01;

/// Decision of a comparison over scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// The interval is above zero, and not within [`MARGIN`].
    Better,
    /// The interval is below zero, and not within [`MARGIN`].
    Worse,
    /// The interval is within ± [`MARGIN`] (two one-sided tests, Schuirmann 1987).
    Equal,
    /// None of these; about so many scenes give an interval of ± [`MARGIN`].
    Open(usize),
}

impl Difference {
    /// Summarises differences given as (scene, value). Seeds of one scene are averaged first,
    /// because they are not independent scenes.
    pub fn of(values: &[(&str, f64)]) -> Option<Difference> {
        let mut scenes: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
        values.iter().for_each(|(scene, v)| scenes.entry(scene).or_default().push(*v));
        let means: Vec<f64> = scenes.values().filter_map(|v| Spread::of(v)).map(|s| s.mean).collect();
        let Spread { mean, sd, n } = Spread::of(&means)?;
        Some(Difference { mean, half: sd.map(|sd| student(n - 1) * sd / (n as f64).sqrt()), scenes: n, sd })
    }

    /// The decision by the 95 % confidence interval; `None` for a single scene.
    pub fn verdict(&self) -> Option<Verdict> {
        let (half, sd) = (self.half?, self.sd?);
        Some(if self.mean.abs() + half <= MARGIN {
            Verdict::Equal
        } else if self.mean > half {
            Verdict::Better
        } else if self.mean < -half {
            Verdict::Worse
        } else {
            // With many scenes Student's t is the normal distribution.
            Verdict::Open((1.96 * sd / MARGIN).powi(2).ceil().max(2.0) as usize)
        })
    }
}

/// 97.5 % quantile of Student's t (Student 1908): a table with three decimals up to ten degrees of
/// freedom, above that Fisher's expansion in their reciprocal.
fn student(freedom: usize) -> f64 {
    const TABLE: [f64; 10] = [12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228];
    let z = 1.959_964f64;
    let terms = [
        (z.powi(3) + z) / 4.0,
        (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / 96.0,
        (3.0 * z.powi(7) + 19.0 * z.powi(5) + 17.0 * z.powi(3) - 15.0 * z) / 384.0,
    ];
    let expansion = |f: f64| terms.iter().rev().fold(0.0, |sum, term| (sum + term) / f) + z;
    TABLE.get(freedom.wrapping_sub(1)).copied().unwrap_or_else(|| expansion(freedom as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spread_uses_sample_deviation() {
        let s = Spread::of(&[1.0, 2.0, 4.0]).unwrap();
        assert!((s.mean - 7.0 / 3.0).abs() < 1e-12 && (s.sd.unwrap() - (7.0f64 / 3.0).sqrt()).abs() < 1e-12);
        assert_eq!(Spread::of(&[5.0]).unwrap(), Spread { mean: 5.0, sd: None, n: 1 });
        assert_eq!(Spread::of(&[]), None);
    }

    #[test]
    fn difference_averages_seeds_of_scene() {
        let scenes = [("a", 0.1), ("b", 0.2), ("c", 0.3)];
        let once = Difference::of(&scenes).unwrap();
        let thrice: Vec<(&str, f64)> = scenes.iter().flat_map(|s| [*s; 3]).collect();
        let again = Difference::of(&thrice).unwrap();
        assert!((once.half.unwrap() - again.half.unwrap()).abs() < 1e-12 && again.scenes == 3);
        // 0.2 ± 4.303 · 0.1 / √3 does not exclude zero.
        assert!((once.half.unwrap() - 0.2484).abs() < 1e-3);
    }

    #[test]
    fn verdict_needs_interval_off_zero_or_within_margin() {
        let verdict = |values: [f64; 3]| {
            let scenes = ["a", "b", "c"].into_iter().zip(values).collect::<Vec<_>>();
            Difference::of(&scenes).unwrap().verdict().unwrap()
        };
        assert_eq!(verdict([0.2, 0.2, 0.21]), Verdict::Better);
        assert_eq!(verdict([-0.2, -0.2, -0.21]), Verdict::Worse);
        assert_eq!(verdict([0.003, 0.003, 0.004]), Verdict::Equal, "off zero, but within a point");
        // sd 0.1: (1.96 · 0.1 / 0.01)² scenes.
        assert_eq!(verdict([0.1, 0.2, 0.3]), Verdict::Open(385));
        assert_eq!(Difference::of(&[("a", 0.9), ("a", 0.9)]).unwrap().verdict(), None, "one scene");
    }

    #[test]
    fn student_matches_known_quantiles() {
        assert!((student(11) - 2.201).abs() < 2e-3 && (student(30) - 2.042).abs() < 1e-3);
        assert!((student(1000) - 1.962).abs() < 1e-3);
    }
}
