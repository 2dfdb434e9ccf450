//! Photos of a scene directory: their working images, the metadata of their files, and the
//! corrections applied to them.
use crate::photo::{self, Photo};
use crate::scene::{Camera, Coverage, Image, Outside, RgbImage};
use crate::{Error, Result, files};
use std::path::{Path, PathBuf};

/// All data of the photos except their pixels, which are in `images/` beside it.
const PHOTOS: &str = "photos.json";

/// Writes `photos.json` into the folder of cameras.
pub(super) fn write(cameras: &Path, photos: &[Photo]) -> Result<()> {
    let all: Vec<Photo> = photos.iter().map(without_pixels).collect();
    super::write_json(&cameras.join(PHOTOS), &all)
}

fn without_pixels(p: &Photo) -> Photo {
    let image = RgbImage { width: p.image.width, height: p.image.height, data: Vec::new() };
    // The user's folders are not disclosed with the scene.
    let path = p.path.file_name().map_or_else(|| p.path.clone(), PathBuf::from);
    let none = Image { width: p.image.width, height: p.image.height, data: Vec::new() };
    let coverage = p.coverage.as_ref().map(|c| Coverage { share: none, ..c.clone() });
    Photo { image, path, coverage, fine: None, ..p.clone() }
}

/// Image file of a camera of a scene directory; `None` where its name leads out of the scene.
pub fn picture(scene: &Path, camera: &Camera) -> Option<PathBuf> {
    files::within(&scene.join("cameras"), &camera.name)
}

/// Photos of a scene directory as used in training: undistorted, with photometric corrections, in
/// the order of its cameras.
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
        let path = own_file(&folder, "images", photo)?;
        check_size(&path, photo)?;
        // Larger than any image: no scaling.
        let read = photo::load_at(&path, usize::MAX >> 16)?;
        photo.image = read.image;
        photo.coverage = match photo.coverage.as_ref().map(|c| c.outside) {
            Some(outside @ Outside::Empty) => read.coverage.map(|c| Coverage { outside, ..c }),
            Some(outside @ Outside::Unknown) => Some(Coverage { share: mask(&folder, photo)?, outside }),
            None => None,
        };
    }
    Ok(photos)
}

/// PNG file of a photo in a folder of the scene's cameras.
fn own_file(cameras: &Path, folder: &str, photo: &Photo) -> Result<PathBuf> {
    files::within(&cameras.join(folder), &format!("{}.png", photo.stem)).ok_or_else(|| {
        Error::input(format!(
            "{}: {:?} names a file outside of the scene; the scene is damaged, run again",
            cameras.join(PHOTOS).display(),
            photo.stem
        ))
    })
}

/// Refuses an image of another size than its photo before it is decoded: its header may state any
/// size.
fn check_size(path: &Path, photo: &Photo) -> Result<()> {
    let (width, height) = photo::dimensions(path)?;
    if (width as usize, height as usize) == (photo.image.width, photo.image.height) {
        return Ok(());
    }
    Err(Error::input(format!(
        "{}: {width} × {height} pixels, the scene's camera has {} × {}; the scene is damaged, run again",
        path.display(),
        photo.image.width,
        photo.image.height
    )))
}

/// Used share of every pixel.
fn mask(cameras: &Path, photo: &Photo) -> Result<Image<f32>> {
    let path = own_file(cameras, "masks", photo)?;
    check_size(&path, photo)?;
    let data =
        photo::stored_pixels(&path)?.to_luma8().as_raw().iter().map(|v| f32::from(*v) / 255.0).collect();
    Ok(Image { width: photo.image.width, height: photo.image.height, data })
}
