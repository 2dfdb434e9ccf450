//! Smoothing and the LERF mask (docs/internals/method.md#smoothing,
//! docs/internals/method.md#lerf-ovs).
use crate::scene::Image;
use rayon::prelude::*;

/// Side of the smoothing box, pixels (LERF, LangSplat).
pub(super) const BOX: usize = 30;

/// Side of the majority filter of the LERF protocol, pixels.
const MAJORITY: usize = 7;

/// 30×30 box mean with the window `x−15 … x+14`, border reflected without repeating the edge pixel
/// (OpenCV `filter2D`, `REFLECT_101`).
pub fn box30(map: &Image<f32>) -> Image<f32> {
    box_filter(map, BOX, BOX / 2, reflect_101)
}

/// `½ (box + raw)`.
pub fn blend(raw: &Image<f32>, boxed: &Image<f32>) -> Image<f32> {
    let data = raw.data.iter().zip(&boxed.data).map(|(a, b)| 0.5 * (a + b)).collect();
    Image { width: raw.width, height: raw.height, data }
}

/// Protocol `lerf`: `clip(2·o − 1, 0, 1) > threshold` with o the min–max-normalised map, then a 7×7
/// majority.
pub fn lerf_mask(blended: &Image<f32>, threshold: f32) -> Image<bool> {
    let low = blended.data.iter().copied().fold(f32::INFINITY, f32::min);
    let high = blended.data.iter().map(|v| v - low).fold(0.0, f32::max) + 1e-9;
    let mask = blended.data.iter().map(|v| {
        let o = ((v - low) / high * 2.0 - 1.0).clamp(0.0, 1.0);
        if o > threshold { 1.0 } else { 0.0 }
    });
    let mask = Image { width: blended.width, height: blended.height, data: mask.collect() };
    let votes = box_filter(&mask, MAJORITY, MAJORITY / 2, replicate);
    let data = votes.data.iter().map(|&v| v >= 0.5).collect();
    Image { width: mask.width, height: mask.height, data }
}

/// Maps an index into 0..n by reflection without repeating the edge.
pub(super) fn reflect_101(i: isize, n: usize) -> usize {
    if n == 1 {
        return 0;
    }
    let period = 2 * (n as isize - 1);
    let m = i.rem_euclid(period);
    (if m < n as isize { m } else { period - m }) as usize
}

fn replicate(i: isize, n: usize) -> usize {
    i.clamp(0, n as isize - 1) as usize
}

/// Rows per task of the vertical pass: enough that filling the first window takes a small part of
/// it.
const BAND: usize = 96;

/// Separable mean over `size` pixels starting `anchor` before each pixel; running sums in f64.
fn box_filter(map: &Image<f32>, size: usize, anchor: usize, border: fn(isize, usize) -> usize) -> Image<f32> {
    let (w, h) = (map.width, map.height);
    let mut out = Image::filled(w, h, 0.0f32);
    if w == 0 || h == 0 {
        return out;
    }
    let columns: Vec<usize> = (0..w + size).map(|k| border(k as isize - anchor as isize, w)).collect();
    let mut rows = vec![0.0f32; w * h];
    rows.par_chunks_exact_mut(w).zip(map.data.par_chunks_exact(w)).for_each(|(sums, row)| {
        let mut sum: f64 = columns[..size].iter().map(|&x| f64::from(row[x])).sum();
        for (x, out) in sums.iter_mut().enumerate() {
            *out = sum as f32;
            sum += f64::from(row[columns[x + size]]) - f64::from(row[columns[x]]);
        }
    });
    let source_row = |y: usize| {
        let from = border(y as isize - anchor as isize, h) * w;
        &rows[from..from + w]
    };
    let scale = 1.0 / (size * size) as f64;
    out.data.par_chunks_mut(w * BAND).enumerate().for_each(|(band, out)| {
        let mut sums = vec![0.0f64; w];
        let first = band * BAND;
        for y in first..first + size {
            sums.iter_mut().zip(source_row(y)).for_each(|(s, v)| *s += f64::from(*v));
        }
        for (k, out) in out.chunks_exact_mut(w).enumerate() {
            let (gone, new) = (source_row(first + k), source_row(first + k + size));
            for ((o, s), (g, n)) in out.iter_mut().zip(&mut sums).zip(gone.iter().zip(new)) {
                *o = (*s * scale) as f32;
                *s += f64::from(*n) - f64::from(*g);
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(w: usize, h: usize) -> Image<f32> {
        let data = (0..w * h).map(|i| ((i * 7919 + 13) % 1009) as f32 / 1009.0).collect();
        Image { width: w, height: h, data }
    }

    #[test]
    fn box30_matches_direct_sum() {
        // maps narrower than the box reflect more than once
        for (w, h) in [(41, 33), (8, 50), (1, 1)] {
            let map = noise(w, h);
            let got = box30(&map);
            for y in 0..h {
                for x in 0..w {
                    let mut sum = 0.0f64;
                    for j in 0..30isize {
                        for i in 0..30isize {
                            let fold = |v: isize, n: usize| {
                                let (mut v, n) = (v, n as isize);
                                while n > 1 && (v < 0 || v >= n) {
                                    v = if v < 0 { -v } else { 2 * (n - 1) - v };
                                }
                                if n == 1 { 0 } else { v as usize }
                            };
                            sum += map.at(fold(x as isize + i - 15, w), fold(y as isize + j - 15, h)) as f64;
                        }
                    }
                    // both sides end in f32
                    assert!((got.at(x, y) as f64 - sum / 900.0).abs() < 1e-6);
                }
            }
        }
    }

    #[test]
    fn lerf_mask_shrinks_with_higher_threshold() {
        let mut map = noise(64, 48);
        map.data.iter_mut().for_each(|v| *v *= 0.2);
        for y in 10..30 {
            for x in 20..40 {
                map.data[y * 64 + x] = 0.9 + 0.005 * x as f32;
            }
        }
        map.data[40 * 64 + 60] = 1.1;
        let count = |t: f32| lerf_mask(&map, t).data.iter().filter(|&&m| m).count();
        assert!(count(0.4) >= count(0.6) && count(0.6) >= count(0.9) && count(0.6) > 300);
        assert!(!lerf_mask(&map, 0.6).at(60, 40), "a single pixel has no majority");
        assert!(!lerf_mask(&Image::filled(5, 5, 0.3), 0.6).data.iter().any(|&m| m));
    }
}
