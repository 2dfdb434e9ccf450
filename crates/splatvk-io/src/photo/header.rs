//! Sizes of image files, from their headers.
use super::heif;
use super::turn::Turn;
use crate::files::{self, guarded};
use crate::{Error, Result};
use image::metadata::Orientation;
use image::{ImageDecoder, ImageFormat, ImageReader, Limits};
use std::io::{BufReader, Cursor, Read};
use std::path::Path;

/// Stored (width, height) of an image file, from its header; orientation is not applied.
pub fn dimensions(path: &Path) -> Result<(u32, u32)> {
    let read = guarded(|| header(path).map(|decoder| decoder.dimensions()));
    let bad = |what: String| Error::input(format!("{}: cannot be read as an image: {what}", path.display()));
    match read {
        Ok(Ok(size)) => Ok(size),
        Ok(Err(HeaderError::File(e))) => Err(e),
        Ok(Err(HeaderError::Image(e))) => Err(bad(e.to_string())),
        Err(panic) => Err(bad(format!("damaged ({panic})"))),
    }
}

enum HeaderError {
    File(Error),
    Image(image::ImageError),
}

/// Largest memory for the header of a file, bytes: it includes the inflated profile.
const LARGEST_HEADER: u64 = 16 << 20;

/// A decoder that has read the header.
fn header(path: &Path) -> Result<Box<dyn ImageDecoder>, HeaderError> {
    let file = BufReader::new(files::open(path).map_err(HeaderError::File)?.0);
    let mut reader = ImageReader::new(file)
        .with_guessed_format()
        .map_err(|e| HeaderError::Image(image::ImageError::IoError(e)))?;
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(LARGEST_HEADER);
    reader.limits(limits);
    if reader.format() == Some(ImageFormat::Hdr) {
        // Its decoder stores every line of a header without a bound.
        let start = Cursor::new(first_bytes(path).map_err(HeaderError::File)?);
        let decoder = ImageReader::with_format(start, ImageFormat::Hdr).into_decoder();
        return decoder.map(|d| Box::new(d) as _).map_err(HeaderError::Image);
    }
    reader.into_decoder().map(|d| Box::new(d) as _).map_err(HeaderError::Image)
}

/// First bytes of a file, up to the longest header of a Radiance file.
fn first_bytes(path: &Path) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let most = super::decode::LONGEST_RADIANCE as u64;
    files::open(path)?.0.take(most).read_to_end(&mut bytes).map_err(Error::io(path))?;
    Ok(bytes)
}

/// Number of pixels of an image file of any kind, from its header; 0 where it cannot be read.
pub(super) fn pixels(path: &Path) -> u64 {
    match upright_size(path) {
        Some((w, h)) => (w * h) as u64,
        None => files::read(path).map_or(0, |bytes| guarded(|| heif::pixels(&bytes)).unwrap_or(0)),
    }
}

/// Upright (width, height) of an image file that the `image` crate supports.
pub(super) fn upright_size(path: &Path) -> Option<(usize, usize)> {
    let read = || {
        let mut decoder = header(path).ok()?;
        let (w, h) = decoder.dimensions();
        let turn = Turn::from(decoder.orientation().unwrap_or(Orientation::NoTransforms));
        // The swap of width and height is its own inverse.
        let (w, h) = turn.stored((w, h));
        Some((w as usize, h as usize))
    };
    guarded(read).ok()?
}
