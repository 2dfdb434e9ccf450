//! A run that is killed, or finds the disk full, continues with `--resume` and ends with the same
//! bits as an uninterrupted run.
#![cfg(unix)]
#![allow(clippy::unwrap_used)] // a panic is how a test fails
mod fixture;

use fixture::command::{limited, memory_was_limited};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Number of times that the run is killed; `tools/test-long` sets 20.
const KILLS: &str = "SPLATVK_TEST_KILLS";

/// Photos of a size at which a run takes seconds.
struct Scene {
    folder: tempfile::TempDir,
}

impl Scene {
    fn new() -> Scene {
        let folder = tempfile::tempdir().unwrap();
        let photos = folder.path().join("photos");
        std::fs::create_dir(&photos).unwrap();
        let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/breakfast/images");
        for k in 0..3 {
            let photo = image::open(data.join(format!("train_{k:02}.jpg"))).unwrap();
            let small = photo.resize_exact(240, 180, image::imageops::FilterType::Triangle);
            small.to_rgb8().save(photos.join(format!("{k}.png"))).unwrap();
        }
        // A film beside photos is not read; every run warns of it.
        std::fs::write(photos.join("clip.mp4"), "film").unwrap();
        Scene { folder }
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Folder like the one that setup fills, without stages.
    fn home(&self, name: &str) -> PathBuf {
        let home = self.at(name);
        if !home.exists() {
            std::fs::create_dir(&home).unwrap();
            for part in ["lib", "models"] {
                std::os::unix::fs::symlink(splatvk::infer::home().unwrap().join(part), home.join(part))
                    .unwrap();
            }
        }
        home
    }

    /// `splatvk run` with `language` steps of semantic training, and with stages kept in the folder
    /// `home`.
    fn run(&self, home: &str, out: &str, language: u32, resume: bool) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        command
            .env("SPLATVK_HOME", self.home(home))
            .arg("run")
            .arg(self.at("photos"))
            .args(["--max-size", "200", "--preset", "draft", "--iterations", "40"])
            .args([
                "--checkpoint-seconds",
                "0",
                "--deterministic",
                "--query",
                "lemon",
                "--log",
                "json",
                "--out",
            ])
            .arg(self.at(out))
            .args(["--language-iterations", &language.to_string()])
            .args(resume.then_some("--resume"))
            .stdout(Stdio::null());
        command
    }

    /// Runs to the end and returns the messages.
    fn finished(&self, home: &str, out: &str, language: u32, resume: bool) -> String {
        let output = self.run(home, out, language, resume).stderr(Stdio::piped()).output().unwrap();
        let log = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{log}");
        log
    }
}

/// All files of a scene except those that contain times.
fn content(scene: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    let mut folders = vec![scene.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if !["run.json", "report.html"].iter().any(|n| path.ends_with(n)) {
                files.push((path.strip_prefix(scene).unwrap().to_path_buf(), std::fs::read(&path).unwrap()));
            }
        }
    }
    files.sort();
    files
}

/// Statistics in a scene's run.json about the photos, the cameras and the answers.
fn statistics(scene: &Path) -> Value {
    let run: Value = serde_json::from_slice(&std::fs::read(scene.join("run.json")).unwrap()).unwrap();
    let part = |name: &str| run["statistics"][name].clone();
    serde_json::json!([part("geometry"), part("light"), part("psnr_train"), part("queries"), run["warnings"]])
}

/// Kills a child as a power cut would. Returns false if it had already ended.
fn killed_after(mut child: Child, time: Duration) -> bool {
    let began = Instant::now();
    while began.elapsed() < time {
        if let Some(status) = child.try_wait().unwrap() {
            assert!(status.success());
            return true;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    false
}

/// Size of the largest file in a folder, bytes.
fn largest(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path());
    entries.map(|p| if p.is_dir() { largest(&p) } else { p.metadata().unwrap().len() }).max().unwrap_or(0)
}

#[test]
#[ignore = "three whole runs; unit tests of pipeline and format::workspace fill disks faster"]
fn full_disk_run_resumes_later() {
    let scene = Scene::new();
    scene.finished("home-a", "whole", 20, false);
    let before = content(&scene.at("whole"));
    let run_json = std::fs::read(scene.at("whole/run.json")).unwrap();

    // The same run again, over its own scene, with too little space for the largest file. The
    // kernel counts in blocks of 512 bytes, and would end the process without the trap.
    let blocks = largest(&scene.at("whole")).div_ceil(512) - 2;
    let mut run = scene.run("home-b", "whole", 20, false);
    let output = limited(blocks, run.arg("--force")).output().unwrap();
    if memory_was_limited(output.status) {
        return;
    }
    let log = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(4), "{log}");
    let last: Value = serde_json::from_str(log.lines().last().unwrap()).unwrap();
    let message = last["message"].as_str().unwrap();
    assert!(last["event"] == "error" && message.contains("cannot be written"), "{log}");
    assert!(message.contains("ulimit") && message.lines().count() == 1, "{message}");
    assert!(content(&scene.at("whole")) == before, "the old scene is as it was");
    assert!(std::fs::read(scene.at("whole/run.json")).unwrap() == run_json);
    for entry in std::fs::read_dir(scene.folder.path()).unwrap() {
        let name = entry.unwrap().file_name().to_string_lossy().into_owned();
        assert!(!name.contains("partial") && !name.contains("old"), "left behind: {name}");
    }

    // With enough space again.
    let log = scene.finished("home-b", "resumed", 20, true);
    let kept = log.lines().find(|l| l.contains("kept from an earlier run")).unwrap();
    // The trained language is larger than the limit, so it was not kept.
    assert!(
        kept.contains("cameras") && kept.contains("view dependence") && kept.contains("alignment"),
        "{kept}"
    );
    assert!(content(&scene.at("resumed")) == before, "the same scene");
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn killed_run_resumes_with_same_bits() {
    let scene = Scene::new();
    let began = Instant::now();
    scene.finished("home-a", "whole", 20, false);
    let whole = began.elapsed();
    let kills: u32 = std::env::var(KILLS).map_or(1, |n| n.parse().unwrap());
    let mut state = 1u64;
    let mut done = false;
    for _ in 0..kills {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let share = (state >> 33) as f64 / f64::from(1u32 << 31);
        let child = scene.run("home-b", "resumed", 20, true).stderr(Stdio::null()).spawn().unwrap();
        done = killed_after(child, whole.mul_f64(share));
        if done {
            break;
        }
        assert!(!scene.at("resumed").exists(), "a scene appears whole or not at all");
    }
    if !done {
        scene.finished("home-b", "resumed", 20, true);
    }
    let (whole, resumed) = (scene.at("whole"), scene.at("resumed"));
    let names = |c: &[(PathBuf, Vec<u8>)]| c.iter().map(|f| f.0.clone()).collect::<Vec<_>>();
    let (a, b) = (content(&whole), content(&resumed));
    assert_eq!(names(&a), names(&b));
    for ((name, a), (_, b)) in a.iter().zip(&b) {
        assert!(a == b, "{} differs", name.display());
    }
    assert_eq!(statistics(&whole), statistics(&resumed));
    assert!(statistics(&whole)[4].to_string().contains("clip.mp4"), "{}", statistics(&whole)[4]);

    // With all stages kept, only decoding runs again; then another late option, with all earlier
    // stages kept.
    let log = scene.finished("home-b", "again", 20, true);
    let kept = |log: &str| log.lines().find(|l| l.contains("kept from an earlier run")).unwrap().to_owned();
    // Splats are read as the stage after them left them.
    for stage in ["cameras", "depth", "view dependence", "alignment", "language"] {
        assert!(kept(&log).contains(stage), "{stage}: {log}");
    }
    assert!(!log.contains("\"begin\",\"stage\":\"rgb"), "{log}");
    assert!(content(&scene.at("again")) == b, "the same scene");
    let log = scene.finished("home-b", "other", 10, true);
    let kept = kept(&log);
    assert!(kept.contains("view dependence") && kept.contains("alignment"), "{kept}");
    assert!(!kept.contains("language"), "{kept}");
}
