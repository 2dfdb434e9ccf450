//! Structure from motion and stereo for a few photos: photos to cameras, depth and points.
//!
//! - [`place`] finds the cameras of photos, with the uncertainty of each: matches, two-view
//!   geometry, incremental reconstruction, bundle adjustment, lens and light. Keypoints come from a
//!   closure ([`matching::Detect`]), so that no network is needed here.
//! - [`stereo`] computes depth by slanted-plane multi-view stereo. The matching itself comes
//!   through [`stereo::PlaneSweep`]: splatvk implements it on Vulkan.
//! - [`pointmap`] aligns pointmaps of networks such as MASt3R globally.
//! - [`upright`] finds the direction against gravity.
//!
//! ```no_run
//! use splatvk_io::photo;
//! use splatvk_sfm::{Keypoints, place};
//! use splatvk_types::progress::Silent;
//! use splatvk_types::scene::RgbImage;
//!
//! # fn my_detector(_: &RgbImage) -> splatvk_types::Result<Keypoints> { Ok(Keypoints::default()) }
//! # fn main() -> splatvk_types::Result<()> {
//! let files = ["a.jpg", "b.jpg", "c.jpg"];
//! let photos = files.iter().map(|f| photo::load(f.as_ref())).collect::<Result<Vec<_>, _>>()?;
//! // Any detector: a closure from an image to keypoints with descriptors.
//! let solved = place(photos, None, &mut my_detector, 0, &Silent)?;
//! for (camera, fitted) in solved.model.cameras.iter().zip(&solved.model.fitted) {
//!     println!("{}: f = {:.1} px ± {:.1} %", camera.name, camera.fx, 100.0 * fitted.sigmas[0]);
//! }
//! # Ok(())
//! # }
//! ```

// [N, 3] in the docs states a shape; rustdoc takes it for a link.
#![allow(rustdoc::broken_intra_doc_links)]

mod added;
mod affine;
pub mod align;
mod bundle;
pub mod choose;
mod confidence;
mod geometry;
mod given;
mod homography;
mod initialise;
pub mod leave_out;
pub mod light;
pub mod matching;
mod minimal;
pub mod numeric;
mod overlap;
pub mod pointmap;
pub mod relative;
mod resect;
mod segments;
pub mod sfm;
mod sharpness;
mod sift;
pub mod stereo;
pub mod still;
#[cfg(test)]
mod testing;
mod two_view;
pub mod upright;
mod vanishing;

pub use added::{KnownPhotos, add};
pub use confidence::Confidence;
pub use geometry::{Fitted, Geometry, SparseModel, SparsePoint};
pub use given::assign;
pub use initialise::{MAX_KEYPOINTS, SolvedCameras, dense, learned_features, place};
pub use matching::Keypoints;

pub(crate) use splatvk_io::photo;
pub(crate) use splatvk_types::{Error, Result, files, math, preset, progress, scene};
