//! Trials of view-dependent colour: how well colours that depend on the direction predict photos
//! that were left out. Nothing is trained. The residual colour of a splat in a photo is a mean over
//! its pixels, and a splat's residuals in other photos predict it by a Gaussian process over
//! directions, whose covariance is that of spherical harmonics with independent coefficients.
use super::photos::Photos;
use super::sh_degree::DegreeTrial;
use crate::Result;
use crate::gpu::Device;
use crate::pass::renderer::Renderer;
use crate::progress::Progress;
use crate::scene::{Camera, RgbImage, SH_C0, Splats};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Number of folds of the cross-validation.
const PARTS: usize = 4;
/// Variance of a residual that one pixel shows, relative to the prior variance of the mean colour.
/// With [`PRIOR`] it was chosen on generated tuning sets (docs/internals/experiments.md).
const NOISE: f64 = 2.0;
/// Prior variance of a coefficient that depends on the direction, relative to that of the mean.
const PRIOR: f64 = 0.1;
/// Most photos that predict the colour of a splat.
const MOST: usize = 16;

/// Residual colours of the splats in one photo.
struct Residuals {
    /// Unit vectors from the camera.
    directions: Vec<[f32; 3]>,
    /// Sums of blending weights over the pixels.
    weights: Vec<f32>,
    /// Means of photo − render over the pixels.
    colours: Vec<[f32; 3]>,
}

/// Cross-validation of SH degrees on trained splats.
pub(super) struct Trials<'a> {
    pub device: &'a Device,
    pub photos: Photos<'a>,
    pub splats: &'a Splats,
    pub near: f64,
    pub progress: &'a dyn Progress,
}

impl Trials<'_> {
    /// Tries degrees from the highest down until left-out photos support one. A degree is compared
    /// with colours that are corrected as much without depending on the direction.
    pub fn run(&self, most: u32) -> Result<Vec<DegreeTrial>> {
        let mut renderer = Renderer::new(self.device, self.splats, &[], 0)?.with_near(self.near);
        let shown = (0..self.photos.images.len()).map(|i| self.residuals(&mut renderer, i));
        let shown: Vec<Residuals> = shown.collect::<Result<_>>()?;
        let without = self.left_out_psnr(&shown, self.splats.sh_degree)?;
        let mut trials = Vec::new();
        for degree in (self.splats.sh_degree + 1..=most).rev() {
            self.progress.step(1 + trials.len() as u64, &format!("degree {degree}"));
            let trial = DegreeTrial::of(degree, &self.left_out_psnr(&shown, degree)?, &without);
            trials.push(trial);
            if trial.supported() {
                break;
            }
        }
        Ok(trials)
    }

    fn residuals(&self, renderer: &mut Renderer, photo: usize) -> Result<Residuals> {
        let (camera, image) = (&self.photos.cameras[photo], &self.photos.images[photo]);
        let used = self.photos.coverage.get(photo).and_then(Option::as_ref).map(|c| c.weights().data);
        let used = |pixel: usize| used.as_ref().map_or(1.0, |used| used[pixel]);
        let rendered = renderer.render(camera)?.rgb;
        let of_pixels = |value: &(dyn Fn(usize) -> [f32; 3] + Sync)| RgbImage {
            data: (0..image.data.len()).map(value).collect(),
            ..*image
        };
        let difference =
            of_pixels(&|p| [0, 1, 2].map(|c| used(p) * (image.data[p][c] - rendered.data[p][c])));
        let mask = of_pixels(&|p| [used(p); 3]);
        let weights: Vec<f32> = renderer.colour_sums(camera, &mask)?.iter().map(|sum| sum[0]).collect();
        let sums = renderer.colour_sums(camera, &difference)?;
        let colours = sums.iter().zip(&weights).map(|(sum, w)| sum.map(|s| s / w.max(1e-6))).collect();
        Ok(Residuals { directions: directions(camera, self.splats), weights, colours })
    }

    /// PSNR of every photo with colours that the other folds predict, dB.
    fn left_out_psnr(&self, shown: &[Residuals], degree: u32) -> Result<Vec<f64>> {
        let of = |photo: usize| {
            let kept: Vec<&Residuals> = shown
                .iter()
                .enumerate()
                .filter(|(i, _)| i % PARTS != photo % PARTS)
                .map(|(_, r)| r)
                .collect();
            let changes = predicted(&kept, &shown[photo].directions, degree);
            let mut splats = self.splats.clone();
            let stride = 3 * crate::scene::sh_coefficients(splats.sh_degree);
            for (sh, change) in splats.sh.chunks_exact_mut(stride).zip(changes) {
                sh[..3].iter_mut().zip(change).for_each(|(sh, change)| *sh += change / SH_C0);
            }
            let mut renderer = Renderer::new(self.device, &splats, &[], 0)?.with_near(self.near);
            Ok(self.photos.psnr(photo, &renderer.render(&self.photos.cameras[photo])?.rgb))
        };
        (0..shown.len()).map(of).collect()
    }
}

/// Unit vectors from a camera to the splats.
fn directions(camera: &Camera, splats: &Splats) -> Vec<[f32; 3]> {
    let centre = camera.pose.centre().as_vec3();
    splats
        .means
        .iter()
        .map(|mean| (glam::Vec3::from(*mean) - centre).normalize_or_zero().to_array())
        .collect()
}

/// The residual colour of each splat in other directions.
fn predicted(kept: &[&Residuals], directions: &[[f32; 3]], degree: u32) -> Vec<[f32; 3]> {
    let of = |(splat, direction): (usize, &[f32; 3])| {
        let mut seen: Vec<&&Residuals> = kept.iter().filter(|r| r.weights[splat] > 0.01).collect();
        seen.sort_by(|a, b| b.weights[splat].total_cmp(&a.weights[splat]));
        seen.truncate(MOST);
        if seen.is_empty() {
            return [0.0; 3];
        }
        let between = |a: &[f32; 3], b: &[f32; 3]| {
            let cosine: f32 = a.iter().zip(b).map(|(a, b)| a * b).sum();
            covariance(degree, f64::from(cosine))
        };
        let own = |k: usize| &seen[k].directions[splat];
        let matrix = DMatrix::from_fn(seen.len(), seen.len(), |i, j| {
            let noise = if i == j { NOISE / f64::from(seen[i].weights[splat]) } else { 0.0 };
            between(own(i), own(j)) + noise
        });
        // Positive definite because of the noise.
        let Some(factor) = matrix.cholesky() else { return [0.0; 3] };
        let shares = factor.solve(&DVector::from_fn(seen.len(), |k, _| between(own(k), direction)));
        [0, 1, 2].map(|c| {
            shares.iter().zip(&seen).map(|(share, r)| *share as f32 * r.colours[splat][c]).sum::<f32>()
        })
    };
    directions.par_iter().enumerate().with_min_len(1024).map(of).collect()
}

/// Covariance of colours of an SH degree in two directions with this cosine: by the addition
/// theorem a sum of Legendre polynomials.
fn covariance(degree: u32, cosine: f64) -> f64 {
    let c = cosine;
    let legendre = [c, (3.0 * c * c - 1.0) / 2.0, (5.0 * c * c * c - 3.0 * c) / 2.0];
    let terms = legendre.iter().take(degree as usize).enumerate();
    1.0 + PRIOR * terms.map(|(l, p)| (2 * l + 3) as f64 * p).sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Residuals of one splat in photos along an arc, with the weights of ten pixels.
    fn arc(degrees: &[f32], colour: impl Fn(f32) -> f32) -> Vec<Residuals> {
        let of = |angle: &f32| Residuals {
            directions: vec![[angle.to_radians().sin(), 0.0, angle.to_radians().cos()]],
            weights: vec![10.0],
            colours: vec![[colour(*angle); 3]],
        };
        degrees.iter().map(of).collect()
    }

    fn predict(kept: &[Residuals], direction: &Residuals, degree: u32) -> f32 {
        predicted(&kept.iter().collect::<Vec<_>>(), &direction.directions, degree)[0][0]
    }

    #[test]
    fn colours_without_directions_are_shrunk_means() {
        let kept = arc(&[0.0, 10.0, 20.0], |angle| 0.3 + 0.01 * angle);
        let mean = predict(&kept, &arc(&[40.0], |_| 0.0)[0], 0);
        // The mean 0.4 of 30 pixels, with the prior of NOISE pixels.
        assert!((f64::from(mean) - 0.4 * 30.0 / (30.0 + NOISE)).abs() < 1e-5, "{mean}");
    }

    #[test]
    fn higher_degrees_follow_the_direction() {
        let slope = |angle: f32| 0.02 * angle;
        let kept = arc(&[-20.0, -10.0, 0.0, 10.0], slope);
        let errors =
            [0, 1, 2, 3].map(|degree| (predict(&kept, &arc(&[20.0], slope)[0], degree) - slope(20.0)).abs());
        assert!(errors[3] < 0.8 * errors[0] && errors[2] < errors[1] && errors[1] < errors[0], "{errors:?}");
    }

    #[test]
    fn unseen_splats_keep_their_colour() {
        let mut kept = arc(&[0.0, 10.0], |_| 0.5);
        kept.iter_mut().for_each(|r| r.weights[0] = 0.0);
        assert_eq!(predict(&kept, &arc(&[5.0], |_| 0.0)[0], 3), 0.0);
    }
}
