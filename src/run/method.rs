//! The compared methods as configurations of one engine: each shares photos, cameras, stereo points
//! and every pass with the default, and changes only the authors' treatment of language.
use super::view::Viewer;
use crate::fit::scale::SceneScale;
use crate::fit::{
    self, FeatureStorage, LanguageOptions, Photos, Preset, RgbOptions, Start, TrainedLanguage, index_head,
};
use crate::gpu::Device;
use crate::infer::words;
use crate::language::align::AlignOptions;
use crate::language::{BuildOptions, Pooling, Reducer};
use crate::progress::Progress;
use crate::scene::{Camera, LanguageField, Splats};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// A method of the paper's comparison. All start from dense points of the photos, like the paper's
/// "-s" rows.
#[derive(Debug, PartialEq)]
pub struct Method {
    /// Name on the command line.
    pub name: &'static str,
    /// Description in one line.
    pub about: &'static str,
    /// Choices, with the code length of its authors.
    pub recipe: Recipe,
}

impl Serialize for Method {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name)
    }
}

impl<'de> Deserialize<'de> for &'static Method {
    fn deserialize<D: serde::Deserializer<'de>>(from: D) -> std::result::Result<Self, D::Error> {
        Method::named(&String::deserialize(from)?).map_err(serde::de::Error::custom)
    }
}

/// The method of this program.
pub static SPARSELGS: Method = Method {
    name: "sparselgs",
    about: "Alignment across views, a code per thing, photos in the loss",
    recipe: OURS,
};

/// A scene autoencoder (Qin et al. 2024).
pub static LANGSPLAT: Method = Method {
    name: "langsplat",
    about: "No alignment, a scene autoencoder to 3 numbers, features only",
    recipe: Recipe { reducer: AUTOENCODER, feature_dim: 3, ..UNALIGNED },
};

/// A quantised feature codebook with an index head and smoothing in space (Shi et al. 2024).
pub static LEGAUSSIANS: Method = Method {
    name: "legaussians",
    about: "No alignment, 128 quantised features read by an index head, smoothed in space",
    recipe: Recipe { reducer: Reducer::Quantised, feature_dim: 8, index_head: true, ..UNALIGNED },
};

/// After LSM (Fan et al. 2024; its network is not part of this program): no optimisation per scene.
pub static LSM: Method = Method {
    name: "lsm",
    about: "No alignment, features lifted onto the stereo points in one pass, nothing optimised",
    recipe: Recipe { optimise: false, language: LanguageFit::Lift, ..UNALIGNED },
};

/// Closed form (Cheng et al. 2024, Occam's LGS): the blending-weighted mean of the codes that a
/// splat is seen with.
pub static LIFT: Method = Method {
    name: "lift",
    about: "Alignment and codes as sparselgs; features are summed and normalised, not trained",
    recipe: Recipe { language: LanguageFit::Lift, ..OURS },
};

/// Values of `--method`. [`Method::by_default`] is one of the first two.
pub static METHODS: [&Method; 5] = [&SPARSELGS, &LIFT, &LANGSPLAT, &LEGAUSSIANS, &LSM];

/// Method that computes the features of the splats.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum LanguageFit {
    /// Training from the start of the preset.
    Train,
    /// One pass per photo: sum and normalise.
    Lift,
}

const OURS: Recipe = Recipe {
    steps: [true; 3],
    reducer: Reducer::Bijection,
    feature_dim: FEATURE_DIM,
    image_weight: IMAGE_WEIGHT,
    features_only: false,
    optimise: true,
    language: LanguageFit::Train,
    index_head: false,
    align: AlignOptions::DEFAULT,
    storage: FeatureStorage::Mixes,
};

const UNALIGNED: Recipe = Recipe {
    steps: [false; 3],
    image_weight: 0.0,
    features_only: true,
    storage: FeatureStorage::Numbers,
    ..OURS
};

/// Choices of a method.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Recipe {
    /// Alignment steps 1, 2, 3.
    pub steps: [bool; 3],
    /// Reduction of embeddings to codes.
    pub reducer: Reducer,
    /// Length of the codes.
    pub feature_dim: usize,
    /// Weight of the photometric loss in the language stage.
    pub image_weight: f64,
    /// Only features move in the language stage.
    pub features_only: bool,
    /// Whether colours are trained.
    pub optimise: bool,
    /// Method that computes the features of the splats.
    pub language: LanguageFit,
    /// Smooth features in space and train a head that reads the codebook index from them.
    pub index_head: bool,
    /// Thresholds and conditions of the alignment; `steps` disables the ones that a method lacks.
    pub align: AlignOptions,
    /// Form in which a scene keeps the features.
    pub storage: FeatureStorage,
}

impl Method {
    /// Finds a method by name.
    pub fn named(name: &str) -> Result<&'static Method> {
        METHODS.iter().find(|m| m.name == name).copied().ok_or_else(|| {
            let names: Vec<&str> = METHODS.iter().map(|m| m.name).collect();
            Error::input(format!("--method {name}: unknown; use one of: {}", names.join(", ")))
        })
    }

    /// The method of a run that names none. Training gains nothing over lifted features
    /// (docs/internals/experiments.md#measured-lifting), so features are trained only if a setting
    /// concerns the training: the paper's preset, a number of steps, or one model per level.
    pub fn by_default(
        preset: Option<Preset>,
        language_iterations: Option<usize>,
        per_level: bool,
    ) -> &'static Method {
        let trains = preset == Some(Preset::Paper) || language_iterations.is_some() || per_level;
        if trains { &SPARSELGS } else { &LIFT }
    }
}

/// Codes of up to 200 things stay apart at borders; with 3 numbers they do not
/// (docs/internals/method.md#code-length).
pub const FEATURE_DIM: usize = 16;

/// LangSplat trains on the masks of hundreds of photos; 100 epochs on those of a few photos would
/// leave it half trained.
pub const AUTOENCODER: Reducer = Reducer::Autoencoder { least_steps: 2000 };

/// λ2 of the paper.
const IMAGE_WEIGHT: f64 = 0.3;

impl Recipe {
    /// Options for [`crate::language::build`].
    pub fn build(&self, space: &str, seed: u64) -> BuildOptions {
        let [matching, fusion, reprojection] = self.steps;
        BuildOptions {
            align: AlignOptions {
                matching: matching && self.align.matching,
                fusion: fusion && self.align.fusion,
                reprojection: reprojection && self.align.reprojection,
                ..self.align
            },
            reducer: self.reducer,
            feature_dim: self.feature_dim,
            pooling: if words::is_space(space) { Pooling::Agreement } else { Pooling::Medoid },
            space: space.to_owned(),
            seed,
        }
    }

    /// The colour stage of this recipe.
    pub fn rgb(&self, options: RgbOptions) -> RgbOptions {
        if self.optimise { options } else { options.with_iterations(0) }
    }

    /// The language stage of this recipe, from codes and targets to features.
    pub(crate) fn train_language(
        &self,
        device: &Device,
        photos: Photos,
        splats: &Splats,
        field: LanguageField,
        options: LanguageOptions,
        progress: &dyn Progress,
    ) -> Result<TrainedLanguage> {
        let (options, seed) = (self.language(options.clone()), options.seed);
        let mut trained = fit::train_language_of(device, photos, splats, field, &options, progress)?;
        if self.index_head {
            train_index_heads(device, photos.cameras, &mut trained, seed)?;
        }
        Ok(trained)
    }

    /// The options of the language stage.
    fn language(&self, mut options: LanguageOptions) -> LanguageOptions {
        options.image_weight = self.image_weight;
        options.detach_geometry |= self.features_only;
        options.storage = self.storage;
        if matches!(self.reducer, Reducer::Autoencoder { .. }) {
            // Decoding every training pixel against 2048 directions takes longer on the CPU than
            // the training.
            options.check_every = 0;
        }
        // Codes of hundreds of numbers: the features of one level fill the largest buffer of a
        // device.
        options.per_level |= self.reducer == Reducer::Unreduced;
        match self.language {
            LanguageFit::Train => {}
            LanguageFit::Lift => (options.iterations, options.start) = (0, Start::Lifted),
        }
        options
    }
}

/// Labelled pixels per view for the training of an index head: some thousand in all determine its
/// few hundred parameters.
const HEAD_SAMPLES: usize = 4000;

/// Smooths the features in space and trains the index head of every level on the features rendered
/// in the photos' views.
fn train_index_heads(
    device: &Device,
    cameras: &[Camera],
    trained: &mut TrainedLanguage,
    seed: u64,
) -> Result<()> {
    let extent = SceneScale::measure(cameras, &trained.splats.means).extent;
    for level in &mut trained.field.levels {
        let d = level.features.len() / trained.splats.len().max(1);
        let own = level.splats.as_ref().unwrap_or(&trained.splats);
        index_head::smooth(own, &mut level.features, d, extent);
    }
    let mut viewer = Viewer::new(device, &trained.splats, &trained.field)?;
    let dims: Vec<usize> =
        trained.field.levels.iter().map(|l| l.features.len() / trained.splats.len().max(1)).collect();
    let total: usize = dims.iter().sum();
    let mut samples: Vec<(Vec<f32>, Vec<u32>)> = vec![Default::default(); dims.len()];
    for (view, camera) in cameras.iter().enumerate() {
        let frame = viewer.view_with_features(camera)?.rendered;
        let mut first = 0;
        for ((level, &d), (features, labels)) in trained.field.levels.iter().zip(&dims).zip(&mut samples) {
            let Some(targets) = level.targets.get(view) else { continue };
            let step = targets.data.len().div_ceil(HEAD_SAMPLES).max(1);
            for (p, &label) in targets.data.iter().enumerate().step_by(step) {
                if let Ok(label) = u32::try_from(label) {
                    let at = p * total + first;
                    features.extend_from_slice(&frame.features[at..at + d]);
                    labels.push(label);
                }
            }
            first += d;
        }
    }
    for (level, (features, labels)) in trained.field.levels.iter_mut().zip(samples) {
        index_head::train_head(&mut level.codebook, &features, &labels, seed);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::format::scene_dir::{self, Contents};
    use crate::gpu::test_device;
    use crate::progress::Silent;
    use crate::run::LanguageConfig;
    use crate::scene::{Codebook, Image, LevelField, RgbImage, Seen, World, seeded};

    /// A wall of 300 splats seen by one camera, with columns of three labels.
    fn labelled(code_dim: usize) -> (Splats, Camera, RgbImage, LanguageField) {
        let (width, height) = (75, 53);
        let (splats, camera) = seeded::small(300, width, height, 0, 3);
        let (width, height) = (width as usize, height as usize);
        let image = RgbImage { width, height, data: vec![[0.5; 3]; width * height] };
        let code = |k: usize| (0..code_dim).map(move |i| f32::from(u8::from(i == k)));
        let level = LevelField {
            codebook: Codebook {
                embedding_dim: 1,
                code_dim,
                embeddings: vec![1.0; 3],
                codes: (0..3).flat_map(code).collect(),
                weights: vec![1.0; 3],
                members: vec![Vec::new(); 3],
                min_chord: 1.0,
            },
            targets: vec![Image {
                width,
                height,
                data: (0..width * height).map(|p| (p / 9 % 3) as i32).collect(),
            }],
            ..LevelField::default()
        };
        (
            splats,
            camera,
            image,
            LanguageField {
                levels: vec![level, LevelField::default(), LevelField::default()],
                space: "test".into(),
            },
        )
    }

    /// A scene on disk has the features that were scored, and a baseline those of its authors.
    #[test]
    fn baseline_is_stored_as_trained() {
        let device = test_device();
        for method in METHODS {
            let recipe = method.recipe;
            let (splats, camera, image, field) = labelled(recipe.feature_dim);
            let photos = Photos {
                images: std::slice::from_ref(&image),
                cameras: std::slice::from_ref(&camera),
                depths: None,
                coverage: &[],
            };
            let options = LanguageOptions { iterations: 3, ..LanguageOptions::preset(Preset::Draft) };
            let trained = recipe.train_language(&device, photos, &splats, field, options, &Silent).unwrap();
            let level = &trained.field.levels[0];
            assert_eq!(level.mixes.is_empty(), recipe.storage == FeatureStorage::Numbers, "{}", method.name);
            let folder = tempfile::tempdir().unwrap();
            let contents = Contents {
                splats: &trained.splats,
                seen: &Seen::default(),
                backdrop: &Splats::default(),
                holes: &Splats::default(),
                cameras: std::slice::from_ref(&camera),
                world: &World::default(),
                photos: &[],
                points: None,
                language: Some(&trained.field),
                text_embeddings: None,
            };
            scene_dir::write(folder.path(), &contents).unwrap();
            let loaded = scene_dir::load(folder.path()).unwrap().language.unwrap();
            assert_eq!(loaded.levels[0].features, level.features, "{}", method.name);
            assert_eq!(loaded.levels[0].codebook.codes, level.codebook.codes, "{}", method.name);
        }
    }

    #[test]
    fn training_settings_select_trained_method() {
        let name = |preset, steps, per_level| Method::by_default(preset, steps, per_level).name;
        assert_eq!(name(None, None, false), "lift");
        assert_eq!(name(Some(Preset::Default), None, false), "lift");
        assert_eq!(name(Some(Preset::Paper), None, false), "sparselgs");
        assert_eq!(name(None, Some(30), false), "sparselgs");
        assert_eq!(name(None, None, true), "sparselgs");
        assert_eq!(
            LanguageConfig::default().recipe(Some(Preset::Paper)).language,
            LanguageFit::Train,
            "a configuration that names no method follows its preset"
        );
    }

    #[test]
    fn recipes_change_only_their_own_choices() {
        let preset = LanguageOptions::preset(Preset::Draft);
        let ours = SPARSELGS.recipe;
        assert_eq!(ours.language(preset.clone()), preset);
        assert_eq!(ours.rgb(RgbOptions::preset(Preset::Draft)), RgbOptions::preset(Preset::Draft));
        let build = ours.build("x", 3);
        assert_eq!(build, BuildOptions { space: "x".into(), seed: 3, ..BuildOptions::default() });
        let recipe = Recipe { language: LanguageFit::Train, ..LIFT.recipe };
        assert_eq!(recipe, ours);
        let expected = LanguageOptions { iterations: 0, start: Start::Lifted, ..preset.clone() };
        assert_eq!(LIFT.recipe.language(preset.clone()), expected);
        for method in [&LANGSPLAT, &LEGAUSSIANS, &LSM] {
            let recipe = method.recipe;
            let align = recipe.build("x", 0).align;
            assert!(!align.matching && !align.fusion && !align.reprojection, "{}", method.name);
            let language = recipe.language(preset.clone());
            assert!(language.detach_geometry && language.image_weight == 0.0);
            assert_eq!(language.iterations == 0, method.name == LSM.name);
        }
        assert_eq!(LSM.recipe.rgb(RgbOptions::preset(Preset::Draft)).iterations, 0);
    }
}
