//! Synthetic scenes on disk, in the layout of a ground-truth folder.
use super::outdoor::Sky;
use super::photos::{self, Photos};
use super::regions::{self, InjectedErrors};
use super::render::{self, RayCast};
use super::scene::{SceneSpec, SyntheticScene};
use crate::{Error, Result};
use half::f16;
use serde_json::json;
use splatvk::eval::{GroundTruth, Split, TruthFrame};
use splatvk::format::npy::{self, NpyArray, NpyData};
use splatvk::format::picture::Jpeg;
use splatvk::format::{cameras, create_folder, picture, write_json};
use splatvk::progress::Progress;
use splatvk::scene::{Camera, RgbImage};
use splatvk_types::files;
use std::path::Path;

/// Folders of regions without and with injected errors.
const REGIONS: [&str; 2] = ["regions_exact", "regions_flawed"];

/// Folder of the photos without the walker.
pub const CLEAN: &str = "clean";

/// Folder of masks of the photos for `--photo-masks`: black where the walker is.
pub const USED: &str = "used";

/// File of the ground truth.
const TRUTH: &str = "ground_truth.json";

/// File of text embeddings in a folder of regions.
const TEXTS: &str = "text_embeddings.npz";

/// JPEG quality of held-out views, and by default of photos: no visible artefacts.
const QUALITY: u8 = 95;

/// Entries that [`generate`] and [`write_regions`] do not write, as paths relative to `folder`;
/// `None` where neither of them made the folder.
pub fn foreign(folder: &Path) -> Option<Vec<String>> {
    let truth: Option<serde_json::Value> = files::read_json(&folder.join(TRUTH), "").ok();
    // Other data sets may have the same layout; only generated ones have the key "knobs".
    let knobs = truth.as_ref().is_some_and(|truth| !truth["knobs"].is_null());
    let regions = |name: &str| folder.join(name).join(TEXTS).is_file();
    if !REGIONS.into_iter().all(regions) || truth.is_some() && !knobs {
        return None;
    }
    let views = truth.as_ref().and_then(|truth| truth["frames"].as_array());
    let views: Option<Vec<&str>> = views.map(|v| v.iter().filter_map(|f| f["file"].as_str()).collect());
    Some(files::foreign(folder, &|name, is_folder| is_own(name, is_folder, views.as_deref())))
}

/// Whether a path belongs to generated data with these views; `None`: to regions alone, which may
/// have any views.
fn is_own(name: &str, is_folder: bool, views: Option<&[&str]>) -> bool {
    let Some((folder, file)) = name.rsplit_once('/') else {
        let folders: &[&str] =
            if views.is_some() { &["images", "held_out", "depth", "masks", CLEAN, USED] } else { &[] };
        return match is_folder {
            true => REGIONS.contains(&name) || folders.contains(&name),
            false => views.is_some() && [TRUTH, "cameras_noisy.json"].contains(&name),
        };
    };
    let plain = |view: &str| view.rsplit('/').next().and_then(|v| v.strip_suffix(".jpg")).map(str::to_owned);
    let is_view = |stem: &str| views.is_none_or(|all| all.iter().filter_map(|v| plain(v)).any(|v| v == stem));
    let stem = |ending: &str| file.strip_suffix(ending).is_some_and(is_view);
    !is_folder
        && match folder {
            "images" | "held_out" => views.is_some_and(|all| all.contains(&name)),
            CLEAN => stem(".jpg"),
            "depth" => stem(".npz"),
            "masks" | USED => stem(".png"),
            _ => REGIONS.contains(&folder) && (file == TEXTS || stem("_s.npy") || stem("_f.npy")),
        }
}

/// Makes a scene and writes it: photos, held-out views, depth, masks, cameras, and regions without
/// and with injected errors. With a walker, the photos show it and everything else does not.
pub fn generate(
    folder: &Path,
    spec: &SceneSpec,
    flaws: &InjectedErrors,
    progress: &dyn Progress,
) -> Result<()> {
    let scene = photos::build(spec)?;
    let walked: &[&str] = if spec.walker { &[CLEAN, USED] } else { &[] };
    for name in ["images", "held_out", "depth", "masks"].iter().chain(walked) {
        create_folder(&folder.join(name))?;
    }
    let frames = write_views(folder, &scene, spec, progress)?;
    let named = scene.objects.iter().map(|t| (t.label, t.phrase.as_str()));
    let named = named.chain(scene.sky.iter().map(|s| (s.label, Sky::PHRASE)));
    let labels: serde_json::Map<String, serde_json::Value> =
        named.map(|(label, phrase)| (label.to_string(), json!(phrase))).collect();
    let truth = json!({
        "width": spec.size.0, "height": spec.size.1, "labels": labels,
        "convention": "OpenCV world-to-camera, metres, pinhole", "up": [0.0, 0.0, 1.0], "frames": frames, "knobs": spec,
    });
    write_json(&folder.join(TRUTH), &truth)?;
    cameras::write_json(&folder.join("cameras_noisy.json"), &scene.noisy)?;
    write_regions(folder, folder, flaws)
}

/// Renders and writes every view; returns the frames of the ground truth.
fn write_views(
    folder: &Path,
    scene: &SyntheticScene,
    spec: &SceneSpec,
    progress: &dyn Progress,
) -> Result<Vec<serde_json::Value>> {
    let quality = spec.effects.jpeg.unwrap_or(QUALITY);
    // Where photos have effects of a phone camera, held-out views are free of noise.
    let held_out_noise = if spec.effects.any() { 0.0 } else { spec.photo_noise };
    let held_out = scene.test.iter().map(|c| (c, Split::Test));
    let held_out: Vec<(&Camera, Split)> = held_out.chain(scene.out.iter().map(|c| (c, Split::Out))).collect();
    let total = scene.photo_effects.len() + held_out.len();
    progress.begin("render", total as u64);
    let shown = Photos::new(scene, spec)?;
    let mut frames = Vec::new();
    for i in 0..total {
        progress.check()?;
        let seed = spec.seed.wrapping_add(i as u64);
        frames.push(match scene.photo_effects.get(i) {
            Some(effects) => {
                let jpeg = Jpeg { quality, exif: shown.exif(i)? };
                let mut seen = shown.render(i, seed);
                if let Some(passed) = shown.passed(i, seed) {
                    let name = &effects.camera.name;
                    write_jpeg(&folder.join(CLEAN).join(format!("{name}.jpg")), &seen.image, jpeg.clone())?;
                    picture::write_mask_png(&folder.join(USED).join(format!("{name}.png")), &passed.used)?;
                    seen.image = passed.image;
                }
                let file = write_view(folder, &effects.camera, Split::Train, &seen, jpeg)?;
                let mut frame = frame_json(&effects.camera, Split::Train, &file);
                if let Some(lens) = &effects.lens {
                    frame["lens"] = json!(lens);
                }
                if let Some(light) = &effects.light {
                    frame["light"] = json!(light);
                }
                frame
            }
            None => {
                let (camera, split) = held_out[i - scene.photo_effects.len()];
                let seen = render::render(scene, camera, held_out_noise, seed);
                let file = write_view(folder, camera, split, &seen, Jpeg { quality: QUALITY, exif: None })?;
                frame_json(camera, split, &file)
            }
        });
        progress.step(i as u64 + 1, "");
    }
    progress.end();
    Ok(frames)
}

/// Writes `regions_exact/` and `regions_flawed/` for the photos of a ground-truth folder that has
/// masks.
pub fn write_regions(data: &Path, out: &Path, flaws: &InjectedErrors) -> Result<()> {
    let truth = GroundTruth::read(data)?;
    let photos: Vec<&TruthFrame> = truth.frames.iter().filter(|f| f.split == Split::Train).collect();
    let phrases: Vec<String> = truth.labels.values().cloned().collect();
    for (name, flaws) in REGIONS.into_iter().zip([&InjectedErrors::NONE, flaws]) {
        regions::write(&out.join(name), &photos, &regions::regions(&truth, &photos, flaws)?, &phrases)?;
    }
    Ok(())
}

fn write_jpeg(path: &Path, image: &RgbImage, jpeg: Jpeg) -> Result<()> {
    std::fs::write(path, picture::jpeg_bytes(image, jpeg)?).map_err(Error::unwritable(path))
}

fn write_view(folder: &Path, camera: &Camera, split: Split, seen: &RayCast, jpeg: Jpeg) -> Result<String> {
    let place = if split == Split::Train { "images" } else { "held_out" };
    let (name, file) = (&camera.name, format!("{place}/{}.jpg", camera.name));
    write_jpeg(&folder.join(&file), &seen.image, jpeg)?;
    let shape = vec![seen.depth.height, seen.depth.width];
    let depth = NpyData::F16(seen.depth.data.iter().map(|z| f16::from_f32(*z)).collect());
    let path = folder.join("depth").join(format!("{name}.npz"));
    npy::write_npz(path, &[("depth", &NpyArray { shape, data: depth })])?;
    let path = folder.join("masks").join(format!("{name}.png"));
    let bytes: Vec<u8> = seen.objects.data.iter().map(|&o| o as u8).collect();
    let size = (seen.objects.width, seen.objects.height);
    picture::write_grey_bytes(&path, size, &bytes)?;
    Ok(file)
}

fn frame_json(c: &Camera, split: Split, file: &str) -> serde_json::Value {
    let (r, t) = (c.pose.rotation, c.pose.translation);
    let matrix_row = |k: usize| [r.x_axis[k], r.y_axis[k], r.z_axis[k], t[k]];
    json!({
        "split": split, "file": file, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
        "world_to_camera": [matrix_row(0), matrix_row(1), matrix_row(2), [0.0, 0.0, 0.0, 1.0]],
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generate::{Effects, build_scene};
    use glam::DVec2;
    use splatvk::progress::Silent;
    use splatvk::scene::Lens;

    #[test]
    fn generate_reads_back_as_ground_truth() {
        let dir = tempfile::tempdir().unwrap();
        let spec = SceneSpec {
            seed: 1000,
            size: (160, 120),
            views: 3,
            held_out: 2,
            beyond: true,
            ..SceneSpec::default()
        };
        generate(dir.path(), &spec, &InjectedErrors::default_rates(1000), &Silent).unwrap();
        let truth = GroundTruth::read(dir.path()).unwrap();
        let made = build_scene(&spec).unwrap();
        assert_eq!((truth.frames.len(), truth.labels.len()), (13, made.objects.len()));
        assert_eq!(truth.up, Some(glam::DVec3::Z));
        assert_eq!(truth.frames.iter().filter(|f| f.split == Split::Out).count(), 8);
        let cameras = made.train.iter().chain(&made.test).chain(&made.out);
        for (frame, camera) in truth.frames.iter().zip(cameras) {
            assert_eq!(frame.stem, camera.name);
            assert!((frame.camera.pose.centre() - camera.pose.centre()).length() < 1e-12);
            let seen = render::render(&made, camera, 0.0, 0);
            assert_eq!(truth.objects(frame).unwrap().unwrap(), seen.objects);
            let depth = truth.depth(frame).unwrap().unwrap();
            // float16 has 11 bits
            assert!(depth.data.iter().zip(&seen.depth.data).all(|(a, b)| (a - b).abs() <= b * 5e-4));
            let photo = truth.image(frame).unwrap();
            assert!(splatvk::pass::metrics::psnr(&photo, &seen.image) > 30.0);
        }
        assert_eq!(foreign(dir.path()), Some(Vec::new()));
        for name in ["letter", "images/IMG_1.jpg", "images/train_00.txt", "regions_exact/mine_s.npy", "depth"]
        {
            let path = dir.path().join(name);
            let _ = std::fs::rename(&path, dir.path().join("aside"));
            std::fs::write(&path, "precious").unwrap();
            let found = foreign(dir.path()).unwrap();
            assert!(found.iter().any(|f| f == name), "{name} is not in {found:?}");
            std::fs::remove_file(&path).unwrap();
            let _ = std::fs::rename(dir.path().join("aside"), &path);
        }
        let noisy = cameras::read(&dir.path().join("cameras_noisy.json")).unwrap();
        assert_eq!(noisy.len(), 3);
        for name in ["regions_exact", "regions_flawed"] {
            let photo = splatvk::photo::load(&dir.path().join("images/train_01.jpg")).unwrap();
            let view = splatvk::language::dir::read_view(&dir.path().join(name), &photo, true).unwrap();
            assert!(view.levels.iter().all(|l| !l.quality.is_empty()));
        }
    }

    #[test]
    fn jpeg_quality_applies_to_photos_only() {
        let file_sizes = |jpeg: Option<u8>| {
            let dir = tempfile::tempdir().unwrap();
            let effects = Effects { jpeg, ..Effects::default() };
            let spec = SceneSpec {
                seed: 1000,
                size: (160, 120),
                views: 2,
                held_out: 1,
                photo_noise: 0.0,
                effects,
                ..SceneSpec::default()
            };
            generate(dir.path(), &spec, &InjectedErrors::NONE, &Silent).unwrap();
            ["images/train_00.jpg", "held_out/test_02.jpg"]
                .map(|f| dir.path().join(f).metadata().unwrap().len())
        };
        let (default, coarse) = (file_sizes(None), file_sizes(Some(5)));
        assert!(2 * coarse[0] < default[0] && coarse[1] == default[1], "{default:?} {coarse:?}");
    }

    /// Bilinear sample of an image; `None` outside the pixel centres.
    fn bilinear(image: &splatvk::scene::RgbImage, at: DVec2) -> Option<[f32; 3]> {
        let (x, y) = (at.x - 0.5, at.y - 0.5);
        let inside = x >= 0.0 && y >= 0.0 && x + 1.0 < image.width as f64 && y + 1.0 < image.height as f64;
        inside.then(|| {
            let (i, j, fx, fy) = (x as usize, y as usize, x.fract() as f32, y.fract() as f32);
            let along_x = |j: usize, c: usize| image.at(i, j)[c] * (1.0 - fx) + image.at(i + 1, j)[c] * fx;
            [0, 1, 2].map(|c| along_x(j, c) * (1.0 - fy) + along_x(j + 1, c) * fy)
        })
    }

    #[test]
    fn stated_lens_undistorts_photos() {
        let dir = tempfile::tempdir().unwrap();
        let effects = Effects { focal: true, lens: true, centre: true, ..Effects::default() };
        let spec = SceneSpec {
            seed: 1003,
            size: (320, 240),
            views: 2,
            held_out: 1,
            effects,
            photo_noise: 0.0,
            ..SceneSpec::default()
        };
        generate(dir.path(), &spec, &InjectedErrors::NONE, &Silent).unwrap();
        let truth = GroundTruth::read(dir.path()).unwrap();
        let made = build_scene(&spec).unwrap();
        let frame = &truth.frames[0];
        let stated = frame.lens.unwrap();
        let photo = truth.image(frame).unwrap();
        let pinhole = render::render(&made, &frame.camera, 0.0, 0).image;
        // Mean square difference to the pinhole image after undistortion with a lens.
        let error = |lens: Lens| {
            let (mut sum, mut count) = (0.0, 0);
            for p in 0..320 * 240 {
                let pixel = DVec2::new((p % 320) as f64 + 0.5, (p / 320) as f64 + 0.5);
                let point = frame.camera.unproject(pixel, 1.0);
                let Some(shown) = bilinear(&photo, lens.project(&frame.camera, point)) else { continue };
                sum += (0..3).map(|c| f64::from(shown[c] - pinhole.data[p][c]).powi(2)).sum::<f64>();
                count += 1;
            }
            sum / f64::from(count)
        };
        let (undistorted, ignored) = (error(stated), error(Lens::NONE));
        assert!(undistorted < 0.25 * ignored, "{undistorted} {ignored}");
        assert!(truth.frames[2].lens.is_none() && stated.k1.abs() > 0.02, "{stated:?}");
    }
}
