//! Queries by a concept network: text → masks of the photos → splats → masks of views, with small
//! graphs that have the interfaces of public exports of SAM 3.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
mod fixture;

use fixture::command::{refuses, splatvk, text};
use serde_json::Value;
use splatlab::generate::regions::InjectedErrors;
use splatlab::generate::{SceneSpec, generate};
use splatvk::eval::GroundTruth;
use splatvk::format::picture;
use splatvk::format::scene_dir::{self, Contents};
use splatvk::format::scene_photos;
use splatvk::infer::concepts::Concepts;
use splatvk::infer::installed::Task;
use splatvk::infer::{PackFileKind, Registry};
use splatvk::progress::Silent;
use splatvk::scene::{Camera, Pose, RgbImage, Seen, Splats, World};
use splatvk_test_support::onnx::{Attribute, BOOL, FLOAT, INT64, Onnx};
use splatvk_test_support::toys::{WORDS, photo, tokenizer};
use std::path::{Path, PathBuf};

/// Size of the photos, pixels; the focal length is the width.
const SIZE: [usize; 2] = [96, 72];
const GREY: [f32; 3] = [0.5; 3];
const RED: [f32; 3] = [0.9, 0.1, 0.1];
const BLUE: [f32; 3] = [0.1, 0.1, 0.9];
/// Places of the cameras on x.
const PLACES: [f64; 3] = [-0.1, 0.0, 0.1];

/// Colour of a wall at z = 1 with a red and a blue square.
fn colour([x, y]: [f64; 2]) -> [f32; 3] {
    match (y.abs() < 0.15, x) {
        (true, -0.35..-0.05) => RED,
        (true, 0.1..0.4) => BLUE,
        _ => GREY,
    }
}

fn camera(k: usize) -> Camera {
    let [width, height] = SIZE;
    let focal = width as f64;
    let translation = glam::DVec3::new(-PLACES[k], 0.0, 0.0);
    Camera {
        name: format!("view{k}"),
        width: width as u32,
        height: height as u32,
        fx: focal,
        fy: focal,
        cx: 0.5 * width as f64,
        cy: 0.5 * height as f64,
        pose: Pose { translation, ..Pose::IDENTITY },
    }
}

/// Colours that a camera sees on the wall.
fn image(k: usize) -> RgbImage {
    let [width, height] = SIZE;
    let pixel = |p: usize| {
        let at = [p % width, p / width].map(|u| u as f64 + 0.5);
        let centred = [at[0] - 0.5 * width as f64, at[1] - 0.5 * height as f64];
        colour([centred[0] / width as f64 + PLACES[k], centred[1] / width as f64])
    };
    RgbImage { width, height, data: (0..width * height).map(pixel).collect() }
}

/// A scene without language: the wall as splats, and its photos.
fn scene(folder: &Path) -> PathBuf {
    const STEP: f64 = 0.015;
    let mut splats = Splats::default();
    for (i, j) in (-32..=32).flat_map(|j| (-45..=45).map(move |i| (i, j))) {
        let [x, y] = [f64::from(i) * STEP, f64::from(j) * STEP];
        splats.means.push([x as f32, y as f32, 1.0]);
        splats.sh.extend(colour([x, y]).map(|c| (c - 0.5) / 0.282_094_8));
    }
    let count = splats.means.len();
    splats.log_scales = vec![[(0.6 * STEP).ln() as f32; 3]; count];
    splats.quats = vec![[1.0, 0.0, 0.0, 0.0]; count];
    splats.opacity_logits = vec![4.0; count];
    let photos: Vec<_> = (0..3).map(|k| photo(&format!("view{k}"), image(k))).collect();
    let cameras: Vec<Camera> = (0..3).map(camera).collect();
    let scene = folder.join("wall");
    std::fs::create_dir(&scene).unwrap();
    let contents = Contents {
        splats: &splats,
        seen: &Seen::default(),
        backdrop: &Splats::default(),
        holes: &Default::default(),
        cameras: &cameras,
        world: &World::default(),
        photos: &photos,
        points: None,
        language: None,
        text_embeddings: None,
    };
    scene_dir::write(&scene, &contents).unwrap();
    scene
}

/// Names of the tensors of a layout: image, feature maps, position, text and mask of the decoder.
struct Layout {
    image: &'static str,
    levels: [&'static str; 4],
    text: [&'static str; 2],
    /// The layout of usls has truth values for masks, and the presence head.
    is_usls: bool,
}

const USLS: Layout = Layout {
    image: "images",
    levels: ["fpn_feat_0", "fpn_feat_1", "fpn_feat_2", "fpn_pos_2"],
    text: ["prompt_features", "prompt_mask"],
    is_usls: true,
};
const TRANSFORMERS: Layout = Layout {
    image: "pixel_values",
    levels: ["fpn_hidden_state_0", "fpn_hidden_state_1", "fpn_hidden_state_2", "fpn_position_encoding_2"],
    text: ["text_features", "attention_mask"],
    is_usls: false,
};

/// The other feature maps are constant: 0.1, 0.2 and 0.4.
const CONSTANTS: [f32; 3] = [0.1, 0.2, 0.4];

fn image_encoder(layout: &Layout) -> Onnx {
    let [fine, rest @ ..] = layout.levels;
    let pool = [("kernel_shape", Attribute::Ints(&[2, 2])), ("strides", Attribute::Ints(&[2, 2]))];
    let mut graph = Onnx::new()
        .input(layout.image, FLOAT, "batch 3 128 128")
        .output(fine, "batch 3 64 64")
        .node("AveragePool", layout.image, fine, &pool);
    for ((name, side), value) in rest.into_iter().zip([32u64, 16, 16]).zip(CONSTANTS) {
        let data = vec![value; 3 * (side * side) as usize];
        graph = graph
            .output(name, &format!("batch 3 {side} {side}"))
            .weight(&format!("all_{name}"), &[1, 3, side, side], &data)
            .node("Identity", &format!("all_{name}"), name, &[]);
    }
    graph
}

/// The row of red is (1, −1, −1), and so on; those of other words and of the padding are (5, 5, 5),
/// which no colour has.
fn text_encoder(layout: &Layout) -> Onnx {
    let rows = (0..WORDS.len()).flat_map(|word| match word {
        1..=3 => [0, 1, 2].map(|c| if c + 1 == word { 1.0 } else { -1.0 }),
        _ => [5.0; 3],
    });
    let graph = Onnx::new()
        .input("input_ids", INT64, "batch 32")
        .input("attention_mask", INT64, "batch 32")
        .output("text_features", "batch 32 3")
        .weight("table", &[WORDS.len() as u64, 3], &rows.collect::<Vec<f32>>())
        .node("Gather", "table input_ids", "text_features", &[]);
    match layout.is_usls {
        true => graph.output_of("text_mask", BOOL, "batch 32").node(
            "Cast",
            "attention_mask",
            "text_mask",
            &[("to", Attribute::Int(9))],
        ),
        false => graph,
    }
}

/// Logits: the product of the colours of the pixels, in −1..1, with the sum of the rows of the
/// text, less the sum of the other feature maps, weighted with 1, 2 and 1 (0.9). The presence is
/// small for rows other than those of colours.
fn decoder(layout: &Layout) -> Onnx {
    let ([l0, l1, l2, position], [features, mask]) = (layout.levels, layout.text);
    let kind = if layout.is_usls { BOOL } else { INT64 };
    let to_float = [("to", Attribute::Int(1))];
    let kept = [("keepdims", Attribute::Int(1))];
    let salt = f32::from((std::process::id() % 65_536) as u16);
    let graph = Onnx::new()
        .input(l0, FLOAT, "batch 3 64 64")
        .input(l1, FLOAT, "batch 3 32 32")
        .input(l2, FLOAT, "batch 3 16 16")
        .input(position, FLOAT, "batch 3 16 16")
        .input(features, FLOAT, "batch 32 3")
        .input(mask, kind, "batch 32")
        .output("pred_masks", "batch 2 64 64")
        .output("pred_boxes", "batch 2 4")
        .output("pred_logits", "batch 2")
        // Another file than that of an earlier process, whose results are cached.
        .weight("salt", &[1], &[salt])
        .weight("two", &[1], &[2.0])
        .weight("ten", &[1], &[10.0])
        .weight("six", &[1], &[6.0])
        .weight("fourteen", &[1], &[14.0])
        .weight("nowhere", &[1, 1, 64, 64], &[-1.0; 64 * 64])
        .weight("scores", &[1, 2], &[3.0, -3.0])
        .weight("boxes", &[1, 2, 4], &[0.5; 8])
        .integers("per_token", &[1, 32, 1])
        .integers("per_channel", &[1, 3, 1, 1])
        .integers("one", &[1])
        .node("Cast", mask, "numbers", &to_float)
        .node("Reshape", "numbers per_token", "weights", &[])
        .node("Mul", &format!("{features} weights"), "words", &[])
        .node("ReduceSum", "words one", "row", &[("keepdims", Attribute::Int(0))])
        .node("Reshape", "row per_channel", "colour", &[])
        .node("Mul", &format!("{l0} colour"), "products", &[])
        .node("ReduceSum", "products one", "likeness", &kept)
        .node("ReduceMean", l1, "a", &kept)
        .node("ReduceMean", l2, "b", &kept)
        .node("Mul", "b two", "twice", &[])
        .node("ReduceMean", position, "c", &kept)
        .node("Add", "a twice", "ab", &[])
        .node("Add", "ab c", "bias", &[])
        .node("Sub", "likeness bias", "logits", &[])
        .node("Concat", "logits nowhere", "pred_masks", &[("axis", Attribute::Int(1))])
        .node("Identity", "scores", "pred_logits", &[])
        .node("Identity", "boxes", "pred_boxes", &[]);
    match layout.is_usls {
        true => graph
            .output("presence_logits", "batch 1")
            .node(
                "ReduceMax",
                "row",
                "most",
                &[("axes", Attribute::Ints(&[1])), ("keepdims", Attribute::Int(1))],
            )
            .node("Mul", "most ten", "much", &[])
            // 10 − 6 = 14 − 10 for a colour, 14 − 50 for rows of 5.
            .node("Sub", "much six", "high", &[])
            .node("Sub", "fourteen much", "low", &[])
            .node("Min", "high low", "presence_logits", &[]),
        false => graph,
    }
}

/// Installs a network of this layout; returns the folder of the models.
fn install(folder: &Path, layout: &Layout) -> PathBuf {
    let models = folder.join("models");
    image_encoder(layout).write(&models.join("sam3/vision-encoder.onnx"));
    text_encoder(layout).write(&models.join("sam3/text-encoder.onnx"));
    decoder(layout).write(&models.join("sam3/decoder.onnx"));
    std::fs::write(models.join("sam3/tokenizer.json"), tokenizer()).unwrap();
    models
}

/// Both layouts of public exports give every tensor to its role.
#[test]
fn sam3_reads_public_layouts() {
    for layout in [USLS, TRANSFORMERS] {
        let folder = tempfile::tempdir().unwrap();
        let models = install(folder.path(), &layout);
        let model = Registry::of(&[&models]).installed(Task::Concepts, "sam3").unwrap();
        let mut network = Concepts::load(model).unwrap();
        let flat = RgbImage { width: 64, height: 32, data: vec![RED; 64 * 32] };
        let found = network.find(&flat, &["red", "green", "dog"]).unwrap();
        // 0.8 − (−0.8) − (−0.8) less 0.1 + 2 · 0.2 + 0.4; with presence 1 / (1 + e⁻⁴).
        let presence = if layout.is_usls { 1.0 / (1.0 + (-4f32).exp()) } else { 1.0 };
        let instance = &found[0].instances[0];
        assert!((instance.score - presence / (1.0 + (-3f32).exp())).abs() < 1e-5, "{}", instance.score);
        assert!(instance.logits.data.iter().all(|v| (v - 1.5).abs() < 1e-4), "{}", instance.logits.data[0]);
        assert!(found[0].mask(64, 32).data.iter().all(|m| *m) && found[0].instances.len() == 1);
        assert!(!found[1].mask(64, 32).data.contains(&true), "no pixel is green");
        if layout.is_usls {
            assert!(found[2].instances.is_empty() && found[2].best < 0.01, "{}", found[2].best);
        }
    }
}

/// Output of a query with --json.
fn ask(scene: &Path, models: &Path, texts: &[&str], more: &[&str]) -> Value {
    let mut query = splatvk();
    query.arg("query").arg(scene).args(texts).args(["--concepts", "sam3", "--json", "--models"]).arg(models);
    let output = query.args(more).output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// IoU of a mask file and the pixels of a colour in a photo.
fn iou(file: &Path, k: usize, wanted: [f32; 3]) -> f64 {
    let mask = image::open(file).unwrap().to_luma8();
    let photo = image(k);
    let pairs = mask.as_raw().iter().zip(&photo.data).map(|(m, c)| (*m > 127, *c == wanted));
    let (both, either) =
        pairs.fold((0, 0), |(b, e), (m, c)| (b + usize::from(m && c), e + usize::from(m || c)));
    both as f64 / either as f64
}

#[test]
fn masks_of_photos_become_splats_and_views() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, models) = (scene(folder.path()), install(folder.path(), &USLS));
    let out = folder.path().join("out");
    let report = ask(&scene, &models, &["red", "blue", "dog"], &["--splats", "--out", out.to_str().unwrap()]);
    for (n, colour, x) in [(0, RED, -0.2), (1, BLUE, 0.25)] {
        let answer = &report["queries"][n];
        assert_eq!(answer["presence"], "found");
        let findings = &answer["concepts"];
        assert!(findings["network"] == "sam3" && findings["found"] == 3, "{findings}");
        assert_eq!(findings["disagreeing"], serde_json::json!([]));
        let instances = answer["instances"].as_array().unwrap();
        let centre = |axis: usize| instances[0]["centre"][axis].as_f64().unwrap();
        assert!(
            instances.len() == 1 && (centre(0) - x).abs() < 0.01 && centre(1).abs() < 0.01,
            "{instances:?}"
        );
        for (k, view) in answer["views"].as_array().unwrap().iter().enumerate() {
            assert!(view["found"] == true && view["level"].is_null(), "{view}");
            let overlap = iou(&out.join(view["mask"].as_str().unwrap()), k, colour);
            assert!(overlap > 0.8, "{overlap}");
            assert!(out.join(view["heat"].as_str().unwrap()).is_file());
            // The location is inside the square.
            let place = &view["place"]["position"];
            assert!((place[0].as_f64().unwrap() - x).abs() < 0.15, "{view}");
        }
        let file = out.join(answer["splats"]["file"].as_str().unwrap());
        let splats = splatvk::format::ply::read_splats(&file).unwrap();
        assert!(splats.means.iter().all(|m| (f64::from(m[0]) - x).abs() < 0.17 && m[1].abs() < 0.17));
        assert_eq!(splats.len(), answer["splats"]["count"].as_u64().unwrap() as usize);
        // 20 × 20 splats of the square, up to its border.
        assert!((300..=500).contains(&splats.len()), "{}", splats.len());
    }
    let absent = &report["queries"][2];
    assert!(absent["presence"] == "absent" && absent["concepts"]["found"] == 0, "{absent}");
    assert!(absent["instances"] == serde_json::json!([]) && absent["splats"]["count"] == 0);
    let views = absent["views"].as_array().unwrap();
    assert!(views.iter().all(|v| v["found"] == false && v["mask_pixels"] == 0), "{views:?}");
    let mut table = splatvk();
    table.arg("query").arg(&scene).args(["dog", "red", "--concepts", "sam3", "--models"]).arg(&models);
    let table = text(&table.output().unwrap().stdout);
    assert!(table.contains("no sign of it") && table.contains("sam3 finds it in 3 of 3 photos"), "{table}");
}

/// `--ignore` takes the masks of an installed network, for words that the built-in ones do not know.
#[test]
fn ignored_things_are_found_by_network() {
    let folder = tempfile::tempdir().unwrap();
    let models = install(folder.path(), &USLS);
    // Points of given cameras are triangulated from built-in keypoints.
    let keypoints = Registry::open(None).unwrap().path(PackFileKind::Keypoints).unwrap();
    std::fs::copy(&keypoints, models.join(keypoints.file_name().unwrap())).unwrap();
    let set = folder.path().join("set");
    let spec = SceneSpec { seed: 1003, views: 2, held_out: 1, size: (160, 120), ..SceneSpec::default() };
    generate(&set, &spec, &InjectedErrors::NONE, &Silent).unwrap();
    let out = folder.path().join("scene");
    let mut train = splatvk();
    train.arg("train").arg("--images").arg(set.join("images"));
    train.arg("--cameras").arg(set.join("cameras_noisy.json")).arg("--models").arg(&models);
    train.args(["--ignore", "blue", "--ignore", "dog", "--iterations", "1", "--json", "--out"]).arg(&out);
    let output = train.output().unwrap();
    let log = text(&output.stderr);
    assert!(output.status.success(), "{log}");
    assert!(log.contains("--ignore dog: found in 0 of 2 photos; nothing is ignored"), "{log}");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    let record = &report["run"]["statistics"]["ignored"];
    assert!(record[0]["by"] == "sam3" && record[0]["photos"].as_array().unwrap().len() == 2, "{record}");
    let truth = GroundTruth::read(&set).unwrap();
    let photos = scene_photos::load(&out).unwrap();
    for (photo, frame) in photos.iter().zip(&truth.frames) {
        let objects = truth.objects(frame).unwrap().unwrap();
        let share = |wanted: &dyn Fn(&str) -> bool| {
            let pixels = || {
                let phrase = |label: &u32| truth.labels.get(label).map_or("", String::as_str);
                objects.data.iter().enumerate().filter(move |(_, label)| wanted(phrase(label)))
            };
            pixels().filter(|(p, _)| !photo.uses(*p)).count() as f64 / pixels().count() as f64
        };
        let (blue, wall) =
            (share(&|phrase| phrase.starts_with("blue")), share(&|phrase| phrase == "plaster wall"));
        assert!(blue > 0.9 && wall < 0.05, "{}: {blue} {wall}", photo.stem);
    }
}

#[test]
fn disagreeing_photo_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, models) = (scene(folder.path()), install(folder.path(), &USLS));
    std::fs::remove_dir_all(scene.join("cameras/images")).unwrap();
    let mut missing = splatvk();
    missing.arg("query").arg(&scene).args(["red", "--concepts", "sam3", "--models"]).arg(&models);
    refuses(&mut missing, 2, &["view0.png", "--photos DIR"]);
    // In the second photo the square is painted over.
    let photos = folder.path().join("photos");
    std::fs::create_dir(&photos).unwrap();
    for k in 0..3 {
        let mut image = image(k);
        image.data.iter_mut().filter(|c| k == 1 && **c == RED).for_each(|c| *c = GREY);
        picture::write_png(&photos.join(format!("view{k}.png")), &image).unwrap();
    }
    let report = ask(&scene, &models, &["red"], &["--photos", photos.to_str().unwrap()]);
    let findings = &report["queries"][0]["concepts"];
    assert!(findings["found"] == 2 && findings["disagreeing"] == serde_json::json!(["view1"]), "{findings}");
    let cropped = RgbImage { width: 72, height: 72, data: vec![RED; 72 * 72] };
    picture::write_png(&photos.join("view0.png"), &cropped).unwrap();
    let mut other = splatvk();
    other.arg("query").arg(&scene).args(["red", "--concepts", "sam3", "--models"]).arg(&models);
    refuses(other.arg("--photos").arg(&photos), 2, &["view0.png", "72 × 72", "96 × 72"]);
}

#[test]
fn missing_network_is_refused_with_command() {
    let folder = tempfile::tempdir().unwrap();
    let scene = scene(folder.path());
    let models = folder.path().join("models");
    std::fs::create_dir(&models).unwrap();
    let mut query = splatvk();
    query.arg("query").arg(&scene).args(["red", "--concepts", "sam3", "--models"]).arg(&models);
    refuses(&mut query, 3, &["splatvk models fetch sam3 --accept sam3", "SAM License (Meta)"]);
    let mut fetch = splatvk();
    fetch.args(["models", "fetch", "sam3", "--yes", "--models"]).arg(&models);
    refuses(&mut fetch, 2, &["SAM License (Meta) forbids military", "--accept sam3"]);
}
