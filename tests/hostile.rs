//! Files that somebody else made, as the program meets them: one clear line, exit code 2, nothing
//! half-written.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod fixture;

use splatvk::format::{cameras, gaussians, npy, ply, scene_dir};
use splatvk::scene::{Camera, Codebook, LanguageField, LevelField, Pose, Seen, Splats, World};
use std::path::Path;
use std::process::{Command, Output, Stdio};

fn splatvk(arguments: &[&str]) -> Output {
    let mut c = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    c.env_remove("SPLATVK_MODELS").stdin(Stdio::null()).args(arguments).output().unwrap()
}

/// Must end with `code` and one error line of bounded length without control characters, which
/// contains the words.
fn refuses(code: i32, arguments: &[&str], words: &[&str]) {
    let output = splatvk(arguments);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{arguments:?}\n{stderr}");
    let line = stderr.strip_suffix('\n').unwrap();
    assert!(line.starts_with("splatvk: ") && !line.contains(char::is_control), "{line:?}");
    assert!(line.chars().count() <= 1100, "{} characters", line.chars().count());
    for word in words {
        assert!(line.contains(word), "{word:?} is not in: {line}");
    }
}

fn splats(n: usize) -> Splats {
    Splats {
        means: (0..n).map(|i| [i as f32 * 0.1, 0.2, 3.0]).collect(),
        log_scales: vec![[-3.0; 3]; n],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![1.0; n],
        sh_degree: 0,
        sh: vec![0.3; 3 * n],
        antialiased: false,
    }
}

fn field(n: usize) -> LanguageField {
    let codebook = Codebook {
        embedding_dim: 2,
        code_dim: 1,
        embeddings: vec![0.6, 0.8],
        codes: vec![1.0],
        weights: vec![9.0],
        members: vec![Vec::new()],
        min_chord: 2.0,
    };
    let level = LevelField { codebook, features: vec![1.0; n], ..LevelField::default() };
    LanguageField { levels: vec![level, LevelField::default(), LevelField::default()], space: "x".into() }
}

/// Puts a number in the place of one of a binary PLY of degree 0.
fn poison(path: &Path, row: usize, column: usize, value: f32) {
    let mut bytes = std::fs::read(path).unwrap();
    let body = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let width = (bytes.len() - body) / 50;
    bytes[body + row * width + 4 * column..][..4].copy_from_slice(&value.to_le_bytes());
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn camera_files_are_checked_when_they_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    gaussians::write(at("a.ply").as_ref(), &splats(3), None).unwrap();
    let frame = |name: &str, w: f64| {
        serde_json::json!({ "fl_x": 50, "w": w, "h": 48, "frames": [{
            "file_path": name, "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        }] })
        .to_string()
    };
    let (out, scene) = (at("out"), at("a.ply"));
    let refused = |cameras: &str, words: &[&str]| {
        refuses(2, &["render", &scene, "--cameras", cameras, "--out", &out], words);
        assert!(!Path::new(&out).exists(), "{cameras} left something behind");
    };
    for (text, words) in [
        (frame("a", 1e6), "1000000 × 48 pixels are too many"),
        (frame("a\0b", 64.0), "a control character is in its name"),
        (frame("\u{1b}[31mred\n\u{7}", 64.0), "a control character is in its name"),
        (frame(&"x".repeat(300), 64.0), "too long"),
        (frame(&"x".repeat(5_000_000), 64.0), "too long"),
        (frame("a", 64.0).replace("50", "null"), "no focal length"),
        ("{\"frames\": 3}".to_owned(), "not a JSON camera file (transforms.json)"),
        ("hello".to_owned(), "not a JSON camera file"),
    ] {
        std::fs::write(at("c.json"), text).unwrap();
        refused(&at("c.json"), &["c.json", words]);
    }
    std::fs::create_dir(at("folder.json")).unwrap();
    refused(&at("folder.json"), &["no cameras here"]);
    refused(&at("none.json"), &["none.json", "check the name"]);
    #[cfg(target_os = "linux")]
    {
        use std::os::unix::fs::symlink;
        symlink("/dev/zero", at("zero.json")).unwrap();
        symlink(at("loop.json"), at("loop.json")).unwrap();
        refused("/dev/zero", &["is a device or pipe"]);
        refused(&at("zero.json"), &["zero.json", "is a device or pipe"]);
        refused(&at("loop.json"), &["loop.json", "check the name"]);
    }
}

#[test]
fn gaussians_that_are_not_finite_are_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    for (k, (column, value)) in [(0, f32::INFINITY), (9, f32::NAN), (10, 100.0)].into_iter().enumerate() {
        // Columns: x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0.
        let path = at(&format!("a{k}.ply"));
        let options = ply::PlyOptions { degree: 0, language: None };
        ply::write_splats(path.as_ref(), &splats(50), options).unwrap();
        poison(path.as_ref(), 7, column, value);
        for format in ["glb", "gltf", "splat", "compressed-ply", "spz", "ply"] {
            let ending = format.replace("compressed-ply", "compressed.ply");
            let out = at(&format!("out{k}.{ending}"));
            let output = splatvk(&["export", &path, "--format", format, "--out", &out]);
            let stderr = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success(), "{stderr}");
            let words = "1 of 50 Gaussians are left out, the first is number 7";
            assert!(stderr.starts_with("warning: ") && stderr.contains(words), "{stderr}");
            let (back, _, notes) = gaussians::read_noted(out.as_ref()).unwrap();
            assert!(back.len() == 49 && notes.is_empty(), "{out}: {notes:?}");
        }
    }
}

#[test]
fn names_of_another_format_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    gaussians::write(at("a.ply").as_ref(), &splats(3), None).unwrap();
    for (format, out, words) in [
        ("spz", "tree.ply", ["not spz", "tree.spz", "--format ply"]),
        ("ply", "tree.compressed.ply", ["tree.ply", "--format compressed-ply", ".compressed.ply"]),
        ("splat", "Tree.SPZ", ["Tree.splat", "--format spz", "end in .spz"]),
        ("gltf", "tree.glb", ["tree.gltf", "--format glb", "end in .glb"]),
        ("ply", "tree.json", ["tree.ply", "--format transforms", ".json"]),
        ("spz", "..ply", ["..spz", "--format ply", ".ply"]),
    ] {
        refuses(2, &["export", &at("a.ply"), "--format", format, "--out", &at(out)], &words);
        assert!(!folder.path().join(out).exists());
    }
    // A name of no format is written, with a warning; those of COLMAP are folders.
    for (format, out, warned) in [
        ("ply", "tree", true),
        ("spz", "tree.xyz", true),
        ("compressed-ply", "b.ply", false),
        ("spz", "t.v2.spz", false),
    ] {
        let output = splatvk(&["export", &at("a.ply"), "--format", format, "--out", &at(out)]);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && folder.path().join(out).is_file(), "{stderr}");
        assert_eq!(
            stderr.contains("warning: --out") && stderr.contains("by names that end in"),
            warned,
            "{stderr}"
        );
    }
    // Without a format, the ending of the file decides.
    for out in ["c.compressed.ply", "c.spz", "c.GLB"] {
        let output = splatvk(&["export", &at("a.ply"), "--out", &at(out)]);
        assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
        assert_eq!(gaussians::read(at(out).as_ref()).unwrap().0.len(), 3);
    }
    refuses(2, &["export", &at("a.ply"), "--out", &at("c.obj")], &["no format", "--format", ".spz", ".json"]);
}

#[test]
fn scenes_beyond_spz_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let mut far = splats(3);
    far.means[1][2] = 2e7;
    gaussians::write(at("a.ply").as_ref(), &far, None).unwrap();
    let words = ["b.spz: the scene reaches 2.0e7", "--only-seen", "--format ply"];
    let line = ["export", &at("a.ply"), "--format", "spz", "--out", &at("b.spz")];
    refuses(2, &line, &words);
    let stderr = splatvk(&line).stderr;
    assert!(!String::from_utf8_lossy(&stderr).contains("partial"), "{stderr:?}");
    refuses(
        2,
        &["export", &at("a.ply"), "--format", "ply", "--spz-version", "2", "--out", &at("c.ply")],
        &["--spz-version"],
    );
}

#[test]
fn antialiased_scenes_stay_so_or_are_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let thin = Splats { antialiased: true, ..splats(50) };
    gaussians::write(at("a.ply").as_ref(), &thin, None).unwrap();
    for (format, ending, kept) in [
        ("ply", "ply", true),
        ("compressed-ply", "compressed.ply", true),
        ("spz", "spz", true),
        ("splat", "splat", false),
        ("glb", "glb", false),
    ] {
        let out = at(&format!("out.{ending}"));
        let output = splatvk(&["export", &at("a.ply"), "--format", format, "--out", &out]);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{stderr}");
        assert_eq!(gaussians::read(out.as_ref()).unwrap().0.antialiased, kept, "{format}");
        assert_eq!(stderr.contains("the scene is antialiased"), !kept, "{format}: {stderr}");
    }
}

/// The warning of a command that is over in no time comes at its end.
#[test]
fn colours_that_a_format_cuts_off_are_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    // 0.5 + 0.28 · 6 is 2.2 times white.
    let mut bright = splats(50);
    bright.sh[30] = 6.0;
    gaussians::write(at("bright.ply").as_ref(), &bright, None).unwrap();
    for (format, warned) in [("splat", true), ("spz", true), ("glb", false)] {
        let out = at(&format!("out.{format}"));
        let output = splatvk(&["export", &at("bright.ply"), "--format", format, "--out", &out]);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{stderr}");
        assert_eq!(stderr.contains("1 splats are brighter"), warned, "{format}: {stderr}");
    }
}

fn write_scene(folder: &Path, s: &Splats, field: Option<&LanguageField>) {
    let pose = Pose::IDENTITY;
    let (name, c) = ("a.png".to_owned(), 32.0);
    let camera = Camera { name, width: 64, height: 64, fx: 60.0, fy: 60.0, cx: c, cy: c, pose };
    let contents = scene_dir::Contents {
        splats: s,
        seen: &Seen::default(),
        cameras: &[camera],
        world: &World::default(),
        photos: &[],
        points: None,
        language: field,
        text_embeddings: None,
    };
    std::fs::create_dir_all(folder).unwrap();
    scene_dir::write(folder, &contents).unwrap();
}

#[test]
fn a_damaged_scene_directory_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene");
    let (path, out) = (scene.to_string_lossy().into_owned(), folder.path().join("o.ply"));
    let out = out.to_string_lossy().into_owned();
    let refused = |words: &[&str]| {
        refuses(2, &["export", &path, "--format", "ply", "--out", &out], words);
        assert!(!Path::new(&out).exists());
    };
    write_scene(&scene, &splats(50), Some(&field(50)));
    assert!(scene_dir::load(&scene).is_ok());
    poison(&scene.join("point_cloud.ply"), 3, 0, f32::NAN);
    refused(&["point_cloud.ply", "1 of 50 Gaussians, the first is number 3"]);

    // 50 features of 1, as they are: no mixes of codes.
    type Change = fn(&mut Vec<f32>);
    let cases: [(&str, &str, Change, &str); 5] = [
        (
            "features",
            "features_s",
            |v| v[8] = f32::NAN,
            "the features of level s are not finite, the first in row 8",
        ),
        ("codebook_s", "clip", |v| v[1] = f32::INFINITY, "its embeddings are not finite"),
        ("codebook_s", "code", |v| v[0] = f32::NAN, "its codes are not finite"),
        ("codebook_s", "weight", |v| v[0] = f32::NAN, "its weights are not finite"),
        ("codebook_s", "weight", |v| v.push(1.0), "do not fit together"),
    ];
    for (file, name, change, words) in cases {
        write_scene(&scene, &splats(50), Some(&field(50)));
        let archive = scene.join(format!("language/{file}.npz"));
        let mut arrays = npy::read_npz(&archive).unwrap();
        let array = arrays.get_mut(name).unwrap();
        let mut values = array.to_f32();
        change(&mut values);
        let shape =
            if values.len() == array.to_f32().len() { array.shape.clone() } else { vec![values.len()] };
        *array = npy::NpyArray::f32(&shape, values);
        let list: Vec<(&str, &npy::NpyArray)> = arrays.iter().map(|(n, a)| (n.as_str(), a)).collect();
        npy::write_npz(&archive, &list).unwrap();
        refused(&[file, words]);
    }
    // Nor is it written.
    let mut broken = field(50);
    broken.levels[0].features[8] = f32::NAN;
    let e = gaussians::write(folder.path().join("b.ply").as_ref(), &splats(50), Some(&broken)).unwrap_err();
    assert!(e.to_string().contains("nothing is written") && !folder.path().join("b.ply").exists(), "{e}");

    write_scene(&scene, &splats(50), Some(&field(50)));
    let archive = scene.join("language/codebook_s.npz");
    let whole = std::fs::read(&archive).unwrap();
    let mut refusals = 0;
    for k in (0..whole.len()).step_by(7) {
        let mut bytes = whole.clone();
        bytes[k] ^= 0x10;
        std::fs::write(&archive, &bytes).unwrap();
        if let Err(e) = npy::read_npz(&archive) {
            assert!(e.exit_code() == 2 && e.to_string().contains("codebook_s.npz"), "{e}");
            assert!(e.to_string().contains("copy") || e.to_string().contains("save"), "{e}");
            refusals += 1;
        }
    }
    assert!(refusals > 20, "{refusals}");
    std::fs::write(&archive, &whole[..whole.len() / 2]).unwrap();
    refused(&["codebook_s.npz", "copy the file again"]);
    std::fs::remove_file(&archive).unwrap();
    std::fs::create_dir(&archive).unwrap();
    refused(&["codebook_s.npz", "is a folder"]);
}

#[test]
fn questions_need_cameras_and_language() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    gaussians::write(at("plain.ply").as_ref(), &splats(5), None).unwrap();
    gaussians::write(at("words.ply").as_ref(), &splats(5), Some(&field(5))).unwrap();
    let out = at("out");
    refuses(2, &["query", &at("plain.ply"), "lemon", "--out", &out], &["plain.ply", "no language"]);
    refuses(
        2,
        &["query", &at("words.ply"), "lemon", "--out", &out],
        &["words.ply", "no cameras", "--cameras"],
    );
    cameras::write_json(at("none.json").as_ref(), &[]).unwrap();
    let none = at("none.json");
    refuses(2, &["query", &at("words.ply"), "lemon", "--cameras", &none, "--out", &out], &["no cameras"]);
    assert!(!Path::new(&out).exists());
}

/// A folder of somebody else, in which the command is started.
#[test]
fn relative_home_is_never_the_current_folder() {
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join(".local/share/splatvk/models/theirs");
    std::fs::create_dir_all(&models).unwrap();
    std::fs::write(models.join("model.onnx"), "theirs").unwrap();
    let variables = ["HOME", "XDG_DATA_HOME", "SPLATVK_HOME", "SPLATVK_MODELS", "ORT_DYLIB_PATH"];
    for (home, data) in [("", ""), (".", ""), ("here", ".local/share"), ("", "./.local/share")] {
        for arguments in [&["models", "list"][..], &["clean"]] {
            let mut c = Command::new(env!("CARGO_BIN_EXE_splatvk"));
            for name in variables {
                c.env_remove(name);
            }
            let c = c.env("HOME", home).env("XDG_DATA_HOME", data).current_dir(folder.path());
            let output = c.args(arguments).output().unwrap();
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            // The list of users states a folder for most; without one the command is refused.
            assert!(
                output.status.success() || said.contains("set HOME, or SPLATVK_HOME"),
                "{:?}: {said}",
                output.status
            );
            let shown = String::from_utf8_lossy(&output.stdout);
            assert!(!shown.contains("theirs"), "{shown}");
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

/// A scene and its report are passed on, kept stages stay with the user.
#[cfg(unix)]
#[test]
fn folders_as_typed_are_not_in_the_scene() {
    use std::os::unix::fs::MetadataExt;
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (images, cameras, points) = fixture::small_views();
    let home = at("alice-t/home");
    std::fs::create_dir_all(at("alice-t/secret-album")).unwrap();
    std::fs::create_dir_all(&home).unwrap();
    for part in ["lib", "models"] {
        std::os::unix::fs::symlink(splatvk::infer::home().unwrap().join(part), home.join(part)).unwrap();
    }
    for (from, to) in [(cameras, "cameras.json"), (points, "points.ply")] {
        std::fs::copy(from, at("alice-t/secret-album").join(to)).unwrap();
    }
    std::fs::create_dir(at("alice-t/secret-album/photos")).unwrap();
    for entry in std::fs::read_dir(images).unwrap().map(|e| e.unwrap()) {
        std::fs::copy(entry.path(), at("alice-t/secret-album/photos").join(entry.file_name())).unwrap();
    }
    std::fs::write(at("alice-t/secret-album/photos/notes.jpg"), "no photo").unwrap();
    let train = |images: &Path, out: &Path| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        c.env("SPLATVK_HOME", &home).arg("train").arg("--images").arg(images);
        c.arg("--cameras").arg(at("alice-t/secret-album/cameras.json"));
        c.arg("--points").arg(at("alice-t/secret-album/points.ply"));
        let output = c.args(["--iterations", "5", "--resume", "--out"]).arg(out).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    train(&at("alice-t/secret-album/photos"), &at("alice-t/scene"));
    for name in ["run.json", "report.html", "cameras/photos.json", "cameras/transforms.json", "scene.json"] {
        let text = String::from_utf8(std::fs::read(at("alice-t/scene").join(name)).unwrap()).unwrap();
        let folder = folder.path().to_str().unwrap();
        assert!(
            !text.contains("alice-t") && !text.contains("secret-album") && !text.contains(folder),
            "{name}"
        );
    }
    let record = std::fs::read_to_string(at("alice-t/scene/run.json")).unwrap();
    assert!(record.contains("\"images\": \"photos\""), "what it was made of: {record}");
    let mode = |path: &Path| path.metadata().unwrap().mode() & 0o777;
    let stages: Vec<_> = std::fs::read_dir(home.join("stages")).unwrap().map(|e| e.unwrap().path()).collect();
    assert!(mode(&home.join("stages")) == 0o700 && !stages.is_empty());
    assert!(stages.iter().all(|s| mode(s) == 0o600), "{stages:?}");
}

/// A chunk of a PNG with its sum.
fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let mut sum = flate2::Crc::new();
    sum.update(kind);
    sum.update(data);
    [&(data.len() as u32).to_be_bytes()[..], kind, data, &sum.sum().to_be_bytes()].concat()
}

#[test]
fn panic_of_photo_decoder_is_line() {
    use std::io::Write;
    let folder = tempfile::tempdir().unwrap();
    let mut rows = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    rows.write_all(&[1; 65 * 64]).unwrap();
    // A palette of one colour and a third.
    let png = [
        b"\x89PNG\r\n\x1a\n".to_vec(),
        chunk(b"IHDR", &[0, 0, 0, 64, 0, 0, 0, 64, 8, 3, 0, 0, 0]),
        chunk(b"PLTE", &[1, 2, 3, 4]),
        chunk(b"IDAT", &rows.finish().unwrap()),
        chunk(b"IEND", &[]),
    ];
    std::fs::write(folder.path().join("a.png"), png.concat()).unwrap();
    let photo = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/breakfast/images/train_00.jpg");
    std::fs::copy(photo, folder.path().join("b.jpg")).unwrap();
    let (photos, out) =
        (folder.path().display().to_string(), folder.path().join("out").display().to_string());
    refuses(2, &["run", &photos, "--out", &out], &["a.png: the image is damaged (", "copy the photo again"]);
    assert!(!Path::new(&out).exists());
}
