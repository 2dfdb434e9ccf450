//! Pictures of the interactive view against masks and renders.
use super::Page;
use splatvk::scene::{Image, RgbImage};
use std::path::Path;

pub fn to_float(picture: &image::RgbImage) -> RgbImage {
    let data = picture.pixels().map(|p| p.0.map(|v| f32::from(v) / 255.0)).collect();
    RgbImage { width: picture.width() as usize, height: picture.height() as usize, data }
}

/// The point of the object's mask farthest from its edge, in pixels of the photo.
pub fn inner_point(mask: &Image<i32>, object: i32) -> (f64, f64) {
    let mut best = (0, 0, 0);
    for y in 0..mask.height {
        for x in 0..mask.width {
            while is_clear(mask, object, x, y, best.2 + 1) {
                best = (x, y, best.2 + 1);
            }
        }
    }
    (best.0 as f64 + 0.5, best.1 as f64 + 0.5)
}

/// Whether a square of radius `r` lies inside the object.
pub fn is_clear(mask: &Image<i32>, object: i32, x: usize, y: usize, r: usize) -> bool {
    x >= r
        && y >= r
        && x + r < mask.width
        && y + r < mask.height
        && (y - r..=y + r).all(|j| (x - r..=x + r).all(|i| mask.at(i, j) == object))
}

/// Pixels that a relevancy picture colours; the others are grey.
pub fn coloured(picture: &image::RgbImage) -> Vec<bool> {
    // Warm and light colours of the heat map differ by more than half the range between channels.
    picture.pixels().map(|p| p.0.iter().max().unwrap() - p.0.iter().min().unwrap() > 100).collect()
}

pub fn iou(a: &[bool], b: &[bool]) -> f64 {
    let both = a.iter().zip(b).filter(|(a, b)| **a && **b).count();
    both as f64 / a.iter().zip(b).filter(|(a, b)| **a || **b).count() as f64
}

pub fn object_mask(mask: &Image<i32>, object: i32) -> Vec<bool> {
    mask.data.iter().map(|l| *l == object).collect()
}

/// Writes a screenshot into the folder `SPLATVK_KEEP`, if that is set.
pub fn keep_screenshot(page: &mut Page, name: &str) {
    if let Ok(folder) = std::env::var("SPLATVK_KEEP") {
        std::fs::write(Path::new(&folder).join(name), page.screenshot()).unwrap();
    }
}

/// Position of a pixel of photo 0 on a page whose canvas fills the window.
pub fn page_position(page: &mut Page, (x, y): (f64, f64)) -> (f64, f64) {
    let size = page.run("[innerWidth, innerHeight]");
    let (width, height) = (size[0].as_f64().unwrap(), size[1].as_f64().unwrap());
    let scale = (width / 640.0).min(height / 480.0);
    (width / 2.0 + (x - 320.0) * scale, height / 2.0 + (y - 240.0) * scale)
}
