//! Photos: choosing, decoding, EXIF, resizing, affine bookkeeping (ALGORITHMS 0.4, 1.1, 1.2).
mod affine;
mod candidate;
mod choose;
mod decode;
mod exif_tags;
mod frame;
mod heif;
mod kind;
mod resize;
mod video;

pub use affine::Affine;
pub use candidate::{Candidate, gather};
pub use choose::{DEFAULT_VIEWS, Found, MOST_VIEWS, find, spread, wanted};
pub use frame::Frame;
pub use resize::Kernel;

use crate::progress::Progress;
use crate::scene::RgbImage;
use crate::{Error, Result};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// What the machine has for HEIC and AVIF photos, in words, and what to do about what it lacks.
pub fn heif_support() -> (String, Option<String>) {
    heif::status()
}

/// What the machine has for videos, in words, and what to do about what it lacks.
pub fn video_support() -> (String, Option<String>) {
    video::status()
}

/// Greatest height of the working image, pixels (ALGORITHMS 1.2).
pub const WORKING_HEIGHT: usize = 1080;

/// Smallest side of a usable photo, pixels: feature networks work at 1/8 resolution, below 8 × 8 cells nothing is left
/// to match.
pub const SMALLEST_SIDE: usize = 64;

/// One decoded photo at working resolution, upright.
#[derive(Clone, Debug)]
pub struct Photo {
    /// Where it was read from.
    pub path: PathBuf,
    /// File name without extension: the key that joins masks, cameras and renders.
    pub stem: String,
    /// Upright pixels at working resolution; on a plain frame, the nearest pixels of the picture.
    pub image: RgbImage,
    /// The white or black frame that was around the picture, working pixels.
    pub frame: Frame,
    /// Upright size of the file, pixels.
    pub original_size: (u32, u32),
    /// Original (upright) pixels → working pixels.
    pub to_working: Affine,
    /// Focal length from EXIF in working pixels, if the file tells.
    pub exif_focal: Option<f64>,
    /// Camera make and model from EXIF: photos that share it may share one focal length.
    pub camera_model: Option<String>,
}

/// Reads one photo: EXIF orientation applied, alpha composited on black, height at most [`WORKING_HEIGHT`].
pub fn load(path: &Path) -> Result<Photo> {
    from_bytes(path, read(path)?)
}

fn read(path: &Path) -> Result<Vec<u8>> {
    std::fs::read(path).map_err(|e| {
        Error::input(format!("{}: {e}; check the name and that you may read it", path.display()))
    })
}

/// [`load`] of an image file that is in memory already; `name` stands for its path.
pub fn from_bytes(name: &Path, bytes: Vec<u8>) -> Result<Photo> {
    from_decoded(name, &decode::decode(bytes, name)?)
}

fn from_decoded(name: &Path, decoded: &decode::Decoded) -> Result<Photo> {
    let photo = working(name, decoded.size, |x, y| decoded.at(x, y))?;
    // The two scales differ by the rounding of the size only; the height is the exact one.
    let exif_focal = decoded.lens.focal.map(|f| f * photo.to_working.scale[1]);
    Ok(Photo { exif_focal, camera_model: decoded.lens.camera_model.clone(), ..photo })
}

/// A photo from upright sRGB pixels in [0, 1]; `focal` is in their pixels, where it is known.
pub fn from_pixels(name: &Path, image: &RgbImage, focal: Option<f64>) -> Result<Photo> {
    if image.data.len() != image.width * image.height {
        return Err(Error::input(format!(
            "{}: {} pixels do not make {} × {}",
            name.display(),
            image.data.len(),
            image.width,
            image.height
        )));
    }
    let photo = working(name, (image.width, image.height), |x, y| image.at(x, y))?;
    Ok(Photo { exif_focal: focal.map(|f| f * photo.to_working.scale[1]), ..photo })
}

/// Upright pixels at working resolution, nothing known about the lens.
fn working(
    name: &Path,
    (w, h): (usize, usize),
    at: impl Fn(usize, usize) -> [f32; 3] + Sync,
) -> Result<Photo> {
    check_size(name, (w, h))?;
    let (working_w, working_h) = working_size(w, h);
    let mut image = resize::area_average((w, h), (working_w, working_h), at);
    let frame = Frame::of(&image);
    frame.continue_picture(&mut image);
    Ok(Photo {
        path: name.to_path_buf(),
        stem: name.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default(),
        image,
        frame,
        original_size: (w as u32, h as u32),
        to_working: Affine::resize((w as u32, h as u32), (working_w as u32, working_h as u32)),
        exif_focal: None,
        camera_model: None,
    })
}

fn check_size(name: &Path, (w, h): (usize, usize)) -> Result<()> {
    if w.min(h) < SMALLEST_SIDE {
        return Err(Error::input(format!(
            "{}: {w} × {h} pixels are too few; each side needs at least {SMALLEST_SIDE}",
            name.display()
        )));
    }
    Ok(())
}

/// Working (width, height) of an upright size: the height is capped, sizes truncated (ALGORITHMS 1.2).
fn working_size(w: usize, h: usize) -> (usize, usize) {
    if h <= WORKING_HEIGHT {
        return (w, h);
    }
    ((w * WORKING_HEIGHT / h).max(1), WORKING_HEIGHT)
}

/// Finds and reads all photos of files and folders; [`crate::pose::choose::load_photos`] chooses among too many.
pub fn load_all(inputs: &[PathBuf], progress: &dyn Progress) -> Result<Vec<Photo>> {
    let found = gather(inputs, progress)?;
    wanted(found.len(), Some(found.len()))?;
    load_each(&found, progress)
}

/// Reads the photos of a run; refuses sets that cannot give geometry (the same photo twice) or that would mix up files (the
/// same name twice).
pub fn load_each(candidates: &[Candidate], progress: &dyn Progress) -> Result<Vec<Photo>> {
    progress.begin("photos", candidates.len() as u64);
    let done = AtomicU64::new(0);
    let one = |candidate: &Candidate| {
        progress.check()?;
        let photo = candidate.load(progress)?;
        progress.step(done.fetch_add(1, Ordering::Relaxed) + 1, "");
        Ok(photo)
    };
    // Collected before errors are looked at: the first in the order of the photos is reported, whichever came first.
    let all: Vec<Result<Photo>> = candidates.par_iter().map(one).collect();
    let photos = all.into_iter().collect::<Result<Vec<_>>>()?;
    progress.end();
    let framed: Vec<&str> = photos.iter().filter(|p| !p.frame.is_none()).map(|p| p.stem.as_str()).collect();
    if !framed.is_empty() {
        progress.warn(&format!("plain frame around the picture left out: {}", framed.join(", ")));
    }
    check_set(&photos)?;
    Ok(photos)
}

/// Refuses sets that cannot give geometry (one photo, or the same photo twice) or that would mix up files (the same name
/// twice). [`load_all`] has done it; for photos from memory.
pub fn check_set(photos: &[Photo]) -> Result<()> {
    if !(2..=MOST_VIEWS).contains(&photos.len()) {
        return Err(Error::input(format!("{} photos; give 2 to {MOST_VIEWS}", photos.len())));
    }
    let digests: Vec<_> =
        photos.iter().map(|p| Sha256::digest(bytemuck::cast_slice(&p.image.data))).collect();
    for j in 1..photos.len() {
        for i in 0..j {
            let (a, b) = (photos[i].path.display(), photos[j].path.display());
            if digests[i] == digests[j] && photos[i].image.width == photos[j].image.width {
                return Err(Error::input(format!(
                    "{a} and {b}: the same photo twice; each photo must be taken from another place"
                )));
            }
            if photos[i].stem == photos[j].stem {
                return Err(Error::input(format!(
                    "{a} and {b}: two photos with the name \"{}\"; rename one",
                    photos[i].stem
                )));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_height_is_capped_and_sizes_truncated() {
        assert_eq!(working_size(640, 480), (640, 480));
        assert_eq!(working_size(1920, 1080), (1920, 1080));
        assert_eq!(working_size(4032, 3024), (1440, 1080));
        assert_eq!(working_size(3024, 4033), (809, 1080));
    }
}
