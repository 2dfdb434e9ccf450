//! splatvk turns a few ordinary photos, without camera poses, into a Gaussian-splat scene that
//! answers text queries, on any Vulkan device.
//!
//! This crate holds the kernels ([`pass`], `glsl/`), training ([`fit`]), the pipeline of a run
//! ([`run`]), the report, the command line and the C interface. The crates below it can be used
//! alone and appear here under their own names: [`scene`], [`math`] and [`Error`] of
//! `splatvk-types`, [`format`] and [`photo`] of `splatvk-io`, [`gpu`] on `splatvk-gpu`, [`pose`]
//! (`splatvk-sfm`), [`infer`] (`splatvk-infer`), [`language`] and [`query`] (`splatvk-language`).
//!
//! # From a program
//! Everything the command line does is here: [`run::run`] writes a scene directory,
//! [`run::reconstruct`] keeps the scene in memory, [`run::live::LiveScene`] draws, answers and
//! saves it, [`progress::Progress`] reports and stops, [`gpu::Device::adopt`] works on the
//! program's own Vulkan device, [`format`] holds the files. The C interface ([`capi`],
//! `include/splatvk.h`) is a thin layer over the same.
//!
//! ```
//! # fn main() -> splatvk::Result<()> {
//! use splatvk::gpu;
//! use splatvk::pass::Renderer;
//! use splatvk::scene::{Camera, Pose, Splats};
//!
//! // One red Gaussian of half a unit, four units in front of a camera.
//! let splats = Splats {
//!     means: vec![[0.0, 0.0, 4.0]],
//!     log_scales: vec![[0.5f32.ln(); 3]],
//!     quats: vec![[1.0, 0.0, 0.0, 0.0]],
//!     opacity_logits: vec![4.0],
//!     sh_degree: 0,
//!     sh: vec![1.7, -1.7, -1.7],
//!     antialiased: false,
//! };
//! let camera = Camera {
//!     name: "front".into(),
//!     width: 64,
//!     height: 48,
//!     fx: 60.0,
//!     fy: 60.0,
//!     cx: 32.0,
//!     cy: 24.0,
//!     pose: Pose::IDENTITY,
//! };
//! let frame = Renderer::new(&gpu::open(None)?, &splats, &[], 0)?.render(&camera)?;
//! let [r, g, b] = frame.rgb.at(32, 24);
//! assert!(r > 0.9 && g < 0.1 && b < 0.1);
//! assert!((frame.depth.at(32, 24) - 4.0).abs() < 1e-3);
//!
//! // To a file that web viewers open, and back.
//! let folder = std::env::temp_dir().join(format!("splatvk-doc-{}", std::process::id()));
//! std::fs::create_dir_all(&folder).map_err(splatvk::Error::io(&folder))?;
//! let file = folder.join("red.spz");
//! splatvk::format::gaussians::write(&file, &splats, None)?;
//! let (back, language) = splatvk::format::gaussians::read(&file)?;
//! assert!(back.len() == 1 && (back.means[0][2] - 4.0).abs() < 1e-5 && language.is_none());
//! # std::fs::remove_dir_all(&folder).map_err(splatvk::Error::io(&folder))
//! # }
//! ```
#![warn(missing_docs)]
// [N, 3] in the docs states a shape; rustdoc takes it for a link.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod bench;
#[cfg(feature = "capi")]
pub mod capi;
pub mod check;
pub mod eval;
#[cfg(feature = "cli")]
pub mod fetch;
pub mod fit;
pub mod gpu;
pub mod pass;
pub mod pipeline;
pub mod report;
pub mod run;

#[cfg(feature = "cli")]
#[doc(hidden)]
pub mod cli;

pub use splatvk_infer as infer;
pub use splatvk_io::{format, photo};
pub use splatvk_language as language;
pub use splatvk_language::query;
pub use splatvk_sfm as pose;
pub use splatvk_types::{Error, Result, checkpoint, error, math, preset, progress, scene};
pub(crate) use splatvk_types::{files, sync};
