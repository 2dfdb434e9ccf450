//! Time per step against its load, over seeded scenes of growing size.
//!
//! The load is the larger of the number of intersections and that of visible splats. On these scenes
//! a larger number of splats has smaller ones, so that intersections grow more slowly than splats,
//! and with them the load than the work per splat: the exponent in splats stands beside it.
use super::measure::Budget;
use super::model::Roofline;
use super::report::{Clock, STEP, Section};
use super::training;
use super::workload::Workload;
use crate::Result;
use crate::gpu::Device;

/// Measures training steps on seeded scenes of these sizes, which differ from `like` only in the
/// number of splats.
pub fn measure(
    device: &Device,
    sizes: &[usize],
    like: &Workload,
    limits: (&Budget, &Roofline),
) -> Result<Section> {
    let (camera, degree) = (&like.camera, like.splats.sh_degree);
    let place = format!("seeded scenes, {} × {}, SH {degree}", camera.width, camera.height);
    let mut section = Section::new("growth", place);
    let mut points: Vec<(usize, f64, f64)> = Vec::new();
    for &n in sizes {
        let workload = Workload::seeded(n, camera.width, camera.height, degree, 0)?;
        let step = training::colour(device, &workload, limits)?;
        let row = step.row(STEP).map(|r| r.ms).unwrap_or_default();
        let pairs = step.value("intersections").unwrap_or(f64::NAN);
        section.time(format!("step, {n} splats"), Clock::Wall, row);
        section.figure(format!("intersections, {n} splats"), pairs, "tile–splat pairs");
        section.figure(format!("step per intersection, {n} splats"), row.median * 1e6 / pairs, "ns");
        let memory = step.value("peak device memory").unwrap_or(f64::NAN);
        section.figure(format!("peak device memory, {n} splats"), memory, "MiB");
        let visible = step.value("visible splats").unwrap_or(f64::NAN);
        section.figure(format!("visible splats, {n} splats"), visible, "");
        points.push((n, pairs.max(visible), row.median));
    }
    // Linear growth with a fixed part has a slope of at most 1 in the logarithms.
    for (a, b) in points.iter().zip(points.iter().skip(1)) {
        let exponent = |growth: f64| (b.2 / a.2).ln() / growth.ln();
        let name = |of: &str| format!("exponent in {of}, {} to {} splats", a.0, b.0);
        section.figure(name("load"), exponent(b.1 / a.1), "");
        section.figure(name("splats"), exponent(b.0 as f64 / a.0 as f64), "");
    }
    Ok(section)
}
