//! Preprocesses photos to network inputs, with the map between their pixels.
use super::adapter::{Filter, Fit, ImageSpec};
use super::graph::GraphFile;
use super::runtime::Input;
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::resize::Kernel;
use crate::scene::{Affine, ModelView, RgbImage};
use crate::{Error, Result};

/// A photo as network input.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Input width, pixels.
    pub width: usize,
    /// Input height, pixels.
    pub height: usize,
    /// Width and height of the part that shows the photo; the rest is padding.
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

/// Converts a photo to the size, aspect and range of a graph. `role` is the graph's image input.
pub fn prepare(image: &RgbImage, graph: &GraphFile, spec: &ImageSpec, role: &str) -> Prepared {
    let fixed = graph.fixed(role, "W").zip(graph.fixed(role, "H"));
    let (from_w, from_h) = (image.width as f64, image.height as f64);
    let round = |n: f64| (n.round_ties_even() as usize).max(1);
    let down = |n: usize| (n / spec.multiple).max(1) * spec.multiple;
    let long = spec.size as f64 / from_w.max(from_h);
    // The photo is resized to `inner`, then cropped or padded to `outer`.
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
    let (x0, y0) = (crop_start(inner.0, outer.0), crop_start(inner.1, outer.1));
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

/// First pixel of a centred crop from `inner` to `outer` pixels; 0 with padding.
fn crop_start(inner: usize, outer: usize) -> usize {
    (inner / 2).saturating_sub(outer / 2).min(inner.saturating_sub(outer))
}

/// Preprocesses every photo for a graph.
pub(super) fn inputs(graph: &GraphFile, role: &str, photos: &[Photo]) -> Result<Vec<Prepared>> {
    let spec =
        graph.binding.image.as_ref().ok_or_else(|| {
            Error::work(format!("{}: its adapter has no image range", graph.path.display()))
        })?;
    Ok(photos.iter().map(|p| prepare(&p.image, graph, spec, role)).collect())
}

/// Views for `pose::pointmap` of splatvk; warns if a crop loses more than 10 % of a photo.
pub(super) fn views(photos: &[Photo], prepared: &[Prepared], progress: &dyn Progress) -> Vec<ModelView> {
    let mut groups: Vec<(Option<&str>, (u32, u32))> = Vec::new();
    let mut lost = 0.0f64;
    let mut views = Vec::with_capacity(photos.len());
    for (photo, ready) in photos.iter().zip(prepared) {
        let group = (photo.camera_model.as_deref(), photo.original_size);
        let camera_group = groups.iter().position(|g| *g == group).unwrap_or_else(|| {
            groups.push(group);
            groups.len() - 1
        });
        let scale = ready.from_photo.scale;
        let kept = (ready.width as f64 / scale[0] / photo.image.width as f64)
            * (ready.height as f64 / scale[1] / photo.image.height as f64);
        lost = lost.max(1.0 - kept);
        views.push(ModelView {
            name: photo.stem.clone(),
            image: photo.image.clone(),
            width: ready.width,
            height: ready.height,
            from_working: ready.from_photo,
            exif_focal: photo.exif_focal.map(|f| f * scale[1]),
            camera_group,
        });
    }
    // Rounding to whole patches loses a few rows.
    if lost > 0.1 {
        progress.warn(&format!(
            "the geometry network's input cuts {:.0} % off a photo; an export for another aspect would use all of it",
            100.0 * lost
        ));
    }
    views
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::progress::Silent;
    use splatvk_test_support::toys::photo;

    #[test]
    fn views_scale_exif_focal() {
        let image = RgbImage { width: 64, height: 32, data: vec![[0.5; 3]; 64 * 32] };
        let photos = [Photo { exif_focal: Some(80.0), ..photo("a", image.clone()) }, photo("b", image)];
        let from_photo = Affine { scale: [0.5; 2], offset: [0.0; 2] };
        let ready = Prepared { width: 32, height: 16, filled: [32, 16], data: Vec::new(), from_photo };
        let views = views(&photos, &[ready.clone(), ready], &Silent);
        assert_eq!((views[0].exif_focal, views[1].exif_focal), (Some(40.0), None));
    }
}
