//! Options of the training stages, and their presets.
use super::densify::DensifyOptions;
use super::losses::Losses;
use super::pose::PoseOptions;
use super::schedule::Exponential;
use crate::preset::Preset;
use serde::Serialize;

/// Initialisation of splats (docs/internals/method.md#splats-from-points).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InitOptions {
    /// Most splats; more points are thinned to an even density by voxels.
    pub max_points: usize,
    /// Opacity of a new splat, in (0, 1).
    pub opacity: f32,
    /// Standard deviation of a new splat in units of its pixel footprint (`PointCloud::radius`).
    pub footprint: f32,
    /// Upper bound of the standard deviation in units of the mean distance to the three nearest
    /// points.
    pub neighbours: f32,
    /// Standard deviation of a new splat along the normal of its surface, where that is known, over
    /// the one in the surface.
    pub thickness: f32,
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
    /// Rates of zero.
    pub const STILL: Rates = Rates {
        means: Exponential { start: 0.0, end: 0.0, steps: 1 },
        log_scales: 0.0,
        quats: 0.0,
        opacity: 0.0,
        sh_dc: 0.0,
        sh_rest: 0.0,
    };
}

/// Weight of the opacity loss: at 0.1, one photo pixel in seven keeps an alpha below 0.99, and views
/// beside the photos lose 0.8 dB; the photos gain 0.4 dB.
const OPACITY: Option<f64> = Some(1.5);

/// Photos from which on steps and splats grow with their number.
const MANY_PHOTOS: usize = 16;
/// Most splats that continue the surfaces beyond one photo's border; the border of a photo among many
/// is mostly within others.
const UNSEEN_PER_PHOTO: usize = 15_000;

/// Options of [`super::train_rgb`].
#[derive(Clone, Debug, PartialEq)]
pub struct RgbOptions {
    /// Optimisation steps; one view each.
    pub iterations: usize,
    /// Seeds the view order and thinning.
    pub seed: u64,
    /// Initialisation of the splats.
    pub init: InitOptions,
    /// Reach of continued surfaces beyond the photo borders, in units of the longer image side
    /// (needs depth maps); 0 = no surface is continued, also behind depth edges.
    pub margin: f64,
    /// Most splats of continued surfaces, those next to the ends of surfaces first.
    pub most_unseen: usize,
    /// Learning rates.
    pub rates: Rates,
    /// Blending weight, pixels, below which the colour of a splat hardly moves.
    pub colour_pixels: f64,
    /// Terms of the objective.
    pub losses: Losses,
    /// Number of virtual views, photos warped by their depth at half their resolution.
    pub virtual_views: usize,
    /// Least confidence of stereo depth that warps photos and continues surfaces; the depth loss
    /// takes all depth.
    pub min_confidence: f32,
    /// Whether splats are clamped: in every photo behind the least depth of that photo, and no
    /// larger than a share of their distance to the nearest camera. Applied at the start, when
    /// pruning, and at the end.
    pub bounded: bool,
    /// Opacity below which splats are pruned.
    pub prune_opacity: f32,
    /// Interval of pruning, steps; 0 = never.
    pub prune_every: usize,
    /// First step of pruning.
    pub prune_from: usize,
    /// Density control; `None` = off. Not for options with a margin or bounds, which move rows.
    pub densify: Option<DensifyOptions>,
    /// Camera refinement; `None` = off.
    pub poses: Option<PoseOptions>,
    /// Interval of points of the loss curve, steps.
    pub report_every: usize,
}

impl RgbOptions {
    /// The options of a preset.
    pub fn preset(preset: Preset) -> Self {
        match preset {
            Preset::Paper => Self::paper(),
            // Fewer steps need proportionally higher rates: with Adam a parameter moves by at most
            // about rate × steps.
            Preset::Draft => Self::draft(),
            Preset::Default => Self::short(),
        }
    }

    /// These options for a number of photos. Of more than 16, each is used as often as of
    /// 16; splats grow with the square root, since many photos overlap.
    pub fn for_photos(self, photos: usize) -> Self {
        let growth = (photos as f64 / MANY_PHOTOS as f64).max(1.0);
        let steps = (self.iterations as f64 * growth) as usize;
        let mut options = self.with_iterations(steps);
        options.init.max_points = (options.init.max_points as f64 * growth.sqrt()) as usize;
        options.most_unseen = UNSEEN_PER_PHOTO * photos.min(MANY_PHOTOS / 2);
        options
    }

    /// Most splats, of surfaces that photos show and of continued ones.
    pub fn most_splats(&self) -> usize {
        let growth = self.densify.map_or(1, |densify| densify.growth);
        growth * self.init.max_points + if self.margin > 0.0 { self.most_unseen } else { 0 }
    }

    /// Limits the number of splats to `most`.
    pub fn limit_splats(&mut self, most: usize) {
        self.most_unseen = self.most_unseen.min(most / 3);
        let shown = most - if self.margin > 0.0 { self.most_unseen } else { 0 };
        let growth = self.densify.map_or(1, |densify| densify.growth);
        self.init.max_points = self.init.max_points.min(shown / growth);
    }

    /// These options for another number of steps; schedules end with the run.
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

    /// These options, of all photos, for continuing a scene of `known` photos with `new` more: each
    /// new photo may add its share of the splats.
    pub fn for_continuation(self, known: usize, new: usize) -> Self {
        let mut options = RgbOptions { virtual_views: 0, ..self };
        options.init.max_points = (options.init.max_points * new).div_ceil((known + new).max(1));
        options
    }

    /// Options of the default preset. A thousand steps overfit a few photos: 0.9 dB more on them,
    /// 0.3 less on views between them (docs/internals/experiments.md#how-long-to-train).
    fn short() -> Self {
        RgbOptions { prune_every: 50, prune_from: 50, ..Self::scaled(200, 5.0) }
    }

    /// Options of the draft preset, with fewer splats: on breakfast two fifths less time and 0.4 dB
    /// more on held-out views, 1.2 dB less on the photos themselves.
    fn draft() -> Self {
        let mut options = Self::short();
        options.init.max_points = 130_000;
        options
    }

    fn scaled(iterations: usize, speed: f64) -> Self {
        let paper = Self::paper();
        RgbOptions {
            iterations,
            // Stereo points are dense, on surfaces and of the right colour, so splats start as
            // nearly opaque discs: from spheres of an opacity of 0.1, the first hundred steps would only
            // flatten them and raise it.
            init: InitOptions {
                max_points: 200_000,
                opacity: 0.85,
                footprint: 1.1,
                neighbours: 1.0,
                thickness: 0.5,
            },
            // No photo covers up to 14 % of the pixels of held-out breakfast views; all are within
            // this reach.
            margin: 0.3,
            rates: Rates {
                means: Exponential { start: 1.6e-4 * speed, end: 1.6e-5 * speed, steps: iterations },
                log_scales: 5e-3 * speed,
                quats: 1e-3 * speed,
                opacity: 0.02 * speed,
                sh_dc: 2.5e-3 * speed,
                sh_rest: 2.5e-3 / 20.0 * speed,
            },
            colour_pixels: 0.1,
            losses: Losses { depth: Some(0.3), needles: Some(1e-3), opacity: OPACITY, ..Losses::PHOTOS },
            min_confidence: 0.5,
            virtual_views: 12,
            bounded: true,
            densify: None,
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
                thickness: 1.0,
            },
            margin: 0.0,
            most_unseen: UNSEEN_PER_PHOTO * MANY_PHOTOS / 2,
            rates: Rates {
                means: Exponential { start: 1.6e-4, end: 1.6e-6, steps: 30_000 },
                log_scales: 5e-3,
                quats: 1e-3,
                opacity: 0.05,
                sh_dc: 2.5e-3,
                sh_rest: 2.5e-3 / 20.0,
            },
            colour_pixels: 0.0,
            losses: Losses::PHOTOS,
            virtual_views: 0,
            min_confidence: 0.5,
            bounded: false,
            prune_opacity: 0.005,
            prune_every: 100,
            prune_from: 200,
            densify: Some(DensifyOptions::PUBLISHED),
            poses: Some(PoseOptions { start: 0, rate: Exponential { start: 1e-4, end: 1e-6, steps: 1000 } }),
            report_every: 10,
        }
    }
}

/// Initialisation of features.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Start {
    /// Zero, as the paper.
    Zero,
    /// Mean of the codes of the pixels of a splat, weighted by its blending weights.
    Lifted,
}

/// Form in which a scene keeps the features of splats (docs/internals/method.md#feature-storage).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum FeatureStorage {
    /// Two codes of the codebook and a share: five bytes.
    Mixes,
    /// All numbers of the feature as it is rendered, as in the published methods.
    Numbers,
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
    /// Terms of L_img; depth and needles are not used here.
    pub losses: Losses,
    /// Learning rates of everything but the features (reduced,
    /// docs/internals/method.md#language-rates).
    pub rates: Rates,
    /// Learning rate of the features.
    pub feature_rate: f64,
    /// ε of `f̂ = f/(‖f‖+ε)` per level (docs/internals/method.md#feature-gauge); for features that
    /// start at zero, only the ratio of ε and learning rate matters.
    pub epsilon: f32,
    /// Initialisation of the features.
    pub start: Start,
    /// Whether every level has its own copy of the splats, as in the paper; otherwise all levels
    /// share one geometry.
    pub per_level: bool,
    /// Whether geometry, opacity and colour stay fixed and only the features are trained.
    pub detach_geometry: bool,
    /// Interval of measurements of the decode accuracy, steps; 0 = never. It is also measured after
    /// the last step.
    pub check_every: usize,
    /// Whether training stops when the decode accuracy gains less than 0.1 % in two measurements.
    pub stops_early: bool,
    /// Form in which the features are kept.
    pub storage: FeatureStorage,
}

impl LanguageOptions {
    /// The options of a preset.
    pub fn preset(preset: Preset) -> Self {
        let iterations = match preset {
            // Lifted features start near convergence: three times as many steps decode as many
            // pixels and find the same objects.
            Preset::Draft => 10,
            Preset::Default => 60,
            Preset::Paper => 1000,
        };
        let paper = preset == Preset::Paper;
        LanguageOptions {
            iterations,
            seed: 0,
            image_weight: 0.3,
            losses: if paper { Losses::PHOTOS } else { Losses { opacity: OPACITY, ..Losses::PHOTOS } },
            rates: Rates {
                means: Exponential { start: 3e-5, end: 3e-7, steps: 30_000 },
                log_scales: 1e-3,
                quats: 2e-4,
                opacity: 0.01,
                sh_dc: 1e-4,
                sh_rest: 1e-4 / 20.0,
            },
            // From zero: the dynamics of the paper (7e-9 at ε = 1e-9) scaled to the range of f32.
            // After lifting: 2.5e-3.
            feature_rate: if paper { 7e-3 } else { 2.5e-3 },
            epsilon: 1e-3,
            start: if paper { Start::Zero } else { Start::Lifted },
            per_level: paper,
            detach_geometry: false,
            // A measurement costs as much as three steps.
            check_every: if preset == Preset::Draft { iterations } else { (iterations / 4).min(50) },
            stops_early: !paper,
            storage: FeatureStorage::Mixes,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_and_splats_grow_with_many_photos() {
        let few = RgbOptions::preset(Preset::Draft);
        for photos in [2, MANY_PHOTOS] {
            let options = few.clone().for_photos(photos);
            assert_eq!(options.iterations, few.iterations);
            assert_eq!(options.init, few.init);
        }
        let many = few.clone().for_photos(100);
        assert_eq!(many.iterations, few.iterations * 100 / MANY_PHOTOS);
        assert_eq!(many.rates.means.steps, many.iterations, "the schedule ends with the run");
        assert_eq!(many.init.max_points, few.init.max_points * 10 / 4, "the root of 100 / 16");
        // Continued surfaces leave most of a small device to the surfaces that photos show.
        let mut limited = many;
        limited.limit_splats(120_000);
        assert_eq!(limited.most_splats(), 120_000);
        assert!(limited.init.max_points >= 80_000);
    }

    #[test]
    fn paper_trains_language_to_its_end() {
        let options = LanguageOptions::preset(Preset::Paper);
        assert_eq!((options.iterations, options.start, options.stops_early), (1000, Start::Zero, false));
        assert!(LanguageOptions::preset(Preset::Default).stops_early);
    }

    #[test]
    fn with_iterations_stretches_the_schedules() {
        for steps in [30, 3000] {
            let options = RgbOptions::preset(Preset::Draft).with_iterations(steps);
            for rate in [Some(options.rates.means), options.poses.map(|p| p.rate)].into_iter().flatten() {
                let share = |step: usize| rate.at(step) / rate.end;
                assert!((share(steps) - 1.0).abs() < 1e-9 && share(steps - 1) > 1.0001, "{steps}: {rate:?}");
            }
        }
        // The schedule of the paper is longer than its runs (docs/internals/method.md#schedules).
        let paper = RgbOptions::preset(Preset::Paper);
        assert_eq!(paper.clone().with_iterations(100).rates.means, paper.rates.means);
    }
}
