//! Photo loading from real files: kinds of JPEG and PNG, EXIF, and sets that are refused.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
use exif::{Tag, Value};
use image::ImageEncoder;
use splatvk::photo::{self, Photo};
use splatvk::pose::choose;
use splatvk::progress::Silent;
use splatvk::scene::RgbImage;
use std::path::{Path, PathBuf};

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

/// Compares 8-bit colours at four positions with those that Pillow 13 reads from the same files.
fn assert_colours(photo: &Photo, expected: [[u8; 3]; 4], tolerance: f32) {
    for ((x, y), e) in [(5, 5), (90, 10), (40, 50), (90, 60)].into_iter().zip(expected) {
        let c = photo.image.at(x, y).map(|v| v * 255.0);
        let off = (0..3).map(|k| (c[k] - e[k] as f32).abs()).fold(0.0, f32::max);
        assert!(off <= tolerance, "{} at ({x}, {y}): {c:?}, expected {e:?}", photo.stem);
    }
}

fn read(inputs: &[PathBuf], views: Option<usize>) -> splatvk::Result<Vec<photo::Photo>> {
    photo::load_each(&choose::photos(inputs, views, &Silent)?.0, photo::MAX_SIZE, &Silent)
}

#[test]
fn file_kinds_match_pillow() {
    // JPEG decoders may differ by rounding of the inverse DCT and of the chroma interpolation: 3 of
    // 255.
    let cmyk = photo::load(&data("photos/cmyk.jpg")).unwrap();
    assert_colours(&cmyk, [[237, 231, 211], [17, 174, 173], [124, 49, 177], [15, 15, 153]], 3.0);
    let progressive = photo::load(&data("photos/progressive.jpg")).unwrap();
    assert_colours(&progressive, [[14, 18, 247], [233, 39, 154], [105, 195, 167], [233, 233, 101]], 3.0);
    let palette = photo::load(&data("photos/palette.png")).unwrap();
    assert_colours(&palette, [[13, 11, 247], [231, 41, 156], [104, 197, 165], [231, 230, 107]], 0.01);
}

/// EXIF block with the given tags.
fn exif_of<const N: usize>(tags: [(Tag, Value); N]) -> Vec<u8> {
    let fields = tags.map(|(tag, value)| exif::Field { tag, ifd_num: exif::In::PRIMARY, value });
    let mut writer = exif::experimental::Writer::new();
    fields.iter().for_each(|f| writer.push_field(f));
    let mut raw = std::io::Cursor::new(Vec::new());
    writer.write(&mut raw, false).unwrap();
    raw.into_inner()
}

#[test]
fn tall_photo_scales_focal_length() {
    let folder = tempfile::tempdir().unwrap();
    let raw = exif_of([
        (Tag::Orientation, Value::Short(vec![6])),
        (Tag::FocalLengthIn35mmFilm, Value::Short(vec![28])),
        (Tag::Model, Value::Ascii(vec![b"Phone".to_vec()])),
    ]);
    // Stored lying on its side as 2000 × 1200 with a red left half: upright 1200 × 2000 with a red
    // upper half.
    let stored = image::RgbImage::from_fn(2000, 1200, |x, _| {
        image::Rgb(if x < 1000 { [220, 0, 0] } else { [0, 0, 220] })
    });
    let path = folder.path().join("tall.jpg");
    let mut encoder =
        image::codecs::jpeg::JpegEncoder::new_with_quality(std::fs::File::create(&path).unwrap(), 90);
    encoder.set_exif_metadata(raw).unwrap();
    encoder.encode_image(&stored).unwrap();

    let photo = photo::load(&path).unwrap();
    assert_eq!(photo.original_size, (1200, 2000));
    assert_eq!((photo.image.width, photo.image.height), (960, 1600));
    assert!(photo.image.at(480, 20)[0] > 0.8 && photo.image.at(480, 1580)[2] > 0.8, "upright");
    let expected = 28.0 / 43.2666 * 1200f64.hypot(2000.0) * 0.8;
    assert!((photo.exif_focal.unwrap() - expected).abs() < 0.1);
    assert_eq!(photo.camera_model.as_deref(), Some("Phone"));
    assert_eq!(photo.to_working.apply([1200.0, 2000.0]), [960.0, 1600.0]);
}

/// Loads a photo that only a decoder of the system reads.
fn heif(name: &str) -> Photo {
    photo::load(&data(&format!("photos/{name}")))
        .unwrap_or_else(|e| panic!("{e}\nthe tests need what tools/setup installs"))
}

#[test]
fn heif_is_read_upright_with_lens() {
    let original =
        photo::load(&data("breakfast/images/train_00.jpg")).unwrap().image.resized_by_area(160, 120);
    for name in ["turned.heic", "deep.heic", "small.avif"] {
        let photo = heif(name);
        assert_eq!((photo.image.width, photo.image.height), (160, 120), "{name}");
        let squares = photo.image.data.iter().zip(&original.data);
        let error: f64 =
            squares.map(|(a, b)| (0..3).map(|k| (a[k] - b[k]).powi(2) as f64).sum::<f64>()).sum();
        let psnr = -10.0 * (error / (3.0 * 160.0 * 120.0)).log10();
        // The encoders were set to about 35 dB; a turned or mirrored picture is below 15 dB.
        assert!(psnr > 30.0, "{name}: {psnr:.1} dB");
    }
    // This file states its rotation twice, in `irot` and in EXIF, as phones do: it is applied once.
    let turned = heif("turned.heic");
    assert!((turned.exif_focal.unwrap() - 28.0 / 43.2666 * 200.0).abs() < 0.01);
    assert_eq!(turned.camera_model.as_deref(), Some("Acme Phone 3"));
    assert_eq!(heif("deep.heic").exif_focal, None);
}

#[test]
fn heic_keeps_ten_bits() {
    let levels: std::collections::BTreeSet<u32> =
        heif("deep.heic").image.data.iter().flatten().map(|v| (v * 1023.0 * 16.0).round() as u32).collect();
    let on_the_10_bit_grid = levels.iter().filter(|v| (**v + 1) % 16 <= 2).count();
    assert!(levels.len() > 300 && on_the_10_bit_grid == levels.len(), "{} levels", levels.len());
}

#[test]
fn damaged_heif_gives_one_line() {
    for name in ["turned.heic", "small.avif"] {
        let whole = std::fs::read(data(&format!("photos/{name}"))).unwrap();
        for cut in (0..whole.len()).step_by(53) {
            let e = photo::from_bytes(Path::new(name), whole[..cut].to_vec(), photo::MAX_SIZE);
            let e = e.err().unwrap_or_else(|| panic!("{name} cut at {cut} of {} was read", whole.len()));
            let message = e.to_string();
            assert_eq!((e.exit_code(), message.lines().count()), (2, 1), "{message}");
            assert!(message.starts_with(name), "{message}");
        }
    }
}

#[test]
fn folder_is_read_in_order() {
    let photos = photo::load_all(&[data("breakfast/images")], &Silent).unwrap();
    let stems: Vec<_> = photos.iter().map(|p| p.stem.as_str()).collect();
    assert_eq!(stems, ["train_00", "train_01", "train_02", "train_03"], "held-out views must not be here");
    assert!(photos.iter().all(|p| (p.image.width, p.image.height) == (640, 480) && p.exif_focal.is_none()));
}

#[test]
fn unusable_photo_sets_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    // macOS leaves such files beside photos on a memory card.
    std::fs::write(dir.join("._a.jpg"), b"\0\x05\x16\x07").unwrap();
    assert_refused(&[dir.to_path_buf()], None, &["no photos"]);
    assert_refused(&[dir.join("nothing")], None, &["nothing", "does not exist"]);
    std::fs::write(dir.join("clip.mp4"), b"\0\0\0\x18ftypmp42").unwrap();
    assert_refused(&[dir.to_path_buf()], None, &["clip.mp4", "video"]);
    assert_refused(&[dir.join("clip.mp4")], None, &["clip.mp4", "video"]);
    let source = |i: u32| data(&format!("breakfast/images/train_{i:02}.jpg"));
    std::fs::copy(source(0), dir.join("a.jpg")).unwrap();
    assert_refused(&[dir.to_path_buf()], None, &["a.jpg", "only one photo"]);
    std::fs::copy(source(0), dir.join("b.jpg")).unwrap();
    assert_refused(&[dir.to_path_buf()], None, &["a.jpg", "b.jpg", "the same photo twice"]);
    assert_refused(&[dir.to_path_buf()], Some(3), &["--views 3", "only 2"]);
    assert_refused(&[dir.to_path_buf()], Some(1), &["--views 1"]);
    std::fs::create_dir(dir.join("c")).unwrap();
    std::fs::copy(source(1), dir.join("c/a.jpg")).unwrap();
    assert_refused(&[dir.join("a.jpg"), dir.join("c/a.jpg")], None, &["two photos with the name \"a\""]);
    image::RgbImage::new(20, 300).save(dir.join("b.png")).unwrap();
    assert_refused(&[dir.join("a.jpg"), dir.join("b.png")], None, &["b.png", "20 × 300"]);
    let mut encoder =
        image::codecs::png::PngEncoder::new(std::fs::File::create(dir.join("round.png")).unwrap());
    let lens = Value::Ascii(vec![b"Samyang 8mm f/2.8 Fisheye".to_vec()]);
    encoder.set_exif_metadata(exif_of([(Tag::LensModel, lens)])).unwrap();
    encoder.write_image(&[90; 100 * 80], 100, 80, image::ExtendedColorType::L8).unwrap();
    let named = ["round.png", "fisheye lens (Samyang 8mm f/2.8 Fisheye)"];
    assert_refused(&[dir.join("a.jpg"), dir.join("round.png")], None, &named);
    let whole = std::fs::read(source(2)).unwrap();
    std::fs::write(dir.join("b.jpg"), &whole[..whole.len() / 2]).unwrap();
    assert_refused(&[dir.join("a.jpg"), dir.join("b.jpg")], None, &["b.jpg", "cut off"]);
}

/// Expects exit code 2 and one line that contains the words.
fn assert_refused(inputs: &[PathBuf], views: Option<usize>, words: &[&str]) {
    let e = read(inputs, views).unwrap_err();
    let message = e.to_string();
    assert_eq!((e.exit_code(), message.lines().count()), (2, 1), "{message}");
    assert!(words.iter().all(|w| message.contains(w)), "{message}");
}

/// Program that makes test data; reports if it is not installed, and returns `None`.
fn program(name: &str) -> Option<std::process::Command> {
    let there = std::process::Command::new(name).arg("-version").output().is_ok();
    if !there {
        eprintln!("{name} is not installed: videos are NOT tested here");
    }
    there.then(|| std::process::Command::new(name))
}

/// The four photos as a video of twelve frames, two of them blurred; `options` precede the output.
fn make_clip(folder: &Path, name: &str, options: &[&str]) -> Option<PathBuf> {
    let frames = folder.join("frames");
    std::fs::create_dir_all(&frames).unwrap();
    // Each photo three times, like a camera at rest: repeated frames must not be chosen together.
    for i in 0..12 {
        let photo = data(&format!("breakfast/images/train_{:02}.jpg", i / 3));
        std::fs::copy(photo, frames.join(format!("{i:02}.jpg"))).unwrap();
    }
    let path = folder.join(name);
    let blur = "gblur=sigma=4:enable='eq(n,0)+eq(n,4)'";
    let mut ffmpeg = program("ffmpeg")?;
    ffmpeg.args(["-loglevel", "error", "-nostdin", "-framerate", "5", "-i"]).arg(frames.join("%02d.jpg"));
    ffmpeg.args(["-vf", blur, "-c:v", "mpeg4", "-q:v", "2", "-pix_fmt", "yuv420p"]).args(options).arg(&path);
    assert!(ffmpeg.status().unwrap().success());
    Some(path)
}

#[test]
fn video_gives_sharp_distinct_frames() {
    let folder = tempfile::tempdir().unwrap();
    let Some(path) = make_clip(folder.path(), "my.clip.mp4", &[]) else { return };
    let candidates = photo::gather(std::slice::from_ref(&path), &Silent).unwrap();
    let names: Vec<_> = candidates.iter().map(photo::Candidate::name).collect();
    assert_eq!((names.len(), names[1].as_str()), (12, "my_clip_0000200"));
    let (chosen, choice) = choose::choose(&candidates, 4, &Silent).unwrap();
    let places: Vec<usize> = chosen.iter().map(|i| i / 3).collect();
    assert_eq!(places, [0, 1, 2, 3], "one frame of each place: {choice:?}");
    assert!(!chosen.contains(&0) && !chosen.contains(&4), "blurred: {choice:?}");
    let photos = read(&[path], None).unwrap();
    assert_eq!(photos.len(), 4);
    assert!(photos.iter().all(|p| (p.image.width, p.image.height) == (640, 480) && p.exif_focal.is_none()));
    assert_eq!(photos[0].stem, names[chosen[0]]);
    // Frames equal the photos, up to the codec.
    let original = photo::load(&data("breakfast/images/train_03.jpg")).unwrap();
    let off: f64 =
        photos[3].image.data.iter().zip(&original.image.data).map(|(a, b)| (a[1] - b[1]).abs() as f64).sum();
    assert!(off / (640.0 * 480.0) < 0.03, "{}", off / (640.0 * 480.0));
}

#[test]
fn bad_videos_give_one_line() {
    let folder = tempfile::tempdir().unwrap();
    let Some(path) = make_clip(folder.path(), "clip.mp4", &[]) else { return };
    let refuse = |path: &Path, words: &[&str]| {
        let e = read(&[path.to_path_buf()], None).unwrap_err();
        let message = e.to_string();
        assert_eq!((e.exit_code(), message.lines().count()), (2, 1), "{message}");
        assert!(words.iter().all(|w| message.contains(w)), "{message}");
    };
    let whole = std::fs::read(&path).unwrap();
    std::fs::write(folder.path().join("cut.mp4"), &whole[..whole.len() / 2]).unwrap();
    refuse(&folder.path().join("cut.mp4"), &["cut.mp4", "cannot be read"]);
    std::fs::write(folder.path().join("text.mov"), b"no video at all").unwrap();
    refuse(&folder.path().join("text.mov"), &["text.mov", "cannot be read"]);
    // A list of other files under the name of a video, which ffmpeg would play by default.
    let list = "ffconcat version 1.0\nfile clip.mp4\nduration 2.4\n";
    std::fs::write(folder.path().join("list.mp4"), list).unwrap();
    refuse(&folder.path().join("list.mp4"), &["list.mp4", "cannot be read"]);
}

/// Upper left, upper right, lower left, lower right of the pictures below.
const QUADRANTS: [[u8; 3]; 4] = [[230, 40, 40], [40, 200, 60], [30, 60, 220], [240, 240, 240]];

/// Upright picture of four colours, in the given pixel format.
fn quadrants(kind: &str, (w, h): (u32, u32)) -> image::DynamicImage {
    use image::{DynamicImage, RgbImage};
    let colour = |x: u32, y: u32| QUADRANTS[usize::from(2 * x >= w) + 2 * usize::from(2 * y >= h)];
    if kind.contains("luma8") {
        // A picture of 108 megapixels must not need three bytes per pixel.
        let grey = |x, y| image::Luma([colour(x, y)[0]]);
        return image::GrayImage::from_fn(w, h, grey).into();
    }
    let rgb = DynamicImage::from(RgbImage::from_fn(w, h, |x, y| image::Rgb(colour(x, y))));
    match kind {
        "rgba8" => rgb.to_rgba8().into(),
        "rgb16" => rgb.to_rgb16().into(),
        "rgba16" => rgb.to_rgba16().into(),
        "lumaa8" => quadrants("luma8", (w, h)).to_luma_alpha8().into(),
        "luma16" => quadrants("luma8", (w, h)).to_luma16().into(),
        _ => rgb,
    }
}

/// Writes a picture that only its EXIF orientation makes upright.
fn write_turned(path: &Path, upright: &image::DynamicImage, orientation: u8) {
    let raw = exif_of([(Tag::Orientation, Value::Short(vec![u16::from(orientation)]))]);
    let mut stored = upright.clone();
    let inverse = match orientation {
        6 => 8,
        8 => 6,
        other => other,
    };
    stored.apply_orientation(image::metadata::Orientation::from_exif(inverse).unwrap());
    let file = std::io::BufWriter::new(std::fs::File::create(path).unwrap());
    let (bytes, w, h, colour) = (stored.as_bytes(), stored.width(), stored.height(), stored.color().into());
    if path.extension().unwrap() == "png" {
        let mut encoder = image::codecs::png::PngEncoder::new(file);
        encoder.set_exif_metadata(raw).unwrap();
        encoder.write_image(bytes, w, h, colour).unwrap();
    } else {
        let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(file, 95);
        encoder.set_exif_metadata(raw).unwrap();
        encoder.write_image(bytes, w, h, colour).unwrap();
    }
}

/// Loads a picture of four colours and compares it with the original.
fn check_quadrants(path: &Path, kind: &str, (w, h): (u32, u32)) {
    let named = format!("{} {w} × {h}", path.display());
    let photo = match photo::load(path) {
        Ok(photo) => photo,
        Err(error) => {
            let text = error.to_string();
            assert!(w.min(h) < photo::SMALLEST_SIDE as u32, "{named}: {text}");
            assert!(
                error.exit_code() == 2 && text.lines().count() == 1 && text.contains("too few"),
                "{text}"
            );
            return;
        }
    };
    assert!(w.min(h) >= photo::SMALLEST_SIDE as u32, "{named}");
    assert_eq!(photo.original_size, (w, h), "{named}");
    let (pw, ph) = (photo.image.width, photo.image.height);
    // The longer side is capped unless the shorter one falls below the minimum of the networks.
    let fits = pw.max(ph) <= photo::MAX_SIZE || pw.min(ph) == photo::SMALLEST_SIDE;
    assert!(fits && pw.min(ph) >= photo::SMALLEST_SIDE, "{named}: {pw} × {ph}");
    assert_quadrants(&photo.image, kind, &named);
}

/// Compares the colours in the middle of each quadrant.
fn assert_quadrants(picture: &RgbImage, kind: &str, named: &str) {
    let (w, h) = (picture.width, picture.height);
    for (k, colour) in QUADRANTS.into_iter().enumerate() {
        let expected = if kind.contains("luma") { [colour[0]; 3] } else { colour };
        let seen = picture.at(w / 4 + k % 2 * (w / 2), h / 4 + k / 2 * (h / 2)).map(|v| 255.0 * v);
        let off = (0..3).map(|c| (seen[c] - f32::from(expected[c])).abs()).fold(0.0, f32::max);
        assert!(off < 4.0, "{named}, quadrant {k}: {seen:?}, expected {expected:?}");
    }
}

#[test]
fn thumbnail_covers_whole_photo() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    quadrants("rgb8", (640, 480)).save(&path).unwrap();
    // At a tenth of the size not all pixels are sampled.
    let small = photo::Candidate::file(&path).thumbnail(64, &Silent).unwrap().unwrap();
    assert_eq!((small.width, small.height), (64, 48));
    assert_quadrants(&small, "rgb8", "small version");
}

#[test]
fn plain_frame_is_filled_by_picture() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("framed.png");
    let mut framed = quadrants("rgb8", (128, 96)).to_rgb8();
    for (x, y, pixel) in framed.enumerate_pixels_mut() {
        if !(3..125).contains(&x) || !(3..93).contains(&y) {
            *pixel = image::Rgb([255; 3]);
        }
    }
    framed.save(&path).unwrap();
    let photo = photo::load(&path).unwrap();
    assert!(!photo.border.is_none());
    let corners = [(0, 0), (127, 0), (0, 95), (127, 95)].map(|(x, y)| photo.image.at(x, y));
    assert_eq!(corners, QUADRANTS.map(|c| c.map(|v| f32::from(v) / 255.0)));
}

#[test]
fn all_photo_variants_load_upright() {
    let folder = tempfile::tempdir().unwrap();
    let sizes = [(1, 1), (1, 4000), (63, 64), (64, 64), (65, 4096), (4099, 67), (640, 481), (2001, 1203)];
    let kinds = [
        "rgb8.png",
        "rgba8.png",
        "rgb16.png",
        "rgba16.png",
        "luma8.png",
        "lumaa8.png",
        "luma16.png",
        "rgb8.jpg",
        "luma8.jpg",
    ];
    for (i, size) in sizes.into_iter().enumerate() {
        for (j, file) in kinds.into_iter().enumerate() {
            // Every size with every kind; with nine kinds, all eight orientations occur with each
            // size and each kind.
            let orientation = 1 + (i + j) as u8 % 8;
            let (kind, _) = file.split_once('.').unwrap();
            let path = folder.path().join(format!("{i}-{orientation}-{file}"));
            write_turned(&path, &quadrants(kind, size), orientation);
            check_quadrants(&path, kind, size);
        }
    }
    // 108 megapixels, as the largest sensors of phones produce.
    let path = folder.path().join("large-luma8.jpg");
    write_turned(&path, &quadrants("luma8", (12_000, 9_000)), 6);
    check_quadrants(&path, "luma8", (12_000, 9_000));
}

#[test]
fn colours_follow_icc_profile() {
    let folder = tempfile::tempdir().unwrap();
    let icc = moxcms::ColorProfile::new_display_p3().encode().unwrap();
    let picture = quadrants("rgb8", (128, 96));
    let mut seen = Vec::new();
    for (name, profile) in [("plain.jpg", None), ("p3.jpg", Some(&icc)), ("p3.png", Some(&icc))] {
        let path = folder.path().join(name);
        let file = std::fs::File::create(&path).unwrap();
        let (bytes, colour) = (picture.as_bytes(), picture.color().into());
        if name.ends_with("png") {
            let mut encoder = image::codecs::png::PngEncoder::new(file);
            profile.into_iter().for_each(|icc| encoder.set_icc_profile(icc.clone()).unwrap());
            encoder.write_image(bytes, 128, 96, colour).unwrap();
        } else {
            let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(file, 95);
            profile.into_iter().for_each(|icc| encoder.set_icc_profile(icc.clone()).unwrap());
            encoder.write_image(bytes, 128, 96, colour).unwrap();
        }
        seen.push(photo::load(&path).unwrap().image.at(96, 24).map(|v| 255.0 * v));
    }
    // The green of Display P3 has less red in sRGB: none, since it lies outside the gamut.
    assert!((seen[0][0] - 40.0).abs() < 4.0 && seen[1][0] < 4.0 && seen[2][0] < 1.0, "{seen:?}");
    assert!((seen[1][1] - seen[2][1]).abs() < 4.0, "{seen:?}");
}

/// `small.avif` with an ICC profile: a fifth property of its only item (ISO/IEC 23008-12).
fn avif_with(icc: &[u8]) -> Vec<u8> {
    let mut file = std::fs::read(data("photos/small.avif")).unwrap();
    let box_start = |name: &[u8; 4]| file.windows(4).position(|w| w == name).unwrap() - 4;
    let [meta, iloc, iprp, ipco, ipma] = [b"meta", b"iloc", b"iprp", b"ipco", b"ipma"].map(box_start);
    let number = |file: &[u8], at: usize| u32::from_be_bytes(file[at..at + 4].try_into().unwrap());
    let end = ipma + number(&file, ipma) as usize;
    let colr = [&(icc.len() as u32 + 12).to_be_bytes()[..], b"colrprof", icc].concat();
    let grown = colr.len() as u32;
    // Sizes of the boxes, and in `iloc` the offset of the pixels.
    for (at, by) in [(meta, grown + 1), (iloc + 20, grown + 1), (iprp, grown + 1), (ipco, grown), (ipma, 1)] {
        let value = number(&file, at) + by;
        file[at..at + 4].copy_from_slice(&value.to_be_bytes());
    }
    // The item's list of property indices.
    file[ipma + 18] += 1;
    file.insert(end, 5);
    file.splice(ipma..ipma, colr);
    file
}

#[test]
fn avif_profile_matches_png() {
    let folder = tempfile::tempdir().unwrap();
    let icc = moxcms::ColorProfile::new_display_p3().encode().unwrap();
    let avif = photo::from_bytes(Path::new("p3.avif"), avif_with(&icc), photo::MAX_SIZE).unwrap();
    let plain = heif("small.avif").image;
    let (w, h) = (plain.width as u32, plain.height as u32);
    let bytes: Vec<u8> = plain.data.as_flattened().iter().map(|v| (255.0 * v).round() as u8).collect();
    let path = folder.path().join("p3.png");
    let mut encoder = image::codecs::png::PngEncoder::new(std::fs::File::create(&path).unwrap());
    encoder.set_icc_profile(icc).unwrap();
    encoder.write_image(&bytes, w, h, image::ExtendedColorType::Rgb8).unwrap();
    let png = photo::load(&path).unwrap();
    assert!(avif.image == png.image, "other colours");
    assert!(avif.image != plain, "the profile changes nothing here");
}

#[test]
fn avif_code_points_are_used() {
    let mut file = std::fs::read(data("photos/small.avif")).unwrap();
    let at = file.windows(8).position(|w| w == b"colrnclx").unwrap() + 8;
    let plain = heif("small.avif").image;
    let bytes: Vec<u8> = plain.data.as_flattened().iter().map(|v| (255.0 * v).round() as u8).collect();
    // BT.2020 with PQ, Display P3, and unspecified.
    for [primaries, transfer] in [[9u8, 16], [12, 13], [2, 2]] {
        (file[at + 1], file[at + 3]) = (primaries, transfer);
        let avif = photo::from_bytes(Path::new("a.avif"), file.clone(), photo::MAX_SIZE).unwrap();
        let mut png = Vec::new();
        let encoder = image::codecs::png::PngEncoder::new(&mut png);
        let (w, h) = (plain.width as u32, plain.height as u32);
        encoder.write_image(&bytes, w, h, image::ExtendedColorType::Rgb8).unwrap();
        let mut chunk = [b"cICP", &[primaries, transfer, 0, 1][..]].concat();
        let mut sum = flate2::Crc::new();
        sum.update(&chunk);
        chunk.splice(0..0, 4u32.to_be_bytes());
        chunk.extend(sum.sum().to_be_bytes());
        png.splice(33..33, chunk);
        let png = photo::from_bytes(Path::new("a.png"), png, photo::MAX_SIZE).unwrap();
        assert!(avif.image == png.image, "primaries {primaries}, transfer {transfer}: other colours");
        assert_eq!(avif.image == plain, transfer == 2);
    }
}

/// Mean difference between the largest and the smallest channel, in steps of 8 bits.
fn saturation(image: &RgbImage) -> f32 {
    let clipped = |c: &[f32; 3]| c.map(|v| 255.0 * v.clamp(0.0, 1.0));
    let spread = |c: [f32; 3]| c[0].max(c[1]).max(c[2]) - c[0].min(c[1]).min(c[2]);
    image.data.iter().map(|c| spread(clipped(c))).sum::<f32>() / image.data.len() as f32
}

#[test]
fn hdr_video_matches_photo_colours() {
    let folder = tempfile::tempdir().unwrap();
    let original = photo::load(&data("breakfast/images/train_00.jpg")).unwrap().image;
    let to_2020 = [[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0114], [0.0164, 0.088, 0.8956f32]];
    let pixels = original.data.iter().flat_map(|c| {
        let light = c.map(splatvk::scene::to_linear);
        to_2020.map(|r| (65535.0 * hlg((0..3).map(|k| r[k] * light[k]).sum::<f32>().max(0.0))) as u16)
    });
    let (w, h) = (original.width as u32, original.height as u32);
    let frame =
        image::ImageBuffer::<image::Rgb<u16>, _>::from_raw(w, h, pixels.collect::<Vec<u16>>()).unwrap();
    for k in 0..2 {
        image::DynamicImage::from(frame.clone()).save(folder.path().join(format!("{k}.png"))).unwrap();
    }
    let path = folder.path().join("hlg.mkv");
    let Some(mut ffmpeg) = program("ffmpeg") else { return };
    ffmpeg
        .args(["-loglevel", "error", "-nostdin", "-framerate", "2", "-i"])
        .arg(folder.path().join("%d.png"));
    ffmpeg.args(["-vf", "scale=out_color_matrix=bt2020:out_range=tv,format=yuv420p10le", "-c:v", "ffv1"]);
    ffmpeg.args(["-color_trc", "arib-std-b67", "-color_primaries", "bt2020", "-colorspace", "bt2020nc"]);
    assert!(ffmpeg.args(["-color_range", "tv"]).arg(&path).status().unwrap().success());
    let candidates = photo::gather(&[path], &Silent).unwrap();
    let seen = candidates[0].load(photo::MAX_SIZE, &Silent).unwrap().image;
    let (found, right) = (saturation(&seen), saturation(&original));
    assert!((found / right - 1.0).abs() < 0.03, "saturation {found}, that of the photo is {right}");
    let off: f32 =
        seen.data.as_flattened().iter().zip(original.data.as_flattened()).map(|(a, b)| (a - b).abs()).sum();
    let off = off / (3 * w * h) as f32;
    assert!(off < 0.02, "colours differ by {off} on average");
}

/// Hybrid log-gamma signal of linear light; diffuse white is at 0.75 of the signal: ITU-R BT.2408.
fn hlg(l: f32) -> f32 {
    let e = l * 0.265;
    if e <= 1.0 / 12.0 {
        (3.0 * e).sqrt()
    } else {
        0.178_832_77 * (12.0 * e - 0.284_668_92).ln() + 0.559_910_7
    }
}

#[test]
fn nonfinite_pixels_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let paths = ["a.exr", "b.exr"].map(|n| folder.path().join(n));
    for (k, path) in paths.iter().enumerate() {
        let mut picture = image::Rgb32FImage::from_fn(64, 64, |x, y| {
            image::Rgb([x as f32 / 64.0, y as f32 / 64.0, k as f32 / 2.0])
        });
        if k == 1 {
            picture.get_pixel_mut(3, 5).0[1] = f32::NAN;
            picture.get_pixel_mut(4, 5).0 = [f32::INFINITY; 3];
        }
        image::DynamicImage::from(picture).save(path).unwrap();
    }
    let recorded = splatvk::progress::Recorded::new(&Silent);
    let photos = photo::load_all(&paths, &recorded).unwrap();
    let warning = "b: 2 of its pixels are not finite numbers and are read as black";
    assert_eq!(recorded.warnings(), [warning]);
    assert!(photos[1].image.at(3, 5)[1] == 0.0 && photos[1].image.at(4, 5) == [0.0; 3]);
}
