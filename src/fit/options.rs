//! What the training stages can be told, and the presets.
use super::pose::PoseOptions;
use super::schedule::Exponential;
use crate::preset::Preset;

/// How splats start (docs/internals/method.md#splats-from-points).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InitOptions {
    /// At most this many splats; more points are thinned to an even density by voxels.
    pub max_points: usize,
    /// Opacity of a new splat, in (0, 1).
    pub opacity: f32,
    /// Standard deviation of a new splat in units of its pixel footprint (`PointCloud::radius`).
    pub footprint: f32,
    /// Upper bound of the standard deviation in units of the mean distance to the three nearest
    /// points.
    pub neighbours: f32,
}

/// Learning rates per parameter class.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Means, times the scene extent.
    pub means: Exponential,
    /// Log-scales.
    pub log_scales: f64,
    /// Quaternions.
    pub quats: f64,
    /// Opacity logits.
    pub opacity: f64,
    /// SH, DC coefficients.
    pub sh_dc: f64,
    /// SH, the other coefficients.
    pub sh_rest: f64,
}

impl Rates {
    /// Nothing moves.
    pub const STILL: Rates = Rates {
        means: Exponential { start: 0.0, end: 0.0, steps: 1 },
        log_scales: 0.0,
        quats: 0.0,
        opacity: 0.0,
        sh_dc: 0.0,
        sh_rest: 0.0,
    };
}

/// Options of [`super::train_rgb`].
#[derive(Clone, Debug, PartialEq)]
pub struct RgbOptions {
    /// Optimisation steps; one view each.
    pub iterations: usize,
    /// Seeds the view order and thinning.
    pub seed: u64,
    /// Start of the splats.
    pub init: InitOptions,
    /// How far surfaces are continued beyond the photo borders, in units of the longer image side
    /// (needs depth maps); 0 = nothing is continued, behind depth edges neither.
    pub margin: f64,
    /// Learning rates.
    pub rates: Rates,
    /// Share of the steps, from the first on, that see the photos at half their size.
    pub coarse: f64,
    /// Weight of mean |render − photo|.
    pub l1_weight: f64,
    /// Weight of 1 − SSIM.
    pub dssim_weight: f64,
    /// Weight of the relative depth difference to the stereo depth where that is confident; 0 =
    /// off.
    pub depth_weight: f64,
    /// Stereo depth counts only where its confidence is at least this.
    pub min_confidence: f32,
    /// Weight of `mean max(0, s_max/s_min − 8)`, against needles; 0 = off.
    pub ratio_weight: f64,
    /// No splat before everything that a photo shows, none larger than a share of its distance to
    /// the cameras: held at the start, when pruning, and in the end.
    pub bounded: bool,
    /// Drop splats with a lower opacity …
    pub prune_opacity: f32,
    /// … every so many steps (0 = never) …
    pub prune_every: usize,
    /// … from this step on.
    pub prune_from: usize,
    /// Camera refinement, if at all.
    pub poses: Option<PoseOptions>,
    /// A point of the loss curve every so many steps.
    pub report_every: usize,
}

impl RgbOptions {
    /// The options of a preset.
    pub fn preset(preset: Preset) -> Self {
        match preset {
            Preset::Paper => Self::paper(),
            // Fewer steps take proportionally longer ones: with Adam the distance a parameter can
            // travel is about rate × steps. Rates stay below the point where the loss oscillates
            // (means: a tenth of a pixel a step).
            Preset::Draft => Self::draft(),
            Preset::Default => Self::short(),
        }
    }

    /// No more than `most` splats in the end; `planned` is how many there would be with those
    /// beyond the photos' borders.
    pub fn limit_splats(&mut self, most: usize, planned: usize) {
        let beyond = planned.saturating_sub(self.init.max_points);
        self.init.max_points = self.init.max_points.min(most.saturating_sub(beyond));
    }

    /// The same options for another number of steps; schedules end with the run.
    pub fn with_iterations(mut self, iterations: usize) -> Self {
        self.iterations = iterations;
        if self.rates.means.steps < 30_000 {
            self.rates.means.steps = iterations;
        }
        if let Some(poses) = &mut self.poses {
            poses.start = poses.start.min(iterations / 10);
            poses.rate.steps = iterations;
        }
        self
    }

    /// The same options for a scene of `known` photos that goes on with `new` more: each may bring
    /// its share of the splats.
    pub fn for_continuation(self, known: usize, new: usize) -> Self {
        // Steps at half size, 0.6 of a run, would undo what the scene shows already: they are left
        // out, and of the others there are a few more, since new splats have seen none of them. Of
        // many photos each is seen as often as in a run with sixteen.
        let steps = self.iterations.div_ceil(2).max(self.iterations * (known + new) / 16);
        let mut options = RgbOptions { coarse: 0.0, ..self.with_iterations(steps) };
        options.init.max_points = (options.init.max_points * new).div_ceil((known + new).max(1));
        options
    }

    /// Most steps at half the photos' size. A thousand steps learn a few photos by heart: 0.9 dB
    /// more on them, 0.3 less on views between them
    /// (docs/internals/experiments.md#how-long-to-train).
    fn short() -> Self {
        RgbOptions { coarse: 0.6, ..Self::scaled(300, 2.0) }
    }

    /// Fewer splats: on breakfast two fifths less time and 0.4 dB more on held-out views, 1.2 dB
    /// less on the photos themselves.
    fn draft() -> Self {
        let mut options = Self::short();
        options.init.max_points = 130_000;
        options
    }

    fn scaled(iterations: usize, speed: f64) -> Self {
        let paper = Self::paper();
        RgbOptions {
            iterations,
            // Stereo points are dense and already have the right colour, so splats start nearly
            // opaque: from 0.1 the first hundred steps would only build up opacity.
            init: InitOptions { max_points: 200_000, opacity: 0.6, footprint: 0.7, neighbours: 1.0 },
            // Held-out breakfast views show up to 14 % of pixels that no photo covers, all within
            // this reach.
            margin: 0.3,
            rates: Rates {
                means: Exponential { start: 1.6e-4 * speed, end: 1.6e-5 * speed, steps: iterations },
                log_scales: 5e-3 * speed,
                quats: 1e-3 * speed,
                opacity: 0.025 * speed,
                sh_dc: 2.5e-3 * speed,
                sh_rest: 2.5e-3 / 20.0 * speed,
            },
            depth_weight: 0.02,
            min_confidence: 0.5,
            ratio_weight: 1e-3,
            bounded: true,
            poses: Some(PoseOptions {
                start: (iterations / 10).min(100),
                rate: Exponential { start: 1e-4, end: 1e-6, steps: iterations },
            }),
            ..paper
        }
    }

    fn paper() -> Self {
        RgbOptions {
            iterations: 1000,
            seed: 0,
            init: InitOptions {
                max_points: 1_000_000,
                opacity: 0.1,
                footprint: f32::INFINITY,
                neighbours: 1.0,
            },
            margin: 0.0,
            rates: Rates {
                means: Exponential { start: 1.6e-4, end: 1.6e-6, steps: 30_000 },
                log_scales: 5e-3,
                quats: 1e-3,
                opacity: 0.05,
                sh_dc: 2.5e-3,
                sh_rest: 2.5e-3 / 20.0,
            },
            coarse: 0.0,
            l1_weight: 0.8,
            dssim_weight: 0.2,
            depth_weight: 0.0,
            min_confidence: 0.5,
            ratio_weight: 0.0,
            bounded: false,
            prune_opacity: 0.005,
            prune_every: 100,
            prune_from: 200,
            poses: Some(PoseOptions { start: 0, rate: Exponential { start: 1e-4, end: 1e-6, steps: 1000 } }),
            report_every: 10,
        }
    }
}

/// What features start from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Start {
    /// Zero, as the paper.
    Zero,
    /// The mean of the codes that a splat is seen with, weighted by how much it is blended into
    /// their pixels.
    Lifted,
    /// The features whose blend is nearest to the codes of all labelled pixels, in the sense of
    /// least squares.
    LeastSquares,
}

/// Options of [`super::train_language`].
#[derive(Clone, Debug, PartialEq)]
pub struct LanguageOptions {
    /// Optimisation steps; one view each.
    pub iterations: usize,
    /// Seeds the view order.
    pub seed: u64,
    /// λ2 of `L = λ2·L_img + (1−λ2)·L_sem`.
    pub image_weight: f64,
    /// Learning rates of everything but the features (reduced,
    /// docs/internals/method.md#language-rates).
    pub rates: Rates,
    /// Learning rate of the features.
    pub feature_rate: f64,
    /// ε of `f̂ = f/(‖f‖+ε)` per level (docs/internals/method.md#feature-gauge); only the ratio of
    /// ε and learning rate matters when features start at zero.
    pub epsilon: f32,
    /// What the features start from.
    pub start: Start,
    /// Train every level on its own copy of the splats, as the paper; otherwise all levels share
    /// one geometry.
    pub per_level: bool,
    /// Keep geometry, opacity and colour fixed: only the features move.
    pub detach_geometry: bool,
    /// Measure the decode accuracy every so many steps and after the last one (0 = never), and stop
    /// when it gains less than 0.1 % in two measurements.
    pub check_every: usize,
}

impl LanguageOptions {
    /// The options of a preset.
    pub fn preset(preset: Preset) -> Self {
        let iterations = match preset {
            // Lifted features start near the end: three times as many steps decode as many pixels
            // and find the same objects.
            Preset::Draft => 10,
            Preset::Default => 60,
            Preset::Paper => 1000,
        };
        let paper = preset == Preset::Paper;
        LanguageOptions {
            iterations,
            seed: 0,
            image_weight: 0.3,
            rates: Rates {
                means: Exponential { start: 3e-5, end: 3e-7, steps: 30_000 },
                log_scales: 1e-3,
                quats: 2e-4,
                opacity: 0.01,
                sh_dc: 1e-4,
                sh_rest: 1e-4 / 20.0,
            },
            // From zero: the paper's dynamics (7e-9 at ε = 1e-9) scaled to numbers f32 holds. After
            // lifting: 2.5e-3.
            feature_rate: if paper { 7e-3 } else { 2.5e-3 },
            epsilon: 1e-3,
            start: if paper { Start::Zero } else { Start::Lifted },
            per_level: paper,
            detach_geometry: false,
            // A measurement costs as much as three steps.
            check_every: if preset == Preset::Draft { iterations } else { (iterations / 4).min(50) },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn with_another_number_of_steps_rates_fall_until_the_last_of_them() {
        for steps in [30, 3000] {
            let options = RgbOptions::preset(Preset::Draft).with_iterations(steps);
            for rate in [Some(options.rates.means), options.poses.map(|p| p.rate)].into_iter().flatten() {
                let share = |step: usize| rate.at(step) / rate.end;
                assert!((share(steps) - 1.0).abs() < 1e-9 && share(steps - 1) > 1.0001, "{steps}: {rate:?}");
            }
        }
        // That of the paper is longer than its runs (docs/internals/method.md#schedules).
        let paper = RgbOptions::preset(Preset::Paper);
        assert_eq!(paper.clone().with_iterations(100).rates.means, paper.rates.means);
    }
}
