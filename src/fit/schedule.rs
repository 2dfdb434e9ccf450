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

/// Endless view indices, drawn without replacement within each round; virtual views are drawn in
/// rounds of their own.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ViewOrder {
    random: Random,
    /// Number of views of photos and of virtual views, which follow them.
    counts: [usize; 2],
    /// Views that the present rounds still lack.
    left: [Vec<usize>; 2],
    drawn: usize,
}

/// Every third view is a virtual one, if there are any.
const VIRTUAL_EVERY: usize = 3;

impl ViewOrder {
    /// Order over `views` photos and the virtual views behind them, for a seed.
    pub fn new(views: usize, virtual_views: usize, seed: u64) -> Self {
        ViewOrder {
            random: Random::new(seed),
            counts: [views, virtual_views],
            left: Default::default(),
            drawn: 0,
        }
    }

    /// Draws the next view.
    pub fn draw(&mut self) -> usize {
        self.drawn += 1;
        let kind = usize::from(self.counts[1] > 0 && self.drawn.is_multiple_of(VIRTUAL_EVERY));
        let left = &mut self.left[kind];
        if left.is_empty() {
            let first = kind * self.counts[0];
            *left = (first..first + self.counts[kind]).collect();
            self.random.shuffle(left);
        }
        left.pop().unwrap_or(0)
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
        let mut order = ViewOrder::new(4, 0, 7);
        for _ in 0..10 {
            let mut round: Vec<usize> = (0..4).map(|_| order.draw()).collect();
            round.sort_unstable();
            assert_eq!(round, [0, 1, 2, 3]);
        }
        // Two photos and three virtual views.
        let mut order = ViewOrder::new(2, 3, 7);
        let (mut photos, mut others): (Vec<usize>, Vec<usize>) =
            (0..18).map(|_| order.draw()).partition(|view| *view < 2);
        assert_eq!((photos.len(), others.len()), (12, 6));
        photos.chunks_mut(2).for_each(|round| round.sort_unstable());
        others.chunks_mut(3).for_each(|round| round.sort_unstable());
        assert!(photos.chunks(2).all(|r| r == [0, 1]) && others.chunks(3).all(|r| r == [2, 3, 4]));
    }
}
