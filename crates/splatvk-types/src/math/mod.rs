//! Arithmetic that several folders share; depends on no other module of the crate.
mod nearest;
mod random;
mod sphere;
mod statistics;

pub use nearest::Nearest;
pub use random::{Random, hash};
pub use sphere::sphere_directions;
pub use statistics::{median, quantile};

/// `a·b` in f32, for comparing many features.
pub fn dot_f32(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// Length of an unnormalised quaternion, above 0.
pub fn quaternion_norm(q: &[f32; 4]) -> f32 {
    q.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE)
}

/// Logistic function: opacity of an opacity logit.
pub fn sigmoid(v: f32) -> f32 {
    1.0 / (1.0 + (-v).exp())
}

/// `a·b`, summed in f64.
pub fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum()
}
