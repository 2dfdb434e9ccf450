//! `.sog` of PlayCanvas ("Spatially Ordered Gaussians"), version 2: lossless images with a byte or
//! two per number, and `meta.json`, in a zip archive; on reading also as files of a folder. About
//! a twelfth of the size of a PLY with SH.
//!
//! Positions have 16 bits on a logarithmic scale, scales and base colours share codebooks of 256
//! numbers, the SH of a Gaussian are one row of a palette. The published text calls y up, but
//! SuperSplat, splat-transform and Spark take its axes for those of PLY files, and so does this.
mod codebook;
mod palette;
mod read;
mod write;

pub use read::read_noted;
pub use write::write_splats;

use serde::{Deserialize, Serialize};

/// Name of the description in an archive or a folder.
pub(super) const META: &str = "meta.json";
/// The version that is read and written.
const VERSION: u32 = 2;
/// Numbers of a codebook.
const CODES: usize = 256;
/// Palette entries in a row of their image.
const ROW: usize = 64;
/// The last byte of a rotation is this plus the index of its largest component of (w, x, y, z).
const FIRST_TAG: u8 = 252;

/// `meta.json`.
#[derive(Debug, Serialize, Deserialize)]
struct Meta {
    version: u32,
    #[serde(default, skip_deserializing)]
    asset: Asset,
    count: usize,
    #[serde(default)]
    antialias: bool,
    means: Means,
    scales: Coded,
    quats: Files<1>,
    sh0: Coded,
    #[serde(rename = "shN", default, skip_serializing_if = "Option::is_none")]
    rest: Option<Rest>,
}

#[derive(Debug, Default, Serialize)]
struct Asset {
    generator: String,
}

/// Positions: bounds of sign(x) ln(|x| + 1), and images of the low and the high bytes.
#[derive(Debug, Serialize, Deserialize)]
struct Means {
    mins: [f64; 3],
    maxs: [f64; 3],
    #[serde(with = "names")]
    files: [String; 2],
}

#[derive(Debug, Serialize, Deserialize)]
struct Files<const N: usize> {
    #[serde(with = "names")]
    files: [String; N],
}

/// An image of indices into a codebook.
#[derive(Debug, Serialize, Deserialize)]
struct Coded {
    codebook: Vec<Option<f32>>,
    #[serde(with = "names")]
    files: [String; 1],
}

/// SH of degree 1 and above: images of the palette, and of a row of it per Gaussian.
#[derive(Debug, Serialize, Deserialize)]
struct Rest {
    count: usize,
    bands: u32,
    codebook: Vec<Option<f32>>,
    #[serde(with = "names")]
    files: [String; 2],
}

/// Serde holds arrays of a generic length only through a list.
mod names {
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer, const N: usize>(names: &[String; N], to: S) -> Result<S::Ok, S::Error> {
        names.as_slice().serialize(to)
    }

    pub fn deserialize<'de, D: Deserializer<'de>, const N: usize>(from: D) -> Result<[String; N], D::Error> {
        let names = Vec::<String>::deserialize(from)?;
        let found = names.len();
        names.try_into().map_err(|_| D::Error::custom(format!("{found} files where {N} are needed")))
    }
}
