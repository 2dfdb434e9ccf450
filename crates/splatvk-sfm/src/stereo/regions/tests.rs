//! A plain square before a textured wall.
use super::*;
use crate::stereo::{StereoOptions, pyramid, texture};
use splatvk_test_support::stereo::{Set, synthetic};

/// Width of the matched rim of the square, pixels.
const RIM: usize = 4;
/// Columns of the mirror image in view 1.
const MIRROR: std::ops::Range<usize> = 64..74;

/// The set with a square of one colour, and the square's pixels in each view.
fn with_plain_square(mut set: Set) -> (Set, Vec<Vec<bool>>) {
    let mut squares = Vec::new();
    for image in &mut set.images {
        let square: Vec<bool> = image.data.iter().map(|c| c[0] > c[2]).collect();
        image.data.iter_mut().zip(&square).filter(|(_, s)| **s).for_each(|(c, _)| *c = [0.8, 0.48, 0.4]);
        squares.push(square);
    }
    (set, squares)
}

#[test]
fn fill_extends_rim_without_mirror_image() {
    let (set, squares) = with_plain_square(synthetic(160, 120));
    let options = StereoOptions { rounds: vec![1], ..StereoOptions::default() };
    let level = pyramid(&set.images, &set.cameras, &set.sparse, &options).unwrap().pop().unwrap();
    let poses = RelativePoses::new(&level);
    let mut surface = Surface { planes: Vec::new(), confidence: Vec::new() };
    let mut open = Vec::new();
    for (view, (depth, square)) in set.depth.iter().zip(&squares).enumerate() {
        let (width, height) = (depth.width, depth.height);
        for k in 0..depth.data.len() {
            let (x, y) = (k % width, k / width);
            let inside = (y.saturating_sub(RIM)..(y + RIM + 1).min(height))
                .all(|y| (x.saturating_sub(RIM)..(x + RIM + 1).min(width)).all(|x| square[y * width + x]));
            // A mirror image lies behind the mirror and looks well matched.
            let mirrored = view == 1 && inside && MIRROR.contains(&x) && (50..60).contains(&y);
            let depth = if mirrored { 1.6 * depth.data[k] } else { depth.data[k] };
            surface.planes.push(Vec3::new(0.0, 0.0, 1.0 / depth));
            surface.confidence.push(if inside && !mirrored { 0.0 } else { 0.9 });
            open.push(inside);
        }
    }
    let void = vec![false; level.pixels()];
    let filled = fill(&level, &poses, &surface, &void, &segment(&level, &texture::weak(&level)), 1);
    let errors = map_pixels(&level, |view, x, y, k| {
        let truth = set.depth[view].at(x, y);
        let found = 1.0 / filled.planes[k].dot(ray(&level, view, x, y));
        (open[k] && filled.confidence[k] > 0.0).then_some((found - truth).abs() / truth)
    });
    let known: Vec<f32> = errors.iter().flatten().copied().collect();
    let all = open.iter().filter(|o| **o).count();
    let worst = known.iter().copied().fold(0.0, f32::max);
    println!("{} of {all} filled, worst error {worst:.4}", known.len());
    assert!(all > 5000 && known.len() * 10 > all * 9, "{} of {all}", known.len());
    assert!(worst < 0.01, "worst error {worst}");

    // Textured pixels are not inferred; only the mirror image loses its depth.
    let textured = vec![false; level.pixels()];
    let untouched = fill(&level, &poses, &surface, &void, &segment(&level, &textured), 1);
    assert_eq!(untouched.confidence, surface.confidence);
}
