//! Pixels of weak texture.
use super::{Level, ReferenceView};
use rayon::prelude::*;

/// Half of the window, pixels, as for matching.
const RADIUS: usize = 5;
/// Standard deviation of luma (0 to 1) over the window below which noise, JPEG blocks and shading
/// prevail. In room_a three quarters of the cupboard doors lie below 0.017 and half of the matched
/// pixels above 0.03; the walls of generated scenes start at 0.03.
const WEAK: f64 = 0.02;

/// Per pixel of all views: true if its texture is too weak for matching.
pub fn weak(level: &Level) -> Vec<bool> {
    level.references.par_iter().flat_map_iter(|r| weak_of_view(level, r)).collect()
}

/// [`weak`] of one view.
fn weak_of_view(level: &Level, r: &ReferenceView) -> Vec<bool> {
    let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
    let luma = &level.luma[first..first + width * height];
    let stride = width + 1;
    // Integral images of luma and its square.
    let mut sums = vec![[0.0f64; 2]; stride * (height + 1)];
    for y in 0..height {
        let mut row = [0.0; 2];
        for x in 0..width {
            let l = f64::from(luma[y * width + x]);
            row = [row[0] + l, row[1] + l * l];
            let above = sums[y * stride + x + 1];
            sums[(y + 1) * stride + x + 1] = [above[0] + row[0], above[1] + row[1]];
        }
    }
    let mut out = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let (x0, x1) = (x.saturating_sub(RADIUS), (x + RADIUS + 1).min(width));
            let (y0, y1) = (y.saturating_sub(RADIUS), (y + RADIUS + 1).min(height));
            let n = ((x1 - x0) * (y1 - y0)) as f64;
            let corner = |x: usize, y: usize| sums[y * stride + x];
            let (a, b, c, d) = (corner(x1, y1), corner(x0, y1), corner(x1, y0), corner(x0, y0));
            let [mean, square] = [0, 1].map(|k| (a[k] - b[k] - c[k] + d[k]) / n);
            out.push(square - mean * mean < WEAK * WEAK);
        }
    }
    out
}
