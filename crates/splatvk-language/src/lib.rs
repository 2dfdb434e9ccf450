//! Masks, region features, alignment, codebook.
//!
//! [`dir`] or [`graph`] give masks, a [`splatvk_infer::RegionEncoder`] or `dir` their features,
//! [`matcher`] the dense matches between views; [`build()`] aligns everything and turns it into
//! codebooks and training targets.
//!
//! The relevancy of a text to a region, the formula of LERF:
//!
//! ```
//! use splatvk_language::query::relevancy;
//!
//! // A region, a canonical phrase and a text as unit vectors of two dimensions.
//! let (region, canonical) = ([1.0, 0.0], [0.8, 0.6]);
//! let cosine_to_text = 0.9;
//! // exp(10 · 0.9) / (exp(10 · 0.9) + exp(10 · 0.8)), with the least such value over the phrases.
//! let value = relevancy(&region, cosine_to_text, &canonical);
//! assert!((value - 0.731).abs() < 1e-3);
//! ```

// [N, 3] in the docs states a shape; rustdoc takes it for a link.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod align;
mod build;
pub mod codebook;
pub mod dir;
pub mod graph;
mod join;
mod masks;
pub mod matcher;
pub mod query;
pub mod sam;
pub mod surfaces;

pub use build::{BuildOptions, Language, Pooling, Reducer, build};
pub use join::{SceneView, join};
pub use masks::{LevelMasks, ViewMasks};
pub(crate) use splatvk_io::{format, photo};
pub(crate) use splatvk_types::{Error, Result, math, progress, scene};
