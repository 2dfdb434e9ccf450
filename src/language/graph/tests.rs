use super::*;
use crate::infer::breakfast::{TestView, train_views};
use crate::infer::{Registry, hed::Hed};

/// The eight objects of the breakfast set; 1 to 3 are table, wall and carpet.
const OBJECTS: std::ops::Range<i32> = 4..12;

/// Best IoU of any mask of any level with one object.
fn best_iou(masks: &ViewMasks, truth: &Plane<i32>, object: i32) -> f32 {
    let size = truth.data.iter().filter(|&&t| t == object).count() as f32;
    let mut best = 0.0f32;
    for level in &masks.levels {
        let mut counts = vec![(0f32, 0f32); level.quality.len()];
        for (&l, &t) in level.labels.data.iter().zip(&truth.data).filter(|(l, _)| **l >= 0) {
            counts[l as usize].0 += 1.0;
            counts[l as usize].1 += f32::from(t == object);
        }
        best = counts.iter().map(|(area, hit)| hit / (area + size - hit)).fold(best, f32::max);
    }
    best
}

/// Exact depth with independent noise of 1 % per pixel.
fn noisy_depth(view: &TestView) -> DepthMap {
    let mut state = 1u64;
    let mut uniform = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5
    };
    // the sum of four uniforms has variance 1/3
    let mut normal = || (0..4).map(|_| uniform()).sum::<f32>() * 3f32.sqrt();
    let mut depth = view.depth.clone();
    depth.data.iter_mut().for_each(|z| *z *= 1.0 + 0.01 * normal());
    let confidence = depth.data.iter().map(|&z| f32::from(z > 0.0)).collect();
    DepthMap { confidence: Plane { data: confidence, ..depth.clone() }, depth }
}

fn mean_iou(views: &[TestView], mask: impl Fn(&TestView) -> ViewMasks) -> f32 {
    let mut all = Vec::new();
    for view in views {
        let masks = mask(view);
        let row: Vec<f32> = OBJECTS.map(|k| best_iou(&masks, &view.masks, k)).collect();
        let counts: Vec<usize> = masks.levels.iter().map(|l| l.quality.len()).collect();
        println!("{}: {row:.2?} masks {counts:?}", view.camera.name);
        all.extend(row);
    }
    all.iter().sum::<f32>() / all.len() as f32
}

#[test]
fn finds_the_breakfast_objects() {
    let views = train_views();
    let mut hed = Hed::load(&Registry::open(None).unwrap()).unwrap();
    let edges: Vec<Plane<f32>> = views.iter().map(|v| hed.edges(&v.image).unwrap()).collect();
    let options = GraphOptions::default();
    let of = |v: &TestView| views.iter().position(|o| o.camera.name == v.camera.name).unwrap();
    let learned = mean_iou(&views, |v| segment(&v.image, Some(&edges[of(v)]), None, &options).unwrap());
    let both = mean_iou(&views, |v| {
        let depth = noisy_depth(v);
        segment(&v.image, Some(&edges[of(v)]), Some((&v.camera, &depth)), &options).unwrap()
    });
    let plain = mean_iou(&views, |v| segment(&v.image, None, None, &options).unwrap());
    println!(
        "best of three levels: {learned:.3} with edges, {both:.3} with edges and depth, {plain:.3} colour only"
    );
    // the goal of the built-in masks on this set
    assert!(learned >= 0.88 && both >= 0.88);
    // plain Felzenszwalb merging, best of four scales, reaches 0.83 to 0.86 on these photos
    assert!(plain >= 0.70);
}

#[test]
fn every_level_is_a_compact_partition() {
    let view = &train_views()[1];
    let masks = segment(&view.image, None, None, &GraphOptions::default()).unwrap();
    assert_eq!(masks.levels.len(), 3);
    for level in &masks.levels {
        let mut seen = vec![false; level.quality.len()];
        assert_eq!(level.labels.data.len(), view.masks.data.len());
        for &l in &level.labels.data {
            // everything belongs to something: small regions joined what encloses them
            seen[usize::try_from(l).unwrap()] = true;
        }
        assert!(seen.iter().all(|&s| s) && seen.len() > 1);
    }
    let count = |k: usize| masks.levels[k].quality.len();
    assert!(count(0) >= count(1) && count(1) >= count(2), "finer levels have more masks");
    let again = segment(&view.image, None, None, &GraphOptions::default()).unwrap();
    assert!(again.levels.iter().zip(&masks.levels).all(|(a, b)| a.labels == b.labels));
}

/// A red square on grey, with a small blue dot inside the square.
fn square() -> (RgbImage, Plane<i32>) {
    let (width, height) = (320, 240);
    let mut image = RgbImage { width, height, data: vec![[0.5; 3]; width * height] };
    let mut truth = Plane::filled(width, height, 0);
    for y in 60..160 {
        for x in 100..220 {
            let dot = (x as i32 - 160).pow(2) + (y as i32 - 110).pow(2) < 64;
            image.data[y * width + x] = if dot { [0.1, 0.1, 0.8] } else { [0.8, 0.1, 0.1] };
            truth.data[y * width + x] = 1;
        }
    }
    (image, truth)
}

#[test]
fn what_a_thing_encloses_belongs_to_it() {
    let (image, truth) = square();
    let masks = segment(&image, None, None, &GraphOptions::default()).unwrap();
    let best = best_iou(&masks, &truth, 1);
    // the smoothing of the colours may move the outline by half a pixel: 2 % of this square
    assert!(best > 0.96, "{best}");
}

#[test]
fn a_flat_image_and_wrong_sizes() {
    let flat = RgbImage { width: 64, height: 64, data: vec![[0.3; 3]; 4096] };
    let masks = segment(&flat, None, None, &GraphOptions::default()).unwrap();
    for level in &masks.levels {
        assert!(level.quality.len() == 1 && level.labels.data.iter().all(|&l| l == 0));
    }
    let edges = Plane::filled(32, 64, 0.0);
    assert!(segment(&flat, Some(&edges), None, &GraphOptions::default()).is_err());
}
