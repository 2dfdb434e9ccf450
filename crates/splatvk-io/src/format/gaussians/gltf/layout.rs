//! Constants and axes of glTF files.
use crate::scene::Similarity;
use glam::{DMat3, DVec3};

pub(super) const EXTENSION: &str = "KHR_gaussian_splatting";
/// "glTF", the start of a binary file.
pub(super) const MAGIC: u32 = 0x4654_6c67;
/// "JSON" and "BIN", the types of its chunks.
pub(super) const JSON_CHUNK: u32 = 0x4e4f_534a;
pub(super) const BIN_CHUNK: u32 = 0x004e_4942;
/// Component type of f32.
pub(super) const FLOAT: u32 = 5126;

pub(super) fn attribute(name: &str) -> String {
    format!("{EXTENSION}:{name}")
}

/// Rotation from scene axes (right, down, forward) to those of glTF; it is its own inverse.
pub(super) fn turned() -> Similarity {
    let rotation = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    Similarity { scale: 1.0, rotation, translation: DVec3::ZERO }
}
