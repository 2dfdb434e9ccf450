//! Commands that use the world data of a scene: the up direction, lengths, and visibility in
//! photos.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod fixture;

use fixture::command::{refuses, splatvk, text};
use splatvk::format::ply::PlyOptions;
use splatvk::format::scene_dir::{self, Contents};
use splatvk::scene::{
    Camera, Codebook, LanguageField, LevelField, PointCloud, Pose, Seen, Splats, Up, World,
};
use std::path::{Path, PathBuf};

/// A scene of two splats and one camera; the first splat lies one unit straight above the camera,
/// in no photo. Points are at the splats' means.
fn tilted_scene(folder: &Path) -> (PathBuf, Splats, Camera) {
    let scene = folder.join("scene");
    std::fs::create_dir(&scene).unwrap();
    let direction = glam::DVec3::new(0.2, -0.9, 0.3).normalize();
    let splats = Splats {
        means: vec![direction.as_vec3().to_array(), [0.1, 0.2, 2.0]],
        log_scales: vec![[-3.0, -4.0, -5.0]; 2],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
        opacity_logits: vec![1.0; 2],
        sh_degree: 0,
        sh: vec![0.0; 6],
        antialiased: false,
    };
    let camera = Camera {
        name: "a".into(),
        width: 64,
        height: 48,
        fx: 60.0,
        fy: 60.0,
        cx: 32.0,
        cy: 24.0,
        pose: Pose::exp(glam::DVec3::new(0.1, 0.0, 0.3), glam::DVec3::new(0.0, 0.2, 0.1)),
    };
    let up = Up { direction, sigma_degrees: 1.0, evidence: Vec::new() };
    let points =
        PointCloud { positions: splats.means.clone(), colours: vec![[0.5; 3]; 2], ..PointCloud::default() };
    let codebook = Codebook {
        embedding_dim: 1,
        code_dim: 1,
        embeddings: vec![1.0],
        codes: vec![1.0],
        weights: vec![1.0],
        members: vec![Vec::new()],
        min_chord: 2.0,
    };
    let level = LevelField { codebook, features: vec![0.25, 0.5], ..LevelField::default() };
    let levels = vec![LevelField::default(), LevelField::default(), level];
    let field = LanguageField { levels, space: "dir".into() };
    let contents = Contents {
        splats: &splats,
        seen: &Seen { pixels: vec![0.0, 3.0] },
        backdrop: &Default::default(),
        holes: &Default::default(),
        cameras: std::slice::from_ref(&camera),
        world: &World { up: Some(up), ..World::default() },
        photos: &[],
        points: Some(&points),
        language: Some(&field),
        text_embeddings: None,
    };
    scene_dir::write(&scene, &contents).unwrap();
    (scene, splats, camera)
}

#[test]
fn export_up_turns_scene() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, splats, camera) = tilted_scene(folder.path());
    let export = |scene: &Path, format: &str, axis: &str, name: &str| {
        let mut export = splatvk();
        export.arg("export").arg(scene).args([
            "--format",
            format,
            "--up",
            axis,
            "--guessed",
            "--force",
            "--out",
        ]);
        export.arg(folder.path().join(name));
        export
    };
    let mean = |at: &[f32; 3]| glam::Vec3::from_array(*at).as_dvec3();
    for (axis, to) in [("-y", glam::DVec3::NEG_Y), ("z", glam::DVec3::Z)] {
        for (format, name) in [("ply", "a.ply"), ("transforms", "t.json"), ("colmap", "model")] {
            let output = export(&scene, format, axis, name).output().unwrap();
            assert!(output.status.success(), "{}", text(&output.stderr));
        }
        let turned = splatvk::format::ply::read_splats(&folder.path().join("a.ply")).unwrap();
        assert!((mean(&turned.means[0]) - to).length() < 1e-6, "{axis}: {:?}", turned.means[0]);
        let seen = splatvk::format::cameras::read(&folder.path().join("t.json")).unwrap();
        let (before, after) =
            (camera.project(mean(&splats.means[1])), seen[0].project(mean(&turned.means[1])));
        assert!((before.0 - after.0).length() < 1e-3, "cameras and splats turn together");
        let points = splatvk::format::colmap::read_points(&folder.path().join("model")).unwrap().positions;
        assert!((mean(&points[0]) - to).length() < 1e-6, "and points: {points:?}");
    }
    // After reading, a glTF scene is in the axes of scenes again: y up in the file.
    assert!(export(&scene, "glb", "y", "a.glb").output().unwrap().status.success());
    let turned = splatvk::format::gaussians::read(&folder.path().join("a.glb")).unwrap().0;
    assert!((mean(&turned.means[0]) - glam::DVec3::NEG_Y).length() < 1e-6);
    refuses(&mut export(&scene, "spz", "z", "b.spz"), 2, &["y up by definition", "--up y"]);
    refuses(&mut export(&folder.path().join("a.ply"), "splat", "y", "b.splat"), 2, &["not known"]);
    refuses(&mut export(&scene, "ply", "x", "b.ply"), 2, &["-y, y or z"]);
    assert!(!folder.path().join("b.spz").exists());
}

/// `{files, up, metres, splats, guessed, summary}` of an export into `folder`.
fn exported(scene: &Path, folder: &Path, arguments: &[&str]) -> serde_json::Value {
    let mut export = splatvk();
    export.current_dir(folder).arg("export").arg(scene).args(arguments).args(["--force", "--json"]);
    let output = export.output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let line = told["summary"].as_str().unwrap();
    assert!(text(&output.stderr).lines().any(|l| l == line), "{line}: {}", text(&output.stderr));
    told
}

#[test]
fn export_is_upright_in_metres_by_default() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, splats, camera) = tilted_scene(folder.path());
    let mean = |at: &[f32; 3]| glam::Vec3::from_array(*at).as_dvec3();
    let read = |name: &str| splatvk::format::gaussians::read(&folder.path().join(name)).unwrap().0;
    // Up is known, metres are not.
    let told = exported(&scene, folder.path(), &["a.ply", "--guessed"]);
    assert_eq!((&told["up"]["axis"], &told["metres"]), (&"-y".into(), &serde_json::Value::Null), "{told}");
    assert_eq!((&told["files"][0], &told["splats"]), (&"a.ply".into(), &2.into()));
    let summary = told["summary"].as_str().unwrap();
    for words in ["upright (−y is up, ±1.0°)", "own unit", "measure --scale", "2 splats, 1 of them guessed"]
    {
        assert!(summary.contains(words), "{words}: {summary}");
    }
    assert!((mean(&read("a.ply").means[0]) - glam::DVec3::NEG_Y).length() < 1e-6);
    // Metres are known, too. A format with y up is read back with −y up, as the others are.
    measure_json(&scene, &["--scale", "0,0,2 - -2,0,2 = 50cm"]);
    for (name, axis) in [("a.ply", "-y"), ("a.splat", "-y"), ("a.spz", "y"), ("a.glb", "y")] {
        let told = exported(&scene, folder.path(), &[name, "--guessed"]);
        assert_eq!(told["up"]["axis"], axis, "{name}");
        assert_eq!(told["metres"]["metres_per_unit"], 0.25, "{name}");
        let up = mean(&read(name).means[0]);
        assert!((up - 0.25 * glam::DVec3::NEG_Y).length() < 1e-5, "{name}: {up}");
    }
    let told = exported(&scene, folder.path(), &["a.ply"]);
    assert!(told["summary"].as_str().unwrap().contains("1 splat; 1 that no photo shows left out: --guessed"));
    // Cameras and points fit the splats.
    let told = exported(&scene, folder.path(), &["t.json"]);
    assert_eq!((&told["cameras"], &told["up"]["axis"]), (&1.into(), &"-y".into()), "{told}");
    assert_eq!(exported(&scene, folder.path(), &["model", "--format", "colmap"])["points"], 2);
    let placed = splatvk::format::cameras::read(&folder.path().join("t.json")).unwrap();
    let (before, after) =
        (camera.project(mean(&splats.means[1])), placed[0].project(mean(&read("a.spz").means[1])));
    assert!((before.0 - after.0).length() < 1e-2, "{before:?} {after:?}");
    let points = splatvk::format::colmap::read_points(&folder.path().join("model")).unwrap().positions;
    assert!((mean(&points[0]) - 0.25 * glam::DVec3::NEG_Y).length() < 1e-6, "{points:?}");
    // The scene's own axes and unit, or one of the two.
    let told = exported(&scene, folder.path(), &["raw.ply", "--guessed", "--raw"]);
    assert!(told["up"].is_null() && told["metres"].is_null(), "{told}");
    assert!(told["summary"].as_str().unwrap().starts_with("in the scene's own axes and unit, 2 splats"));
    assert_eq!(read("raw.ply").means, splats.means);
    let told = exported(&scene, folder.path(), &["raw.ply", "--guessed", "--raw", "--up", "z"]);
    assert!(told["metres"].is_null() && told["up"]["axis"] == "z", "{told}");
    assert!((mean(&read("raw.ply").means[0]) - glam::DVec3::Z).length() < 1e-6);
    // A file of Gaussians states neither.
    let told = exported(&folder.path().join("a.ply"), folder.path(), &["copy.spz"]);
    assert!(told["up"].is_null() && told["summary"].as_str().unwrap().contains("states neither"), "{told}");
    let mut both = splatvk();
    refuses(
        both.arg("export").arg(&scene).args(["b.ply", "--out", "c.ply"]),
        2,
        &["cannot be used together"],
    );
    refuses(splatvk().arg("export").arg(&scene), 2, &["FILE"]);
}

#[test]
fn export_omits_unseen() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, out) = (tilted_scene(folder.path()).0, folder.path().join("seen.spz"));
    let mut export = splatvk();
    export.arg("export").arg(&scene).args(["--format", "spz", "--out"]).arg(&out);
    let output = export.output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    let (kept, language) = splatvk::format::gaussians::read(&out).unwrap();
    assert_eq!((kept.len(), language.unwrap().levels[2].features.as_slice()), (1, &[0.5][..]));
    // With guessed splats: the unseen one, and those behind the scene, without features.
    let out = folder.path().join("all.spz");
    let backdrop = Splats {
        means: vec![[0.0, 0.0, 9.0]; 2],
        log_scales: vec![[0.0; 3]; 2],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
        opacity_logits: vec![2.0; 2],
        sh: vec![0.1; 6],
        ..Splats::default()
    };
    let options = PlyOptions { degree: 0, ..PlyOptions::default() };
    splatvk::format::ply::write_splats(&scene.join("backdrop.ply"), &backdrop, options).unwrap();
    let mut export = splatvk();
    export.arg("export").arg(&scene).args(["--format", "spz", "--guessed", "--out"]).arg(&out);
    assert!(export.output().unwrap().status.success());
    let (all, language) = splatvk::format::gaussians::read(&out).unwrap();
    assert_eq!((all.len(), language.unwrap().levels[2].features.len()), (4, 4));
}

#[test]
fn measure_scale_sets_metres() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, splats, _) = tilted_scene(folder.path());
    let export = |name: &str| {
        let mut export = splatvk();
        export
            .arg("export")
            .arg(&scene)
            .args(["--format", "ply", "--raw", "--metres", "--guessed", "--out"])
            .arg(folder.path().join(name));
        export
    };
    refuses(&mut export("none.ply"), 2, &["scale is not known", "splatvk measure --scale"]);
    let length = "0,0,1 - 0.3,-0.4,1";
    let before = measure_json(&scene, &[length]);
    assert!(
        (before["lengths"][0]["units"].as_f64().unwrap() - 0.5).abs() < 1e-12 && before["scale"].is_null()
    );
    let stated = measure_json(&scene, &["--scale", "0,0,2 - -2,0,2 = 50cm", length]);
    assert!((stated["scale"]["metres_per_unit"].as_f64().unwrap() - 0.25).abs() < 1e-12);
    let kept = measure_json(&scene, &[length]);
    assert!((kept["lengths"][0]["metres"].as_f64().unwrap() - 0.125).abs() < 1e-12, "{kept}");
    assert!(kept["lengths"][0]["sigma_metres"].as_f64().unwrap() > 0.0);
    assert!(export("metres.ply").output().unwrap().status.success());
    let scaled = splatvk::format::ply::read_splats(&folder.path().join("metres.ply")).unwrap();
    for (own, metres) in splats.means.as_flattened().iter().zip(scaled.means.as_flattened()) {
        assert!((0.25 * own - metres).abs() < 1e-6);
    }
    // The up direction and all else in the manifest stays.
    let loaded = scene_dir::load(&scene).unwrap();
    assert!(loaded.world.up.is_some() && loaded.splats == splats && loaded.cameras.len() == 1);
    let behind = measure_json(&scene, &["--", "-0.3,0,1 - 0,0,1"]);
    assert!((behind["lengths"][0]["units"].as_f64().unwrap() - 0.3).abs() < 1e-12);
    refuses(&mut measure(&scene, &[]), 2, &["give a length"]);
    refuses(&mut measure(&scene, &["--scale", length]), 2, &["METRES"]);
    refuses(&mut measure(&scene, &["0,0,1 to 1,0,1"]), 2, &["A - B"]);
    refuses(&mut measure(&scene, &["0,0,1 - 0,0,1"]), 2, &["one place"]);
    refuses(&mut measure(&scene, &["b:1,1 - a:2,2"]), 2, &["no view of the scene", "it has a"]);
    refuses(&mut measure(&scene, &["a:64,1 - a:2,2"]), 2, &["64 × 48 pixels"]);
}

fn measure_json(scene: &Path, arguments: &[&str]) -> serde_json::Value {
    let output = measure(scene, &[&["--json"], arguments].concat()).output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn measure(scene: &Path, arguments: &[&str]) -> std::process::Command {
    let mut measure = splatvk();
    measure.arg("measure").arg(scene).args(arguments);
    measure
}
