//! Colours that depend on the direction they are seen from
//! (docs/internals/method.md#view-dependent-colour): spherical harmonics on a trained geometry, of
//! the degree that photos left out support.
use super::coarse::Photos;
use super::init::raise_sh_degree;
use super::options::{Rates, RgbOptions};
use super::rgb::{Trained, fit_photos};
use super::scale::SceneScale;
use super::sh_degree::{DegreeTrial, ViewDependence};
use crate::Result;
use crate::gpu::Device;
use crate::pass::renderer::Renderer;
use crate::preset::Preset;
use crate::progress::Progress;
use crate::scene::{Camera, Coverage, RgbImage, Splats, sh_coefficients};

/// The highest degree that files, viewers and passes know.
const HIGHEST: u32 = 3;
/// Fewest photos that can say anything: with one left out of four, a splat is still seen from three
/// directions.
const FEWEST_PHOTOS: usize = 4;
/// Parts that the photos are dealt into, one of which is left out at a time. More parts take longer
/// in proportion.
const PARTS: usize = 4;

/// Options of [`fit_view_dependent`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewDependentOptions {
    /// SH degree of the result, 0–3; `None` = what photos left out support.
    pub degree: Option<u32>,
    /// Steps per photo.
    pub rounds: usize,
    /// Learning rates of the first coefficient and of the others.
    pub rates: [f64; 2],
    /// Seeds the order of the photos.
    pub seed: u64,
}

impl ViewDependentOptions {
    /// For a degree, or where that is open the one that photos support; the paper has none.
    pub fn preset(preset: Preset, degree: Option<u32>, seed: u64) -> Self {
        let open = if preset == Preset::Paper { Some(0) } else { None };
        ViewDependentOptions { degree: degree.or(open), rounds: 5, rates: [2e-2, 6e-3], seed }
    }
}

/// Gives trained splats SH coefficients of the highest degree by which photos gain that the colours
/// were not fitted to, if any, and fits the colours to the photos. Everything else of the splats,
/// and the cameras, stay to the bit.
///
/// The splats themselves have seen all photos, so what is compared is only what the coefficients
/// add.
pub fn fit_view_dependent(
    device: &Device,
    images: &[RgbImage],
    coverage: &[Option<Coverage>],
    trained: Trained,
    options: &ViewDependentOptions,
    progress: &dyn Progress,
) -> Result<Trained> {
    let mut result = trained;
    let fit = Fit { device, coverage, options, progress };
    let (start, splats) = (result.splats.sh_degree, result.splats.len());
    let highest = highest(device.info().max_storage_range, splats);
    let asked = options.degree.map(|d| d.min(highest));
    if asked < options.degree {
        progress.warn(&format!(
            "{splats} splats of a higher SH degree than {highest} need larger buffers than the device binds; trained with {highest}"
        ));
    }
    let most = asked.unwrap_or(highest);
    let mut trials = Vec::new();
    if most > start && (asked.is_some() || images.len() >= FEWEST_PHOTOS) {
        progress.begin("view dependence", 2 + u64::from(most - start));
        if asked.is_none() {
            trials = fit.trials(images, &result.cameras, &result.splats, most)?;
        }
        let supported = trials.last().filter(|t: &&DegreeTrial| t.supported()).map(|t| t.degree);
        if let Some(degree) = asked.or(supported) {
            let with = fit.colours(images, &result.cameras, coverage, &result.splats, degree)?;
            (result.splats, result.stats.psnr) = (with.splats, with.stats.psnr);
        }
        progress.end();
    }
    result.stats.view_dependence = ViewDependence { degree: result.splats.sh_degree, trials };
    Ok(result)
}

/// The highest degree whose coefficients the device binds: their two moments are the largest
/// buffer. `range` in bytes.
fn highest(range: u64, splats: usize) -> u32 {
    let bytes = |degree: u32| (2 * 4 * 3 * sh_coefficients(degree) * splats) as u64;
    (0..=HIGHEST).rev().find(|d| bytes(*d) <= range).unwrap_or(0)
}

struct Fit<'a> {
    device: &'a Device,
    /// Of all photos.
    coverage: &'a [Option<Coverage>],
    options: &'a ViewDependentOptions,
    progress: &'a dyn Progress,
}

impl Fit<'_> {
    /// Fits the colours, of a degree; nothing else moves.
    fn colours(
        &self,
        images: &[RgbImage],
        cameras: &[Camera],
        coverage: &[Option<Coverage>],
        splats: &Splats,
        degree: u32,
    ) -> Result<Trained> {
        let mut start = splats.clone();
        raise_sh_degree(&mut start, degree);
        let iterations = self.options.rounds * images.len();
        let options = RgbOptions {
            iterations,
            seed: self.options.seed,
            rates: Rates { sh_dc: self.options.rates[0], sh_rest: self.options.rates[1], ..Rates::STILL },
            coarse: 0.0,
            depth_weight: 0.0,
            ratio_weight: 0.0,
            bounded: false,
            prune_every: 0,
            poses: None,
            report_every: iterations,
            ..RgbOptions::preset(Preset::Default)
        };
        let scale = SceneScale::measure(cameras, &start.means);
        let quiet = Quiet(self.progress);
        let photos = Photos { images, cameras, depths: None, coverage };
        fit_photos(self.device, photos, start, scale, &options, &quiet)
    }

    /// Degrees from the highest down until photos left out gain by one. A degree is compared with
    /// the colours of the splats fitted as long, because they have not come to rest.
    fn trials(
        &self,
        images: &[RgbImage],
        cameras: &[Camera],
        splats: &Splats,
        most: u32,
    ) -> Result<Vec<DegreeTrial>> {
        let without = self.left_out(images, cameras, splats, splats.sh_degree)?;
        let mut trials = Vec::new();
        for degree in (splats.sh_degree + 1..=most).rev() {
            self.progress.step(1 + trials.len() as u64, &format!("degree {degree}"));
            let trial = DegreeTrial::of(degree, &self.left_out(images, cameras, splats, degree)?, &without);
            trials.push(trial);
            if trial.supported() {
                break;
            }
        }
        Ok(trials)
    }

    /// PSNR of every photo when the colours are fitted to the other parts of the photos, dB.
    fn left_out(
        &self,
        images: &[RgbImage],
        cameras: &[Camera],
        splats: &Splats,
        degree: u32,
    ) -> Result<Vec<f64>> {
        let mut all = vec![0.0; images.len()];
        for part in 0..PARTS {
            let (out, kept): (Vec<usize>, Vec<usize>) = (0..images.len()).partition(|i| i % PARTS == part);
            let pick = |i: &usize| (images[*i].clone(), cameras[*i].clone());
            let (images_kept, cameras_kept): (Vec<_>, Vec<_>) = kept.iter().map(pick).unzip();
            let coverage_kept: Vec<_> =
                kept.iter().map(|i| self.coverage.get(*i).cloned().flatten()).collect();
            let with = self.colours(&images_kept, &cameras_kept, &coverage_kept, splats, degree)?.splats;
            let near = SceneScale::measure(cameras, &with.means).near();
            let mut renderer = Renderer::new(self.device, &with, &[], 0)?.with_near(near);
            let photos = Photos { images, cameras, depths: None, coverage: self.coverage };
            for i in out {
                all[i] = photos.psnr(i, &renderer.render(&cameras[i])?.rgb);
            }
        }
        Ok(all)
    }
}

/// Only passes on that the work should stop: the parts of a stage are not stages.
struct Quiet<'a>(&'a dyn Progress);

impl Progress for Quiet<'_> {
    fn begin(&self, _: &'static str, _: u64) {}
    fn step(&self, _: u64, _: &str) {}
    fn end(&self) {}
    fn warn(&self, message: &str) {
        self.0.warn(message);
    }
    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_splats_take_a_lower_degree() {
        // The two moments of a splat of degree 3 take 2 · 4 · 3 · 16 = 384 bytes.
        let range = 128 << 20;
        let degrees = [100_000, 349_525, 349_526, 621_378, 621_379, 1_398_101, 5_000_000];
        assert_eq!(degrees.map(|splats| highest(range, splats)), [3, 3, 2, 2, 1, 1, 0]);
    }
}
