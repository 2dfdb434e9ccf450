//! Bytes of an image file to upright pixels.
use super::exif_tags::{Lens, lens};
use super::heif;
use super::kind::{FileKind, LARGEST_DECODED, READ, TOO_LARGE, check_pixels, kind};
use super::profile;
use crate::scene::to_srgb;
use crate::{Error, Result, files};
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, Limits};
use rayon::prelude::*;
use std::io::Cursor;
use std::path::Path;

/// A decoded file: stored pixels, read through [`Decoded::at`] as the upright image.
pub(super) struct Decoded {
    pixels: DynamicImage,
    /// Of the stored pixels, by EXIF.
    pub orientation: Orientation,
    /// Colours are multiplied by alpha already (OpenEXR, TIFF with associated alpha).
    premultiplied: bool,
    /// Upright (width, height).
    pub size: (usize, usize),
    pub lens: Lens,
}

impl Decoded {
    fn new(pixels: DynamicImage, orientation: Orientation, premultiplied: bool, lens: Lens) -> Decoded {
        let (w, h) = (pixels.width() as usize, pixels.height() as usize);
        let sideways = matches!(
            orientation,
            Orientation::Rotate90
                | Orientation::Rotate270
                | Orientation::Rotate90FlipH
                | Orientation::Rotate270FlipH
        );
        Decoded { pixels, orientation, premultiplied, size: if sideways { (h, w) } else { (w, h) }, lens }
    }

    /// The same with the colours that an ICC profile gives the stored numbers.
    fn in_srgb(self, icc: Option<Vec<u8>>) -> Decoded {
        match icc {
            Some(icc) => Decoded { pixels: profile::to_srgb(self.pixels, &icc), ..self },
            None => self,
        }
    }

    /// Upright pixel as sRGB; alpha composited on black. 1 is the white of an 8- or 16-bit file; floating-point files
    /// (OpenEXR, Radiance, float TIFF) go beyond it on the same curve, in the scale that they were written in.
    pub fn at(&self, x: usize, y: usize) -> [f32; 3] {
        let c = self.stored(x, y);
        if self.is_linear() { c.map(to_srgb) } else { c }
    }

    /// Whether the file holds linear light in floating point, as all formats with floats do by convention.
    fn is_linear(&self) -> bool {
        matches!(self.pixels, DynamicImage::ImageRgb32F(_) | DynamicImage::ImageRgba32F(_))
    }

    /// Pixels with a value that is no finite number; only floating-point files have them.
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

    /// Upright pixel as the file encodes it, times alpha.
    fn stored(&self, x: usize, y: usize) -> [f32; 3] {
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
        let (colour, alpha) = sample(&self.pixels, x as u32, y as u32);
        if self.premultiplied || alpha == 1.0 { colour } else { colour.map(|v| v * alpha) }
    }
}

/// Colour and alpha of a stored pixel.
fn sample(image: &DynamicImage, x: u32, y: u32) -> ([f32; 3], f32) {
    // f32 holds every 8- and 16-bit sample; dividing keeps 255 / 255 and 65535 / 65535 at exactly 1.
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
        // The decoders give the types above; the enum is open.
        other => colour(image::GenericImageView::get_pixel(other, x, y).0.map(eight)),
    }
}

/// Light is not negative; renderers and sensors leave NaN, infinities and values just below zero behind.
fn finite(v: f32) -> f32 {
    if v.is_finite() { v.max(0.0) } else { 0.0 }
}

/// Decodes the bytes of a file; `path` only names it in messages.
pub(super) fn decode(bytes: Vec<u8>, path: &Path) -> Result<Decoded> {
    let named = |what: &str| format!("{}: {what}", path.display());
    let fail = |what: &str| Error::input(named(what));
    if bytes.is_empty() {
        return Err(fail("the file is empty (0 bytes); copy the photo again"));
    }
    match kind(&bytes, path) {
        FileKind::Image(format) => {
            let (decoded, icc) = coded(bytes, format).map_err(|what| fail(&what))?;
            Ok(decoded.in_srgb(icc))
        }
        FileKind::Heif => match heif::decode(&bytes) {
            Ok(heif::Image { pixels, exif, icc }) => {
                let size = (pixels.width(), pixels.height());
                let lens = exif.map(|raw| lens(raw, size)).unwrap_or_default();
                Ok(Decoded::new(pixels, Orientation::NoTransforms, false, lens).in_srgb(icc))
            }
            Err(heif::Failure::Input(what)) => Err(fail(&what)),
            Err(heif::Failure::Missing(what)) => Err(Error::missing(named(&what))),
        },
        FileKind::Video => Err(fail("is a video, not a photo")),
        FileKind::Refused(what) => Err(fail(what)),
        FileKind::Unknown => Err(fail(&format!("is not an image; photos must be {READ}"))),
    }
}

/// Stored pixels of an image file that holds no photo but labels: as they are, in the file's own orientation.
pub fn stored_pixels(path: &Path) -> Result<DynamicImage> {
    let bytes = files::read(path)?;
    let named = |what: &str| Error::input(format!("{}: {what}", path.display()));
    match kind(&bytes, path) {
        FileKind::Image(format) => coded(bytes, format).map(|(d, _)| d.pixels).map_err(|what| named(&what)),
        _ => Err(named("cannot be read as an image; give a PNG")),
    }
}

/// A file that the `image` crate reads and its ICC profile; the error is one line without the file's name.
fn coded(bytes: Vec<u8>, format: ImageFormat) -> Result<(Decoded, Option<Vec<u8>>), String> {
    if format == ImageFormat::Jpeg && !jpeg_is_complete(&bytes) {
        return Err("the JPEG is cut off before its end; copy the photo again".to_owned());
    }
    // A TIFF file is an EXIF block with pixels, so its tags are read in place.
    let tiff = (format == ImageFormat::Tiff).then(|| super::exif_tags::of_tiff(&bytes)).flatten();
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(LARGEST_DECODED);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    let mut decoder = reader.into_decoder().map_err(reason)?;
    let size = decoder.dimensions();
    check_pixels(size.0.into(), size.1.into())?;
    // Damaged metadata must not cost the photo: it only loses the focal length and the orientation.
    let lens = match (&tiff, decoder.exif_metadata()) {
        (Some(tags), _) => tags.lens(size),
        (None, Ok(Some(raw))) => lens(raw, size),
        _ => Lens::default(),
    };
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    let premultiplied =
        format == ImageFormat::OpenExr || tiff.is_some_and(|tags| tags.has_associated_alpha());
    // Checked here too: not every decoder heeds the limit before it allocates.
    if decoder.total_bytes() > LARGEST_DECODED {
        return Err(TOO_LARGE.to_owned());
    }
    let icc = decoder.icc_profile().ok().flatten();
    let pixels = DynamicImage::from_decoder(decoder).map_err(reason)?;
    Ok((Decoded::new(pixels, orientation, premultiplied, lens), icc))
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
    fn the_size_is_checked_before_anything_is_decoded() {
        let small = png(&image::GrayImage::new(2, 2).into(), None);
        let with_size = |w: u32, h: u32| {
            let mut bytes = small.clone();
            bytes[16..20].copy_from_slice(&w.to_be_bytes());
            bytes[20..24].copy_from_slice(&h.to_be_bytes());
            let mut sum = flate2::Crc::new();
            sum.update(&bytes[12..29]);
            bytes[29..33].copy_from_slice(&sum.sum().to_be_bytes());
            decode(bytes, Path::new("a.png")).err().unwrap().to_string()
        };
        let e = with_size(20_000, 20_000);
        assert!(e.contains("a.png: 20000 × 20000 pixels are more than the 200 million"), "{e}");
        // 108 megapixels are none too many: here only the pixels are missing.
        let e = with_size(12_000, 9_000);
        assert!(!e.contains("million"), "{e}");
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
    fn floats_are_linear_light_and_may_exceed_one() {
        let half = image::Rgba32FImage::from_pixel(2, 2, image::Rgba([0.25, 4.0, f32::NAN, 0.5]));
        let mut exr = Cursor::new(Vec::new());
        DynamicImage::ImageRgba32F(half).write_to(&mut exr, ImageFormat::OpenExr).unwrap();
        // OpenEXR stores colours multiplied by alpha: it must not be applied again.
        let d = decode(exr.into_inner(), Path::new("a.exr")).unwrap();
        // By IEC 61966-2-1, 0.25 is 0.53710 and 4 is 1.055 · 4^(1/2.4) − 0.055; f32 powers are good to 1e-6.
        let srgb = d.at(0, 1);
        let right =
            (srgb[0] - 0.537_099).abs() < 1e-5 && (srgb[1] - 1.824_796).abs() < 1e-5 && srgb[2] == 0.0;
        assert!(right, "{srgb:?}");
        assert_eq!(
            (d.not_finite(), decode(png(&picture(), None), Path::new("a.png")).unwrap().not_finite()),
            (4, 0)
        );
        let mut hdr = Cursor::new(Vec::new());
        let bright = image::Rgb32FImage::from_pixel(16, 2, image::Rgb([8.0, 2.0, 0.5]));
        DynamicImage::ImageRgb32F(bright).write_to(&mut hdr, ImageFormat::Hdr).unwrap();
        // Powers of two, which the shared exponent of Radiance files holds exactly.
        let back =
            decode(hdr.into_inner(), Path::new("a.hdr")).unwrap().at(3, 1).map(crate::scene::to_linear);
        assert!(
            back.iter().zip([8.0, 2.0, 0.5]).all(|(a, b): (&f32, f32)| (a / b - 1.0).abs() < 1e-5),
            "{back:?}"
        );
    }

    #[test]
    fn webp_with_exif_and_alpha() {
        use exif::{Tag, Value};
        let raw = super::super::exif_tags::tests::block(&[
            (Tag::Orientation, Value::Short(vec![6])),
            (Tag::FocalLengthIn35mmFilm, Value::Short(vec![28])),
        ]);
        let mut stored = picture();
        stored.apply_orientation(Orientation::Rotate270);
        let mut out = Vec::new();
        let mut encoder = image::codecs::webp::WebPEncoder::new_lossless(&mut out);
        encoder.set_exif_metadata(raw).unwrap();
        encoder.write_image(stored.as_bytes(), 3, 5, image::ExtendedColorType::Rgb8).unwrap();
        let d = decode(out, Path::new("a.webp")).unwrap();
        let reference = decode(png(&picture(), None), Path::new("a.png")).unwrap();
        assert_eq!((d.size, upright(&d)), ((5, 3), upright(&reference)));
        assert!((d.lens.focal.unwrap() - 28.0 / 43.2666 * 5f64.hypot(3.0)).abs() < 1e-3);
        let clear = image::RgbaImage::from_pixel(2, 2, image::Rgba([200, 100, 0, 51]));
        let mut out = Cursor::new(Vec::new());
        DynamicImage::from(clear).write_to(&mut out, ImageFormat::WebP).unwrap();
        let c = decode(out.into_inner(), Path::new("a.webp")).unwrap().at(0, 0);
        assert!((c[0] - 200.0 / 255.0 * 0.2).abs() < 1e-6, "{c:?}");
    }

    /// An uncompressed little-endian TIFF: per page a size, the tags besides those of the layout, and the strip.
    fn tiff(pages: &[(u32, u32, &[(u16, u16, Vec<u32>)], Vec<u8>)]) -> Vec<u8> {
        let mut out = b"II*\0\0\0\0\0".to_vec();
        let mut link = 4;
        for (w, h, tags, strip) in pages {
            let at = out.len() as u32;
            out.extend(strip);
            out.resize(out.len().next_multiple_of(2), 0);
            let mut tags: Vec<_> = tags.to_vec();
            tags.extend([(256, 4, vec![*w]), (257, 4, vec![*h]), (259, 3, vec![1])]);
            tags.extend([(273, 4, vec![at]), (278, 4, vec![*h]), (279, 4, vec![strip.len() as u32])]);
            tags.sort();
            let mut directory = (tags.len() as u16).to_le_bytes().to_vec();
            for (tag, kind, values) in &tags {
                let size = if *kind == 3 { 2 } else { 4 };
                let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()[..size].to_vec()).collect();
                let field = if bytes.len() <= 4 {
                    let mut inline = bytes;
                    inline.resize(4, 0);
                    inline
                } else {
                    let at = out.len() as u32;
                    out.extend(bytes);
                    at.to_le_bytes().to_vec()
                };
                directory.extend([tag.to_le_bytes(), kind.to_le_bytes()].concat());
                directory.extend((values.len() as u32).to_le_bytes());
                directory.extend(field);
            }
            let here = out.len() as u32;
            out[link..link + 4].copy_from_slice(&here.to_le_bytes());
            out.extend(directory);
            link = out.len();
            out.extend([0; 4]);
        }
        out
    }

    #[test]
    fn kinds_of_tiff() {
        const BITS: u16 = 258;
        const PHOTOMETRIC: u16 = 262;
        const ORIENTATION: u16 = 274;
        const SAMPLES: u16 = 277;
        const EXTRA: u16 = 338;
        let short = |tag, values: &[u32]| (tag, 3u16, values.to_vec());
        let layout = |photometric, bits: &[u32]| {
            vec![short(PHOTOMETRIC, &[photometric]), short(SAMPLES, &[bits.len() as u32]), short(BITS, bits)]
        };
        let sixteen = |values: &[u16]| values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let read = |tags: &[(u16, u16, Vec<u32>)], strip: Vec<u8>| {
            decode(tiff(&[(2, 1, tags, strip)]), Path::new("a.tif")).unwrap()
        };
        let near = |c: [f32; 3], want: [f32; 3]| {
            assert!((0..3).all(|k| (c[k] - want[k]).abs() < 1e-6), "{c:?}, expected {want:?}");
        };
        let grey = read(&layout(1, &[16]), sixteen(&[1000, 65535]));
        near(grey.at(0, 0), [1000.0 / 65535.0; 3]);
        // White is zero.
        near(read(&layout(0, &[8]), vec![0, 255]).at(0, 0), [1.0; 3]);
        let deep = read(&layout(2, &[16; 3]), sixteen(&[65535, 257, 0, 1, 2, 3]));
        near(deep.at(0, 0), [1.0, 1.0 / 255.0, 0.0]);
        // Orientation 3: the second stored pixel comes first.
        let mut turned = layout(2, &[8; 3]);
        turned.push(short(ORIENTATION, &[3]));
        near(read(&turned, vec![0, 0, 0, 255, 51, 0]).at(0, 0), [1.0, 0.2, 0.0]);
        // Associated alpha is in the colours already, unassociated alpha is not.
        for (kind, expected) in [(1, [0.4, 0.2, 0.0]), (2, [0.08, 0.04, 0.0])] {
            let mut alpha = layout(2, &[8; 4]);
            alpha.push(short(EXTRA, &[kind]));
            near(read(&alpha, vec![102, 51, 0, 51, 0, 0, 0, 0]).at(0, 0), expected);
        }
        // (1 − C)(1 − K), as printing inks are approximated without a profile.
        let inks = read(&layout(5, &[8; 4]), vec![0, 255, 51, 0, 0, 0, 0, 255]);
        near(inks.at(0, 0), [1.0, 0.0, 0.8]);
        near(inks.at(1, 0), [0.0; 3]);
        let first = (2, 1, &layout(1, &[8])[..], vec![51, 51]);
        let second = (1, 1, &layout(1, &[8])[..], vec![255]);
        let pages = decode(tiff(&[first, second]), Path::new("a.tif")).unwrap();
        assert_eq!(pages.size, (2, 1), "the first page");
        near(pages.at(1, 0), [0.2; 3]);
    }

    #[test]
    fn cut_off_webp_tiff_and_exr_are_refused() {
        let noise = image::RgbImage::from_fn(24, 18, |x, y| image::Rgb([x as u8 * 9, y as u8 * 13, 7]));
        let noise = DynamicImage::from(noise);
        for (format, name) in
            [(ImageFormat::WebP, "a.webp"), (ImageFormat::Tiff, "a.tif"), (ImageFormat::OpenExr, "a.exr")]
        {
            let mut out = Cursor::new(Vec::new());
            let floats = DynamicImage::from(noise.to_rgb32f());
            let image = if format == ImageFormat::OpenExr { &floats } else { &noise };
            image.write_to(&mut out, format).unwrap();
            let bytes = out.into_inner();
            assert!(decode(bytes.clone(), Path::new(name)).is_ok());
            // The directory of a TIFF and the padding of a WebP may end the file: what is cut must reach into the pixels.
            for cut in (0..bytes.len() / 2).step_by(7) {
                let e = decode(bytes[..cut].to_vec(), Path::new(name)).err();
                let e = e.unwrap_or_else(|| panic!("{name} cut at {cut} of {}", bytes.len()));
                assert_eq!((e.exit_code(), e.to_string().lines().count()), (2, 1), "{e}");
            }
        }
    }

    #[test]
    fn foreign_files_are_named() {
        let cases: [(&[u8], &str, &str); 5] = [
            (b"\0\0\0\x18ftypmp42....", "a.jpg", "video"),
            (b"GIF89a", "a.png", "GIF"),
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
