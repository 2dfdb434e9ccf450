//! Loading of scenes for commands.
use super::args::EditUse;
use super::progress;
use crate::Result;
use crate::format::scene_dir::{self, Scene};
pub use crate::run::stored::{photos, title};
use std::path::Path;

/// Loads a scene directory or a file of Gaussians, and prints its warnings and the number of its
/// edits.
pub fn load(path: &Path, edits: EditUse) -> Result<Scene> {
    let scene = match edits.ignore_edits {
        true => scene_dir::load_unedited(path)?,
        false => scene_dir::load(path)?,
    };
    remark(path, &scene);
    Ok(scene)
}

/// Prints the warnings of a scene and the number of its edits.
pub fn remark(path: &Path, scene: &Scene) {
    if let Some(edits) = &scene.edits {
        let noun = if edits.count == 1 { "edit" } else { "edits" };
        progress::reporter().inform(&format!(
            "{}: with {} {noun} (--ignore-edits leaves them out)",
            path.display(),
            edits.count
        ));
    }
    scene.warnings.iter().for_each(|note| progress::print_warning(note));
}
