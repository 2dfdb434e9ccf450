//! Plain data: cameras, splats, images, depth maps, language fields. No GPU, no I/O.
//!
//! Conventions used everywhere: camera frame OpenCV (+x right, +y down, +z forward), pixel (column c, row r) covers
//! `[c, c+1) × [r, r+1)` with its centre at `(c+0.5, r+0.5)`, quaternions `(w, x, y, z)`, depth = camera z, images
//! row-major RGB in [0, 1] (sRGB values as they are).
mod camera;
mod image;
mod language;
mod lens;
mod points;
mod splats;
mod transfer;

pub use camera::{Camera, Pose};
pub use image::{DepthMap, Plane, RgbImage};
pub use language::{Codebook, LEVEL_NAMES, LanguageField, LevelField};
pub use lens::Lens;
pub use points::PointCloud;
pub use splats::{Splats, sh_coefficients};
pub use transfer::{to_linear, to_srgb};
