//! Photometric alignment of small planar patches between views with known cameras.
use super::model::Model;
use crate::scene::Image;
use crate::sift::blurred;
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};

/// Half the side of a patch: 13 × 13 pixels hold enough texture at corners and stay planar.
pub(super) const RADIUS: i32 = 6;
/// Pixels of a patch.
const PIXELS: usize = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as usize;
/// σ of the Gaussian window, pixels: the point itself matters most.
const WINDOW: f64 = 4.0;
/// σ of the blur before sampling, pixels: hides the pixel grid from the bilinear interpolation.
const BLUR: f32 = 0.8;
/// Standard deviation below which a patch has no texture (1 in 255, twice JPEG noise after the
/// blur).
pub(super) const MIN_CONTRAST: f64 = 0.008;
/// Typical relative change of inverse depth per pixel of a surface seen at 45°, f = 650: 1/650. The
/// slant prior is twice that.
const SLANT_SIGMA: f64 = 0.003;

/// Blurred luma with its gradients.
pub(super) struct LumaGradients {
    value: Image<f32>,
    dx: Vec<f32>,
    dy: Vec<f32>,
}

impl LumaGradients {
    pub(super) fn new(luma: &Image<f32>) -> LumaGradients {
        let value = blurred(luma, BLUR);
        let (w, h) = (value.width, value.height);
        let at = |x: usize, y: usize| value.data[y * w + x];
        let (mut dx, mut dy) = (vec![0f32; w * h], vec![0f32; w * h]);
        for y in 1..h.saturating_sub(1) {
            for x in 1..w.saturating_sub(1) {
                dx[y * w + x] = 0.5 * (at(x + 1, y) - at(x - 1, y));
                dy[y * w + x] = 0.5 * (at(x, y + 1) - at(x, y - 1));
            }
        }
        LumaGradients { value, dx, dy }
    }

    pub(super) fn size(&self) -> (usize, usize) {
        (self.value.width, self.value.height)
    }

    /// Smaller eigenvalue of the gradient covariance over a 7 × 7 window (Shi & Tomasi 1994).
    pub(super) fn cornerness(&self, x: usize, y: usize) -> f32 {
        let w = self.value.width;
        let (mut xx, mut xy, mut yy) = (0f32, 0f32, 0f32);
        for r in y - 3..=y + 3 {
            for k in r * w + x - 3..=r * w + x + 3 {
                xx += self.dx[k] * self.dx[k];
                xy += self.dx[k] * self.dy[k];
                yy += self.dy[k] * self.dy[k];
            }
        }
        let (half, difference) = (0.5 * (xx + yy), 0.5 * (xx - yy));
        half - (difference * difference + xy * xy).sqrt()
    }

    /// Index of the upper left sample around a position and the bilinear fractions; `None` outside.
    fn cell(&self, x: f32, y: f32) -> Option<(usize, f32, f32)> {
        let (u, v) = (x - 0.5, y - 0.5);
        let (w, h) = self.size();
        if !(u >= 1.0 && v >= 1.0 && u < (w - 2) as f32 && v < (h - 2) as f32) {
            return None;
        }
        let (i, j) = (u as u32, v as u32);
        Some((j as usize * w + i as usize, u - i as f32, v - j as f32))
    }

    /// Value at a position; `None` outside.
    pub(super) fn value_at(&self, x: f32, y: f32) -> Option<f32> {
        let (k, fx, fy) = self.cell(x, y)?;
        Some(mix(&self.value.data, self.value.width, k, fx, fy))
    }

    /// (value, gradient) at a position; `None` outside.
    fn sample(&self, p: DVec2) -> Option<(f64, DVec2)> {
        let (k, fx, fy) = self.cell(p.x as f32, p.y as f32)?;
        let at = |d: &[f32]| f64::from(mix(d, self.value.width, k, fx, fy));
        Some((at(&self.value.data), DVec2::new(at(&self.dx), at(&self.dy))))
    }
}

/// Bilinear value of an image of width `w` between sample `k` and its neighbours.
fn mix(d: &[f32], w: usize, k: usize, fx: f32, fy: f32) -> f32 {
    let [a, b] = [k, k + w].map(|k| d[k] + (d[k + 1] - d[k]) * fx);
    a + (b - a) * fy
}

/// Offsets and weights of the window, row-major.
fn window() -> Vec<(DVec2, f64)> {
    let mut out = Vec::new();
    for y in -RADIUS..=RADIUS {
        for x in -RADIUS..=RADIUS {
            let d = DVec2::new(x as f64, y as f64);
            out.push((d, (-d.length_squared() / (2.0 * WINDOW * WINDOW)).exp()));
        }
    }
    let sum: f64 = out.iter().map(|o| o.1).sum();
    out.iter_mut().for_each(|o| o.1 /= sum);
    out
}

/// Zero-mean, unit-variance values under the window, and their σ; `None` without texture.
fn standardised(values: &[f64; PIXELS], offsets: &[(DVec2, f64)]) -> Option<([f64; PIXELS], f64)> {
    let mean: f64 = values.iter().zip(offsets).map(|(v, o)| v * o.1).sum();
    let variance: f64 = values.iter().zip(offsets).map(|(v, o)| (v - mean).powi(2) * o.1).sum();
    let sigma = variance.sqrt();
    (sigma > MIN_CONTRAST).then(|| (values.map(|v| (v - mean) / sigma), sigma))
}

/// Maps a patch of the reference view into another view through a plane of inverse depth `a (1 +
/// b·d)`.
pub(super) struct Warp {
    pub(super) m: DMat3,
    pub(super) shift: DVec3,
    pub(super) f: f64,
    pub(super) centre: DVec2,
}

impl Warp {
    fn new(model: &Model, reference: usize, other: usize) -> Option<Warp> {
        let (r, o) = (model.poses[reference]?, model.poses[other]?);
        let relative = o.compose(&r.inverse());
        Some(Warp {
            m: relative.rotation,
            shift: relative.translation,
            f: model.focal(other),
            centre: model.principal_point(other),
        })
    }
    fn position(&self, ray: DVec3, a: f64, slant: DVec2, d: DVec2) -> Option<DVec2> {
        let h = self.m * ray + self.shift * (a * (1.0 + slant.dot(d)));
        (h.z > 1e-6).then(|| DVec2::new(h.x, h.y) * (self.f / h.z) + self.centre)
    }
    /// Position and its derivatives by the two slants.
    fn apply(&self, ray: DVec3, a: f64, slant: DVec2, d: DVec2) -> Option<(DVec2, [DVec2; 2])> {
        let h = self.m * ray + self.shift * (a * (1.0 + slant.dot(d)));
        if h.z <= 1e-6 {
            return None;
        }
        let u = DVec2::new(h.x, h.y) / h.z;
        let by = |amount: f64| {
            let dh = self.shift * amount;
            (DVec2::new(dh.x, dh.y) - u * dh.z) * (self.f / h.z)
        };
        Some((u * self.f + self.centre, [by(a * d.x), by(a * d.y)]))
    }
}

/// One aligned view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Aligned {
    pub(super) view: usize,
    /// Position of the centre of the reference patch.
    pub(super) pixel: DVec2,
    /// Normalised cross-correlation.
    pub(super) ncc: f64,
}

/// Model, images and window of the alignment.
pub(super) struct Aligner<'a> {
    pub(super) model: &'a Model,
    pub(super) images: &'a [LumaGradients],
    /// Offsets and weights of a patch, row-major.
    pub(super) offsets: Vec<(DVec2, f64)>,
    /// From view `i / views` to view `i % views`.
    warps: Vec<Option<Warp>>,
}

/// Patch of a facet in its own view.
pub(super) struct Template {
    /// Standardised values.
    pub(super) values: [f64; PIXELS],
    /// Viewing rays of the pixels.
    pub(super) rays: [DVec3; PIXELS],
}

/// A patch warped into another view.
struct Warped {
    values: [f64; PIXELS],
    gradients: [DVec2; PIXELS],
    /// Derivatives of the positions by the two slants.
    moves: [[DVec2; 2]; PIXELS],
}

/// A patch of the reference view: centre and local plane.
#[derive(Clone, Copy, Debug)]
pub(super) struct Facet {
    pub(super) view: usize,
    pub(super) pixel: DVec2,
    /// Inverse depth at the centre.
    pub(super) inverse_depth: f64,
    /// Relative change of inverse depth per pixel.
    pub(super) slant: DVec2,
}

impl<'a> Aligner<'a> {
    pub(super) fn new(model: &'a Model, images: &'a [LumaGradients]) -> Aligner<'a> {
        let views = model.poses.len();
        let warps = (0..views * views).map(|i| Warp::new(model, i / views, i % views)).collect();
        Aligner { model, images, offsets: window(), warps }
    }

    /// Warp between two views; `None` where one is not registered.
    pub(super) fn warp(&self, reference: usize, other: usize) -> Option<&Warp> {
        self.warps[reference * self.model.poses.len() + other].as_ref()
    }

    /// Standardised patch of the facet in its own view; `None` at the image edge or without
    /// texture.
    pub(super) fn template(&self, f: &Facet) -> Option<Template> {
        let mut values = [0.0; PIXELS];
        for (value, (d, _)) in values.iter_mut().zip(&self.offsets) {
            let p = f.pixel + *d;
            *value = f64::from(self.images[f.view].value_at(p.x as f32, p.y as f32)?);
        }
        let (values, _) = standardised(&values, &self.offsets)?;
        let rays = std::array::from_fn(|i| self.model.ray(f.view, f.pixel + self.offsets[i].0));
        Some(Template { values, rays })
    }

    /// Normalised cross-correlation of a facet with another view, shifted by `shift`; `template` is
    /// the patch at the facet's pixel.
    pub(super) fn ncc(&self, template: &Template, f: &Facet, other: usize, shift: DVec2) -> Option<f64> {
        let warp = self.warp(f.view, other)?;
        let mut values = [0.0; PIXELS];
        for ((value, ray), (d, _)) in values.iter_mut().zip(&template.rays).zip(&self.offsets) {
            let p = warp.position(*ray, f.inverse_depth, f.slant, *d)?;
            let p = p + shift;
            *value = f64::from(self.images[other].value_at(p.x as f32, p.y as f32)?);
        }
        let (sampled, _) = standardised(&values, &self.offsets)?;
        Some(sampled.iter().zip(&template.values).zip(&self.offsets).map(|((a, b), o)| a * b * o.1).sum())
    }

    /// Values, gradients and slant derivatives of the warped patch.
    fn sample_warped(&self, template: &Template, f: &Facet, other: usize, shift: DVec2) -> Option<Warped> {
        let warp = self.warp(f.view, other)?;
        let mut out = Warped {
            values: [0.0; PIXELS],
            gradients: [DVec2::ZERO; PIXELS],
            moves: [[DVec2::ZERO; 2]; PIXELS],
        };
        for (i, (ray, (d, _))) in template.rays.iter().zip(&self.offsets).enumerate() {
            let (p, by) = warp.apply(*ray, f.inverse_depth, f.slant, *d)?;
            (out.values[i], out.gradients[i]) = self.images[other].sample(p + shift)?;
            out.moves[i] = by;
        }
        Some(out)
    }

    /// Projection of the facet's centre without shift.
    pub(super) fn project_centre(&self, f: &Facet, other: usize) -> Option<DVec2> {
        let warp = self.warp(f.view, other)?;
        let ray = self.model.ray(f.view, f.pixel);
        warp.apply(ray, f.inverse_depth, f.slant, DVec2::ZERO).map(|w| w.0)
    }

    /// Gauss–Newton over the slant (shared by all views) and one shift per view, with gain and bias
    /// removed. `starts`: views with initial shifts; views whose correlation stays below `least`
    /// are left out. Returns the improved facet and the aligned views.
    pub(super) fn align(
        &self,
        facet: &Facet,
        starts: &[(usize, DVec2)],
        least: f64,
    ) -> Option<(Facet, Vec<Aligned>)> {
        let template = self.template(facet)?;
        let (mut f, mut active) = (*facet, starts.to_vec());
        let first = facet.slant;
        let mut scores = Vec::new();
        for round in 0..12 {
            let n = 2 + 2 * active.len();
            let (mut h, mut g) = (DMatrix::<f64>::zeros(n, n), DVector::<f64>::zeros(n));
            scores.clear();
            for (k, (view, shift)) in active.iter().enumerate() {
                let step = self.sample_warped(&template, &f, *view, *shift).and_then(|warped| {
                    let (sampled, sigma) = standardised(&warped.values, &self.offsets)?;
                    Some((Warped { values: sampled, ..warped }, sigma))
                });
                let Some((warped, sigma)) = step else {
                    scores.push(-1.0);
                    h[(2 + 2 * k, 2 + 2 * k)] += 1.0;
                    h[(3 + 2 * k, 3 + 2 * k)] += 1.0;
                    continue;
                };
                scores.push(self.accumulate(&template, &warped, sigma, k, &mut h, &mut g));
            }
            // Slant prior against the starting plane, in units of the patch residual (about 0.3 at
            // NCC 0.95).
            for k in 0..2 {
                let w = (0.3 / SLANT_SIGMA).powi(2) * 0.05;
                h[(k, k)] += w;
                g[k] += w * (f.slant[k] - first[k]);
            }
            for i in 0..n {
                h[(i, i)] = h[(i, i)] * 1.001 + 1e-9;
            }
            let d = h.cholesky()?.solve(&g);
            // Beyond a pixel per step the linearisation is invalid.
            f.slant -= DVec2::new(d[0], d[1]).clamp_length_max(SLANT_SIGMA);
            let mut largest: f64 = 0.0;
            for (k, a) in active.iter_mut().enumerate() {
                let step = DVec2::new(d[2 + 2 * k], d[3 + 2 * k]).clamp_length_max(1.0);
                a.1 -= step;
                largest = largest.max(step.length());
            }
            // A hundredth of a pixel is below the noise of JPEG.
            let found = round >= 1 && largest < 0.01;
            if round >= 3 || found {
                // Occluded or wrong views would distort the plane of the others.
                let keep: Vec<bool> = scores.iter().map(|s| *s > 0.5).collect();
                let mut k = keep.iter();
                active.retain(|_| *k.next().unwrap_or(&false));
            }
            if active.is_empty() {
                return None;
            }
            if found {
                break;
            }
        }
        let aligned: Vec<Aligned> = active
            .iter()
            .filter_map(|(view, shift)| {
                let ncc = self.ncc(&template, &f, *view, *shift)?;
                let pixel = self.project_centre(&f, *view)? + *shift;
                (ncc >= least).then_some(Aligned { view: *view, pixel, ncc })
            })
            .collect();
        (!aligned.is_empty()).then_some((f, aligned))
    }

    /// Adds one view, whose values are standardised, to the normal equations; returns its
    /// correlation.
    fn accumulate(
        &self,
        template: &Template,
        warped: &Warped,
        sigma: f64,
        k: usize,
        h: &mut DMatrix<f64>,
        g: &mut DVector<f64>,
    ) -> f64 {
        let rows: [[f64; 4]; PIXELS] = std::array::from_fn(|i| {
            let (q, m) = (warped.gradients[i], warped.moves[i]);
            [q.dot(m[0]), q.dot(m[1]), q.x, q.y].map(|v| v / sigma)
        });
        // Standardising removes the mean and the component along the patch itself from every
        // derivative.
        let (mut mean, mut along) = ([0.0; 4], [0.0; 4]);
        for ((row, s), o) in rows.iter().zip(&warped.values).zip(&self.offsets) {
            for c in 0..4 {
                mean[c] += o.1 * row[c];
                along[c] += o.1 * row[c] * s;
            }
        }
        let index = [0, 1, 2 + 2 * k, 3 + 2 * k];
        let mut correlation = 0.0;
        // The view's entries in registers; the lower triangle, which the factorisation reads.
        let mut own_g = index.map(|a| g[a]);
        let mut own_h = index.map(|a| index.map(|b| h[(b, a)]));
        for (((row, s), t), o) in rows.iter().zip(&warped.values).zip(&template.values).zip(&self.offsets) {
            let j: [f64; 4] = std::array::from_fn(|c| row[c] - mean[c] - along[c] * s);
            correlation += o.1 * s * t;
            for a in 0..4 {
                let weighted = o.1 * j[a];
                own_g[a] += weighted * (s - t);
                for b in a..4 {
                    own_h[a][b] += weighted * j[b];
                }
            }
        }
        for a in 0..4 {
            g[index[a]] = own_g[a];
            for b in a..4 {
                h[(index[b], index[a])] = own_h[a][b];
            }
        }
        correlation
    }

    /// Forward–backward error, pixels: distance from the facet's centre after the patch around
    /// `pixel` of `other` is aligned back through the same plane.
    pub(super) fn round_trip(&self, f: &Facet, other: usize, pixel: DVec2) -> Option<f64> {
        let back = self.transfer(f, other, pixel)?;
        let start = f.pixel - self.project_centre(&back, f.view)?;
        let (_, found) = self.align(&back, &[(f.view, start)], 0.5)?;
        Some((found[0].pixel - f.pixel).length())
    }

    /// The facet's plane in another view, centred at `pixel`.
    fn transfer(&self, f: &Facet, other: usize, pixel: DVec2) -> Option<Facet> {
        let warp = self.warp(f.view, other)?;
        // Inverse depth in the other view at three points of the patch.
        let project = |d: DVec2| -> Option<(DVec2, f64)> {
            let ray = self.model.ray(f.view, f.pixel + d);
            let rho = f.inverse_depth * (1.0 + f.slant.dot(d));
            let h = warp.m * ray + warp.shift * rho;
            (h.z > 1e-6 && rho > 0.0)
                .then(|| (DVec2::new(h.x, h.y) * (warp.f / h.z) + warp.centre, rho / h.z))
        };
        let (c, x, y) = (project(DVec2::ZERO)?, project(DVec2::X * 4.0)?, project(DVec2::Y * 4.0)?);
        let m = glam::DMat2::from_cols(x.0 - c.0, y.0 - c.0);
        if m.determinant().abs() < 1e-3 {
            return None;
        }
        // Relative changes along the two image directions of the other view.
        let slant = m.transpose().inverse() * DVec2::new(x.1 / c.1 - 1.0, y.1 / c.1 - 1.0);
        Some(Facet { view: other, pixel, inverse_depth: c.1, slant })
    }
}
