//! Fusion with priors made from true depth, with errors of known size.
use super::*;
use crate::progress::{Recorded, Silent};
use crate::scene::Image;
use crate::stereo::surface::RelativePoses;
use crate::stereo::{StereoOptions, pyramid};
use splatvk_test_support::stereo::{Set, breakfast};

/// Smooth field of mean 0 and standard deviation 1 that swings about twice over the image.
fn smooth(width: usize, height: usize, phase: f32) -> impl Fn(usize) -> f32 {
    move |k| {
        let (x, y) = ((k % width) as f32 / width as f32, (k / width) as f32 / height as f32);
        let wave = |a: f32, b: f32, p: f32| (std::f32::consts::TAU * (a * x + b * y + p + phase)).sin();
        // Three waves of variance one half each.
        (wave(1.3, 0.8, 0.1) + wave(-0.7, 1.6, 0.4) + wave(2.1, -0.5, 0.8)) / 1.5f32.sqrt()
    }
}

/// Network-like prior from true depth: inverse depth with a scale and a shift that both vary by
/// `error` over the image, near surfaces spread over far ones and blurred by a tenth of `error` of
/// the width.
fn simulated(depth: &Image<f32>, error: f32, phase: f32) -> DepthPrior {
    let (width, height) = (depth.width, depth.height);
    let radius = (0.1 * error * width as f32).round().max(1.0) as usize;
    let known: Vec<f32> = depth.data.iter().map(|z| if *z > 0.0 { 1.0 / z } else { 0.0 }).collect();
    let mut sorted: Vec<f64> = known.iter().filter(|v| **v > 0.0).map(|v| f64::from(*v)).collect();
    let unit = crate::math::median(&mut sorted).unwrap() as f32;
    let filtered = |from: &[f32], reduce: &dyn Fn(&[f32]) -> f32| -> Vec<f32> {
        let mut out = Vec::with_capacity(from.len());
        for k in 0..from.len() {
            let (x, y) = (k % width, k / width);
            let mut inside = Vec::new();
            for py in y.saturating_sub(radius)..(y + radius + 1).min(height) {
                for px in x.saturating_sub(radius)..(x + radius + 1).min(width) {
                    inside.push(from[py * width + px]);
                }
            }
            out.push(reduce(&inside));
        }
        out
    };
    let dilated = filtered(&known, &|w| w.iter().copied().fold(0.0, f32::max));
    let mixed: Vec<f32> = known.iter().zip(&dilated).map(|(k, b)| 0.5 * (k + b)).collect();
    let blurred = filtered(&mixed, &|w| w.iter().sum::<f32>() / w.len() as f32);
    let (scale, shift) = (smooth(width, height, phase), smooth(width, height, phase + 0.37));
    let value = |k: usize| {
        let inverse = blurred[k] * (1.0 + error * scale(k)) + 0.5 * error * unit * shift(k);
        3.0 * inverse + 0.7 * unit
    };
    let values = Image { width, height, data: (0..width * height).map(value).collect() };
    DepthPrior { values, kind: PriorKind::InverseDepth }
}

/// Matched surface from true depth, without blocks of a sixth of the width that cover half of the
/// image.
fn matched(set: &Set, level: &Level) -> Surface {
    let mut surface = Surface { planes: Vec::new(), confidence: Vec::new() };
    for (view, depth) in set.depth.iter().enumerate() {
        let side = depth.width / 6;
        for k in 0..depth.data.len() {
            let (x, y) = (k % depth.width, k / depth.width);
            let known = depth.data[k] > 0.0 && (x / side + y / side + view) % 2 == 0;
            surface.planes.push(if known { Vec3::new(0.0, 0.0, 1.0 / depth.data[k]) } else { Vec3::ZERO });
            surface.confidence.push(if known { 0.9 } else { 0.0 });
        }
    }
    assert_eq!(surface.planes.len(), level.pixels());
    surface
}

fn level(set: &Set) -> Level {
    let options = StereoOptions { rounds: vec![1], ..StereoOptions::default() };
    pyramid(&set.images, &set.cameras, &set.sparse, &options).unwrap().pop().unwrap()
}

/// Mean relative error of pixels from the prior alone, and their share of the unmatched ones.
fn suggested(set: &Set, level: &Level, before: &Surface, after: &Surface) -> (f32, f32) {
    let (mut sum, mut count, mut open) = (0.0, 0usize, 0usize);
    for (view, depth) in set.depth.iter().enumerate() {
        let first = level.references[view].first as usize;
        for (k, &truth) in depth.data.iter().enumerate().filter(|(_, z)| **z > 0.0) {
            open += usize::from(before.confidence[first + k] <= 0.0);
            if before.confidence[first + k] <= 0.0 && after.confidence[first + k] == SUGGESTED {
                let ray = ray(level, view, k % depth.width, k / depth.width);
                sum += (1.0 / after.planes[first + k].dot(ray) - truth).abs() / truth;
                count += 1;
            }
        }
    }
    (sum / count as f32, count as f32 / open as f32)
}

#[test]
fn fuse_priors_follows_varying_scale() {
    let set = breakfast(4);
    let level = level(&set);
    let poses = RelativePoses::new(&level);
    let before = matched(&set, &level);
    for (error, at_most) in [(0.05, 0.03), (0.1, 0.07), (0.2, 0.15)] {
        let priors: Vec<_> =
            set.depth.iter().enumerate().map(|(v, d)| Some(simulated(d, error, 0.2 * v as f32))).collect();
        let after = fuse_priors(&level, &poses, &before, &priors, 1, &Silent);
        let (mean, share) = suggested(&set, &level, &before, &after);
        println!("prior off by {error}: filled {share:.2} with a mean error of {mean:.4}");
        assert!(mean < at_most && share > 0.5, "prior off by {error}: {mean} over {share}");
        // Matched pixels keep their confidence.
        for (k, c) in before.confidence.iter().enumerate().filter(|(_, c)| **c > 0.0) {
            assert_eq!(after.confidence[k], *c);
        }
    }
}

#[test]
fn fuse_priors_rejects_another_scene() {
    let set = breakfast(8);
    let level = level(&set);
    let poses = RelativePoses::new(&level);
    let before = matched(&set, &level);
    // Near where the scene is far.
    let inverted = |d: &Image<f32>| Some(DepthPrior { values: d.clone(), kind: PriorKind::InverseDepth });
    let priors: Vec<_> = set.depth.iter().map(inverted).collect();
    let recorded = Recorded::new(&Silent);
    let after = fuse_priors(&level, &poses, &before, &priors, 1, &recorded);
    let warned = recorded.warnings();
    let used = after.confidence.iter().filter(|c| **c == SUGGESTED).count();
    println!("{used} of {} pixels suggested; {warned:?}", after.confidence.len());
    assert!(warned.iter().all(|w| w.contains("prior")), "{warned:?}");
    assert!(!warned.is_empty() && used * 10 < after.confidence.len());
}

#[test]
fn fuse_priors_rejects_contradicting_block() {
    let set = breakfast(4);
    let level = level(&set);
    let poses = RelativePoses::new(&level);
    let before = matched(&set, &level);
    // Exact, but for a block of view 0 that stands at half its depth.
    let mut priors: Vec<Option<DepthPrior>> =
        set.depth.iter().map(|d| Some(DepthPrior { values: d.clone(), kind: PriorKind::Depth })).collect();
    let depth = &mut priors[0].as_mut().unwrap().values;
    let (width, side) = (depth.width, depth.width / 6);
    let wrong =
        |k: usize| (2 * side..4 * side).contains(&(k % width)) && (side..3 * side).contains(&(k / width));
    for k in (0..depth.data.len()).filter(|k| wrong(*k)) {
        depth.data[k] *= 0.5;
    }
    let after = fuse_priors(&level, &poses, &before, &priors, 1, &Silent);
    let (mut bad, mut good) = (0usize, 0usize);
    for k in (0..set.depth[0].data.len()).filter(|k| before.confidence[*k] <= 0.0) {
        let truth = set.depth[0].data[k];
        if after.confidence[k] == SUGGESTED && truth > 0.0 {
            let ray = ray(&level, 0, k % width, k / width);
            let off = (1.0 / after.planes[k].dot(ray) - truth).abs() / truth;
            if off > 0.1 { bad += 1 } else { good += 1 }
        }
    }
    println!("{good} right, {bad} wrong");
    assert!(good > 2000 && bad * 50 < good, "{good} right, {bad} wrong");
}
