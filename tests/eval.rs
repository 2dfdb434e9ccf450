//! `splatvk eval` with invalid ground truth, and when interrupted: a one-line error, and nothing
//! written.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod fixture;

use fixture::{data, scene, truth};
use serde_json::{Value, json};
use splatvk::eval::GroundTruth;
use splatvk::format::npy::{self, NpyArray};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// A copy of the ground truth of breakfast, altered by `change`.
fn copy(folder: &Path, change: impl FnOnce(&Path, &mut Value)) {
    for part in ["images", "held_out", "masks", "depth"] {
        std::fs::create_dir_all(folder.join(part)).unwrap();
        for file in std::fs::read_dir(data("breakfast").join(part)).unwrap() {
            let file = file.unwrap();
            std::fs::copy(file.path(), folder.join(part).join(file.file_name())).unwrap();
        }
    }
    let mut text = truth();
    change(folder, &mut text);
    std::fs::write(folder.join("ground_truth.json"), text.to_string()).unwrap();
}

fn eval(truth: &Path, out: &Path) -> Command {
    let mut eval = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    eval.env_remove("SPLATVK_MODELS").stdin(Stdio::null()).arg("eval").arg(scene());
    eval.arg("--ground-truth").arg(truth).arg("--out").arg(out).arg("--text");
    eval
}

#[test]
fn eval_refuses_mismatched_ground_truth() {
    assert_refused(&["masks/train_01.png", "10 × 10", "640 × 480"], |folder, _| {
        image::GrayImage::new(10, 10).save(folder.join("masks/train_01.png")).unwrap();
    });
    assert_refused(&["depth/test_05.npz", "5 × 5", "640 × 480"], |folder, _| {
        let depth = NpyArray::f32(&[5, 5], vec![1.0; 25]);
        npy::write_npz(folder.join("depth/test_05.npz"), &[("depth", &depth)]).unwrap();
    });
    assert_refused(&["held_out/test_06.jpg", "32 × 24", "640 × 480"], |folder, _| {
        image::RgbImage::new(32, 24).save(folder.join("held_out/test_06.jpg")).unwrap();
    });
    assert_refused(&["held_out/test_06.jpg"], |folder, _| {
        std::fs::remove_file(folder.join("held_out/test_06.jpg")).unwrap();
    });
    assert_refused(&["ground_truth.json", "train_00", "focal lengths must be positive"], |_, text| {
        text["frames"][0]["fx"] = json!(0);
    });
    assert_refused(&["ground_truth.json", "train_00", "not a rotation"], |_, text| {
        text["frames"][0]["world_to_camera"] = json!(vec![[0.0; 4]; 4]);
    });
    assert_refused(&["ground_truth.json", "expected a sequence"], |_, text| {
        text["frames"] = json!("none");
    });
    assert_refused(&["truth", "0 of its train frames"], |_, text| {
        text["frames"].as_array_mut().unwrap().retain(|f| f["split"] == "test");
    });
}

/// Expects that `eval` refuses a changed ground truth, and that it writes nothing.
fn assert_refused(words: &[&str], change: fn(&Path, &mut Value)) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("deep/out");
    copy(&folder.path().join("truth"), change);
    let output = eval(&folder.path().join("truth"), &out).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{words:?}: {stderr}");
    assert!(stderr.lines().count() == 1 && words.iter().all(|w| stderr.contains(w)), "{words:?}: {stderr}");
    assert!(output.stdout.is_empty() && !folder.path().join("deep").exists(), "{words:?}");
}

/// A scene with language needs masks for its score; one without needs none.
#[test]
fn eval_names_missing_masks() {
    let folder = tempfile::tempdir().unwrap();
    copy(folder.path(), |folder, _| std::fs::remove_file(folder.join("masks/test_07.png")).unwrap());
    let read = GroundTruth::read(folder.path()).unwrap();
    assert_eq!(read.check(false).unwrap(), None);
    let error = read.check(true).unwrap_err();
    assert!(error.exit_code() == 2 && error.to_string().contains("masks/test_07.png"), "{error}");
    copy(folder.path(), |folder, _| std::fs::remove_dir_all(folder.join("masks")).unwrap());
    let doubt = GroundTruth::read(folder.path()).unwrap().check(true).unwrap().unwrap();
    assert!(doubt.contains("11 labels and no masks"), "{doubt}");
    copy(folder.path(), |folder, text| {
        std::fs::remove_dir_all(folder.join("masks")).unwrap();
        text["labels"] = json!({});
    });
    assert_eq!(GroundTruth::read(folder.path()).unwrap().check(true).unwrap(), None);
    assert_eq!(GroundTruth::read(&data("breakfast")).unwrap().check(true).unwrap(), None);
}

/// Whether a folder or one below it has an entry of a name.
fn holds(folder: &Path, name: &str) -> bool {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|e| e.path()).any(|p| p.ends_with(name) || p.is_dir() && holds(&p, name))
}

#[test]
fn eval_writes_all_or_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("deep/out");
    let mut child =
        eval(&data("breakfast"), &out).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    let begun = Instant::now();
    // The first picture has been written.
    let hidden = folder.path().join("deep/.out.partial-splatvk");
    while !holds(&hidden, "renders") {
        assert!(begun.elapsed() < Duration::from_secs(60) && child.try_wait().unwrap().is_none());
        std::thread::sleep(Duration::from_millis(2));
    }
    Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(130), "{stderr}");
    assert!(stderr.contains("nothing was written") && !folder.path().join("deep").exists(), "{stderr}");
    assert!(eval(&data("breakfast"), &out).output().unwrap().status.success());
    let mut names: Vec<_> = std::fs::read_dir(&out).unwrap().map(|e| e.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["eval.json", "renders"]);
    assert_eq!(std::fs::read_dir(out.join("renders")).unwrap().count(), 18);
}
