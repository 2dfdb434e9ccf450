//! File formats and the scene directory.
pub mod cameras;
pub mod colmap;
pub mod npy;
pub mod picture;
pub mod ply;
pub mod scene_dir;
pub mod splat;
pub mod transforms;
mod workspace;

pub use workspace::{Workspace, remove_unfinished};

use crate::{Error, Result};
use std::path::Path;

/// Constant of the first spherical harmonic, `1 / (2 √π)`: colour = 0.5 + SH_C0 · f_dc.
pub const SH_C0: f32 = 0.282_094_8;

/// [0, 1] → 0–255, clamped; NaN becomes 0.
pub fn to_byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// Writes pretty JSON.
pub fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    let text =
        serde_json::to_string_pretty(value).map_err(|e| Error::work(format!("{}: {e}", path.display())))?;
    std::fs::write(path, text + "\n").map_err(Error::io(path))
}

/// Creates a folder and its parents.
pub fn create_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(Error::io(path))
}
