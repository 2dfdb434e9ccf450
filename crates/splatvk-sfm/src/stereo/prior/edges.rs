//! Depth edges of a prior, over which networks blur.

/// Half of the window of the plane fit, share of the view's width: the reach of a blur by a
/// hundredth of the width.
const RADIUS_SHARE: f32 = 1.0 / 90.0;
/// Relative deviation from a plane above which the window holds two surfaces; a ball of a tenth of
/// its distance deviates less.
const BENT: f64 = 0.012;

/// Per pixel: true if the inverse depths around it (0 = unknown) lie on one plane, by least squares
/// over a square window.
pub fn flat(inverse: &[f32], width: usize, height: usize) -> Vec<bool> {
    let radius = ((RADIUS_SHARE * width as f32).round() as usize).max(2);
    let moments = Moments::new(inverse, width, height);
    (0..inverse.len())
        .map(|k| {
            let here = f64::from(inverse[k]);
            here > 0.0 && moments.deviation(k % width, k / width, radius).is_some_and(|d| d < BENT * here)
        })
        .collect()
}

/// Integral images of 1, x, y, x², xy, y², v, xv, yv, v².
struct Moments {
    sums: Vec<[f64; 10]>,
    width: usize,
    height: usize,
}

impl Moments {
    fn new(values: &[f32], width: usize, height: usize) -> Moments {
        let stride = width + 1;
        let mut sums = vec![[0.0; 10]; stride * (height + 1)];
        for y in 0..height {
            let mut row = [0.0; 10];
            for x in 0..width {
                let v = f64::from(values[y * width + x]);
                if v > 0.0 {
                    let (x, y) = (x as f64, y as f64);
                    let own = [1.0, x, y, x * x, x * y, y * y, v, x * v, y * v, v * v];
                    row.iter_mut().zip(own).for_each(|(r, o)| *r += o);
                }
                for c in 0..10 {
                    sums[(y + 1) * stride + x + 1][c] = sums[y * stride + x + 1][c] + row[c];
                }
            }
        }
        Moments { sums, width, height }
    }

    /// Root mean square residual of a plane fit over the window; `None` where hardly any is known.
    fn deviation(&self, x: usize, y: usize, radius: usize) -> Option<f64> {
        let stride = self.width + 1;
        let (x0, x1) = (x.saturating_sub(radius), (x + radius + 1).min(self.width));
        let (y0, y1) = (y.saturating_sub(radius), (y + radius + 1).min(self.height));
        let corner = |x: usize, y: usize| &self.sums[y * stride + x];
        let (a, b, c, d) = (corner(x1, y1), corner(x0, y1), corner(x1, y0), corner(x0, y0));
        let s: [f64; 10] = std::array::from_fn(|k| a[k] - b[k] - c[k] + d[k]);
        let n = s[0];
        if n < 6.0 {
            return None;
        }
        let (mx, my, mv) = (s[1] / n, s[2] / n, s[6] / n);
        let (xx, xy, yy) = (s[3] / n - mx * mx, s[4] / n - mx * my, s[5] / n - my * my);
        let (xv, yv, vv) = (s[7] / n - mx * mv, s[8] / n - my * mv, s[9] / n - mv * mv);
        let det = xx * yy - xy * xy;
        if det < 1e-6 * xx.max(yy).powi(2) {
            return None;
        }
        let (p, q) = ((yy * xv - xy * yv) / det, (xx * yv - xy * xv) / det);
        Some((vv - p * xv - q * yv).max(0.0).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flat_rejects_blurred_steps() {
        let (width, height) = (360, 60);
        // A slanted plane, then a step of 20 % in inverse depth that is blurred over 5 pixels.
        let plane = |x: f32, y: f32| 1.0 + 0.002 * x + 0.003 * y;
        let ramp = |x: f32| ((x - 86.0) / 5.0).clamp(0.0, 1.0);
        let inverse: Vec<f32> = (0..width * height)
            .map(|k| ((k % width) as f32, (k / width) as f32))
            .map(|(x, y)| plane(x, y) * (1.0 - 0.2 * ramp(x)))
            .collect();
        let flat = flat(&inverse, width, height);
        for y in 0..height {
            for x in 0..width {
                let expected = match x {
                    0..80 | 100.. => true,
                    86..91 => false,
                    _ => continue,
                };
                assert_eq!(flat[y * width + x], expected, "{x} {y}");
            }
        }
    }
}
