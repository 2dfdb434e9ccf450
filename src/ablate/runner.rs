//! Runs setups as graphs of stages that share one store: setups that agree up to a stage share what that stage made.
use super::stages::{
    EncoderEmbeddings, MaskEmbeddings, ObjectEmbeddings, Score, Scored, SyntheticEmbeddings, SyntheticMasks,
};
use super::tables::{Available, NetworkFamily, Regions, Setup};
use crate::fit::{LanguageOptions, Preset, RgbOptions, Trained, TrainedLanguage};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::infer::installed::{Task, catalogue, inventory};
use crate::language::sam::SamOptions;
use crate::language::{Language, ViewMasks};
use crate::photo;
use crate::pipeline::{Graph, Output, Store};
use crate::progress::{Progress, Recorded};
use crate::query::TextQuery;
use crate::query::eval::{BACKGROUND_LABELS, GroundTruth, Split, TruthFrame};
use crate::run::ask;
use crate::run::sources::{
    self, DepthSources, FeatureSources, GeometrySources, GraphBuilder, MaskSources, MatchSources, PosedPhotos,
};
use crate::run::stages::{self, CameraOrigin, PlacedPhotos};
use crate::scene::Camera;
use crate::synth::regions;
use crate::{Error, Result};
use std::path::PathBuf;
use std::sync::Arc;

/// What came out of a setup.
#[derive(Clone)]
#[non_exhaustive]
pub struct RowFigures {
    /// Figures of protocol `field`, and agreement of decoded embeddings with the true ones.
    pub scored: Arc<Scored>,
    /// Splats of the finished scene.
    pub splats: usize,
    /// Codes per level.
    pub codes: Vec<usize>,
    /// Parameters, gradients, optimiser state and pixel planes of the features in training, bytes.
    pub feature_bytes: u64,
    /// Seconds of alignment, language stage and scoring.
    pub seconds: f64,
}

/// The machine, the data, and everything made so far.
pub struct Runner<'a> {
    device: Device,
    registry: Registry,
    /// The data set.
    pub truth: Arc<GroundTruth>,
    seed: u64,
    progress: &'a dyn Progress,
    store: Store,
}

/// The stages of a setup.
struct Stages {
    build: GraphBuilder,
    placed: Output<PlacedPhotos>,
    trained: Output<Trained>,
    aligned: Output<Language>,
    language: Output<TrainedLanguage>,
    scored: Output<Scored>,
    queries: Vec<TextQuery>,
}

/// Bytes that `channels` features of `splats` splats take while they are trained in views of `pixels` pixels: value, raw
/// value, gradient and two moments each, and a plane with its gradient per channel.
pub fn feature_bytes(splats: usize, channels: usize, pixels: usize) -> u64 {
    4 * channels as u64 * (5 * splats as u64 + 2 * pixels as u64)
}

fn pixels(placed: &PlacedPhotos) -> usize {
    placed.photos.iter().map(|p| p.image.data.len()).max().unwrap_or(0)
}

impl<'a> Runner<'a> {
    /// Opens the machine and the data.
    pub fn open(
        device: Device,
        registry: Registry,
        truth: GroundTruth,
        seed: u64,
        progress: &'a dyn Progress,
    ) -> Self {
        Runner { device, registry, truth: Arc::new(truth), seed, progress, store: Store::in_memory() }
    }

    /// Frames whose photos a scene of so many views is made from: train frames spread over their order, and held-out ones
    /// when they do not suffice.
    pub fn frames(&self, views: usize) -> Result<Vec<TruthFrame>> {
        let of =
            |split| -> Vec<&TruthFrame> { self.truth.frames.iter().filter(|f| f.split == split).collect() };
        let (train, test) = (of(Split::Train), of(Split::Test));
        let pick = |from: &[&TruthFrame], n: usize| -> Vec<TruthFrame> {
            photo::spread(from.len(), n).into_iter().map(|i| from[i].clone()).collect()
        };
        if views < 2 || views > train.len() + test.len() {
            return Err(Error::input(format!(
                "{}: {views} views of {} frames",
                self.truth.folder.display(),
                train.len() + test.len()
            )));
        }
        let mut frames = pick(&train, views.min(train.len()));
        if views > train.len() {
            frames.extend(pick(&test, views - train.len()));
        }
        Ok(frames)
    }

    /// What there is to compare.
    pub fn available(&self) -> Available {
        let of = |split| self.truth.frames.iter().filter(|f| f.split == split).count();
        let there = inventory(&self.registry);
        let families = |task| {
            let mut all: Vec<NetworkFamily> = Vec::new();
            for model in catalogue().iter().filter(|k| k.task == task) {
                let installed = there
                    .models
                    .iter()
                    .any(|m| m.tasks.contains(&task) && m.family == model.family && !m.untrained());
                if all.iter().all(|f| f.name != model.family) {
                    all.push(NetworkFamily { name: model.family.clone(), installed });
                }
            }
            all
        };
        // Half of the held-out frames must stay held out.
        let views = of(Split::Train) + of(Split::Test) / 2;
        Available { views, geometry: families(Task::Geometry), features: families(Task::Features) }
    }

    /// The stages of a setup, up to its figures.
    fn stages(&self, setup: &Setup) -> Result<Stages> {
        let frames = self.frames(setup.views)?;
        let paths: Vec<PathBuf> = frames.iter().map(|f| self.truth.folder.join(&f.file)).collect();
        let photos = photo::load_all(&paths, self.progress)?;
        let registry = &self.registry;
        let given = |r: &Regions| matches!(r, Regions::Found { features, .. } if features.argument.is_some());
        let mut build = GraphBuilder {
            graph: Graph::default(),
            registry: registry.clone(),
            sam: SamOptions::default(),
            given_features: given(&setup.regions),
            depth_prior: sources::default::<DepthSources>(),
            preset: Preset::Draft,
            seed: self.seed,
        };
        let posed = if setup.true_cameras {
            let named = |f: &TruthFrame| Camera { name: f.stem.clone(), ..f.camera.clone() };
            build.posed(photos, CameraOrigin::Known(frames.iter().map(named).collect()))?
        } else {
            sources::make::<GeometrySources>(&setup.init, registry, (&mut build, photos))?
        };
        let PosedPhotos { placed, geometry } = posed;
        let matches = sources::make::<MatchSources>(
            &sources::default::<MatchSources>(),
            registry,
            (&mut build, posed),
        )?;
        let options = self.rgb_options(setup);
        let trained = build.graph.add(stages::TrainColour { options }, (placed, geometry));
        let RegionData { masks, embeddings, queries, space } = self.described(setup, &mut build, posed)?;
        let (recipe, seed) = (setup.recipe, self.seed);
        let aligned = build.graph.add(stages::Align { recipe, space, seed }, (masks, matches, geometry));
        let options = LanguageOptions {
            iterations: setup.language_iterations,
            seed,
            // Every row trains equally long.
            check_every: 0,
            ..LanguageOptions::preset(Preset::Draft)
        };
        let language = build.graph.add(stages::TrainLanguage { recipe, options }, (placed, trained, aligned));
        let score = Score { truth: self.truth.clone(), queries: queries.clone() };
        let scored = build.graph.add(score, (trained, language, embeddings));
        Ok(Stages { build, placed, trained, aligned, language, scored, queries })
    }

    fn rgb_options(&self, setup: &Setup) -> RgbOptions {
        let mut options = RgbOptions::preset(Preset::Draft).with_iterations(setup.iterations);
        options.seed = self.seed;
        options.init.max_points = setup.max_points.unwrap_or(options.init.max_points);
        setup.recipe.rgb(options)
    }

    /// Masks with features, the true embedding of every object in the space of these features, and the questions.
    fn described(&self, setup: &Setup, build: &mut GraphBuilder, posed: PosedPhotos) -> Result<RegionData> {
        let (truth, placed) = (&self.truth, posed.placed);
        let (masks, features) = match &setup.regions {
            Regions::Synthetic(flaws) => {
                let (truth, flaws) = (truth.clone(), *flaws);
                let queries = self.phrases().iter().map(|p| regions::query(p)).collect();
                return Ok(RegionData {
                    masks: build.graph.add(SyntheticMasks { truth: truth.clone(), flaws }, (placed,)),
                    embeddings: build.graph.add(SyntheticEmbeddings { truth, flaws }, (placed,)),
                    queries,
                    space: "synthetic".into(),
                });
            }
            Regions::Found { masks, features } => (masks, features),
        };
        let encoder = sources::make::<FeatureSources>(features, &self.registry, &self.registry)?;
        let found = sources::make::<MaskSources>(masks, &self.registry, (build, posed))?;
        let masks = build.graph.add(stages::RegionFeatures { encoder: encoder.clone() }, (placed, found));
        let queries = encoder.with(|e| ask::embedded(&self.phrases(), e))?;
        let space = encoder.space().to_owned();
        let truth = truth.clone();
        let embeddings = if features.argument.is_some() {
            build.graph.add(MaskEmbeddings { truth }, (placed, masks))
        } else {
            build.graph.add(EncoderEmbeddings { truth, encoder }, (placed,))
        };
        Ok(RegionData { masks, embeddings, queries, space })
    }

    /// Phrases that the evaluation asks for, in its order.
    fn phrases(&self) -> Vec<String> {
        let all = self.truth.labels.values();
        all.filter(|p| !BACKGROUND_LABELS.contains(&p.as_str())).cloned().collect()
    }

    /// Runs a setup, as far as it was not run before.
    pub fn outcome(&mut self, setup: &Setup) -> Result<RowFigures> {
        let s = self.stages(setup)?;
        let targets = [s.placed.target(), s.aligned.target(), s.language.target(), s.scored.target()];
        let progress = Recorded::new(self.progress);
        let made = s.build.graph.run(&targets, &self.device, &self.registry, &self.store, &progress)?;
        let (placed, language, scored) = (made.get(s.placed)?, made.get(s.language)?, made.get(s.scored)?);
        let levels = &language.field.levels;
        let codes = levels.iter().map(|l| l.codebook.members.iter().filter(|m| !m.is_empty()).count());
        let channels: usize = levels.iter().map(|l| l.codebook.code_dim).sum();
        Ok(RowFigures {
            splats: language.splats.len(),
            codes: codes.collect(),
            feature_bytes: feature_bytes(language.splats.len(), channels, pixels(&placed)),
            seconds: made.seconds(s.aligned) + made.seconds(s.language) + made.seconds(s.scored),
            scored,
        })
    }

    /// Bytes of a setup's features in training if they were as long as the embeddings, on three levels.
    pub fn unreduced_bytes(&mut self, setup: &Setup) -> Result<u64> {
        let s = self.stages(setup)?;
        let targets = [s.placed.target(), s.trained.target()];
        let progress = Recorded::new(self.progress);
        let made = s.build.graph.run(&targets, &self.device, &self.registry, &self.store, &progress)?;
        let (placed, trained) = (made.get(s.placed)?, made.get(s.trained)?);
        let length = s.queries.first().map_or(0, |q| q.embedding.len());
        Ok(feature_bytes(trained.splats.len(), 3 * length, pixels(&placed)))
    }
}

/// What [`Runner::described`] adds.
struct RegionData {
    masks: Output<Vec<ViewMasks>>,
    embeddings: Output<ObjectEmbeddings>,
    queries: Vec<TextQuery>,
    space: String,
}
