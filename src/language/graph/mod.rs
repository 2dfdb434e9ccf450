//! Built-in masks without a large model: hierarchical merging of superpixels by colour, texture, a learned boundary map
//! and, where depth is known, depth steps and creases; three cuts of the tree are the three levels.
mod levels;
mod options;
mod pixels;
mod plane;
mod tree;

#[cfg(test)]
mod tests;

pub use options::{GraphOptions, MergeOptions};

use super::ViewMasks;
use crate::scene::{Camera, DepthMap, Plane, RgbImage};
use crate::{Error, Result};
use options::Cues;

/// Cuts one photo into masks of three levels. `edges` is a boundary probability per pixel, `depth` the view's depth with
/// its camera; both are optional and of the photo's size.
pub fn segment(
    image: &RgbImage,
    edges: Option<&Plane<f32>>,
    depth: Option<(&Camera, &DepthMap)>,
    options: &GraphOptions,
) -> Result<ViewMasks> {
    let tree_and_cues = merge_tree(image, edges, depth, options)?;
    Ok(levels::cut(&tree_and_cues.1, &tree_and_cues.0, options))
}

fn merge_tree<'a>(
    image: &RgbImage,
    edges: Option<&'a Plane<f32>>,
    depth: Option<(&'a Camera, &'a DepthMap)>,
    options: &GraphOptions,
) -> Result<(Cues<'a>, tree::Tree)> {
    let (width, height) = (image.width, image.height);
    let sizes = [edges.map(|e| (e.width, e.height)), depth.map(|d| (d.1.depth.width, d.1.depth.height))];
    if sizes.iter().flatten().any(|&s| s != (width, height)) {
        return Err(Error::work(format!("graph masks: {width}x{height} image, cues of {sizes:?}")));
    }
    let lab = pixels::smooth_lab(image, 0.8);
    let linear = ((width * height) as f32 / (640.0 * 480.0)).sqrt();
    let weight = |p: usize, q: usize| {
        let colour: f32 = (0..3).map(|c| (lab[p][c] - lab[q][c]).powi(2)).sum::<f32>().sqrt();
        // a learned boundary keeps superpixels from leaking through weak colour edges
        colour + edges.map_or(0.0, |e| 10.0 * e.data[p].max(e.data[q]))
    };
    let min_size = (options.min_superpixel * linear * linear).max(4.0) as u32;
    let (labels, count) = crate::photo::superpixels(width, height, options.scale * linear, min_size, weight);
    let gradient = pixels::gradient(&lab, width, height);
    let cues =
        Cues { labels, count, lab, gradient, edges, depth: depth.map(|d| d.1), camera: depth.map(|d| d.0) };
    let tree = tree::build(&cues, &options.merge);
    Ok((cues, tree))
}
