//! File formats and the scene directory.
pub mod npy;
