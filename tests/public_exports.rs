//! Runs the built-in adapters with small graphs that have the interfaces of public exports. Each
//! graph goes through the whole code path of its task, and its outputs reveal its inputs.
#![allow(clippy::unwrap_used)] // a panic is how a test fails
use std::path::Path;

use splatvk::infer::clip::Clip;
use splatvk::infer::installed::Task;
use splatvk::infer::sam::Sam;
use splatvk::infer::{RegionEncoder, Registry, pairs, warp};
use splatvk::pose::pointmap;
use splatvk::progress::Silent;
use splatvk::scene::{Camera, Image, Pose, RgbImage};
use splatvk_test_support::breakfast;
use splatvk_test_support::onnx::{Attribute, FLOAT, INT64, Onnx};
use splatvk_test_support::toys::{clip_in, photo};

fn flat_photo(width: usize, height: usize, colour: [f32; 3]) -> RgbImage {
    RgbImage { width, height, data: vec![colour; width * height] }
}

const AVERAGE: &str = "AveragePool";

fn pool(side: i64) -> [(&'static str, Attribute<'static>); 2] {
    let by: &'static [i64] = match side {
        4 => &[4, 4],
        8 => &[8, 8],
        _ => &[16, 16],
    };
    [("kernel_shape", Attribute::Ints(by)), ("strides", Attribute::Ints(by))]
}

/// Adds output `masks`: the x of each prompt, plus the number in `also`, plus 0, 100, 200… for the
/// masks of a prompt. `shape` is the shape of the 8 × 8 masks of one prompt; x is the first entry
/// of the last axis of the prompts.
fn with_masks(graph: Onnx, points: &str, axis: i64, shape: &[u64], also: &str, masks: &str) -> Onnx {
    let count = shape[shape.len() - 3];
    let place: Vec<f32> = (0..64 * count).map(|k| 100.0 * (k / 64) as f32).collect();
    let mut column: Vec<i64> = vec![1; shape.len()];
    column[shape.len() - 4] = -1;
    graph
        .integers("from", &[0])
        .integers("until", &[1])
        .integers("axes", &[axis])
        .integers("column", &column)
        .weight("place", shape, &place)
        .node("Slice", &format!("{points} from until axes"), "coordinate", &[])
        .node("Reshape", "coordinate column", "x", &[])
        .node("Add", &format!("x {also}"), "sum", &[])
        .node("Add", "sum place", masks, &[])
}

/// Adds output `scores`: `values` for each prompt.
fn with_scores(graph: Onnx, shape: &[u64], row: &[i64], values: &[f32], scores: &str) -> Onnx {
    graph
        .weight("values", shape, values)
        .weight("zero", &[1], &[0.0])
        .integers("row", row)
        .node("Reshape", "x row", "rows", &[])
        .node("Mul", "rows zero", "nothing", &[])
        .node("Add", "nothing values", scores, &[])
}

/// Prompts a model with two pixels of a photo of 32 × 16; returns the first logit of each mask, and
/// the scores.
fn decode_prompts(folder: &Path, name: &str) -> (Vec<f32>, Vec<f32>) {
    let model = Registry::of(&[folder]).installed(Task::Masks, name).unwrap();
    let mut sam = Sam::load(&model).unwrap();
    let encoded = sam.encode(&flat_photo(32, 16, [0.485, 0.456, 0.406])).unwrap();
    let found = sam.decode(&encoded, &[[8.0, 4.0], [24.0, 4.0]]).unwrap();
    assert_eq!((found.width, found.height, found.logits.len()), (8, 8, 2 * 3 * 64));
    (found.logits.iter().step_by(64).copied().collect(), found.scores)
}

fn assert_near(given: &[f32], wanted: &[f32]) {
    let close = given.len() == wanted.len() && given.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-3);
    assert!(close, "{given:?}, wanted {wanted:?}");
}

#[test]
fn sam2_passes_fine_features() {
    let dir = tempfile::tempdir().unwrap();
    Onnx::new()
        .input("image", FLOAT, "1 3 64 64")
        .output("image_embed", "1 3 4 4")
        .output("high_res_feats_0", "1 3 16 16")
        .output("high_res_feats_1", "1 3 8 8")
        .weight("seven", &[1], &[7.0])
        .node(AVERAGE, "image", "image_embed", &pool(16))
        .node(AVERAGE, "image", "fine", &pool(4))
        .node("Add", "fine seven", "high_res_feats_0", &[])
        .node(AVERAGE, "image", "high_res_feats_1", &pool(8))
        .write(&dir.path().join("sam2/encoder.onnx"));
    let decoder = Onnx::new()
        .input("image_embed", FLOAT, "1 3 4 4")
        .input("high_res_feats_0", FLOAT, "1 3 16 16")
        .input("high_res_feats_1", FLOAT, "1 3 8 8")
        .input("point_coords", FLOAT, "labels 1 2")
        .input("point_labels", FLOAT, "labels 1")
        .input("mask_input", FLOAT, "labels 1 16 16")
        .input("has_mask_input", FLOAT, "labels")
        .output("masks", "labels 4 8 8")
        .output("iou_predictions", "labels 4")
        .node("ReduceMean", "high_res_feats_0", "mean", &[("keepdims", Attribute::Int(1))]);
    let decoder = with_masks(decoder, "point_coords", 2, &[1, 4, 8, 8], "mean", "masks");
    with_scores(decoder, &[1, 4], &[-1, 1], &[0.1, 0.2, 0.3, 0.4], "iou_predictions")
        .write(&dir.path().join("sam2/decoder.onnx"));
    let (logits, scores) = decode_prompts(dir.path(), "sam2");
    // Columns 8 and 24 of 32 are 16 and 48 of 64; a photo of the mean colour leaves 7 in the fine
    // features.
    assert_near(&logits, &[123.0, 223.0, 323.0, 155.0, 255.0, 355.0]);
    assert_near(&scores, &[0.2, 0.3, 0.4, 0.2, 0.3, 0.4]);

    // A graph that leaves the padding point to its caller needs two points.
    let adapter = "family = \"sam2\"\n[[graph]]\npart = \"mask-decoder\"\npads = false\n";
    std::fs::write(dir.path().join("sam2/adapter.toml"), adapter).unwrap();
    let mut sam = Sam::load(&Registry::of(&[dir.path()]).installed(Task::Masks, "sam2").unwrap()).unwrap();
    let encoded = sam.encode(&flat_photo(32, 16, [0.5; 3])).unwrap();
    let error = sam.decode(&encoded, &[[8.0, 4.0]]).err().unwrap().to_string();
    assert!(error.contains("point_") && error.contains("Expected: 1"), "{error}");
}

/// The interface of onnx-community's SAM 2.1: three feature maps, points in batches, and boxes, of
/// which there are none.
#[test]
fn sam2_reads_hugging_face_layout() {
    let dir = tempfile::tempdir().unwrap();
    Onnx::new()
        .input("pixel_values", FLOAT, "batch 3 64 64")
        .output("image_embeddings.0", "batch 3 16 16")
        .output("image_embeddings.1", "batch 3 8 8")
        .output("image_embeddings.2", "batch 3 4 4")
        .weight("seven", &[1], &[7.0])
        .node(AVERAGE, "pixel_values", "fine", &pool(4))
        .node("Add", "fine seven", "image_embeddings.0", &[])
        .node(AVERAGE, "pixel_values", "image_embeddings.1", &pool(8))
        .node(AVERAGE, "pixel_values", "image_embeddings.2", &pool(16))
        .write(&dir.path().join("sam2_hf/vision_encoder.onnx"));
    let decoder = Onnx::new()
        .input("input_points", FLOAT, "batch prompts points 2")
        .input("input_labels", INT64, "batch prompts points")
        .input("input_boxes", FLOAT, "batch boxes 4")
        .input("image_embeddings.0", FLOAT, "batch 3 16 16")
        .input("image_embeddings.1", FLOAT, "batch 3 8 8")
        .input("image_embeddings.2", FLOAT, "batch 3 4 4")
        .output("iou_scores", "batch prompts 3")
        .output("pred_masks", "batch prompts 3 8 8")
        .integers("one", &[1, 1, 1, 1, 1])
        .integers("first", &[0])
        .integers("second", &[1])
        .integers("points", &[2])
        // Behind each point is a padding point.
        .node("Slice", "input_points first second points", "prompts", &[])
        // The sum over no boxes is zero.
        .node("ReduceSum", "input_boxes", "boxes", &[("keepdims", Attribute::Int(0))])
        .node("ReduceMean", "image_embeddings.0", "mean", &[("keepdims", Attribute::Int(0))])
        .node("Add", "mean boxes", "also", &[])
        .node("Reshape", "also one", "position", &[]);
    let decoder = with_masks(decoder, "prompts", 3, &[1, 1, 3, 8, 8], "position", "pred_masks");
    with_scores(decoder, &[1, 1, 3], &[1, -1, 1], &[0.2, 0.3, 0.4], "iou_scores")
        .write(&dir.path().join("sam2_hf/prompt_encoder_mask_decoder.onnx"));
    let (logits, scores) = decode_prompts(dir.path(), "sam2");
    // Columns 8 and 24 of 32 are 16 and 48 of 64.
    assert_near(&logits, &[23.0, 123.0, 223.0, 55.0, 155.0, 255.0]);
    assert_near(&scores, &[0.2, 0.3, 0.4, 0.2, 0.3, 0.4]);
}

#[test]
fn sam_reads_hugging_face_layout() {
    let dir = tempfile::tempdir().unwrap();
    Onnx::new()
        .input("pixel_values", FLOAT, "batch 3 64 64")
        .output("image_embeddings", "batch 3 4 4")
        .output("image_positional_embeddings", "batch 3 4 4")
        .weight("five", &[1], &[5.0])
        .node(AVERAGE, "pixel_values", "image_embeddings", &pool(16))
        .node("Add", "image_embeddings five", "image_positional_embeddings", &[])
        .write(&dir.path().join("sam_hf/vision_encoder.onnx"));
    let decoder = Onnx::new()
        .input("input_points", FLOAT, "batch prompts points 2")
        .input("input_labels", INT64, "batch prompts points")
        .input("image_embeddings", FLOAT, "batch 3 4 4")
        .input("image_positional_embeddings", FLOAT, "batch 3 4 4")
        .output("iou_scores", "batch prompts 3")
        .output("pred_masks", "batch prompts 3 8 8")
        .integers("corner", &[0, 0, 0, 0])
        .integers("next", &[1, 1, 1, 1])
        .integers("one", &[1, 1, 1, 1, 1])
        .node("Slice", "image_positional_embeddings corner next", "first", &[])
        .node("Reshape", "first one", "position", &[]);
    let decoder = with_masks(decoder, "input_points", 3, &[1, 1, 3, 8, 8], "position", "pred_masks");
    with_scores(decoder, &[1, 1, 3], &[1, -1, 1], &[0.2, 0.3, 0.4], "iou_scores")
        .write(&dir.path().join("sam_hf/prompt_encoder_mask_decoder.onnx"));
    let (logits, scores) = decode_prompts(dir.path(), "sam");
    // The photo fills the upper half, at a scale of 2 in both directions.
    assert_near(&logits, &[21.0, 121.0, 221.0, 53.0, 153.0, 253.0]);
    assert_near(&scores, &[0.2, 0.3, 0.4, 0.2, 0.3, 0.4]);
}

#[test]
fn sam_reads_official_layout() {
    let dir = tempfile::tempdir().unwrap();
    Onnx::new()
        .input("input_image", FLOAT, "height width 3")
        .output("image_embeddings", "1 1 1 1")
        .integers("shape", &[1, 1, 1, 1])
        .node("ReduceMax", "input_image", "brightest", &[("keepdims", Attribute::Int(1))])
        .node("Reshape", "brightest shape", "image_embeddings", &[])
        .write(&dir.path().join("sam/encoder.onnx"));
    let decoder = Onnx::new()
        .input("image_embeddings", FLOAT, "1 1 1 1")
        .input("point_coords", FLOAT, "1 points 2")
        .input("point_labels", FLOAT, "1 points")
        .input("mask_input", FLOAT, "1 1 8 8")
        .input("has_mask_input", FLOAT, "1")
        .input("orig_im_size", FLOAT, "2")
        .output("masks", "…")
        .output("iou_predictions", "1 4")
        .output("low_res_masks", "1 4 8 8")
        .integers("p0", &[0])
        .integers("p1", &[1])
        .integers("second", &[1])
        .node("Slice", "point_coords p0 p1 second", "lone", &[])
        .node("Identity", "low_res_masks", "masks", &[]);
    let decoder = with_masks(decoder, "lone", 2, &[1, 4, 8, 8], "image_embeddings", "low_res_masks");
    with_scores(decoder, &[1, 4], &[-1, 1], &[0.1, 0.2, 0.3, 0.4], "iou_predictions")
        .write(&dir.path().join("sam/decoder.onnx"));
    let (logits, _) = decode_prompts(dir.path(), "sam");
    // The longer side becomes 1024: columns 256 and 768. 0.485 of 255 is 123.7.
    assert_near(&logits, &[479.675, 579.675, 679.675, 991.675, 1091.675, 1191.675]);
}

#[test]
fn lseg_averages_features_over_regions() {
    let dir = tempfile::tempdir().unwrap();
    clip_in(dir.path(), [0, 1, 2]);
    let (from, to) = (dir.path().join("clip_toy"), dir.path().join("lseg"));
    std::fs::rename(&from, &to).unwrap();
    std::fs::remove_file(to.join("vision_model.onnx")).unwrap();
    // Every second pixel, channels first.
    Onnx::new()
        .input("image", FLOAT, "1 3 32 32")
        .output("features", "1 3 16 16")
        .node(
            AVERAGE,
            "image",
            "features",
            &[("kernel_shape", Attribute::Ints(&[2, 2])), ("strides", Attribute::Ints(&[2, 2]))],
        )
        .write(&to.join("lseg.onnx"));
    let mut lseg =
        Clip::load(Registry::of(&[dir.path()]).installed(Task::Features, "lseg").unwrap()).unwrap();
    let (mut image, mut labels) = (flat_photo(32, 32, [0.5, 0.5, 1.0]), Image::filled(32, 32, 1));
    for y in 0..32 {
        for x in 0..16 {
            // Half red, half green: their sum is the direction of the region.
            image.data[32 * y + x] = if y < 16 { [1.0, 0.5, 0.5] } else { [0.5, 1.0, 0.5] };
            labels.data[32 * y + x] = 0;
        }
    }
    let rows = lseg.embed_regions(&image, &labels, 2, &Silent).unwrap();
    let half = 0.5f32.sqrt();
    assert_near(&rows, &[half, half, 0.0, 0.0, 0.0, 1.0]);
    let blue = lseg.embed_texts(&["blue"]).unwrap();
    assert!(blue[2] > 0.99, "{blue:?}");
}

#[test]
fn roma2_returns_both_directions() {
    let dir = tempfile::tempdir().unwrap();
    Onnx::new()
        .input("img_A", FLOAT, "batch 3 64 64")
        .input("img_B", FLOAT, "batch 3 64 64")
        .output("warp_AB", "batch 8 8 2")
        .output("warp_BA", "batch 8 8 2")
        .output("overlap_AB", "batch 8 8 1")
        .output("overlap_BA", "batch 8 8 1")
        .output("precision_AB", "batch 8 8 2 2")
        .weight("there", &[1, 8, 8, 2], &warp_field(0.5))
        .weight("back", &[1, 8, 8, 2], &warp_field(-0.5))
        // The mean of a white photo reveals the value range of the input: [0, 1].
        .node("ReduceMean", "img_A", "white", &[("keepdims", Attribute::Int(1))])
        .weight("sure", &[1, 8, 8, 1], &[0.75; 64])
        .weight("unsure", &[1, 8, 8, 1], &[0.25; 64])
        .weight("precision", &[1, 8, 8, 2, 2], &[1.0; 256])
        .node("Identity", "there", "warp_AB", &[])
        .node("Identity", "back", "warp_BA", &[])
        .node("Mul", "sure white", "overlap_AB", &[])
        .node("Mul", "unsure white", "overlap_BA", &[])
        .node("Identity", "precision", "precision_AB", &[])
        .write(&dir.path().join("romav2/warp.onnx"));
    let model = Registry::of(&[dir.path()]).installed(Task::Matcher, "romav2").unwrap();
    let photos = [photo("a", flat_photo(80, 40, [1.0; 3])), photo("b", flat_photo(160, 100, [0.5; 3]))];
    let (there, back) = &warp::warps(&model, &photos, &Silent).unwrap()[0];
    // A quarter of the width to the right, and back.
    let ([u, v], [s, t]) = (there.target.data[10 * 80 + 30], back.target.data[50 * 160 + 120]);
    assert_near(&[u, v, s, t], &[101.0, 26.25, 40.25, 20.2]);
    assert_near(&[there.certainty.data[10 * 80 + 30], back.certainty.data[50 * 160 + 120]], &[0.75, 0.25]);
}

/// Pixel centres in [−1, 1] of a grid of 8 × 8, shifted to the right.
fn warp_field(shift: f32) -> Vec<f32> {
    let place = |k: usize| (2.0 * (k as f32 + 0.5) / 8.0) - 1.0;
    (0..64).flat_map(|k| [place(k % 8) + shift, place(k / 8)]).collect()
}

/// Graphs that return the true depth and cameras of the breakfast views, in the formats of VGGT and
/// of Depth Anything 3.
#[test]
fn true_pointmaps_give_true_cameras() {
    let views = breakfast::train_views();
    let n = views.len();
    let (w, h) = (112usize, 84);
    let (mut depth, mut codes, mut matrices, mut intrinsics) = (vec![], vec![], vec![], vec![]);
    for v in &views {
        let relative = v.camera.pose.compose(&views[0].camera.pose.inverse());
        let q = glam::DQuat::from_mat3(&relative.rotation);
        let field = |pixels: f64, focal: f64| 2.0 * (0.5 * pixels / focal).atan();
        codes.extend(relative.translation.to_array());
        codes.extend([q.x, q.y, q.z, q.w, field(480.0, v.camera.fy), field(640.0, v.camera.fx)]);
        for row in 0..3 {
            matrices.extend(relative.rotation.row(row).to_array());
            matrices.push(relative.translation[row]);
        }
        let scale = w as f64 / 640.0;
        intrinsics.extend([v.camera.fx * scale, 0.0, v.camera.cx * scale, 0.0, v.camera.fy * scale]);
        intrinsics.extend([v.camera.cy * scale, 0.0, 0.0, 1.0]);
        for p in 0..w * h {
            let (x, y) = ((p % w) as f64 + 0.5, (p / w) as f64 + 0.5);
            depth.push(v.depth.at((x / scale) as usize, (y / scale) as usize));
        }
    }
    let sure: Vec<f32> = depth.iter().map(|z| if *z > 0.0 { 5.0 } else { 1.0 }).collect();
    let narrow = |values: &[f64]| values.iter().map(|v| *v as f32).collect::<Vec<f32>>();
    let dir = tempfile::tempdir().unwrap();
    let graph = Onnx::new().input("images", FLOAT, &format!("1 {n} 3 {h} {w}"));
    let graph = constant_output(graph, "depth", &format!("1 {n} {h} {w} 1"), &depth);
    let graph = constant_output(graph, "depth_conf", &format!("1 {n} {h} {w}"), &sure);
    constant_output(graph, "pose_enc", &format!("1 {n} 9"), &narrow(&codes))
        .write(&dir.path().join("vggt/model.onnx"));
    let matrix_form = |folder: &str, intrinsics: &[f64]| {
        let graph = Onnx::new().input("image", FLOAT, &format!("1 {n} 3 {h} {w}"));
        let graph = constant_output(graph, "depth", &format!("1 {n} {h} {w}"), &depth);
        let graph = constant_output(graph, "depth_conf", &format!("1 {n} {h} {w}"), &sure);
        let graph = constant_output(graph, "extrinsics", &format!("1 {n} 3 4"), &narrow(&matrices));
        let graph = constant_output(graph, "intrinsics", &format!("1 {n} 3 3"), &narrow(intrinsics));
        graph.write(&dir.path().join(folder).join("model.onnx"));
    };
    matrix_form("da3", &intrinsics);
    // The same cameras with pixel coordinates that count from pixel centres.
    let shifted = |(k, v): (usize, &f64)| if [2, 5].contains(&(k % 9)) { v - 0.5 } else { *v };
    matrix_form("da3_from_centres", &intrinsics.iter().enumerate().map(shifted).collect::<Vec<_>>());
    let adapter = "family = \"da3\"\n[[graph]]\npart = \"multi-view\"\npixel_centre = 0.0\n";
    std::fs::write(dir.path().join("da3_from_centres/adapter.toml"), adapter).unwrap();

    let photos: Vec<_> =
        views.iter().enumerate().map(|(k, v)| photo(&format!("view{k}"), v.image.clone())).collect();
    for name in ["vggt", "da3", "da3_from_centres"] {
        let model = Registry::of(&[dir.path()]).installed(Task::Geometry, name).unwrap();
        let maps = pairs::pointmaps(&model, &photos, &Silent).unwrap();
        assert_eq!(maps.confidence_floor, (name != "vggt").then_some(1.05));
        for (pair, k) in maps.pairs.iter().flat_map(|p| [(&p.x11, p.first), (&p.x22, p.second)]) {
            let camera = Camera { pose: Pose::IDENTITY, ..views[k].camera.resized(w as u32, h as u32) };
            for (p, x) in pair.points.iter().enumerate().step_by(97) {
                let centre = glam::DVec2::new((p % w) as f64 + 0.5, (p / w) as f64 + 0.5);
                let truth = camera.unproject(centre, f64::from(depth[k * w * h + p]));
                // Half a pixel would be 0.5 % of the depth.
                let off = (glam::Vec3::from(*x).as_dvec3() - truth).length();
                assert!(off < 1e-4 * truth.z.max(1.0), "{name} {k} {p}: {off}");
            }
        }
        let geometry = pointmap::reconstruct(maps, 0, &Silent).unwrap().geometry;
        assert_eq!(geometry.method, "pointmaps, started from the network's own cameras", "{name}");
        for (k, (camera, v)) in geometry.cameras.iter().zip(&views).enumerate() {
            let truth = v.camera.pose.compose(&views[0].camera.pose.inverse());
            let turned = (camera.pose.rotation * truth.rotation.transpose()).transpose();
            let angle =
                ((turned.x_axis.x + turned.y_axis.y + turned.z_axis.z - 1.0) / 2.0).clamp(-1.0, 1.0).acos();
            // Depth is sampled at one of 33 pixels, at the nearest pixel: measured below 0.1° and
            // 0.3 %.
            assert!(angle.to_degrees() < 0.3, "{name} {k}: {}°", angle.to_degrees());
            assert!(
                (camera.fx / v.camera.fx - 1.0).abs() < 0.01,
                "{name} {k}: {} {}",
                camera.fx,
                v.camera.fx
            );
        }
        let few = pairs::pointmaps(&model, &photos[..2], &Silent).unwrap_err().to_string();
        assert!(few.contains(&format!("exported for {n} photos, here are 2")), "{few}");
    }
}

/// Adds an output with constant values.
fn constant_output(graph: Onnx, name: &str, shape: &str, values: &[f32]) -> Onnx {
    let dims: Vec<u64> = shape.split(' ').map(|d| d.parse().unwrap()).collect();
    let kept = format!("the {name}").replace(' ', "_");
    graph.output(name, shape).weight(&kept, &dims, values).node("Identity", &kept, name, &[])
}
