//! Pixel correspondences between two views: from dense matches
//! (docs/internals/method.md#pixel-matching) and from depth and poses
//! (docs/internals/method.md#reprojection).
use crate::scene::{Camera, DenseWarp, DepthMap, Image};
use glam::DVec2;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// No correspondence.
const NONE: u32 = u32::MAX;

/// Certainty of RoMa above which a match is accepted (docs/internals/method.md#pixel-matching).
const MIN_CERTAINTY: f32 = 0.35;

/// Tolerance of relative depth differences in the occlusion test and the round trip
/// (docs/internals/method.md#reprojection).
const DEPTH_TOLERANCE: f64 = 0.05;

/// Largest ratio of the four neighbouring depths that are interpolated as one surface
/// (docs/internals/method.md#reprojection).
const SAME_SURFACE: f32 = 1.06;

/// Corresponding pixels of one view in another.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Links {
    /// [H·W] pixel index in the other view, `u32::MAX` = none.
    target: Vec<u32>,
    /// [H·W] pixels that the other view could see; all true for dense matches.
    visible: Vec<bool>,
}

impl Links {
    /// Pixel of the other view that source pixel `p` corresponds to.
    pub(crate) fn target(&self, p: usize) -> Option<usize> {
        match self.target.get(p) {
            Some(&q) if q != NONE => Some(q as usize),
            _ => None,
        }
    }
    /// Whether the other view could see source pixel `p`.
    pub(super) fn visible(&self, p: usize) -> bool {
        self.visible.get(p).copied().unwrap_or(false)
    }
    /// Number of correspondences.
    pub fn count(&self) -> usize {
        self.target.iter().filter(|&&q| q != NONE).count()
    }
}

/// Correspondences of one unordered pair of views, both ways.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct PairLinks {
    /// First view.
    pub i: usize,
    /// Second view.
    pub j: usize,
    /// i → j.
    pub forward: Links,
    /// j → i.
    pub backward: Links,
}

impl PairLinks {
    /// Exchanges the two views.
    pub fn swapped(self) -> Self {
        PairLinks { i: self.j, j: self.i, forward: self.backward, backward: self.forward }
    }
}

/// Links of two views from one camera: equal pixels, where `same` is true.
pub fn links_from_overlay(i: usize, j: usize, same: &[bool]) -> PairLinks {
    let target = same.iter().zip(0..).map(|(s, p)| if *s { p } else { NONE }).collect();
    let links = Links { target, visible: same.to_vec() };
    PairLinks { i, j, forward: links.clone(), backward: links }
}

/// Step 1: keeps certain matches inside the other view whose forward-backward error is below
/// `max(2, 0.004·width)` pixels.
pub fn links_from_warps(i: usize, j: usize, forward: &DenseWarp, backward: &DenseWarp) -> PairLinks {
    PairLinks {
        i,
        j,
        forward: consistent_links(forward, backward),
        backward: consistent_links(backward, forward),
    }
}

/// Links of the certain matches whose forward-backward error is small.
fn consistent_links(warp: &DenseWarp, back: &DenseWarp) -> Links {
    let (width, other) = (warp.target.width, &back.target);
    let tolerance = (0.004 * width as f32).max(2.0);
    let target = (0..warp.target.data.len()).into_par_iter().map(|p| {
        let q = warp.target.data[p];
        if warp.certainty.data[p] <= MIN_CERTAINTY {
            return NONE;
        }
        let Some(index) = pixel_index(q, other.width, other.height) else { return NONE };
        let home = [(p % width) as f32 + 0.5, (p / width) as f32 + 0.5];
        let r = return_position(other, q);
        let error = ((r[0] - home[0]).powi(2) + (r[1] - home[1]).powi(2)).sqrt();
        if back.certainty.data[index] > 0.0 && error < tolerance { index as u32 } else { NONE }
    });
    let target: Vec<u32> = target.collect();
    Links { visible: vec![true; target.len()], target }
}

/// Index of the pixel that a position falls into.
fn pixel_index(q: [f32; 2], width: usize, height: usize) -> Option<usize> {
    let inside = q[0] >= 0.0 && q[1] >= 0.0 && q[0] < width as f32 && q[1] < height as f32;
    inside.then(|| q[1] as usize * width + q[0] as usize)
}

/// Position to which `map` returns `q`: the value of q's pixel, shifted by q's offset from the
/// pixel centre. Unlike interpolation, this first-order step with the identity Jacobian does not
/// blur discontinuities.
fn return_position(map: &Image<[f32; 2]>, q: [f32; 2]) -> [f32; 2] {
    let (x, y) = (q[0] as usize, q[1] as usize);
    let v = map.at(x.min(map.width - 1), y.min(map.height - 1));
    [v[0] + (q[0] - x as f32 - 0.5), v[1] + (q[1] - y as f32 - 0.5)]
}

/// Step 3: reprojects every pixel with known depth and keeps it if the other view shows the same
/// surface there and the forward-backward error is below `1.5·width/512` pixels.
pub fn links_from_depth(
    i: usize,
    j: usize,
    cameras: (&Camera, &Camera),
    depths: (&DepthMap, &DepthMap),
) -> PairLinks {
    PairLinks {
        i,
        j,
        forward: reproject(cameras.0, depths.0, cameras.1, depths.1),
        backward: reproject(cameras.1, depths.1, cameras.0, depths.0),
    }
}

fn reproject(from: &Camera, depth: &DepthMap, to: &Camera, other: &DepthMap) -> Links {
    let width = depth.depth.width;
    // 1.5 px on the 512-pixel grid that the tolerance was chosen on
    let tolerance = 1.5 * width as f64 / 512.0;
    let back = from.pose.compose(&to.pose.inverse());
    let rows: Vec<(u32, bool)> = (0..depth.depth.data.len())
        .into_par_iter()
        .map(|p| {
            let z = depth.depth.data[p] as f64;
            if z <= 0.0 || depth.confidence.data[p] <= 0.0 {
                return (NONE, false);
            }
            let home = DVec2::new((p % width) as f64 + 0.5, (p / width) as f64 + 0.5);
            let (q, zq) = to.project(from.unproject(home, z));
            let position = [q.x as f32, q.y as f32];
            let Some(index) =
                pixel_index(position, other.depth.width, other.depth.height).filter(|_| zq > 0.0)
            else {
                return (NONE, false);
            };
            let d = surface_depth(&other.depth, position, index);
            if d <= 0.0 {
                return (NONE, true);
            }
            // an occluded pixel cannot have a match and must not lower the coverage
            let hidden = d < zq * (1.0 - DEPTH_TOLERANCE);
            let returned = back.transform(to.ray(q) * d);
            let u = DVec2::new(
                from.fx * returned.x / returned.z + from.cx,
                from.fy * returned.y / returned.z + from.cy,
            );
            let same = (zq - d).abs() / d < DEPTH_TOLERANCE
                && (u - home).length() < tolerance
                && (returned.z - z).abs() / z < DEPTH_TOLERANCE;
            (if same { index as u32 } else { NONE }, !hidden)
        })
        .collect();
    Links { target: rows.iter().map(|r| r.0).collect(), visible: rows.iter().map(|r| r.1).collect() }
}

/// Depth at a position: bilinear on one surface, else nearest; ≤ 0 when unknown.
fn surface_depth(depth: &Image<f32>, q: [f32; 2], index: usize) -> f64 {
    let nearest = depth.data[index] as f64;
    let (fx, fy) = (q[0] - 0.5, q[1] - 0.5);
    if fx < 0.0 || fy < 0.0 || fx as usize + 1 >= depth.width || fy as usize + 1 >= depth.height {
        return nearest;
    }
    let (x, y) = (fx as usize, fy as usize);
    let v = [depth.at(x, y), depth.at(x + 1, y), depth.at(x, y + 1), depth.at(x + 1, y + 1)];
    let (low, high) = v.iter().fold((f32::MAX, 0.0f32), |(l, h), &d| (l.min(d), h.max(d)));
    if low <= 0.0 || high > SAME_SURFACE * low {
        return nearest;
    }
    let (a, b) = ((fx - x as f32) as f64, (fy - y as f32) as f64);
    let v = v.map(|d| d as f64);
    (v[0] * (1.0 - a) + v[1] * a) * (1.0 - b) + (v[2] * (1.0 - a) + v[3] * a) * b
}
