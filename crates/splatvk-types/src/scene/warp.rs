//! Dense matches between two views.
use super::Image;

/// A dense match field from view i to view j at the working resolution of view i.
#[derive(Clone, Debug, Default)]
pub struct DenseWarp {
    /// [H, W] pixel position in view j.
    pub target: Image<[f32; 2]>,
    /// [H, W] probability in [0, 1]; 0 where there is no match.
    pub certainty: Image<f32>,
}
