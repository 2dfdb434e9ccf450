//! Files of Gaussian splatting, without a GPU and without networks.
//!
//! - [`format`]: splats in PLY, compressed PLY, SPZ, `.splat` and glTF; cameras of COLMAP,
//!   nerfstudio and `transforms.json`; the scene folder of splatvk.
//! - [`photo`]: photos of many formats decoded to linear or sRGB colour, with EXIF, masks and
//!   colour profiles.
//!
//! ```
//! # fn main() -> splatvk_types::Result<()> {
//! use splatvk_io::format::gaussians;
//! use splatvk_types::scene::seeded;
//!
//! let (splats, _) = seeded::small(100, 64, 48, 1, 3);
//! let folder = std::env::temp_dir().join(format!("splatvk-io-doc-{}", std::process::id()));
//! std::fs::create_dir_all(&folder).map_err(splatvk_types::Error::io(&folder))?;
//! // Converts from one format to another.
//! gaussians::write(&folder.join("scene.ply"), &splats, None)?;
//! let (splats, language) = gaussians::read(&folder.join("scene.ply"))?;
//! gaussians::write(&folder.join("scene.spz"), &splats, language.as_ref())?;
//! # std::fs::remove_dir_all(&folder).map_err(splatvk_types::Error::io(&folder))
//! # }
//! ```
// Docs state shapes as [N, 3], which rustdoc reads as links.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod format;
pub mod photo;

pub(crate) use splatvk_types::{Error, Result, error, files, math, progress, scene};
