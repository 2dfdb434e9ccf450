//! Sizes of image files by their headers.
use super::heif;
use super::turn::Turn;
use crate::{Error, Result, files};
use image::metadata::Orientation;
use image::{ImageDecoder, ImageReader};
use std::io::BufReader;
use std::path::Path;

/// Stored (width, height) of an image file, by its header; orientation is not applied.
pub fn dimensions(path: &Path) -> Result<(u32, u32)> {
    let read = ImageReader::new(BufReader::new(files::open(path)?.0)).with_guessed_format();
    let size = read.map_err(image::ImageError::IoError).and_then(ImageReader::into_dimensions);
    size.map_err(|e| Error::input(format!("{}: cannot be read as an image: {e}", path.display())))
}

/// Pixels of an image file of any kind, by its header; 0 where it cannot be read.
pub(super) fn pixels(path: &Path) -> u64 {
    match upright_size(path) {
        Some((w, h)) => (w * h) as u64,
        None => files::read(path).map_or(0, |bytes| heif::pixels(&bytes)),
    }
}

/// Upright (width, height) of an image file that the `image` crate reads.
pub(super) fn upright_size(path: &Path) -> Option<(usize, usize)> {
    let file = BufReader::new(files::open(path).ok()?.0);
    let mut decoder = ImageReader::new(file).with_guessed_format().ok()?.into_decoder().ok()?;
    let (w, h) = decoder.dimensions();
    let turn = Turn::from(decoder.orientation().unwrap_or(Orientation::NoTransforms));
    // Turning is its own inverse but for the direction.
    let (w, h) = turn.stored((w, h));
    Some((w as usize, h as usize))
}
