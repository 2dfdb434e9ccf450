//! Photos to cameras, depth and points.
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
mod leave_out;
pub mod light;
pub mod matching;
mod minimal;
pub(crate) mod numeric;
mod overlap;
pub mod pointmap;
pub mod relative;
mod resect;
mod segments;
pub mod sfm;
mod sharpness;
mod sift;
pub mod stereo;
mod still;
#[cfg(test)]
mod testing;
mod two_view;
pub mod upright;
mod vanishing;

pub use added::{KnownPhotos, add};
pub use confidence::Confidence;
pub use geometry::{Fitted, Geometry, SparseModel, SparsePoint};
pub use given::assign;
pub use initialise::{SolvedCameras, dense, learned_features, place};
pub use matching::Keypoints;
