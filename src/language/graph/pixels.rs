//! Per-pixel cues: Lab colour, gradient, texture.
use crate::scene::{Plane, RgbImage};
use rayon::prelude::*;

/// sRGB in [0, 1] → CIE L*a*b* (D65).
pub(super) fn lab(c: [f32; 3]) -> [f32; 3] {
    let linear = c.map(|v| if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) });
    let [r, g, b] = linear;
    let xyz = [
        (0.412_456 * r + 0.357_576 * g + 0.180_437 * b) / 0.950_47,
        0.212_673 * r + 0.715_152 * g + 0.072_175 * b,
        (0.019_334 * r + 0.119_192 * g + 0.950_304 * b) / 1.088_83,
    ];
    let f = xyz.map(|t| if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 });
    [116.0 * f[1] - 16.0, 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])]
}

/// Lab image, smoothed by a Gaussian of `sigma` pixels.
pub(super) fn smooth_lab(image: &RgbImage, sigma: f32) -> Vec<[f32; 3]> {
    let raw: Vec<[f32; 3]> = image.data.par_iter().map(|&c| lab(c)).collect();
    blur(&raw, image.width, image.height, sigma)
}

/// Separable Gaussian, edge pixels repeated.
pub(super) fn blur(data: &[[f32; 3]], width: usize, height: usize, sigma: f32) -> Vec<[f32; 3]> {
    let radius = (3.0 * sigma).ceil().max(1.0) as isize;
    let kernel: Vec<f32> =
        (-radius..=radius).map(|k| (-(k * k) as f32 / (2.0 * sigma * sigma)).exp()).collect();
    let total: f32 = kernel.iter().sum();
    let pass = |data: &[[f32; 3]], dx: isize, dy: isize| -> Vec<[f32; 3]> {
        (0..width * height)
            .into_par_iter()
            .map(|p| {
                let (x, y) = ((p % width) as isize, (p / width) as isize);
                let mut sum = [0.0; 3];
                for (k, w) in (-radius..=radius).zip(&kernel) {
                    let sx = (x + k * dx).clamp(0, width as isize - 1) as usize;
                    let sy = (y + k * dy).clamp(0, height as isize - 1) as usize;
                    let v = data[sy * width + sx];
                    for c in 0..3 {
                        sum[c] += w * v[c];
                    }
                }
                sum.map(|s| s / total)
            })
            .collect()
    };
    let rows = pass(data, 1, 0);
    pass(&rows, 0, 1)
}

/// Length of the Lab gradient per pixel (central differences, all channels), Lab units per pixel.
pub(super) fn gradient(lab: &[[f32; 3]], width: usize, height: usize) -> Plane<f32> {
    let data = (0..width * height).into_par_iter().map(|p| {
        let (x, y) = (p % width, p / width);
        let (l, r) = (lab[y * width + x.saturating_sub(1)], lab[y * width + (x + 1).min(width - 1)]);
        let (u, d) = (lab[y.saturating_sub(1) * width + x], lab[(y + 1).min(height - 1) * width + x]);
        let square: f32 = (0..3).map(|c| (r[c] - l[c]).powi(2) + (d[c] - u[c]).powi(2)).sum();
        0.5 * square.sqrt()
    });
    Plane { width, height, data: data.collect() }
}

/// Bins of a region's descriptor: 3 × 12 of colour and 8 of texture.
pub(super) const COLOUR_BINS: usize = 12;
/// Orientation bins; a gradient below [`FLAT`] votes for none.
pub(super) const TEXTURE_BINS: usize = 8;
/// Length of a region's histogram.
pub(super) const BINS: usize = 3 * COLOUR_BINS + TEXTURE_BINS + 1;

/// Lab units per pixel below which a pixel counts as untextured: JPEG noise stays under it.
const FLAT: f32 = 1.5;

/// The four histogram cells that one pixel votes for.
pub(super) fn votes(lab: &[[f32; 3]], width: usize, height: usize, p: usize) -> [usize; 4] {
    let v = lab[p];
    // the a and b of photographed things rarely leave ±60
    let unit = [v[0] / 100.0, v[1] / 120.0 + 0.5, v[2] / 120.0 + 0.5];
    let bin = |k: usize| {
        k * COLOUR_BINS
            + ((unit[k] * COLOUR_BINS as f32) as isize).clamp(0, COLOUR_BINS as isize - 1) as usize
    };
    let (x, y) = (p % width, p / width);
    let gx = lab[y * width + (x + 1).min(width - 1)][0] - lab[y * width + x.saturating_sub(1)][0];
    let gy = lab[(y + 1).min(height - 1) * width + x][0] - lab[y.saturating_sub(1) * width + x][0];
    let texture = if (gx * gx + gy * gy).sqrt() < 2.0 * FLAT {
        TEXTURE_BINS
    } else {
        let turn = gy.atan2(gx) / std::f32::consts::TAU + 0.5;
        ((turn * TEXTURE_BINS as f32) as usize).min(TEXTURE_BINS - 1)
    };
    [bin(0), bin(1), bin(2), 3 * COLOUR_BINS + texture]
}
