//! Files of a scene directory that splatvk wrote: only these may be replaced.
use super::{cameras, scene_dir};
use crate::files;
use crate::photo::stem;
use crate::scene::LEVEL_NAMES;
use std::path::Path;

/// Entries of a scene directory that splatvk did not write, relative to it; `None` where the folder
/// is no scene directory by its manifest.
pub fn foreign(folder: &Path) -> Option<Vec<String>> {
    let names = Names::of(folder)?;
    Some(files::foreign(folder, &|name, is_folder| names.has(name, is_folder)))
}

/// Whether splatvk wrote `file` into the scene directory `folder`.
pub fn is_own(folder: &Path, file: &Path) -> bool {
    let name = file.strip_prefix(folder).ok().map(|name| name.to_string_lossy().replace('\\', "/"));
    Names::of(folder).zip(name).is_some_and(|(names, name)| names.has(&name, false))
}

/// Data from which the names of files follow.
struct Names {
    /// Stems of the photos.
    stems: Vec<String>,
}

impl Names {
    fn of(folder: &Path) -> Option<Names> {
        if !scene_dir::is_scene(folder) {
            return None;
        }
        // A scene without cameras, or with damaged ones, has no images of its own.
        let cameras = cameras::read(&folder.join("cameras/transforms.json")).unwrap_or_default();
        let plain = |name: &str| name.rsplit('/').next().unwrap_or_default().to_owned();
        Some(Names { stems: cameras.iter().map(|c| stem(&plain(&c.name)).to_owned()).collect() })
    }

    fn has(&self, name: &str, is_folder: bool) -> bool {
        const FOLDERS: [&str; 8] = [
            "cameras",
            "cameras/colmap",
            "cameras/images",
            "cameras/masks",
            "cameras/original",
            "cameras/original/colmap",
            "language",
            "previews",
        ];
        // Edits and named views are the user's: they keep a scene from being replaced.
        const FILES: [&str; 12] = [
            scene_dir::MANIFEST,
            scene_dir::SPLATS,
            scene_dir::SEEN,
            scene_dir::BACKDROP,
            scene_dir::HOLES,
            "run.json",
            "report.html",
            "cameras/transforms.json",
            "cameras/photos.json",
            "cameras/original/transforms.json",
            "language/features.npz",
            scene_dir::TEXT_EMBEDDINGS,
        ];
        if is_folder {
            return FOLDERS.contains(&name);
        }
        FILES.contains(&name)
            || match name.rsplit_once('/') {
                Some(("cameras/colmap" | "cameras/original/colmap", file)) => {
                    ["cameras.txt", "images.txt", "points3D.txt"].contains(&file)
                }
                Some(("language", file)) => LEVEL_NAMES
                    .iter()
                    .any(|l| file == format!("codebook_{l}.npz") || file == format!("splats_{l}.ply")),
                Some(("cameras/images" | "cameras/masks", file)) => {
                    self.stems.iter().any(|s| file == format!("{s}.png"))
                }
                Some(("previews", file)) => self.stems.iter().any(|s| is_preview(file, s)),
                _ => false,
            }
    }
}

/// Whether a file of `previews/` is named like a preview of the view `stem`.
fn is_preview(file: &str, stem: &str) -> bool {
    let Some(name) = file.strip_suffix(".jpg") else { return false };
    let of_view = name.strip_prefix(stem).is_some_and(|what| {
        what == "_render" || what == "_depth" || LEVEL_NAMES.iter().any(|l| what == format!("_level_{l}"))
    });
    of_view || name.starts_with("query_") && name.ends_with(&format!("_{stem}"))
}
