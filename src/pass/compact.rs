//! Pruning and compaction: chooses the splats to keep and moves their rows of parameters and
//! optimiser state together.
use super::adam::rows_of_threads;
use crate::Result;
use crate::gpu::{Buffer, Device, Recorder, shaders};
use bytemuck::Pod;

/// Indices of the splats whose opacity is finite and at least `min_opacity`, in order.
pub fn kept(opacity_logits: &[f32], min_opacity: f32) -> Vec<u32> {
    let limit = (min_opacity / (1.0 - min_opacity)).ln();
    (0..opacity_logits.len() as u32)
        .filter(|&i| {
            let logit = opacity_logits[i as usize];
            logit.is_finite() && logit >= limit
        })
        .collect()
}

/// Copies the rows `index` of `from`, each `stride` elements of 32 bits, to a new buffer.
pub fn gather<T: Pod>(
    device: &Device,
    name: &'static str,
    from: &Buffer<T>,
    index: &Buffer<u32>,
    rows: usize,
    stride: usize,
) -> Result<Buffer<T>> {
    const { assert!(size_of::<T>() == 4) };
    let to = device.buffer::<u32>(name, (rows * stride).max(1))?;
    let mut rec = Recorder::new(device, "gather");
    let call = shaders::gather::call(
        &shaders::gather::Bindings { index, from: &from.cast(), to: &to },
        &shaders::gather::Push { rows: rows as u32, stride: stride as u32 },
    );
    rec.dispatch(call, rows_of_threads(rows * stride));
    rec.run()?;
    Ok(to.cast())
}

/// CPU reference of [`gather`].
pub fn gather_rows<T: Copy>(from: &[T], index: &[u32], stride: usize) -> Vec<T> {
    index.iter().flat_map(|&i| &from[i as usize * stride..][..stride]).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Random;

    #[test]
    fn gather_matches_reference() {
        let device = crate::gpu::test_device();
        let mut random = Random::new(11);
        let logits: Vec<f32> = (0..1003).map(|_| random.normal() as f32 * 4.0).collect();
        let mut index = kept(&logits, 0.1);
        assert!(index.len() > 100 && index.len() < 900);
        index.extend([5, 5]);
        let index_buffer = device.buffer_from("index", &index).unwrap();
        for stride in [1, 3, 8] {
            let rows: Vec<f32> = (0..1003 * stride).map(|_| random.normal() as f32).collect();
            let from = device.buffer_from("rows", &rows).unwrap();
            let to = gather(&device, "compacted", &from, &index_buffer, index.len(), stride).unwrap();
            assert_eq!(to.read().unwrap(), gather_rows(&rows, &index, stride));
        }
    }

    /// Workgroups of 256 numbers are dispatched in rows of 32768.
    #[test]
    fn gather_beyond_workgroup_row_is_complete() {
        let device = crate::gpu::test_device();
        let (stride, index) = (1usize << 16, [0u32, 1].repeat(65));
        assert!(rows_of_threads(index.len() * stride)[1] > 1);
        let rows: Vec<u32> = (1..=2 * stride as u32).collect();
        let from = device.buffer_from("rows", &rows).unwrap();
        let index_buffer = device.buffer_from("index", &index).unwrap();
        let to = gather(&device, "compacted", &from, &index_buffer, index.len(), stride).unwrap();
        for (k, i) in index.iter().enumerate() {
            let moved = to.read_range(k * stride..(k + 1) * stride).unwrap();
            assert!(moved == rows[*i as usize * stride..][..stride], "row {k}");
        }
    }

    #[test]
    fn kept_drops_faint_and_broken_splats() {
        let logit = |o: f32| (o / (1.0 - o)).ln();
        assert_eq!(kept(&[logit(0.9), logit(0.004), f32::NAN, logit(0.006), f32::INFINITY], 0.005), [0, 3]);
    }
}
