//! Image loss `w₁·mean|x−y| + w₂·(1 − mean SSIM(x,y))` and its gradient by the rendered image x.
//!
//! SSIM as in 3D Gaussian splatting (Wang et al. 2004; Kerbl et al. 2023): 11×11 Gaussian window, σ
//! = 1.5, normalised, zero padding, per channel, C1 = 1e-4, C2 = 9e-4, mean over all pixels and
//! channels. Where pixels have weights w, x is replaced by `y + w·(x − y)`: a pixel of weight 0
//! equals the target in the windows of its neighbours, and the means are over the weights. With ∗
//! the (symmetric) window and S = A1·A2/(B1·B2), the derivative is three more blurs: `∂/∂x =
//! ∗(∂S/∂μx) + 2x·∗(∂S/∂E[x²]) + y·∗(∂S/∂E[xy])`.
use super::bands::{Band, Bands};
use super::sum;
use crate::Result;
use crate::gpu::shaders::shared::ssim::{self as shared, C1, C2};
use crate::gpu::{Buffer, Device, KernelVariant, Recorder, VariantPair, shaders};
use serde::{Deserialize, Serialize};

/// Taps of the SSIM window.
pub const WINDOW: usize = shared::WINDOW.len();
/// Half of the window, in which a pixel has an influence.
pub const HALF: usize = shared::HALF as usize;
const SIGMA: f64 = 1.5;

/// The two terms of the image loss before weighting.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ImageLoss {
    /// Mean absolute difference.
    pub l1: f64,
    /// Mean structural similarity, at most 1.
    pub ssim: f64,
}

impl ImageLoss {
    /// `l1_weight·L1 + dssim_weight·(1 − SSIM)`.
    pub fn total(&self, l1_weight: f64, dssim_weight: f64) -> f64 {
        l1_weight * self.l1 + dssim_weight * (1.0 - self.ssim)
    }
}

/// Normalised 1D Gaussian taps.
fn taps() -> [f64; WINDOW] {
    let mut w = [0.0; WINDOW];
    for (k, v) in w.iter_mut().enumerate() {
        let d = k as f64 - HALF as f64;
        *v = (-d * d / (2.0 * SIGMA * SIGMA)).exp();
    }
    let sum: f64 = w.iter().sum();
    w.map(|v| v / sum)
}

/// Separable zero-padded blur of one [H, W] plane.
fn blur(plane: &[f64], width: usize, height: usize) -> Vec<f64> {
    let w = taps();
    let mut rows = vec![0.0; plane.len()];
    for y in 0..height {
        for x in 0..width {
            let (lo, hi) = (x.saturating_sub(HALF), (x + HALF).min(width - 1));
            rows[y * width + x] = (lo..=hi).map(|i| w[i + HALF - x] * plane[y * width + i]).sum();
        }
    }
    let mut out = vec![0.0; plane.len()];
    for y in 0..height {
        let (lo, hi) = (y.saturating_sub(HALF), (y + HALF).min(height - 1));
        for x in 0..width {
            out[y * width + x] = (lo..=hi).map(|i| w[i + HALF - y] * rows[i * width + x]).sum();
        }
    }
    out
}

/// CPU reference, in f64: loss terms and gradient of [`ImageLoss::total`] for planar `[C, H, W]`
/// images.
pub fn ssim_l1(
    rendered: &[f64],
    target: &[f64],
    width: usize,
    height: usize,
    l1_weight: f64,
    dssim_weight: f64,
) -> (ImageLoss, Vec<f64>) {
    let weights = vec![1.0; width * height];
    ssim_l1_weighted(rendered, target, &weights, width, height, l1_weight, dssim_weight)
}

/// [`ssim_l1`] with pixel weights `[H, W]`.
pub fn ssim_l1_weighted(
    rendered: &[f64],
    target: &[f64],
    weights: &[f64],
    width: usize,
    height: usize,
    l1_weight: f64,
    dssim_weight: f64,
) -> (ImageLoss, Vec<f64>) {
    let planes = rendered.len() / (width * height);
    let count = weights.iter().sum::<f64>() * planes as f64;
    let mut loss = ImageLoss { l1: 0.0, ssim: 1.0 };
    let mut gradient = Vec::with_capacity(rendered.len());
    for (x, y) in rendered.chunks(width * height).zip(target.chunks(width * height)) {
        let x: Vec<f64> = (0..x.len()).map(|i| y[i] + weights[i] * (x[i] - y[i])).collect();
        let (ssim, d) = ssim_plane(&x, y, width, height);
        loss.ssim -= (x.len() as f64 - ssim) / count;
        for i in 0..x.len() {
            let difference = x[i] - y[i];
            loss.l1 += difference.abs() / count;
            // f64::signum(0) is 1; the subgradient at 0 must be 0.
            let sign = if difference == 0.0 { 0.0 } else { difference.signum() };
            gradient.push(weights[i] * (l1_weight * sign - dssim_weight * d[i]) / count);
        }
    }
    (loss, gradient)
}

/// Sum of SSIM over one plane and its derivative with respect to x.
fn ssim_plane(x: &[f64], y: &[f64], width: usize, height: usize) -> (f64, Vec<f64>) {
    let product = |f: &dyn Fn(usize) -> f64| blur(&(0..x.len()).map(f).collect::<Vec<_>>(), width, height);
    let (mx, my) = (blur(x, width, height), blur(y, width, height));
    let squares = product(&|i| x[i] * x[i] + y[i] * y[i]);
    let cross = product(&|i| x[i] * y[i]);
    let (mut d_mean, mut d_square, mut d_cross) =
        (vec![0.0; x.len()], vec![0.0; x.len()], vec![0.0; x.len()]);
    let mut sum = 0.0;
    for i in 0..x.len() {
        let a1 = 2.0 * mx[i] * my[i] + C1;
        let a2 = 2.0 * (cross[i] - mx[i] * my[i]) + C2;
        let b1 = mx[i] * mx[i] + my[i] * my[i] + C1;
        let b2 = squares[i] - mx[i] * mx[i] - my[i] * my[i] + C2;
        let s = a1 * a2 / (b1 * b2);
        sum += s;
        d_mean[i] = 2.0 * my[i] * (a2 - a1) / (b1 * b2) - 2.0 * mx[i] * s / b1 + 2.0 * mx[i] * s / b2;
        d_square[i] = -s / b2;
        d_cross[i] = 2.0 * a1 / (b1 * b2);
    }
    let (p, q, r) =
        (blur(&d_mean, width, height), blur(&d_square, width, height), blur(&d_cross, width, height));
    (sum, (0..x.len()).map(|i| p[i] + 2.0 * x[i] * q[i] + y[i] * r[i]).collect())
}

/// Outputs per thread in the shaders.
const STRIP: usize = shared::STRIP as usize;
/// Colour channels.
const CHANNELS: usize = 3;

/// Kernel that blurs rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SsimRowKernel {
    /// A strip of a row per thread, in registers, for CPU devices.
    Strips,
    /// A span of a row per workgroup, in shared memory, for GPUs.
    Shared,
}

impl SsimRowKernel {
    /// The faster kernel for the device, unless it is disabled.
    pub fn of(device: &Device) -> SsimRowKernel {
        match VariantPair::SSIM_ROWS.chosen(device.info()) {
            KernelVariant::SsimStrips => SsimRowKernel::Strips,
            _ => SsimRowKernel::Shared,
        }
    }
}

/// GPU pass: scratch memory that all views and their bands share.
pub struct SsimL1 {
    rows: SsimRowKernel,
    means: Buffer<f32>,
    moments: Buffer<f32>,
    slopes: Buffer<f32>,
    cross: Buffer<f32>,
    /// Sums of SSIM, and from `first_l1` on those of |x − y|.
    sums: Buffer<f32>,
    first_l1: usize,
}

impl SsimL1 {
    /// Allocates for RGB images in any of these bands, with the fastest row kernel of the device.
    pub fn new(device: &Device, bands: &[Bands]) -> Result<Self> {
        Self::with(device, bands, SsimRowKernel::of(device))
    }

    /// [`SsimL1::new`] with a given row kernel.
    pub fn with(device: &Device, bands: &[Bands], rows: SsimRowKernel) -> Result<Self> {
        let most = |count: fn(&Bands) -> usize| bands.iter().map(count).max().unwrap_or(0);
        let values = most(|b| CHANNELS * b.pixels());
        let first_l1 = most(ssim_sums);
        let pairs = |name| device.buffer::<f32>(name, 2 * values);
        Ok(SsimL1 {
            rows,
            means: pairs("ssim means")?,
            moments: pairs("ssim moments")?,
            slopes: pairs("ssim slopes")?,
            cross: device.buffer::<f32>("ssim cross slopes", values)?,
            sums: device.buffer::<f32>("loss sums of strips", first_l1 + most(l1_sums))?,
            first_l1,
        })
    }

    /// Records the pass for one of `bands`. `rendered` and `gradient` are planar `[≥3, rows, W]`,
    /// RGB first; `target` is `[3, rows, W]`. With `covered`, the sum of the pixel weights of the
    /// whole image, `target` is `[4, rows, W]`, the last plane the weights. Writes Σ|x−y| of the
    /// band to slot `slot` of `loss` ([`sum`]) and, unless its weight is 0, ΣSSIM to the next one:
    /// see [`ImageLoss::of`]. `weights` are those of L1 and 1 − SSIM.
    pub fn record(
        &self,
        rec: &mut Recorder,
        (bands, band): (&Bands, &Band),
        rendered: &Buffer<f32>,
        target: &Buffer<f32>,
        gradient: &Buffer<f32>,
        covered: Option<f64>,
        weights: [f64; 2],
        loss: (&Buffer<f32>, u32),
    ) {
        let with_ssim = weights[1] != 0.0;
        rec.pass(if with_ssim { "SSIM + L1" } else { "L1" });
        let (width, height) = (bands.width as i32, bands.rows as i32);
        let (first, end) = ((band.inner.start - band.top) as i32, (band.inner.end - band.top) as i32);
        let (count, weighted) = (values(bands, covered), i32::from(covered.is_some()));
        let strips = |n: usize| n.div_ceil(STRIP) as u32;
        let columns = [(width as u32).div_ceil(64), strips(bands.rows), CHANNELS as u32];
        if with_ssim {
            let call = shaders::ssim_columns::call(
                &shaders::ssim_columns::Bindings {
                    rendered,
                    target,
                    means: &self.means,
                    moments: &self.moments,
                },
                &shaders::ssim_columns::Push { width, height, weighted },
            );
            rec.dispatch(call, columns);
            self.record_rows(rec, bands, first, end);
        }
        let call = shaders::ssim_gradient::call(
            shaders::ssim_gradient::Variant { ssim: u32::from(with_ssim) },
            &shaders::ssim_gradient::Bindings {
                rendered,
                target,
                slopes: &self.slopes,
                cross: &self.cross,
                gradient,
                sums: &self.sums,
            },
            &shaders::ssim_gradient::Push {
                width,
                height,
                l1_weight: (weights[0] / count) as f32,
                dssim_weight: (weights[1] / count) as f32,
                first,
                end,
                weighted,
                first_sum: self.first_l1 as i32,
            },
        );
        rec.dispatch(call, columns);
        let (l1, ssim) = (self.first_l1..self.first_l1 + l1_sums(bands), 0..ssim_sums(bands));
        sum::record(rec, &self.sums, (l1, with_ssim.then_some(ssim)), loss);
    }

    fn record_rows(&self, rec: &mut Recorder, bands: &Bands, first: i32, end: i32) {
        let (width, height) = (bands.width as u32, bands.rows as u32);
        let strips = width.div_ceil(STRIP as u32);
        let (means, moments, slopes) = (&self.means, &self.moments, &self.slopes);
        let (cross, sums) = (&self.cross, &self.sums);
        let (w, h, n) = (width as i32, height as i32, strips as i32);
        match self.rows {
            SsimRowKernel::Strips => {
                use shaders::ssim_rows::{Bindings, Push, call};
                let call = call(
                    &Bindings { means, moments, slopes, cross, sums },
                    &Push { width: w, height: h, strips: n, first, end },
                );
                rec.dispatch_threads(call, [strips, height, CHANNELS as u32]);
            }
            SsimRowKernel::Shared => {
                use shaders::ssim_rows_shared::{Bindings, Push, SPAN, call};
                let call = call(
                    &Bindings { means, moments, slopes, cross, sums },
                    &Push { width: w, height: h, strips: n, first, end },
                );
                rec.dispatch(call, [width.div_ceil(SPAN as u32), height, CHANNELS as u32]);
            }
        }
    }
}

impl ImageLoss {
    /// Loss terms of an image from the two sums of [`SsimL1::record`], added up over its bands.
    pub fn of(bands: &Bands, sums: [f64; 2], covered: Option<f64>) -> ImageLoss {
        let (all, count) = (values(bands, None), values(bands, covered));
        ImageLoss { l1: sums[0] / count, ssim: 1.0 - (all - sums[1]) / count }
    }
}

/// Number of values of a mean.
fn values(bands: &Bands, covered: Option<f64>) -> f64 {
    let pixels = covered.unwrap_or((bands.width * bands.height) as f64);
    CHANNELS as f64 * pixels
}

/// Sums of SSIM that the row kernels write.
fn ssim_sums(bands: &Bands) -> usize {
    CHANNELS * bands.rows * bands.width.div_ceil(STRIP)
}

/// Sums of |x − y| that the gradient kernel writes.
fn l1_sums(bands: &Bands) -> usize {
    CHANNELS * bands.width * bands.rows.div_ceil(STRIP)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reproducible pseudo-random number in [0, 1).
    fn noise(i: usize) -> f64 {
        let mut z = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        ((z ^ (z >> 27)) >> 11) as f64 / (1u64 << 53) as f64
    }

    #[test]
    fn shader_taps_match_reference() {
        for (own, shader) in taps().iter().zip(shared::WINDOW) {
            assert!((own - shader).abs() < 1e-8, "{own} {shader}");
        }
    }

    #[test]
    fn ssim_of_equal_images_is_one() {
        let x: Vec<f64> = (0..3 * 20 * 17).map(noise).collect();
        let (loss, gradient) = ssim_l1(&x, &x, 20, 17, 0.8, 0.2);
        assert!((loss.ssim - 1.0).abs() < 1e-12 && loss.l1 == 0.0);
        assert!(gradient.iter().all(|g| g.abs() < 1e-14));
    }

    #[test]
    fn gradient_matches_central_differences() {
        let (w, h) = (23, 19);
        let mut x: Vec<f64> = (0..3 * w * h).map(noise).collect();
        let y: Vec<f64> = (0..3 * w * h).map(|i| 0.7 * noise(i) + 0.3 * noise(i + 7777)).collect();
        let (_, gradient) = ssim_l1(&x, &y, w, h, 0.8, 0.2);
        let step = 1e-6;
        let mut worst: f64 = 0.0;
        let scale = gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
        for i in (0..x.len()).step_by(53) {
            let keep = x[i];
            let mut loss_at = |v: f64| {
                x[i] = v;
                ssim_l1(&x, &y, w, h, 0.8, 0.2).0.total(0.8, 0.2)
            };
            let difference = (loss_at(keep + step) - loss_at(keep - step)) / (2.0 * step);
            x[i] = keep;
            worst = worst.max((difference - gradient[i]).abs() / scale);
        }
        assert!(worst < 1e-6, "relative error {worst:.1e}");
    }

    #[test]
    fn weighted_gradient_matches_central_differences() {
        let (w, h) = (23, 19);
        let mut x: Vec<f64> = (0..3 * w * h).map(noise).collect();
        let y: Vec<f64> = (0..3 * w * h).map(|i| noise(i + 7777)).collect();
        let weights: Vec<f64> = (0..w * h).map(|i| [0.0, 1.0, 0.4][(i % w / 5 + i / w / 4) % 3]).collect();
        let loss = |x: &[f64]| ssim_l1_weighted(x, &y, &weights, w, h, 0.8, 0.2);
        let (_, gradient) = loss(&x);
        let scale = gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
        for i in (0..x.len()).step_by(37) {
            let (keep, step) = (x[i], 1e-6);
            let mut loss_at = |v: f64| {
                x[i] = v;
                loss(&x).0.total(0.8, 0.2)
            };
            let difference = (loss_at(keep + step) - loss_at(keep - step)) / (2.0 * step);
            x[i] = keep;
            assert!((difference - gradient[i]).abs() < 1e-6 * scale, "{i}: {difference} {}", gradient[i]);
            assert!(weights[i % (w * h)] > 0.0 || gradient[i] == 0.0, "a pixel without weight moves");
        }
        // Rendered pixels of weight 0 do not change the loss.
        let before = loss(&x);
        (0..x.len()).filter(|i| weights[i % (w * h)] == 0.0).for_each(|i| x[i] = 9.0);
        assert_eq!(loss(&x), before);
    }

    #[test]
    fn ssim_at_odd_sizes_matches_reference() {
        let device = crate::gpu::test_device();
        // Neither side is a multiple of a strip or workgroup; the second is smaller than one strip
        // and window.
        let sizes = [(75, 53), (13, 7), (130, 33)];
        let cases = sizes.into_iter().flat_map(|s| [(s, SsimRowKernel::Strips), (s, SsimRowKernel::Shared)]);
        for ((w, h), rows, weighted) in cases.flat_map(|(s, r)| [(s, r, false), (s, r, true)]) {
            let x: Vec<f32> = (0..3 * w * h).map(|i| noise(i) as f32).collect();
            let y: Vec<f32> =
                (0..3 * w * h).map(|i| (0.7 * noise(i) + 0.3 * noise(i + 7777)) as f32).collect();
            let wide = |v: &[f32]| v.iter().map(|&a| f64::from(a)).collect::<Vec<_>>();
            let weight =
                |i: usize| if weighted { [0.0f32, 1.0, 0.25][(i % w / 4 + i / w / 3) % 3] } else { 1.0 };
            let weights: Vec<f32> = (0..w * h).map(weight).collect();
            let (expected, gradient) =
                ssim_l1_weighted(&wide(&x), &wide(&y), &wide(&weights), w, h, 0.8, 0.2);
            let covered = weighted.then(|| wide(&weights).iter().sum::<f64>());
            let bands = Bands::whole(w, h);
            // Room for larger images, with the sums of one.
            let pass = SsimL1::with(&device, &[bands.clone(), Bands::whole(w + 30, h + 20)], rows).unwrap();
            pass.sums.write(&vec![1.0; (pass.sums.bytes() / 4) as usize]).unwrap();
            let rendered = device.buffer_from("x", &x).unwrap();
            let stack = if weighted { [&y[..], &weights].concat() } else { y.clone() };
            let target = device.buffer_from("y", &stack).unwrap();
            let out = device.buffer::<f32>("gradient", 3 * w * h).unwrap();
            let sums = device.buffer::<f32>("loss", 3 * sum::PARTIALS).unwrap();
            let mut rec = Recorder::new(&device, "ssim");
            let band = (&bands, &bands.get(0));
            pass.record(&mut rec, band, &rendered, &target, &out, covered, [0.8, 0.2], (&sums, 1));
            rec.run().unwrap();
            let sums = sums.read().unwrap();
            let loss = ImageLoss::of(&bands, [1, 2].map(|slot| sum::total(&sums, slot)), covered);
            // f32 sums of about 10⁴ values of order one: 1e-5.
            assert!(
                (loss.l1 - expected.l1).abs() < 1e-5 && (loss.ssim - expected.ssim).abs() < 1e-5,
                "{rows:?}"
            );
            let scale = gradient.iter().fold(0.0f64, |m, g| m.max(g.abs()));
            for (g, e) in out.read().unwrap().into_iter().zip(gradient) {
                // E[x²]−E[x]² cancels about three digits in f32, amplified by 1/C2 in flat regions.
                assert!((f64::from(g) - e).abs() < 1e-3 * scale, "{w}x{h} {rows:?}: {g} {e}");
            }
        }
    }
}
