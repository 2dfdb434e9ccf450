//! Time per step against intersections, over seeded scenes of growing size.
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
    let mut per_pair = Vec::new();
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
        per_pair.push((pairs, row.median));
    }
    // Linear growth with a fixed part has a slope of at most 1 in the logarithms.
    for (a, b) in per_pair.iter().zip(per_pair.iter().skip(1)) {
        let exponent = (b.1 / a.1).ln() / (b.0 / a.0).ln();
        let name = format!("exponent, {:.0} to {:.0} intersections", a.0, b.0);
        section.figure(name, exponent, "");
    }
    Ok(section)
}
