//! `--ignore`: things found by words in the photos become masks before anything else is done.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
mod fixture;

use fixture::command::{refuses, splatvk, text};
use fixture::data;
use splatvk::format::{cameras, picture, scene_photos};
use splatvk::photo::Photo;
use splatvk::scene::{Camera, Image};
use splatvk_test_support::breakfast::{TestView, views};
use std::path::Path;
use std::process::Command;

/// Label of the lemon, and of the plate below it.
const LEMON: i32 = 7;
const PLATE: i32 = 10;
/// Rows that the given mask of the first photo excludes.
const ROWS: usize = 100;

/// `train` on breakfast with its true cameras, as short as possible.
fn train(folder: &Path, views: &[TestView]) -> Command {
    let known: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
    let file = folder.join("cameras.json");
    cameras::write_json(&file, &known).unwrap();
    let mut command = splatvk();
    command.arg("train").arg("--images").arg(data("breakfast/images")).arg("--cameras").arg(file);
    command.args(["--iterations", "1", "--preset", "draft", "--out"]).arg(folder.join("scene"));
    command
}

/// Share of the pixels of a view that `are` and that its photo does not use.
fn unused(photo: &Photo, view: &TestView, are: impl Fn(usize, i32) -> bool) -> f64 {
    let pixels = || view.masks.data.iter().enumerate().filter(|(p, label)| are(*p, **label));
    pixels().filter(|(p, _)| !photo.uses(*p)).count() as f64 / pixels().count() as f64
}

/// The lemon is masked beside the rows that a given mask excludes, and a car is not found.
#[test]
fn words_join_given_masks() {
    let folder = tempfile::tempdir().unwrap();
    // Two of the photos: masks take most of the time.
    let views = &views("train")[..2];
    let masks = folder.path().join("used");
    std::fs::create_dir(&masks).unwrap();
    let (width, height) = (views[0].image.width, views[0].image.height);
    let used = Image { width, height, data: (0..width * height).map(|p| p / width >= ROWS).collect() };
    picture::write_mask_png(&masks.join("train_00.png"), &used).unwrap();
    let mut command = train(folder.path(), views);
    command.args(["--ignore", "lemon", "--ignore", "car", "--photo-masks"]).arg(&masks);
    let output = command.output().unwrap();
    let log = text(&output.stderr);
    assert!(output.status.success(), "{log}");
    assert!(log.contains("--ignore lemon: ignored in 2 of 2 photos"), "{log}");
    assert!(log.contains("--ignore car: found in 0 of 2 photos; nothing is ignored"), "{log}");
    let scene = folder.path().join("scene");
    let record: serde_json::Value =
        serde_json::from_slice(&std::fs::read(scene.join("run.json")).unwrap()).unwrap();
    let ignored = &record["statistics"]["ignored"];
    assert_eq!(record["config"]["plan"]["ignore"], serde_json::json!(["lemon", "car"]));
    assert_eq!(ignored[0]["photos"].as_array().unwrap().len(), 2);
    assert_eq!(ignored[1]["photos"], serde_json::json!([]));
    for (k, (photo, view)) in scene_photos::load(&scene).unwrap().iter().zip(views).enumerate() {
        let below = |p: usize| p / width >= ROWS + 2;
        let lemon = unused(photo, view, |p, label| label == LEMON && below(p));
        let rest = unused(photo, view, |p, label| label != LEMON && label != PLATE && below(p));
        assert!(lemon > 0.97 && rest < 0.01, "photo {k}: {lemon} {rest}");
        let above = unused(photo, view, |p, _| p / width < ROWS - 2);
        assert_eq!(above, if k == 0 { 1.0 } else { 0.0 }, "photo {k}");
    }
}

/// The reason and a way out, before the photos are looked at.
#[test]
fn unknown_words_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    // Two of the photos: masks take most of the time.
    let views = &views("train")[..2];
    for (ignored, words) in [
        ("quantum mechanics", &["--ignore quantum mechanics", "do not know it", "--photo-masks DIR"][..]),
        (" ", &["--ignore", "a few words"]),
    ] {
        refuses(train(folder.path(), views).args(["--ignore", ignored]), 2, words);
    }
}
