//! Training of a scene from photos.
use super::boundary::{self, CallError, bad_argument, guard};
use super::context::SvkContext;
use super::progress::Callback;
use super::scene::{SvkScene, camera_in};
use super::types::*;
use crate::fit::Preset;
use crate::infer::installed::{Inventory, inventory};
use crate::photo::{self, MaskChoice, Photo};
use crate::pose::choose;
use crate::progress::Progress;
use crate::run::live::LiveScene;
use crate::run::sources::{
    self, DepthSources, FeatureSources, GeometrySources, MaskSources, MatchSources, SourceChoice, SourceKind,
};
use crate::run::{
    self, Compat, Extras, GeometryConfig, LanguageConfig, Method, ReconstructionConfig, TrainingConfig,
};
use crate::scene::{Camera, GivenCamera, Image, MAX_PIXELS, RgbImage};
use std::path::{Path, PathBuf};

/// Maximum distance of the rows of a photo in memory, bytes; a photo may be part of a wide image.
const MOST_ROW_BYTES: u64 = 1 << 32;
/// Maximum of bytes of a photo's file: as uncompressed 32-bit floats of the most pixels.
const MOST_ENCODED_BYTES: u64 = 16 * MAX_PIXELS;

/// Trains a scene from two or more photos. `options` may be NULL. On failure, and when the callback
/// stops it, `*scene` is NULL and the context keeps the error text. Thread-safe; several trainings
/// may run on one context and share its device.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn svk_train(
    context: *mut SvkContext,
    photos: *const SvkPhoto,
    photo_count: usize,
    options: *const SvkTrainOptions,
    scene: *mut *mut SvkScene,
) -> SvkStatus {
    // SAFETY: per the header.
    let Ok(context) = (unsafe { boundary::handle(context, "context") }) else { return SvkStatus::Argument };
    guard(&context.error, || {
        // SAFETY: per the header.
        unsafe {
            let slot = boundary::slot(scene)?;
            let options = boundary::read_or_default(options)?;
            let given = boundary::read_array(photos, photo_count)?;
            // Options are checked before the photos are read.
            let networks = inventory(&context.registry);
            let config = config(&options, &networks)?;
            let masks = boundary::path(options.photo_masks, "SvkTrainOptions.photo_masks")?;
            let progress = Callback::new(options.progress, options.user);
            let max_size = match options.max_size as usize {
                0 => photo::default_max_size(context.device.info().is_cpu),
                n if n < photo::SMALLEST_SIDE => {
                    return bad_argument(format!("SvkTrainOptions.max_size is {n}"));
                }
                n => n,
            };
            let (photos, cameras) = gather(&given, options.views as usize, masks, max_size, &progress)?;
            if !cameras.is_empty() && config.geometry.init != GeometryConfig::default().init {
                return bad_argument(
                    "cameras are given with the photos and in the options; give one of them",
                );
            }
            let cameras = cameras.into_iter().map(GivenCamera::from).collect();
            let extras = Extras { cameras, ..Extras::default() };
            let (device, registry) = (&context.device, &context.registry);
            let outcome = run::reconstruct(&config, &extras, device, registry, photos, &progress)?;
            let live = LiveScene::trained(&context.device, outcome, &context.registry)?;
            *slot = SvkScene::boxed(live);
        }
        Ok(())
    })
}

/// Reads the photos, and their cameras where they are given.
unsafe fn gather(
    given: &[SvkPhoto],
    views: usize,
    masks: Option<PathBuf>,
    max_size: usize,
    progress: &dyn Progress,
) -> Result<(Vec<Photo>, Vec<Camera>), CallError> {
    // SAFETY: per the header.
    let paths = given.iter().map(|p| unsafe { boundary::path(p.path, "SvkPhoto.path") });
    let paths = paths.collect::<Result<Vec<Option<PathBuf>>, _>>()?;
    if given.iter().any(|p| !p.mask.is_null() && p.pixels.is_null()) {
        return bad_argument(
            "SvkPhoto.mask: belongs to pixels; photos from files have a folder of masks beside theirs",
        );
    }
    let in_memory = given.iter().any(|p| !p.encoded.is_null() || !p.pixels.is_null());
    if masks.is_some() && (in_memory || paths.iter().any(Option::is_none)) {
        return bad_argument(
            "SvkTrainOptions.photo_masks: belongs to photos from files; pixels have SvkPhoto.mask",
        );
    }
    let photos = if !in_memory && paths.iter().all(Option::is_some) {
        let paths: Vec<PathBuf> = paths.into_iter().flatten().collect();
        let all = if views > 0 || paths.iter().any(|p| p.is_dir()) { None } else { Some(paths.len()) };
        let (mut chosen, _) = choose::photos(&paths, if views > 0 { Some(views) } else { all }, progress)?;
        photo::assign_masks(&mut chosen, &MaskChoice { folder: masks, ..MaskChoice::default() }, progress)?;
        photo::load_each(&chosen, max_size, progress)?
    } else {
        // SAFETY: photos of the host, as the header describes them.
        let read = |(i, (photo, path)): (usize, (&SvkPhoto, Option<PathBuf>))| unsafe {
            read_photo(photo, path, i, max_size)
        };
        let mut photos =
            given.iter().zip(paths).enumerate().map(read).collect::<Result<Vec<_>, CallError>>()?;
        photo::settle(&mut photos, &[], progress);
        photos
    };
    let mut cameras = Vec::new();
    for (photo, given) in photos.iter().zip(given).filter(|(_, g)| !g.camera.is_null()) {
        // SAFETY: per the header.
        cameras.push(Camera { name: photo.stem.clone(), ..unsafe { camera_in(given.camera) }? });
    }
    if !cameras.is_empty() && (cameras.len() != photos.len() || photos.len() != given.len()) {
        return bad_argument("SvkPhoto.camera: give a camera with every photo, or with none");
    }
    Ok((photos, cameras))
}

/// Reads one photo from its file, its file in memory, or its pixels.
unsafe fn read_photo(
    given: &SvkPhoto,
    path: Option<PathBuf>,
    index: usize,
    max_size: usize,
) -> Result<Photo, CallError> {
    let sources =
        [path.is_some(), !given.encoded.is_null(), !given.pixels.is_null()].iter().filter(|s| **s).count();
    if sources != 1 {
        return bad_argument(format!("photo {index}: set exactly one of path, encoded and pixels"));
    }
    // SAFETY: per the header.
    let name = unsafe { boundary::text(given.name, "SvkPhoto.name") }?;
    let name = PathBuf::from(name.unwrap_or_else(|| format!("photo_{index:02}")));
    if let Some(path) = path {
        return Ok(photo::load_at(&path, max_size)?);
    }
    if !given.encoded.is_null() {
        if given.encoded_bytes as u64 > MOST_ENCODED_BYTES {
            return bad_argument(format!(
                "{}: a file of {} bytes is too large for a photo; at most {MOST_ENCODED_BYTES}",
                name.display(),
                given.encoded_bytes
            ));
        }
        // SAFETY: the caller's file of that length.
        let bytes = unsafe { std::slice::from_raw_parts(given.encoded, given.encoded_bytes) };
        return Ok(photo::from_bytes(&name, bytes.to_vec(), max_size)?);
    }
    // SAFETY: per the header.
    let image = unsafe { pixels(given, &name) }?;
    let focal = (given.focal > 0.0).then_some(given.focal);
    if given.mask.is_null() {
        return Ok(photo::from_pixels(&name, &image, focal, max_size)?);
    }
    // SAFETY: one byte for each of the pixels, whose number was checked.
    let mask = unsafe { std::slice::from_raw_parts(given.mask, image.data.len()) };
    let used = mask.iter().map(|v| *v > 0).collect();
    let used = Image { width: image.width, height: image.height, data: used };
    Ok(photo::from_used_pixels(&name, &image, &used, focal, max_size)?)
}

/// Reads the pixels of a photo in memory.
unsafe fn pixels(given: &SvkPhoto, name: &Path) -> Result<RgbImage, CallError> {
    let (width, height, bytes) = (given.width as usize, given.height as usize, given.pixel_bytes as usize);
    let refuse = |reason: String| bad_argument(format!("{}: {reason}", name.display()));
    if u64::from(given.width) * u64::from(given.height) > MAX_PIXELS {
        let most = MAX_PIXELS / 1_000_000;
        return refuse(format!("{width} × {height} pixels are too many; at most {most} million"));
    }
    let packed = width.saturating_mul(bytes);
    let row = if given.row_bytes == 0 { packed } else { given.row_bytes };
    let is_image = (3..=4).contains(&bytes) && width > 0 && height > 0;
    if !is_image || row < packed || row as u64 > MOST_ROW_BYTES {
        return refuse(format!(
            "{width} × {height} pixels of {bytes} bytes in rows of {row} bytes make no image"
        ));
    }
    let length = row.checked_mul(height - 1).and_then(|rows| rows.checked_add(packed));
    let Some(length) = length.filter(|n| isize::try_from(*n).is_ok()) else {
        return refuse(format!("{height} rows of {row} bytes do not fit into memory"));
    };
    // SAFETY: the caller's rows; the last one ends with its last pixel.
    let all = unsafe { std::slice::from_raw_parts(given.pixels, length) };
    let pixel = |p: &[u8]| [p[0], p[1], p[2]].map(|v| f32::from(v) / 255.0);
    let data = all.chunks(row).flat_map(|r| r[..packed].chunks_exact(bytes).map(pixel)).collect();
    Ok(RgbImage { width, height, data })
}

/// Converts training options to a resolved configuration.
unsafe fn config(o: &SvkTrainOptions, networks: &Inventory) -> Result<ReconstructionConfig, CallError> {
    let preset = match o.preset {
        0 => None,
        1 => Some(Preset::Draft),
        2 => Some(Preset::Default),
        3 => Some(Preset::Paper),
        other => return bad_argument(format!("SvkTrainOptions.preset is {other}")),
    };
    let sh_degree = match o.sh_degree {
        0 => None,
        degree @ 1..=4 => Some(degree as u32 - 1),
        other => {
            return bad_argument(format!("SvkTrainOptions.sh_degree is {other}; an SvkShDegree, 0 to 4"));
        }
    };
    if ![0, 3, 8, 16].contains(&o.feature_dim) {
        return bad_argument(format!("SvkTrainOptions.feature_dim is {}; 3, 8 or 16", o.feature_dim));
    }
    // SAFETY: texts per the header.
    let text = |pointer, field: &str| unsafe { boundary::text(pointer, &format!("SvkTrainOptions.{field}")) };
    // SAFETY: as above.
    let path = |pointer, field: &str| unsafe { boundary::path(pointer, &format!("SvkTrainOptions.{field}")) };
    let count = |n: u64| usize::try_from(n).ok().filter(|n| *n > 0);
    let cameras = path(o.cameras, "cameras")?.map(|file| SourceChoice::with("cameras", file));
    let masks = path(o.masks, "masks")?.map(|folder| SourceChoice::with("dir", folder));
    let features = path(o.features, "features")?.map(|folder| SourceChoice::with("dir", folder));
    let config = ReconstructionConfig {
        geometry: GeometryConfig {
            init: source::<GeometrySources>(text(o.init, "init")?, cameras)?,
            depth_prior: source::<DepthSources>(text(o.depth_prior, "depth_prior")?, None)?,
        },
        training: TrainingConfig {
            preset,
            iterations: count(o.iterations),
            sh_degree,
            ignore: text(o.ignore, "ignore")?
                .iter()
                .flat_map(|list| list.lines())
                .map(str::to_owned)
                .collect(),
            seed: o.seed,
            ..TrainingConfig::default()
        },
        language: Some(LanguageConfig {
            matcher: source::<MatchSources>(text(o.matcher, "matcher")?, None)?,
            masks: source::<MaskSources>(text(o.mask_source, "mask_source")?, masks)?,
            features: source::<FeatureSources>(text(o.feature_source, "feature_source")?, features)?,
            language_iterations: count(o.language_iterations),
            feature_dim: count(u64::from(o.feature_dim)),
            method: text(o.method, "method")?.map(|name| Method::named(&name)).transpose()?,
            per_level: o.per_level != 0,
            compat: text(o.compat, "compat")?.map_or(Ok(None), |name| Compat::named(&name))?,
            ..LanguageConfig::default()
        }),
    };
    Ok(config.resolved(networks)?)
}

/// Source by name, by the file or folder of an older field, or the built-in one.
pub(super) fn source<K: SourceKind>(
    named: Option<String>,
    given: Option<SourceChoice>,
) -> Result<SourceChoice, CallError> {
    match (named, given) {
        (Some(_), Some(given)) => {
            bad_argument(format!("{}: {given} is given twice; give one of the two", K::OPTION))
        }
        (Some(text), None) => Ok(SourceChoice::from(text.as_str())),
        (None, given) => Ok(given.unwrap_or_else(sources::default::<K>)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::picture;
    use crate::progress::Silent;
    use std::ffi::CString;

    #[test]
    fn pixels_skips_row_padding() {
        // Two rows of two pixels at a distance of 8 bytes; the second ends with its last pixel.
        let bytes: [u8; 14] = [1, 2, 3, 4, 5, 6, 99, 99, 7, 8, 9, 10, 11, 12];
        // SAFETY: zero is a value.
        let none: SvkPhoto = unsafe { std::mem::zeroed() };
        let given =
            SvkPhoto { pixels: bytes.as_ptr(), pixel_bytes: 3, width: 2, height: 2, row_bytes: 8, ..none };
        // SAFETY: the bytes live as long as the call.
        let image = unsafe { pixels(&given, Path::new("a")) }.ok().unwrap();
        let expected = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0], [10.0, 11.0, 12.0]];
        assert_eq!((image.width, image.height), (2, 2));
        assert_eq!(image.data, expected.map(|p| p.map(|v| v / 255.0f32)));
    }

    #[test]
    fn mask_excludes_zero_pixels() {
        let (grey, mut mask) = (vec![90u8; 3 * 64 * 64], vec![255u8; 64 * 64]);
        mask[..64 * 10].fill(0);
        // SAFETY: zero is a value.
        let none: SvkPhoto = unsafe { std::mem::zeroed() };
        let size = SvkPhoto { pixel_bytes: 3, width: 64, height: 64, mask: mask.as_ptr(), ..none };
        let given = SvkPhoto { pixels: grey.as_ptr(), ..size };
        // SAFETY: pixels and mask live as long as the call.
        let photo = unsafe { read_photo(&given, None, 0, 64) }.ok().unwrap();
        assert!(!photo.uses(9 * 64 + 63) && photo.uses(10 * 64));
        let encoded = SvkPhoto { encoded: grey.as_ptr(), encoded_bytes: 9, ..size };
        // SAFETY: refused before anything is read.
        assert!(matches!(unsafe { gather(&[encoded], 0, None, 64, &Silent) }, Err(CallError::Argument(_))));
    }

    #[test]
    fn photo_masks_exclude_black_pixels() {
        let folder = tempfile::tempdir().unwrap();
        let masks = folder.path().join("people");
        std::fs::create_dir(&masks).unwrap();
        let plain = |grey| RgbImage { width: 64, height: 64, data: vec![[grey; 3]; 64 * 64] };
        let files = [("a", 0.3), ("b", 0.6)].map(|(name, grey)| {
            let file = folder.path().join(format!("{name}.png"));
            picture::write_png(&file, &plain(grey)).unwrap();
            CString::new(file.to_str().unwrap()).unwrap()
        });
        let mut mask = plain(1.0);
        mask.data[..64 * 10].fill([0.0; 3]);
        picture::write_png(&masks.join("a.png"), &mask).unwrap();
        // SAFETY: zero is a value.
        let none: SvkPhoto = unsafe { std::mem::zeroed() };
        let given = files.each_ref().map(|file| SvkPhoto { path: file.as_ptr(), ..none });
        // SAFETY: the paths live as long as the call.
        let read = |masks: Option<PathBuf>| unsafe { gather(&given, 0, masks, 64, &Silent) }.ok().unwrap().0;
        let (with, without) = (read(Some(masks.clone())), read(None));
        assert!(!with[0].uses(9 * 64 + 63) && with[0].uses(10 * 64) && with[1].uses(0));
        assert!(without[0].uses(0));
        let pixels = SvkPhoto { pixels: b"abc".as_ptr(), pixel_bytes: 3, width: 1, height: 1, ..none };
        // SAFETY: refused before anything is read.
        let refused = unsafe { gather(&[pixels], 0, Some(masks), 64, &Silent) };
        assert!(matches!(refused, Err(CallError::Argument(_))));
    }

    #[test]
    fn invalid_sizes_are_refused_unread() {
        // SAFETY: zero is a value.
        let none: SvkPhoto = unsafe { std::mem::zeroed() };
        let byte = 0u8;
        for (width, height, row_bytes, reason) in [
            (30_000, 30_000, 0, "too many; at most"),
            (u32::MAX, u32::MAX, 0, "too many; at most"),
            (u32::MAX, 0, 0, "make no image"),
            (2, 2, 1 << 62, "make no image"),
            (2, 2, usize::MAX, "make no image"),
            (2, 2, 5, "make no image"),
            (0, 2, 0, "make no image"),
        ] {
            let given = SvkPhoto { pixels: &byte, pixel_bytes: 4, width, height, row_bytes, ..none };
            // SAFETY: refused before the pixels are read.
            let message = match unsafe { pixels(&given, Path::new("a")) } {
                Err(CallError::Argument(text)) => text,
                _ => panic!("{width} {height} {row_bytes}"),
            };
            assert!(message.starts_with("a: ") && message.contains(reason), "{message}");
        }
        let given = SvkPhoto { encoded: &byte, encoded_bytes: usize::MAX, ..none };
        // SAFETY: as above.
        assert!(matches!(unsafe { read_photo(&given, None, 0, 64) }, Err(CallError::Argument(_))));
    }
}
