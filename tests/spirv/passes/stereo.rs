//! Plane sweep and refinement.
use glam::Vec4;
use splatvk::gpu::Device;
use splatvk::pass::plane_sweep::{GpuMatcher, Matcher, ReferenceView, SourceView};
use splatvk::pass::plane_sweep_cpu::CpuMatcher;

const SIZE: [u32; 2] = [22, 14];
const FOCAL: f32 = 20.0;
/// Distance of the two cameras along x; the wall is at depth 2.
const BASE: f32 = 0.3;

/// The other view, from a camera that lies `offset` beside it.
fn source(offset: f32, first: u32) -> SourceView {
    let (cx, cy) = (SIZE[0] as f32 / 2.0, SIZE[1] as f32 / 2.0);
    let rows = |t: f32| [[FOCAL, 0.0, cx, FOCAL * t], [0.0, FOCAL, cy, 0.0], [0.0, 0.0, 1.0, 0.0]];
    SourceView {
        forward: rows(-offset),
        back: rows(offset),
        centre: [offset, 0.0, 0.0, 0.0],
        intrinsics: [FOCAL, FOCAL, cx, cy],
        size: [SIZE[0], SIZE[1], first, 0],
    }
}

pub fn plane_sweep(device: &Device) {
    let pixels = (SIZE[0] * SIZE[1]) as usize;
    let view = |shift: f32| {
        (0..pixels).map(move |k| shade((k as u32 % SIZE[0]) as f32 + shift, (k as u32 / SIZE[0]) as f32))
    };
    let luma: Vec<f32> = view(0.0).chain(view(FOCAL * BASE / 2.0)).collect();
    let references = [reference(0), reference(1)];
    let sources = vec![source(BASE, pixels as u32), source(-BASE, 0)];
    let start = vec![Vec4::ZERO; 2 * pixels];
    let mut gpu = GpuMatcher::new(device, &luma, &references, &sources, &start).unwrap();
    let mut cpu = CpuMatcher::new(luma.clone(), sources.clone(), start);
    for r in &references {
        gpu.sweep(r).unwrap();
        cpu.sweep(r).unwrap();
    }
    let swept = cpu.planes().unwrap();
    compare(&gpu.planes().unwrap(), &swept);
    for (geometric, smoothness, parity) in [(0.0, 0.0, 0), (0.1, 0.1, 1)] {
        let mut gpu = GpuMatcher::new(device, &luma, &references, &sources, &swept).unwrap();
        let mut cpu = CpuMatcher::new(luma.clone(), sources.clone(), swept.clone());
        let r = ReferenceView { seed: 9, geometric, smoothness, parity, ..references[1] };
        gpu.refine(&r).unwrap();
        cpu.refine(&r).unwrap();
        let refined = cpu.planes().unwrap();
        assert!(refined != swept, "refinement changed nothing");
        compare(&gpu.planes().unwrap(), &refined);
    }
}

fn reference(k: u32) -> ReferenceView {
    ReferenceView {
        intrinsics: [FOCAL, FOCAL, SIZE[0] as f32 / 2.0, SIZE[1] as f32 / 2.0],
        range: [0.2, 1.0],
        seed: 5,
        width: SIZE[0],
        height: SIZE[1],
        first: k * SIZE[0] * SIZE[1],
        first_source: k,
        sources: 1,
        planes: 6,
        ..ReferenceView::default()
    }
}

/// Luma of the wall, quantised as by the shaders.
fn shade(x: f32, y: f32) -> f32 {
    let wave = 0.25 * (0.9 * x + 0.2 * y).sin() + 0.2 * (0.5 * x - 0.8 * y).cos();
    ((0.5 + wave) * 65535.0).round() / 65535.0
}

/// Bound of src/pass/stereo_tests.rs: near ties may resolve either way.
fn compare(a: &[Vec4], b: &[Vec4]) {
    let same: Vec<usize> = (0..a.len())
        .filter(|&k| (a[k].truncate() - b[k].truncate()).length() < 1e-4 * a[k].truncate().length())
        .collect();
    let worst = same.iter().map(|&k| (a[k].w - b[k].w).abs()).fold(0.0, f32::max);
    assert!(same.len() * 1000 > a.len() * 985, "only {} of {} planes agree", same.len(), a.len());
    assert!(worst < 2e-3, "costs differ by {worst}");
}
