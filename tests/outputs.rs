//! The rule for everything that a command writes where a user says: never over what is there
//! without --force, never over a symbolic link or a device, all of it or none.
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

/// The command must end with exit code 2 and one line on standard error that contains the words.
fn refused(args: &[OsString], words: &str) {
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

/// A command line that ends with the place to write to.
fn line(words: &str, place: &Path) -> Vec<OsString> {
    let path = |name: &str| match name {
        "SCENE" => scene().into(),
        "CAMERAS" => scene().join("cameras/transforms.json").into(),
        "TRUTH" => data("breakfast").into(),
        "PHOTOS" => data("breakfast/images").into(),
        "IMAGES" => small_views().0.into(),
        "KNOWN" => small_views().1.into(),
        word => OsString::from(word),
    };
    words.split(' ').map(path).chain([place.into()]).collect()
}

fn forced(mut line: Vec<OsString>) -> Vec<OsString> {
    line.push("--force".into());
    line
}

/// Commands that write a file, and those that write a folder.
const FILES: [&str; 4] = [
    "export SCENE --format ply --out",
    "export SCENE --format spz --out",
    "export SCENE --format transforms --out",
    "bench sort --keys 1000 --repeats 1 --json",
];
const FOLDERS: [&str; 6] = [
    "export SCENE --format colmap --out",
    "render SCENE --cameras CAMERAS --out",
    "query SCENE lemon --out",
    "eval SCENE --ground-truth TRUTH --out",
    "bench --write-scene",
    "manuals",
];
/// Those whose folder is replaced as a whole, where it is a scene.
const SCENES: [&str; 2] = ["run PHOTOS --out", "train --images IMAGES --cameras KNOWN --out"];

#[test]
fn nothing_is_written_over_without_force() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("letter");
    std::fs::write(&file, "precious").unwrap();
    let full = folder.path().join("full");
    std::fs::create_dir(&full).unwrap();
    std::fs::write(full.join("letter"), "precious").unwrap();
    for words in FILES {
        refused(&line(words, &file), "--force");
        refused(&forced(line(words, &full)), "a folder is in the way");
    }
    for words in FOLDERS {
        refused(&line(words, &full), "--force");
        refused(&forced(line(words, &file)), "a file is in the way");
    }
    for words in SCENES {
        refused(&forced(line(words, &full)), "not a scene");
        refused(&forced(line(words, &file)), "a file is in the way");
        refused(&line(words, scene()), "--force");
    }
    refused(&forced(line("generate --out", &full)), "not empty and not generated data");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "precious");
    assert_eq!(std::fs::read_to_string(full.join("letter")).unwrap(), "precious");
    assert_eq!(
        (names(folder.path()), names(&full)),
        (vec!["full".into(), "letter".into()], vec!["letter".into()])
    );
}

#[test]
fn links_and_devices_are_never_written_over() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("letter"), "precious").unwrap();
    std::fs::create_dir(at("empty")).unwrap();
    for (link, target) in [("to-file", "letter"), ("to-folder", "empty"), ("to-nothing", "nothing")] {
        symlink(at(target), at(link)).unwrap();
    }
    symlink(scene(), at("to-scene")).unwrap();
    for words in FILES.into_iter().chain(FOLDERS).chain(SCENES) {
        for link in ["to-file", "to-folder", "to-nothing", "to-scene"] {
            refused(&forced(line(words, &at(link))), "symbolic link");
        }
        refused(&forced(line(words, Path::new("/dev/null"))), "device");
    }
    refused(&line("generate --out", &at("to-folder")), "symbolic link");
    assert!(std::fs::symlink_metadata("/dev/null").unwrap().file_type().is_char_device());
    assert_eq!(std::fs::read_to_string(at("letter")).unwrap(), "precious");
    assert!(
        names(&at("empty")).is_empty() && !at("nothing").exists() && scene().join("scene.json").is_file()
    );
    assert!(["to-file", "to-folder", "to-nothing", "to-scene"].iter().all(|l| at(l).is_symlink()));
}

#[test]
fn with_force_files_of_the_same_names_are_replaced_and_others_stay() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for (k, words) in FILES.into_iter().enumerate() {
        let file = at(&format!("file-{k}"));
        std::fs::write(&file, "old").unwrap();
        succeeds(&forced(line(words, &file)));
        assert!(std::fs::metadata(&file).unwrap().len() > 100, "{words}");
    }
    for (words, file) in [
        ("export SCENE --format colmap --out", "cameras.txt"),
        ("render SCENE --cameras CAMERAS --out", "train_00.png"),
        ("manuals", "splatvk.1"),
        ("bench --splats 100 --width 64 --height 48 --write-scene", "scene.json"),
    ] {
        let out = at("results").join(words.split(' ').next().unwrap());
        std::fs::create_dir_all(&out).unwrap();
        std::fs::write(out.join(file), "old").unwrap();
        std::fs::write(out.join("letter"), "precious").unwrap();
        succeeds(&forced(line(words, &out)));
        assert!(std::fs::metadata(out.join(file)).unwrap().len() > 100, "{words}");
        assert_eq!(std::fs::read_to_string(out.join("letter")).unwrap(), "precious");
        assert!(names(&out).iter().all(|n| !n.contains("partial")));
    }
}

#[test]
fn generated_data_is_replaced_as_a_whole_and_only_where_nothing_else_lies_in_it() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    let words = |views: u32| format!("generate --seed 1000 --size 64x64 --views {views} --held-out 0 --out");
    succeeds(&line(&words(3), &data));
    refused(&line(&words(2), &data), "--force");
    let regions = format!("generate --from {} --out", data.display());
    refused(&forced(line(&regions, &data)), "is read, and lies in");
    succeeds(&forced(line(&words(2), &data)));
    assert_eq!(names(&data.join("images")), ["train_00.jpg", "train_01.jpg"], "no photo of the older data");
    let regions = format!("generate --from {} --out", data.display());
    let out = folder.path().join("regions");
    succeeds(&line(&regions, &out));
    succeeds(&forced(line(&regions, &out)));
    std::fs::write(data.join("letter"), "precious").unwrap();
    refused(&forced(line(&words(2), &data)), "did not write: letter;");
    assert_eq!(std::fs::read_to_string(data.join("letter")).unwrap(), "precious");
    assert_eq!(names(folder.path()), ["data", "regions"]);
}

#[test]
fn a_model_in_one_form_replaces_that_in_the_other() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("model");
    let forms = [("colmap", "txt"), ("colmap-bin", "bin"), ("colmap", "txt")];
    for (k, (format, ending)) in forms.into_iter().enumerate() {
        let line = line(&format!("export SCENE --format {format} --out"), &model);
        succeeds(&if k == 0 { line } else { forced(line) });
        std::fs::write(model.join("letter"), "precious").unwrap();
        let mut all: Vec<String> = ["cameras", "images", "points3D"].map(|n| format!("{n}.{ending}")).into();
        all.insert(2, "letter".into());
        assert_eq!(names(&model), all);
    }
    // What may not be written over may not be removed either.
    symlink(model.join("letter"), model.join("images.bin")).unwrap();
    refused(&forced(line("export SCENE --format colmap --out", &model)), "symbolic link");
    assert!(model.join("images.bin").is_symlink() && model.join("images.txt").is_file());
}

#[test]
fn a_scene_is_not_written_into_by_its_own_export() {
    let before = std::fs::read(scene().join("point_cloud.ply")).unwrap();
    for (format, place) in [("ply", "point_cloud.ply"), ("colmap", "cameras/colmap"), ("colmap", "cameras")] {
        let words = format!("export SCENE --format {format} --out");
        refused(&forced(line(&words, &scene().join(place))), "a part of the scene");
    }
    assert_eq!(std::fs::read(scene().join("point_cloud.ply")).unwrap(), before);
}

/// With files of at most so many blocks of 512 bytes.
fn limited(blocks: u64, args: &[OsString]) -> Output {
    fixture::command::limited(blocks, fixture::command::splatvk().args(args)).output().unwrap()
}

#[test]
fn a_full_disk_leaves_no_half_of_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out/model");
    for format in ["colmap", "colmap-bin"] {
        // Cameras and images take less than a block of 512 bytes each, points more.
        let words = format!("export SCENE --format {format} --out");
        let output = limited(4, &line(&words, &out));
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{stderr}");
        assert!(stderr.lines().count() == 1 && stderr.contains("limit"), "{stderr}");
        assert!(names(folder.path()).is_empty(), "{:?}", names(folder.path()));
    }
    // Two files, of which the second is a zip archive.
    let file = folder.path().join("scene.splat");
    for blocks in [4, 16, 64, 256] {
        let output = limited(blocks, &line("export SCENE --format splat --out", &file));
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        let lines: Vec<&str> = stderr.lines().filter(|l| !l.starts_with("warning: ")).collect();
        assert!(
            output.status.code() == Some(2) && lines.len() == 1 && lines[0].starts_with("splatvk: "),
            "{stderr}"
        );
        assert!(names(folder.path()).is_empty(), "{blocks}: {:?}", names(folder.path()));
    }
    succeeds(&line("export SCENE --format colmap --out", &out));
    let before: Vec<Vec<u8>> = names(&out).iter().map(|n| std::fs::read(out.join(n)).unwrap()).collect();
    assert_eq!(limited(4, &forced(line("export SCENE --format colmap --out", &out))).status.code(), Some(2));
    let after: Vec<Vec<u8>> = names(&out).iter().map(|n| std::fs::read(out.join(n)).unwrap()).collect();
    assert!(before.len() == 3 && before == after, "the old model is whole");
}

/// `clean` in a folder, with a home of its own: what it says of unfinished files.
fn cleaned(folder: &Path, extra: &[&str]) -> serde_json::Value {
    let mut clean = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    clean.env("SPLATVK_HOME", folder.join("home")).current_dir(folder).args(["clean", "--json"]).args(extra);
    let output = clean.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let rows = told["kept"].as_array().unwrap();
    rows.iter().find(|r| r["what"].as_str().unwrap().contains("unfinished")).unwrap().clone()
}

#[test]
fn leftovers_of_killed_commands_go_with_the_next_and_with_clean() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let leave = || {
        for place in ["a.ply", "b.ply", "scene"] {
            abandon(&at(&format!(".{place}.partial-splatvk")), place);
        }
        abandon(&at("answers/.partial-splatvk"), "answers");
    };
    leave();
    succeeds(&line("export SCENE --format ply --out", &at("a.ply")));
    let kept = [".b.ply.partial-splatvk", ".scene.partial-splatvk", "a.ply", "answers"];
    assert_eq!(names(folder.path()), kept, "only those of the same place");
    // A folder with nothing but a leftover is empty.
    succeeds(&line("export SCENE --format colmap --out", &at("answers")));
    assert_eq!(names(&at("answers")), ["cameras.txt", "images.txt", "points3D.txt"]);
    std::fs::remove_dir_all(at("answers")).unwrap();
    for name in [".b.ply.partial-splatvk", ".scene.partial-splatvk"] {
        std::fs::remove_dir_all(at(name)).unwrap();
    }
    leave();
    let told = cleaned(folder.path(), &[]);
    assert!(told["files"] == 4 && told["paths"].to_string().contains(".b.ply.partial-splatvk"), "{told}");
    assert!(at(".b.ply.partial-splatvk").exists(), "told, not deleted");
    let elsewhere = tempfile::tempdir().unwrap();
    abandon(&elsewhere.path().join(".c.ply.partial-splatvk"), "c.ply");
    let again = elsewhere.path().join("..").join(elsewhere.path().file_name().unwrap());
    let named = [elsewhere.path(), &again].map(|p| p.to_str().unwrap());
    assert_eq!(cleaned(folder.path(), &["--delete", named[0], named[1], "."])["files"], 5, "each once");
    assert_eq!(cleaned(folder.path(), &[])["files"], 0);
    assert_eq!(names(folder.path()), ["a.ply", "answers"]);
    assert!(names(elsewhere.path()).is_empty());
}

#[test]
fn clean_deletes_nothing_without_an_owners_mark() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    std::fs::create_dir_all(at("precious/sub")).unwrap();
    std::fs::write(at("precious/sub/IMG.jpg"), "precious").unwrap();
    abandon(&at("precious/.x.partial-splatvk"), "x");
    std::fs::create_dir(at("work")).unwrap();
    for link in ["link.partial-99999999", ".link.partial-splatvk", ".partial-splatvk"] {
        symlink("../precious", at("work").join(link)).unwrap();
    }
    symlink("../precious/.x.partial-splatvk", at("work/.x.partial-splatvk")).unwrap();
    std::fs::write(at("work/notes.partial-20240115.md"), "precious").unwrap();
    std::fs::write(at("work/.a.partial-splatvk"), "precious").unwrap();
    for shoot in [".shoot.partial-20250101", ".shoot.partial-splatvk"] {
        std::fs::create_dir(at("work").join(shoot)).unwrap();
        std::fs::write(at("work").join(shoot).join("IMG.jpg"), "precious").unwrap();
    }
    let before = names(&at("work"));
    assert_eq!(cleaned(&at("work"), &["--delete"])["files"], 0);
    // A refused command, too, leaves everything, and a leftover of our own.
    abandon(&at("work/.mine.partial-splatvk"), "mine");
    refused(&line("render SCENE --cameras CAMERAS --out", &at("work")), "not empty");
    refused(&line("export SCENE --format ply --out", &at("work/.a.partial-splatvk")), "--force");
    refused(&line("export SCENE --format ply --out", &at("work/shoot")), "bears no mark");
    assert!(at("work/.mine.partial-splatvk/owner").exists());
    std::fs::remove_dir_all(at("work/.mine.partial-splatvk")).unwrap();
    assert_eq!(names(&at("work")), before);
    for shoot in [".shoot.partial-20250101", ".shoot.partial-splatvk"] {
        assert!(at("work").join(shoot).join("IMG.jpg").exists());
    }
    assert!(at("precious/sub/IMG.jpg").exists() && at("precious/.x.partial-splatvk/owner").exists());
}

#[test]
fn foreign_files_and_inputs_are_never_replaced() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    // A project that has a scene.json of its own, with the photos in it.
    std::fs::create_dir_all(at("project/photos")).unwrap();
    std::fs::write(at("project/scene.json"), r#"{"three": true}"#).unwrap();
    for words in SCENES {
        refused(&forced(line(words, &at("project"))), "not a scene");
    }
    copy(scene(), &at("room"));
    std::fs::write(at("room/.DS_Store"), "x").unwrap();
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
        forced(line.into_iter().chain([at("room").into()]).collect())
    };
    let (images, cameras, points) = small_views();
    // Photos and notes that somebody has put into a scene.
    std::fs::create_dir(at("room/my-photos")).unwrap();
    std::fs::write(at("room/NOTES.txt"), "precious").unwrap();
    refused(&train(&images, &cameras), "did not write: NOTES.txt, my-photos;");
    std::fs::remove_dir(at("room/my-photos")).unwrap();
    std::fs::remove_file(at("room/NOTES.txt")).unwrap();
    // What the scene itself has, as an input.
    refused(&train(&images, &at("room/cameras/original/transforms.json")), "is read, and lies in");
    refused(&train(&at("room/cameras/images"), &cameras), "is read, and lies in");
    let mut with_points = train(&images, &cameras);
    with_points.extend(["--points".into(), at("room/point_cloud.ply").into()]);
    refused(&with_points, "is read, and lies in");
    let export = format!("export {} --format ply --out", points.display());
    refused(&forced(line(&export, &points)), "is read, and lies in");
    let render = format!("render {0} --cameras {0}/cameras/transforms.json --out", at("room").display());
    refused(&forced(line(&render, &at("room/cameras/images"))), "what this command reads");
    assert!(at("room/scene.json").exists() && at("room/cameras/images").exists());
    // A scene with nothing else in it is replaced.
    let before = std::fs::read(at("room/run.json")).unwrap();
    let mut whole = train(&images, &cameras);
    whole.extend(["--points".into(), points.into()]);
    succeeds(&whole);
    assert!(std::fs::read(at("room/run.json")).unwrap() != before && !at("room/.DS_Store").exists());
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
fn second_command_for_one_place_is_refused() {
    for words in [
        "train --images IMAGES --cameras KNOWN --iterations 1000000 --out",
        "bench training --splats 2000 --seconds 600 --json",
    ] {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("out");
        let mut first = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        first.env_remove("SPLATVK_MODELS").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let mut first = first.args(line(words, &place)).spawn().unwrap();
        let marks =
            [".out.partial-splatvk/owner", "out/.partial-splatvk/owner"].map(|m| folder.path().join(m));
        let begun = Instant::now();
        while !marks.iter().any(|m| m.metadata().is_ok_and(|m| m.len() > 0)) {
            assert!(begun.elapsed() < Duration::from_secs(60), "{words}: nothing is reserved");
            std::thread::sleep(Duration::from_millis(20));
        }
        let name = format!("process {}", first.id());
        for again in [line(words, &place), forced(line(words, &place))] {
            refused(&again, &name);
        }
        refused(
            &line("export SCENE --format ply --out", &place),
            if place.is_dir() { "folder" } else { &name },
        );
        // Killed, it is in nobody's way.
        first.kill().unwrap();
        first.wait().unwrap();
        assert_eq!(cleaned(folder.path(), &["--delete"])["files"], 1, "{words}");
        std::fs::remove_dir_all(folder.path().join("home")).ok();
        let left: Vec<String> = names(folder.path()).into_iter().filter(|n| n != "out").collect();
        assert!(left.is_empty() && (!place.is_dir() || names(&place).is_empty()), "{left:?}");
    }
}

/// Commands that take longer than the test, each with what it has written when it is told to stop.
#[test]
fn told_to_stop_a_command_leaves_nothing() {
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
        let child = command.args(line(words, &place)).spawn().unwrap();
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
