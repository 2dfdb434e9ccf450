//! Overlays: things that stand still in the frame of every photo and hide the scene.
use crate::scene::{Coverage, Image};

/// Hidden pixels of a photo, and the coverage of the photo before they were found.
#[derive(Clone, Debug)]
pub struct Overlay {
    /// [H, W] working pixels; true where the scene is hidden.
    pub hidden: Image<bool>,
    pub(super) before: Option<Coverage>,
}
