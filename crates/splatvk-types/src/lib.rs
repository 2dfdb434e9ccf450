//! Plain data that all parts of splatvk share. No GPU, no networks, no file formats.
//!
//! - [`scene`]: cameras, splats, images, depth maps, point clouds and language fields, with the
//!   conventions of axes and units.
//! - [`math`]: one random generator, statistics, dot products.
//! - [`Error`] and [`Result`]: errors by the reaction that a program may have.
//! - [`progress`] and [`checkpoint`]: progress, cancellation and resumption of long work.
//! - [`files`]: bounded reading, atomic writing; owners of unfinished work.
//!
//! ```
//! use splatvk_types::scene::{Camera, Pose};
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
//! // The centre of the image, four units in front of the camera, which looks along +z.
//! let point = camera.unproject(glam::DVec2::new(32.0, 24.0), 4.0);
//! assert_eq!(point, glam::DVec3::new(0.0, 0.0, 4.0));
//! ```
// Docs state shapes as [N, 3], which rustdoc reads as links.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod checkpoint;
pub mod error;
pub mod files;
pub mod math;
pub mod preset;
pub mod progress;
pub mod scene;
pub mod sync;

pub use error::{Error, Result};
