//! Raw splat parameters in GPU memory.
use super::frame::PROJECTED_FLOATS;
use crate::gpu::{Buffer, Device, DeviceInfo};
use crate::scene::{Splats, sh_coefficients};
use crate::{Error, Result};

/// Raw parameters of N splats, or gradients by them, on the GPU.
#[derive(Clone)]
pub struct SplatBuffers {
    /// N. Buffers may be longer; only the first N splats are used.
    pub count: usize,
    /// Degree of the stored coefficients, 0–3.
    pub sh_degree: u32,
    /// d.
    pub feature_dim: usize,
    /// As [`Splats::antialiased`].
    pub antialiased: bool,
    /// [N, 3] f32, world units.
    pub means: Buffer<f32>,
    /// [N, 3] f32, natural logs.
    pub log_scales: Buffer<f32>,
    /// [N, 4] f32 (w, x, y, z), not necessarily normalised.
    pub quats: Buffer<f32>,
    /// [N] f32.
    pub opacity_logits: Buffer<f32>,
    /// [N, (sh_degree+1)², 3] f32, DC first, RGB interleaved.
    pub sh: Buffer<f32>,
    /// [N, d] f32 raw features (a single unused float when d = 0).
    pub features: Buffer<f32>,
}

impl SplatBuffers {
    /// Copies splats and their features [N, d] to the GPU (`features` empty and d = 0 for none).
    ///
    /// # Errors
    /// Where the lengths of the arrays do not agree.
    pub fn upload(
        device: &Device,
        splats: &Splats,
        features: &[f32],
        feature_dim: usize,
    ) -> Result<SplatBuffers> {
        let n = splats.len();
        let lengths = [splats.log_scales.len(), splats.quats.len(), splats.opacity_logits.len()];
        if lengths.iter().any(|&l| l != n) || splats.sh.len() != n * 3 * splats.sh_len() {
            return Err(Error::work(format!("splats with {n} means have other arrays of different lengths")));
        }
        if features.len() != n * feature_dim {
            let given = features.len();
            return Err(Error::work(format!("{given} feature values do not make {n} × {feature_dim}")));
        }
        let most = most_splats(device.info(), splats.sh_degree, feature_dim);
        if n > most {
            return Err(too_many(device.info(), n, most));
        }
        let mut out = SplatBuffers::zeros(device, "splats", n, splats.sh_degree, feature_dim)?;
        out.antialiased = splats.antialiased;
        if n > 0 {
            out.means.write(splats.means.as_flattened())?;
            out.log_scales.write(splats.log_scales.as_flattened())?;
            out.quats.write(splats.quats.as_flattened())?;
            out.opacity_logits.write(&splats.opacity_logits)?;
            out.sh.write(&splats.sh)?;
        }
        if !features.is_empty() {
            out.features.write(features)?;
        }
        Ok(out)
    }

    /// Allocates zero-filled buffers for `count` splats; `label` begins their names.
    pub fn zeros(
        device: &Device,
        label: &str,
        count: usize,
        sh_degree: u32,
        feature_dim: usize,
    ) -> Result<SplatBuffers> {
        let zeros =
            |name: &str, floats: usize| device.buffer::<f32>(&format!("{label} {name}"), floats.max(4));
        Ok(SplatBuffers {
            count,
            sh_degree,
            feature_dim,
            antialiased: false,
            means: zeros("means", 3 * count)?,
            log_scales: zeros("log_scales", 3 * count)?,
            quats: zeros("quats", 4 * count)?,
            opacity_logits: zeros("opacity_logits", count)?,
            sh: zeros("sh", 3 * count * sh_coefficients(sh_degree))?,
            features: zeros("features", count * feature_dim)?,
        })
    }

    /// Allocates zero-filled buffers of the same shape, for gradients.
    pub fn zeros_like(&self, device: &Device) -> Result<SplatBuffers> {
        SplatBuffers::zeros(device, "gradient", self.count, self.sh_degree, self.feature_dim)
    }

    /// SH coefficients per channel.
    pub fn sh_len(&self) -> usize {
        sh_coefficients(self.sh_degree)
    }

    /// Copies splats and features [N, d] to the host.
    pub fn download(&self) -> Result<(Splats, Vec<f32>)> {
        let n = self.count;
        let floats = |b: &Buffer<f32>, len: usize| b.read_range(0..len);
        let splats = Splats {
            means: triples(&floats(&self.means, 3 * n)?),
            log_scales: triples(&floats(&self.log_scales, 3 * n)?),
            quats: floats(&self.quats, 4 * n)?.chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]).collect(),
            opacity_logits: floats(&self.opacity_logits, n)?,
            sh_degree: self.sh_degree,
            sh: floats(&self.sh, 3 * n * self.sh_len())?,
            antialiased: self.antialiased,
        };
        Ok((splats, floats(&self.features, n * self.feature_dim)?))
    }
}

/// Most splats of this SH degree, with d features, that a device renders: its largest buffer over
/// the widest of a splat's rows, the projected splat among them.
pub fn most_splats(device: &DeviceInfo, sh_degree: u32, feature_dim: usize) -> usize {
    let widest = PROJECTED_FLOATS.max(3 * sh_coefficients(sh_degree)).max(feature_dim.next_multiple_of(4));
    (device.max_buffer / (4 * widest as u64)) as usize
}

fn too_many(device: &DeviceInfo, splats: usize, most: usize) -> Error {
    Error::input(format!(
        "{splats} splats are more than the {most} that {} renders, whose buffers have at most {} MiB: splatvk view shows \
         those that cover most, another --device may hold more",
        device.name,
        device.max_buffer >> 20
    ))
}

fn triples(values: &[f32]) -> Vec<[f32; 3]> {
    values.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::{Options, TestDevice, options};
    use crate::scene::seeded;

    #[test]
    fn too_many_splats_are_refused_with_their_limit() {
        let device = TestDevice::open(&Options { max_binding: Some(48 * 100), ..options(None) }).unwrap();
        let upload = |count: usize| {
            let (splats, _) = seeded::small(count, 40, 30, 0, 1);
            SplatBuffers::upload(&device, &splats, &[], 0).map(|_| ())
        };
        upload(100).unwrap();
        let e = upload(101).unwrap_err();
        assert_eq!(e.exit_code(), 2);
        assert!(e.to_string().starts_with("101 splats are more than the 100 that "), "{e}");
    }
}
