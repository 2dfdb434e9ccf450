//! glTF 2.0 with the ratified extension `KHR_gaussian_splatting`: points whose attributes are Gaussians.
//!
//! | attribute | type | value |
//! |---|---|---|
//! | `POSITION` | VEC3 | mean |
//! | `KHR_gaussian_splatting:ROTATION` | VEC4 | unit quaternion, x y z w |
//! | `KHR_gaussian_splatting:SCALE` | VEC3 | standard deviations (not their logarithms) |
//! | `KHR_gaussian_splatting:OPACITY` | SCALAR | 0 to 1 |
//! | `KHR_gaussian_splatting:SH_DEGREE_l_COEF_n` | VEC3 | coefficient n = 0 … 2l of degree l, RGB, basis and signs of 3DGS |
//! | `COLOR_0` | VEC4 | for programs without the extension: linear base colour, opacity |
//!
//! glTF's axes are right, up, back; files are turned by 180° about x on the way in and out.
mod read;
mod write;

pub use read::read_splats;
pub use write::{write_glb, write_gltf};

use crate::scene::Similarity;
use glam::{DMat3, DVec3};

const EXTENSION: &str = "KHR_gaussian_splatting";
/// "glTF", the start of a binary file.
const MAGIC: u32 = 0x4654_6c67;
/// "JSON" and "BIN", the kinds of its chunks.
const JSON_CHUNK: u32 = 0x4e4f_534a;
const BIN_CHUNK: u32 = 0x004e_4942;
/// Component types: f32, and bytes and shorts with and without a sign.
const FLOAT: u32 = 5126;

fn attribute(name: &str) -> String {
    format!("{EXTENSION}:{name}")
}

/// Scene axes (right, down, forward) to glTF's, and back: the same turn.
fn turned() -> Similarity {
    let rotation = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    Similarity { scale: 1.0, rotation, translation: DVec3::ZERO }
}
