//! Ground truth for tests: photos, cameras and depth of the breakfast set (and any set in its
//! layout).
use crate::math::Random;
use crate::photo::{self, Photo};
use crate::scene::{Camera, Lens, Pose, RgbImage};
use glam::{DMat3, DVec2, DVec3};
use std::path::{Path, PathBuf};

pub(crate) struct Truth {
    pub(crate) photos: Vec<Photo>,
    pub(crate) cameras: Vec<Camera>,
    pub(crate) mean_depth: f64,
    pub(crate) folder: PathBuf,
}

/// The breakfast set in the repository, or another set of the same layout named by
/// SPLATVK_TEST_SET.
pub(crate) fn folder() -> PathBuf {
    std::env::var_os("SPLATVK_TEST_SET").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/breakfast"),
        PathBuf::from,
    )
}

/// [`train`] of breakfast at half the size, without the larger images: detection takes a quarter of
/// the time.
pub(crate) fn small_train() -> Truth {
    let mut truth = train(&folder());
    for (photo, camera) in truth.photos.iter_mut().zip(&mut truth.cameras) {
        *photo = Photo { fine: None, ..photo::load_at(&photo.path, 320).unwrap() };
        *camera = camera.resized(320, 240);
    }
    truth
}

/// Photos, cameras and mean depth of the train split.
pub(crate) fn train(folder: &Path) -> Truth {
    let text = std::fs::read_to_string(folder.join("ground_truth.json")).unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    let mut truth =
        Truth { photos: Vec::new(), cameras: Vec::new(), mean_depth: 0.0, folder: folder.to_path_buf() };
    let mut depths = Vec::new();
    for frame in json["frames"].as_array().unwrap().iter().filter(|f| f["split"] == "train") {
        let file = frame["file"].as_str().unwrap();
        let photo = photo::load(&folder.join(file)).unwrap();
        let m = |r: usize, c: usize| frame["world_to_camera"][r][c].as_f64().unwrap();
        let column = |c: usize| DVec3::new(m(0, c), m(1, c), m(2, c));
        let k = |name: &str| frame[name].as_f64().unwrap();
        truth.cameras.push(Camera {
            name: file.to_string(),
            width: photo.image.width as u32,
            height: photo.image.height as u32,
            fx: k("fx"),
            fy: k("fy"),
            cx: k("cx"),
            cy: k("cy"),
            pose: Pose {
                rotation: DMat3::from_cols(column(0), column(1), column(2)),
                translation: column(3),
            },
        });
        let depth = depth(folder, &photo.stem);
        let known: Vec<f64> = depth.iter().filter(|z| **z > 0.0).map(|z| *z as f64).collect();
        depths.push(known.iter().sum::<f64>() / known.len() as f64);
        truth.photos.push(photo);
    }
    truth.mean_depth = depths.iter().sum::<f64>() / depths.len() as f64;
    truth
}

/// Camera z per pixel, row-major, 0 = unknown.
pub(crate) fn depth(folder: &Path, stem: &str) -> Vec<f32> {
    splatvk_io::format::npy::read_npz(folder.join(format!("depth/{stem}.npz"))).unwrap()["depth"].to_f32()
}

/// Colour between pixels; `x` and `y` are index coordinates.
pub(crate) fn bilinear(image: &RgbImage, x: f64, y: f64) -> [f32; 3] {
    let (x, y) = (x.clamp(0.0, image.width as f64 - 1.001), y.clamp(0.0, image.height as f64 - 1.001));
    let (i, j, fx, fy) = (x as usize, y as usize, x.fract() as f32, y.fract() as f32);
    std::array::from_fn(|k| {
        let top = image.at(i, j)[k] * (1.0 - fx) + image.at(i + 1, j)[k] * fx;
        let low = image.at(i, j + 1)[k] * (1.0 - fx) + image.at(i + 1, j + 1)[k] * fx;
        top * (1.0 - fy) + low * fy
    })
}

/// The photo of the same view with distortion about the image centre.
pub(crate) fn lensed(photo: &Photo, focal: f64, lens: Lens) -> Photo {
    let mut out = photo.clone();
    let (w, h) = (photo.image.width, photo.image.height);
    let middle = DVec2::new(w as f64, h as f64) * 0.5;
    for y in 0..h {
        for x in 0..w {
            let seen = (DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - middle) / focal;
            let p = lens.undistort(seen) * focal + middle;
            out.image.data[y * w + x] = bilinear(&photo.image, p.x - 0.5, p.y - 0.5);
        }
    }
    out
}

/// Random points projected into two cameras, the first of which is the world frame: centred pixels
/// with normal noise; `focal` and `noise` in the same unit.
pub(crate) fn matches_of(
    pose: &Pose,
    focal: [f64; 2],
    n: usize,
    noise: f64,
    point: impl Fn(&mut Random) -> DVec3,
) -> (Vec<DVec2>, Vec<DVec2>) {
    let mut rng = Random::new(1000);
    let project = |rng: &mut Random| {
        let p = point(rng);
        let q = pose.transform(p);
        [(p, focal[0]), (q, focal[1])]
            .map(|(p, f)| DVec2::new(p.x, p.y) * (f / p.z) + DVec2::new(rng.normal(), rng.normal()) * noise)
    };
    (0..n).map(|_| project(&mut rng)).map(|[a, b]| (a, b)).unzip()
}

/// Keypoints of the built-in network.
pub(crate) fn keypoints(xfeat: &mut splatvk_infer::xfeat::XFeat, image: &RgbImage) -> crate::Keypoints {
    let found = xfeat.detect(image, crate::MAX_KEYPOINTS).unwrap();
    crate::Keypoints {
        points: found.keypoints.iter().map(|k| DVec2::new(f64::from(k[0]), f64::from(k[1]))).collect(),
        dim: splatvk_infer::xfeat::DIM,
        descriptors: found.descriptors,
    }
}
