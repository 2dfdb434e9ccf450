//! Depth priors: estimates of networks, not measurements.
use super::Image;
use serde::{Deserialize, Serialize};

/// Kind of the values of a depth prior; scale and shift may be unknown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum PriorKind {
    /// Camera z.
    Depth,
    /// 1 / z, as networks of relative depth give.
    InverseDepth,
}

/// A depth map of unknown scale and shift, as a network estimates it from one photo. It covers the
/// whole photo, at any resolution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthPrior {
    /// [H, W] values; unknown where not positive or not finite.
    pub values: Image<f32>,
    /// Their kind.
    pub kind: PriorKind,
}
