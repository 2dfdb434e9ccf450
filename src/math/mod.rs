//! Arithmetic that several folders share; depends on nothing else here.
mod random;
mod statistics;

pub use random::Random;
pub use statistics::{median, quantile};

/// `a·b`, summed in f64.
pub fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum()
}
