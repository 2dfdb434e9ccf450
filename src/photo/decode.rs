//! Bytes of an image file to upright pixels.
use super::exif_tags::{Lens, lens};
use crate::{Error, Result};
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits};
use std::io::Cursor;
use std::path::Path;

/// Most memory a decoded file may take: four times the largest photo that phones write (200 megapixels, 8 bit).
const LARGEST_DECODED: u64 = 2 << 30;

/// A decoded file: stored pixels, read through [`Decoded::at`] as the upright image.
pub(super) struct Decoded {
    pixels: DynamicImage,
    orientation: Orientation,
    /// Upright (width, height).
    pub size: (usize, usize),
    pub lens: Lens,
}

impl Decoded {
    /// Upright pixel as RGB in [0, 1]; alpha composited on black.
    pub fn at(&self, x: usize, y: usize) -> [f32; 3] {
        let (w, h) = (self.pixels.width() as usize, self.pixels.height() as usize);
        let (x, y) = match self.orientation {
            Orientation::NoTransforms => (x, y),
            Orientation::FlipHorizontal => (w - 1 - x, y),
            Orientation::Rotate180 => (w - 1 - x, h - 1 - y),
            Orientation::FlipVertical => (x, h - 1 - y),
            Orientation::Rotate90FlipH => (y, x),
            Orientation::Rotate90 => (y, h - 1 - x),
            Orientation::Rotate270FlipH => (w - 1 - y, h - 1 - x),
            Orientation::Rotate270 => (w - 1 - y, x),
        };
        stored(&self.pixels, x as u32, y as u32)
    }
}

fn stored(image: &DynamicImage, x: u32, y: u32) -> [f32; 3] {
    // f32 holds every 8- and 16-bit sample; dividing keeps 255 / 255 and 65535 / 65535 at exactly 1.
    let eight = |v: u8| v as f32 / 255.0;
    let sixteen = |v: u16| v as f32 / 65535.0;
    match image {
        DynamicImage::ImageLuma8(i) => [eight(i.get_pixel(x, y).0[0]); 3],
        DynamicImage::ImageLumaA8(i) => {
            let [v, a] = i.get_pixel(x, y).0.map(eight);
            [v * a; 3]
        }
        DynamicImage::ImageRgb8(i) => i.get_pixel(x, y).0.map(eight),
        DynamicImage::ImageRgba8(i) => {
            let [r, g, b, a] = i.get_pixel(x, y).0.map(eight);
            [r * a, g * a, b * a]
        }
        DynamicImage::ImageLuma16(i) => [sixteen(i.get_pixel(x, y).0[0]); 3],
        DynamicImage::ImageLumaA16(i) => {
            let [v, a] = i.get_pixel(x, y).0.map(sixteen);
            [v * a; 3]
        }
        DynamicImage::ImageRgb16(i) => i.get_pixel(x, y).0.map(sixteen),
        DynamicImage::ImageRgba16(i) => {
            let [r, g, b, a] = i.get_pixel(x, y).0.map(sixteen);
            [r * a, g * a, b * a]
        }
        // Float images do not come out of JPEG or PNG files.
        other => {
            let [r, g, b, a] = image::GenericImageView::get_pixel(other, x, y).0.map(eight);
            [r * a, g * a, b * a]
        }
    }
}

/// What to do with a video.
pub(super) const VIDEO: &str =
    "is a video; take 3 or 4 still photos, or save frames of it as JPEG or PNG and give those";

/// What a file that is not a JPEG or PNG turns out to be, by its first bytes or its name.
fn foreign(bytes: &[u8], path: &Path) -> Option<&'static str> {
    const HEIF: &str = "is a HEIC/AVIF image; save it as JPEG or PNG";
    let brand = if bytes.get(4..8) == Some(b"ftyp") { bytes.get(8..12) } else { None };
    match (bytes, brand) {
        (_, Some(b"heic" | b"heix" | b"hevc" | b"mif1" | b"msf1" | b"avif" | b"avis")) => return Some(HEIF),
        (_, Some(_)) | ([0x1a, 0x45, 0xdf, 0xa3, ..], _) => return Some(VIDEO),
        (b, _) if b.starts_with(b"RIFF") && b.get(8..12) == Some(b"AVI ") => return Some(VIDEO),
        (b, _) if b.starts_with(b"RIFF") && b.get(8..12) == Some(b"WEBP") => {
            return Some("is a WebP image; save it as JPEG or PNG");
        }
        (b, _) if b.starts_with(b"GIF8") => return Some("is a GIF; save its frames as PNG"),
        (b, _) if b.starts_with(b"BM") => return Some("is a BMP image; save it as PNG"),
        (b, _) if b.starts_with(b"II*\0") || b.starts_with(b"MM\0*") => {
            return Some("is a TIFF or camera raw file; develop it to JPEG or 16-bit PNG");
        }
        _ => {}
    }
    super::choose::is_video_name(path).then_some(VIDEO)
}

/// Decodes the bytes of a file; `path` only names it in messages.
pub(super) fn decode(bytes: Vec<u8>, path: &Path) -> Result<Decoded> {
    let fail = |what: &str| Error::input(format!("{}: {what}", path.display()));
    if bytes.is_empty() {
        return Err(fail("the file is empty (0 bytes); copy the photo again"));
    }
    let format = match image::guess_format(&bytes) {
        Ok(f @ (ImageFormat::Jpeg | ImageFormat::Png)) => f,
        _ => {
            return Err(fail(foreign(&bytes, path).unwrap_or("is not an image; photos must be JPEG or PNG")));
        }
    };
    if format == ImageFormat::Jpeg && !jpeg_is_complete(&bytes) {
        return Err(fail("the JPEG is cut off before its end; copy the photo again"));
    }
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(LARGEST_DECODED);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    let mut decoder = reader.into_decoder().map_err(|e| fail(&reason(e)))?;
    let size = decoder.dimensions();
    // Damaged metadata must not cost the photo: it only loses the focal length and the orientation.
    let lens = match decoder.exif_metadata() {
        Ok(Some(raw)) => lens(raw, size),
        _ => Lens::default(),
    };
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let pixels = DynamicImage::from_decoder(decoder).map_err(|e| fail(&reason(e)))?;
    let (w, h) = (pixels.width() as usize, pixels.height() as usize);
    let sideways = matches!(
        orientation,
        Orientation::Rotate90
            | Orientation::Rotate270
            | Orientation::Rotate90FlipH
            | Orientation::Rotate270FlipH
    );
    Ok(Decoded { pixels, orientation, size: if sideways { (h, w) } else { (w, h) }, lens })
}

fn reason(e: ImageError) -> String {
    let flat = |e: &dyn std::error::Error| e.to_string().replace('\n', " ").trim().to_string();
    match e {
        ImageError::Limits(_) => "the image needs more than 2 GiB of memory; make it smaller".into(),
        ImageError::Unsupported(e) => {
            format!("this kind of file is not supported ({}); save it as 8-bit JPEG or PNG", flat(&e))
        }
        ImageError::IoError(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
            "the image is cut off before its end; copy the photo again".into()
        }
        e => format!("the image is damaged ({}); copy the photo again or save it anew", flat(&e)),
    }
}

/// Walks the segments of a JPEG file: true once the end-of-image marker is reached. The decoder fills a cut-off file
/// with grey instead of reporting it, and grey areas would end up as geometry.
fn jpeg_is_complete(bytes: &[u8]) -> bool {
    let mut at = 2;
    let mut in_scan = false;
    while at + 1 < bytes.len() {
        if bytes[at] != 0xff {
            // Entropy-coded data, or stray bytes between segments that decoders skip too.
            at += 1;
            continue;
        }
        match bytes[at + 1] {
            0xd9 => return true,
            // A stuffed byte, a restart marker, or a second 0xff of padding.
            0x00 if in_scan => at += 2,
            0x01 | 0xd0..=0xd8 => at += 2,
            0xff => at += 1,
            marker => {
                let Some(length) = bytes.get(at + 2..at + 4) else { return false };
                in_scan = marker == 0xda || in_scan;
                at += 2 + u16::from_be_bytes([length[0], length[1]]) as usize;
            }
        }
    }
    false
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ImageEncoder, codecs::png::PngEncoder};

    fn png(image: &DynamicImage, exif: Option<Vec<u8>>) -> Vec<u8> {
        let mut out = Vec::new();
        let mut encoder = PngEncoder::new(&mut out);
        if let Some(raw) = exif {
            encoder.set_exif_metadata(raw).unwrap();
        }
        encoder.write_image(image.as_bytes(), image.width(), image.height(), image.color().into()).unwrap();
        out
    }

    fn upright(d: &Decoded) -> Vec<[f32; 3]> {
        (0..d.size.1).flat_map(|y| (0..d.size.0).map(move |x| (x, y))).map(|(x, y)| d.at(x, y)).collect()
    }

    fn picture() -> DynamicImage {
        // 5 × 3: neither symmetric nor square.
        image::RgbImage::from_fn(5, 3, |x, y| image::Rgb([(x * 50) as u8, (y * 90) as u8, (x + 7 * y) as u8]))
            .into()
    }

    #[test]
    fn the_eight_orientations_give_one_image() {
        use exif::{Tag, Value};
        let reference = decode(png(&picture(), None), Path::new("a.png")).unwrap();
        for tag in 1..=8u8 {
            // The stored image is the upright one with the inverse of the tag applied: of the eight, only the two
            // quarter turns are not their own inverse.
            let inverse = match tag {
                6 => 8,
                8 => 6,
                t => t,
            };
            let mut stored = picture();
            stored.apply_orientation(Orientation::from_exif(inverse).unwrap());
            let raw =
                super::super::exif_tags::tests::block(&[(Tag::Orientation, Value::Short(vec![tag as u16]))]);
            let d = decode(png(&stored, Some(raw)), Path::new("a.png")).unwrap();
            assert_eq!(d.size, (5, 3), "orientation {tag}");
            assert_eq!(upright(&d), upright(&reference), "orientation {tag}");
        }
    }

    #[test]
    fn depth_and_channels() {
        let p = Path::new("a.png");
        let grey16 = image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(2, 2, image::Luma([1000]));
        let d = decode(png(&grey16.into(), None), p).unwrap();
        assert_eq!(d.at(1, 1), [1000.0 / 65535.0; 3]);
        let rgb16 = image::ImageBuffer::<image::Rgb<u16>, _>::from_pixel(2, 2, image::Rgb([65535, 257, 0]));
        assert_eq!(decode(png(&rgb16.into(), None), p).unwrap().at(0, 1), [1.0, 257.0 / 65535.0, 0.0]);
        let grey = image::GrayImage::from_pixel(2, 2, image::Luma([51]));
        assert_eq!(decode(png(&grey.into(), None), p).unwrap().at(0, 0), [0.2; 3]);
        let alpha = image::RgbaImage::from_pixel(2, 2, image::Rgba([255, 51, 0, 51]));
        let c = decode(png(&alpha.into(), None), p).unwrap().at(0, 0);
        assert!((c[0] - 0.2).abs() < 1e-6 && (c[1] - 0.04).abs() < 1e-6 && c[2] == 0.0, "on black: {c:?}");
    }

    #[test]
    fn every_cut_is_noticed() {
        let mut jpeg = Vec::new();
        let noise = image::RgbImage::from_fn(40, 30, |x, y| {
            let v = (x * 7919 + y * 104_729) % 251;
            image::Rgb([v as u8, (v * 3 % 256) as u8, (v * 5 % 256) as u8])
        });
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 90).encode_image(&noise).unwrap();
        for (bytes, name) in [(jpeg, "a.jpg"), (png(&picture(), None), "a.png")] {
            assert!(decode(bytes.clone(), Path::new(name)).is_ok());
            for cut in 0..bytes.len() {
                // The last 12 bytes of a PNG are its empty IEND chunk: all pixels are there without it.
                if name == "a.png" && cut + 12 >= bytes.len() {
                    continue;
                }
                let e = decode(bytes[..cut].to_vec(), Path::new(name))
                    .err()
                    .unwrap_or_else(|| panic!("{name} cut at {cut}"));
                assert_eq!(e.exit_code(), 2);
                assert_eq!(e.to_string().lines().count(), 1);
            }
        }
    }

    #[test]
    fn foreign_files_are_named() {
        let cases: [(&[u8], &str, &str); 6] = [
            (b"\0\0\0\x18ftypmp42....", "a.jpg", "video"),
            (b"\0\0\0\x18ftypheic....", "a.heic", "HEIC"),
            (b"RIFF....WEBPVP8 ", "a.png", "WebP"),
            (b"hello world, not an image", "clip.MOV", "video"),
            (b"hello world, not an image", "a.txt", "not an image"),
            (b"", "a.jpg", "empty"),
        ];
        for (bytes, name, word) in cases {
            let message = decode(bytes.to_vec(), Path::new(name)).err().unwrap().to_string();
            assert!(message.contains(word) && message.contains(name), "{message}");
        }
    }
}
