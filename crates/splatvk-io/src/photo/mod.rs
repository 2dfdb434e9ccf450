//! Photos: choosing, decoding, EXIF, resizing, affine bookkeeping
//! (docs/internals/method.md#photos).
mod bars;
mod border;
mod candidate;
mod choose;
mod code_points;
mod decode;
mod exif_tags;
mod header;
mod heif;
mod join;
mod jpeg;
mod kind;
pub mod light;
mod mask;
mod masks;
mod metadata;
mod overlay;
mod png;
mod profile;
mod read;
mod sizes;
mod straighten;
mod superpixels;
mod support;
mod tiff;
mod turn;
mod twins;
mod video;
mod video_writer;
mod xmp;

pub use border::PlainBorder;
pub use candidate::{Candidate, gather};
pub use choose::{
    DEFAULT_VIEWS, DEFAULT_VIEWS_WITHOUT_LANGUAGE, FoundFiles, find, find_named, photo_count, spread,
};
pub use decode::stored_pixels;
pub use header::dimensions;
pub use join::{join, plain_name, stems_apart};
pub use kind::{check_name, stem};
pub use light::Light;
pub use masks::{MaskChoice, assign as assign_masks};
pub use overlay::Overlay;
pub use read::{
    MAX_SIZE, MAX_SIZE_CPU, Photo, SMALLEST_SIDE, default_max_size, from_bytes, from_pixels,
    from_used_pixels, load, load_at, of_image, working_size,
};
pub use sizes::sizes_of;
pub use straighten::Straightening;
pub use superpixels::superpixels;
pub use support::Support;
pub use turn::Turn;
pub use video_writer::VideoWriter;

use crate::progress::Progress;
use crate::scene::{Outside, RgbImage};
use crate::{Error, Result};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};

/// Reports the support for HEIC and AVIF photos.
pub fn heif_support() -> Support {
    heif::status()
}

/// Reports the support for videos.
pub fn video_support() -> Support {
    video::status()
}

/// Finds and reads all photos of files and folders at [`MAX_SIZE`]; `pose::choose::photos` of
/// splatvk chooses among too many.
pub fn load_all(inputs: &[PathBuf], progress: &dyn Progress) -> Result<Vec<Photo>> {
    let found = gather(inputs, progress)?;
    photo_count(found.len(), Some(found.len()))?;
    load_each(&found, MAX_SIZE, progress)
}

/// Reads the photos of a run, scaled down to `max_size` where larger; refuses sets that cannot give
/// geometry (the same photo twice) or with ambiguous names (the same name twice).
pub fn load_each(candidates: &[Candidate], max_size: usize, progress: &dyn Progress) -> Result<Vec<Photo>> {
    candidates.iter().try_for_each(|c| check_name(&c.path))?;
    progress.begin("photos", candidates.len() as u64);
    let done = AtomicU64::new(0);
    let load_one = |candidate: &Candidate| {
        progress.check()?;
        let photo = candidate.load(max_size, progress)?;
        progress.step(done.fetch_add(1, Ordering::Relaxed) + 1, "");
        Ok(photo)
    };
    // Collected before errors are checked: the first error in the order of the photos is reported,
    // whichever came first.
    let mut all: Vec<Result<Photo>> = Vec::with_capacity(candidates.len());
    for wave in sizes::waves(candidates) {
        all.par_extend(candidates[wave].par_iter().map(load_one));
    }
    let mut photos = all.into_iter().collect::<Result<Vec<_>>>()?;
    for bars in bars::find(&photos) {
        // Reloaded so that the picture gets as many pixels as the whole file would have had.
        let photo = &photos[bars.photo];
        let (w, h) = (photo.image.width, photo.image.height);
        let gain = w.max(h) as f64 / bars.picture_long_side(photo);
        if (w as u32, h as u32) != photo.original_size {
            photos[bars.photo] = candidates[bars.photo].load((max_size as f64 * gain) as usize, progress)?;
        }
    }
    progress.end();
    cut_bars(&mut photos, progress);
    settle(&mut photos, &[], progress);
    check_set(&photos)?;
    Ok(photos)
}

/// Warns of files and decides the meaning of transparency, once all photos of a set are read;
/// `known` are the photos of a scene that they join.
pub fn settle(photos: &mut [Photo], known: &[Photo], progress: &dyn Progress) {
    warn_of_files(photos, progress);
    settle_transparency(photos, known, progress);
}

/// Decides the meaning of transparent pixels of a set: empty space if every photo has some and none
/// has a mask, as in photos with removed background; otherwise they are unused.
fn settle_transparency(photos: &mut [Photo], known: &[Photo], progress: &dyn Progress) {
    let named = |wanted: &dyn Fn(&Photo) -> bool, photos: &[Photo]| {
        photos.iter().filter(|p| wanted(p)).map(|p| p.stem.as_str()).collect::<Vec<_>>().join(", ")
    };
    let transparent = named(&|p| p.coverage.is_some() && !p.masked, photos);
    if transparent.is_empty() {
        return;
    }
    let empty = photos.iter().all(|p| p.coverage.is_some() && !p.masked)
        && known.iter().all(|p| p.coverage.as_ref().is_some_and(|c| c.outside == Outside::Empty));
    if !empty {
        progress.warn(&format!(
            "transparent parts are not used, since other photos have none or have masks: {transparent}"
        ));
        return;
    }
    progress.warn(
        "all photos have a transparent background: it is taken for emptiness, and the scene has nothing there; for a background that \
         is there but not to be used, give masks (--photo-masks) and opaque photos",
    );
    photos.iter_mut().flat_map(|p| &mut p.coverage).for_each(|c| c.outside = Outside::Empty);
}

/// Warns of parts of the files that are not used or look unusual.
fn warn_of_files(photos: &[Photo], progress: &dyn Progress) {
    for photo in photos {
        photo.notes.iter().for_each(|note| progress.warn(&format!("{}: {note}", photo.stem)));
    }
    let framed: Vec<&str> = photos.iter().filter(|p| !p.border.is_none()).map(|p| p.stem.as_str()).collect();
    if !framed.is_empty() {
        progress.warn(&format!("plain frame around the picture left out: {}", framed.join(", ")));
    }
    for photo in photos.iter().filter(|p| p.lost_pixels > 0) {
        progress.warn(&format!(
            "{}: {} of its pixels are not finite numbers and are read as black",
            photo.stem, photo.lost_pixels
        ));
    }
    let bright: Vec<&str> =
        photos.iter().filter(|p| mostly_above_white(&p.image)).map(|p| p.stem.as_str()).collect();
    if !bright.is_empty() {
        progress.warn(&format!(
            "most of the picture is brighter than white (1.0): {}; if these are not overexposed, scale the values in the \
             files so that white paper is near 1",
            bright.join(", ")
        ));
    }
}

/// Cuts off the bars beside the pictures (letterboxes, frames and captions) with a warning.
pub fn cut_bars(photos: &mut [Photo], progress: &dyn Progress) {
    let found = bars::find(photos);
    if let Some(text) = bars::message(photos, &found) {
        progress.warn(&text);
    }
    found.iter().for_each(|bars| photos[bars.photo].cut(bars.depth));
}

/// Whether a file of high dynamic range uses another unit: matching and training expect diffuse
/// surfaces below 1.
fn mostly_above_white(image: &RgbImage) -> bool {
    let above = image.data.iter().filter(|c| c.iter().any(|v| *v > 1.0)).count();
    2 * above > image.data.len()
}

/// Largest relative difference of EXIF focal lengths of one zoom setting.
const SAME_ZOOM: f64 = 0.03;

/// Largest relative difference of the sides of equal pictures between bars.
const SAME_PICTURE: f64 = 0.02;

/// Camera index of every photo by the data in the files: photos of equal size, camera model and
/// zoom share one; photos without EXIF share by size. Portrait and landscape photos of one camera
/// share, too.
pub fn cameras_by_file(photos: &[Photo]) -> Vec<usize> {
    let mut firsts: Vec<&Photo> = Vec::new();
    let mut number = |photo| {
        firsts.iter().position(|f| share_camera(f, photo)).unwrap_or_else(|| {
            firsts.push(photo);
            firsts.len() - 1
        })
    };
    photos.iter().map(&mut number).collect()
}

/// Whether two photos are of one camera and zoom by the data in their files.
fn share_camera(a: &Photo, b: &Photo) -> bool {
    let size = |p: &Photo| {
        let (w, h) = p.original_size;
        (w.max(h), w.min(h))
    };
    let one_zoom = match (a.original_focal(), b.original_focal()) {
        (Some(f), Some(g)) => (f / g - 1.0).abs() <= SAME_ZOOM,
        (f, g) => f.is_none() && g.is_none(),
    };
    size(a) == size(b) && have_equal_pictures(a, b) && a.camera_model == b.camera_model && one_zoom
}

/// Whether the pictures between bars have equal sizes, in either orientation. The edge of a bar is
/// accurate to a pixel or two of the working image; uncut photos of one size have equal pictures.
fn have_equal_pictures(a: &Photo, b: &Photo) -> bool {
    let sides = a.picture_size().into_iter().zip(b.picture_size());
    let turned = a.picture_size().into_iter().rev().zip(b.picture_size());
    let near = |(a, b): (f64, f64)| (a / b - 1.0).abs() < SAME_PICTURE;
    sides.into_iter().all(near) || turned.into_iter().all(near)
}

/// Refuses sets that cannot give geometry (one photo, or the same photo twice) or with ambiguous
/// names (the same name twice). Included in [`load_all`]; for photos from memory.
pub fn check_set(photos: &[Photo]) -> Result<()> {
    match photos {
        [] => return Err(Error::input("no photos; at least 2 are needed, 3 or 4 work best")),
        [one] => {
            return Err(Error::input(format!(
                "{}: only one photo; at least 2 are needed, 3 or 4 work best",
                one.path.display()
            )));
        }
        _ => {}
    }
    // The stem of a photo may be prefixed by its folders.
    photos.iter().try_for_each(|p| check_name(&p.path).and_then(|()| check_name(p.stem.as_ref())))?;
    let digests: Vec<_> =
        photos.iter().map(|p| Sha256::digest(bytemuck::cast_slice(&p.image.data))).collect();
    for j in 1..photos.len() {
        for i in 0..j {
            let (a, b) = (photos[i].path.display(), photos[j].path.display());
            if digests[i] == digests[j] && photos[i].image.width == photos[j].image.width {
                // A photo that is added to a scene which already contains it has the same path.
                let named = match photos[i].path == photos[j].path {
                    true => format!("{a}: this photo is there already"),
                    false => format!("{a} and {b}: the same photo twice"),
                };
                return Err(Error::input(format!("{named}; each photo must be taken from another place")));
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
    fn check_set_names_repeated_photo() {
        let photo = |path: &str| {
            let image = RgbImage { width: 64, height: 64, data: vec![[0.3; 3]; 64 * 64] };
            from_pixels(path.as_ref(), &image, None, MAX_SIZE).unwrap()
        };
        let refusal = |a: &str, b: &str| check_set(&[photo(a), photo(b)]).unwrap_err().to_string();
        assert!(refusal("a.png", "b.png").starts_with("a.png and b.png: the same photo twice"));
        assert!(refusal("a.png", "a.png").starts_with("a.png: this photo is there already"));
    }

    #[test]
    fn photos_share_camera_by_zoom() {
        let image = RgbImage { width: 64, height: 64, data: vec![[0.3; 3]; 64 * 64] };
        let photo = |focal| from_pixels("a.png".as_ref(), &image, focal, MAX_SIZE).unwrap();
        // Rounding of the tags is 2 %.
        let photos = [Some(60.0), Some(61.0), Some(90.0), None, None].map(photo);
        assert_eq!(cameras_by_file(&photos), [0, 0, 1, 2, 2]);
    }

    #[test]
    fn pictures_above_white_are_detected() {
        let image = |v: f32| RgbImage { width: 2, height: 2, data: vec![[v; 3], [v; 3], [v; 3], [0.1; 3]] };
        assert!(mostly_above_white(&image(3.0)) && !mostly_above_white(&image(1.0)));
    }

    #[test]
    fn working_size_caps_longer_side() {
        assert_eq!(working_size(640, 480, 800), (640, 480));
        assert_eq!(working_size(800, 800, 800), (800, 800));
        assert_eq!(working_size(4032, 3024, 800), (800, 600));
        assert_eq!(working_size(3024, 4032, 800), (600, 800));
        assert_eq!(working_size(4032, 3024, MAX_SIZE), (1600, 1200));
        assert_eq!(working_size(4032, 3024, usize::MAX / 8192), (4032, 3024));
        // A panorama keeps a usable height.
        assert_eq!(working_size(8000, 1200, 800), (800, 120));
        assert_eq!(working_size(12000, 400, 800), (1920, 64));
    }
}
