//! Numbers and axes of the files.
use crate::scene::Similarity;
use glam::{DMat3, DVec3};

pub(super) const EXTENSION: &str = "KHR_gaussian_splatting";
/// "glTF", the start of a binary file.
pub(super) const MAGIC: u32 = 0x4654_6c67;
/// "JSON" and "BIN", the kinds of its chunks.
pub(super) const JSON_CHUNK: u32 = 0x4e4f_534a;
pub(super) const BIN_CHUNK: u32 = 0x004e_4942;
/// Component types: f32, and bytes and shorts with and without a sign.
pub(super) const FLOAT: u32 = 5126;

pub(super) fn attribute(name: &str) -> String {
    format!("{EXTENSION}:{name}")
}

/// Scene axes (right, down, forward) to glTF's, and back: the same turn.
pub(super) fn turned() -> Similarity {
    let rotation = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    Similarity { scale: 1.0, rotation, translation: DVec3::ZERO }
}
