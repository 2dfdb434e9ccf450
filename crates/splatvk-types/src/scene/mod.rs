//! Plain data: cameras, splats, images, depth maps, language fields. No GPU, no I/O.
//!
//! Conventions used everywhere: camera frame OpenCV (+x right, +y down, +z forward), pixel (column
//! c, row r) covers `[c, c+1) × [r, r+1)` with its centre at `(c+0.5, r+0.5)`, quaternions `(w, x,
//! y, z)`, depth = camera z, images row-major RGB in [0, 1] (sRGB values as they are).
mod affine;
mod camera;
mod camera_path;
pub mod code_mix;
mod coverage;
mod given;
mod image;
mod language;
mod lens;
mod mesh;
mod pointmap;
mod points;
mod prior;
pub mod resize;
pub mod seeded;
mod seen;
pub mod sh;
mod similarity;
mod sky;
mod splats;
mod transfer;
mod warp;
mod world;

pub use affine::Affine;
pub use camera::{Camera, MAX_PIXELS, MAX_SIDE, Pose};
pub use camera_path::CameraOrbit;
pub use code_mix::CodeMix;
pub use coverage::{Coverage, Outside};
pub use given::GivenCamera;
pub use image::{DepthMap, Image, RgbImage};
pub use language::{Codebook, LEVEL_NAMES, LanguageField, LevelField, MaskId};
pub use lens::Lens;
pub use mesh::{Hull, Mesh, MeshPart};
pub use pointmap::{Descriptors, ModelView, PairPointmaps, Pointmap, Pointmaps};
pub use points::PointCloud;
pub use prior::{DepthPrior, PriorKind};
pub use seen::Seen;
pub use similarity::Similarity;
pub use sky::Sky;
pub use splats::{SH_C0, Splats, sh_coefficients};
pub use transfer::{to_linear, to_srgb};
pub use warp::DenseWarp;
pub use world::{Scale, Up, UpAxis, UpEvidence, World};
