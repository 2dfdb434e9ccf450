//! Outputs of commands: existing files are replaced only with --force, symbolic links and devices
//! never, and an output is written as a whole or not at all.
#![cfg(unix)]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod fixture;

use fixture::command::abandon;
use fixture::{data, scene, small_views};
use std::ffi::OsString;
use std::os::unix::fs::{FileTypeExt, symlink};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

fn splatvk(args: &[OsString]) -> Output {
    let mut c = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    c.env_remove("SPLATVK_MODELS").stdin(Stdio::null()).args(args).output().unwrap()
}

/// Expects exit code 2 and one line on standard error that contains the words.
fn assert_refused(args: &[OsString], words: &str) {
    let output = splatvk(args);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {stderr}");
    assert!(stderr.lines().count() == 1 && stderr.contains(words), "{args:?}: {words:?} is not in: {stderr}");
}

fn succeeds(args: &[OsString]) {
    let output = splatvk(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> =
        entries.map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    names
}

/// Command line that ends with the output path.
fn command_line(words: &str, place: &Path) -> Vec<OsString> {
    words.split(' ').map(argument).chain([place.into()]).collect()
}

/// Argument of a command: the path of a placeholder, or the word itself.
fn argument(name: &str) -> OsString {
    match name {
        "SCENE" => scene().into(),
        "CAMERAS" => scene().join("cameras/transforms.json").into(),
        "TRUTH" => data("breakfast").into(),
        "PHOTOS" => data("breakfast/images").into(),
        "IMAGES" => small_views().0.into(),
        "KNOWN" => small_views().1.into(),
        word => OsString::from(word),
    }
}

fn forced(mut line: Vec<OsString>) -> Vec<OsString> {
    line.push("--force".into());
    line
}

/// Commands that write a file; then those that write a folder.
const FILES: [&str; 7] = [
    "export SCENE --format ply --out",
    "export SCENE --format spz --out",
    "export SCENE --format sog --out",
    "export SCENE --format html --out",
    "export SCENE --format transforms --out",
    "mesh SCENE --format ply",
    "bench sort --keys 1000 --repeats 1 --json",
];
const FOLDERS: [&str; 7] = [
    "export SCENE --format colmap --out",
    "render SCENE --cameras CAMERAS --out",
    "render SCENE --path orbit --seconds 0.1 --fps 20 --out",
    "query SCENE lemon --out",
    "eval SCENE --ground-truth TRUTH --out",
    "bench --write-scene",
    "manuals",
];
/// Commands that replace their folder as a whole if it is a scene.
const SCENES: [&str; 2] = ["run PHOTOS --out", "train --images IMAGES --cameras KNOWN --out"];

#[test]
fn outputs_replace_only_with_force() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("letter");
    std::fs::write(&file, "precious").unwrap();
    let full = folder.path().join("full");
    std::fs::create_dir(&full).unwrap();
    std::fs::write(full.join("letter"), "precious").unwrap();
    for words in FILES {
        assert_refused(&command_line(words, &file), "--force");
        assert_refused(&forced(command_line(words, &full)), "a folder is in the way");
    }
    for words in FOLDERS {
        assert_refused(&command_line(words, &full), "--force");
        assert_refused(&forced(command_line(words, &file)), "a file is in the way");
    }
    for words in SCENES {
        assert_refused(&forced(command_line(words, &full)), "not a scene");
        assert_refused(&forced(command_line(words, &file)), "a file is in the way");
        assert_refused(&command_line(words, scene()), "--force");
    }
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "precious");
    assert_eq!(std::fs::read_to_string(full.join("letter")).unwrap(), "precious");
    assert_eq!(
        (names(folder.path()), names(&full)),
        (vec!["full".into(), "letter".into()], vec!["letter".into()])
    );
}

#[test]
fn outputs_never_replace_links_or_devices() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    std::fs::write(path_of("letter"), "precious").unwrap();
    std::fs::create_dir(path_of("empty")).unwrap();
    for (link, target) in [("to-file", "letter"), ("to-folder", "empty"), ("to-nothing", "nothing")] {
        symlink(path_of(target), path_of(link)).unwrap();
    }
    symlink(scene(), path_of("to-scene")).unwrap();
    for words in FILES.into_iter().chain(FOLDERS).chain(SCENES) {
        for link in ["to-file", "to-folder", "to-nothing", "to-scene"] {
            assert_refused(&forced(command_line(words, &path_of(link))), "symbolic link");
        }
        assert_refused(&forced(command_line(words, Path::new("/dev/null"))), "device");
    }
    assert!(std::fs::symlink_metadata("/dev/null").unwrap().file_type().is_char_device());
    assert_eq!(std::fs::read_to_string(path_of("letter")).unwrap(), "precious");
    assert!(
        names(&path_of("empty")).is_empty()
            && !path_of("nothing").exists()
            && scene().join("scene.json").is_file()
    );
    assert!(["to-file", "to-folder", "to-nothing", "to-scene"].iter().all(|l| path_of(l).is_symlink()));
}

#[test]
fn force_replaces_only_same_names() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    for (k, words) in FILES.into_iter().enumerate() {
        let file = path_of(&format!("file-{k}"));
        std::fs::write(&file, "old").unwrap();
        succeeds(&forced(command_line(words, &file)));
        assert!(std::fs::metadata(&file).unwrap().len() > 100, "{words}");
    }
    for (words, file) in [
        ("export SCENE --format colmap --out", "cameras.txt"),
        ("render SCENE --cameras CAMERAS --out", "train_00.png"),
        ("render SCENE --path orbit --seconds 0.1 --fps 20 --out", "frame_0000.png"),
        ("manuals", "splatvk.1"),
        ("bench --splats 100 --width 64 --height 48 --write-scene", "scene.json"),
    ] {
        let out = path_of("results").join(words.split(' ').next().unwrap());
        std::fs::create_dir_all(&out).unwrap();
        std::fs::write(out.join(file), "old").unwrap();
        std::fs::write(out.join("letter"), "precious").unwrap();
        succeeds(&forced(command_line(words, &out)));
        assert!(std::fs::metadata(out.join(file)).unwrap().len() > 100, "{words}");
        assert_eq!(std::fs::read_to_string(out.join("letter")).unwrap(), "precious");
        assert!(names(&out).iter().all(|n| !n.contains("partial")));
    }
}

#[test]
fn film_has_its_length_and_replaces_only_with_force() {
    let folder = tempfile::tempdir().unwrap();
    let film = folder.path().join("film.mp4");
    let line = command_line("render SCENE --path orbit --seconds 0.5 --fps 12 --out", &film);
    if Command::new("ffprobe").arg("-version").output().is_err() {
        return println!("SKIPPED: no ffmpeg here");
    }
    succeeds(&line);
    let mut probe = Command::new("ffprobe");
    probe.args(["-v", "error", "-count_frames", "-show_entries", "stream=nb_read_frames,r_frame_rate"]);
    let output = probe.args(["-of", "csv=p=0"]).arg(&film).output().unwrap();
    assert_eq!(String::from_utf8_lossy(&output.stdout).trim(), "12/1,6");
    assert_refused(&line, "--force");
    succeeds(&forced(line));
    // Without a path there is nothing to film.
    assert_refused(&command_line("render SCENE --cameras CAMERAS --out", &film), "--path orbit");
    assert_eq!(names(folder.path()), ["film.mp4"]);
}

#[test]
fn colmap_model_replaces_other_form() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("model");
    let forms = [("colmap", "txt"), ("colmap-bin", "bin"), ("colmap", "txt")];
    for (k, (format, ending)) in forms.into_iter().enumerate() {
        let line = command_line(&format!("export SCENE --format {format} --out"), &model);
        succeeds(&if k == 0 { line } else { forced(line) });
        std::fs::write(model.join("letter"), "precious").unwrap();
        let mut all: Vec<String> = ["cameras", "images", "points3D"].map(|n| format!("{n}.{ending}")).into();
        all.insert(2, "letter".into());
        assert_eq!(names(&model), all);
    }
    // A link is not removed, either.
    symlink(model.join("letter"), model.join("images.bin")).unwrap();
    assert_refused(&forced(command_line("export SCENE --format colmap --out", &model)), "symbolic link");
    assert!(model.join("images.bin").is_symlink() && model.join("images.txt").is_file());
}

#[test]
fn export_never_writes_into_scene() {
    let before = std::fs::read(scene().join("point_cloud.ply")).unwrap();
    for (format, place) in [("ply", "point_cloud.ply"), ("colmap", "cameras/colmap"), ("colmap", "cameras")] {
        let words = format!("export SCENE --format {format} --out");
        assert_refused(&forced(command_line(&words, &scene().join(place))), "a part of the scene");
    }
    assert_eq!(std::fs::read(scene().join("point_cloud.ply")).unwrap(), before);
}

/// Runs a command whose files are limited to a number of blocks of 512 bytes.
fn limited(blocks: u64, args: &[OsString]) -> Output {
    fixture::command::limited(blocks, fixture::command::splatvk().args(args)).output().unwrap()
}

#[test]
fn full_disk_leaves_no_partial_folder() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out/model");
    for format in ["colmap", "colmap-bin"] {
        // Cameras and images take less than a block of 512 bytes each, points more.
        let words = format!("export SCENE --format {format} --out");
        let output = limited(4, &command_line(&words, &out));
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(4), "{stderr}");
        assert!(stderr.lines().count() == 1 && stderr.contains("limit"), "{stderr}");
        assert!(names(folder.path()).is_empty(), "{:?}", names(folder.path()));
    }
    // Two files; the second is a zip archive.
    let file = folder.path().join("scene.splat");
    for blocks in [4, 16, 64, 256] {
        let output = limited(blocks, &command_line("export SCENE --format splat --out", &file));
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        let lines: Vec<&str> = stderr.lines().filter(|l| !l.starts_with("warning: ")).collect();
        assert!(
            output.status.code() == Some(4) && lines.len() == 1 && lines[0].starts_with("splatvk: "),
            "{stderr}"
        );
        assert!(names(folder.path()).is_empty(), "{blocks}: {:?}", names(folder.path()));
    }
    succeeds(&command_line("export SCENE --format colmap --out", &out));
    let before: Vec<Vec<u8>> = names(&out).iter().map(|n| std::fs::read(out.join(n)).unwrap()).collect();
    assert_eq!(
        limited(4, &forced(command_line("export SCENE --format colmap --out", &out))).status.code(),
        Some(4)
    );
    let after: Vec<Vec<u8>> = names(&out).iter().map(|n| std::fs::read(out.join(n)).unwrap()).collect();
    assert!(before.len() == 3 && before == after, "the old model is whole");
}

/// Runs `clean` in a folder with a home of its own, and returns its report of unfinished files.
fn clean_report(folder: &Path, extra: &[&str]) -> serde_json::Value {
    let mut clean = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    clean.env("SPLATVK_HOME", folder.join("home")).current_dir(folder).args(["clean", "--json"]).args(extra);
    let output = clean.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let rows = told["kept"].as_array().unwrap();
    rows.iter().find(|r| r["what"].as_str().unwrap().contains("unfinished")).unwrap().clone()
}

#[test]
fn leftovers_are_removed_later() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    let leave = || {
        for place in ["a.ply", "b.ply", "scene"] {
            abandon(&path_of(&format!(".{place}.partial-splatvk")), place);
        }
        abandon(&path_of("answers/.partial-splatvk"), "answers");
    };
    leave();
    succeeds(&command_line("export SCENE --format ply --out", &path_of("a.ply")));
    let kept = [".b.ply.partial-splatvk", ".scene.partial-splatvk", "a.ply", "answers"];
    assert_eq!(names(folder.path()), kept, "only those of the same place");
    // A folder that contains only a leftover counts as empty.
    succeeds(&command_line("export SCENE --format colmap --out", &path_of("answers")));
    assert_eq!(names(&path_of("answers")), ["cameras.txt", "images.txt", "points3D.txt"]);
    std::fs::remove_dir_all(path_of("answers")).unwrap();
    for name in [".b.ply.partial-splatvk", ".scene.partial-splatvk"] {
        std::fs::remove_dir_all(path_of(name)).unwrap();
    }
    leave();
    let told = clean_report(folder.path(), &[]);
    assert!(told["files"] == 4 && told["paths"].to_string().contains(".b.ply.partial-splatvk"), "{told}");
    assert!(path_of(".b.ply.partial-splatvk").exists(), "told, not deleted");
    let elsewhere = tempfile::tempdir().unwrap();
    abandon(&elsewhere.path().join(".c.ply.partial-splatvk"), "c.ply");
    let again = elsewhere.path().join("..").join(elsewhere.path().file_name().unwrap());
    let named = [elsewhere.path(), &again].map(|p| p.to_str().unwrap());
    assert_eq!(clean_report(folder.path(), &["--delete", named[0], named[1], "."])["files"], 5, "each once");
    assert_eq!(clean_report(folder.path(), &[])["files"], 0);
    assert_eq!(names(folder.path()), ["a.ply", "answers"]);
    assert!(names(elsewhere.path()).is_empty());
}

#[test]
fn clean_needs_owner_mark() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    std::fs::create_dir_all(path_of("precious/sub")).unwrap();
    std::fs::write(path_of("precious/sub/IMG.jpg"), "precious").unwrap();
    abandon(&path_of("precious/.x.partial-splatvk"), "x");
    std::fs::create_dir(path_of("work")).unwrap();
    for link in ["link.partial-99999999", ".link.partial-splatvk", ".partial-splatvk"] {
        symlink("../precious", path_of("work").join(link)).unwrap();
    }
    symlink("../precious/.x.partial-splatvk", path_of("work/.x.partial-splatvk")).unwrap();
    std::fs::write(path_of("work/notes.partial-20240115.md"), "precious").unwrap();
    std::fs::write(path_of("work/.a.partial-splatvk"), "precious").unwrap();
    for shoot in [".shoot.partial-20250101", ".shoot.partial-splatvk"] {
        std::fs::create_dir(path_of("work").join(shoot)).unwrap();
        std::fs::write(path_of("work").join(shoot).join("IMG.jpg"), "precious").unwrap();
    }
    let before = names(&path_of("work"));
    assert_eq!(clean_report(&path_of("work"), &["--delete"])["files"], 0);
    // A refused command leaves everything in place, even a leftover of splatvk.
    abandon(&path_of("work/.mine.partial-splatvk"), "mine");
    assert_refused(&command_line("render SCENE --cameras CAMERAS --out", &path_of("work")), "not empty");
    assert_refused(
        &command_line("export SCENE --format ply --out", &path_of("work/.a.partial-splatvk")),
        "--force",
    );
    assert_refused(&command_line("export SCENE --format ply --out", &path_of("work/shoot")), "bears no mark");
    assert!(path_of("work/.mine.partial-splatvk/owner").exists());
    std::fs::remove_dir_all(path_of("work/.mine.partial-splatvk")).unwrap();
    assert_eq!(names(&path_of("work")), before);
    for shoot in [".shoot.partial-20250101", ".shoot.partial-splatvk"] {
        assert!(path_of("work").join(shoot).join("IMG.jpg").exists());
    }
    assert!(
        path_of("precious/sub/IMG.jpg").exists() && path_of("precious/.x.partial-splatvk/owner").exists()
    );
}

#[test]
fn outputs_never_replace_foreign_files() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    // A project with a scene.json of its own that contains the photos.
    std::fs::create_dir_all(path_of("project/photos")).unwrap();
    std::fs::write(path_of("project/scene.json"), r#"{"three": true}"#).unwrap();
    for words in SCENES {
        assert_refused(&forced(command_line(words, &path_of("project"))), "not a scene");
    }
    copy(scene(), &path_of("room"));
    std::fs::write(path_of("room/.DS_Store"), "x").unwrap();
    let train = |images: &Path, cameras: &Path| {
        let line: [OsString; 9] = [
            "train".into(),
            "--images".into(),
            images.into(),
            "--cameras".into(),
            cameras.into(),
            "--iterations=1".into(),
            "--max-size=64".into(),
            "--sh-degree=0".into(),
            "--out".into(),
        ];
        forced(line.into_iter().chain([path_of("room").into()]).collect())
    };
    let (images, cameras, points) = small_views();
    // Foreign photos and notes in a scene.
    std::fs::create_dir(path_of("room/my-photos")).unwrap();
    std::fs::write(path_of("room/NOTES.txt"), "precious").unwrap();
    assert_refused(&train(&images, &cameras), "files of yours: NOTES.txt, my-photos;");
    std::fs::remove_dir(path_of("room/my-photos")).unwrap();
    std::fs::remove_file(path_of("room/NOTES.txt")).unwrap();
    // An input inside the scene itself.
    assert_refused(
        &train(&images, &path_of("room/cameras/original/transforms.json")),
        "is read, and lies in",
    );
    assert_refused(&train(&path_of("room/cameras/images"), &cameras), "is read, and lies in");
    let mut with_points = train(&images, &cameras);
    with_points.extend(["--points".into(), path_of("room/point_cloud.ply").into()]);
    assert_refused(&with_points, "is read, and lies in");
    let export = format!("export {} --format ply --out", points.display());
    assert_refused(&forced(command_line(&export, &points)), "is read, and lies in");
    let render = format!("render {0} --cameras {0}/cameras/transforms.json --out", path_of("room").display());
    assert_refused(
        &forced(command_line(&render, &path_of("room/cameras/images"))),
        "what this command reads",
    );
    assert!(path_of("room/scene.json").exists() && path_of("room/cameras/images").exists());
    // A scene without foreign files is replaced.
    let before = std::fs::read(path_of("room/run.json")).unwrap();
    let mut whole = train(&images, &cameras);
    whole.extend(["--points".into(), points.into()]);
    succeeds(&whole);
    assert!(
        std::fs::read(path_of("room/run.json")).unwrap() != before && !path_of("room/.DS_Store").exists()
    );
    assert_eq!(names(folder.path()), ["project", "room"]);
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().map(|e| e.unwrap()) {
        let to = to.join(entry.file_name());
        match entry.path().is_dir() {
            true => copy(&entry.path(), &to),
            false => drop(std::fs::copy(entry.path(), to).unwrap()),
        }
    }
}

#[test]
fn concurrent_output_is_refused() {
    for words in [
        "train --images IMAGES --cameras KNOWN --iterations 1000000 --out",
        "bench training --splats 2000 --seconds 600 --json",
    ] {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("out");
        let mut first = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        first.env_remove("SPLATVK_MODELS").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut first = first.args(command_line(words, &place)).spawn().unwrap();
        let marks =
            [".out.partial-splatvk/owner", "out/.partial-splatvk/owner"].map(|m| folder.path().join(m));
        let begun = Instant::now();
        while !marks.iter().any(|m| m.metadata().is_ok_and(|m| m.len() > 0)) {
            assert!(begun.elapsed() < Duration::from_secs(60), "{words}: nothing is reserved");
            std::thread::sleep(Duration::from_millis(20));
        }
        let name = format!("process {}", first.id());
        for again in [command_line(words, &place), forced(command_line(words, &place))] {
            assert_refused(&again, &name);
        }
        assert_refused(
            &command_line("export SCENE --format ply --out", &place),
            if place.is_dir() { "folder" } else { &name },
        );
        // A killed command does not block others.
        first.kill().unwrap();
        first.wait().unwrap();
        assert_eq!(clean_report(folder.path(), &["--delete"])["files"], 1, "{words}");
        std::fs::remove_dir_all(folder.path().join("home")).ok();
        let left: Vec<String> = names(folder.path()).into_iter().filter(|n| n != "out").collect();
        assert!(left.is_empty() && (!place.is_dir() || names(&place).is_empty()), "{left:?}");
    }
}

/// Interrupts commands that run longer than the test, after they have started to write.
#[test]
fn terminated_command_leaves_nothing() {
    let lines = [
        "train --images IMAGES --cameras KNOWN --iterations 1000000 --out",
        "bench training --splats 2000 --seconds 600 --json",
    ];
    for words in lines {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("out");
        let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        command
            .env_remove("SPLATVK_MODELS")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped());
        let child = command.args(command_line(words, &place)).spawn().unwrap();
        std::thread::sleep(Duration::from_secs(2));
        let told = Instant::now();
        Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
        let output = child.wait_with_output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(130), "{words}: {stderr}");
        // 2 s are promised (docs/internals/trust.md#faults); other tests run beside this one.
        assert!(told.elapsed() < Duration::from_secs(10), "{words}: {:?}", told.elapsed());
        assert_eq!(names(folder.path()), Vec::<String>::new(), "{words}: {stderr}");
    }
}
