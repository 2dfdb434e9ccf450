//! splatvk turns a few ordinary photos, without camera poses, into a Gaussian-splat scene that answers text
//! queries, on any Vulkan device. The folders follow the data, left to right:
//! photo → infer → pose → scene → fit → language → query → format / report; each may use what stands left of it
//! and the foundations `gpu`, `pass`, `scene`, `error`.
#![warn(missing_docs)]
// [N, 3] in the docs states a shape; rustdoc takes it for a link.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod ablate;
pub mod bench;
pub mod error;
pub mod fit;
pub mod format;
pub mod gpu;
pub mod infer;
pub mod language;
pub mod pass;
pub mod photo;
pub mod pose;
pub mod progress;
pub mod query;
pub mod report;
pub mod run;
pub mod scene;
pub mod synth;

#[doc(hidden)]
pub mod cli;

pub use error::{Error, Result};
