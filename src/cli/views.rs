//! Names of the files that belong to a camera.
use super::progress;
use crate::Result;
use crate::format::cameras;
pub use crate::run::objects::stems;
use crate::scene::Camera;
use std::path::Path;

/// Reads the cameras of a file as views to render, and prints its warnings.
pub fn read(path: &Path) -> Result<Vec<Camera>> {
    let (cameras, warnings) = cameras::read_file(path)?.pinholes();
    warnings.iter().for_each(|w| progress::print_warning(w));
    Ok(cameras)
}
