//! Names of the files that belong to a camera.
use super::progress;
use crate::Result;
pub use crate::run::objects::stems;
use crate::run::stored;
use crate::scene::Camera;
use std::path::Path;

/// Reads the cameras of a file as views to render, and prints its warnings.
pub fn read(path: &Path) -> Result<Vec<Camera>> {
    stored::cameras(path, progress::reporter().as_ref())
}
