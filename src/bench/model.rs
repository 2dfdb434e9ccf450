//! Least work of each pass, first version (`floor v1`): bytes that must move at least once, and
//! arithmetic on blended pairs. [`super::least`] replaces it; it stays for one release, so that
//! ratios can be compared.
//!
//! Floats per splat: 11 of geometry and opacity, 3 per SH coefficient, d features; of a projected
//! splat PROJECTED_FLOATS. Operations are counted from the formulas of the passes, a fused
//! multiply-add as two, an exponential as one.
use super::least::Limits;
use crate::gpu::shaders;
use crate::pass::fused_update;

/// Limits of the device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Roofline {
    /// Bytes read plus bytes written by a copy, per second.
    pub bytes_per_second: f64,
    /// Floating-point operations of shaders, two per fused multiply-add, per second.
    pub flops_per_second: f64,
    /// Limits of the second floor, where the passes run: in shaders or in native code.
    pub limits: Limits,
}

impl Roofline {
    /// Least milliseconds for this much work.
    pub fn floor_ms(&self, bytes: f64, flops: f64) -> f64 {
        (bytes / self.bytes_per_second).max(flops / self.flops_per_second) * 1e3
    }
}

/// Sizes that determine the work of a step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PassWork {
    /// N.
    pub splats: f64,
    /// SH coefficients per channel.
    pub sh: f64,
    /// d.
    pub features: f64,
    /// W·H.
    pub pixels: f64,
    /// Tile-list entries.
    pub intersections: f64,
    /// Pixel–splat pairs that change a pixel.
    pub blended: f64,
    /// Pixel–splat pairs in rows of a tile in which the splat changes a pixel.
    pub in_rows: f64,
    /// Whether projection backward, the penalty on needles and Adam are one pass.
    pub fused: bool,
}

/// Geometry and opacity of a splat, bytes.
const GEOMETRY: f64 = 44.0;
/// A projected splat, bytes.
const PROJECTED: f64 = 4.0 * shaders::shared::layout::PROJECTED_FLOATS as f64;
/// (key, value), bytes.
const PAIR: f64 = 8.0;
/// 32-bit keys, eight bits at a time.
const SORT_PASSES: f64 = 4.0;
/// Power of the Gaussian (8), its exponential, clamp, weight and the transmittance after it.
const WEIGH: f64 = 14.0;
/// Gradient of alpha from the sum behind it (6), of the power and its six moments (24).
const WEIGH_BACK: f64 = 30.0;

impl PassWork {
    /// (bytes, operations) of a pass by its name in a recording; `None` for passes without a model.
    pub fn of(&self, pass: &str) -> Option<(f64, f64)> {
        let PassWork { splats: n, sh, features: d, pixels, intersections, blended, fused, .. } = *self;
        let (colour, channels) = (12.0 * sh, 4.0 + d);
        let listed = intersections * (4.0 + PROJECTED + 4.0 * d);
        Some(match pass {
            "projection" => (n * (GEOMETRY + colour + 8.0 * d + PROJECTED + PAIR), n * (200.0 + 6.0 * sh)),
            "depth sort" => (n * 2.0 * PAIR * SORT_PASSES, 0.0),
            "binning" => (n * (PAIR + 24.0) + 4.0 * intersections, 30.0 * intersections),
            "raster forward" => {
                (listed + 4.0 * pixels * (channels + 1.0), blended * (WEIGH + 2.0 * channels))
            }
            // Seven separable blurs of 11 taps per value and 40 operations for SSIM and its
            // derivatives.
            "SSIM + L1" => (3.0 * pixels * 12.0, 3.0 * pixels * (7.0 * 44.0 + 40.0)),
            "feature loss" => (pixels * (8.0 * d + 8.0), 3.0 * pixels * d),
            "regularisers" if fused => (8.0 * pixels, 0.0),
            "regularisers" => (8.0 * pixels + 36.0 * n, 10.0 * n),
            // Gradients of a projected splat are added once per list entry: read and written.
            "raster backward" => (
                listed + 8.0 * intersections * (6.0 + channels) + 8.0 * pixels * (channels + 1.0),
                blended * (WEIGH + WEIGH_BACK + 4.0 * channels),
            ),
            "projection backward" => (n * (2.0 * (GEOMETRY + colour) + PROJECTED), n * (600.0 + 12.0 * sh)),
            "feature backward" => (12.0 * n * d, 6.0 * n * d),
            // Both passes without the gradients, which they write and read, and with one reading of
            // the parameters instead of two: 2 · 4 + 20 − 4 − 4 − 4 bytes per parameter.
            fused_update::PASS => {
                let parameters = n * (11.0 + 3.0 * sh);
                (16.0 * parameters + n * PROJECTED, n * (610.0 + 12.0 * sh) + 12.0 * parameters)
            }
            "Adam" => {
                // With the fused update only the features have a pass of their own.
                let parameters = n * (if fused { 0.0 } else { 11.0 + 3.0 * sh } + d);
                // Parameter and moments read and written, gradient read.
                (20.0 * parameters, 12.0 * parameters)
            }
            _ => return None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pass_work_grows_with_features() {
        let small = PassWork {
            splats: 1e5,
            sh: 1.0,
            pixels: 3e5,
            intersections: 5e5,
            blended: 1e7,
            ..PassWork::default()
        };
        let more = PassWork { features: 16.0, ..small };
        for pass in ["projection", "raster forward", "raster backward", "Adam"] {
            let (a, b) = (small.of(pass).unwrap(), more.of(pass).unwrap());
            assert!(b.0 > a.0, "{pass}: features have bytes");
        }
        // 12 bytes per pixel and channel and 348 operations per value.
        assert_eq!(small.of("SSIM + L1"), Some((36.0 * 3e5, 3.0 * 3e5 * 348.0)));
        assert_eq!(small.of("depth sort"), Some((64.0 * 1e5, 0.0)));
        assert_eq!(small.of("unknown"), None);
        // Each of 14 parameters: written and read as a gradient, and read once more.
        let [fused, back, adam] =
            [fused_update::PASS, "projection backward", "Adam"].map(|pass| small.of(pass).unwrap().0);
        assert_eq!(back + adam - fused, 14.0 * 12.0 * 1e5);
    }
}
