//! Scenes that commands are given.
use super::progress;
use crate::Result;
use crate::format::scene_dir::{self, Scene};
use std::path::Path;

/// Loads a scene directory or a file of Gaussians, and says what was left out of it.
pub(super) fn load(path: &Path) -> Result<Scene> {
    let scene = scene_dir::load(path)?;
    scene.warnings.iter().for_each(|note| progress::print_warning(note));
    Ok(scene)
}
