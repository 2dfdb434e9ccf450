//! Dense multi-view stereo with known cameras: slanted plane sweep, propagation, consistency
//! checks, filling, and fusion into points.
mod colours;
mod faces;
mod fill;
mod fuse;
mod matcher;
mod options;
mod planes;
mod prior;
mod regions;
mod sky;
mod surface;
#[cfg(test)]
mod tests;
mod texture;
mod views;
mod void;

pub use matcher::{MAX_SOURCES, Matcher, PLANE_BYTES, PlaneSweep, ReferenceView, SourceView, binding};
pub use options::StereoOptions;
pub use views::{Level, pyramid};

use crate::Result;
use crate::progress::Progress;
use crate::scene::{Camera, Coverage, DepthMap, DepthPrior, Image, PointCloud, RgbImage};
use glam::{DVec3, Vec4};
use rayon::prelude::*;

/// Result of dense stereo.
#[derive(Clone, Debug, Default)]
pub struct Dense {
    /// One per photo, at its size. Complete except at white borders and unused pixels.
    pub depths: Vec<DepthMap>,
    /// Fused points.
    pub points: PointCloud,
    /// Share of the pixels of each photo that was taken for sky and lies far behind everything.
    pub sky: Vec<f32>,
}

/// Depth maps and fused points of photos with `cameras` at their working resolutions. Depth is
/// complete except at white borders and unused pixels. `sparse` are points of the scene in world
/// coordinates: they set the range of depth and choose the source views. `sweep` computes the
/// matching. Deterministic for a given device, seed and input.
///
/// Confidence: 0.9 with two or more agreeing views, 0.6 with one, below 0.3 for filled depth.
pub fn dense(
    sweep: &dyn PlaneSweep,
    images: &[RgbImage],
    coverage: &[Option<Coverage>],
    cameras: &[Camera],
    sparse: &[DVec3],
    priors: &[Option<DepthPrior>],
    options: &StereoOptions,
    progress: &dyn Progress,
) -> Result<Dense> {
    let options = &StereoOptions { binding: sweep.binding(), ..options.clone() };
    let levels = pyramid(images, cameras, sparse, options)?;
    let finest = &levels[levels.len() - 1];
    // The segmentation needs no depth, so it runs while the device matches.
    let (planes, segments) = std::thread::scope(|scope| {
        let segments = scope.spawn(|| PhotoSegments::new(finest, coverage, sparse));
        let planes = run_schedule(&levels, options, progress, |level, start| {
            sweep.matcher(&level.luma, &level.references, &level.sources, &start)
        });
        // A panic of the other thread continues in this one.
        (planes, segments.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    });
    let planes = planes?;
    progress.check()?;
    Ok(finish(images, coverage, finest, &segments, &planes, priors, options, progress))
}

/// Areas of the photos at one resolution, found without depth.
pub struct PhotoSegments {
    /// Pixels that are neither matched nor filled.
    void: Vec<bool>,
    /// Sky, which is not matched.
    sky: sky::Sky,
    /// Pixels of weak texture.
    weak: Vec<bool>,
    /// Areas of even colour, per view.
    areas: Vec<regions::Segmentation>,
}

impl PhotoSegments {
    /// Segments all views of a level; `coverage` has an entry per view or none. `sparse` are points
    /// of the scene in world coordinates.
    pub fn new(level: &Level, coverage: &[Option<Coverage>], sparse: &[DVec3]) -> PhotoSegments {
        let weak = texture::weak(level);
        let areas = regions::segment(level, &weak);
        let void = void::unused(level, coverage);
        PhotoSegments { sky: sky::Sky::find(level, sparse, &void), void, weak, areas }
    }
}

/// Planes (π, cost) of all views at the finest resolution; `matcher` makes a level's matcher.
pub fn run_schedule<M: Matcher>(
    levels: &[Level],
    options: &StereoOptions,
    progress: &dyn Progress,
    matcher: impl Fn(&Level, Vec<Vec4>) -> Result<M>,
) -> Result<Vec<Vec4>> {
    let work = |index: usize| {
        let (photometric, geometric) = rounds(options, levels.len(), index);
        ((photometric + geometric) as u64) * levels[index].pixels() as u64 / 1000
    };
    progress.begin("dense stereo", (0..levels.len()).map(work).sum());
    let (mut done, mut seed) = (0, options.seed);
    let mut planes: Vec<Vec4> = Vec::new();
    for (index, level) in levels.iter().enumerate() {
        let start = match index {
            0 => vec![Vec4::ZERO; level.pixels()],
            _ => level.enlarged(&levels[index - 1], &planes),
        };
        let mut matcher = matcher(level, start)?;
        if index == 0 {
            for reference in &level.references {
                matcher.sweep(&ReferenceView { seed, planes: options.planes, ..*reference })?;
            }
        }
        let (photometric, geometric) = rounds(options, levels.len(), index);
        for round in 0..photometric + geometric {
            let geometric = if round < photometric { 0.0 } else { options.geometric };
            for reference in &level.references {
                for parity in 0..2 {
                    progress.check()?;
                    seed = seed.wrapping_add(1);
                    let smoothness = options.smoothness;
                    matcher.refine(&ReferenceView { parity, geometric, smoothness, seed, ..*reference })?;
                }
            }
            done += level.pixels() as u64 / 1000;
            progress.step(done, &format!("{} × {}", level.references[0].width, level.references[0].height));
        }
        planes = matcher.planes()?;
    }
    progress.end();
    Ok(planes)
}

/// Photometric and geometric rounds of level `index` of `levels`.
fn rounds(options: &StereoOptions, levels: usize, index: usize) -> (u32, u32) {
    let photometric = if index == 0 { options.coarse_rounds } else { 0 };
    // Small photos have fewer levels: they skip the first entries, those of the coarsest.
    let skipped = options.rounds.len().saturating_sub(levels);
    (photometric, options.rounds.get(index + skipped).copied().unwrap_or(1))
}

/// Depth maps and points from matched planes.
pub fn finish(
    images: &[RgbImage],
    coverage: &[Option<Coverage>],
    level: &Level,
    segments: &PhotoSegments,
    matched: &[Vec4],
    priors: &[Option<DepthPrior>],
    options: &StereoOptions,
    progress: &dyn Progress,
) -> Dense {
    progress.begin("surfaces", SURFACE_STEPS);
    let PhotoSegments { void, sky, weak, areas } = segments;
    let poses = surface::RelativePoses::new(level);
    let no_match: Vec<bool> = void.iter().zip(&sky.pixels).map(|(void, sky)| *void || *sky).collect();
    let consistent = surface::consistent_surface(level, &poses, matched, &no_match, weak);
    progress.step(1, "planes");
    let fitted = surface::smoothed(level, &consistent, FIT_RADIUS);
    let (large, inferred) = rayon::join(
        || planes::large_planes(level, &fitted, options.seed),
        || {
            let trimmed = fill::without_depth_edges(level, &fitted, depth_edge_radius(level));
            progress.step(2, "regions");
            regions::fill(level, &poses, &trimmed, &no_match, areas, options.seed)
        },
    );
    let fused = prior::fuse_priors(level, &poses, &inferred, priors, options.seed, progress);
    progress.step(3, "filling");
    let complete = fill::fill(level, &poses, &fused, &large, &no_match);
    let complete = match faces::faces(level, &poses, &fused, &complete, &large, options.seed) {
        Some(with_faces) => fill::fill(level, &poses, &with_faces, &large, &no_match),
        None => complete,
    };
    // Not before: filling would carry the sky into pixels of the ground that match nowhere.
    let complete = sky.added_to(level, complete);
    progress.step(4, "points");
    let points = fuse::fuse(level, &poses, &complete, &sky.pixels);
    let mut depths: Vec<DepthMap> =
        images.par_iter().enumerate().map(|(view, image)| depth_map(level, &complete, view, image)).collect();
    for (depth, coverage) in depths.iter_mut().zip(coverage) {
        coverage.iter().for_each(|c| depth.keep(|i| c.uses(i)));
    }
    progress.step(SURFACE_STEPS, "");
    progress.end();
    Dense { depths, points, sky: sky.shares(level) }
}

/// Steps of the progress bar: consistency, planes, regions, filling, points.
const SURFACE_STEPS: u64 = 5;

/// Radius of the plane fit, pixels: averages the matching noise of one window over 11 × 11.
const FIT_RADIUS: i32 = 5;
/// Pixels on either side of a depth step that can be wrong: at least half the matching window.
/// Large photos inherit wider errors from coarser levels where texture is weak (breakfast at
/// 640 × 480: 7 leaves 0.5 % fewer pixels wrong than 4).
fn depth_edge_radius(level: &Level) -> usize {
    (level.references.iter().map(|r| r.width.max(r.height)).max().unwrap_or(0) as usize / 90).max(4)
}

/// Depth and confidence of one view at its photo's resolution; π is evaluated at each of its
/// pixels.
fn depth_map(level: &Level, surface: &surface::Surface, view: usize, image: &RgbImage) -> DepthMap {
    let r = &level.references[view];
    let scale = (image.width / r.width as usize).max(1);
    let mut out = DepthMap {
        depth: Image::filled(image.width, image.height, 0.0),
        confidence: Image::filled(image.width, image.height, 0.0),
    };
    let [fx, fy, cx, cy] = r.intrinsics;
    for y in 0..image.height {
        for x in 0..image.width {
            let (lx, ly) = ((x / scale).min(r.width as usize - 1), (y / scale).min(r.height as usize - 1));
            let k = r.first as usize + ly * r.width as usize + lx;
            let (u, v) = ((x as f32 + 0.5) / scale as f32, (y as f32 + 0.5) / scale as f32);
            let inverse = surface.planes[k].dot(glam::Vec3::new((u - cx) / fx, (v - cy) / fy, 1.0));
            if surface.confidence[k] > 0.0 && inverse > 0.0 {
                out.depth.data[y * image.width + x] = 1.0 / inverse;
                out.confidence.data[y * image.width + x] = surface.confidence[k];
            }
        }
    }
    out
}
