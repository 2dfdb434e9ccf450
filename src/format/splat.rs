//! `.splat`: 32 bytes a Gaussian, for web viewers. Only the base colour survives.
use crate::scene::Splats;
use crate::{Error, Result};
use std::path::Path;

/// Writes positions and standard deviations (f32 × 3 each), base colour and opacity (u8 × 4), rotation
/// (w, x, y, z as `128 q + 128`), the most visible splats first, as progressive viewers expect.
pub fn write_splats(path: &Path, s: &Splats) -> Result<()> {
    let alpha = |i: usize| 1.0 / (1.0 + (-s.opacity_logits[i]).exp());
    let volume = |i: usize| s.log_scales[i].iter().sum::<f32>().exp();
    let mut order: Vec<(f32, usize)> = (0..s.len()).map(|i| (alpha(i) * volume(i), i)).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut bytes = Vec::with_capacity(32 * s.len());
    for (_, i) in order {
        let base = i * s.sh_len() * 3;
        for v in s.means[i].into_iter().chain(s.log_scales[i].map(f32::exp)) {
            bytes.extend_from_slice(&v.to_le_bytes());
        }
        bytes.extend([0, 1, 2].map(|k| super::to_byte(0.5 + super::SH_C0 * s.sh[base + k])));
        bytes.push(super::to_byte(alpha(i)));
        let q = s.quats[i];
        let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
        bytes.extend(q.map(|v| (v / norm * 128.0 + 128.0).round().clamp(0.0, 255.0) as u8));
    }
    std::fs::write(path, bytes).map_err(Error::io(path))
}
