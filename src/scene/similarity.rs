//! Moving between world frames of different scale.
use glam::{DMat3, DVec3};

/// `x ↦ scale · rotation · x + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Uniform scale.
    pub scale: f64,
    /// Rotation.
    pub rotation: DMat3,
    /// Translation, target units.
    pub translation: DVec3,
}

impl Similarity {
    /// The image of a point.
    pub fn transform(&self, p: DVec3) -> DVec3 {
        self.rotation * p * self.scale + self.translation
    }
}
