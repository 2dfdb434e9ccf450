//! Masks of the photos.
use crate::scene::Plane;
use serde::{Deserialize, Serialize};

/// The label map of one level of one view.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct LevelMasks {
    /// [H, W] mask index, −1 = hole.
    pub labels: Plane<i32>,
    /// [M] quality weight of each mask (predicted IoU · stability; 1 when unknown).
    pub quality: Vec<f32>,
    /// [M, D] unit feature per mask, row-major; empty until region features ran.
    pub features: Vec<f32>,
    /// Label maps with every mask as it was found, in one of them, so that masks which overlap are in different ones; empty
    /// where `labels` has them whole, and once features are there.
    pub whole: Vec<Plane<i32>>,
}

/// The masks of one view, index as in [`crate::scene::LEVEL_NAMES`].
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct ViewMasks {
    /// Three levels.
    pub levels: Vec<LevelMasks>,
}
