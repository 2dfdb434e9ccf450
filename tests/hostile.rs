//! Damaged and hostile input files: the program prints one clear line, exits with code 2, and
//! leaves no partial output.
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

/// Expects exit code `code` and one error line of bounded length without control characters that
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

fn text_path(folder: &Path, name: &str) -> String {
    folder.join(name).to_string_lossy().into_owned()
}

/// Overwrites one number of a binary PLY of degree 0.
fn overwrite(path: &Path, row: usize, column: usize, value: f32) {
    let mut bytes = std::fs::read(path).unwrap();
    let body = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let width = (bytes.len() - body) / 50;
    bytes[body + row * width + 4 * column..][..4].copy_from_slice(&value.to_le_bytes());
    std::fs::write(path, bytes).unwrap();
}

#[test]
fn camera_files_are_validated_on_read() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| text_path(folder.path(), name);
    gaussians::write(path_of("a.ply").as_ref(), &splats(3), None).unwrap();
    let (out, scene) = (path_of("out"), path_of("a.ply"));
    let assert_refused = |cameras: &str, words: &[&str]| {
        refuses(2, &["render", &scene, "--cameras", cameras, "--out", &out], words);
        assert!(!Path::new(&out).exists(), "{cameras} left something behind");
    };
    for (text, words) in [
        (transforms("a", 1e6), "1000000 × 48 pixels are too many"),
        (transforms("a\0b", 64.0), "a control character is in its name"),
        (transforms("\u{1b}[31mred\n\u{7}", 64.0), "a control character is in its name"),
        (transforms(&"x".repeat(300), 64.0), "too long"),
        (transforms(&"x".repeat(5_000_000), 64.0), "too long"),
        (transforms("a", 64.0).replace("50", "null"), "no focal length"),
        ("{\"frames\": 3}".to_owned(), "not a JSON camera file (transforms.json)"),
        ("hello".to_owned(), "not a JSON camera file"),
    ] {
        std::fs::write(path_of("c.json"), text).unwrap();
        assert_refused(&path_of("c.json"), &["c.json", words]);
    }
    std::fs::create_dir(path_of("folder.json")).unwrap();
    assert_refused(&path_of("folder.json"), &["no cameras here"]);
    assert_refused(&path_of("none.json"), &["none.json", "check the name"]);
    #[cfg(target_os = "linux")]
    {
        use std::os::unix::fs::symlink;
        symlink("/dev/zero", path_of("zero.json")).unwrap();
        symlink(path_of("loop.json"), path_of("loop.json")).unwrap();
        assert_refused("/dev/zero", &["is a device or pipe"]);
        assert_refused(&path_of("zero.json"), &["zero.json", "is a device or pipe"]);
        assert_refused(&path_of("loop.json"), &["loop.json", "check the name"]);
    }
}

/// transforms.json with one frame.
fn transforms(name: &str, w: f64) -> String {
    serde_json::json!({ "fl_x": 50, "w": w, "h": 48, "frames": [{
        "file_path": name, "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    }] })
    .to_string()
}

#[test]
fn export_omits_nonfinite_gaussians() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| text_path(folder.path(), name);
    for (k, (column, value)) in [(0, f32::INFINITY), (9, f32::NAN), (10, 100.0)].into_iter().enumerate() {
        // Columns: x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0.
        let path = path_of(&format!("a{k}.ply"));
        let options = ply::PlyOptions { degree: 0, ..ply::PlyOptions::default() };
        ply::write_splats(path.as_ref(), &splats(50), options).unwrap();
        overwrite(path.as_ref(), 7, column, value);
        for format in ["glb", "gltf", "splat", "compressed-ply", "spz", "ply"] {
            let ending = format.replace("compressed-ply", "compressed.ply");
            let out = path_of(&format!("out{k}.{ending}"));
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
fn export_refuses_mismatched_file_name() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| text_path(folder.path(), name);
    gaussians::write(path_of("a.ply").as_ref(), &splats(3), None).unwrap();
    for (format, out, words) in [
        ("spz", "tree.ply", ["not spz", "tree.spz", "--format ply"]),
        ("ply", "tree.compressed.ply", ["tree.ply", "--format compressed-ply", ".compressed.ply"]),
        ("splat", "Tree.SPZ", ["Tree.splat", "--format spz", "end in .spz"]),
        ("gltf", "tree.glb", ["tree.gltf", "--format glb", "end in .glb"]),
        ("ply", "tree.json", ["tree.ply", "--format transforms", ".json"]),
        ("spz", "..ply", ["..spz", "--format ply", ".ply"]),
    ] {
        refuses(2, &["export", &path_of("a.ply"), "--format", format, "--out", &path_of(out)], &words);
        assert!(!folder.path().join(out).exists());
    }
    // A name of no format is accepted with a warning; COLMAP models are folders.
    for (format, out, warned) in [
        ("ply", "tree", true),
        ("spz", "tree.xyz", true),
        ("compressed-ply", "b.ply", false),
        ("spz", "t.v2.spz", false),
    ] {
        let output = splatvk(&["export", &path_of("a.ply"), "--format", format, "--out", &path_of(out)]);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && folder.path().join(out).is_file(), "{stderr}");
        assert_eq!(
            stderr.contains("warning: ") && stderr.contains("by names that end in"),
            warned,
            "{stderr}"
        );
    }
    // Without a format, the extension of the file decides.
    for out in ["c.compressed.ply", "c.spz", "c.GLB"] {
        let output = splatvk(&["export", &path_of("a.ply"), &path_of(out)]);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && stderr.lines().count() == 1, "{stderr}");
        assert!(stderr.contains("the unit of the file") && stderr.ends_with("3 splats\n"), "{stderr}");
        assert_eq!(gaussians::read(path_of(out).as_ref()).unwrap().0.len(), 3);
    }
    refuses(
        2,
        &["export", &path_of("a.ply"), "--out", &path_of("c.obj")],
        &["no format", "--format", ".spz", ".json"],
    );
    refuses(2, &["export", &path_of("a.ply"), &path_of("c.usdc")], &["Python", "splatvk[usd]"]);
}

#[test]
fn spz_limits_refuse_unsuitable_scenes() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| text_path(folder.path(), name);
    let mut far = splats(3);
    far.means[1][2] = 2e7;
    gaussians::write(path_of("a.ply").as_ref(), &far, None).unwrap();
    let words = ["b.spz: the scene reaches 2.0e7", "--format ply"];
    let line = ["export", &path_of("a.ply"), "--format", "spz", "--out", &path_of("b.spz")];
    refuses(2, &line, &words);
    let stderr = splatvk(&line).stderr;
    assert!(!String::from_utf8_lossy(&stderr).contains("partial"), "{stderr:?}");
    refuses(
        2,
        &["export", &path_of("a.ply"), "--format", "ply", "--spz-version", "2", "--out", &path_of("c.ply")],
        &["--spz-version"],
    );
}

#[test]
fn export_keeps_or_warns_of_antialiasing() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| text_path(folder.path(), name);
    let thin = Splats { antialiased: true, ..splats(50) };
    gaussians::write(path_of("a.ply").as_ref(), &thin, None).unwrap();
    for (format, ending, kept) in [
        ("ply", "ply", true),
        ("compressed-ply", "compressed.ply", true),
        ("spz", "spz", true),
        ("splat", "splat", false),
        ("glb", "glb", false),
    ] {
        let out = path_of(&format!("out.{ending}"));
        let output = splatvk(&["export", &path_of("a.ply"), "--format", format, "--out", &out]);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{stderr}");
        assert_eq!(gaussians::read(out.as_ref()).unwrap().0.antialiased, kept, "{format}");
        assert_eq!(stderr.contains("the scene is antialiased"), !kept, "{format}: {stderr}");
    }
}

/// A command that ends at once prints the warning at its end.
#[test]
fn export_warns_of_clipped_colours() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| text_path(folder.path(), name);
    // 0.5 + 0.28 · 6 is 2.2 times white.
    let mut bright = splats(50);
    bright.sh[30] = 6.0;
    gaussians::write(path_of("bright.ply").as_ref(), &bright, None).unwrap();
    for (format, warned) in [("splat", true), ("spz", true), ("glb", false)] {
        let out = path_of(&format!("out.{format}"));
        let output = splatvk(&["export", &path_of("bright.ply"), "--format", format, "--out", &out]);
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
        backdrop: &Default::default(),
        holes: &Default::default(),
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
fn damaged_scene_directory_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene");
    let (path, out) = (scene.to_string_lossy().into_owned(), folder.path().join("o.ply"));
    let out = out.to_string_lossy().into_owned();
    let assert_refused = |words: &[&str]| {
        refuses(2, &["export", &path, "--format", "ply", "--out", &out], words);
        assert!(!Path::new(&out).exists());
    };
    write_scene(&scene, &splats(50), Some(&field(50)));
    assert!(scene_dir::load(&scene).is_ok());
    overwrite(&scene.join("point_cloud.ply"), 3, 0, f32::NAN);
    assert_refused(&["point_cloud.ply", "1 of 50 Gaussians, the first is number 3"]);

    // 50 features of 1 as stored, not as mixes of codes.
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
        assert_refused(&[file, words]);
    }
    // Writing refuses it, too.
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
    assert_refused(&["codebook_s.npz", "copy the file again"]);
    std::fs::remove_file(&archive).unwrap();
    std::fs::create_dir(&archive).unwrap();
    assert_refused(&["codebook_s.npz", "is a folder"]);
}

#[test]
fn query_needs_cameras_and_language() {
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| text_path(folder.path(), name);
    gaussians::write(path_of("plain.ply").as_ref(), &splats(5), None).unwrap();
    gaussians::write(path_of("words.ply").as_ref(), &splats(5), Some(&field(5))).unwrap();
    let out = path_of("out");
    refuses(2, &["query", &path_of("plain.ply"), "lemon", "--out", &out], &["plain.ply", "no language"]);
    refuses(
        2,
        &["query", &path_of("words.ply"), "lemon", "--out", &out],
        &["words.ply", "no cameras", "--cameras"],
    );
    cameras::write_json(path_of("none.json").as_ref(), &[]).unwrap();
    let none = path_of("none.json");
    refuses(
        2,
        &["query", &path_of("words.ply"), "lemon", "--cameras", &none, "--out", &out],
        &["no cameras"],
    );
    assert!(!Path::new(&out).exists());
}

/// The command starts in a foreign folder.
#[test]
fn home_is_never_current_folder() {
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
            let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
            // The list of users states a folder for most of them; without one the command is
            // refused.
            assert!(
                output.status.success() || stderr.contains("set HOME, or SPLATVK_HOME"),
                "{:?}: {stderr}",
                output.status
            );
            let shown = String::from_utf8_lossy(&output.stdout);
            assert!(!shown.contains("theirs"), "{shown}");
        }
    }
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}

/// A scene and its report are passed on; kept stages stay with the user.
#[cfg(unix)]
#[test]
fn scene_contains_no_typed_folders() {
    use std::os::unix::fs::MetadataExt;
    let folder = tempfile::tempdir().unwrap();
    let path_of = |name: &str| folder.path().join(name);
    let (images, cameras, points) = fixture::small_views();
    let home = path_of("alice-t/home");
    std::fs::create_dir_all(path_of("alice-t/secret-album")).unwrap();
    std::fs::create_dir_all(&home).unwrap();
    for part in ["lib", "models"] {
        std::os::unix::fs::symlink(splatvk::infer::home().unwrap().join(part), home.join(part)).unwrap();
    }
    for (from, to) in [(cameras, "cameras.json"), (points, "points.ply")] {
        std::fs::copy(from, path_of("alice-t/secret-album").join(to)).unwrap();
    }
    std::fs::create_dir(path_of("alice-t/secret-album/photos")).unwrap();
    for entry in std::fs::read_dir(images).unwrap().map(|e| e.unwrap()) {
        std::fs::copy(entry.path(), path_of("alice-t/secret-album/photos").join(entry.file_name())).unwrap();
    }
    std::fs::write(path_of("alice-t/secret-album/photos/notes.jpg"), "no photo").unwrap();
    let train = |images: &Path, out: &Path| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        c.env("SPLATVK_HOME", &home).arg("train").arg("--images").arg(images);
        c.arg("--cameras").arg(path_of("alice-t/secret-album/cameras.json"));
        c.arg("--points").arg(path_of("alice-t/secret-album/points.ply"));
        let output = c.args(["--iterations", "5", "--resume", "--out"]).arg(out).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    };
    train(&path_of("alice-t/secret-album/photos"), &path_of("alice-t/scene"));
    for name in ["run.json", "report.html", "cameras/photos.json", "cameras/transforms.json", "scene.json"] {
        let text = String::from_utf8(std::fs::read(path_of("alice-t/scene").join(name)).unwrap()).unwrap();
        let folder = folder.path().to_str().unwrap();
        assert!(
            !text.contains("alice-t") && !text.contains("secret-album") && !text.contains(folder),
            "{name}"
        );
    }
    let record = std::fs::read_to_string(path_of("alice-t/scene/run.json")).unwrap();
    assert!(
        record.contains("\"photos\"") && record.contains("\"cameras:cameras.json\""),
        "what it was made of: {record}"
    );
    let mode = |path: &Path| path.metadata().unwrap().mode() & 0o777;
    let stages: Vec<_> = std::fs::read_dir(home.join("stages")).unwrap().map(|e| e.unwrap().path()).collect();
    assert!(mode(&home.join("stages")) == 0o700 && !stages.is_empty());
    assert!(stages.iter().all(|s| mode(s) == 0o600), "{stages:?}");
}

/// Chunk of a PNG with its checksum.
fn chunk(kind: &[u8; 4], data: &[u8]) -> Vec<u8> {
    let mut sum = flate2::Crc::new();
    sum.update(kind);
    sum.update(data);
    [&(data.len() as u32).to_be_bytes()[..], kind, data, &sum.sum().to_be_bytes()].concat()
}

#[test]
fn decoder_panic_becomes_error_line() {
    use std::io::Write;
    let folder = tempfile::tempdir().unwrap();
    let mut rows = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    rows.write_all(&[1; 65 * 64]).unwrap();
    // A palette with one colour and a third of another.
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
