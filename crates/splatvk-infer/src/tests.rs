//! Tests with tiny graphs that have the interfaces of users' networks.
use std::path::Path;

use super::catalogue::{CatalogueEntry, catalogue, common_packages};
use super::clip::Clip;
use super::contract::Part;
use super::graph::GraphFile;
use super::installed::{Task, inventory};
use super::{Input, RegionEncoder, Registry, pairs, warp};
use crate::files::sha256;
use splatvk_test_support::onnx::{Attribute, FLOAT, INT64, Onnx};
use splatvk_test_support::toys::{clip_in, image_tower, photo, text_tower};

use crate::progress::Silent;
use crate::scene::{Image, RgbImage};

/// The error of recognising, or of loading and running, one graph.
fn refused(graph: &Onnx, extra: &[(&str, &str)]) -> String {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("graph.onnx");
    graph.write(&path);
    for (name, text) in extra {
        std::fs::write(dir.path().join(name), text).unwrap();
    }
    let run = || {
        let mut graph = GraphFile::recognise(&path)?.load()?;
        graph.run(vec![("image", Input::F32(vec![1, 3, 16, 16], vec![0.5; 768]))])
    };
    let error = run().expect_err("must be refused").to_string();
    assert!(!error.contains('\n') && error.contains("graph.onnx"), "one line that names the file: {error}");
    error
}

#[test]
fn clip_towers_are_recognised_and_matched() {
    let dir = tempfile::tempdir().unwrap();
    clip_in(dir.path(), [0, 1, 2]);
    let registry = Registry::of(&[dir.path()]);
    let model = registry.installed(Task::Features, "clip").unwrap();
    assert_eq!((model.name.as_str(), model.family.as_str()), ("clip_toy", "clip"));
    let mut clip = Clip::load(model).unwrap();
    assert_eq!((clip.dim(), clip.tokens("Red dog").unwrap()), (3, vec![1, 4]));
    assert_eq!(clip.tokens(&("red ".repeat(50) + "dog")).unwrap(), [1, 1, 1, 1, 1, 1, 1, 4], "cut");

    // The left half is green, the right half blue; a label without pixels has a zero row.
    let (mut image, mut labels) =
        (RgbImage { width: 32, height: 20, data: Vec::new() }, Image::filled(32, 20, 0));
    for p in 0..32 * 20 {
        let right = p % 32 >= 16;
        image.data.push(if right { [0.0, 0.1, 1.0] } else { [0.0, 1.0, 0.1] });
        labels.data[p] = i32::from(right);
    }
    let regions = clip.embed_regions(&image, &labels, 3, &crate::progress::Silent).unwrap();
    let texts = clip.embed_texts(&["green", "blue"]).unwrap();
    let dot = |r: usize, t: usize| (0..3).map(|k| regions[3 * r + k] * texts[3 * t + k]).sum::<f32>();
    assert!(dot(0, 0) > dot(0, 1) && dot(1, 1) > dot(1, 0), "{regions:?} {texts:?}");
    assert_eq!(regions[6..], [0.0; 3]);

    clip_in(dir.path(), [1, 2, 0]);
    let mismatched = Clip::load(registry.installed(Task::Features, "clip").unwrap()).err().unwrap();
    assert!(mismatched.to_string().contains("do not belong together"), "{mismatched}");
    assert_eq!(mismatched.exit_code(), 3);
}

/// Folders from a hub also have both towers in one graph, and incompletely downloaded variants.
#[test]
fn inventory_complete_model_ignores_unusable_files() {
    let dir = tempfile::tempdir().unwrap();
    clip_in(dir.path(), [0, 1, 2]);
    let both = image_tower().input("input_ids", INT64, "batch 8").output("logits_per_image", "batch batch");
    both.write(&dir.path().join("clip_toy/model.onnx"));
    std::fs::write(dir.path().join("clip_toy/vision_model_fp16.onnx"), "cut").unwrap();
    let found = inventory(&Registry::of(&[dir.path()]));
    assert!(found.broken.is_empty() && found.models.len() == 1, "{:?}", found.broken);
    let unused = &found.models[0].unused;
    assert_eq!(unused.len(), 2, "{unused:?}");
    assert!(
        unused[0].contains("model.onnx: fits no known model") && unused[1].contains("fp16"),
        "{unused:?}"
    );
    // Without a tower, each file is broken and has a reason.
    std::fs::remove_file(dir.path().join("clip_toy/text_model.onnx")).unwrap();
    let found = inventory(&Registry::of(&[dir.path()]));
    assert_eq!((found.models.len(), found.broken.len()), (0, 3), "{:?}", found.broken);
}

#[test]
fn clip_mismatched_towers_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    clip_in(dir.path(), [0, 1, 2]);
    let registry = Registry::of(&[dir.path()]);
    let folder = dir.path().join("clip_toy");
    std::fs::write(folder.join("vision_model.toml"), "family = \"clip\"\ncheckpoint = \"a\"").unwrap();
    std::fs::write(folder.join("text_model.toml"), "family = \"clip\"\ncheckpoint = \"b\"").unwrap();
    let apart = registry.installed(Task::Features, "clip").unwrap_err().to_string();
    assert!(apart.contains("different checkpoints (a and b)"), "{apart}");
    std::fs::remove_file(folder.join("text_model.toml")).unwrap();
    Onnx::new()
        .input("input_ids", INT64, "1 8")
        .output("text_embeds", "1 8")
        .node("Cast", "input_ids", "text_embeds", &[("to", Attribute::Int(1))])
        .write(&folder.join("text_model.onnx"));
    let wide = Clip::load(registry.installed(Task::Features, "clip").unwrap()).err().unwrap().to_string();
    assert!(wide.contains("embeddings of 3 and 8 values"), "{wide}");
    std::fs::remove_file(folder.join("text_model.onnx")).unwrap();
    let half = registry.installed(Task::Features, "clip").unwrap_err().to_string();
    assert!(half.contains("only its image-tower") && half.contains("text-tower"), "{half}");
}

#[test]
fn recognise_unknown_graph_states_nearest_contract() {
    let graph = Onnx::new().input("pixel_values", FLOAT, "batch 3 16 16").output("strange", "batch 3").node(
        "ReduceMean",
        "pixel_values",
        "strange",
        &[("axes", Attribute::Ints(&[2, 3])), ("keepdims", Attribute::Int(0))],
    );
    let error = refused(&graph, &[]);
    for part in
        ["pixel_values [?×3×16×16]", "strange [?×3]", "nearest is image-tower (clip)", "embedding", ".toml"]
    {
        assert!(error.contains(part), "{part}: {error}");
    }
    // With an adapter, the same file is used.
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("graph.onnx");
    graph.write(&path);
    let adapter = "family = \"clip\"\n[[graph]]\npart = \"image-tower\"\nnames.embedding = \"strange\"";
    std::fs::write(path.with_extension("toml"), adapter).unwrap();
    let mut graph = GraphFile::recognise(&path).unwrap().load().unwrap();
    let mut out = graph.run(vec![("image", Input::F32(vec![1, 3, 16, 16], vec![0.5; 768]))]).unwrap();
    assert_eq!(out.take("embedding").unwrap().data, [0.5; 3]);
    let misspelt = adapter.replace("names.embedding", "names.embeding");
    std::fs::write(path.with_extension("toml"), misspelt).unwrap();
    let error = GraphFile::recognise(&path).unwrap_err().to_string();
    assert!(
        error.contains("graph.toml") && error.contains("embeding") && error.contains("image, embedding"),
        "{error}"
    );
}

#[test]
fn recognise_bad_files_states_remedy() {
    let mut future = image_tower();
    future.opset = 99;
    let error = refused(&future, &[]);
    assert!(error.contains("opset_version=17") && error.contains("99"), "{error}");

    let ranked = Onnx::new()
        .input("pixel_values", FLOAT, "batch 3 16 16")
        .output("image_embeds", "batch 3 1 1")
        .node("ReduceMean", "pixel_values", "image_embeds", &[("axes", Attribute::Ints(&[2, 3]))]);
    let error = refused(&ranked, &[]);
    assert!(error.contains("image_embeds [?×3×1×1] cannot be embedding [B D]"), "{error}");

    let silent = Onnx::new().input("pixel_values", FLOAT, "batch 3 16 16").output("image_embeds", "…").node(
        "ReduceMean",
        "pixel_values",
        "image_embeds",
        &[("axes", Attribute::Ints(&[2, 3]))],
    );
    let error = refused(&silent, &[]);
    assert!(error.contains("[1, 3, 1, 1]") && error.contains("swapped"), "seen when it runs: {error}");

    let nan = Onnx::new()
        .input("pixel_values", FLOAT, "batch 3 16 16")
        .output("image_embeds", "batch 3")
        .weight("zero", &[1], &[0.0])
        .node(
            "ReduceMean",
            "pixel_values",
            "mean",
            &[("axes", Attribute::Ints(&[2, 3])), ("keepdims", Attribute::Int(0))],
        )
        .node("Mul", "mean zero", "nothing", &[])
        .node("Div", "nothing zero", "image_embeds", &[]);
    let error = refused(&nan, &[]);
    assert!(error.contains("image_embeds holds NaN"), "{error}");

    let adapter = |hash: &str| format!("family = \"clip\"\n[sha256]\n\"graph.onnx\" = \"{hash}\"\n");
    let error = refused(&image_tower(), &[("adapter.toml", &adapter("00ff"))]);
    let own = sha256(&image_tower().encode());
    assert!(error.contains(&format!("has sha256 {own}, its adapter pins 00ff")), "{error}");
    // With its own hash the file loads, and its NaN is refused.
    let error = refused(&nan, &[("adapter.toml", &adapter(&sha256(&nan.encode())))]);
    assert!(error.contains("image_embeds holds NaN"), "{error}");

    let split = image_tower().external("far", &[4], "weights.bin");
    let error = refused(&split, &[]);
    assert!(error.contains("weights.bin, which is missing"), "{error}");

    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("cut.onnx");
    let whole = text_tower([0, 1, 2]).encode();
    for length in [whole.len() / 2, whole.len() - 1, 0] {
        std::fs::write(&path, &whole[..length]).unwrap();
        let error = GraphFile::recognise(&path).unwrap_err().to_string();
        assert!(error.contains("cut.onnx: not a complete ONNX file"), "{error}");
    }
    std::fs::write(&path, "<html>404 Not Found</html>").unwrap();
    assert!(GraphFile::recognise(&path).unwrap_err().to_string().contains("of another format"));
    assert!(inventory(&Registry::of(&[dir.path()])).broken[0].reason.contains("cut.onnx"));
}

#[test]
fn recognise_swapped_decoder_outputs_fails() {
    let decoder = |masks: &str, scores: &str| {
        Onnx::new()
            .input("image_embeddings", FLOAT, "1 256 64 64")
            .input("point_coords", FLOAT, "p 2 2")
            .input("point_labels", FLOAT, "p 2")
            .output("low_res_masks", masks)
            .output("iou_predictions", scores)
            .encode()
    };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("decoder.onnx");
    std::fs::write(&path, decoder("p 4 256 256", "p 4")).unwrap();
    assert_eq!(GraphFile::recognise(&path).unwrap().binding.part, Part::MaskDecoder);
    std::fs::write(&path, decoder("p 4", "p 4 256 256")).unwrap();
    let error = GraphFile::recognise(&path).unwrap_err().to_string();
    assert!(error.contains("low_res_masks [?×4] cannot be masks [P M x y]"), "{error}");
}

#[test]
fn catalogue_is_sound_and_explains_absence() {
    assert!(catalogue().len() >= 12);
    for model in catalogue() {
        assert!(model.source.starts_with("https://") && !model.licence.is_empty(), "{}", model.id);
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(&model.export);
        assert!(model.export.starts_with("https://") || script.is_file(), "{}: {}", model.id, model.export);
        assert_eq!(model.non_commercial, model.licence.contains("NC"), "{}", model.id);
        // The open pack is for commercial use, and complete without work by hand.
        let open = model.packs.contains(&"open".into());
        let fetched = !model.files.is_empty() || model.recipe.is_some();
        assert!(!open || !model.non_commercial && fetched, "{}", model.id);
        sources_are_sound(model);
    }
    for (pack, tasks) in [
        ("paper", &[Task::Geometry, Task::Matcher, Task::Masks, Task::Features][..]),
        ("open", &[Task::Geometry, Task::Masks, Task::Features]),
    ] {
        for task in tasks {
            let of_pack = |k: &&CatalogueEntry| k.task == *task && k.packs.contains(&pack.into());
            assert_eq!(catalogue().iter().filter(of_pack).count(), 1, "{pack} {task:?}");
        }
    }
    assert!(common_packages().iter().any(|p| p.starts_with("torch==")));
    let dir = tempfile::tempdir().unwrap();
    let error = Registry::of(&[dir.path()]).installed(Task::Geometry, "dust3r").unwrap_err();
    let text = error.to_string();
    for part in ["splatvk models fetch dust3r", "NC", "tools/export/export_dust3r.py", "naver/dust3r"] {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert_eq!(error.exit_code(), 3);
    let text = Registry::of(&[dir.path()]).installed(Task::Masks, "sam").unwrap_err().to_string();
    assert!(text.contains("models fetch sam_vit_b"), "of a family the one that needs no export: {text}");
}

/// Addresses are https and lead to files; names cannot leave their folder.
fn sources_are_sound(model: &CatalogueEntry) {
    let weights = model.recipe.iter().flat_map(|r| &r.weights);
    for source in model.files.iter().chain(weights) {
        let name = Path::new(&source.name);
        assert!(source.from.starts_with("https://") && !source.from.ends_with('/'), "{}", source.from);
        assert_eq!(name.file_name(), Some(name.as_os_str()), "{}", source.name);
        let hex = |s: &String| s.len() == 64 && s.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'));
        assert!(source.sha256.as_ref().is_none_or(hex), "{}", source.from);
        // Files at addresses without a revision may change, so they have no checksum.
        let fixed =
            source.from.split('/').any(|part| part.len() == 40) || !source.from.contains("huggingface");
        assert!(fixed || source.sha256.is_none(), "{}", source.from);
    }
    if let Some(recipe) = &model.recipe {
        assert!(model.export.ends_with(&recipe.script), "{}", model.id);
        let mut given = recipe.weights.iter().map(|w| &w.name);
        assert!(given.all(|w| recipe.arguments.contains(w)), "{}: a checkpoint nobody reads", model.id);
    }
}

#[test]
fn inventory_groups_files_by_name() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["sam_vit_b", "sam_vit_h"] {
        Onnx::new()
            .input("image", FLOAT, "1 3 1024 1024")
            .output("image_embeddings", "1 256 64 64")
            .write(&dir.path().join(format!("{name}_encoder.onnx")));
        Onnx::new()
            .input("image_embeddings", FLOAT, "1 256 64 64")
            .input("point_coords", FLOAT, "1 n 2")
            .input("point_labels", FLOAT, "1 n")
            .input("mask_input", FLOAT, "1 1 256 256")
            .input("has_mask_input", FLOAT, "1")
            .input("orig_im_size", FLOAT, "2")
            .output("masks", "…")
            .output("iou_predictions", "1 4")
            .output("low_res_masks", "1 4 256 256")
            .write(&dir.path().join(format!("{name}_decoder.onnx")));
    }
    let registry = Registry::of(&[dir.path()]);
    assert_eq!(registry.installed(Task::Masks, "sam").unwrap().name, "sam_vit_h");
    assert_eq!(registry.installed(Task::Masks, "sam_vit_b").unwrap().name, "sam_vit_b");
    let model = registry.installed(Task::Masks, "sam").unwrap();
    assert_eq!(model.graph(Part::MaskDecoder).unwrap().fixed("points", "P"), Some(1));
}

/// One graph for both views, channels first, raw activations, which the adapter states.
#[test]
fn pair_network_runs_in_both_orders() {
    let (w, h) = (32u64, 16);
    let pixels = (w * h) as usize;
    // ln 3 along z: e^d − 1 = 2. The first image's brightness in x marks the order of the images.
    let raw: Vec<f32> = (0..3 * pixels).map(|k| if k / pixels == 2 { 3f32.ln() } else { 0.0 }).collect();
    let mut graph = Onnx::new().input("img1", FLOAT, "1 3 16 32").input("img2", FLOAT, "1 3 16 32");
    for k in ["1", "2"] {
        graph = graph
            .output(&format!("pts3d_{k}"), "1 3 16 32")
            .output(&format!("conf_{k}"), "1 16 32")
            .weight(&format!("p{k}"), &[1, 3, h, w], &raw)
            .weight(&format!("c{k}"), &[1, h, w], &vec![3f32.ln(); pixels])
            .node("Identity", &format!("c{k}"), &format!("conf_{k}"), &[]);
    }
    let graph = graph
        .weight("tiny", &[1], &[1e-3])
        .node("Mul", "img1 tiny", "mark", &[])
        .node("Add", "p1 mark", "pts3d_1", &[])
        .node("Identity", "p2", "pts3d_2", &[]);
    let dir = tempfile::tempdir().unwrap();
    graph.write(&dir.path().join("dust3r/model.onnx"));
    let registry = Registry::of(&[dir.path()]);
    let grey = |v: f32| RgbImage { width: 64, height: 32, data: vec![[v; 3]; 64 * 32] };
    let photos = [photo("dark", grey(0.5)), photo("light", grey(1.0))];
    let model = registry.installed(Task::Geometry, "dust3r").unwrap();
    // A raw confidence of ln 3 = 1.1 is at least 1 and passes the check.
    let maps = pairs::pointmaps(&model, &photos, &Silent).unwrap();
    assert_eq!((maps.views[0].width, maps.views[0].height, maps.pairs.len()), (32, 16, 1));
    assert!(maps.cameras.is_empty() && maps.confidence_floor == Some(3.0));
    assert!((maps.pairs[0].x11.points[0][2] - 3f32.ln()).abs() < 1e-6);

    let adapter = "family = \"dust3r\"\n[[graph]]\npart = \"pair\"\napply.points = \"expm1-norm\"\napply.conf = \"one-plus-exp\"";
    std::fs::write(dir.path().join("dust3r/adapter.toml"), adapter).unwrap();
    let model = registry.installed(Task::Geometry, "dust3r").unwrap();
    let maps = pairs::pointmaps(&model, &photos, &Silent).unwrap();
    let pair = &maps.pairs[0];
    assert!((pair.x21.points[7][2] - 2.0).abs() < 1e-5 && (pair.x12.points[7][2] - 2.0).abs() < 1e-5);
    assert!((pair.x11.confidence[0] - 4.0).abs() < 1e-5);
    // (1 − 0.5) / 0.5 = 1 for the light photo, 0 for the dark one.
    assert!(pair.x11.points[0][0].abs() < 1e-6 && pair.x22.points[0][0] > 1e-3, "{:?}", pair.x22.points[0]);
}

/// MASt3R as a matcher: pixels of one colour have one descriptor, and every colour occurs once in
/// each photo.
#[test]
fn pair_network_descriptors_match_photos() {
    let (w, h) = (32u64, 16);
    let pixels = (w * h) as usize;
    let mut graph = Onnx::new().input("img1", FLOAT, "1 3 16 32").input("img2", FLOAT, "1 3 16 32");
    for k in ["1", "2"] {
        graph = graph
            .output(&format!("pts3d_{k}"), "1 16 32 3")
            .output(&format!("conf_{k}"), "1 16 32")
            .output(&format!("desc_{k}"), "1 3 16 32")
            .weight(&format!("p{k}"), &[1, h, w, 3], &vec![1.0; 3 * pixels])
            .weight(&format!("c{k}"), &[1, h, w], &vec![2.0; pixels])
            .node("Identity", &format!("p{k}"), &format!("pts3d_{k}"), &[])
            .node("Identity", &format!("c{k}"), &format!("conf_{k}"), &[])
            .node("Identity", &format!("img{k}"), &format!("desc_{k}"), &[]);
    }
    let dir = tempfile::tempdir().unwrap();
    graph.write(&dir.path().join("mast3r/model.onnx"));
    let registry = Registry::of(&[dir.path()]);
    let model = registry.installed(Task::Matcher, "mast3r").unwrap();
    assert_eq!(model.tasks, [Task::Geometry, Task::Depth, Task::Matcher]);
    // Each pixel has its own direction on a cone, close to that of its neighbours. The second photo
    // is the first moved by eight pixels.
    let colours = |shift: usize| {
        let colour = |x: usize, y: usize| {
            let (sin, cos) = (0.1 * x as f32).sin_cos();
            let r = 0.2 + 0.01 * y as f32;
            [0.5 + r * cos, 0.5 + r * sin, 0.95]
        };
        let data = (0..pixels).map(|p| colour(p % 32 + shift, p / 32)).collect();
        RgbImage { width: 32, height: 16, data }
    };
    let found = warp::warps(&model, &[photo("a", colours(0)), photo("b", colours(8))], &Silent).unwrap();
    let (there, back) = &found[0];
    for (x, y) in [(12, 6), (20, 10), (27, 5)] {
        let [u, v] = there.target.data[y * 32 + x];
        let (wanted, row) = (x as f32 + 0.5 - 8.0, y as f32 + 0.5);
        assert!((u - wanted).abs() < 0.6 && (v - row).abs() < 0.6, "{x} {y}: {u} {v}");
    }
    let [u, _] = back.target.data[8 * 32 + 10];
    assert!((u - 18.5).abs() < 0.6, "{u}");
}

/// A matcher that moves everything a quarter of the width to the right, with a certainty logit of
/// 2.
#[test]
fn warps_use_photo_pixels() {
    let mut flow = Vec::new();
    for y in 0..8 {
        for x in 0..8 {
            flow.extend([(2.0 * (x as f32 + 0.5) / 8.0 - 1.0) + 0.5, 2.0 * (y as f32 + 0.5) / 8.0 - 1.0]);
        }
    }
    let graph = |certainty: &str| {
        Onnx::new()
            .input("im_A", FLOAT, "1 3 56 56")
            .input("im_B", FLOAT, "1 3 56 56")
            .output("warp_AB", "1 8 8 2")
            .output(certainty, "1 1 8 8")
            .weight("f", &[1, 8, 8, 2], &flow)
            .weight("c", &[1, 1, 8, 8], &[2.0; 64])
            .node("Identity", "f", "warp_AB", &[])
            .node("Identity", "c", certainty, &[])
    };
    let dir = tempfile::tempdir().unwrap();
    graph("certainty").write(&dir.path().join("roma/warp.onnx"));
    let registry = Registry::of(&[dir.path()]);
    let model = registry.installed(Task::Matcher, "roma").unwrap();
    let grey = |w: usize, h: usize| RgbImage { width: w, height: h, data: vec![[0.5; 3]; w * h] };
    let photos = [photo("a", grey(80, 40)), photo("b", grey(160, 100))];
    let found = warp::warps(&model, &photos, &Silent).unwrap();
    let there = &found[0].0;
    let p = 10 * 80 + 30;
    let [u, v] = there.target.data[p];
    // (30.5 / 80 + 1/4) · 160 and (10.5 / 40) · 100.
    assert!((u - 101.0).abs() < 1e-3 && (v - 26.25).abs() < 1e-3, "{u} {v}");
    assert!((there.certainty.data[p] - 1.0 / (1.0 + (-2f32).exp())).abs() < 1e-6);
    assert_eq!(there.certainty.data[10 * 80 + 78], 0.0, "what leaves the photo has no match");
    // Without the adapter's sigmoid a logit is refused.
    let raw = "family = \"other\"\n[[graph]]\npart = \"warp\"\nnames = { image1 = \"im_A\", image2 = \"im_B\", warp12 = \
               \"warp_AB\", certainty12 = \"certainty\" }\nimage = { mean = [0.0, 0.0, 0.0], std = [1.0, 1.0, 1.0], size = 56, \
               fit = \"squash\" }";
    std::fs::write(dir.path().join("roma/adapter.toml"), raw).unwrap();
    let error =
        warp::warps(&registry.installed(Task::Matcher, "roma").unwrap(), &photos, &Silent).unwrap_err();
    assert!(error.to_string().contains("apply.certainty"), "{error}");
}
