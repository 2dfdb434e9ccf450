//! The command line: refusals and their messages, and no half-written files.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod fixture;

use fixture::command::{limited, memory_was_limited, refuses, splatvk, text};
use fixture::{data, scene, small_views, train_log};
use splatlab::generate::regions::InjectedErrors;
use splatlab::generate::{SceneSpec, generate};
use splatvk::format::npy::{self, NpyArray};
use splatvk::progress::Silent;
use splatvk::scene::Seen;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// Expects that `splatvk run INPUT... --out FOLDER/out/scene` is refused and FOLDER stays empty.
fn run_refuses(inputs: &[&Path], options: &[&str], words: &[&str]) {
    run_ends(2, inputs, options, words);
}

/// A run that ends with an exit code before it leaves anything.
fn run_ends(code: i32, inputs: &[&Path], options: &[&str], words: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let mut command = splatvk();
    command.arg("run").args(inputs).args(options).arg("--out").arg(folder.path().join("out/scene"));
    refuses(&mut command, code, words);
    assert!(names(folder.path()).is_empty(), "left behind: {:?}", names(folder.path()));
}

#[test]
fn unusable_photos_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    run_refuses(&[dir], &[], &["no photos"]);
    run_refuses(&[&dir.join("missing")], &[], &["missing"]);
    std::fs::write(dir.join("clip.mp4"), b"\0\0\0\x18ftypmp42........").unwrap();
    run_refuses(&[dir], &[], &["clip.mp4", "video"]);
    run_refuses(&[&dir.join("clip.mp4")], &[], &["clip.mp4", "video"]);
    // Without ffmpeg.
    let mut command = splatvk();
    command.env("PATH", dir).arg("run").arg(dir.join("clip.mp4")).arg("--out").arg(dir.join("scene"));
    refuses(&mut command, 3, &["clip.mp4", "ffprobe", "install"]);
    assert_eq!(names(dir), ["clip.mp4"]);
    let photo = |i: usize| data(&format!("breakfast/images/train_{i:02}.jpg"));
    std::fs::copy(photo(0), dir.join("a.jpg")).unwrap();
    run_refuses(&[dir], &[], &["a.jpg", "only one photo"]);
    std::fs::copy(photo(0), dir.join("b.jpg")).unwrap();
    run_refuses(&[dir], &[], &["a.jpg", "b.jpg", "the same photo twice"]);
    let whole = std::fs::read(photo(1)).unwrap();
    std::fs::write(dir.join("b.jpg"), &whole[..whole.len() * 2 / 3]).unwrap();
    run_refuses(&[dir], &[], &["b.jpg", "cut off"]);
    std::fs::write(dir.join("b.jpg"), b"this is text").unwrap();
    run_refuses(&[dir], &[], &["b.jpg", "not an image"]);
    std::fs::write(dir.join("b.jpg"), b"").unwrap();
    run_refuses(&[dir], &[], &["b.jpg", "empty"]);
}

#[test]
fn heic_without_library_explains_installation() {
    let folder = tempfile::tempdir().unwrap();
    let photo = |name: &str| data(name);
    let mut command = splatvk();
    command.env("SPLATVK_LIBHEIF", folder.path().join("libheif.so.1"));
    command.arg("run").args([photo("photos/turned.heic"), photo("breakfast/images/train_00.jpg")]);
    command.arg("--out").arg(folder.path().join("scene"));
    refuses(&mut command, 3, &["turned.heic", "libheif", "SPLATVK_LIBHEIF"]);
    assert!(names(folder.path()).is_empty(), "left behind: {:?}", names(folder.path()));
    let mut doctor = splatvk();
    let output = doctor.arg("doctor").env("SPLATVK_LIBHEIF", "/nowhere/libheif.so").output().unwrap();
    let line = text(&output.stdout).lines().find(|l| l.contains("HEIC")).unwrap().to_owned();
    assert!(line.starts_with("note") && line.contains("cannot be read"), "{line}");
}

#[test]
fn doctor_compares_all_passes() {
    let home = tempfile::tempdir().unwrap();
    let table = doctor_check(home.path(), &[], "");
    let (timed, rows): (Vec<&str>, Vec<&str>) = table.lines().skip(1).partition(|l| l.starts_with("timed "));
    assert!(rows.len() > 15 && rows.iter().all(|line| line.starts_with("ok ")), "{table}");
    let cache = home.path().join("cache");
    let is_kept = || cache.exists() && names(&cache).iter().any(|name| name.ends_with(".preferred"));
    assert_eq!(is_kept(), !timed.is_empty());
    let report = doctor_check(home.path(), &["--json"], "native passes");
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    assert_eq!(report["right"], true);
    assert_eq!(report["switched_off"], serde_json::json!([]));
    assert_eq!(report["passes"].as_array().unwrap().len(), rows.len());
    let timed = report["timed"].as_array().unwrap();
    assert!(timed.len() == 7 && is_kept(), "{timed:?}");
    assert!(timed.iter().all(|t| t["ways"].as_array().unwrap().contains(&t["chosen"])), "{timed:?}");
}

/// Output of `splatvk doctor --check` without some kernel variants.
fn doctor_check(home: &Path, arguments: &[&str], disabled: &str) -> String {
    let mut command = splatvk();
    command.arg("doctor").arg("--check").args(arguments).env("SPLATVK_HOME", home);
    let output = command.env("SPLATVK_DISABLE", disabled).output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    text(&output.stdout)
}

#[test]
fn photos_without_overlap_are_named() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::copy(data("breakfast/images/train_00.jpg"), folder.path().join("table.jpg")).unwrap();
    // A few blocks of random colour: corners, none of them on the table, and few enough for a quick
    // refusal.
    let blob = |x: u32, y: u32, k: u32| ((x / 64 * 7919 + y / 48 * 104_729 + k * 31) % 251) as u8;
    let noise =
        image::RgbImage::from_fn(640, 480, |x, y| image::Rgb([blob(x, y, 0), blob(x, y, 1), blob(x, y, 5)]));
    noise.save(folder.path().join("noise.png")).unwrap();
    run_refuses(&[folder.path()], &[], &["overlap", "noise", "table"]);
}

/// With a limit of 4 MiB, 52 channels fit for 314 pixels side by side.
#[test]
fn impossible_size_error_suggests_possible_one() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = splatvk();
    command.env("SPLATVK_MAX_BINDING", "4").arg("run").arg(data("breakfast/images"));
    command.arg("--out").arg(folder.path().join("scene"));
    let start = Instant::now();
    refuses(&mut command, 2, &["640 pixels", "pixels wide", "--max-size 314"]);
    assert!(start.elapsed() < Duration::from_secs(30), "before any long stage");
    assert!(names(folder.path()).is_empty(), "left behind: {:?}", names(folder.path()));
}

/// A data set has more photos with cameras than are used in training.
#[test]
fn train_chooses_views_and_names_them() {
    let folder = tempfile::tempdir().unwrap();
    let (set, out) = (folder.path().join("set"), folder.path().join("scene"));
    let spec = SceneSpec { views: 5, held_out: 1, size: (160, 120), objects: 2, ..SceneSpec::default() };
    generate(&set, &spec, &InjectedErrors::NONE, &Silent).unwrap();
    let mut train = splatvk();
    train
        .arg("train")
        .arg("--images")
        .arg(set.join("images"))
        .arg("--cameras")
        .arg(set.join("cameras_noisy.json"));
    let output = train.args(["--views", "2", "--iterations", "1", "--out"]).arg(&out).output().unwrap();
    assert!(
        output.status.success() && text(&output.stderr).contains("using 2 of 5 photos: train_0"),
        "{output:?}"
    );
    assert_eq!(names(&out.join("cameras/images")).len(), 2);
}

#[test]
fn views_must_fit_the_photos() {
    let photos = data("breakfast/images");
    run_refuses(&[&photos], &["--views", "5"], &["--views 5", "only 4"]);
    for views in ["0", "1", "-3", "abc"] {
        run_refuses(&[&photos], &["--views", views], &[&format!("--views {views}: "), "give 2 or more"]);
    }
}

#[test]
fn bad_usage_exits_with_two() {
    for args in [&["run"][..], &["frobnicate"], &["run", "x", "--views", "many"], &["render", "x"], &[]] {
        let output = splatvk().args(args).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{args:?}");
        assert!(output.stdout.is_empty() && !output.stderr.is_empty(), "{args:?}");
    }
    let help = splatvk().arg("--help").output().unwrap();
    assert!(help.status.success() && text(&help.stdout).contains("doctor"));
}

#[test]
fn misspelt_words_get_suggestions() {
    for (args, words) in [
        (&["rnu"][..], "there is no command rnu; did you mean run?"),
        (&["run", "x", "--quary", "lemon"], "there is no option --quary; did you mean --query?"),
        (&["run", "x", "--preset", "drat"], "did you mean draft?"),
    ] {
        refuses(splatvk().args(args), 2, &[words, "--help"]);
    }
}

#[cfg(target_os = "linux")]
#[test]
fn system_errors_are_explained() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    std::fs::write(path_of("file"), "x").unwrap();
    std::os::unix::fs::symlink(path_of("loop"), path_of("loop")).unwrap();
    let long = "n".repeat(300);
    for (name, words) in [
        ("none", &["none: ", "does not exist"][..]),
        ("file/a.ply", &["a.ply: ", "is a file, not a folder"]),
        ("loop", &["loop: ", "lead in a circle"]),
        (&long, &["the name is too long"]),
    ] {
        let words: Vec<&str> = words.iter().copied().chain(["; "]).collect();
        for line in [
            refuses(splatvk().arg("view").arg(path_of(name)), 2, &[]),
            refuses(splatvk().arg("run").arg(path_of(name)).arg("--out").arg(path_of("o")), 2, &words),
        ] {
            let stderr = text(&line.stderr);
            assert!(!stderr.contains("os error"), "{stderr}");
        }
    }
}

/// Without --out nothing is written: a row per text, or the same answers as JSON.
#[test]
fn query_without_out_prints_answer() {
    let folder = tempfile::tempdir().unwrap();
    let scene = fixture::view::breakfast(folder.path());
    let empty = tempfile::tempdir().unwrap();
    let table = ask(&scene, empty.path(), &[]);
    let lines: Vec<&str> = table.lines().collect();
    assert!(lines.len() == 2 && lines[0].starts_with("text ") && lines[0].ends_with("best view"), "{table}");
    assert!(lines[1].starts_with("“lemon”  found ") && lines[1].contains("train_0"), "{table}");
    let report: serde_json::Value = serde_json::from_str(&ask(&scene, empty.path(), &["--json"])).unwrap();
    let view = &report["queries"][0]["views"][0];
    assert!(report["out"].is_null() && view["found"] == true && view.get("heat").is_none(), "{report}");
    assert_eq!(names(empty.path()), [""; 0]);
    let mut force = splatvk();
    refuses(force.arg("query").arg(&scene).args(["lemon", "--splats"]), 2, &["--out"]);
    let long = "red ".repeat(50);
    let mut question = splatvk();
    refuses(question.arg("query").arg(&scene).arg(&long), 2, &["50 words", "at most 300 characters"]);
    // A damaged run.json is an error: without it the answers would differ.
    std::fs::write(scene.join("run.json"), "{\"config\"").unwrap();
    let mut damaged = splatvk();
    refuses(damaged.arg("query").arg(&scene).arg("lemon"), 2, &["run.json", "restore it"]);
    let mut chosen = splatvk();
    let chosen = chosen.arg("query").arg(&scene).args(["lemon", "--compat", "none"]).output().unwrap();
    assert!(chosen.status.success(), "{}", text(&chosen.stderr));
    std::fs::remove_file(scene.join("run.json")).unwrap();
    std::fs::remove_file(scene.join("seen.npy")).unwrap_or_default();
    std::fs::create_dir(scene.join("seen.npy")).unwrap();
    let mut seen = splatvk();
    refuses(seen.arg("query").arg(&scene).arg("lemon"), 2, &["seen.npy", "a folder, not a file"]);
}

/// Output of a query about the lemon.
fn ask(scene: &Path, current: &Path, more: &[&str]) -> String {
    let output = splatvk().arg("query").arg(scene).args(["lemon"]).args(more).current_dir(current).output();
    let output = output.unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    text(&output.stdout)
}

#[test]
fn unwritable_output_fails_before_work() {
    let folder = tempfile::tempdir().unwrap();
    let photos = data("breakfast/images");
    let run = |out: PathBuf, code: i32, words: &[&str]| {
        let start = Instant::now();
        refuses(splatvk().arg("run").arg(&photos).arg("--out").arg(out), code, words);
        assert!(start.elapsed() < Duration::from_secs(5), "the work must not start");
    };
    let file = folder.path().join("file");
    std::fs::write(&file, "x").unwrap();
    run(file.clone(), 2, &["file is in the way"]);
    run(file.join("scene"), 2, &["cannot be written"]);
    run(PathBuf::from("/proc/splatvk-scene"), 2, &["cannot be written"]);
    let precious = folder.path().join("precious");
    std::fs::create_dir(&precious).unwrap();
    std::fs::write(precious.join("letter.txt"), "x").unwrap();
    run(precious.clone(), 2, &["not empty"]);
    run(scene().to_path_buf(), 2, &["already holds a scene", "--force"]);
    let mut force = splatvk();
    force.arg("run").arg(&photos).arg("--force").arg("--out").arg(&precious);
    refuses(&mut force, 2, &["not a scene"]);
    assert_eq!(names(folder.path()), ["file", "precious"]);
    assert!(scene().join("scene.json").exists());
}

#[test]
fn bad_model_error_names_checksum() {
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    std::fs::create_dir(&models).unwrap();
    let photos = data("breakfast/images");
    run_ends(3, &[&photos], &["--models", models.to_str().unwrap()], &["sha256", "tools/"]);
    let listed = splatvk().args(["models", "list", "--json", "--models"]).arg(&models).output().unwrap();
    assert!(listed.status.success());
    let list: serde_json::Value = serde_json::from_slice(&listed.stdout).unwrap();
    let list = list["models"].as_array().unwrap();
    assert!(
        list.len() >= 5
            && list.iter().all(|m| m["installed"] == false && m["sha256"].as_str().unwrap().len() == 64)
    );
    for m in list {
        std::fs::write(m["file"].as_str().unwrap(), b"damaged").unwrap();
    }
    run_ends(3, &[&photos], &["--models", models.to_str().unwrap()], &["sha256", "tools/"]);
    let mut check = splatvk();
    check.args(["models", "check", "--models"]).arg(&models);
    refuses(&mut check, 3, &["sha256"]);
    run_refuses(&[&photos], &["--models", folder.path().join("none").to_str().unwrap()], &["none"]);
}

#[test]
fn missing_vulkan_device_fails_before_work() {
    let folder = tempfile::tempdir().unwrap();
    let mut run = splatvk();
    hide_vulkan(&mut run);
    run.arg("run").arg(data("breakfast/images")).arg("--out").arg(folder.path().join("scene"));
    refuses(&mut run, 3, &["Vulkan", "mesa-vulkan-drivers"]);
    assert!(names(folder.path()).is_empty());
    let mut doctor = splatvk();
    hide_vulkan(&mut doctor);
    let output = refuses(doctor.arg("doctor"), 3, &["missing"]);
    assert!(text(&output.stdout).contains("MISSING"), "{}", text(&output.stdout));
    run_refuses(&[&data("breakfast/images")], &["--device", "no such device"], &["no such device"]);
}

fn hide_vulkan(c: &mut Command) {
    c.env("VK_DRIVER_FILES", "/nonexistent.json").env("VK_ICD_FILENAMES", "/nonexistent.json");
}

#[test]
fn ctrl_c_stops_cleanly() {
    let folder = tempfile::tempdir().unwrap();
    let mut child = splatvk()
        .arg("run")
        .arg(data("breakfast/images"))
        .arg("--out")
        .arg(folder.path().join("scene"))
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let start = Instant::now();
    while names(folder.path()).is_empty() {
        assert!(start.elapsed() < Duration::from_secs(60), "the run never started");
        std::thread::sleep(Duration::from_millis(20));
    }
    // Half a second into the work: reading photos has finished, detecting features has not.
    std::thread::sleep(Duration::from_millis(500));
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    // Measured to the last line, after which the work is done: a busy kernel took 5 s more to tear
    // down the process.
    let sent = Instant::now();
    let lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let messages: Vec<(Duration, String)> = lines.map(|line| (sent.elapsed(), line.unwrap())).collect();
    assert_eq!(child.wait().unwrap().code(), Some(130), "{messages:?}");
    let (took, last) = messages.last().unwrap();
    assert!(last.contains("nothing was written"), "{messages:?}");
    assert!(names(folder.path()).is_empty(), "left behind: {:?}", names(folder.path()));
    assert!(*took < Duration::from_secs(2), "took {took:?} to stop");
}

#[test]
fn full_disk_leaves_no_scene() {
    let folder = tempfile::tempdir().unwrap();
    let (images, cameras, points) = small_views();
    let mut export = splatvk();
    export
        .arg("export")
        .arg(scene())
        .args(["--format", "ply", "--out"])
        .arg(folder.path().join("deep/a.ply"));
    refuses(&mut limited(8, &export), 4, &["a.ply", "limit"]);
    let mut render = splatvk();
    render
        .arg("render")
        .arg(scene())
        .arg("--cameras")
        .arg(&cameras)
        .arg("--out")
        .arg(folder.path().join("r"));
    if memory_was_limited(limited(8, &render).output().unwrap().status) {
        return;
    }
    refuses(&mut limited(8, &render), 4, &["limit"]);
    let mut train = splatvk();
    train.arg("train").arg("--images").arg(images).arg("--cameras").arg(cameras).arg("--points").arg(points);
    train.args(["--iterations", "2", "--out"]).arg(folder.path().join("scene"));
    refuses(&mut limited(8, &train), 4, &["limit"]);
    assert!(names(folder.path()).is_empty(), "{:?}", names(folder.path()));
}

/// Every answer is relative to the canonical phrases: without them, and without a network for them,
/// no query is possible.
#[test]
fn missing_text_embedding_fails_before_work() {
    let folder = tempfile::tempdir().unwrap();
    let photos = data("breakfast/images");
    let dir = format!("dir:{}", folder.path().display());
    let options =
        |query: &'static str| ["--masks", &dir, "--features", &dir, "--query", query].map(str::to_owned);
    let assert_refused = |query: &'static str, words: &[&str]| {
        let start = Instant::now();
        run_ends(3, &[&photos], &options(query).each_ref().map(String::as_str), words);
        assert!(start.elapsed() < Duration::from_secs(5), "before any work");
    };
    write_embeddings(folder.path(), &["lemon"]);
    assert_refused("lemon", &["'object'", "text_embeddings.npz", "add the phrase"]);
    write_embeddings(folder.path(), &["lemon", "object", "things", "stuff"]);
    assert_refused("lemon", &["'texture'", "text_embeddings.npz"]);
    write_embeddings(folder.path(), &["lemon", "object", "things", "stuff", "texture"]);
    assert_refused("mug", &["'mug'", "text_embeddings.npz"]);
}

fn write_embeddings(folder: &Path, phrases: &[&str]) {
    let row = NpyArray::f32(&[3], vec![1.0, 0.0, 0.0]);
    let rows: Vec<(&str, &NpyArray)> = phrases.iter().map(|p| (*p, &row)).collect();
    npy::write_npz(folder.join("text_embeddings.npz"), &rows).unwrap();
}

#[test]
fn run_writes_complete_replaceable_scene() {
    let scene = scene();
    let expected =
        ["cameras", "point_cloud.ply", "previews", "report.html", "run.json", "scene.json", "seen.npy"];
    assert_eq!(names(scene), expected);
    let run: serde_json::Value =
        serde_json::from_slice(&std::fs::read(scene.join("run.json")).unwrap()).unwrap();
    assert!(run["stages"].as_array().unwrap().len() >= 2 && run["seed"] == 0 && run["device"].is_string());
    let logged = events(&std::fs::read_to_string(train_log()).unwrap());
    let mut warned: Vec<_> =
        logged.iter().filter(|e| e["event"] == "warning").filter_map(|e| e["message"].as_str()).collect();
    let mut recorded: Vec<_> =
        run["warnings"].as_array().unwrap().iter().filter_map(|w| w.as_str()).collect();
    warned.sort_unstable();
    recorded.sort_unstable();
    assert_eq!(recorded, warned);
    assert!(names(scene.parent().unwrap()).iter().all(|n| !n.contains("partial") && !n.contains("old")));
}

#[test]
fn run_scene_renders_exports_and_answers() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("renders");
    let cameras = scene().join("cameras/transforms.json");
    let mut render = splatvk();
    render.arg("render").arg(scene()).arg("--cameras").arg(&cameras).arg("--out").arg(&out);
    render.args(["--channels", "rgb,alpha,depth,unseen", "--format", "png,exr,npy", "--json"]);
    let output = render.output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let listed: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let files = listed["files"].as_array().unwrap();
    // Four PNG, one EXR and four npy per view.
    assert_eq!((files.len(), names(&out).len()), (2 * 9, 2 * 9));
    let depth = npy::read(out.join("train_00_depth.npy")).unwrap();
    assert_eq!(depth.shape, [120, 160]);
    assert!(depth.to_f32().iter().any(|z| *z > 0.3), "the table is about 0.7 m away");
    let unseen = npy::read(out.join("train_00_unseen.npy")).unwrap().to_f32();
    let mean = unseen.iter().sum::<f32>() / unseen.len() as f32;
    assert!(mean < 1e-3, "a photo shows what its own view shows: {mean}");
    let picture = image::open(out.join("train_00.png")).unwrap().to_rgb8();
    assert!(picture.dimensions() == (160, 120) && picture.pixels().any(|p| p.0[0] > 60));
    // EXR contains linear light (IEC 61966-2-1), npy the values of the picture.
    let light = splatvk::format::picture::read_exr(&out.join("train_00.exr")).unwrap();
    let shown = npy::read(out.join("train_00_rgb.npy")).unwrap().to_f32();
    for (red, v) in light["R"].data.iter().zip(shown.iter().step_by(3)).filter(|(_, v)| **v > 0.05) {
        let linear = ((*v + 0.055) / 1.055).powf(2.4);
        assert!((*red - linear).abs() < 1e-4 * linear.max(1.0), "{red} for {v}");
    }

    let mut features = splatvk();
    features
        .arg("render")
        .arg(scene())
        .arg("--cameras")
        .arg(&cameras)
        .arg("--out")
        .arg(folder.path().join("none"));
    refuses(features.args(["--channels", "features"]), 2, &["no language"]);
    let mut query = splatvk();
    query.arg("query").arg(scene()).arg("lemon").arg("--out").arg(folder.path().join("none"));
    refuses(&mut query, 2, &["no language"]);
    for (format, name) in
        [("ply", "a.ply"), ("splat", "a.splat"), ("colmap", "model"), ("transforms", "t.json")]
    {
        let mut export = splatvk();
        export.arg("export").arg(scene()).args(["--format", format, "--out"]).arg(folder.path().join(name));
        assert!(export.output().unwrap().status.success(), "{format}");
        assert!(folder.path().join(name).exists());
    }
    // The view as one page.
    let mut page = splatvk();
    page.arg("export").arg(scene()).arg(folder.path().join("p.html")).args([
        "--title",
        "A <b> & c",
        "--json",
    ]);
    let output = page.output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let html = std::fs::read_to_string(folder.path().join("p.html")).unwrap();
    assert!(html.contains("<h1>A &lt;b&gt; &amp; c</h1>") && html.contains("id=\"v-splats\""));
    assert!(!html.contains("http:") && !html.contains("https:"), "nothing is fetched");
    let shown = told["splats"].as_u64().unwrap();
    assert!(shown > 1000 && html.matches("data:image/jpeg;base64,").count() == 2, "{told}");
    let page = |options: &[&str]| {
        let mut page = splatvk();
        page.arg("export").arg(scene()).arg(folder.path().join("q.html")).args(options);
        page
    };
    refuses(&mut page(&["--up", "z"]), 2, &["opens upright", "--up"]);
    refuses(&mut page(&["--format", "ply", "--title", "x"]), 2, &["--title"]);
    // The same scene, as if no photo showed its first hundred splats.
    let guessed = tempfile::tempdir().unwrap();
    std::fs::create_dir(guessed.path().join("cameras")).unwrap();
    for file in ["scene.json", "point_cloud.ply", "cameras/transforms.json"] {
        std::fs::copy(scene().join(file), guessed.path().join(file)).unwrap();
    }
    let mut pixels = npy::read(scene().join("seen.npy")).unwrap().to_f32();
    pixels[..100].fill(0.0);
    let all = Seen { pixels };
    npy::write(guessed.path().join("seen.npy"), &NpyArray::f32(&[all.pixels.len()], all.pixels.clone()))
        .unwrap();
    let mut seen = splatvk();
    seen.arg("export").arg(guessed.path()).args(["--format", "ply", "--force", "--out"]);
    assert!(seen.arg(folder.path().join("a.ply")).output().unwrap().status.success());
    let kept = splatvk::format::ply::read_splats(&folder.path().join("a.ply")).unwrap();
    assert!((100..all.pixels.len() / 2).contains(&all.unseen()), "{}", all.unseen());
    assert_eq!(kept.len(), all.pixels.len() - all.unseen());
    assert_eq!(names(folder.path()), ["a.ply", "a.splat", "model", "p.html", "renders", "t.json"]);
    let mut nothing = splatvk();
    nothing
        .arg("render")
        .arg(folder.path().join("model"))
        .arg("--cameras")
        .arg(&cameras)
        .arg("--out")
        .arg(folder.path().join("none"));
    refuses(&mut nothing, 2, &["not a scene directory"]);
}

#[test]
fn closed_pipe_exits_without_failure() {
    let mut child =
        splatvk().args(["models", "list"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.stderr.is_empty(), "{}", text(&output.stderr));
}

/// Every line of standard error as JSON.
fn events(stderr: &str) -> Vec<serde_json::Value> {
    stderr.lines().map(|l| serde_json::from_str(l).unwrap_or_else(|e| panic!("{e}: {l}"))).collect()
}

#[test]
fn json_logs_have_object_per_line() {
    let record = scene().join("run.json");
    let events_of_training = events(&std::fs::read_to_string(train_log()).unwrap());
    let events_of = |event: &str, stage: &str| -> Vec<&serde_json::Value> {
        events_of_training.iter().filter(|e| e["event"] == event && e["stage"] == stage).collect()
    };
    assert_eq!((events_of("begin", "splats").len(), events_of("end", "splats").len()), (1, 1));
    assert_eq!(events_of("begin", "splats")[0]["steps"], 20);
    let figures = events_of("figures", "splats");
    assert_eq!(figures.last().unwrap()["step"], 20);
    for f in &figures {
        let number = |name: &str| f[name].as_f64().unwrap();
        assert!(number("psnr") > 5.0 && number("loss") > 0.0 && number("splats") > 100.0, "{f}");
    }
    // The curves of the report are the same figures.
    let record: serde_json::Value = serde_json::from_slice(&std::fs::read(record).unwrap()).unwrap();
    let curves = record["statistics"]["curves"].as_array().unwrap();
    let psnr = curves.iter().find(|c| c["unit"] == "dB").unwrap()["points"].as_array().unwrap();
    assert_eq!(psnr.len(), figures.len());
    assert_eq!(psnr.last().unwrap()[1], figures.last().unwrap()["psnr"]);
    assert!(
        std::fs::read_to_string(scene().join("report.html")).unwrap().contains("PSNR of render and photo")
    );

    let output =
        splatvk().args(["--log", "json", "render", "nowhere", "--cameras", "x", "--out", "y"]).output();
    let output = output.unwrap();
    assert_eq!(output.status.code(), Some(2));
    let last = events(&text(&output.stderr)).pop().unwrap();
    assert_eq!((&last["event"], &last["exit_code"]), (&"error".into(), &2.into()));
    assert!(last["message"].as_str().unwrap().contains("nowhere"));
}
