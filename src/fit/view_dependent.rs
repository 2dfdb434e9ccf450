//! View-dependent colour (docs/internals/method.md#view-dependent-colour): spherical harmonics on a
//! trained geometry, of the degree that left-out photos support.
use super::degree_trials::Trials;
use super::losses::Losses;
use super::options::{Rates, RgbOptions};
use super::photos::Photos;
use super::rgb::{Trained, fit_photos};
use super::scale::SceneScale;
use super::sh_degree::{DegreeTrial, ViewDependence};
use crate::Result;
use crate::gpu::Device;
use crate::preset::Preset;
use crate::progress::Progress;
use crate::scene::{Camera, Coverage, RgbImage, Splats, sh_coefficients};

/// Highest SH degree of files, viewers and passes.
const HIGHEST: u32 = 3;
/// Fewest photos for cross-validation: with one left out of four, three directions of a splat
/// remain.
const FEWEST_PHOTOS: usize = 4;

/// Options of [`fit_view_dependent`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewDependentOptions {
    /// SH degree of the result, 0–3; `None` = the degree that left-out photos support.
    pub degree: Option<u32>,
    /// Steps per photo.
    pub rounds: usize,
    /// Learning rates of the first coefficient and of the others.
    pub rates: [f64; 2],
    /// Seeds the order of the photos.
    pub seed: u64,
}

impl ViewDependentOptions {
    /// Options of a preset. Without a degree, the photos decide; with the paper's preset it is 0.
    pub fn preset(preset: Preset, degree: Option<u32>, seed: u64) -> Self {
        let default = if preset == Preset::Paper { Some(0) } else { None };
        ViewDependentOptions { degree: degree.or(default), rounds: 5, rates: [2e-2, 6e-3], seed }
    }
}

/// Fits view-dependent colour to trained splats. Without a given degree it is the highest SH degree
/// that improves the PSNR of left-out photos ([`DegreeTrial::supported`], 4-fold cross-validation).
/// Geometry, opacities and cameras stay to the bit.
///
/// The splats were trained on all photos, so only the difference between degrees is meaningful.
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
    let given = options.degree.map(|d| d.min(highest));
    if given < options.degree {
        progress.warn(&format!(
            "{splats} splats of a higher SH degree than {highest} need larger buffers than the device binds; trained with {highest}"
        ));
    }
    let most = given.unwrap_or(highest);
    let mut trials = Vec::new();
    if most > start && (given.is_some() || images.len() >= FEWEST_PHOTOS) {
        progress.begin("view dependence", 2 + u64::from(most - start));
        if given.is_none() {
            let (cameras, splats) = (&result.cameras, &result.splats);
            let photos = Photos { images, cameras, depths: None, coverage };
            let near = SceneScale::measure(cameras, &splats.means).near();
            trials = Trials { device, photos, splats, near, progress }.run(most)?;
        }
        let supported = trials.last().filter(|t: &&DegreeTrial| t.supported()).map(|t| t.degree);
        if let Some(degree) = given.or(supported) {
            let with = fit.colours(images, &result.cameras, &result.splats, degree)?;
            (result.splats, result.stats.psnr) = (with.splats, with.stats.psnr);
        }
        progress.end();
    }
    result.stats.view_dependence = ViewDependence { degree: result.splats.sh_degree, trials };
    Ok(result)
}

/// Highest degree whose coefficients the device binds: they and their moments are the largest
/// buffers.
/// `range` is the largest binding, bytes.
fn highest(range: u64, splats: usize) -> u32 {
    let bytes = |degree: u32| (4 * 3 * sh_coefficients(degree) * splats) as u64;
    (0..=HIGHEST).rev().find(|d| bytes(*d) <= range).unwrap_or(0)
}

struct Fit<'a> {
    device: &'a Device,
    /// Coverage of all photos.
    coverage: &'a [Option<Coverage>],
    options: &'a ViewDependentOptions,
    progress: &'a dyn Progress,
}

impl Fit<'_> {
    /// Fits the colours at an SH degree; all other parameters stay.
    fn colours(
        &self,
        images: &[RgbImage],
        cameras: &[Camera],
        splats: &Splats,
        degree: u32,
    ) -> Result<Trained> {
        let mut start = splats.clone();
        start.raise_sh_degree(degree);
        let iterations = self.options.rounds * images.len();
        let options = RgbOptions {
            iterations,
            seed: self.options.seed,
            rates: Rates { sh_dc: self.options.rates[0], sh_rest: self.options.rates[1], ..Rates::STILL },
            virtual_views: 0,
            losses: Losses::PHOTOS,
            bounded: false,
            prune_every: 0,
            poses: None,
            report_every: iterations,
            ..RgbOptions::preset(Preset::Default)
        };
        let scale = SceneScale::measure(cameras, &start.means);
        let quiet = Quiet(self.progress);
        let photos = Photos { images, cameras, depths: None, coverage: self.coverage };
        fit_photos(self.device, photos, start, scale, &options, &quiet)
    }
}

/// Progress that forwards only warnings and cancellation, for parts of a stage.
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
    fn highest_degree_falls_with_splats() {
        // The coefficients of a splat of degree 3 take 4 · 3 · 16 = 192 bytes.
        let range = 128 << 20;
        let degrees = [100_000, 699_050, 699_051, 1_242_756, 1_242_757, 2_796_202, 10_000_000];
        assert_eq!(degrees.map(|splats| highest(range, splats)), [3, 3, 2, 2, 1, 1, 0]);
    }
}
