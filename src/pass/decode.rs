//! Decoding of rendered features to code indices: `k*(p) = argmax_k F(p)·c_k`, brute force over the
//! codes of a level.
use crate::gpu::shaders::decode::{MIN_FEATURE_SHARE, PIXELS, VOID_ALPHA, WORKGROUP};
use crate::gpu::{Buffer, Device, Recorder, shaders};
use crate::{Error, Result};
use rayon::prelude::*;

/// Code widths of the variants of glsl/decode.comp; other codes are padded with zeros.
const WIDTHS: [usize; 4] = [4, 8, 16, LONGEST_CODE];

/// Longest code that the device decodes.
pub const LONGEST_CODE: usize = 32;

/// Pixels per workgroup.
const PIXELS_PER_GROUP: u32 = WORKGROUP[0] * PIXELS;

/// The codes of one level on the device.
pub struct Codes {
    buffer: Buffer<f32>,
    count: u32,
    dim: u32,
    width: u32,
}

impl Codes {
    /// Uploads `codes`, `[K, dim]`, row-major, unit rows; `dim` is 1 to [`LONGEST_CODE`].
    pub fn upload(device: &Device, codes: &[f32], dim: usize) -> Result<Codes> {
        let Some(&width) = WIDTHS.iter().find(|&&w| w >= dim).filter(|_| dim > 0) else {
            return Err(Error::work(format!(
                "codes have {dim} components, the decoder takes 1 to {LONGEST_CODE}"
            )));
        };
        let mut padded = Vec::with_capacity(codes.len() / dim * width);
        for code in codes.chunks_exact(dim) {
            padded.extend_from_slice(code);
            padded.resize(padded.len() + width - dim, 0.0);
        }
        let buffer = device.buffer_from("codes", &padded)?;
        Ok(Codes { buffer, count: (codes.len() / dim) as u32, dim: dim as u32, width: width as u32 })
    }

    /// Records the decoding of `pixels` pixels. `features` is planar `[planes, pixels]`, with the
    /// level in the planes `first_plane..first_plane + dim`; `transmittance` is `[pixels]`, 1 −
    /// alpha. Writes `decoded`, `[pixels]` of `i32` with −1 where alpha < 0.5, where ‖F‖ < alpha /
    /// 4 and without codes. Reference: [`decode_pixels`].
    pub fn record(
        &self,
        rec: &mut Recorder,
        features: &Buffer<f32>,
        first_plane: u32,
        transmittance: &Buffer<f32>,
        pixels: u32,
        decoded: &Buffer<i32>,
    ) {
        let planes = u64::from(first_plane + self.dim);
        if features.bytes() < planes * u64::from(pixels) * 4 {
            rec.fail(format!("decode: `{}` has fewer than {planes} planes", features.name()));
        }
        rec.dispatch(
            shaders::decode::call(
                shaders::decode::Variant { dim: self.width },
                &shaders::decode::Bindings { features, transmittance, codes: &self.buffer, decoded },
                &shaders::decode::Push { pixels, count: self.count, dim: self.dim, first_plane },
            ),
            [pixels.div_ceil(PIXELS_PER_GROUP), 1, 1],
        );
    }
}

/// CPU reference of [`Codes::record`], in f64: code per pixel of planar `features` `[dim, P]` and
/// `alpha` `[P]`, and its margin `(F·c_1 − F·c_2) / ‖F‖`. Where the margin is within rounding of 0
/// the device may choose the other code.
pub fn decode_pixels(codes: &[f32], dim: usize, features: &[f32], alpha: &[f32]) -> (Vec<i32>, Vec<f64>) {
    let pixels = alpha.len();
    let feature = |p: usize| -> Vec<f64> { (0..dim).map(|c| f64::from(features[c * pixels + p])).collect() };
    (0..pixels).into_par_iter().map(|p| decode_pixel(codes, &feature(p), alpha[p])).unzip()
}

/// Code and margin of one pixel.
fn decode_pixel(codes: &[f32], feature: &[f64], alpha: f32) -> (i32, f64) {
    let norm = feature.iter().map(|f| f * f).sum::<f64>().sqrt();
    let (mut chosen, mut best, mut second) = (-1, f64::NEG_INFINITY, -norm);
    for (k, code) in codes.chunks_exact(feature.len()).enumerate() {
        let score = code.iter().zip(feature).map(|(c, f)| f64::from(*c) * f).sum::<f64>();
        if score > best {
            second = if k == 0 { -norm } else { best };
            (chosen, best) = (k as i32, score);
        } else if k == 1 || score > second {
            second = score;
        }
    }
    let shown = alpha >= VOID_ALPHA as f32 && norm >= MIN_FEATURE_SHARE * f64::from(alpha);
    if !shown || chosen < 0 {
        (if shown { chosen } else { -1 }, 0.0)
    } else {
        (chosen, if norm > 0.0 { (best - second) / norm } else { 0.0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::test_device;

    fn noise(n: usize, mut seed: u64) -> Vec<f32> {
        (0..n)
            .map(|_| {
                // Knuth's MMIX constants.
                seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                (seed >> 40) as f32 / (1u64 << 23) as f32 - 1.0
            })
            .collect()
    }

    fn unit_rows(mut rows: Vec<f32>, dim: usize) -> Vec<f32> {
        for row in rows.chunks_exact_mut(dim) {
            let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt();
            row.iter_mut().for_each(|x| *x /= norm);
        }
        rows
    }

    /// Decodes on the device, with two planes of noise before the features.
    fn on_device(codes: &[f32], dim: usize, features: &[f32], alpha: &[f32]) -> Vec<i32> {
        let device = test_device();
        let planes = [noise(2 * alpha.len(), 99).as_slice(), features].concat();
        let features = device.buffer_from("features", &planes).unwrap();
        let transmittance: Vec<f32> = alpha.iter().map(|a| 1.0 - a).collect();
        let transmittance = device.buffer_from("transmittance", &transmittance).unwrap();
        let decoded = device.buffer::<i32>("decoded", alpha.len()).unwrap();
        let codes = Codes::upload(&device, codes, dim).unwrap();
        let mut rec = Recorder::new(&device, "decode");
        codes.record(&mut rec, &features, 2, &transmittance, alpha.len() as u32, &decoded);
        rec.run().unwrap();
        decoded.read().unwrap()
    }

    #[test]
    fn decode_matches_reference() {
        for (dim, count, pixels) in
            [(3, 50, 700), (4, 2, 256), (5, 1, 1), (8, 20, 257), (16, 100, 300), (20, 7, 64)]
        {
            let codes = unit_rows(noise(count * dim, dim as u64), dim);
            let features = noise(dim * pixels, 7);
            let alpha: Vec<f32> = noise(pixels, 8).iter().map(|a| 0.5 + 0.5 * a).collect();
            let (expected, margin) = decode_pixels(&codes, dim, &features, &alpha);
            let code = on_device(&codes, dim, &features, &alpha);
            for p in 0..pixels {
                // Sums of at most 32 products of numbers below 1 in f32: 32 × 6e-8 × ‖F‖, over ‖F‖,
                // twice.
                let tolerance = 8e-6;
                assert!(code[p] == expected[p] || margin[p] < tolerance, "{dim} {p}");
            }
            assert!(pixels < 64 || code.contains(&-1), "some pixel is transparent");
        }
    }

    #[test]
    fn decode_ties_take_the_lowest_code() {
        let codes = [0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0];
        assert_eq!(on_device(&codes, 2, &[2.0, 0.0, 0.0, 2.0], &[1.0, 1.0]), [1, 0]);
        assert_eq!(on_device(&[], 2, &[2.0, 0.0, 0.0, 2.0], &[1.0, 1.0]), [-1, -1]);
        let (reference, _) = decode_pixels(&[], 2, &[2.0, 0.0, 0.0, 2.0], &[1.0, 1.0]);
        assert_eq!(reference, [-1, -1]);
    }

    #[test]
    fn pixels_without_features_have_no_code() {
        let codes = [1.0, 0.0, 0.0, 1.0];
        // One code; an even mix of both; almost nothing; nothing.
        let (first, second) = ([0.9, 0.45, 0.0, 0.0], [0.0, 0.45, 0.1, 0.0]);
        let features = [first, second].concat();
        let code = on_device(&codes, 2, &features, &[0.9; 4]);
        assert_eq!(code, [0, 0, -1, -1]);
        assert_eq!(decode_pixels(&codes, 2, &features, &[0.9; 4]).0, code);
    }

    #[test]
    fn wide_codes_and_missing_planes_fail() {
        let device = test_device();
        assert!(Codes::upload(&device, &[0.0; 66], 33).is_err());
        let codes = Codes::upload(&device, &[1.0, 0.0], 2).unwrap();
        let one = device.buffer::<f32>("one", 4).unwrap();
        let decoded = device.buffer::<i32>("decoded", 4).unwrap();
        let mut rec = Recorder::new(&device, "decode");
        codes.record(&mut rec, &one, 0, &one, 4, &decoded);
        assert!(rec.run().unwrap_err().to_string().contains("planes"));
    }
}
