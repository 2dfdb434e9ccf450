//! Slanted-plane multi-view matching on the device. The equations are those of the CPU reference,
//! [`super::plane_sweep_cpu`].
use crate::Result;
use crate::gpu::shaders::shared::plane_sweep::VIEW_SHARES;
use crate::gpu::shaders::{plane_sweep, plane_sweep_refine, structs};
use crate::gpu::{Buffer, Device, KernelVariant, Recorder, VariantPair};
use crate::pass::plane_sweep_cpu::CpuMatcher;
use glam::Vec4;
use splatvk_sfm::stereo::PLANE_BYTES;
pub use splatvk_sfm::stereo::{MAX_SOURCES, Matcher, PlaneSweep, ReferenceView, SourceView, binding};

/// The shader mixes [`MAX_SOURCES`] sources.
const _: () = assert!(MAX_SOURCES == VIEW_SHARES.len());

/// Plane sweep of stereo on a device. Where the device is the processor, the host computes it: with
/// vectors over the taps of a window it takes a fraction of the time of the shaders.
pub struct DevicePlaneSweep(Device);

impl DevicePlaneSweep {
    /// Plane sweep on this device.
    pub fn new(device: &Device) -> Self {
        DevicePlaneSweep(device.clone())
    }
}

impl PlaneSweep for DevicePlaneSweep {
    fn binding(&self) -> u64 {
        self.0.info().max_storage_range
    }

    fn matcher(
        &self,
        luma: &[f32],
        references: &[ReferenceView],
        sources: &[SourceView],
        planes: &[Vec4],
    ) -> Result<Box<dyn Matcher>> {
        Ok(match VariantPair::SWEEPS.chosen(self.0.info()) {
            KernelVariant::HostSweep => {
                Box::new(CpuMatcher::new(luma.to_vec(), sources.to_vec(), planes.to_vec()))
            }
            _ => Box::new(GpuMatcher::new(&self.0, luma, references, sources, planes)?),
        })
    }
}

/// Source view in the layout of the shader.
fn to_gpu(view: &SourceView) -> structs::SourceView {
    let SourceView { forward, back, centre, intrinsics, size } = *view;
    structs::SourceView { forward, back, centre, intrinsics, size }
}

/// Matching at one resolution on the device. Where the device does not bind the planes of all views
/// at once, every pass copies those of a reference and its sources into one buffer.
pub struct GpuMatcher {
    device: Device,
    sources: Buffer<structs::SourceView>,
    /// Luma quads that a pass binds: of all views, or of one group.
    quads: Buffer<u32>,
    planes: Buffer<f32>,
    /// Buffers of each view, where views are grouped; else empty.
    views: Vec<ViewBuffers>,
    /// Pixels of all views.
    pixels: usize,
}

/// One view of a grouped matcher.
struct ViewBuffers {
    quads: Buffer<u32>,
    planes: Buffer<f32>,
    /// This view and its sources, by index.
    group: Vec<usize>,
}

impl GpuMatcher {
    /// Uploads `luma` and `planes` (π, cost) of all views, one after the other, at the offsets of
    /// the references.
    pub fn new(
        device: &Device,
        luma: &[f32],
        references: &[ReferenceView],
        sources: &[SourceView],
        planes: &[Vec4],
    ) -> Result<Self> {
        let planes: Vec<[f32; 4]> = planes.iter().map(Vec4::to_array).collect();
        let sources: Vec<structs::SourceView> = sources.iter().map(to_gpu).collect();
        let quads = quads(luma, references);
        let (device, pixels) = (device.clone(), luma.len());
        if (PLANE_BYTES * pixels) as u64 <= device.info().max_storage_range {
            return Ok(GpuMatcher {
                quads: device.buffer_from("stereo quads", quads.as_flattened())?,
                sources: device.buffer_from("stereo sources", &sources)?,
                planes: device.buffer_from("stereo planes", planes.as_flattened())?,
                views: Vec::new(),
                device,
                pixels,
            });
        }
        let (mut views, mut grouped, mut largest) = (Vec::new(), sources, 0);
        for (view, r) in references.iter().enumerate() {
            let (mut group, mut held) = (vec![view], pixels_of(r));
            for source in &mut grouped[r.first_source as usize..(r.first_source + r.sources) as usize] {
                group.extend(references.iter().position(|other| other.first == source.size[2]));
                // Offset of the source's pixels in the group.
                let own = (source.size[0] * source.size[1]) as usize;
                source.size[2] = held as u32;
                held += own;
            }
            largest = largest.max(held);
            let own = r.first as usize..r.first as usize + pixels_of(r);
            views.push(ViewBuffers {
                quads: device.buffer_from("stereo quads", quads[own.clone()].as_flattened())?,
                planes: device.buffer_from("stereo planes", planes[own].as_flattened())?,
                group,
            });
        }
        Ok(GpuMatcher {
            quads: device.buffer::<u32>("stereo quads", 2 * largest)?,
            sources: device.buffer_from("stereo sources", &grouped)?,
            planes: device.buffer::<f32>("stereo planes", 4 * largest)?,
            views,
            device,
            pixels,
        })
    }

    /// Buffers of a reference view; `None` where views are not grouped.
    fn view_of(&self, r: &ReferenceView) -> Option<&ViewBuffers> {
        let mut first = 0;
        self.views.iter().find(|view| {
            let found = first == r.first as usize;
            first += view.planes.len() / 4;
            found
        })
    }

    /// Records one pass: `dispatch` gets the offset of the reference's pixels in the buffers.
    fn record(&self, rec: &mut Recorder, r: &ReferenceView, dispatch: impl FnOnce(&mut Recorder, u32)) {
        let Some(view) = self.view_of(r) else { return dispatch(rec, r.first) };
        let (mut quad, mut plane) = (0, 0);
        for member in view.group.iter().map(|&v| &self.views[v]) {
            rec.copy_bytes(&member.quads, 0, &self.quads, quad, member.quads.bytes());
            rec.copy_bytes(&member.planes, 0, &self.planes, plane, member.planes.bytes());
            quad += member.quads.bytes();
            plane += member.planes.bytes();
        }
        dispatch(rec, 0);
        rec.copy_bytes(&self.planes, 0, &view.planes, 0, view.planes.bytes());
    }
}

fn pixels_of(r: &ReferenceView) -> usize {
    r.width as usize * r.height as usize
}

/// Luma of each pixel and of those to the right, below and diagonally below, 16 bits each.
fn quads(luma: &[f32], references: &[ReferenceView]) -> Vec<[u32; 2]> {
    let word = |a: f32, b: f32| ((b * 65535.0).round() as u32) << 16 | (a * 65535.0).round() as u32;
    let mut out = Vec::with_capacity(luma.len());
    for r in references {
        let (width, height, first) = (r.width as usize, r.height as usize, r.first as usize);
        for y in 0..height {
            let (top, bottom) = (first + y * width, first + (y + 1).min(height - 1) * width);
            for x in 0..width {
                let right = (x + 1).min(width - 1);
                out.push([
                    word(luma[top + x], luma[top + right]),
                    word(luma[bottom + x], luma[bottom + right]),
                ]);
            }
        }
    }
    out
}

macro_rules! push {
    ($shader:ident, $r:expr, $first:expr) => {
        $shader::Push {
            intrinsics: $r.intrinsics,
            range: $r.range,
            geometric: $r.geometric,
            seed: $r.seed,
            width: $r.width,
            height: $r.height,
            first: $first,
            first_source: $r.first_source,
            sources: $r.sources,
            parity: $r.parity,
            planes: $r.planes,
            smoothness: $r.smoothness,
            identity: $r.first,
        }
    };
}

impl Matcher for GpuMatcher {
    fn sweep(&mut self, r: &ReferenceView) -> Result<()> {
        let bindings =
            plane_sweep::Bindings { quads: &self.quads, sources: &self.sources, planes: &self.planes };
        let mut rec = Recorder::new(&self.device, "plane sweep");
        self.record(&mut rec, r, |rec, first| {
            let call = plane_sweep::call(&bindings, &push!(plane_sweep, r, first));
            rec.dispatch_threads(call, [r.width, r.height, 1]);
        });
        Ok(rec.run()?)
    }

    fn refine(&mut self, r: &ReferenceView) -> Result<()> {
        let bindings =
            plane_sweep_refine::Bindings { quads: &self.quads, sources: &self.sources, planes: &self.planes };
        let mut rec = Recorder::new(&self.device, "plane refinement");
        self.record(&mut rec, r, |rec, first| {
            let call = plane_sweep_refine::call(&bindings, &push!(plane_sweep_refine, r, first));
            rec.dispatch_threads(call, [r.width.div_ceil(2), r.height, 1]);
        });
        Ok(rec.run()?)
    }

    fn planes(&self) -> Result<Vec<Vec4>> {
        let mut planes = Vec::with_capacity(self.pixels);
        let whole = [&self.planes];
        let own: Vec<&Buffer<f32>> = self.views.iter().map(|v| &v.planes).collect();
        for buffer in if own.is_empty() { &whole[..] } else { &own[..] } {
            planes.extend(buffer.read()?.chunks_exact(4).map(Vec4::from_slice));
        }
        Ok(planes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::test_device;

    fn waves(width: u32, height: u32, shift: f32) -> Vec<f32> {
        let shade = |x: f32, y: f32| 0.5 + 0.1 * (0.8 * x + 0.3 * y).sin() + 0.08 * (0.5 * x - 0.7 * y).cos();
        let place = |k: u32| ((k % width) as f32 + shift, (k / width) as f32);
        (0..width * height).map(place).map(|(x, y)| shade(x, y)).collect()
    }

    /// Two views of one size; the second is the source of the first.
    fn references(width: u32, height: u32, focal: f32, range: [f32; 2]) -> [ReferenceView; 2] {
        let intrinsics = [focal, focal, width as f32 / 2.0, height as f32 / 2.0];
        let view =
            ReferenceView { intrinsics, range, seed: 5, width, height, planes: 16, ..Default::default() };
        [ReferenceView { sources: 1, ..view }, ReferenceView { first: width * height, ..view }]
    }

    /// The second view, at `centre` in the camera frame of the first, rotated by 0° or 180° about
    /// y.
    fn source(reference: &ReferenceView, centre: [f32; 3], turned: bool) -> SourceView {
        let [fx, fy, cx, cy] = reference.intrinsics;
        let sign = if turned { -1.0 } else { 1.0 };
        let [x, y, z] = [-sign * centre[0], -centre[1], -sign * centre[2]];
        SourceView {
            forward: [
                [sign * fx, 0.0, sign * cx, fx * x + cx * z],
                [0.0, fy, sign * cy, fy * y + cy * z],
                [0.0, 0.0, sign, z],
            ],
            centre: [centre[0], centre[1], centre[2], 0.0],
            intrinsics: reference.intrinsics,
            size: [reference.width, reference.height, reference.width * reference.height, 0],
            ..SourceView::default()
        }
    }

    /// All planes lie at depths below 1.7; none is so oblique that it passes behind a camera at a
    /// depth of 8.
    #[test]
    fn source_behind_plane_has_maximal_cost() {
        let views = references(24, 16, 120.0, [0.6, 1.0]);
        let luma = waves(24, 16, 0.0).repeat(2);
        let costs = |source: SourceView| -> Vec<f32> {
            let start = vec![Vec4::ZERO; luma.len()];
            let mut gpu = GpuMatcher::new(&test_device(), &luma, &views, &[source], &start).unwrap();
            gpu.sweep(&views[0]).unwrap();
            gpu.planes().unwrap()[..24 * 16].iter().map(|p| p.w).collect()
        };
        // The three missing sources make up 0.4 of the cost.
        let same = costs(source(&views[0], [0.0; 3], false));
        assert!(same.iter().all(|w| *w < 0.6), "{same:?}");
        let behind = costs(source(&views[0], [0.0, 0.0, 8.0], true));
        assert!(behind.iter().all(|w| (w - 1.0).abs() < 1e-5), "{behind:?}");
    }

    /// A wall at the inverse depth 1.5, the plane of every second pixel.
    #[test]
    fn propagation_keeps_depth_within_range() {
        let (width, height) = (32, 16);
        let taken = |nearest: f32| {
            let views = references(width, height, 20.0, [0.2, nearest]);
            let luma = [waves(width, height, 0.0), waves(width, height, 6.0)].concat();
            let plane = |k: u32| match (k % width + k / width) % 2 {
                0 => Vec4::new(0.0, 0.0, 0.5, 0.9),
                _ => Vec4::new(0.0, 0.0, 1.5, 0.0),
            };
            let start: Vec<Vec4> = (0..2 * width * height).map(plane).collect();
            let beside = source(&views[0], [0.2, 0.0, 0.0], false);
            let mut gpu = GpuMatcher::new(&test_device(), &luma, &views, &[beside], &start).unwrap();
            gpu.refine(&views[0]).unwrap();
            let planes = gpu.planes().unwrap();
            let inverse_depth = |k: u32| {
                let x = ((k % width) as f32 + 0.5 - 16.0) / 20.0;
                let y = ((k / width) as f32 + 0.5 - 8.0) / 20.0;
                planes[k as usize].dot(Vec4::new(x, y, 1.0, 0.0))
            };
            let updated = (0..width * height).filter(|k| (k % width + k / width) % 2 == 0);
            updated.filter(|k| inverse_depth(*k) > 1.001).count()
        };
        assert_eq!(taken(1.0), 0);
        let all = taken(2.0);
        assert!(all > 150, "{all} of 256");
    }
}
