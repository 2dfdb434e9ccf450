//! Tests of [`super`].
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
    (0..d.size.1).flat_map(|y| (0..d.size.0).map(move |x| (x, y))).map(|(x, y)| d.at(x, y).0).collect()
}

fn picture() -> DynamicImage {
    // 5 × 3: neither symmetric nor square.
    image::RgbImage::from_fn(5, 3, |x, y| image::Rgb([(x * 50) as u8, (y * 90) as u8, (x + 7 * y) as u8]))
        .into()
}

#[test]
fn eight_orientations_give_one_image() {
    use exif::{Tag, Value};
    let reference = decode(png(&picture(), None), Path::new("a.png"), None).unwrap();
    for tag in 1..=8u8 {
        // The stored image is the upright one with the inverse of the tag applied; of the eight
        // only the two quarter turns are not their own inverse.
        let inverse = match tag {
            6 => 8,
            8 => 6,
            t => t,
        };
        let mut stored = picture();
        stored.apply_orientation(Orientation::from_exif(inverse).unwrap());
        let raw =
            super::super::exif_tags::tests::block(&[(Tag::Orientation, Value::Short(vec![tag as u16]))]);
        let d = decode(png(&stored, Some(raw)), Path::new("a.png"), None).unwrap();
        assert_eq!(d.size, (5, 3), "orientation {tag}");
        assert_eq!(upright(&d), upright(&reference), "orientation {tag}");
    }
}

#[test]
fn depth_and_channels() {
    let p = Path::new("a.png");
    let grey16 = image::ImageBuffer::<image::Luma<u16>, _>::from_pixel(2, 2, image::Luma([1000]));
    let d = decode(png(&grey16.into(), None), p, None).unwrap();
    assert_eq!(d.at(1, 1).0, [1000.0 / 65535.0; 3]);
    let rgb16 = image::ImageBuffer::<image::Rgb<u16>, _>::from_pixel(2, 2, image::Rgb([65535, 257, 0]));
    assert_eq!(decode(png(&rgb16.into(), None), p, None).unwrap().at(0, 1).0, [1.0, 257.0 / 65535.0, 0.0]);
    let grey = image::GrayImage::from_pixel(2, 2, image::Luma([51]));
    assert_eq!(decode(png(&grey.into(), None), p, None).unwrap().at(0, 0).0, [0.2; 3]);
    let alpha = image::RgbaImage::from_pixel(2, 2, image::Rgba([255, 51, 0, 51]));
    let d = decode(png(&alpha.into(), None), p, None).unwrap();
    assert_eq!((d.at(0, 0), d.is_transparent()), (([1.0, 0.2, 0.0], 0.2), true), "not multiplied");
    let opaque = image::RgbaImage::from_pixel(2, 2, image::Rgba([255, 51, 0, 255]));
    assert!(!decode(png(&opaque.into(), None), p, None).unwrap().is_transparent());
}

#[test]
fn image_size_is_checked_before_decoding() {
    let small = png(&image::GrayImage::new(2, 2).into(), None);
    let with_size = |w: u32, h: u32| {
        let mut bytes = small.clone();
        bytes[16..20].copy_from_slice(&w.to_be_bytes());
        bytes[20..24].copy_from_slice(&h.to_be_bytes());
        let mut sum = flate2::Crc::new();
        sum.update(&bytes[12..29]);
        bytes[29..33].copy_from_slice(&sum.sum().to_be_bytes());
        decode(bytes, Path::new("a.png"), None).err().unwrap().to_string()
    };
    let e = with_size(20_000, 20_000);
    assert!(e.contains("a.png: 20000 × 20000 pixels are more than the 200 million"), "{e}");
    // 108 megapixels are within the limit: here only the pixels are missing.
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
        let whole = decode(bytes.clone(), Path::new(name), None).unwrap();
        assert!(whole.notes.is_empty());
        let mut read = 0;
        for cut in 0..bytes.len() {
            // The last 12 bytes of a PNG are its empty IEND chunk: all pixels precede it.
            if name == "a.png" && cut + 12 >= bytes.len() {
                continue;
            }
            match decode(bytes[..cut].to_vec(), Path::new(name), None) {
                Ok(found) => {
                    read += 1;
                    assert!(upright(&found) == upright(&whole), "{name} cut at {cut} has other pixels");
                    assert!(found.notes[0].contains("lacks its end marker"), "{:?}", found.notes);
                }
                Err(e) => assert_eq!((e.exit_code(), e.to_string().lines().count()), (2, 1), "{e}"),
            }
        }
        // Cut before the marker or within it; a cut one byte earlier may only remove padding of the
        // last block.
        assert!(
            if name == "a.jpg" { (2..=3).contains(&read) } else { read == 0 },
            "{name}: {read} cuts are read"
        );
    }
}

#[test]
fn float_files_are_linear_light() {
    let half = image::Rgba32FImage::from_pixel(2, 2, image::Rgba([0.125, 2.0, f32::NAN, 0.5]));
    let mut exr = Cursor::new(Vec::new());
    DynamicImage::ImageRgba32F(half).write_to(&mut exr, ImageFormat::OpenExr).unwrap();
    // OpenEXR stores colours multiplied by alpha.
    let d = decode(exr.into_inner(), Path::new("a.exr"), None).unwrap();
    // By IEC 61966-2-1, 0.25 is 0.53710 and 4 is 1.055 · 4^(1/2.4) − 0.055; f32 powers are good to
    // 1e-6.
    let srgb = d.at(0, 1).0;
    let right = (srgb[0] - 0.537_099).abs() < 1e-5 && (srgb[1] - 1.824_796).abs() < 1e-5 && srgb[2] == 0.0;
    assert!(right, "{srgb:?}");
    assert_eq!(
        (d.not_finite(), decode(png(&picture(), None), Path::new("a.png"), None).unwrap().not_finite()),
        (4, 0)
    );
    let mut hdr = Cursor::new(Vec::new());
    let bright = image::Rgb32FImage::from_pixel(16, 2, image::Rgb([8.0, 2.0, 0.5]));
    DynamicImage::ImageRgb32F(bright).write_to(&mut hdr, ImageFormat::Hdr).unwrap();
    // Powers of two are exact in the shared exponent of Radiance files.
    let back =
        decode(hdr.into_inner(), Path::new("a.hdr"), None).unwrap().at(3, 1).0.map(crate::scene::to_linear);
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
    let d = decode(out, Path::new("a.webp"), None).unwrap();
    let reference = decode(png(&picture(), None), Path::new("a.png"), None).unwrap();
    assert_eq!((d.size, upright(&d)), ((5, 3), upright(&reference)));
    assert!((d.lens.focal.unwrap() - 28.0 / 43.2666 * 5f64.hypot(3.0)).abs() < 1e-3);
    let clear = image::RgbaImage::from_pixel(2, 2, image::Rgba([200, 100, 0, 51]));
    let mut out = Cursor::new(Vec::new());
    DynamicImage::from(clear).write_to(&mut out, ImageFormat::WebP).unwrap();
    let (c, alpha) = decode(out.into_inner(), Path::new("a.webp"), None).unwrap().at(0, 0);
    assert!((c[0] - 200.0 / 255.0).abs() < 1e-6 && (alpha - 0.2).abs() < 1e-6, "{c:?} {alpha}");
}

/// An uncompressed little-endian TIFF; per page: a size, the tags besides those of the layout, and
/// the strip.
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
        decode(tiff(&[(2, 1, tags, strip)]), Path::new("a.tif"), None).unwrap()
    };
    let near = |c: [f32; 3], want: [f32; 3]| {
        assert!((0..3).all(|k| (c[k] - want[k]).abs() < 1e-6), "{c:?}, expected {want:?}");
    };
    let grey = read(&layout(1, &[16]), sixteen(&[1000, 65535]));
    near(grey.at(0, 0).0, [1000.0 / 65535.0; 3]);
    // White is zero.
    near(read(&layout(0, &[8]), vec![0, 255]).at(0, 0).0, [1.0; 3]);
    let deep = read(&layout(2, &[16; 3]), sixteen(&[65535, 257, 0, 1, 2, 3]));
    near(deep.at(0, 0).0, [1.0, 1.0 / 255.0, 0.0]);
    // Orientation 3: the second stored pixel comes first.
    let mut turned = layout(2, &[8; 3]);
    turned.push(short(ORIENTATION, &[3]));
    near(read(&turned, vec![0, 0, 0, 255, 51, 0]).at(0, 0).0, [1.0, 0.2, 0.0]);
    // Associated alpha is in the colours already, unassociated alpha is not.
    for (kind, expected) in [(1, [20.0 / 51.0, 10.0 / 51.0, 0.0]), (2, [20.0 / 255.0, 10.0 / 255.0, 0.0])] {
        let mut alpha = layout(2, &[8; 4]);
        alpha.push(short(EXTRA, &[kind]));
        let d = read(&alpha, vec![20, 10, 0, 51, 0, 0, 0, 0]);
        near(d.at(0, 0).0, expected);
        assert_eq!((d.at(0, 0).1, d.at(1, 0)), (0.2, ([0.0; 3], 0.0)));
    }
    // (1 − C)(1 − K), the usual approximation of printing inks without a profile.
    let inks = read(&layout(5, &[8; 4]), vec![0, 255, 51, 0, 0, 0, 0, 255]);
    near(inks.at(0, 0).0, [1.0, 0.0, 0.8]);
    near(inks.at(1, 0).0, [0.0; 3]);
    let first = (2, 1, &layout(1, &[8])[..], vec![51, 51]);
    let second = (1, 1, &layout(1, &[8])[..], vec![255]);
    let pages = decode(tiff(&[first, second]), Path::new("a.tif"), None).unwrap();
    assert_eq!(pages.size, (2, 1), "the first page");
    near(pages.at(1, 0).0, [0.2; 3]);
}

#[test]
fn truncated_webp_tiff_exr_are_refused() {
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
        assert!(decode(bytes.clone(), Path::new(name), None).is_ok());
        // The directory of a TIFF and the padding of a WebP may end the file: a cut must reach into
        // the pixels.
        for cut in (0..bytes.len() / 2).step_by(7) {
            let e = decode(bytes[..cut].to_vec(), Path::new(name), None).err();
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
        let message = decode(bytes.to_vec(), Path::new(name), None).err().unwrap().to_string();
        assert!(message.contains(word) && message.contains(name), "{message}");
    }
}

/// A chunk of a PNG with its checksum.
fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let mut sum = flate2::Crc::new();
    sum.update(kind);
    sum.update(data);
    [&(data.len() as u32).to_be_bytes()[..], kind, data, &sum.sum().to_be_bytes()].concat()
}

/// A PNG with chunks after its header.
fn with_chunks(image: &DynamicImage, chunks: &[Vec<u8>]) -> Vec<u8> {
    let whole = png(image, None);
    [&whole[..33], &chunks.concat(), &whole[33..]].concat()
}

fn deflated(bytes: &[u8], times: usize) -> Vec<u8> {
    use std::io::Write;
    let mut out = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    (0..times).for_each(|_| out.write_all(bytes).unwrap());
    out.finish().unwrap()
}

#[test]
fn png_palette_length_never_panics() {
    let header = [0, 0, 0, 4, 0, 0, 0, 4, 8, 3, 0, 0, 0];
    for length in 0..=800usize {
        let palette: Vec<u8> = (0..length).map(|k| (k % 251) as u8).collect();
        let rows: Vec<u8> = (0..4).flat_map(|y| [0, y, y + 1, 200, 255]).collect();
        let parts = [
            b"\x89PNG\r\n\x1a\n".to_vec(),
            chunk(b"IHDR", &header),
            chunk(b"PLTE", &palette),
            chunk(b"IDAT", &deflated(&rows, 1)),
            chunk(b"IEND", &[]),
        ];
        if let Err(e) = decode(parts.concat(), Path::new("a.png"), None) {
            let text = e.to_string();
            assert!(e.exit_code() == 2 && text.lines().count() == 1 && text.starts_with("a.png: "), "{text}");
        }
    }
}

#[test]
fn bombs_beside_pixels_are_not_inflated() {
    let zeros = vec![0u8; 1 << 20];
    let icc = [&b"bomb\0\0"[..], &deflated(&zeros, 64)].concat();
    let xmp = [&b"XML:com.adobe.xmp\0\x01\0\0\0"[..], &deflated(&zeros, 64)].concat();
    let text = [&b"a\0\0"[..], &deflated(&zeros, 64)].concat();
    let mut bytes =
        with_chunks(&picture(), &[chunk(b"iCCP", &icc), chunk(b"iTXt", &xmp), chunk(b"zTXt", &text)]);
    let found = png::take_metadata(&mut bytes);
    assert_eq!(bytes, png(&picture(), None), "only pixels are left");
    assert!(found.icc.is_none() && found.xmp.is_none());
    assert!(found.notes[0].contains("larger than 4 MiB"), "{:?}", found.notes);
}

#[test]
fn long_header_of_radiance_is_refused() {
    let header = [&b"#?RADIANCE\n"[..], &b"A=B\n".repeat(30_000), b"\n-Y 2 +X 2\n", &[0; 16]].concat();
    let e = decode(header, Path::new("a.hdr"), None).err().unwrap().to_string();
    assert!(e.contains("longer than 64 KiB"), "{e}");
}

#[test]
fn code_points_of_png_are_used() {
    let wide: DynamicImage = image::RgbImage::from_pixel(3, 3, image::Rgb([128, 64, 191])).into();
    let one = |chunks: &[Vec<u8>]| {
        let d = decode(with_chunks(&wide, chunks), Path::new("a.png"), None).unwrap();
        (d.at(1, 1).0.map(|v| (v * 255.0).round() as u8), d.notes)
    };
    let plain = [128, 64, 191];
    let p3 = one(&[chunk(b"cICP", &[12, 13, 0, 1])]).0;
    assert!(p3[0] > 132 && p3[1] < 62, "more saturated in sRGB: {p3:?}");
    let icc = [&b"p\0\0"[..], &deflated(&profile::tests::display_p3(), 1)].concat();
    let by_icc = one(&[chunk(b"iCCP", &icc)]).0;
    assert!((0..3).all(|k| by_icc[k].abs_diff(p3[k]) <= 1), "{by_icc:?} {p3:?}");
    assert_eq!(one(&[chunk(b"cICP", &[1, 13, 0, 1]), chunk(b"iCCP", &icc)]).0, plain, "before the profile");
    assert_eq!(one(&[chunk(b"sRGB", &[0]), chunk(b"gAMA", &100_000u32.to_be_bytes())]).0, plain);
    // 1 / 2.2 approximates the curve of sRGB; 1 is linear light.
    assert_eq!(one(&[chunk(b"gAMA", &45_455u32.to_be_bytes())]).0, plain);
    let linear = one(&[chunk(b"gAMA", &100_000u32.to_be_bytes())]).0;
    let expected = plain.map(|v| (to_srgb(f32::from(v) / 255.0) * 255.0).round() as u8);
    assert!((0..3).all(|k| linear[k].abs_diff(expected[k]) <= 1), "{linear:?} {expected:?}");
    let unknown = one(&[chunk(b"cICP", &[10, 9, 0, 1])]);
    assert!(unknown.0 == plain && unknown.1.len() == 2, "{:?}", unknown.1);
    let damaged = one(&[chunk(b"iCCP", b"p\0\0nonsense")]);
    assert!(damaged.0 == plain && damaged.1[0].contains("ICC profile"), "{:?}", damaged.1);
}

#[test]
fn panorama_is_refused_in_every_container() {
    let packet = b"<x xmlns:GPano=\"http://ns.google.com/photos/1.0/panorama/\" GPano:ProjectionType=\"equirectangular\"/>";
    let text = [&b"XML:com.adobe.xmp\0\0\0\0\0"[..], packet].concat();
    let packed = [&b"XML:com.adobe.xmp\0\x01\0\0\0"[..], &deflated(packet, 1)].concat();
    let mut jpeg = Vec::new();
    image::codecs::jpeg::JpegEncoder::new(&mut jpeg).encode_image(&picture()).unwrap();
    let segment = [&b"http://ns.adobe.com/xap/1.0/\0"[..], packet].concat();
    let length = (segment.len() as u16 + 2).to_be_bytes();
    let jpeg = [&jpeg[..2], &[0xff, 0xe1], &length, &segment, &jpeg[2..]].concat();
    let short = |tag, v: u32| (tag, 3u16, vec![v]);
    let bytes: Vec<u32> = packet.iter().map(|b| u32::from(*b)).collect();
    let words: Vec<u32> = bytes.chunks(2).map(|c| c[0] | c.get(1).unwrap_or(&32) << 8).collect();
    let tags = [short(258, 8), short(262, 1), short(277, 1), (700, 3, words)];
    let files = [
        (with_chunks(&picture(), &[chunk(b"iTXt", &text)]), "a.png"),
        (with_chunks(&picture(), &[chunk(b"iTXt", &packed)]), "b.png"),
        (jpeg, "c.jpg"),
        (tiff(&[(2, 1, &tags, vec![0, 9])]), "d.tif"),
    ];
    for (bytes, name) in files {
        let e = decode(bytes, Path::new(name), None).err().unwrap_or_else(|| panic!("{name} is read"));
        let text = e.to_string();
        assert!(
            text.starts_with(&format!("{name}: is a 360° panorama (GPano:ProjectionType=equirectangular)")),
            "{text}"
        );
        assert!(text.contains("v360=e:flat") && e.exit_code() == 2 && text.lines().count() == 1, "{text}");
    }
}
