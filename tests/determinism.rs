//! `--deterministic`: from the same photos, the command line, the Rust interface and the C
//! interface, with different numbers of host threads, produce the same bits, and the same renders
//! and answers.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks)] // a panic is how a test fails
mod fixture;

use splatvk::capi::*;
use splatvk::run::{self, Destination, Inputs, ReconstructionConfig, RunPlan, TrainingConfig};
use std::collections::BTreeMap;
use std::ffi::CString;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::ptr::null_mut;

const SIZE: usize = 160;
const ITERATIONS: usize = 40;
const QUERY: &str = "lemon";
/// Files that contain times, memory and the path of the scene.
const OF_THE_RUN: [&str; 2] = ["run.json", "report.html"];
/// Lines of `answers.json` that contain times and paths.
const OF_THE_QUERY: [&str; 3] = ["\"out\":", "\"scene\":", "\"milliseconds\":"];

fn photos(folder: &Path) -> Vec<PathBuf> {
    let small = |k: usize| {
        let name = format!("train_0{k}");
        let image = image::open(fixture::data(&format!("breakfast/images/{name}.jpg"))).unwrap();
        let path = folder.join(format!("{name}.png"));
        image
            .resize_exact(SIZE as u32, 120, image::imageops::FilterType::Triangle)
            .to_rgb8()
            .save(&path)
            .unwrap();
        path
    };
    (0..3).map(small).collect()
}

/// The program with numbers of its own threads and of lavapipe's.
fn splatvk(threads: [&str; 2]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    command.env("RAYON_NUM_THREADS", threads[0]).env("LP_NUM_THREADS", threads[1]);
    command
}

fn output(command: &mut Command) -> Vec<u8> {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{command:?}\n{}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

fn from_shell(photos: &[PathBuf], out: &Path, threads: [&str; 2]) {
    let mut command = splatvk(threads);
    command.arg("run").args(photos).args(["--preset", "draft", "--deterministic", "--query", QUERY]);
    command
        .args(["--max-size", &SIZE.to_string(), "--iterations", &ITERATIONS.to_string(), "--out"])
        .arg(out);
    output(&mut command);
}

fn from_rust(photos: &[PathBuf], out: &Path) {
    let training = TrainingConfig {
        preset: Some(splatvk::fit::Preset::Draft),
        iterations: Some(ITERATIONS),
        max_size: Some(SIZE),
        deterministic: true,
        ..TrainingConfig::default()
    };
    let plan = RunPlan {
        inputs: Inputs { photos: photos.to_vec(), queries: vec![QUERY.into()], ..Inputs::default() },
        config: ReconstructionConfig { training, ..ReconstructionConfig::default() },
        output: Destination { out: out.into(), ..Destination::default() },
        ..RunPlan::default()
    };
    run::run(&plan, &splatvk::progress::Silent).unwrap();
}

fn from_c(photos: &[PathBuf], out: &Path) {
    let files: Vec<CString> = photos.iter().map(|p| c_path(p)).collect();
    // The zero bytes of the structures are their defaults.
    unsafe {
        let mut options: SvkContextOptions = std::mem::zeroed();
        (options.size, options.deterministic) = (size_of::<SvkContextOptions>(), 1);
        let (mut context, mut scene) = (null_mut(), null_mut());
        assert_eq!(svk_context_create(&options, &mut context), SvkStatus::Ok);
        let given = files.iter().map(|file| {
            let mut photo: SvkPhoto = std::mem::zeroed();
            (photo.size, photo.path) = (size_of::<SvkPhoto>(), file.as_ptr());
            photo
        });
        let given: Vec<SvkPhoto> = given.collect();
        let mut options: SvkTrainOptions = std::mem::zeroed();
        options.size = size_of::<SvkTrainOptions>();
        options.preset = SvkPreset::Draft as u32;
        (options.iterations, options.max_size) = (ITERATIONS as u64, SIZE as u64);
        assert_eq!(svk_train(context, given.as_ptr(), given.len(), &options, &mut scene), SvkStatus::Ok);
        assert_eq!(svk_scene_save(scene, c_path(out).as_ptr(), 0), SvkStatus::Ok);
        svk_scene_destroy(scene);
        svk_context_destroy(context);
    }
}

fn c_path(path: &Path) -> CString {
    CString::new(path.to_str().unwrap()).unwrap()
}

/// All files under a folder, by name.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
                continue;
            }
            let name = path.strip_prefix(folder).unwrap().to_str().unwrap().to_owned();
            let mut bytes = std::fs::read(path).unwrap();
            if name == "answers.json" {
                let text = String::from_utf8(bytes).unwrap();
                let kept = text.lines().filter(|line| !OF_THE_QUERY.iter().any(|key| line.contains(key)));
                bytes = kept.collect::<Vec<_>>().join("\n").into_bytes();
            }
            if !OF_THE_RUN.contains(&name.as_str()) {
                found.insert(name, bytes);
            }
        }
    }
    found
}

/// Asserts that two folders contain the same bytes; the second may lack the folders `without`.
fn assert_same(a: &Path, b: &Path, without: &[&str]) {
    let (mut a, b) = (files(a), files(b));
    a.retain(|name, _| !without.iter().any(|w| name.starts_with(w)));
    assert!(a.len() > 5, "{:?}", a.keys());
    assert!(a.keys().eq(b.keys()), "{:?}\n{:?}", a.keys(), b.keys());
    let different: Vec<_> =
        a.iter().filter(|(name, bytes)| b[*name] != **bytes).map(|(name, _)| name).collect();
    assert!(different.is_empty(), "differ: {different:?}");
}

#[test]
fn run_repeats_bits_from_any_folder() {
    let folder = tempfile::tempdir().unwrap();
    let photos = photos(folder.path());
    let path_of = |name: &str| folder.path().join(name);
    // With three threads and one of the device; the others use as many as there are cores.
    from_shell(&photos, &path_of("shell"), ["3", "1"]);
    from_rust(&photos, &path_of("rust"));
    assert_same(&path_of("shell"), &path_of("rust"), &[]);
    from_c(&photos, &path_of("c"));
    assert_same(&path_of("shell"), &path_of("c"), &["previews/query_"]);

    let answers = |scene: &str, threads, out: &str| {
        output(
            splatvk(threads)
                .args(["query", "--json"])
                .arg(path_of(scene))
                .args([QUERY, "--out"])
                .arg(path_of(out)),
        );
        let cameras = path_of(scene).join("cameras/transforms.json");
        output(
            splatvk(threads)
                .arg("render")
                .arg(path_of(scene))
                .arg("--cameras")
                .arg(cameras)
                .arg("--out")
                .arg(path_of(out).join("renders")),
        );
    };
    answers("shell", ["1", "2"], "answers-shell");
    answers("rust", ["3", "1"], "answers-rust");
    assert_same(&path_of("answers-shell"), &path_of("answers-rust"), &[]);
}
