//! glTF 2.0 with the ratified extension `KHR_gaussian_splatting`: points whose attributes are
//! Gaussians.
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
mod buffers;
mod extensions;
mod layout;
mod read;
mod write;

pub use read::read_noted;
pub use write::{Node, write_glb, write_gltf, write_nodes};
