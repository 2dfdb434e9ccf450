//! Pairwise pointmaps to cameras and dense points (docs/method.md#pointmaps): what networks such as MASt3R, DUSt3R and
//! VGGT predict for pairs of photos is brought to one scale, one set of cameras and one set of depth maps.
//!
//! Positions are continuous pixels of the network's input ("model pixels"); the centre of the first pixel is 0.5.
mod adjust;
mod canonical;
mod cholesky;
mod dense;
mod matches;
mod pairs;
mod tree;

use super::Geometry;
use crate::photo::Affine;
use crate::progress::Progress;
use crate::scene::{Camera, Pose, RgbImage};
use crate::{Error, Result};
use adjust::Adjustment;
use glam::{DVec2, DVec3};
pub(crate) use matches::best_descriptors;
pub use matches::{descriptor_matches, point_matches};
use pairs::Edge;

/// One view as the network saw it.
#[derive(Clone, Debug)]
pub struct ModelView {
    /// Name of the photo, for cameras and messages.
    pub name: String,
    /// Working-resolution photo: output size and colours.
    pub image: RgbImage,
    /// Width of the network's input.
    pub width: usize,
    /// Height of the network's input.
    pub height: usize,
    /// Working pixels → model pixels.
    pub from_working: Affine,
    /// Focal length from EXIF in model pixels.
    pub exif_focal: Option<f64>,
    /// Photos of one camera and size share this number.
    pub camera_group: usize,
}

/// A point and a confidence (≥ 1) per pixel.
#[derive(Clone, Debug, Default)]
pub struct Pointmap {
    /// [H, W] points; OpenCV axes of the camera that the pair names.
    pub points: Vec<[f32; 3]>,
    /// [H, W] confidence ≥ 1.
    pub confidence: Vec<f32>,
}

/// Dense descriptors of one image.
#[derive(Clone, Debug, Default)]
pub struct Descriptors {
    /// Descriptor length.
    pub dim: usize,
    /// [H, W, dim] unit vectors.
    pub data: Vec<f32>,
    /// [H, W] descriptor confidence ≥ 0.
    pub confidence: Vec<f32>,
}

/// What a network says about a pair of views, decoded in both directions. The two directions, and different pairs, may
/// have different scales.
#[derive(Clone, Debug, Default)]
pub struct PairPointmaps {
    /// Index of the first view.
    pub first: usize,
    /// Index of the second view.
    pub second: usize,
    /// First view's pixels in the first camera.
    pub x11: Pointmap,
    /// Second view's pixels in the first camera.
    pub x21: Pointmap,
    /// Second view's pixels in the second camera.
    pub x22: Pointmap,
    /// First view's pixels in the second camera.
    pub x12: Pointmap,
    /// Descriptors D11, D21 (first decoding) and D12, D22 (second decoding), if the network has them.
    pub descriptors: Option<[Descriptors; 4]>,
}

/// Matched pixels of a pair: (position in the first, position in the second, weight > 0).
#[derive(Clone, Debug, Default)]
pub struct PairMatches {
    /// Model pixels.
    pub matches: Vec<(DVec2, DVec2, f64)>,
}

/// Steps A–G.
pub fn reconstruct(
    views: &[ModelView],
    pairs: &[PairPointmaps],
    progress: &dyn Progress,
) -> Result<Geometry> {
    check(views, pairs)?;
    let mut matches = Vec::with_capacity(pairs.len());
    for pair in pairs {
        progress.check()?;
        matches.push(matches::of_pair(&views[pair.first], &views[pair.second], pair));
    }
    align(views, pairs, &matches, progress)
}

/// Steps B–G for given matches, one list per pair.
pub fn align(
    views: &[ModelView],
    pairs: &[PairPointmaps],
    matches: &[PairMatches],
    progress: &dyn Progress,
) -> Result<Geometry> {
    check(views, pairs)?;
    let canonical = canonical::all(views, pairs);
    let focals = canonical::focals(views, &canonical);
    let edges: Vec<Edge> = pairs
        .iter()
        .zip(matches)
        .filter_map(|(pair, m)| pairs::edge(views, pair, &m.matches, &canonical, &focals))
        .collect();
    let start = tree::place(views.len(), &edges).map_err(|left| apart(views, &edges, &left))?;
    progress.check()?;
    let mut adjustment = Adjustment::new(views, &canonical, &focals, &start, pairs, matches);
    adjustment.solve(progress)?;
    // A pair that disagrees with all others by more than 5 px at 512 is wrong as a whole.
    if adjustment.drop_wrong_pairs(5.0 / 512.0) {
        adjustment.solve(progress)?;
    }
    adjustment.normalise();
    parallax(views, &adjustment)?;
    progress.check()?;
    Ok(dense::output(views, &canonical, &adjustment))
}

fn check(views: &[ModelView], pairs: &[PairPointmaps]) -> Result<()> {
    if views.len() < 2 {
        return Err(Error::input("pointmaps need at least two photos"));
    }
    for p in pairs {
        if p.first == p.second || p.first.max(p.second) >= views.len() {
            return Err(Error::input(format!(
                "pointmaps of views {} and {}: no such pair",
                p.first, p.second
            )));
        }
        for (map, view) in [(&p.x11, p.first), (&p.x21, p.second), (&p.x22, p.second), (&p.x12, p.first)] {
            let size = views[view].width * views[view].height;
            if map.points.len() != size || map.confidence.len() != size {
                return Err(Error::input(format!(
                    "pointmap of {} has {} points, its input has {} × {} pixels: wrong model output",
                    views[view].name,
                    map.points.len(),
                    views[view].width,
                    views[view].height
                )));
            }
        }
    }
    Ok(())
}

/// Names the pairs that hold the views together, and those that are missing.
fn apart(views: &[ModelView], edges: &[Edge], left: &[usize]) -> Error {
    let bad: Vec<String> = left
        .iter()
        .flat_map(|l| (0..views.len()).filter(move |v| !left.contains(v)).map(move |v| (*l, v)))
        .filter(|(a, b)| {
            !edges.iter().any(|e| [e.first, e.second] == [*a, *b] || [e.second, e.first] == [*a, *b])
        })
        .map(|(a, b)| format!("{}–{}", views[b].name, views[a].name))
        .collect();
    Error::input(format!(
        "photos do not overlap enough: no consistent geometry for {}; take photos that share at least half of what they show",
        bad.join(", ")
    ))
}

/// Below 0.5 % of the depth the baseline is within the error of the pointmaps: the camera only turned.
const MIN_BASELINE: f64 = 0.005;

fn parallax(views: &[ModelView], adjustment: &Adjustment) -> Result<()> {
    let poses = &adjustment.state.poses;
    let mut widest = 0.0f64;
    for i in 0..poses.len() {
        for j in 0..i {
            widest = widest.max((poses[i].centre() - poses[j].centre()).length());
        }
    }
    // The median depth is 1 after normalisation.
    if widest < MIN_BASELINE {
        let names: Vec<&str> = views.iter().map(|v| v.name.as_str()).collect();
        return Err(Error::input(format!(
            "no parallax between {}: the camera only turned or the photos are identical; take them from different positions",
            names.join(", ")
        )));
    }
    Ok(())
}

/// Principal point of a model image: its centre.
fn centre(view: &ModelView) -> DVec2 {
    DVec2::new(view.width as f64, view.height as f64) * 0.5
}

/// Camera of the working-resolution photo.
fn working_camera(view: &ModelView, focal: f64, pose: &Pose) -> Camera {
    let c = centre(view);
    let model = Camera {
        name: view.name.clone(),
        width: view.width as u32,
        height: view.height as u32,
        fx: focal,
        fy: focal,
        cx: c.x,
        cy: c.y,
        pose: *pose,
    };
    view.from_working.inverse().camera(&model, (view.image.width as u32, view.image.height as u32))
}

fn point(p: [f32; 3]) -> DVec3 {
    DVec3::new(p[0] as f64, p[1] as f64, p[2] as f64)
}

#[cfg(test)]
mod tests;
