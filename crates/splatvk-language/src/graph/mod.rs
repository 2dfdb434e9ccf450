//! Built-in masks without a large model: hierarchical merging of superpixels by colour and a
//! learned boundary map; three cuts of the tree are the three levels. Method:
//! `docs/internals/method.md#graph-masks`.
mod levels;
mod options;
mod pixels;
mod tree;

#[cfg(test)]
mod tests;

pub use options::GraphOptions;

use super::ViewMasks;
use crate::scene::{Image, RgbImage};
use crate::{Error, Result};
use options::Cues;

/// Cuts one photo into masks of three levels. `edges` is a boundary probability per pixel, of the
/// photo's size.
pub fn segment(image: &RgbImage, edges: &Image<f32>, options: &GraphOptions) -> Result<ViewMasks> {
    let (width, height) = (image.width, image.height);
    if (edges.width, edges.height) != (width, height) {
        let (w, h) = (edges.width, edges.height);
        return Err(Error::work(format!("graph masks: {width}x{height} image, edges of {w}x{h}")));
    }
    let cues = cues(image, edges, options);
    let tree = tree::build(&cues, options);
    Ok(levels::cut(&tree, &cues, options))
}

fn cues<'a>(image: &RgbImage, edges: &'a Image<f32>, options: &GraphOptions) -> Cues<'a> {
    let (width, height) = (image.width, image.height);
    let lab = pixels::smooth_lab(image, options::SMOOTHING);
    let linear = ((width * height) as f32 / (640.0 * 480.0)).sqrt();
    let weight = |p: usize, q: usize| {
        let colour: f32 = (0..3).map(|c| (lab[p][c] - lab[q][c]).powi(2)).sum::<f32>().sqrt();
        // a learned boundary keeps superpixels from leaking through weak colour edges
        colour + options.superpixel_edge * edges.data[p].max(edges.data[q])
    };
    let min_size = (options.min_superpixel * linear * linear).max(4.0) as u32;
    let (labels, count) =
        crate::photo::superpixels(width, height, options.superpixel_scale * linear, min_size, weight);
    Cues { labels, count, lab, edges }
}
