//! The photos that a scene directory keeps: their working images, and what was read of their files and taken out of them.
use crate::photo::{self, Photo};
use crate::scene::RgbImage;
use crate::{Error, Result, files};
use std::path::{Path, PathBuf};

/// Everything of the photos but their pixels, which are in `images/` beside it.
const PHOTOS: &str = "photos.json";

/// Writes `photos.json` into the folder of cameras.
pub(super) fn write(cameras: &Path, photos: &[Photo]) -> Result<()> {
    let bare = |p: &Photo| {
        let image = RgbImage { width: p.image.width, height: p.image.height, data: Vec::new() };
        // Its folder is nobody's business who gets the scene.
        let path = p.path.file_name().map_or_else(|| p.path.clone(), PathBuf::from);
        Photo { image, path, fine: None, ..p.clone() }
    };
    let all: Vec<Photo> = photos.iter().map(bare).collect();
    super::write_json(&cameras.join(PHOTOS), &all)
}

/// The photos of a scene directory as they were trained on: without lens and in one light, in the order of its cameras.
pub fn load(scene: &Path) -> Result<Vec<Photo>> {
    let folder = scene.join("cameras");
    let file = folder.join(PHOTOS);
    if !file.is_file() {
        return Err(Error::input(format!(
            "{}: missing; the scene does not say how its photos were made: make it again with splatvk run",
            file.display()
        )));
    }
    let mut photos: Vec<Photo> = files::read_json(&file, "the scene is damaged, run again")?;
    for photo in &mut photos {
        let path = folder.join("images").join(format!("{}.png", photo.stem));
        // Before it is decoded: the header may state any size.
        let (width, height) = photo::dimensions(&path)?;
        if (width as usize, height as usize) != (photo.image.width, photo.image.height) {
            return Err(Error::input(format!(
                "{}: {width} × {height} pixels, the scene's camera has {} × {}; the scene is damaged, run again",
                path.display(),
                photo.image.width,
                photo.image.height
            )));
        }
        // Larger than any image: it is to be read as it is.
        photo.image = photo::load_at(&path, usize::MAX >> 16)?.image;
    }
    Ok(photos)
}
