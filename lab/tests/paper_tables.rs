//! Tables on data sets of the published layouts, and the script that runs all of them, on small
//! imitations made from generated scenes.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is how a test fails
use glam::DVec2;
use image::GenericImageView;
use serde_json::{Value, json};
use splatvk::eval::GroundTruth;
use splatvk::format::colmap;
use splatvk::scene::{Camera, PointCloud};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn splatlab(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_splatlab")).args(args).output().unwrap()
}

/// Path of `splatvk`, which `cargo test --workspace` builds beside `splatlab`.
fn splatvk() -> PathBuf {
    let program = Path::new(env!("CARGO_BIN_EXE_splatlab")).with_file_name("splatvk");
    assert!(program.is_file(), "{}: build it with cargo build", program.display());
    program
}

fn read(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

/// A generated scene.
struct Scene {
    folder: tempfile::TempDir,
    truth: Value,
}

/// A frame of the ground truth.
struct Frame {
    stem: String,
    photo: image::DynamicImage,
    /// Object index per pixel.
    objects: image::GrayImage,
    /// World to camera.
    pose: [[f64; 4]; 4],
    /// fx, fy, cx, cy.
    intrinsics: [f64; 4],
}

impl Scene {
    fn generate(seed: &str) -> Scene {
        let folder = tempfile::tempdir().unwrap();
        let small =
            ["--size", "160x120", "--views", "4", "--held-out", "2", "--objects", "4", "--pose-noise", "0"];
        let out = folder.path().join("data");
        let made = splatlab(&[&["generate", "--out", path(&out), "--seed", seed][..], &small].concat());
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let truth = read(&out.join("ground_truth.json"));
        Scene { folder, truth }
    }

    fn frames(&self) -> Vec<Frame> {
        let data = self.folder.path().join("data");
        self.truth["frames"].as_array().unwrap().iter().map(|f| Frame::read(&data, f)).collect()
    }

    /// Phrases of the objects by index, without the background.
    fn labels(&self) -> BTreeMap<u8, String> {
        let all: BTreeMap<u8, String> = serde_json::from_value(self.truth["labels"].clone()).unwrap();
        let behind = ["table", "wall", "carpet", "floor"];
        all.into_iter().filter(|(_, p)| !behind.iter().any(|b| p.ends_with(b))).collect()
    }
}

impl Frame {
    /// Reads a frame of `ground_truth.json`.
    fn read(data: &Path, f: &Value) -> Frame {
        let file = f["file"].as_str().unwrap();
        let stem = Path::new(file).file_stem().unwrap().to_str().unwrap().to_owned();
        let masks = image::open(data.join("masks").join(format!("{stem}.png"))).unwrap();
        Frame {
            photo: image::open(data.join(file)).unwrap(),
            objects: masks.to_luma8(),
            pose: serde_json::from_value(f["world_to_camera"].clone()).unwrap(),
            intrinsics: ["fx", "fy", "cx", "cy"].map(|k| f[k].as_f64().unwrap()),
            stem,
        }
    }
}

/// Inverse of a rigid transform.
fn to_world(m: &[[f64; 4]; 4]) -> [[f64; 4]; 4] {
    let mut out = [[0.0, 0.0, 0.0, 0.0], [0.0; 4], [0.0; 4], [0.0, 0.0, 0.0, 1.0]];
    for r in 0..3 {
        (0..3).for_each(|c| out[r][c] = m[c][r]);
        out[r][3] = -(0..3).map(|k| m[k][r] * m[k][3]).sum::<f64>();
    }
    out
}

/// Outline of an object and its bounding box; exact for shapes that are convex along rows.
fn polygon(objects: &image::GrayImage, label: u8) -> (Vec<[f64; 2]>, [f64; 4]) {
    let (mut left, mut right) = (Vec::new(), Vec::new());
    for y in 0..objects.height() {
        let inside = (0..objects.width()).filter(|&x| objects.get_pixel(x, y).0[0] == label);
        if let (Some(a), Some(b)) = (inside.clone().min(), inside.max()) {
            left.push([f64::from(a), f64::from(y)]);
            right.push([f64::from(b), f64::from(y)]);
        }
    }
    let edge =
        |v: &[[f64; 2]], k: usize, of: fn(f64, f64) -> f64| v.iter().map(|p| p[k]).reduce(of).unwrap_or(0.0);
    let bbox = [
        edge(&left, 0, f64::min),
        edge(&left, 1, f64::min),
        edge(&right, 0, f64::max),
        edge(&left, 1, f64::max),
    ];
    right.reverse();
    left.extend(right);
    (left, bbox)
}

/// `transforms.json` as nerfstudio writes it: camera to world in OpenGL axes.
fn transforms(frames: &[Frame]) -> Value {
    let frame_json = |f: &Frame| {
        let mut m = to_world(&f.pose);
        m.iter_mut().take(3).for_each(|row| (1..3).for_each(|c| row[c] = -row[c]));
        let [fx, fy, cx, cy] = f.intrinsics;
        let (w, h) = f.photo.dimensions();
        json!({ "file_path": format!("images/{}.jpg", f.stem), "transform_matrix": m, "fl_x": fx, "fl_y": fy, "cx": cx,
                "cy": cy, "w": w, "h": h })
    };
    json!({ "frames": frames.iter().map(frame_json).collect::<Vec<_>>() })
}

/// Writes `ROOT/SCENE` and `ROOT/label/SCENE` in the layout of LERF-OVS.
fn as_lerf(scene: &Scene, root: &Path, name: &str) {
    let (images, labels) = (root.join(name).join("images"), root.join("label").join(name));
    std::fs::create_dir_all(&images).unwrap();
    std::fs::create_dir_all(&labels).unwrap();
    let frames = scene.frames();
    for f in &frames {
        f.photo.save(images.join(format!("{}.jpg", f.stem))).unwrap();
        let (width, height) = f.photo.dimensions();
        let shown = scene.labels().into_iter().map(|(label, phrase)| (phrase, polygon(&f.objects, label)));
        let objects: Vec<Value> = shown
            .filter(|(_, (outline, _))| outline.len() > 8)
            .map(|(phrase, (outline, bbox))| {
                json!({ "category": phrase, "group": 1, "segmentation": outline, "bbox": bbox, "layer": 1.0, "iscrowd": 0 })
            })
            .collect();
        let info = json!({ "name": format!("{}.jpg", f.stem), "width": width, "height": height, "depth": 3, "note": "" });
        let text = json!({ "info": info, "objects": objects }).to_string();
        std::fs::write(labels.join(format!("{}.json", f.stem)), text).unwrap();
    }
    std::fs::write(root.join(name).join("transforms.json"), transforms(&frames).to_string()).unwrap();
}

/// Writes a scene in the layout of 3D-OVS.
fn as_ovs(scene: &Scene, root: &Path, name: &str) {
    let folder = root.join(name);
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let frames = scene.frames();
    for f in &frames {
        f.photo.save(folder.join("images").join(format!("{}.jpg", f.stem))).unwrap();
        let masks = folder.join("segmentations").join(&f.stem);
        std::fs::create_dir_all(&masks).unwrap();
        for (label, phrase) in scene.labels() {
            let mut mask = f.objects.clone();
            mask.pixels_mut().for_each(|p| p.0[0] = if p.0[0] == label { 255 } else { 0 });
            mask.save(masks.join(format!("{phrase}.png"))).unwrap();
        }
    }
    let classes: Vec<String> = scene.labels().into_values().collect();
    std::fs::write(folder.join("segmentations/classes.txt"), classes.join("\n")).unwrap();
    std::fs::write(folder.join("transforms.json"), transforms(&frames).to_string()).unwrap();
}

/// Writes a scene in the layout of ScanNet: objects are chairs, everything else is wall.
fn as_scannet(scene: &Scene, root: &Path, name: &str) {
    let folder = root.join(name);
    for inner in ["color", "label-filt", "pose", "intrinsic"] {
        std::fs::create_dir_all(folder.join(inner)).unwrap();
    }
    let solid = scene.labels();
    for (k, f) in scene.frames().iter().enumerate() {
        let stem = (10 * k).to_string();
        f.photo.save(folder.join(format!("color/{stem}.jpg"))).unwrap();
        let (w, h) = f.objects.dimensions();
        let raw = image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::from_fn(w, h, |x, y| {
            image::Luma([if solid.contains_key(&f.objects.get_pixel(x, y).0[0]) { 2 } else { 1 }])
        });
        raw.save(folder.join(format!("label-filt/{stem}.png"))).unwrap();
        std::fs::write(folder.join(format!("pose/{stem}.txt")), matrix_text(&to_world(&f.pose))).unwrap();
        let [fx, fy, cx, cy] = f.intrinsics;
        let k = [[fx, 0.0, cx, 0.0], [0.0, fy, cy, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
        std::fs::write(folder.join("intrinsic/intrinsic_color.txt"), matrix_text(&k)).unwrap();
    }
    let table = "id\traw_category\tcategory\tnyu40id\n1\twall\twall\t1\n2\tchair\tchair\t5\n";
    std::fs::write(root.join("scannetv2-labels.combined.tsv"), table).unwrap();
}

fn matrix_text(m: &[[f64; 4]; 4]) -> String {
    m.iter().map(|r| r.map(|v| v.to_string()).join(" ")).collect::<Vec<_>>().join("\n")
}

/// Options of a run of seconds instead of minutes.
const SHORT: [&str; 7] =
    ["--iterations", "10", "--language-iterations", "2", "--true-cameras", "--max-points", "5000"];

fn ablate(args: &[&str], data: &Path, out: &Path) -> Value {
    let all = [args, &["--data", path(data), "--out", path(out), "--json"], &SHORT].concat();
    let output = splatlab(&[&["ablate"][..], &all].concat());
    assert!(output.status.success(), "{all:?}\n{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn row<'r>(report: &'r Value, label: &str) -> &'r Value {
    let rows = report["tables"][0]["rows"].as_array().unwrap();
    rows.iter().find(|r| r["label"] == label).expect(label)
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn true_segmentation_scores_in_every_layout() {
    let scene = Scene::generate("1003");
    let root = tempfile::tempdir().unwrap();
    as_lerf(&scene, &root.path().join("lerf_ovs"), "teatime");
    as_ovs(&scene, &root.path().join("3d_ovs"), "bed");
    as_scannet(&scene, &root.path().join("scannet"), "scene0000_00");
    for (layout, data, least) in [
        // LERF's masks are cut from smoothed maps: at this size edges move by much of an object.
        ("lerf", "lerf_ovs/teatime", 0.6),
        ("3dovs", "3d_ovs/bed", 0.55),
        ("scannet", "scannet/scene0000_00", 0.8),
    ] {
        let out = root.path().join(format!("out-{layout}"));
        let report = ablate(&["feed-forward"], &root.path().join(data), &out);
        assert_eq!(
            report["layout"],
            if layout == "scannet" { json!({"published": "scannet"}) } else { json!({"published": layout}) }
        );
        let figures = &row(&report, "true segmentation")["figures"];
        let figure = |name: &str| figures[name].as_f64().unwrap_or(f64::NAN);
        assert!(figure("mIoU") > least && figure("SIM") > 0.9, "{layout}: {figures}");
        assert!(figure("Tr.T") > 0.0 && figure("T.T") > figure("Tr.T"), "{layout}: {figures}");
        // Found masks score less than true ones.
        let own = row(&report, "sparselgs")["figures"]["mIoU"].as_f64().unwrap();
        assert!(own < figure("mIoU"), "{layout}: {own} {figures}");
        // Those that are found in the photos themselves, without a scene.
        let flat = &row(&report, "in 2D, per mask")["figures"];
        assert!(flat["mIoU"].as_f64().unwrap() > 0.0 && flat["Tr.T"].is_null(), "{layout}: {flat}");
        for label in ["features of lseg", "lseg in 2D", "lseg in 2D, per mask"] {
            let note = row(&report, label)["note"].as_str().unwrap();
            assert_eq!(note, "not installed: splatvk models fetch lseg");
        }
        // The draft preset does not measure what the paper's figures measure.
        assert_eq!(row(&report, "sparselgs")["paper"], json!({}), "{layout}");
    }
}

/// Replaces the cameras of a LERF scene by a COLMAP model of all photos, with points of true depth.
fn with_colmap_model(scene: &Scene, folder: &Path) {
    let truth = GroundTruth::read(&scene.folder.path().join("data")).unwrap();
    let (mut cameras, mut points) = (Vec::new(), PointCloud::default());
    for (view, frame) in truth.frames.iter().enumerate() {
        let depth = truth.depth(frame).unwrap().unwrap();
        cameras.push(Camera { name: format!("{}.jpg", frame.stem), ..frame.camera.clone() });
        for i in (0..depth.data.len()).step_by(41).filter(|&i| depth.data[i] > 0.0) {
            let pixel = DVec2::new((i % depth.width) as f64 + 0.5, (i / depth.width) as f64 + 0.5);
            let point = frame.camera.unproject(pixel, f64::from(depth.data[i]));
            points.positions.push(point.as_vec3().to_array());
            points.colours.push([0.5; 3]);
            points.confidence.push(1.0);
            points.view.push(view as u32);
            points.radius.push(0.0);
        }
    }
    std::fs::remove_file(folder.join("transforms.json")).unwrap();
    std::fs::create_dir_all(folder.join("sparse/0")).unwrap();
    colmap::write_binary(&folder.join("sparse/0"), &cameras, Some(&points)).unwrap();
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn colmap_models_are_rows_and_figures_are_drawn() {
    let scene = Scene::generate("1003");
    let root = tempfile::tempdir().unwrap();
    as_lerf(&scene, &root.path().join("lerf_ovs"), "teatime");
    let data = root.path().join("lerf_ovs/teatime");
    with_colmap_model(&scene, &data);
    let report = ablate(&["colmap"], &data, &root.path().join("out"));
    for method in ["langsplat", "legaussians", "sparselgs"] {
        let dense = row(&report, &format!("{method}, dense COLMAP"));
        assert!(dense["figures"]["mIoU"].is_f64(), "{dense}");
        let sparse = row(&report, &format!("{method}, sparse COLMAP"));
        assert_eq!(sparse["note"], "no COLMAP model with points in sparse_views/0");
    }
    let figure = |label: &str, name: &str| row(&report, label)["figures"][name].as_f64().unwrap();
    let (stereo, points) = (figure("sparselgs", "splats"), figure("sparselgs, dense COLMAP", "splats"));
    assert!(points < 0.7 * stereo && points > 1000.0, "{points} {stereo}");

    let pages = root.path().join("figures");
    let args = ["figures", "--data", path(&data), "--out", path(&pages), "--methods", "sparselgs,langsplat"];
    let output = splatlab(&[&args[..], &SHORT].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(pages.join("figures.html")).unwrap();
    let files: Vec<&str> = page.split("src=\"").skip(1).map(|p| p.split('"').next().unwrap()).collect();
    for section in ["masks", "locations", "alignment-s", "alignment-l", "failures"] {
        assert!(files.iter().any(|f| f.starts_with(section)), "no picture of {section}: {files:?}");
    }
    for file in files {
        assert_eq!(image::open(pages.join(file)).unwrap().dimensions(), (160, 120), "{file}");
    }
}

#[test]
#[ignore = "takes long: tools/test-long"]
fn driver_runs_available_data_sets() {
    let root = tempfile::tempdir().unwrap();
    let (data, out) = (root.path().join("data"), root.path().join("out"));
    for (seed, name) in [("1003", "teatime"), ("1004", "ramen")] {
        as_lerf(&Scene::generate(seed), &data.join("lerf_ovs"), name);
    }
    std::fs::create_dir_all(data.join("3d_ovs/sofa/images")).unwrap();
    let driver = concat!(env!("CARGO_MANIFEST_DIR"), "/tools/paper-tables");
    let run = |data: &Path| {
        let options = ["--", "--seeds", "0", "--regions", "exact"];
        let mut command = Command::new(driver);
        command.arg(data).arg(&out).args(options).args(SHORT);
        command
            .env("SPLATVK", splatvk())
            .env("SPLATLAB", env!("CARGO_BIN_EXE_splatlab"))
            .env("ONLY", "alignment")
            .output()
            .unwrap()
    };
    let output = run(&data);
    let (said, errors) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}\n{errors}");
    for line in [
        "lerf: figurines lacks the folder itself",
        "3dovs: sofa lacks images/, segmentations/classes.txt",
        "3dovs: bed lacks the folder itself",
        "scannet: not in ",
        "network sam: splatvk models fetch sam_vit_h",
    ] {
        assert!(said.contains(line), "no \"{line}\" in {said}");
    }
    let page = std::fs::read_to_string(out.join("paper-tables.md")).unwrap();
    assert!(page.contains("## lerf: ramen, teatime") && page.contains("### alignment"), "{page}");
    let steps = page.lines().find(|l| l.starts_with("| steps 1, 2, 3 |")).unwrap();
    assert!(steps.contains(" ± ") && !steps.contains("(0.538)") && steps.contains("| 2 |"), "{steps}");
    assert!(page.contains("mIoU by scene") && page.contains("lerf: figurines lacks"), "{page}");
    // The second call reuses every row.
    let seconds = || {
        let report = read(&out.join("lerf-1/ablate.json"));
        let all = report["measurements"].as_array().unwrap().clone();
        all.iter().map(|m| format!("{:.9}", m["figures"]["T.T"].as_f64().unwrap())).collect::<Vec<_>>()
    };
    let before = seconds();
    assert!(run(&data).status.success());
    assert_eq!((before.len(), &before), (10, &seconds()));
    let nothing = run(&root.path().join("nowhere"));
    assert_eq!(nothing.status.code(), Some(2));
}
