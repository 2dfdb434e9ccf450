//! Learning-rate schedules and the order of the views.
use crate::math::Random;
use serde::{Deserialize, Serialize};

/// Log-linear interpolation from `start` to `end` over `steps`, constant afterwards
/// (docs/internals/method.md#schedules).
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
    /// A constant rate.
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

/// Endless view indices, drawn without replacement within each round.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ViewOrder {
    random: Random,
    views: usize,
    left: Vec<usize>,
}

impl ViewOrder {
    /// Order over `0..views` for a seed.
    pub fn new(views: usize, seed: u64) -> Self {
        ViewOrder { random: Random::new(seed), views, left: Vec::new() }
    }

    /// Draws the next view.
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
    fn exponential_matches_published_rates() {
        let rate = Exponential { start: 1.6e-4, end: 1.6e-6, steps: 30000 };
        assert!((rate.at(0) - 1.6e-4).abs() < 1e-12 && (rate.at(30000) - 1.6e-6).abs() < 1e-14);
        assert!((rate.at(15000) - 1.6e-5).abs() < 1e-12);
        // The preset `paper` hardly lowers the rate within its 1000 steps
        // (docs/internals/method.md#schedules).
        assert!((rate.at(1000) / 1.6e-4 - 0.8577).abs() < 1e-4, "factor .86 within 1000");
        assert_eq!(Exponential::constant(0.0).at(3), 0.0);
    }

    #[test]
    fn view_order_draws_each_view_once() {
        let mut order = ViewOrder::new(4, 7);
        for _ in 0..10 {
            let mut round: Vec<usize> = (0..4).map(|_| order.draw()).collect();
            round.sort_unstable();
            assert_eq!(round, [0, 1, 2, 3]);
        }
    }
}
