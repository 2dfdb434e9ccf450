//! Something that stands still in the frame of every photo and hides the scene.
use crate::scene::{Coverage, Image};

/// Pixels of a photo that something hides, and the coverage of the photo before they were found.
#[derive(Clone, Debug)]
pub struct Overlay {
    /// [H, W] working pixels; true where the scene is hidden.
    pub hidden: Image<bool>,
    pub(super) before: Option<Coverage>,
}
