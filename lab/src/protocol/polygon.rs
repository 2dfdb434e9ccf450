//! Polygons to masks as in the label tools of LERF-OVS: vertices truncated to whole pixels,
//! even-odd interior, outline included (OpenCV's `fillPoly`).
use splatvk::scene::Image;

/// Farthest that a vertex may lie outside, pixels: beyond it products of coordinates exceed 64
/// bits.
pub const FARTHEST: f64 = 1e6;

/// Sets the pixels of a closed polygon. Vertices may lie outside, up to [`FARTHEST`].
pub fn fill(mask: &mut Image<bool>, polygon: &[[f64; 2]]) {
    let points: Vec<[i64; 2]> = polygon.iter().map(|p| p.map(|v| v.trunc() as i64)).collect();
    let edges = || (0..points.len()).map(|i| (points[i], points[(i + 1) % points.len()]));
    for (a, b) in edges() {
        outline(mask, a, b);
    }
    for y in 0..mask.height as i64 {
        // Half-open in y, so that a vertex on the row counts once.
        let mut crossings: Vec<f64> = edges()
            .filter(|(a, b)| a[1].min(b[1]) <= y && y < a[1].max(b[1]))
            .map(|(a, b)| {
                let t = (y - a[1]) as f64 / (b[1] - a[1]) as f64;
                a[0] as f64 + t * (b[0] - a[0]) as f64
            })
            .collect();
        crossings.sort_by(f64::total_cmp);
        for pair in crossings.chunks_exact(2) {
            let (first, last) = (pair[0].ceil().max(0.0), pair[1].floor().min(mask.width as f64 - 1.0));
            for x in first as i64..=last as i64 {
                set(mask, x, y);
            }
        }
    }
}

fn set(mask: &mut Image<bool>, x: i64, y: i64) {
    if x >= 0 && y >= 0 && x < mask.width as i64 && y < mask.height as i64 {
        mask.data[y as usize * mask.width + x as usize] = true;
    }
}

/// Sets every pixel of an 8-connected line (Bresenham): one per step along the longer axis, rounded
/// along the other.
fn outline(mask: &mut Image<bool>, a: [i64; 2], b: [i64; 2]) {
    let (dx, dy) = (b[0] - a[0], b[1] - a[1]);
    let steps = dx.abs().max(dy.abs());
    // Every step along the longer axis is a pixel: steps outside the image are skipped.
    let (from, forward, size) = match dx.abs() >= dy.abs() {
        true => (a[0], dx >= 0, mask.width as i64),
        false => (a[1], dy >= 0, mask.height as i64),
    };
    let (first, last) = if forward { (-from, size - 1 - from) } else { (from - size + 1, from) };
    for k in first.max(0)..=last.min(steps) {
        let coordinate = |from: i64, d: i64| from + (2 * k * d + steps).div_euclid((2 * steps).max(1));
        set(mask, coordinate(a[0], dx), coordinate(a[1], dy));
    }
}
