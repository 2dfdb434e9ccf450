//! Lab colour of the pixels.
use crate::scene::RgbImage;
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
    let rows = convolve(data, (width, height), &kernel, (1, 0));
    convolve(&rows, (width, height), &kernel, (0, 1))
}

/// Convolution with a normalised kernel of odd length along the direction (dx, dy).
fn convolve(
    data: &[[f32; 3]],
    (width, height): (usize, usize),
    kernel: &[f32],
    (dx, dy): (isize, isize),
) -> Vec<[f32; 3]> {
    let radius = (kernel.len() / 2) as isize;
    let total: f32 = kernel.iter().sum();
    (0..width * height)
        .into_par_iter()
        .map(|p| {
            let (x, y) = ((p % width) as isize, (p / width) as isize);
            let mut sum = [0.0; 3];
            for (k, w) in (-radius..=radius).zip(kernel) {
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
}
