//! ONNX inference: sessions, model registry, one file per model family.
#[cfg(test)]
pub(crate) mod breakfast;
mod classify;
mod colour;
pub mod hed;
mod registry;
mod runtime;
pub mod text;
pub mod words;
pub mod xfeat;

pub use registry::{ModelStatus, Registry, Role, home};
pub use runtime::{Input, Session, Tensor, runtime, runtime_build};

use crate::Result;
use crate::scene::{Plane, RgbImage};

/// Puts image regions and texts into one space of unit vectors, so that a cosine says how well a phrase names a
/// region. Implemented by `words` (the built-in default) and by user-supplied CLIP-like pairs of towers.
pub trait RegionEncoder: Send {
    /// Name of the space; features and texts may be compared only when this agrees.
    fn space(&self) -> &str;
    /// D, the length of every embedding.
    fn dim(&self) -> usize;
    /// [count, D] row-major unit vectors, one per region `0..count` of `labels` (the same size as `image`; −1 and
    /// values ≥ `count` belong to no region). A region without a pixel gets a zero row.
    fn embed_regions(&mut self, image: &RgbImage, labels: &Plane<i32>, count: usize) -> Result<Vec<f32>>;
    /// [texts.len(), D] row-major unit vectors.
    fn embed_texts(&mut self, texts: &[&str]) -> Result<Vec<f32>>;
}
