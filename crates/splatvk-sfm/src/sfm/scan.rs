//! Search for the depth of a patch in another view. It looks at every second pixel each way, in
//! f32: alignment refines what it finds on the whole patch.
use super::patch::{Aligner, Facet, LumaGradients, RADIUS, Template};

/// Pixels that are compared: 7 × 7.
const PIXELS: usize = ((RADIUS + 1) * (RADIUS + 1)) as usize;

/// A patch and its paths in another view as its depth changes.
pub(super) struct Scan<'a> {
    image: &'a LumaGradients,
    /// Standardised values under the window, and the window.
    template: [f32; PIXELS],
    window: [f32; PIXELS],
    /// A pixel is at `(at + by · inverse depth)`, dehomogenised, in pixels.
    at: [[f32; PIXELS]; 3],
    by: [[f32; PIXELS]; 3],
}

/// Subtracts the mean and divides by the standard deviation under the window; `None` if that is
/// below `least`.
fn standardise(values: &mut [f32; PIXELS], window: &[f32; PIXELS], least: f32) -> Option<()> {
    let sum = |values: &[f32; PIXELS]| values.iter().zip(window).map(|(v, w)| v * w).sum::<f32>();
    let mean = sum(values);
    values.iter_mut().for_each(|v| *v -= mean);
    let sigma = sum(&values.map(|v| v * v)).sqrt();
    (sigma > least).then(|| values.iter_mut().for_each(|v| *v /= sigma))
}

impl<'a> Scan<'a> {
    /// Search of the facet, whose patch is `template`, in view `other`.
    pub(super) fn new(
        aligner: &Aligner<'a>,
        template: &Template,
        f: &Facet,
        other: usize,
    ) -> Option<Scan<'a>> {
        let warp = aligner.warp(f.view, other)?;
        let side = (2 * RADIUS + 1) as usize;
        let (mut values, mut window) = ([0.0; PIXELS], [0.0; PIXELS]);
        let (mut at, mut by) = ([[0.0; PIXELS]; 3], [[0.0; PIXELS]; 3]);
        for i in 0..PIXELS {
            let (row, column) = (i / (RADIUS + 1) as usize, i % (RADIUS + 1) as usize);
            let k = 2 * (row * side + column);
            let (d, weight) = aligner.offsets[k];
            (values[i], window[i]) = (template.values[k] as f32, weight as f32);
            // The pixel of homogeneous coordinates h is (f h.x + c.x h.z, f h.y + c.y h.z) / h.z.
            let pixels = |h: glam::DVec3| {
                [h.x * warp.f + warp.centre.x * h.z, h.y * warp.f + warp.centre.y * h.z, h.z]
            };
            let (fixed, moving) =
                (pixels(warp.m * template.rays[k]), pixels(warp.shift * (1.0 + f.slant.dot(d))));
            for axis in 0..3 {
                (at[axis][i], by[axis][i]) = (fixed[axis] as f32, moving[axis] as f32);
            }
        }
        let sum: f32 = window.iter().sum();
        window.iter_mut().for_each(|w| *w /= sum);
        standardise(&mut values, &window, 0.0)?;
        Some(Scan { image: &aligner.images[other], template: values, window, at, by })
    }

    /// Normalised cross-correlation at an inverse depth; `None` outside the image and without
    /// texture.
    pub(super) fn ncc(&self, inverse_depth: f64) -> Option<f64> {
        let a = inverse_depth as f32;
        let h = |axis: usize| -> [f32; PIXELS] {
            std::array::from_fn(|i| self.at[axis][i] + self.by[axis][i] * a)
        };
        let (x, y, z) = (h(0), h(1), h(2));
        if z.iter().any(|z| *z <= 1e-6) {
            return None;
        }
        let (x, y): ([f32; PIXELS], [f32; PIXELS]) =
            (std::array::from_fn(|i| x[i] / z[i]), std::array::from_fn(|i| y[i] / z[i]));
        let mut values = [0.0; PIXELS];
        for (i, value) in values.iter_mut().enumerate() {
            *value = self.image.value_at(x[i], y[i])?;
        }
        standardise(&mut values, &self.window, super::patch::MIN_CONTRAST as f32)?;
        let products = values.iter().zip(&self.template).zip(&self.window).map(|((a, b), w)| a * b * w);
        Some(f64::from(products.sum::<f32>()))
    }
}

#[cfg(test)]
mod tests {
    use super::super::model::{Model, RefinedIntrinsics};
    use super::*;
    use crate::bundle::{Intrinsics, IntrinsicsPrior};
    use crate::scene::{Image, Lens, Pose};
    use glam::{DVec2, DVec3};

    #[test]
    fn ncc_peaks_at_true_depth() {
        // A plane at depth 2; the second camera is 0.1 to the right, so that it moves by 10 pixels.
        let image = |shift: f32| {
            let mut out = Image::filled(200, 160, 0f32);
            for (i, value) in out.data.iter_mut().enumerate() {
                let (x, y) = ((i % 200) as f32 + shift, (i / 200) as f32);
                *value = 0.5 + 0.2 * (0.7 * x).sin() * (0.5 * y).cos() + 0.1 * (0.13 * x + 0.31 * y).sin();
            }
            LumaGradients::new(&out)
        };
        let images = [image(0.0), image(10.0)];
        let model = Model {
            poses: vec![
                Some(Pose::IDENTITY),
                Some(Pose { translation: DVec3::new(-0.1, 0.0, 0.0), ..Pose::IDENTITY }),
            ],
            centres: vec![DVec2::new(100.0, 80.0); 2],
            camera_ids: vec![0; 2],
            camera_ids_by_file: vec![0; 2],
            camera_ids_by_exif: vec![0; 2],
            zoom: vec![1.0; 2],
            intrinsics: vec![Intrinsics {
                focal: 200.0,
                lens: Lens::NONE,
                principal_point_offset: DVec2::ZERO,
            }],
            priors: vec![IntrinsicsPrior::default()],
            refined: RefinedIntrinsics::Focal,
            tracks: Vec::new(),
            seed: 0,
        };
        let aligner = Aligner::new(&model, &images);
        let f = Facet { view: 0, pixel: DVec2::new(100.5, 80.5), inverse_depth: 0.5, slant: DVec2::ZERO };
        let template = aligner.template(&f).unwrap();
        let scan = Scan::new(&aligner, &template, &f, 1).unwrap();
        for step in -10..=10 {
            let inverse_depth = 0.5 + 0.01 * f64::from(step);
            let found = scan.ncc(inverse_depth).unwrap();
            let whole = aligner.ncc(&template, &Facet { inverse_depth, ..f }, 1, DVec2::ZERO).unwrap();
            assert!((found - whole).abs() < 0.1, "{step}: {found} {whole}");
            assert!(if step == 0 { found > 0.999 } else { found < 0.999 }, "{step}: {found}");
        }
        assert!(scan.ncc(10.0).is_none(), "outside");
    }
}
