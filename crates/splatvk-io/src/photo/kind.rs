//! Format of a file by its first bytes or its name, and advice for unsupported formats.
use super::tiff::Directories;
use crate::scene::MAX_PIXELS;
use crate::{Error, Result};
use image::ImageFormat;
use std::path::Path;

/// Extensions of supported photos. OpenEXR and Radiance contain linear light.
const PHOTO: [&str; 14] =
    ["jpg", "jpeg", "jpe", "jfif", "png", "webp", "tif", "tiff", "heic", "heif", "hif", "avif", "exr", "hdr"];
const VIDEO: [&str; 14] =
    ["mp4", "m4v", "mov", "qt", "avi", "mkv", "webm", "mpg", "mpeg", "wmv", "3gp", "3g2", "mts", "m2ts"];
/// Extensions of Canon, Nikon, Sony, Olympus, Fujifilm, Panasonic, Leica, Pentax, Samsung,
/// Hasselblad, Phase One, Mamiya, Minolta, Kodak, Epson, Sigma, GoPro and Apple's and Adobe's DNG.
const RAW: [&str; 28] = [
    "dng", "cr2", "cr3", "crw", "nef", "nrw", "arw", "srf", "sr2", "orf", "raf", "rw2", "raw", "rwl", "pef",
    "srw", "3fr", "fff", "iiq", "mef", "mos", "mrw", "dcr", "kdc", "k25", "erf", "x3f", "gpr",
];
const OTHER_IMAGE: [&str; 12] =
    ["bmp", "gif", "jxl", "jp2", "j2k", "psd", "tga", "svg", "pdf", "ppm", "pgm", "insp"];

/// Supported formats, for messages.
pub(super) const READ: &str = "JPEG, PNG, HEIC, AVIF, WebP or TIFF";

/// Largest memory of a decoded file, bytes: four times the largest photo that phones write (200
/// megapixels, 8 bit).
pub(super) const LARGEST_DECODED: u64 = 2 << 30;
pub(super) const TOO_LARGE: &str = "the image needs more than 2 GiB of memory; make it smaller";

/// Refuses images of more than [`MAX_PIXELS`]: a short header can state any size.
pub(super) fn check_pixels(w: u64, h: u64) -> Result<(), String> {
    match w.saturating_mul(h) <= MAX_PIXELS {
        true => Ok(()),
        false => Err(format!(
            "{w} × {h} pixels are more than the {} million that are read; make it smaller",
            MAX_PIXELS / 1_000_000
        )),
    }
}

const RAW_ADVICE: &str = "is a camera raw file; develop it to JPEG or 16-bit TIFF";
const GIF: &str = "is a GIF; save its frames as PNG";
const BMP: &str = "is a BMP image; save it as PNG";
const JXL: &str = "is a JPEG XL image; save it as JPEG or PNG";
const JP2: &str = "is a JPEG 2000 image; save it as JPEG or PNG";
const PSD: &str = "is a Photoshop file; save it as JPEG or TIFF";

fn has_extension(path: &Path, list: &[&str]) -> bool {
    path.extension().is_some_and(|e| list.iter().any(|l| e.eq_ignore_ascii_case(l)))
}

/// Key that joins a photo to its camera, masks and renders: its file name without folder and
/// extension. Only the extensions of images are removed, so that the stem of a stem is itself, and
/// "view.2" remains distinct.
pub fn stem(file: &str) -> &str {
    let name = file.rsplit(['/', '\\']).next().unwrap_or(file);
    let picture =
        |e: &str| [&PHOTO[..], &RAW, &OTHER_IMAGE].concat().iter().any(|l| e.eq_ignore_ascii_case(l));
    match name.rsplit_once('.') {
        Some((stem, extension)) if !stem.is_empty() && picture(extension) => stem,
        _ => name,
    }
}

pub(super) fn is_photo_name(path: &Path) -> bool {
    has_extension(path, &PHOTO)
}

pub(super) fn is_video_name(path: &Path) -> bool {
    has_extension(path, &VIDEO)
}

/// Unsupported image formats, which are reported where a folder contains them.
pub(super) fn is_foreign_name(path: &Path) -> bool {
    is_raw_name(path) || has_extension(path, &OTHER_IMAGE)
}

/// Camera raw files.
pub(super) fn is_raw_name(path: &Path) -> bool {
    has_extension(path, &RAW)
}

/// Whether the format is one that phones and cameras write two of per photo, with the same stem.
/// PNG is excluded: it is used for masks and cut-outs.
pub(super) fn is_camera_format(path: &Path) -> bool {
    is_photo_name(path) && !has_extension(path, &["png", "exr", "hdr", "webp"])
}

/// Whether the name is that of a JPEG.
pub(super) fn is_jpeg_name(path: &Path) -> bool {
    has_extension(path, &["jpg", "jpeg", "jpe", "jfif"])
}

/// Whether a file without the name of a photo has the first bytes of one.
pub(super) fn begins_as_photo(path: &Path) -> bool {
    use std::io::Read as _;
    let mut start = Vec::new();
    let read = crate::files::open(path).map(|(file, _)| file.take(16).read_to_end(&mut start).is_ok());
    matches!(read, Ok(true))
        && (start.starts_with(b"\xff\xd8\xff")
            || start.starts_with(b"\x89PNG\r\n\x1a\n")
            || brand(&start) == Some(FileKind::Heif))
}

/// Longest stem, bytes: files of a scene are named after it, and camera names have 200 bytes at
/// most.
const LONGEST_STEM: usize = 196;

/// Refuses names of photos that files of a scene cannot be named after: those that are not Unicode,
/// contain control characters, or are too long.
pub fn check_name(path: &Path) -> Result<()> {
    let shown = path.to_string_lossy();
    let refuse = |what: String| {
        let start: String = shown.chars().rev().take(60).collect::<Vec<_>>().into_iter().rev().collect();
        let cut = if start.len() < shown.len() { "…" } else { "" };
        Err(Error::input(format!("{cut}{start}: {what}; rename the photo")))
    };
    let name = stem(&shown);
    if path.to_str().is_none() {
        refuse("its path is not Unicode (UTF-8), so that no file of the scene can name it".to_owned())
    } else if name.chars().any(char::is_control) {
        refuse("a control character is in its name".to_owned())
    } else if name.len() > LONGEST_STEM {
        refuse(format!("a name of {} bytes is too long, {LONGEST_STEM} are the most", name.len()))
    } else {
        Ok(())
    }
}

/// Decoder of a file, or the reason of a refusal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum FileKind {
    /// A codec of the `image` crate.
    Image(ImageFormat),
    /// HEIC, HEIF or AVIF: libheif.
    Heif,
    Video,
    /// Text that completes "NAME: ".
    Refused(&'static str),
    Unknown,
}

/// Kind of a file by its bytes; the name decides where they are ambiguous.
pub(super) fn kind(bytes: &[u8], path: &Path) -> FileKind {
    if let Some(brand) = brand(bytes) {
        return brand;
    }
    let starts = |magic: &[u8]| bytes.starts_with(magic);
    match image::guess_format(bytes) {
        Ok(ImageFormat::Tiff) if is_raw(bytes) || has_extension(path, &RAW) => {
            return FileKind::Refused(RAW_ADVICE);
        }
        Ok(
            f @ (ImageFormat::Jpeg
            | ImageFormat::Png
            | ImageFormat::WebP
            | ImageFormat::Tiff
            | ImageFormat::OpenExr
            | ImageFormat::Hdr),
        ) => return FileKind::Image(f),
        _ => {}
    }
    if starts(b"GIF8") {
        FileKind::Refused(GIF)
    } else if starts(b"BM") {
        FileKind::Refused(BMP)
    } else if starts(b"\xff\x0a") || starts(b"\0\0\0\x0cJXL ") {
        FileKind::Refused(JXL)
    } else if starts(b"\0\0\0\x0cjP  ") {
        FileKind::Refused(JP2)
    } else if starts(b"8BPS") {
        FileKind::Refused(PSD)
    } else if starts(b"FUJIFILM") || starts(b"IIRO") || starts(b"IIU\0") || has_extension(path, &RAW) {
        FileKind::Refused(RAW_ADVICE)
    } else if starts(&[0x1a, 0x45, 0xdf, 0xa3])
        || (starts(b"RIFF") && bytes.get(8..12) == Some(b"AVI "))
        || is_video_name(path)
    {
        FileKind::Video
    } else {
        FileKind::Unknown
    }
}

/// Kind of files of ISO boxes by their brand: HEIF, Canon's raw, or else a video.
fn brand(bytes: &[u8]) -> Option<FileKind> {
    const HEIF: [&[u8; 4]; 12] = [
        b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"mif2", b"msf1", b"miaf", b"avif",
        b"avis",
    ];
    if bytes.get(4..8) != Some(b"ftyp") {
        return None;
    }
    let main: &[u8; 4] = bytes.get(8..12)?.try_into().ok()?;
    Some(match main {
        b"crx " => FileKind::Refused(RAW_ADVICE),
        brand if HEIF.contains(&brand) => FileKind::Heif,
        _ => FileKind::Video,
    })
}

/// Whether a TIFF is a raw file: its first image is a thumbnail or a mosaic, and would be read as
/// the photo.
fn is_raw(bytes: &[u8]) -> bool {
    use exif::{Context, In, Tag};
    if bytes.get(8..10) == Some(b"CR") {
        return true;
    }
    let Some(digest) = Directories::of(bytes).map(|tags| tags.digest()) else { return false };
    let Ok((fields, _)) = exif::parse_exif(&digest) else { return false };
    let first =
        |tag: u16| fields.iter().find(|f| f.ifd_num == In::PRIMARY && f.tag == Tag(Context::Tiff, tag));
    // DNGVersion; a first image that is declared a reduced copy, with the real one in SubIFDs; a
    // colour filter array.
    let reduced = first(0xfe).and_then(|f| f.value.get_uint(0)).is_some_and(|v| v & 1 == 1);
    let mosaic = first(0x106).and_then(|f| f.value.get_uint(0)) == Some(32803);
    first(0xc612).is_some() || (reduced && first(0x14a).is_some()) || mosaic
}

#[cfg(test)]
mod tests {
    use super::super::exif_tags::tests::block;
    use super::*;
    use exif::{Context, Tag, Value};

    #[test]
    fn kind_is_decided_by_bytes() {
        use ImageFormat as F;
        let cases: [(&[u8], &str, FileKind); 14] = [
            (b"\0\0\0\x18ftypmp42....", "a.jpg", FileKind::Video),
            (b"\0\0\0\x14ftypqt  ....", "a.heic", FileKind::Video),
            (b"\0\0\0\x18ftypheic....", "a.jpg", FileKind::Heif),
            (b"\0\0\0\x18ftypmif1....", "a.mov", FileKind::Heif),
            (b"\0\0\0\x18ftypavif....", "a", FileKind::Heif),
            (b"\0\0\0\x18ftypcrx ....", "a.cr3", FileKind::Refused(RAW_ADVICE)),
            (b"RIFF....WEBPVP8 ", "a.png", FileKind::Image(F::WebP)),
            (b"RIFF....AVI LIST", "a.png", FileKind::Video),
            (b"\x89PNG\r\n\x1a\n", "a.jpg", FileKind::Image(F::Png)),
            (b"GIF89a", "a.jpg", FileKind::Refused(GIF)),
            (b"BM......", "a.bmp", FileKind::Refused(BMP)),
            (b"hello world, not an image", "clip.MOV", FileKind::Video),
            (b"hello world, not an image", "a.txt", FileKind::Unknown),
            (b"#?RADIANCE\n", "a.hdr", FileKind::Image(F::Hdr)),
        ];
        for (bytes, name, expected) in cases {
            assert_eq!(kind(bytes, Path::new(name)), expected, "{name}");
        }
    }

    #[test]
    fn stems_join_cameras_to_photos() {
        let cases = [
            ("images/a b.jpg", "a b"),
            ("left\\IMG_1.HEIC", "IMG_1"),
            ("sparse/cam0/a.b.jpg", "a.b"),
            ("a.b", "a.b"),
            ("a.tar.png", "a.tar"),
            ("raw.CR2", "raw"),
            ("view.2", "view.2"),
            ("x", "x"),
            (".png", ".png"),
        ];
        for (name, expected) in cases {
            assert_eq!((stem(name), stem(stem(name))), (expected, expected));
        }
    }

    #[test]
    fn unusable_photo_names_are_refused() {
        let refused = |name: &str| check_name(Path::new(name)).err().map(|e| e.to_string());
        assert_eq!(refused(&format!("f/{}.jpg", "x".repeat(196))), None);
        assert_eq!(refused(&format!("f/{}.jpg", "写".repeat(65))), None);
        for name in [
            "a\nb.jpg",
            "\u{1b}[31m.jpg",
            "f/\u{7f}.png",
            &format!("{}.jpg", "x".repeat(197)),
            &"写".repeat(66),
        ] {
            let e = refused(name).unwrap();
            assert!(e.contains("rename the photo") && e.len() < 400, "{e}");
        }
        #[cfg(unix)]
        {
            use std::os::unix::ffi::OsStrExt;
            let name = std::ffi::OsStr::from_bytes(b"caf\xe9.jpg");
            let e = check_name(Path::new(name)).unwrap_err();
            assert!(e.exit_code() == 2 && e.to_string().contains("not Unicode"), "{e}");
        }
    }

    #[test]
    fn raw_files_are_not_tiff() {
        let long = |v| Value::Long(vec![v]);
        let tiff = |tags: &[(u16, Value)]| {
            let tags: Vec<_> = tags.iter().map(|(t, v)| (Tag(Context::Tiff, *t), v.clone())).collect();
            kind(&block(&tags), Path::new("a.tif"))
        };
        assert_eq!(tiff(&[(0x100, long(10))]), FileKind::Image(ImageFormat::Tiff));
        // A page of a multi-page file may be declared reduced; it is a thumbnail only if the real
        // image is elsewhere.
        assert_eq!(tiff(&[(0xfe, long(1))]), FileKind::Image(ImageFormat::Tiff));
        assert_eq!(tiff(&[(0xc612, Value::Byte(vec![1, 4, 0, 0]))]), FileKind::Refused(RAW_ADVICE));
        assert_eq!(tiff(&[(0xfe, long(1)), (0x14a, long(99))]), FileKind::Refused(RAW_ADVICE));
        assert_eq!(tiff(&[(0x106, Value::Short(vec![32803]))]), FileKind::Refused(RAW_ADVICE));
        assert_eq!(kind(b"II*\0\x10\0\0\0CR\x02\0", Path::new("a.jpg")), FileKind::Refused(RAW_ADVICE));
    }
}
