//! File formats and the scene directory.
mod archive;
mod camera_file;
pub mod cameras;
pub mod colmap;
mod common;
pub mod edits;
pub mod gaussians;
mod glb;
mod lens_models;
mod level_arrays;
pub mod mesh;
pub mod npy;
pub mod picture;
pub mod scene_dir;
pub mod scene_files;
pub mod scene_photos;
pub mod side_file;
pub mod transform;
pub mod transforms;
pub mod views;
mod workspace;

pub use camera_file::CameraFile;
pub use common::logit;
pub use common::{create_folder, to_byte, write_json, write_whole_file};
pub use gaussians::{gltf, ply, ply_packed, sog, splat, spz};
pub use workspace::{Replaced, Workspace};
