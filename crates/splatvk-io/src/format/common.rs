//! Helpers of several formats.
use crate::files::Partial;
use crate::{Error, Result};
use std::path::Path;

/// Inverse sigmoid of an opacity; 0 and 1 give the most extreme logits at which f32 opacities still
/// differ from 0 and 1.
pub fn logit(a: f32) -> f32 {
    let a = a.clamp(1e-7, 1.0 - 1e-7);
    (a / (1.0 - a)).ln()
}

/// [0, 1] → 0–255, clamped; NaN becomes 0.
pub fn to_byte(v: f32) -> u8 {
    (v.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// Writes pretty JSON.
pub fn write_json(path: &Path, value: &impl serde::Serialize) -> Result<()> {
    let text =
        serde_json::to_string_pretty(value).map_err(|e| Error::work(format!("{}: {e}", path.display())))?;
    std::fs::write(path, text + "\n").map_err(Error::unwritable(path))
}

/// Creates a folder and its parents.
pub fn create_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(Error::unwritable(path))
}

/// Writes a file beside its target and renames it: an existing file stays until the new one is
/// complete. Creates its folder.
pub fn write_whole_file(out: &Path, write: impl FnOnce(&Path) -> Result<()>) -> Result<()> {
    let partial = Partial::beside(out)?;
    write(partial.path())?;
    partial.finish(|path| std::fs::rename(path, out).map_err(Error::unwritable(out)))
}
