//! Camera and lens data from EXIF.
use super::tiff::Directories;
use exif::{Field, In, Reader, Tag, Value};
use glam::DVec3;

/// Diagonal of the 36 × 24 mm frame of the "35 mm equivalent" (CIPA DCG-001: equal diagonal angle
/// of view), mm.
const FULL_FRAME_DIAGONAL_MM: f64 = 43.266615305567875;

/// Plausible focal lengths, relative to the long side of the image: from a 140° fisheye to a 1,000
/// mm telephoto lens on full frame. Tags outside are typing errors or placeholders.
const PLAUSIBLE_FOCAL: std::ops::Range<f64> = 0.18..28.0;

/// Camera and lens data of one file.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Lens {
    /// Focal length in pixels of the upright original, if a tag states it.
    pub focal: Option<f64>,
    /// "Make Model".
    pub camera_model: Option<String>,
    /// Name of the lens, if the name states a fisheye.
    pub fisheye: Option<String>,
    /// Unit vector of gravity in camera axes of the upright photo, as the phone measured it.
    pub gravity: Option<DVec3>,
    /// Evidence that the picture is a stitched panorama.
    pub panorama: Option<String>,
}

/// Reads camera and lens data from a raw EXIF block; a damaged block yields the readable part.
/// `size` is the size of the image in pixels, in either orientation.
pub(super) fn lens(raw: &[u8], size: (u32, u32)) -> Lens {
    let Some(tags) = Directories::of(raw) else { return Lens::default() };
    let read = Reader::new().continue_on_error(true).read_raw(tags.digest());
    match read.or_else(|e| e.distill_partial_result(|_| ())) {
        Ok(exif) => lens_of(&|tag| exif.get_field(tag, In::PRIMARY), size),
        Err(_) => Lens::default(),
    }
}

/// Look-up of the first field of a tag that describes the primary image.
type Fields<'a> = &'a dyn Fn(Tag) -> Option<&'a Field>;

fn lens_of(fields: Fields, size: (u32, u32)) -> Lens {
    Lens {
        focal: focal(fields, size),
        camera_model: camera_model(fields),
        fisheye: fisheye(fields),
        gravity: gravity(fields),
        panorama: panorama(fields),
    }
}

fn number(fields: Fields, tag: Tag) -> Option<f64> {
    let value = match &fields(tag)?.value {
        Value::Rational(v) => v.first()?.to_f64(),
        Value::SRational(v) => v.first()?.to_f64(),
        other => other.get_uint(0)? as f64,
    };
    (value.is_finite() && value > 0.0).then_some(value)
}

/// Focal length in pixels. The focal plane tags are exact where they are right; the 35 mm tag is a
/// whole number of millimetres (2 % at 26 mm) but rarely wrong. The former count only if the latter
/// agrees or is absent.
fn focal(fields: Fields, (w, h): (u32, u32)) -> Option<f64> {
    let (w, h) = (w as f64, h as f64);
    if is_cut(fields, w.max(h) / w.min(h)) {
        return None;
    }
    let plausible = |f: &f64| PLAUSIBLE_FOCAL.contains(&(f / w.max(h)));
    let equivalent = number(fields, Tag::FocalLengthIn35mmFilm)
        .map(|mm| mm / FULL_FRAME_DIAGONAL_MM * w.hypot(h))
        .filter(plausible);
    let plane = focal_plane(fields, w.max(h)).filter(plausible);
    match (plane, equivalent) {
        // 12 %: rounding of a short 35 mm figure plus the width-based equivalents of some makers.
        (Some(p), Some(e)) if (p / e).ln().abs() < 0.12 => Some(p),
        (_, Some(e)) => Some(e),
        (p, None) => p,
    }
}

/// Whether the file has another aspect than the camera wrote: it was cropped since, at an unknown
/// scale.
fn is_cut(fields: Fields, aspect: f64) -> bool {
    let side = |tag| number(fields, tag);
    let written = side(Tag::PixelXDimension).zip(side(Tag::PixelYDimension));
    // 2 %: rounding of small copies.
    written.is_some_and(|(x, y)| (x.max(y) / x.min(y) / aspect).ln().abs() > 0.02)
}

/// Focal length in pixels from FocalLength and the sensor's pixels per unit length.
fn focal_plane(fields: Fields, long_side: f64) -> Option<f64> {
    let mm = number(fields, Tag::FocalLength)?;
    let resolution = number(fields, Tag::FocalPlaneXResolution)?;
    let unit_mm = match number(fields, Tag::FocalPlaneResolutionUnit).unwrap_or(2.0) as u32 {
        2 => 25.4,
        3 => 10.0,
        4 => 1.0,
        5 => 0.001,
        _ => return None,
    };
    // The resolution counts pixels of the image as the camera wrote it; PixelXDimension states its
    // size before later scaling.
    let written = [Tag::PixelXDimension, Tag::PixelYDimension].map(|t| number(fields, t).unwrap_or(0.0));
    let written = written[0].max(written[1]);
    let scale = if written > 0.0 { long_side / written } else { 1.0 };
    Some(mm * resolution / unit_mm * scale)
}

/// Name of a fisheye lens: makers use this word, and not for other wide lenses (GoPro's "linear",
/// phones' 0.5×).
fn fisheye(fields: Fields) -> Option<String> {
    let name = ascii(fields, Tag::LensModel)?;
    let plain = name.to_lowercase().replace(['-', ' '], "");
    plain.contains("fisheye").then_some(name)
}

/// Apple writes 6 for its panoramas, a number that EXIF does not define.
fn panorama(fields: Fields) -> Option<String> {
    let processing = fields(Tag::CustomRendered).and_then(|f| f.value.get_uint(0));
    let by_apple = ascii(fields, Tag::Make).is_some_and(|make| make.starts_with("Apple"));
    (by_apple && processing == Some(6)).then(|| "EXIF CustomRendered=6".to_owned())
}

/// Accelerations of a phone that is held still, g; a moving phone does not measure gravity alone.
const STILL: std::ops::Range<f64> = 0.93..1.07;

/// Gravity from the acceleration that iPhones record: in g, in axes of the phone (right, towards
/// its top, out of its screen). The stored pictures of its back camera lie on their side: x towards
/// the phone's bottom, y towards its left.
fn gravity(fields: Fields) -> Option<DVec3> {
    let Value::Undefined(note, _) = &fields(Tag::MakerNote)?.value else { return None };
    if ascii(fields, Tag::LensModel).is_some_and(|lens| lens.to_lowercase().contains("front")) {
        return None;
    }
    let v = apple_acceleration(note).filter(|v| STILL.contains(&v.length()))?.normalize();
    let stored = DVec3::new(-v.y, -v.x, -v.z);
    match fields(Tag::Orientation).and_then(|f| f.value.get_uint(0)).unwrap_or(1) {
        1 => Some(stored),
        3 => Some(DVec3::new(-stored.x, -stored.y, stored.z)),
        6 => Some(DVec3::new(-stored.y, stored.x, stored.z)),
        8 => Some(DVec3::new(stored.y, -stored.x, stored.z)),
        // Mirrored: not written by a camera.
        _ => None,
    }
}

/// Tag 8 of Apple's maker note, three signed fractions; `None` for a note of another maker or a
/// damaged one.
fn apple_acceleration(note: &[u8]) -> Option<DVec3> {
    // A TIFF directory follows the name, a version and "MM"; its offsets count from the name.
    note.strip_prefix(b"Apple iOS\0").filter(|rest| rest.get(2..4) == Some(b"MM"))?;
    let bytes = |at: usize| note.get(at..at.checked_add(4)?)?.try_into().ok();
    let short = |at: usize| Some(u16::from_be_bytes(note.get(at..at.checked_add(2)?)?.try_into().ok()?));
    let entries = (0..usize::from(short(14)?)).map(|k| 16 + 12 * k);
    let entry = entries.into_iter().find(|at| short(*at) == Some(8))?;
    // Type 10 is the signed fraction.
    if (short(entry + 2)?, u32::from_be_bytes(bytes(entry + 4)?)) != (10, 3) {
        return None;
    }
    let values = u32::from_be_bytes(bytes(entry + 8)?) as usize;
    let value = |k: usize| {
        let part = |at: usize| Some(f64::from(i32::from_be_bytes(bytes(at)?)));
        let at = values.checked_add(8 * k)?;
        Some(part(at)? / part(at + 4)?).filter(|v| v.is_finite())
    };
    Some(DVec3::new(value(0)?, value(1)?, value(2)?))
}

fn ascii(fields: Fields, tag: Tag) -> Option<String> {
    match &fields(tag)?.value {
        Value::Ascii(v) => {
            let s = String::from_utf8_lossy(v.first()?).trim_matches(['\0', ' ']).to_string();
            (!s.is_empty()).then_some(s)
        }
        _ => None,
    }
}

fn camera_model(fields: Fields) -> Option<String> {
    match (ascii(fields, Tag::Make), ascii(fields, Tag::Model)) {
        (Some(make), Some(model)) if model.starts_with(&make) => Some(model),
        (Some(make), Some(model)) => Some(format!("{make} {model}")),
        (make, model) => model.or(make),
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use exif::Rational;
    use exif::experimental::Writer;

    /// An EXIF block (TIFF bytes) with the given fields.
    pub fn block(fields: &[(Tag, Value)]) -> Vec<u8> {
        let fields: Vec<Field> = fields
            .iter()
            .map(|(tag, value)| Field { tag: *tag, ifd_num: In::PRIMARY, value: value.clone() })
            .collect();
        let mut writer = Writer::new();
        fields.iter().for_each(|f| writer.push_field(f));
        let mut bytes = std::io::Cursor::new(Vec::new());
        writer.write(&mut bytes, true).unwrap();
        bytes.into_inner()
    }

    fn rational(num: u32, denom: u32) -> Value {
        Value::Rational(vec![Rational { num, denom }])
    }

    #[test]
    fn equivalent_focal_uses_the_diagonal() {
        let raw = block(&[
            (Tag::FocalLengthIn35mmFilm, Value::Short(vec![26])),
            (Tag::Make, Value::Ascii(vec![b"Acme".to_vec()])),
            (Tag::Model, Value::Ascii(vec![b"Phone 3".to_vec()])),
        ]);
        let lens = lens(&raw, (4000, 3000));
        assert!((lens.focal.unwrap() - 26.0 / 43.2666 * 5000.0).abs() < 0.1);
        assert_eq!(lens.camera_model.as_deref(), Some("Acme Phone 3"));
    }

    #[test]
    fn cropped_photo_has_no_focal_length() {
        let focal_of = |written: [u32; 2], size| {
            let fields = [
                (Tag::FocalLengthIn35mmFilm, Value::Short(vec![26])),
                (Tag::PixelXDimension, Value::Long(vec![written[0]])),
                (Tag::PixelYDimension, Value::Long(vec![written[1]])),
            ];
            lens(&block(&fields), size).focal
        };
        assert!(focal_of([4000, 3000], (800, 600)).is_some() && focal_of([4000, 3000], (600, 800)).is_some());
        assert!(focal_of([4000, 3000], (1500, 1500)).is_none());
    }

    #[test]
    fn focal_plane_tags_need_agreement() {
        // 50 mm on a 36 mm wide sensor of 6000 pixels: 8333 px; the file was halved since.
        let mut fields = vec![
            (Tag::FocalLength, rational(50, 1)),
            (Tag::FocalPlaneXResolution, rational(6000 * 254, 36 * 10)),
            (Tag::FocalPlaneResolutionUnit, Value::Short(vec![2])),
            (Tag::PixelXDimension, Value::Long(vec![6000])),
            (Tag::PixelYDimension, Value::Long(vec![4000])),
        ];
        let size = (3000, 2000);
        let alone = lens(&block(&fields), size).focal.unwrap();
        assert!((alone - 50.0 / 36.0 * 3000.0).abs() < 0.1, "{alone}");
        // The same sensor in pixels per centimetre.
        let mut metric = fields.clone();
        metric[1].1 = rational(6000 * 100, 36 * 10);
        metric[2].1 = Value::Short(vec![3]);
        let metric = lens(&block(&metric), size).focal.unwrap();
        assert!((metric - alone).abs() < 0.1, "{metric} {alone}");
        fields.push((Tag::FocalLengthIn35mmFilm, Value::Short(vec![85])));
        let contradicted = lens(&block(&fields), size).focal.unwrap();
        assert!((contradicted - 85.0 / 43.2666 * 3000f64.hypot(2000.0)).abs() < 0.1);
    }

    #[test]
    fn fisheye_is_detected_by_lens_name() {
        let named = |name: &str| {
            lens(&block(&[(Tag::LensModel, Value::Ascii(vec![name.into()]))]), (4000, 3000)).fisheye
        };
        assert_eq!(
            named("Samyang 8mm f/3.5 UMC Fish-Eye CS").as_deref(),
            Some("Samyang 8mm f/3.5 UMC Fish-Eye CS")
        );
        assert_eq!(named("iPhone 15 back camera 2.22mm f/2.2"), None);
    }

    /// A maker note of an iPhone with this acceleration, in thousandths of g.
    fn note(acceleration: [i32; 3]) -> Vec<u8> {
        let mut note = b"Apple iOS\0\0\x01MM".to_vec();
        for half in [2u16, 1, 9, 0, 1, 0, 4] {
            note.extend(half.to_be_bytes());
        }
        for half in [8u16, 10, 0, 3, 0, 44, 0, 0] {
            note.extend(half.to_be_bytes());
        }
        assert_eq!(note.len(), 44);
        for value in acceleration {
            note.extend(value.to_be_bytes());
            note.extend(1000i32.to_be_bytes());
        }
        note
    }

    #[test]
    fn gravity_is_in_upright_axes() {
        let gravity_of = |acceleration, orientation| {
            let fields = [
                (Tag::MakerNote, Value::Undefined(note(acceleration), 0)),
                (Tag::Orientation, Value::Short(vec![orientation])),
            ];
            lens(&block(&fields), (4000, 3000)).gravity
        };
        let near = |found: Option<DVec3>, x, y, z| {
            let found = found.unwrap();
            assert!((found - DVec3::new(x, y, z)).length() < 1e-9, "{found}");
        };
        // Upright, on its left and on its right side, upside down: always down in the photo.
        near(gravity_of([0, -1000, 0], 6), 0.0, 1.0, 0.0);
        near(gravity_of([-1000, 0, 0], 1), 0.0, 1.0, 0.0);
        near(gravity_of([1000, 0, 0], 3), 0.0, 1.0, 0.0);
        near(gravity_of([0, 1000, 0], 8), 0.0, 1.0, 0.0);
        // Upright and leaning forward, so that the camera looks down: partly ahead.
        near(gravity_of([0, -800, -600], 6), 0.0, 0.8, 0.6);
        // Rolled to the right: its right side is lower.
        near(gravity_of([600, -800, 0], 6), 0.6, 0.8, 0.0);
        assert_eq!(gravity_of([0, -1500, 0], 6), None, "shaken");
        assert_eq!(gravity_of([0, -1000, 0], 2), None, "mirrored");
        let gravity_with_lens = |lens_model: &str| {
            let fields = [
                (Tag::MakerNote, Value::Undefined(note([0, -1000, 0]), 0)),
                (Tag::LensModel, Value::Ascii(vec![lens_model.into()])),
            ];
            lens(&block(&fields), (4000, 3000)).gravity
        };
        assert!(gravity_with_lens("iPhone 15 back camera 5.96mm f/1.6").is_some());
        assert_eq!(gravity_with_lens("iPhone 15 front camera 2.69mm f/1.9"), None, "it looks the other way");
        for cut in 0..68 {
            assert_eq!(apple_acceleration(&note([0, -1000, 0])[..cut]), None);
        }
        assert!(apple_acceleration(&note([0, -1000, 0])).is_some() && apple_acceleration(&[7; 90]).is_none());
    }

    #[test]
    fn nonsense_is_ignored() {
        assert_eq!(lens(b"Exif?", (100, 100)), Lens::default());
        // Missing focal lengths, and implausible ones.
        for mm in [0, 1, 65_535] {
            let fields = [(Tag::FocalLengthIn35mmFilm, Value::Short(vec![mm]))];
            assert_eq!(lens(&block(&fields), (100, 100)).focal, None, "{mm} mm");
        }
        assert_eq!(lens(&block(&[(Tag::FocalLength, rational(1, 0))]), (100, 100)).focal, None);
    }
}
