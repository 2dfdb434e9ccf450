//! Views of the breakfast set with their ground truth.
use std::path::PathBuf;

use glam::{DMat3, DVec3};

use splatvk_io::format::npy;
use splatvk_types::scene::{Camera, Image, Pose, RgbImage};

pub struct TestView {
    pub image: RgbImage,
    /// Object index per pixel.
    pub masks: Image<i32>,
    pub depth: Image<f32>,
    pub camera: Camera,
}

/// Folder of the set.
pub fn folder() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/breakfast")
}

fn ground_truth() -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(folder().join("ground_truth.json")).unwrap()).unwrap()
}

/// (object index, phrase) of every labelled object.
pub fn phrases() -> Vec<(i32, String)> {
    let truth = ground_truth();
    let labels = truth["labels"].as_object().unwrap();
    let mut found: Vec<_> =
        labels.iter().map(|(k, v)| (k.parse().unwrap(), v.as_str().unwrap().to_string())).collect();
    found.sort();
    found
}

pub fn train_views() -> Vec<TestView> {
    views("train")
}

/// Views of a split: "train" or "test".
pub fn views(split: &str) -> Vec<TestView> {
    let truth = ground_truth();
    let frames = truth["frames"].as_array().unwrap();
    frames.iter().filter(|f| f["split"] == split).map(view).collect()
}

fn view(frame: &serde_json::Value) -> TestView {
    let file = frame["file"].as_str().unwrap();
    let stem = PathBuf::from(file).file_stem().unwrap().to_str().unwrap().to_string();
    let photo = image::open(folder().join(file)).unwrap().to_rgb8();
    let (width, height) = (photo.width() as usize, photo.height() as usize);
    let data = photo.pixels().map(|p| p.0.map(|v| v as f32 / 255.0)).collect();
    let masks = image::open(folder().join("masks").join(format!("{stem}.png"))).unwrap().to_luma8();
    let depth = npy::read_npz(folder().join("depth").join(format!("{stem}.npz"))).unwrap()["depth"].to_f32();
    let number = |key: &str| frame[key].as_f64().unwrap();
    let matrix = |r: usize, c: usize| frame["world_to_camera"][r][c].as_f64().unwrap();
    let column = |c: usize| DVec3::new(matrix(0, c), matrix(1, c), matrix(2, c));
    let pose = Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) };
    let (fx, fy, cx, cy) = (number("fx"), number("fy"), number("cx"), number("cy"));
    TestView {
        image: RgbImage { width, height, data },
        masks: Image { width, height, data: masks.pixels().map(|p| p.0[0] as i32).collect() },
        depth: Image { width, height, data: depth },
        camera: Camera { name: stem, width: width as u32, height: height as u32, fx, fy, cx, cy, pose },
    }
}
