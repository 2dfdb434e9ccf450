//! Tests with a decoder whose masks are known exactly: discs around the prompt point.
use super::*;
use crate::progress::Silent;
use splatvk_infer::Registry;
use splatvk_infer::installed::Task;
use splatvk_infer::sam::Proposals;
use splatvk_test_support::onnx::{Attribute, FLOAT, Onnx};
use std::path::Path;

const LOW: usize = 64;
/// Radii of the single best mask and of the three levels, pixels of the 256-pixel input.
const RADII: [f32; 4] = [1.0, 25.0, 30.0, 60.0];

/// Logits (radius² − distance²) / 40 around the point: stability follows from the radius, the
/// predicted IoU is given.
fn disc_network(folder: &Path, iou: [f32; 4]) {
    Onnx::new()
        .input("image", FLOAT, "1 3 256 256")
        .output("image_embeddings", "1 3 8 8")
        .node(
            "AveragePool",
            "image",
            "image_embeddings",
            &[("kernel_shape", Attribute::Ints(&[32, 32])), ("strides", Attribute::Ints(&[32, 32]))],
        )
        .write(&folder.join("sam_toy/encoder.onnx"));
    let centre: Vec<f32> = (0..LOW).map(|k| (k as f32 + 0.5) * 256.0 / LOW as f32).collect();
    let squares: Vec<f32> = RADII.iter().map(|r| r * r / 40.0).collect();
    let n = LOW as u64;
    let mut graph = Onnx::new()
        .input("image_embeddings", FLOAT, "1 3 8 8")
        .input("point_coords", FLOAT, "prompts 2 2")
        .input("point_labels", FLOAT, "prompts 2")
        .output("low_res_masks", "prompts 4 64 64")
        .output("iou_predictions", "prompts 4")
        .weight("x", &[1, 1, 1, n], &centre)
        .weight("y", &[1, 1, n, 1], &centre)
        .weight("r", &[1, 4, 1, 1], &squares)
        .weight("scale", &[1], &[1.0 / 40.0])
        .weight("iou", &[1, 4], &iou)
        .weight("zero", &[1], &[0.0])
        .integers("to", &[-1, 1, 1, 1])
        .integers("flat", &[-1, 1])
        .integers("axes", &[1, 2]);
    for (k, name) in ["x", "y"].into_iter().enumerate() {
        let k = k as i64;
        graph = graph
            .integers(&format!("from_{name}"), &[0, k])
            .integers(&format!("until_{name}"), &[1, k + 1])
            .node("Slice", &format!("point_coords from_{name} until_{name} axes"), &format!("s{name}"), &[])
            .node("Reshape", &format!("s{name} to"), &format!("p{name}"), &[])
            .node("Sub", &format!("{name} p{name}"), &format!("d{name}"), &[])
            .node("Mul", &format!("d{name} d{name}"), &format!("q{name}"), &[]);
    }
    graph
        .node("Add", "qx qy", "d2", &[])
        .node("Mul", "d2 scale", "scaled", &[])
        .node("Sub", "r scaled", "low_res_masks", &[])
        .node("Reshape", "sx flat", "column", &[])
        .node("Mul", "column zero", "nothing", &[])
        .node("Add", "nothing iou", "iou_predictions", &[])
        .write(&folder.join("sam_toy/decoder.onnx"));
}

fn toy(iou: [f32; 4], options: &SamOptions, size: (usize, usize)) -> ViewMasks {
    let dir = tempfile::tempdir().unwrap();
    disc_network(dir.path(), iou);
    let model = Registry::of(&[dir.path()]).installed(Task::Masks, "sam").unwrap();
    let image = RgbImage { width: size.0, height: size.1, data: vec![[0.5; 3]; size.0 * size.1] };
    masks(&model, &[image], options, &Silent).unwrap().remove(0)
}

#[test]
fn masks_levels_contain_their_discs() {
    let options = SamOptions { points: 3, crops: false, ..SamOptions::default() };
    let view = toy([0.99, 0.9, 0.9, 0.9], &options, (256, 192));
    // A 3 × 3 grid on 256 × 192: 85 × 64 apart. Discs of radius 25 and 30 do not touch; those of 60
    // overlap, with a box IoU of 0.36 at most.
    let level = |k: usize| &view.levels[k];
    assert_eq!([0, 1, 2].map(|k| level(k).quality.len()), [9, 9, 9]);
    for k in 0..9 {
        // π r², to the coarse grid's error: interpolation lowers the logits by up to 0.2, that is
        // r² by 8 of 625.
        let area = level(0).labels.data.iter().filter(|l| **l == k).count() as f64;
        assert!((area / (std::f64::consts::PI * 625.0) - 1.0).abs() < 0.03, "{k}: {area}");
        // Point k of the grid lies in disc k.
        let (x, y) = (42 + 85 * (k as usize % 3), 32 + 64 * (k as usize / 3));
        assert_eq!(level(0).labels.at(x, y), k);
    }
    // Stability of radius r: (r² − 40) / (r² + 40); the quality is that times the predicted IoU.
    let want = |r: f32| 0.9 * (r * r - 40.0) / (r * r + 40.0);
    for (k, r) in [(0, 25.0), (1, 30.0), (2, 60.0)] {
        assert!((level(k).quality[4] - want(r)).abs() < 0.01, "{k}: {} {}", level(k).quality[4], want(r));
    }
}

#[test]
fn masks_drop_poor_and_unstable_proposals() {
    let options = SamOptions { points: 3, crops: false, ..SamOptions::default() };
    let poor = toy([0.99, 0.9, 0.65, 0.9], &options, (256, 192));
    assert_eq!(poor.levels[1].quality.len(), 0, "predicted IoU of 0.65");
    let strict = SamOptions { min_stability: 0.95, ..options };
    assert_eq!(toy([0.99, 0.9, 0.9, 0.9], &strict, (256, 192)).levels[1].quality.len(), 0);
    let crops = SamOptions { crops: true, ..options };
    let fine = toy([0.99, 0.9, 0.9, 0.9], &crops, (256, 192));
    assert!(fine.levels[1].quality.len() > 9, "{}", fine.levels[1].quality.len());
}

#[test]
fn sam_single_mask_decoder_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    disc_network(dir.path(), [0.9; 4]);
    Onnx::new()
        .input("image_embeddings", FLOAT, "1 3 8 8")
        .input("point_coords", FLOAT, "1 n 2")
        .input("point_labels", FLOAT, "1 n")
        .output("low_res_masks", "1 1 64 64")
        .output("iou_predictions", "1 1")
        .write(&dir.path().join("sam_toy/decoder.onnx"));
    let model = Registry::of(&[dir.path()]).installed(Task::Masks, "sam").unwrap();
    let error = Sam::load(&model).err().unwrap().to_string();
    assert!(error.contains("--return-single-mask"), "{error}");
}

#[test]
fn crops_match_reference() {
    // segment_anything.utils.amg.generate_crop_boxes((480, 640), 1, 512 / 1500), XYXY.
    let boxes: Vec<[usize; 4]> = crops(640, 480, true).iter().map(|c| [c.x0, c.y0, c.x1, c.y1]).collect();
    assert_eq!(boxes, REFERENCE);
    assert_eq!(
        grid(2, Crop { x0: 5, y0: 5, x1: 15, y1: 25 }),
        [[2.5, 5.0], [7.5, 5.0], [2.5, 15.0], [7.5, 15.0]]
    );
}

const REFERENCE: [[usize; 4]; 5] =
    [[0, 0, 640, 480], [0, 0, 402, 322], [0, 159, 402, 480], [239, 0, 640, 322], [239, 159, 640, 480]];

#[test]
fn candidates_include_crop_offset() {
    // Logits of ten pixels each in a crop of 140 × 110; the mask is columns 5 to 8 and rows 4 to 7
    // of them.
    let (width, height) = (14, 11);
    let inside = |k: usize| (5..9).contains(&(k % width)) && (4..8).contains(&(k / width));
    let logits = (0..MASKS * width * height).map(|k| if inside(k) { 10.0 } else { -10.0 }).collect();
    let proposals = Proposals { logits, scores: vec![0.9, 0.0, 0.0], width, height, filled: [1.0; 2] };
    let crop = Crop { x0: 60, y0: 50, x1: 200, y1: 160 };
    let found = filter::candidates(&proposals, &[[0.0; 2]], crop, 4, (200, 160), (0.5, 0.5));
    let mask = Bits::from_runs(200, 160, &found[0].runs);
    assert_eq!((found.len(), mask.bounds), (1, (110..150, 90..130)));
}

fn rectangle(x: std::ops::Range<usize>, y: std::ops::Range<usize>, iou: f32) -> Mask {
    let bits = Bits::from_fn(50, 40, |p| x.contains(&(p % 50)) && y.contains(&(p / 50)));
    Mask { bits, iou, stability: 1.0, crop: 0, changed: false }
}

fn seeded() -> Vec<Mask> {
    let mut state = 7u64;
    let mut next = |n: usize| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as usize % n
    };
    (0..60)
        .map(|_| {
            let (x, y, w, h) = (next(40), next(30), 1 + next(25), 1 + next(20));
            rectangle(x..(x + w).min(50), y..(y + h).min(40), 0.6 + next(40) as f32 / 100.0)
        })
        .collect()
}

#[test]
fn mask_nms_matches_double_loop() {
    let all = seeded();
    let set = |m: &Mask| -> Vec<bool> { (0..2000).map(|p| m.bits.has(p)).collect() };
    let sets: Vec<Vec<bool>> = all.iter().map(set).collect();
    let count = |v: &[bool]| v.iter().filter(|b| **b).count() as f32;
    let mut want = Vec::new();
    for i in 0..all.len() {
        let mut stays = all[i].score() > 0.7;
        for j in (0..all.len()).filter(|j| *j != i) {
            let shared = sets[i].iter().zip(&sets[j]).filter(|(a, b)| **a && **b).count() as f32;
            let (a, b) = (count(&sets[i]), count(&sets[j]));
            // Sorting is stable: of equal scores the first one wins.
            let better = all[j].score() > all[i].score() || (all[j].score() == all[i].score() && j < i);
            stays &= !(better && shared / (a + b - shared) > 0.8);
            stays &= !(shared / a >= 0.85 && shared / b < 0.5);
        }
        if stays {
            want.push(sets[i].clone());
        }
    }
    let got: Vec<Vec<bool>> = nms::masks(all, 0.8, 0.7).iter().map(set).collect();
    assert!(got.len() > 5 && got == want, "{} {}", got.len(), want.len());
}

#[test]
fn mask_nms_keeps_three_poor_masks() {
    let poor = vec![
        rectangle(0..5, 0..5, 0.1),
        rectangle(10..15, 0..5, 0.4),
        rectangle(20..25, 0..5, 0.3),
        rectangle(30..35, 0..5, 0.2),
    ];
    let kept: Vec<f32> = nms::masks(poor, 0.8, 0.7).iter().map(|m| m.iou).collect();
    assert_eq!(kept, [0.4, 0.3, 0.2]);
    assert!(nms::masks(Vec::new(), 0.8, 0.7).is_empty());
}

#[test]
fn box_nms_keeps_better_box() {
    let two = vec![rectangle(0..21, 0..21, 0.8), rectangle(0..21, 0..25, 0.9), rectangle(25..40, 0..20, 0.7)];
    let kept: Vec<f32> = nms::boxes(two.clone(), 0.7, |m| m.iou).iter().map(|m| m.iou).collect();
    assert_eq!(kept, [0.9, 0.7]);
    // 20 · 20 / (20 · 24) = 0.833: not more than that.
    assert_eq!(nms::boxes(two, 0.834, |m| m.iou).len(), 3);
}

#[test]
fn clean_fills_holes_and_removes_islands() {
    let mut bits = Bits::from_fn(50, 40, |p| {
        let (x, y) = (p % 50, p / 50);
        let body =
            (5..30).contains(&x) && (5..30).contains(&y) && !((10..12).contains(&x) && (10..12).contains(&y));
        body || (40..43).contains(&x) && (3..5).contains(&y)
    });
    assert!(bits.clean(100));
    assert_eq!((bits.count(), bits.bounds.clone()), (625, (5..30, 5..30)));
    assert!(!bits.clean(100), "nothing left to do");
    let mut dots = Bits::from_fn(50, 40, |p| [(3, 3), (4, 3), (20, 20)].contains(&(p % 50, p / 50)));
    assert!(dots.clean(100));
    assert_eq!(dots.ones().collect::<Vec<_>>(), [153, 154], "the largest island stays");
    let mut full = Bits::from_fn(50, 40, |_| true);
    assert!(!full.clean(100) && full.count() == 2000);
    assert_eq!(Bits::from_runs(50, 40, &[153, 2, 1845]), dots);
    assert_eq!(full.shared(&dots), 2);
}

#[test]
fn paint_puts_small_masks_on_top() {
    let all = seeded();
    let level = paint::labels(&all, false, 50, 40);
    let scores: Vec<f32> = all.iter().map(Mask::score).collect();
    let mut sizes = vec![0; level.quality.len()];
    for (p, label) in level.labels.data.iter().enumerate() {
        let Ok(label) = usize::try_from(*label) else { continue };
        sizes[label] += 1;
        let cover = |m: &&Mask| m.bits.has(p) && m.score() == level.quality[label];
        assert!(all.iter().any(|m| cover(&m)));
    }
    assert!(sizes.iter().all(|s| *s >= 32), "{sizes:?}");
    assert!(level.quality.iter().all(|q| scores.contains(q)) && level.quality.len() > 3);
    let nested =
        paint::labels(&[rectangle(10..20, 10..20, 0.9), rectangle(0..40, 0..40, 0.99)], false, 50, 40);
    assert_eq!((nested.labels.at(15, 15), nested.labels.at(5, 5), nested.labels.at(45, 5)), (0, 1, -1));
    // `whole` keeps pixels that are covered by a smaller mask.
    assert_eq!(nested.whole.len(), 2);
    let pixels = |label: i32| nested.whole.iter().flat_map(|m| &m.data).filter(|l| **l == label).count();
    assert_eq!((pixels(0), pixels(1)), (100, 1600));
    let other = [rectangle(10..20, 10..20, 0.9), rectangle(0..40, 0..30, 0.99)];
    let in_order = paint::labels(&other, true, 50, 40);
    assert_eq!((in_order.labels.at(15, 15), in_order.quality.len()), (0, 1), "the last one covers the first");
    let apart =
        paint::labels(&[rectangle(10..20, 10..20, 0.9), rectangle(30..40, 0..40, 0.99)], false, 50, 40);
    assert!(apart.whole.is_empty(), "its labels are enough");
    let none = paint::labels(&[], false, 50, 40);
    assert!(none.quality.is_empty() && none.labels.data.iter().all(|l| *l == -1));
}
