//! Photo → network input, with the map between their pixels.
use super::adapter::{Filter, Fit, ImageSpec};
use super::graph::GraphFile;
use super::runtime::Input;
use crate::photo::Kernel;
use crate::scene::Affine;
use crate::scene::RgbImage;

/// A photo as a network sees it.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Input width, pixels.
    pub width: usize,
    /// Input height, pixels.
    pub height: usize,
    /// Width of the part that shows the photo; the rest is padding.
    pub filled: [usize; 2],
    /// [3, H, W], normalised.
    pub data: Vec<f32>,
    /// Photo pixels → input pixels.
    pub from_photo: Affine,
}

impl Prepared {
    /// A tensor [1, 3, H, W].
    pub fn input(&self) -> Input {
        Input::F32(vec![1, 3, self.height, self.width], self.data.clone())
    }
}

/// Brings a photo to the size, aspect and range that a graph asks for. `role` is the graph's image input.
pub fn prepare(image: &RgbImage, graph: &GraphFile, spec: &ImageSpec, role: &str) -> Prepared {
    let fixed = graph.fixed(role, "W").zip(graph.fixed(role, "H"));
    let (from_w, from_h) = (image.width as f64, image.height as f64);
    let round = |n: f64| (n.round_ties_even() as usize).max(1);
    let down = |n: usize| (n / spec.multiple).max(1) * spec.multiple;
    let long = spec.size as f64 / from_w.max(from_h);
    // The photo is resized to `inner`, of which the middle, or all and padding, becomes `outer`.
    let (inner, outer) = match (spec.fit, fixed) {
        (Fit::Squash, fixed) => {
            let outer = fixed.unwrap_or((down(spec.size), down(spec.size)));
            (outer, outer)
        }
        (Fit::Resize, None) => {
            let size = (down(round(from_w * long)), down(round(from_h * long)));
            (size, size)
        }
        (Fit::Resize, Some(size)) => (size, size),
        (Fit::Pad, fixed) => {
            let outer = fixed.unwrap_or((spec.size, spec.size));
            let scale = (outer.0 as f64 / from_w).min(outer.1 as f64 / from_h);
            // Half up, as SAM rounds.
            let size = |n: f64| ((n * scale + 0.5) as usize).max(1);
            ((size(from_w), size(from_h)), outer)
        }
        (Fit::Crop, None) => {
            let inner = (round(from_w * long), round(from_h * long));
            (inner, (down(inner.0), down(inner.1)))
        }
        (Fit::Crop, Some(outer)) => {
            let scale = (outer.0 as f64 / from_w).max(outer.1 as f64 / from_h);
            ((round(from_w * scale).max(outer.0), round(from_h * scale).max(outer.1)), outer)
        }
    };
    let kernel = match (spec.filter, inner.0 < image.width) {
        (Filter::Bilinear, _) => Kernel::Triangle,
        (Filter::Bicubic, _) | (Filter::Lanczos, false) => Kernel::Cubic,
        (Filter::Lanczos, true) => Kernel::Lanczos,
    };
    let small = image.resized(inner.0, inner.1, kernel);
    let cut =
        |inner: usize, outer: usize| (inner / 2).saturating_sub(outer / 2).min(inner.saturating_sub(outer));
    let (x0, y0) = (cut(inner.0, outer.0), cut(inner.1, outer.1));
    let filled = [inner.0.min(outer.0), inner.1.min(outer.1)];
    let mut data = vec![0f32; 3 * outer.0 * outer.1];
    for c in 0..3 {
        for y in 0..filled[1] {
            for x in 0..filled[0] {
                let value = (small.at(x + x0, y + y0)[c] - spec.mean[c]) / spec.std[c];
                data[(c * outer.1 + y) * outer.0 + x] = value;
            }
        }
    }
    let resize = Affine::resize((image.width as u32, image.height as u32), (inner.0 as u32, inner.1 as u32));
    let from_photo = resize.then(&Affine::crop(x0 as f64, y0 as f64));
    Prepared { width: outer.0, height: outer.1, filled, data, from_photo }
}
