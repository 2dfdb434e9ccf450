//! Name, photos and views of a scene by its place.
use crate::format::scene_dir::Scene;
use crate::format::{cameras, scene_photos};
use crate::progress::Progress;
use crate::scene::{Camera, RgbImage};
use crate::{Result, photo};
use std::path::Path;

/// Photos of a scene's cameras. They are optional: a scene without its images, or with images
/// elsewhere, has none here.
pub fn photos(scene: &Scene) -> Vec<RgbImage> {
    let load = |c: &Camera| photo::load_at(&scene_photos::picture(&scene.path, c)?, usize::MAX).ok();
    let photos: Option<Vec<_>> = scene.cameras.iter().map(load).collect();
    photos.unwrap_or_default().into_iter().map(|p| p.image).collect()
}

/// Reads the cameras of a file as views to render.
///
/// # Errors
/// A file that is no file of cameras.
pub fn cameras(path: &Path, progress: &dyn Progress) -> Result<Vec<Camera>> {
    let (cameras, warnings) = cameras::read_file(path)?.pinholes();
    warnings.iter().for_each(|w| progress.warn(w));
    Ok(cameras)
}

/// Title of a scene's page: the name of its folder or file.
pub fn title(path: &Path) -> String {
    let path = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    path.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Name of a scene: that of its folder or file.
pub fn name(path: &Path) -> String {
    Some(title(path)).filter(|name| !name.is_empty()).unwrap_or_else(|| "scene".to_owned())
}
