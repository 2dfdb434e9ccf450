//! Loading of scenes for commands.
use super::progress;
use crate::Result;
use crate::format::scene_dir::{self, Scene};
use std::path::Path;

/// Loads a scene directory or a file of Gaussians, and prints its warnings.
pub fn load(path: &Path) -> Result<Scene> {
    let scene = scene_dir::load(path)?;
    scene.warnings.iter().for_each(|note| progress::print_warning(note));
    Ok(scene)
}
