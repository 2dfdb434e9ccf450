//! Masks, region features, alignment, codebook.
//!
//! [`dir`] or [`graph`] give masks, a [`crate::infer::RegionEncoder`] or `dir` their features, [`matcher`] the dense
//! matches between views; [`build()`] aligns everything and turns it into codebooks and training targets.

pub mod align;
mod build;
pub mod codebook;
pub mod dir;
pub mod graph;
mod join;
mod masks;
pub mod matcher;
pub mod sam;

pub use build::{BuildOptions, Language, Reducer, build};
pub use join::{SceneView, join};
pub use masks::{LevelMasks, ViewMasks};
