//! Decoder from the bytes of an image file to upright pixels.
use super::code_points::{self, CodePoints};
use super::exif_tags::{Lens, lens};
use super::heif;
use super::kind::{FileKind, LARGEST_DECODED, READ, TOO_LARGE, check_pixels, kind};
use super::metadata::{ICC_TOO_LARGE, LARGEST_ICC, LARGEST_XMP, Metadata};
use super::tiff::Directories;
use super::{jpeg, png, profile, tiff, xmp};
use crate::files::{self, guarded};
use crate::scene::to_srgb;
use crate::{Error, Result};
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits};
use moxcms::ColorProfile;
use rayon::prelude::*;
use std::io::Cursor;
use std::path::Path;

#[cfg(test)]
mod tests;

/// A decoded file: stored pixels, read through [`Decoded::at`] as the upright image.
pub(super) struct Decoded {
    pixels: DynamicImage,
    /// Orientation of the stored pixels by EXIF.
    pub orientation: Orientation,
    /// Whether colours are multiplied by alpha already (OpenEXR, TIFF with associated alpha).
    premultiplied: bool,
    /// Upright (width, height).
    pub size: (usize, usize),
    pub lens: Lens,
    /// Notes on parts of the file that are not used, with the reason.
    pub notes: Vec<String>,
}

impl Decoded {
    fn new(pixels: DynamicImage, orientation: Orientation, premultiplied: bool, lens: Lens) -> Decoded {
        let (w, h) = (pixels.width() as usize, pixels.height() as usize);
        let size = if is_sideways(orientation) { (h, w) } else { (w, h) };
        Decoded { pixels, orientation, premultiplied, size, lens, notes: Vec::new() }
    }

    /// Converts the stored numbers to sRGB by the metadata of the file. Code points take precedence
    /// over a profile, a profile over the gamma and chromaticities of PNG.
    fn in_srgb(self, found: Metadata) -> Decoded {
        let Decoded { pixels, mut notes, .. } = self;
        notes.extend(found.notes);
        let pixels = match (found.code_points, found.icc, found.gamma, found.chromaticities) {
            // Floating-point files contain linear light by convention, whatever their metadata
            // state.
            _ if pixels.as_rgb32f().is_some() || pixels.as_rgba32f().is_some() => pixels,
            (Some(code), None, ..) => code_points::to_srgb(pixels, code, &mut notes),
            (Some(code), Some(_), ..) if code_points::is_hdr(code) || found.code_points_first => {
                code_points::to_srgb(pixels, code, &mut notes)
            }
            (_, Some(icc), ..) => match code_points::of_hdr_profile(&icc) {
                Some(code) => code_points::to_srgb(pixels, code, &mut notes),
                None => profile::to_srgb(pixels, &icc, &mut notes),
            },
            _ if found.adobe_rgb => profile::by_profile(pixels, &ColorProfile::new_adobe_rgb()),
            (None, None, gamma, chromaticities) if !found.is_srgb => {
                profile::by_numbers(pixels, gamma, chromaticities)
            }
            _ => pixels,
        };
        Decoded { pixels, notes, ..self }
    }

    /// Whether any pixel is not opaque.
    pub fn is_transparent(&self) -> bool {
        let any = |samples: &[u8], n: usize| samples.par_chunks(n).any(|p| p[n - 1] < u8::MAX);
        let any16 = |samples: &[u16], n: usize| samples.par_chunks(n).any(|p| p[n - 1] < u16::MAX);
        match &self.pixels {
            DynamicImage::ImageLumaA8(i) => any(i.as_raw(), 2),
            DynamicImage::ImageRgba8(i) => any(i.as_raw(), 4),
            DynamicImage::ImageLumaA16(i) => any16(i.as_raw(), 2),
            DynamicImage::ImageRgba16(i) => any16(i.as_raw(), 4),
            DynamicImage::ImageRgba32F(i) => i.as_raw().par_chunks(4).any(|p| p[3].is_nan() || p[3] < 1.0),
            _ => false,
        }
    }

    /// Upright pixel in sRGB and its alpha; the colour is not multiplied by alpha, and black where
    /// alpha is 0. 1 is the white of an 8- or 16-bit file; floating-point files (OpenEXR, Radiance,
    /// float TIFF) and those of high dynamic range exceed it on the same curve.
    pub fn at(&self, x: usize, y: usize) -> ([f32; 3], f32) {
        let (c, alpha) = self.stored(x, y);
        let c = match alpha {
            1.0 => c,
            a if a > 0.0 && self.premultiplied => c.map(|v| v / a),
            a if a > 0.0 => c,
            _ => [0.0; 3],
        };
        (if self.is_linear() { c.map(to_srgb) } else { c }, alpha)
    }

    /// Whether the file contains linear light in floating point, as all float formats do by
    /// convention.
    fn is_linear(&self) -> bool {
        matches!(self.pixels, DynamicImage::ImageRgb32F(_) | DynamicImage::ImageRgba32F(_))
    }

    /// Number of pixels with a value that is not finite; only floating-point files have them.
    pub fn not_finite(&self) -> usize {
        let count = |samples: &[f32], channels: usize| {
            samples.par_chunks(channels).filter(|p| p.iter().any(|v| !v.is_finite())).count()
        };
        match &self.pixels {
            DynamicImage::ImageRgb32F(i) => count(i.as_raw(), 3),
            DynamicImage::ImageRgba32F(i) => count(i.as_raw(), 4),
            _ => 0,
        }
    }

    /// Upright pixel as the file encodes it, and its alpha in [0, 1].
    fn stored(&self, x: usize, y: usize) -> ([f32; 3], f32) {
        let size = (self.pixels.width() as usize, self.pixels.height() as usize);
        let (x, y) = stored_position(self.orientation, size, (x, y));
        let (colour, alpha) = sample(&self.pixels, x as u32, y as u32);
        (colour, if alpha.is_finite() { alpha.clamp(0.0, 1.0) } else { 0.0 })
    }
}

/// Stored position of the upright pixel (x, y) in an image of stored (width, height).
pub(super) fn stored_position(
    orientation: Orientation,
    (w, h): (usize, usize),
    (x, y): (usize, usize),
) -> (usize, usize) {
    match orientation {
        Orientation::NoTransforms => (x, y),
        Orientation::FlipHorizontal => (w - 1 - x, y),
        Orientation::Rotate180 => (w - 1 - x, h - 1 - y),
        Orientation::FlipVertical => (x, h - 1 - y),
        Orientation::Rotate90FlipH => (y, x),
        Orientation::Rotate90 => (y, h - 1 - x),
        Orientation::Rotate270FlipH => (w - 1 - y, h - 1 - x),
        Orientation::Rotate270 => (w - 1 - y, x),
    }
}

/// Whether the orientation swaps width and height.
pub(super) fn is_sideways(orientation: Orientation) -> bool {
    matches!(
        orientation,
        Orientation::Rotate90
            | Orientation::Rotate270
            | Orientation::Rotate90FlipH
            | Orientation::Rotate270FlipH
    )
}

/// Colour and alpha of a stored pixel.
fn sample(image: &DynamicImage, x: u32, y: u32) -> ([f32; 3], f32) {
    // f32 represents every 8- and 16-bit sample; dividing keeps 255 / 255 and 65535 / 65535 at
    // exactly 1.
    let eight = |v: u8| v as f32 / 255.0;
    let sixteen = |v: u16| v as f32 / 65535.0;
    let grey = |[v, a]: [f32; 2]| ([v; 3], a);
    let colour = |[r, g, b, a]: [f32; 4]| ([r, g, b], a);
    match image {
        DynamicImage::ImageLuma8(i) => ([eight(i.get_pixel(x, y).0[0]); 3], 1.0),
        DynamicImage::ImageLumaA8(i) => grey(i.get_pixel(x, y).0.map(eight)),
        DynamicImage::ImageRgb8(i) => (i.get_pixel(x, y).0.map(eight), 1.0),
        DynamicImage::ImageRgba8(i) => colour(i.get_pixel(x, y).0.map(eight)),
        DynamicImage::ImageLuma16(i) => ([sixteen(i.get_pixel(x, y).0[0]); 3], 1.0),
        DynamicImage::ImageLumaA16(i) => grey(i.get_pixel(x, y).0.map(sixteen)),
        DynamicImage::ImageRgb16(i) => (i.get_pixel(x, y).0.map(sixteen), 1.0),
        DynamicImage::ImageRgba16(i) => colour(i.get_pixel(x, y).0.map(sixteen)),
        DynamicImage::ImageRgb32F(i) => (i.get_pixel(x, y).0.map(finite), 1.0),
        DynamicImage::ImageRgba32F(i) => colour(i.get_pixel(x, y).0.map(finite)),
        // The decoders return the types above; the enum is non-exhaustive.
        other => colour(image::GenericImageView::get_pixel(other, x, y).0.map(eight)),
    }
}

/// Replaces NaN, infinities and negative values by 0: renderers and sensors produce them, but light
/// is not negative.
fn finite(v: f32) -> f32 {
    if v.is_finite() { v.max(0.0) } else { 0.0 }
}

/// Decodes the bytes of a file; `path` is only for messages. `code` is set for frames of a video:
/// their PNG file lacks the code points.
pub(super) fn decode(bytes: Vec<u8>, path: &Path, code: Option<CodePoints>) -> Result<Decoded> {
    let named = |what: &str| format!("{}: {what}", path.display());
    if bytes.is_empty() {
        return Err(Error::input(named("the file is empty (0 bytes); copy the photo again")));
    }
    match guarded(|| unguarded(bytes, path, code)) {
        Ok(Ok(decoded)) => Ok(decoded),
        Ok(Err(heif::Failure::Input(what))) => Err(Error::input(named(&what))),
        Ok(Err(heif::Failure::Missing(what))) => Err(Error::missing(named(&what))),
        Err(panic) => Err(Error::input(named(&damaged(&panic)))),
    }
}

fn unguarded(bytes: Vec<u8>, path: &Path, code: Option<CodePoints>) -> Result<Decoded, heif::Failure> {
    let fail = |what: &str| Err(heif::Failure::Input(what.to_owned()));
    let (decoded, found) = match kind(&bytes, path) {
        FileKind::Image(format) => coded(bytes, format).map_err(heif::Failure::Input)?,
        FileKind::Heif => {
            let heif::Image { pixels, metadata } = heif::decode(&bytes)?;
            let size = (pixels.width(), pixels.height());
            let lens = metadata.exif.as_deref().map(|raw| lens(raw, size)).unwrap_or_default();
            (Decoded::new(pixels, Orientation::NoTransforms, false, lens), metadata)
        }
        FileKind::Video => return fail("is a video, not a photo"),
        FileKind::Refused(what) => return fail(what),
        FileKind::Unknown => return fail(&format!("is not an image; photos must be {READ}")),
    };
    if let Some(panorama) = found.xmp.as_deref().and_then(xmp::panorama).or(decoded.lens.panorama.clone()) {
        return fail(&xmp::refusal(&panorama, path));
    }
    let found = match code {
        Some(code) => Metadata { code_points: Some(code), ..Metadata::default() },
        None => found,
    };
    Ok(decoded.in_srgb(found))
}

fn damaged(what: &str) -> String {
    format!("the image is damaged ({what}); copy the photo again or save it anew")
}

/// Stored pixels of an image file of labels, without conversion, in the file's own orientation.
pub fn stored_pixels(path: &Path) -> Result<DynamicImage> {
    let bytes = files::read(path)?;
    let named = |what: &str| Error::input(format!("{}: {what}", path.display()));
    let read = guarded(|| match kind(&bytes, path) {
        FileKind::Image(format) => coded(bytes, format).map(|(d, _)| d.pixels),
        _ => Err("cannot be read as an image; give a PNG".to_owned()),
    });
    read.unwrap_or_else(|panic| Err(damaged(&panic))).map_err(|what| named(&what))
}

/// Decodes a file that the `image` crate supports, with its metadata; the error is one line without
/// the file's name.
fn coded(mut bytes: Vec<u8>, format: ImageFormat) -> Result<(Decoded, Metadata), String> {
    let mut notes = Vec::new();
    match format {
        ImageFormat::Jpeg if !jpeg::has_end(&bytes) => {
            if !jpeg::has_all_pixels(&bytes) {
                return Err("the JPEG is cut off before its end; copy the photo again".to_owned());
            }
            notes.push("the JPEG lacks its end marker, though all pixels are there".to_owned());
        }
        ImageFormat::Hdr => check_radiance(&bytes)?,
        _ => {}
    }
    let mut premultiplied = format == ImageFormat::OpenExr;
    // Extracted from PNG and TIFF files before decoding, as their decoders do not bound it.
    let beside = match format {
        ImageFormat::Png => Some(png::take_metadata(&mut bytes)),
        ImageFormat::Tiff => Some(tiff_metadata(&bytes, &mut premultiplied)),
        _ => None,
    };
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(LARGEST_DECODED);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    let mut decoder = reader.into_decoder().map_err(reason)?;
    let size = decoder.dimensions();
    check_pixels(size.0.into(), size.1.into())?;
    // Damaged metadata must not cost the photo: it only loses the focal length and the orientation.
    let mut found = beside.unwrap_or_else(|| Metadata {
        exif: decoder.exif_metadata().ok().flatten(),
        icc: decoder.icc_profile().ok().flatten(),
        xmp: decoder.xmp_metadata().ok().flatten(),
        ..Metadata::default()
    });
    let lens = found.exif.as_deref().map(|raw| lens(raw, size)).unwrap_or_default();
    found.adobe_rgb |= found.exif.as_deref().and_then(Directories::of).is_some_and(|d| d.is_adobe_rgb());
    let orientation = match &found.exif {
        Some(raw) => Orientation::from_exif_chunk(raw),
        // BigTIFF has no block for EXIF readers; its decoder returns the orientation.
        None if format == ImageFormat::Tiff => decoder.orientation().ok(),
        None => None,
    };
    let orientation = orientation.unwrap_or(Orientation::NoTransforms);
    // Checked here, too: not every decoder checks the limit before it allocates.
    if decoder.total_bytes() > LARGEST_DECODED {
        return Err(TOO_LARGE.to_owned());
    }
    let pixels = DynamicImage::from_decoder(decoder).map_err(reason)?;
    found.notes.extend(notes);
    Ok((Decoded::new(pixels, orientation, premultiplied, lens), found.bounded()))
}

/// Metadata of the first image of a TIFF file, whose tags form an EXIF block; empty where they are
/// damaged, and for BigTIFF.
fn tiff_metadata(bytes: &[u8], premultiplied: &mut bool) -> Metadata {
    let Some(tags) = Directories::of(bytes) else { return Metadata::default() };
    *premultiplied = tags.has_associated_alpha();
    let copied = |tag, most: usize| tags.bytes(tag).filter(|v| v.len() <= most).map(<[u8]>::to_vec);
    let icc = copied(tiff::ICC, LARGEST_ICC);
    let unread = icc.is_none() && tags.bytes(tiff::ICC).is_some();
    Metadata {
        exif: Some(tags.digest()),
        icc,
        xmp: copied(tiff::XMP, LARGEST_XMP),
        adobe_rgb: tags.is_adobe_rgb(),
        notes: unread.then(|| ICC_TOO_LARGE.to_owned()).into_iter().collect(),
        ..Metadata::default()
    }
}

/// Longest header of a Radiance file, bytes: its lines record the commands that made it. The
/// decoder keeps each with 43 times its size.
pub(super) const LONGEST_RADIANCE: usize = 64 << 10;

fn check_radiance(bytes: &[u8]) -> Result<(), String> {
    let head = &bytes[..bytes.len().min(LONGEST_RADIANCE)];
    match head.windows(2).any(|w| w == b"\n\n") || bytes.len() < LONGEST_RADIANCE {
        true => Ok(()),
        false => Err(damaged("its header is longer than 64 KiB")),
    }
}

fn reason(e: ImageError) -> String {
    let flat = |e: &dyn std::error::Error| e.to_string().replace('\n', " ").trim().to_string();
    match e {
        ImageError::Limits(_) => TOO_LARGE.into(),
        ImageError::Unsupported(e) => {
            format!("this kind of file is not supported ({}); save it as 8-bit JPEG or PNG", flat(&e))
        }
        ImageError::IoError(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
            "the image is cut off before its end; copy the photo again".into()
        }
        e => damaged(&flat(&e)),
    }
}
