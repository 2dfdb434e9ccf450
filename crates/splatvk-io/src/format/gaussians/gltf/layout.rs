//! Constants and axes of glTF files.
use crate::scene::Similarity;
use glam::{DMat3, DVec3};

pub(super) const EXTENSION: &str = "KHR_gaussian_splatting";

pub(super) fn attribute(name: &str) -> String {
    format!("{EXTENSION}:{name}")
}

/// Rotation from scene axes (right, down, forward) to those of glTF; it is its own inverse.
pub(super) fn turned() -> Similarity {
    let rotation = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    Similarity { scale: 1.0, rotation, translation: DVec3::ZERO }
}
