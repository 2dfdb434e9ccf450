//! Loading of scenes for commands.
use super::args::EditUse;
use super::progress;
use crate::format::scene_dir::{self, Scene};
use crate::format::scene_photos;
use crate::scene::{Camera, RgbImage};
use crate::{Result, photo};
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

/// Photos of a scene's cameras. They are optional: a scene without its images, or with images
/// elsewhere, has none here.
pub fn photos(scene: &Scene) -> Vec<RgbImage> {
    let load = |c: &Camera| photo::load_at(&scene_photos::picture(&scene.path, c)?, usize::MAX).ok();
    let photos: Option<Vec<_>> = scene.cameras.iter().map(load).collect();
    photos.unwrap_or_default().into_iter().map(|p| p.image).collect()
}

/// Title of a scene's page: the name of its folder or file.
pub fn title(path: &Path) -> String {
    let path = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Name of a scene: that of its folder or file.
pub fn scene_name(path: &Path) -> String {
    let whole = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    let name = whole.file_stem().map(|n| n.to_string_lossy().into_owned());
    name.unwrap_or_else(|| "scene".to_owned())
}
