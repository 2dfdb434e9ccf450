//! `.splat`: 32 bytes per Gaussian, for web viewers. Only the base colour survives.
use super::usable;
use crate::math::quaternion_norm;
use crate::scene::Splats;
use crate::{Error, Result, files};
use std::path::Path;

/// Largest base colour of a byte.
pub const BRIGHTEST: f32 = 1.0;

/// Bytes per Gaussian.
const ROW: usize = 32;

/// Reads a file: SH of degree 0, rotations at byte precision. All of the file is read.
pub fn read_noted(path: &Path, _notes: &mut Vec<String>) -> Result<Splats> {
    let bytes = files::read(path)?;
    if !bytes.len().is_multiple_of(ROW) {
        return Err(Error::input(format!(
            "{}: {} bytes are no whole number of {ROW}-byte Gaussians; not a .splat file, or cut off",
            path.display(),
            bytes.len()
        )));
    }
    let mut s = Splats::with_capacity(bytes.len() / ROW, 0);
    for row in bytes.chunks_exact(ROW) {
        let float =
            |k: usize| f32::from_le_bytes([row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3]]);
        let share = |k: usize| f32::from(row[24 + k]) / 255.0;
        s.means.push([0, 1, 2].map(float));
        s.log_scales.push([3, 4, 5].map(|k| float(k).ln()));
        s.sh.extend([0, 1, 2].map(|k| (share(k) - 0.5) / crate::scene::SH_C0));
        s.opacity_logits.push(crate::format::logit(share(3)));
        s.quats.push([4, 5, 6, 7].map(|k| (f32::from(row[24 + k]) - 128.0) / 128.0));
    }
    Ok(s)
}

/// Writes positions and standard deviations (f32 × 3 each), base colour and opacity (u8 × 4),
/// rotation (w, x, y, z as `128 q + 128`), the most visible splats first, as progressive viewers
/// expect: row r of the file is Gaussian `order[r]` of the scene.
pub fn write_splats(path: &Path, s: &Splats) -> Result<Vec<u32>> {
    usable::check_written(s)?;
    let alpha = |i: usize| crate::math::sigmoid(s.opacity_logits[i]);
    let volume = |i: usize| s.log_scales[i].iter().sum::<f32>().exp();
    let mut order: Vec<(f32, usize)> = (0..s.len()).map(|i| (alpha(i) * volume(i), i)).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut bytes = Vec::with_capacity(32 * s.len());
    for &(_, i) in &order {
        let base = i * s.sh_len() * 3;
        for v in s.means[i].into_iter().chain(s.log_scales[i].map(f32::exp)) {
            bytes.extend_from_slice(&v.to_le_bytes());
        }
        bytes.extend([0, 1, 2].map(|k| crate::format::to_byte(0.5 + crate::scene::SH_C0 * s.sh[base + k])));
        bytes.push(crate::format::to_byte(alpha(i)));
        let q = s.quats[i];
        let norm = quaternion_norm(&q);
        bytes.extend(q.map(|v| (v / norm * 128.0 + 128.0).round().clamp(0.0, 255.0) as u8));
    }
    std::fs::write(path, bytes).map_err(Error::unwritable(path))?;
    Ok(order.into_iter().map(|(_, i)| i as u32).collect())
}
