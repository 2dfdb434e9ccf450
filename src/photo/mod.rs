//! Photos: decoding, EXIF, resizing, affine bookkeeping.
use crate::scene::RgbImage;
use std::path::PathBuf;

/// Axis-aligned affine map of pixel positions, `u' = s·u + o` per axis (ALGORITHMS 0.4).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Affine {
    /// Scale along x and y.
    pub scale: [f64; 2],
    /// Offset along x and y, pixels of the target.
    pub offset: [f64; 2],
}

/// One decoded photo at working resolution, upright.
#[derive(Clone, Debug)]
pub struct Photo {
    /// Where it was read from.
    pub path: PathBuf,
    /// File name without extension: the key that joins masks, cameras and renders.
    pub stem: String,
    /// Upright pixels at working resolution.
    pub image: RgbImage,
    /// Upright size of the file, pixels.
    pub original_size: (u32, u32),
    /// Original (upright) pixels → working pixels.
    pub to_working: Affine,
    /// Focal length from EXIF in working pixels, if the file tells.
    pub exif_focal: Option<f64>,
    /// Camera make and model from EXIF: photos that share it may share one focal length.
    pub camera_model: Option<String>,
}
