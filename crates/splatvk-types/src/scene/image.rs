//! Images and per-pixel maps.
use glam::DVec2;
use serde::{Deserialize, Serialize};

/// A row-major map of one value per pixel, `data[y * width + x]`.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct Image<T> {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// [H, W] values.
    pub data: Vec<T>,
}

impl<T: Clone> Image<T> {
    /// A map filled with one value.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Image { width, height, data: vec![value; width * height] }
    }
}

impl<T: Copy> Image<T> {
    /// Value at column x, row y.
    pub fn at(&self, x: usize, y: usize) -> T {
        self.data[y * self.width + x]
    }

    /// The part of size (width, height) whose first pixel is at column x, row y.
    pub fn cropped(&self, (x, y): (usize, usize), (width, height): (usize, usize)) -> Image<T> {
        let row = |r: usize| self.data[(y + r) * self.width + x..][..width].iter().copied();
        Image { width, height, data: (0..height).flat_map(row).collect() }
    }
}

/// An RGB image: `[H, W, 3]` in [0, 1].
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct RgbImage {
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// [H, W] colours.
    pub data: Vec<[f32; 3]>,
}

impl Image<f32> {
    /// Median of the positive values in the central third; `None` without any.
    pub fn central_median(&self) -> Option<f64> {
        let (w, h) = (self.width / 3, self.height / 3);
        let part = self.cropped((w, h), (self.width - 2 * w, self.height - 2 * h));
        crate::math::median(
            &mut part.data.iter().filter(|v| **v > 0.0).map(|v| f64::from(*v)).collect::<Vec<_>>(),
        )
    }
}

impl RgbImage {
    /// Colour at column x, row y.
    pub fn at(&self, x: usize, y: usize) -> [f32; 3] {
        self.data[y * self.width + x]
    }
    /// Colour of the pixel that contains a continuous position, or of the nearest one.
    pub fn nearest(&self, p: DVec2) -> [f32; 3] {
        self.at((p.x.max(0.0) as usize).min(self.width - 1), (p.y.max(0.0) as usize).min(self.height - 1))
    }
    /// Rec. 601 luma per pixel.
    pub fn luma(&self) -> Image<f32> {
        let data = self.data.iter().map(|c| 0.299 * c[0] + 0.587 * c[1] + 0.114 * c[2]).collect();
        Image { width: self.width, height: self.height, data }
    }
}

/// Depth (camera z, world units, 0 = unknown) and confidence of one view, at the photo's working
/// resolution.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize)]
pub struct DepthMap {
    /// [H, W] camera z; 0 = unknown.
    pub depth: Image<f32>,
    /// [H, W] confidence ≥ 0; 0 where depth is unknown.
    pub confidence: Image<f32>,
}

/// Confidence of rendered depth: that of depth on which several photos agree, which trained it.
const RENDERED: f32 = 0.9;

impl DepthMap {
    /// Depth [H, W] that splats render; 0 = unknown.
    pub fn rendered(depth: Image<f32>) -> DepthMap {
        let confidence = depth.data.iter().map(|z| if *z > 0.0 { RENDERED } else { 0.0 }).collect();
        let confidence = Image { width: depth.width, height: depth.height, data: confidence };
        DepthMap { depth, confidence }
    }

    /// Makes depth unknown where `keep(index)` is false.
    pub fn keep(&mut self, keep: impl Fn(usize) -> bool) {
        for i in (0..self.depth.data.len()).filter(|i| !keep(*i)) {
            (self.depth.data[i], self.confidence.data[i]) = (0.0, 0.0);
        }
    }
}
