//! Generated data and the tables on it, by the program.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is how a test fails
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

fn splatlab(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_splatlab")).args(args).output().unwrap()
}

fn run(args: &[&str]) -> serde_json::Value {
    let output = splatlab(args);
    assert!(output.status.success(), "{args:?}\n{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn ablate_measures_generated_scene() {
    let folder = tempfile::tempdir().unwrap();
    let (data, out) = (folder.path().join("data"), folder.path().join("tables"));
    let small = [
        "--size",
        "160x120",
        "--views",
        "3",
        "--held-out",
        "2",
        "--objects",
        "4",
        "--seed",
        "1000",
        "--json",
    ];
    run(&[&["generate", "--out", path(&data)], &small[..]].concat());
    let short = ["--iterations", "10", "--language-iterations", "2", "--true-cameras", "--json"];
    let report = run(&[
        &["ablate", "bijection", "--data", path(&data), "--out", path(&out), "--regions", "exact"],
        &short[..],
    ]
    .concat());
    let rows = report["tables"][0]["rows"].as_array().unwrap();
    assert_eq!(rows.len(), 5);
    let figure = |row: usize, name: &str| rows[row]["figures"][name].as_f64();
    // The bijection keeps every embedding; mIoU is low because objects are small in these photos.
    assert!(
        figure(0, "SIM").unwrap() > figure(2, "SIM").unwrap() && figure(0, "mIoU").unwrap() > 0.3,
        "{rows:?}"
    );
    // Exact masks have few codes, which one basis holds as well as another.
    assert!(figure(4, "mIoU").unwrap() > figure(0, "mIoU").unwrap() - 0.05, "{rows:?}");
    assert!(figure(4, "MB").unwrap() > 10.0 * figure(0, "MB").unwrap(), "{rows:?}");
    for file in ["bijection.txt", "bijection.svg", "ablate.json"] {
        assert!(out.join(file).metadata().unwrap().len() > 100, "{file}");
    }
}

/// Two scenes and an unreadable one, with two seeds: shared stages run once, the unreadable scene
/// becomes a note, and the second call takes every row from the first.
#[test]
#[ignore = "takes long: tools/test-long"]
fn ablate_spreads_scenes_and_seeds() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    let small = ["--size", "160x120", "--views", "3", "--held-out", "2", "--objects", "4"];
    for (name, seed) in [("a", "1000"), ("b", "1001"), ("broken", "1000")] {
        let made =
            splatlab(&[&["generate", "--out", path(&path_of(name)), "--seed", seed], &small[..]].concat());
        assert!(made.status.success());
    }
    std::fs::remove_dir_all(path_of("broken/images")).unwrap();
    let (a, b, broken, out) = (path_of("a"), path_of("b"), path_of("broken"), path_of("out"));
    let ablate = || {
        let mut args =
            vec!["--log", "json", "ablate", "alignment", "--data", path(&broken), path(&a), path(&b)];
        args.extend([
            "--seeds",
            "0,1",
            "--regions",
            "exact",
            "--true-cameras",
            "--out",
            path(&out),
            "--resume",
            "--json",
        ]);
        args.extend(["--iterations", "5", "--language-iterations", "1", "--max-points", "5000"]);
        let output = splatlab(&args);
        let log = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{log}");
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let begun = move |stage: &str| {
            let events = log.lines().filter_map(|l| serde_json::from_str::<serde_json::Value>(l).ok());
            events.filter(|e| e["event"] == "begin" && e["stage"] == stage).count()
        };
        (report, begun)
    };
    let (report, begun) = ablate();
    let row = &report["tables"][0]["rows"][0];
    assert_eq!(
        (row["spread"]["mIoU"]["n"].as_u64(), row["difference"]["scenes"].as_u64()),
        (Some(4), Some(2))
    );
    assert!(
        row["spread"]["mIoU"]["sd"].as_f64().unwrap() > 0.0 && row["difference"]["half"].is_f64(),
        "{row}"
    );
    let note = row["note"].as_str().unwrap();
    assert!(note.starts_with("2 of 6 failed, first broken with seed 0: "), "{note}");
    // Cameras are given, so that stages before stereo use no random numbers: features run once per
    // scene, training once per scene and seed.
    assert_eq!((begun("features"), begun("splats")), (2, 4));
    let text = std::fs::read_to_string(out.join("alignment.txt")).unwrap();
    assert!(text.contains(" ± ") && text.contains("Δ mIoU"), "{text}");
    let (again, begun) = ablate();
    assert_eq!((begun("features"), begun("splats")), (0, 0));
    // Numbers may change in their last digit when they are written and read.
    let row = &again["tables"][0]["rows"][0];
    let miou = |row: &serde_json::Value| row["figures"]["mIoU"].as_f64().unwrap();
    assert!((miou(row) - miou(&report["tables"][0]["rows"][0])).abs() < 1e-12, "{row}");
    assert_eq!((row["spread"]["mIoU"]["n"].as_u64(), row["note"].as_str()), (Some(4), Some(note)));
}

#[test]
fn invalid_options_exit_with_code_two() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let o = path(&out);
    let breakfast = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/breakfast");
    for (args, cause) in [
        (vec!["generate", "--out", o, "--size", "wide"], "640x480"),
        (vec!["generate", "--out", o, "--objects", "40"], "--objects"),
        (vec!["generate", "--out", o, "--wrong", "2"], "--wrong"),
        (vec!["generate", "--out", o, "--from", o], "ground_truth.json"),
        (vec!["generate", "--out", o, "--phone", "--jpeg", "0"], "--jpeg"),
        (vec!["ablate", "all", "--data", o, "--out", o], "ground_truth.json"),
        (vec!["ablate", "all", "--data", breakfast, "--out", o, "--regions", "clip"], "--regions clip"),
        (vec!["ablate", "all", "--data", breakfast, "--out", o, "--iterations", "0"], "--iterations 0"),
        (vec!["ablate", "all", "--data", breakfast, breakfast, "--out", o], "the same folder twice"),
        (vec!["ablate", "all", "--data", breakfast, "--out", o, "--seeds", "1,1"], "the same seed twice"),
        (vec!["ablate", "all", "--data", breakfast, "--out", o, "--matcher", "sift"], "--matcher sift"),
        (vec!["ablate", "all", "--data", breakfast, "--out", o, "--layout", "lerf"], "LERF-OVS"),
    ] {
        let output = splatlab(&args);
        let text = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{args:?}\n{text}");
        assert!(text.lines().count() == 1 && text.contains(cause), "{args:?}\n{text}");
        assert!(!out.exists(), "{args:?} created the output folder");
    }
}

/// A second command for the output folder of a running process is refused; a command that SIGTERM
/// stops leaves no files.
#[cfg(unix)]
#[test]
fn output_folder_has_one_writer() {
    let breakfast = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/breakfast");
    for words in [
        &["generate", "--size", "1600x1200", "--views", "40"][..],
        &["ablate", "alignment", "--data", breakfast, "--seeds", "1,2,3,4,5,6,7,8"],
    ] {
        let folder = tempfile::tempdir().unwrap();
        let place = folder.path().join("out");
        let mut first = Command::new(env!("CARGO_BIN_EXE_splatlab"));
        first.args(words).arg("--out").arg(&place).stdout(Stdio::null()).stderr(Stdio::null());
        let mut first = first.spawn().unwrap();
        let owner_files =
            [".out.partial-splatvk/owner", "out/.partial-splatvk/owner"].map(|m| folder.path().join(m));
        let begun = Instant::now();
        while !owner_files.iter().any(|f| f.metadata().is_ok_and(|m| m.len() > 0)) {
            assert!(begun.elapsed() < Duration::from_secs(60), "{words:?}: nothing is reserved");
            std::thread::sleep(Duration::from_millis(20));
        }
        let second = splatlab(&[words, &["--out", path(&place), "--force"]].concat());
        let text = String::from_utf8_lossy(&second.stderr).into_owned();
        assert_eq!(second.status.code(), Some(2), "{text}");
        assert!(text.contains(&format!("process {}", first.id())), "{text}");
        Command::new("kill").args(["-TERM", &first.id().to_string()]).status().unwrap();
        assert_eq!(first.wait().unwrap().code(), Some(130));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "{words:?}");
    }
}

fn assert_refused(args: &[&str], says: &str) {
    let output = splatlab(args);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && text.contains(says), "{args:?}: {text}");
}

/// Generated data replaces generated data only.
#[cfg(unix)]
#[test]
fn force_replaces_only_pure_data_sets() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    let names = |folder: &Path| {
        let entries =
            std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        std::collections::BTreeSet::from_iter(entries)
    };
    let (data, regions) = (path_of("data"), path_of("regions"));
    let generate = |views: &'static str, force: &'static [&'static str]| {
        let small = ["--views", views, "--held-out", "0", "--size", "96x72", "--objects", "2"];
        [&["generate", "--out", path(&data)], &small[..], force].concat()
    };
    let succeeds = |args: &[&str]| assert!(splatlab(args).status.success(), "{args:?}");
    succeeds(&generate("3", &[]));
    assert_refused(&generate("2", &[]), "--force");
    let from = ["generate", "--from", path(&data), "--out"];
    assert_refused(&[&from[..], &[path(&data), "--force"]].concat(), "is read, and lies in");
    succeeds(&generate("2", &["--force"]));
    assert_eq!(names(&data.join("images")).len(), 2, "no photo of the older data");
    succeeds(&[&from[..], &[path(&regions)]].concat());
    succeeds(&[&from[..], &[path(&regions), "--force"]].concat());
    std::fs::write(data.join("letter"), "precious").unwrap();
    assert_refused(&generate("2", &["--force"]), "files of yours: letter;");
    assert_eq!(std::fs::read_to_string(data.join("letter")).unwrap(), "precious");
    std::fs::create_dir(path_of("full")).unwrap();
    std::fs::write(path_of("full/letter"), "precious").unwrap();
    let full = path_of("full");
    assert_refused(&["generate", "--out", path(&full), "--force"], "not empty and not generated data");
    let link = path_of("link");
    std::os::unix::fs::symlink(&full, &link).unwrap();
    assert_refused(&["generate", "--out", path(&link)], "symbolic link");
    assert_eq!(Vec::from_iter(names(folder.path())), ["data", "full", "link", "regions"]);
}
