//! Input of the matcher: image pyramid, source views and inverse depth range of every view.
use super::StereoOptions;
use super::matcher::{MAX_SOURCES, ReferenceView, SourceView, binding};
use crate::scene::{Camera, RgbImage};
use crate::{Error, Result};
use glam::{DMat3, DVec3, Vec4};
use rayon::prelude::*;

/// All views at one resolution.
#[derive(Clone, Debug)]
pub struct Level {
    /// Cameras at this resolution.
    pub cameras: Vec<Camera>,
    /// Photos at this resolution.
    pub guide: Vec<RgbImage>,
    /// Luma of all views, one after the other.
    pub luma: Vec<f32>,
    /// Source views of all references.
    pub sources: Vec<SourceView>,
    /// One per view; parity, seed and search parameters are set per pass.
    pub references: Vec<ReferenceView>,
    /// Relative depth difference below which two depths of a view agree, one per view.
    pub tolerance: Vec<f32>,
    /// Per view the views whose depth is compared with its own, ascending.
    pub compared: Vec<Vec<usize>>,
}

/// Most views whose depth is compared with that of a view: of those that share most with it.
const COMPARED: usize = 16;

/// Relative difference below which depths agree: several times the matching noise, far below the
/// size of objects.
pub const DEPTH_TOLERANCE: f32 = 0.01;
/// Matching noise, pixels; at small parallax it is a larger depth difference …
pub const REPROJECTION_TOLERANCE: f32 = 1.5;
/// … up to this limit: coarser depth no longer separates surfaces.
const COARSEST_TOLERANCE: f32 = 0.1;

/// Shift of a point's image in `other`, pixels per relative change of its depth in `camera`.
fn parallax(camera: &Camera, other: &Camera, point: DVec3) -> f64 {
    let along = other.pose.rotation * (point - camera.pose.centre());
    let p = other.pose.transform(point);
    let du = other.fx * (along.x * p.z - p.x * along.z) / (p.z * p.z);
    let dv = other.fy * (along.y * p.z - p.y * along.z) / (p.z * p.z);
    du.hypot(dv)
}

/// [`Level::tolerance`] of a view: for the median point, in its source with the largest parallax.
fn tolerance(view: usize, cameras: &[Camera], chosen: &[usize], sparse: &[DVec3]) -> f32 {
    let best_parallax = |p: &DVec3| {
        let sources = chosen.iter().filter(|&&s| in_image(&cameras[s], *p));
        sources.map(|&s| parallax(&cameras[view], &cameras[s], *p)).reduce(f64::max)
    };
    let mut all: Vec<f64> =
        sparse.iter().filter(|p| in_image(&cameras[view], **p)).filter_map(best_parallax).collect();
    let typical = crate::math::median(&mut all).unwrap_or(f64::INFINITY);
    (REPROJECTION_TOLERANCE / typical as f32).clamp(DEPTH_TOLERANCE, COARSEST_TOLERANCE)
}

/// Least shorter side of a level, pixels: below, the matching window covers whole objects.
const SMALLEST_SIDE: usize = 100;

/// Levels of the image pyramid, coarsest first: at most `options.rounds.len()`.
pub fn pyramid(
    images: &[RgbImage],
    cameras: &[Camera],
    sparse: &[DVec3],
    options: &StereoOptions,
) -> Result<Vec<Level>> {
    if images.len() < 2 || images.len() != cameras.len() {
        return Err(Error::work(format!(
            "dense stereo needs at least two photos and one camera each, got {} photos and {} cameras",
            images.len(),
            cameras.len()
        )));
    }
    let ranges: Vec<[f64; 2]> =
        cameras.iter().map(|c| inverse_depth_range(c, sparse)).collect::<Result<_>>()?;
    let mut compared: Vec<Vec<usize>> =
        (0..cameras.len()).into_par_iter().map(|view| neighbours(view, cameras, sparse)).collect();
    let sources = options.sources.clamp(1, MAX_SOURCES);
    let chosen: Vec<Vec<usize>> =
        compared.iter().map(|all| all.iter().copied().take(sources).collect()).collect();
    compared.iter_mut().for_each(|all| all.sort_unstable());
    let compared = &compared;
    let tolerance: Vec<f32> = (0..cameras.len()).map(|v| tolerance(v, cameras, &chosen[v], sparse)).collect();
    let mut guide = images.to_vec();
    while bound_bytes(&guide, &chosen) as u64 > options.binding {
        guide = guide.iter().map(halved).collect();
    }
    let mut levels = vec![level(&guide, cameras, &chosen, compared, &ranges, &tolerance)];
    while levels.len() < options.rounds.len().max(1) {
        if guide.iter().any(|l| l.width.min(l.height) / 2 < SMALLEST_SIDE) {
            break;
        }
        guide = guide.iter().map(halved).collect();
        levels.push(level(&guide, cameras, &chosen, compared, &ranges, &tolerance));
    }
    levels.reverse();
    Ok(levels)
}

/// Bytes of the largest binding for matching.
fn bound_bytes(guide: &[RgbImage], chosen: &[Vec<usize>]) -> usize {
    let pixels = |view: usize| guide[view].data.len();
    let groups =
        (0..guide.len()).map(|view| pixels(view) + chosen[view].iter().map(|&s| pixels(s)).sum::<usize>());
    binding((0..guide.len()).map(pixels).sum(), groups)
}

/// Range of inverse depth of a view: 1st and 99th percentile of depth of the sparse points in its
/// image, widened to 0.6 of the nearest and twice the farthest because sparse points miss extremes.
fn inverse_depth_range(camera: &Camera, sparse: &[DVec3]) -> Result<[f64; 2]> {
    let mut depths: Vec<f64> = sparse
        .iter()
        .filter_map(|&p| {
            let (pixel, z) = camera.project(p);
            let inside = pixel.x >= 0.0
                && pixel.y >= 0.0
                && pixel.x < camera.width as f64
                && pixel.y < camera.height as f64;
            (z > 0.0 && inside).then_some(z)
        })
        .collect();
    if depths.is_empty() {
        return Err(Error::work(format!(
            "no reconstructed point is seen by {}: cannot search its depth",
            camera.name
        )));
    }
    depths.sort_by(f64::total_cmp);
    let quantile = |share: f64| depths[((depths.len() - 1) as f64 * share) as usize];
    Ok([1.0 / (2.0 * quantile(0.99)), 1.0 / (0.6 * quantile(0.01))])
}

/// True if a point projects into a camera's image.
pub fn in_image(camera: &Camera, p: DVec3) -> bool {
    let (pixel, z) = camera.project(p);
    let (w, h) = (camera.width as f64, camera.height as f64);
    z > 0.0 && pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < w && pixel.y < h
}

/// Up to [`COMPARED`] source views of a view, best first: many shared points at angles of 5–60°
/// (optimum 20°, as in COLMAP's and MVSNet's view selection; smaller angles have no parallax, larger
/// ones no common appearance).
fn neighbours(view: usize, cameras: &[Camera], sparse: &[DVec3]) -> Vec<usize> {
    let here = cameras[view].pose.centre();
    let mut scores: Vec<(f64, usize)> = (0..cameras.len())
        .filter(|&other| other != view)
        .map(|other| {
            let there = cameras[other].pose.centre();
            let score = sparse
                .iter()
                .filter(|&&p| in_image(&cameras[view], p) && in_image(&cameras[other], p))
                .map(|&p| {
                    let angle = (here - p).angle_between(there - p).to_degrees();
                    let width = if angle < 20.0 { 8.0 } else { 25.0 };
                    (-0.5 * ((angle - 20.0) / width).powi(2)).exp()
                });
            (score.sum(), other)
        })
        .collect();
    scores.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    scores.into_iter().take(COMPARED).map(|(_, other)| other).collect()
}

/// Half the size, 2 × 2 means; an odd last row or column is dropped.
pub fn halved(image: &RgbImage) -> RgbImage {
    let (width, height) = (image.width / 2, image.height / 2);
    let mut data = Vec::with_capacity(width * height);
    for y in 0..height {
        for x in 0..width {
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| image.at(2 * x + i, 2 * y + j));
            data.push([0, 1, 2].map(|c| four.iter().map(|p| p[c]).sum::<f32>() / 4.0));
        }
    }
    RgbImage { width, height, data }
}

fn level(
    guide: &[RgbImage],
    cameras: &[Camera],
    chosen: &[Vec<usize>],
    compared: &[Vec<usize>],
    ranges: &[[f64; 2]],
    tolerance: &[f32],
) -> Level {
    // `halved` keeps the origin of the pixel grid and drops odd borders: the scale is a power of
    // two, not a size ratio.
    let cameras: Vec<Camera> = guide
        .iter()
        .zip(cameras)
        .map(|(l, c)| {
            let scale = (c.width as f64 / l.width as f64).round().max(1.0);
            Camera {
                width: l.width as u32,
                height: l.height as u32,
                fx: c.fx / scale,
                fy: c.fy / scale,
                cx: c.cx / scale,
                cy: c.cy / scale,
                ..c.clone()
            }
        })
        .collect();
    let mut first = vec![0u32];
    for l in guide {
        first.push(first[first.len() - 1] + l.data.len() as u32);
    }
    let mut sources = Vec::new();
    let mut references = Vec::new();
    for (view, camera) in cameras.iter().enumerate() {
        references.push(ReferenceView {
            intrinsics: [camera.fx, camera.fy, camera.cx, camera.cy].map(|v| v as f32),
            range: ranges[view].map(|v| v as f32),
            width: camera.width,
            height: camera.height,
            first: first[view],
            first_source: sources.len() as u32,
            sources: chosen[view].len() as u32,
            ..ReferenceView::default()
        });
        sources.extend(chosen[view].iter().map(|&other| source_view(camera, &cameras[other], first[other])));
    }
    let luma = guide.iter().flat_map(|g| g.luma().data).map(rounded_to_16_bits).collect();
    Level {
        cameras,
        guide: guide.to_vec(),
        luma,
        sources,
        references,
        tolerance: tolerance.to_vec(),
        compared: compared.to_vec(),
    }
}

/// Rounds as the shaders' 16-bit input, so that the CPU reference computes the same.
fn rounded_to_16_bits(luma: f32) -> f32 {
    (luma.clamp(0.0, 1.0) * 65535.0).round() / 65535.0
}

/// Rows of K [R | t].
fn projection_rows(camera: &Camera, rotation: DMat3, translation: DVec3) -> [[f32; 4]; 3] {
    let k = DMat3::from_cols(
        DVec3::new(camera.fx, 0.0, 0.0),
        DVec3::new(0.0, camera.fy, 0.0),
        DVec3::new(camera.cx, camera.cy, 1.0),
    );
    let (m, t) = (k * rotation, k * translation);
    [0, 1, 2].map(|i| m.row(i).extend(t[i]).as_vec4().to_array())
}

fn source_view(reference: &Camera, other: &Camera, first: u32) -> SourceView {
    // Reference frame → source frame.
    let relative = other.pose.compose(&reference.pose.inverse());
    let inverse = relative.inverse();
    SourceView {
        forward: projection_rows(other, relative.rotation, relative.translation),
        back: projection_rows(reference, inverse.rotation, inverse.translation),
        centre: inverse.translation.extend(0.0).as_vec4().to_array(),
        intrinsics: [other.fx, other.fy, other.cx, other.cy].map(|v| v as f32),
        size: [other.width, other.height, first, 0],
    }
}

impl Level {
    /// Views whose depth is compared with that of a view.
    pub(super) fn neighbours(&self, view: usize) -> impl Iterator<Item = usize> + '_ {
        self.compared[view].iter().copied()
    }

    /// Pixels of all views together.
    pub fn pixels(&self) -> usize {
        self.luma.len()
    }

    /// Planes of the next coarser level copied to this one: π is independent of resolution.
    pub fn enlarged(&self, coarse: &Level, planes: &[Vec4]) -> Vec<Vec4> {
        let mut out = Vec::with_capacity(self.pixels());
        for (fine, coarse) in self.references.iter().zip(&coarse.references) {
            for y in 0..fine.height {
                for x in 0..fine.width {
                    let (cx, cy) = ((x / 2).min(coarse.width - 1), (y / 2).min(coarse.height - 1));
                    out.push(planes[(coarse.first + cy * coarse.width + cx) as usize]);
                }
            }
        }
        out
    }
}
