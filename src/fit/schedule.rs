//! Learning-rate schedules and the order in which views are seen.
use serde::{Deserialize, Serialize};

/// Log-linear interpolation from `start` to `end` over `steps`, constant afterwards (docs/method.md#schedules).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exponential {
    /// Rate at step 0.
    pub start: f64,
    /// Rate at `steps` and later.
    pub end: f64,
    /// Length in steps.
    pub steps: usize,
}

impl Exponential {
    /// A rate that does not change.
    pub fn constant(rate: f64) -> Self {
        Exponential { start: rate, end: rate, steps: 1 }
    }
    /// Rate at a 0-based step.
    pub fn at(&self, step: usize) -> f64 {
        if self.start <= 0.0 {
            return 0.0;
        }
        let x = (step as f64 / self.steps.max(1) as f64).min(1.0);
        ((1.0 - x) * self.start.ln() + x * self.end.max(f64::MIN_POSITIVE).ln()).exp()
    }
}

/// SplitMix64 (Steele et al. 2014): tiny, seedable, the same on every platform.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Random(u64);

impl Random {
    /// A generator for a seed.
    pub fn new(seed: u64) -> Self {
        Random(seed)
    }
    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }
    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }
    /// Uniform in 0..n (n > 0).
    pub fn below(&mut self, n: usize) -> usize {
        ((self.uniform() * n as f64) as usize).min(n.saturating_sub(1))
    }
    /// Standard normal (Box–Muller).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
    /// Fisher–Yates.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.below(i + 1));
        }
    }
}

/// Endless view indices, drawn without replacement within each round.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ViewOrder {
    random: Random,
    views: usize,
    left: Vec<usize>,
}

impl ViewOrder {
    /// An order over `0..views` for a seed.
    pub fn new(views: usize, seed: u64) -> Self {
        ViewOrder { random: Random::new(seed), views, left: Vec::new() }
    }
    /// The next view.
    pub fn draw(&mut self) -> usize {
        if self.left.is_empty() {
            self.left = (0..self.views).collect();
            self.random.shuffle(&mut self.left);
        }
        self.left.pop().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_meets_its_ends_and_the_published_midpoint() {
        let rate = Exponential { start: 1.6e-4, end: 1.6e-6, steps: 30000 };
        assert!((rate.at(0) - 1.6e-4).abs() < 1e-12 && (rate.at(30000) - 1.6e-6).abs() < 1e-14);
        assert!((rate.at(15000) - 1.6e-5).abs() < 1e-12);
        // docs/method.md#schedules: the preset `paper` hardly lowers the rate within its 1000 steps.
        assert!((rate.at(1000) / 1.6e-4 - 0.8577).abs() < 1e-4, "factor .86 within 1000");
        assert_eq!(Exponential::constant(0.0).at(3), 0.0);
    }

    #[test]
    fn every_round_sees_every_view_once() {
        let mut order = ViewOrder::new(4, 7);
        for _ in 0..10 {
            let mut round: Vec<usize> = (0..4).map(|_| order.draw()).collect();
            round.sort_unstable();
            assert_eq!(round, [0, 1, 2, 3]);
        }
    }

    #[test]
    fn normal_numbers_have_unit_variance() {
        let mut random = Random::new(1);
        let samples: Vec<f64> = (0..20000).map(|_| random.normal()).collect();
        let mean = samples.iter().sum::<f64>() / 20000.0;
        let variance = samples.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 20000.0;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.04, "4 standard errors at 20000 samples");
    }
}
