//! Adding photos to a scene: `splatvk run --add`.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
mod fixture;

use glam::{DMat3, DVec3};
use serde_json::Value;
use splatvk::format::scene_dir;
use splatvk::pose::align::pose_errors;
use splatvk::scene::{Camera, Pose};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Width of the photos: a run takes seconds, and a lemon is still recognised.
const WIDTH: u32 = 320;

struct Scene {
    folder: tempfile::TempDir,
}

impl Scene {
    /// Scene with three photos of breakfast in `photos/`.
    fn new() -> Scene {
        let scene = Scene { folder: tempfile::tempdir().unwrap() };
        std::fs::create_dir(scene.at("photos")).unwrap();
        for name in ["images/train_00", "images/train_01", "images/train_02"] {
            scene.photo(name, &scene.at("photos"));
        }
        scene
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn photo(&self, name: &str, to: &Path) -> PathBuf {
        let photo = image::open(fixture::data(&format!("breakfast/{name}.jpg"))).unwrap();
        let small = photo.resize_exact(WIDTH, WIDTH * 3 / 4, image::imageops::FilterType::Triangle);
        let path = to.join(format!("{}.png", name.rsplit('/').next().unwrap()));
        small.to_rgb8().save(&path).unwrap();
        path
    }

    fn run(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        command.current_dir(self.folder.path()).args(arguments);
        command.output().unwrap()
    }

    fn succeeds(&self, arguments: &[&str]) -> Value {
        let out = self.run(arguments);
        let stderr = String::from_utf8_lossy(&out.stderr);
        assert!(out.status.success(), "{arguments:?}: {stderr}");
        serde_json::from_slice(&out.stdout).unwrap()
    }

    fn names(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.folder.path()).unwrap();
        let mut names: Vec<String> =
            entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }
}

/// True cameras of the photos with these names; only their poses are compared.
fn truth(names: &[&str]) -> Vec<Camera> {
    let json = fixture::truth();
    names.iter().map(|name| true_camera(&json, name)).collect()
}

/// True camera of a photo, scaled to the width of the test.
fn true_camera(json: &serde_json::Value, name: &str) -> Camera {
    let frames = json["frames"].as_array().unwrap();
    let frame = frames.iter().find(|f| f["file"].as_str().unwrap().contains(name)).unwrap();
    let m = |r: usize, c: usize| frame["world_to_camera"][r][c].as_f64().unwrap();
    let column = |c: usize| DVec3::new(m(0, c), m(1, c), m(2, c));
    let k = |name: &str| frame[name].as_f64().unwrap() * f64::from(WIDTH) / 640.0;
    Camera {
        name: name.to_string(),
        width: WIDTH,
        height: WIDTH * 3 / 4,
        fx: k("fx"),
        fy: k("fy"),
        cx: k("cx"),
        cy: k("cy"),
        pose: Pose { rotation: DMat3::from_cols(column(0), column(1), column(2)), translation: column(3) },
    }
}

/// PSNR of a held-out view by `splatvk eval`, dB.
fn held_out(scene: &Scene, name: &str, view: &str) -> f64 {
    let truth = scene.at("truth");
    fixture::truth_of(&truth, |file| file.starts_with("images/") || file.contains(view));
    let report = scene.succeeds(&["eval", name, "--ground-truth", truth.to_str().unwrap(), "--json"]);
    let views = report["images"].as_array().unwrap();
    views.iter().find(|v| v["frame"].as_str().unwrap().contains(view)).unwrap()["psnr"].as_f64().unwrap()
}

fn found(record: &Value) -> u64 {
    record["statistics"]["queries"][0]["found"].as_u64().unwrap()
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn run_add_keeps_existing_scene() {
    let scene = Scene::new();
    let settings = ["--preset", "draft", "--iterations", "80", "--language-iterations", "4", "--json"];
    let made =
        scene.succeeds(&[&["run", "photos", "--out", "cup", "--query", "lemon"], &settings[..]].concat());
    let later = scene.photo("held_out/test_06", scene.folder.path());
    let before = std::fs::read(scene.at("cup/run.json")).unwrap();

    // An unrelated photo is refused by name, and leaves no files.
    let stripes = image::RgbImage::from_fn(WIDTH, WIDTH * 3 / 4, |x, y| {
        let v = ((x * x / 7 + y * 13) % 251) as u8;
        image::Rgb([v, v.wrapping_mul(3), 255 - v])
    });
    stripes.save(scene.at("elsewhere.png")).unwrap();
    let names = scene.names();
    let out = scene.run(&["run", "--add", "cup", "elsewhere.png"]);
    let stderr = String::from_utf8_lossy(&out.stderr).into_owned();
    assert_eq!(out.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("elsewhere"), "{stderr}");
    assert_eq!(scene.names(), names);

    // A photo that is in the scene already is refused, too.
    let out = scene.run(&["run", "--add", "cup", "photos/train_01.png"]);
    assert_eq!(out.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&out.stderr).contains("train_01"));

    let joined = scene.succeeds(&[&["run", "--add", "cup", later.to_str().unwrap()], &settings[..]].concat());
    assert_eq!(std::fs::read(scene.at("cup/run.json")).unwrap(), before, "the old scene stays");
    let (old, new) =
        (scene_dir::load(&scene.at("cup")).unwrap(), scene_dir::load(&scene.at("cup-2")).unwrap());

    // The world frame, the codes and the world data stay; all cameras are accurate.
    assert_eq!(new.cameras.len(), 4);
    let (a, b) = (&old.cameras[0].pose, &new.cameras[0].pose);
    assert!((a.centre() - b.centre()).length() < 1e-9 && a.rotation.abs_diff_eq(b.rotation, 1e-9));
    for (a, b) in old.cameras.iter().zip(&new.cameras) {
        assert!((a.pose.centre() - b.pose.centre()).length() < 0.01, "{a:?} {b:?}");
    }
    assert!(old.world.up.is_none() || old.world == new.world);
    let names = ["train_00", "train_01", "train_02", "test_06"];
    let errors = |cameras: &[Camera]| pose_errors(cameras, &truth(&names[..cameras.len()]), 1.0);
    let (was, is) = (errors(&old.cameras), errors(&new.cameras));
    println!("rotation {:?}° of old {:?}°", is.rotation_degrees, was.rotation_degrees);
    println!("centre {:?} of old {:?}", is.centre, was.centre);
    let worst = |v: &[f64]| v.iter().copied().fold(0.0, f64::max);
    assert!(worst(&is.rotation_degrees) < worst(&was.rotation_degrees).max(0.2), "{:?}", is.rotation_degrees);
    for (a, b) in old.language.unwrap().levels.iter().zip(&new.language.unwrap().levels) {
        let (a, b) = (&a.codebook, &b.codebook);
        assert!(b.len() >= a.len());
        assert_eq!(a.codes[..], b.codes[..a.codes.len()]);
        assert_eq!(a.embeddings[..], b.embeddings[..a.embeddings.len()]);
    }
    assert_eq!(found(&made), 3);
    assert_eq!(found(&joined), 4, "the query of the first run is asked again");
    let own = &joined["statistics"]["added"]["photos"][0];
    println!("{own}");
    assert_eq!((&own["photo"], &own["confidence"]), (&"test_06".into(), &"high".into()));

    // Views near the new photo are rendered better than before.
    let [a, b] = ["cup", "cup-2"].map(|name| held_out(&scene, name, "test_07"));
    println!("test_07: {a:.2} dB from three photos, {b:.2} dB with test_06");
    assert!(b > a, "{a} {b}");
}

#[test]
fn run_add_refuses_unsuitable_scenes() {
    let scene = Scene::new();
    let assert_refused = |arguments: &[&str], words: &str| {
        let out = scene.run(arguments);
        let stderr = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.code() == Some(2) && stderr.contains(words), "{arguments:?}: {stderr}");
    };
    assert_refused(&["run", "--add", "nowhere", "photos"], "run.json");
    assert_refused(&["run", "--add", "cup", "photos", "--init", "sfm"], "--init");
    std::fs::create_dir(scene.at("cup")).unwrap();
    std::fs::write(scene.at("cup/run.json"), r#"{"config": {"plan": {"method": "langsplat"}}}"#).unwrap();
    assert_refused(&["run", "--add", "cup", "photos"], "--method langsplat");
    std::fs::write(scene.at("cup/run.json"), r#"{"config": {"plan": {"images": "photos"}}}"#).unwrap();
    assert_refused(&["run", "--add", "cup", "photos"], "splatvk train");
    assert_eq!(scene.names(), ["cup", "photos"]);
}
