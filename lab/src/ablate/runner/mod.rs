//! Runs setups as graphs of stages that share one store: setups that agree up to a stage share its
//! output.
mod graph;

use super::colmap::Views;
use super::consistency::Consistency;
use super::data::{DataSet, Layout, Scope};
use super::flat;
use super::setup::{Available, Flat, Network, Regime, RowWork, Setup, TableRow};
use super::shape::Shape;
use super::stages::{Scored, frames_of};
use crate::generate::regions;
use crate::{Error, Result};
use graph::known_cameras;
use serde::{Deserialize, Serialize};
use splatvk::eval::{BACKGROUND_LABELS, EvalReport, Evaluation, GroundTruth, Split, TruthFrame};
use splatvk::fit::{LanguageOptions, Preset, Trained, TrainedLanguage};
use splatvk::gpu::Device;
use splatvk::infer::Registry;
use splatvk::infer::installed::{Installed, Task, catalogue, inventory};
use splatvk::language::{Language, Reducer, ViewMasks};
use splatvk::photo::{self, Photo};
use splatvk::pipeline::{Context, Stage, Store};
use splatvk::pose::Geometry;
use splatvk::progress::{Progress, Recorded};
use splatvk::query::{QueryOptions, TextQuery};
use splatvk::run::ask;
use splatvk::run::method::LIFT;
use splatvk::run::score::{Questions, ScoredScene, score_field};
use splatvk::run::sources::{self, FeatureSources, MaskSources, SourceChoice};
use splatvk::run::stages::{self, PlacedPhotos, SharedEncoder};
use splatvk::scene::{LanguageField, LevelField, Splats};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Results of a setup.
#[derive(Clone)]
#[non_exhaustive]
pub struct RowFigures {
    /// Scores, and agreement of decoded embeddings with the true ones.
    pub scored: Arc<Scored>,
    /// Shape of the splats after the language stage.
    pub shape: Shape,
    /// Agreement of the aligned masks of the photos with each other, by true depth, on the coarsest
    /// level with codes. `None` without true depth.
    pub consistency: Option<Consistency>,
    /// Number of splats of the finished scene.
    pub splats: usize,
    /// Number of codes per level.
    pub codes: Vec<usize>,
    /// Bytes of parameters, gradients, optimiser state and pixel planes of the features in
    /// training.
    pub feature_bytes: u64,
    /// Seconds of alignment, language stage and scoring.
    pub seconds: f64,
    /// Seconds of both training stages.
    pub training_seconds: f64,
    /// Sum of the seconds of all stages from photos to the finished scene, shared ones included.
    pub total_seconds: f64,
}

/// Outputs of all stages that precede the training of splats.
#[derive(Clone, Serialize, Deserialize)]
pub struct Prepared {
    /// Photos of the scene.
    pub placed: PlacedPhotos,
    /// Their cameras, depth and points.
    pub geometry: Geometry,
    /// Codes of their masks.
    pub language: Language,
    /// Sum of the seconds of the stages up to the geometry.
    pub seconds: f64,
}

/// A scene of a setup.
#[non_exhaustive]
pub struct MadeScene {
    /// Photos of the scene.
    pub placed: Arc<PlacedPhotos>,
    /// Codes of their masks.
    pub aligned: Arc<Language>,
    /// Cameras and splats of the colour stage.
    pub trained: Arc<Trained>,
    /// Splats with features.
    pub language: Arc<TrainedLanguage>,
    /// Queries of the evaluation's phrases, in its order.
    pub queries: Vec<TextQuery>,
}

/// Runs setups on one data set and one device, and keeps their outputs.
pub struct Runner<'a> {
    device: &'a Device,
    registry: &'a Registry,
    data: Arc<DataSet>,
    truth: Arc<GroundTruth>,
    seed: u64,
    progress: &'a dyn Progress,
    store: Store,
    encoders: Vec<Encoder>,
    /// Setups that ran with this seed, and their results.
    done: Vec<(Setup, RowFigures)>,
}

/// An encoder with the embedded queries of the evaluation's phrases.
struct Encoder {
    choice: SourceChoice,
    encoder: SharedEncoder,
    queries: Vec<TextQuery>,
}

/// Stages whose outputs the store does not keep: trained features are large, and rows of one setup
/// share their results.
const PASSING: &[&str] = &["language"];

/// Bytes of `channels` features of `splats` splats in training on views of `pixels` pixels: value,
/// raw value, gradient and moments each, and an image with its gradient per channel.
pub fn feature_bytes(splats: usize, channels: usize, pixels: usize) -> u64 {
    4 * channels as u64 * (4 * splats as u64 + 2 * pixels as u64)
}

/// Pixels of the largest photo.
fn pixels(placed: &PlacedPhotos) -> usize {
    placed.photos.iter().map(|p| p.image.data.len()).max().unwrap_or(0)
}

impl<'a> Runner<'a> {
    /// Opens a data set on a device.
    pub fn open(
        device: &'a Device,
        registry: &'a Registry,
        data: DataSet,
        progress: &'a dyn Progress,
    ) -> Self {
        let store = Store::in_memory_without(PASSING);
        let (data, truth) = (Arc::new(data.clone()), Arc::new(data.truth));
        let (encoders, done) = (Vec::new(), Vec::new());
        Runner { device, registry, data, truth, seed: 0, progress, store, encoders, done }
    }

    /// Default number of photos: all train frames, at most as many as in the paper's runs.
    pub fn default_views(&self) -> usize {
        let train = self.truth.frames.iter().filter(|f| f.split == Split::Train).count();
        train.min(self.data.layout.views())
    }

    /// Sets the seed of the following setups, and drops the outputs that no setup has used since
    /// the last call.
    pub fn start_seed(&mut self, seed: u64) {
        self.store.forget_unused();
        self.done.clear();
        self.seed = seed;
    }

    /// Frames of the photos of a scene with `views` views: train frames spread over their order,
    /// and held-out frames where these do not suffice.
    pub fn frames(&self, views: usize) -> Result<Vec<TruthFrame>> {
        let frames_of =
            |split| -> Vec<&TruthFrame> { self.truth.frames.iter().filter(|f| f.split == split).collect() };
        let (train, test) = (frames_of(Split::Train), frames_of(Split::Test));
        if views < 2 || views > train.len() + test.len() {
            return Err(Error::input(format!(
                "{}: {views} views of {} frames",
                self.truth.folder.display(),
                train.len() + test.len()
            )));
        }
        let mut frames = spread_frames(&train, views.min(train.len()));
        if views > train.len() {
            frames.extend(spread_frames(&test, views - train.len()));
        }
        Ok(frames)
    }

    /// Frames on which all rows can be scored: held-out frames that are photos of no row, or the
    /// photos that all rows have.
    pub(super) fn scope<'r>(&self, rows: impl Iterator<Item = &'r TableRow>) -> Scope {
        let headline = self.data.layout.headline();
        let (mut seen, mut shared) = (BTreeSet::new(), None::<BTreeSet<String>>);
        for row in rows {
            let RowWork::Score(setup) = &row.runs else { continue };
            // A row with too few frames fails when it runs.
            let Ok(frames) = self.frames(setup.views) else { continue };
            let stems: BTreeSet<String> = frames.into_iter().map(|f| f.stem).collect();
            shared =
                Some(shared.map_or_else(|| stems.clone(), |s| s.intersection(&stems).cloned().collect()));
            seen.extend(stems);
        }
        let own = self.data.layout == Layout::Own;
        let in_scope = |f: &&TruthFrame| match headline {
            Split::Train => shared.as_ref().is_some_and(|s| s.contains(&f.stem)),
            split => !seen.contains(&f.stem) && (!own || f.split == split),
        };
        let frames = self.truth.frames.iter().filter(in_scope).map(|f| f.stem.clone()).collect();
        Scope { headline, frames }
    }

    /// Frames and networks that tables can compare.
    pub fn available(&self) -> Available {
        let count = |split| self.truth.frames.iter().filter(|f| f.split == split).count();
        let installed = inventory(self.registry).models;
        Available {
            // Half of the held-out frames must stay held out.
            views: count(Split::Train) + count(Split::Test) / 2,
            cameras: self.data.layout == Layout::Own || !self.data.known.is_empty(),
            published: self.data.layout != Layout::Own,
            models: Views::ALL.into_iter().filter_map(|v| Some((v, v.model(&self.truth.folder)?))).collect(),
            geometry: networks(&installed, Task::Geometry),
            matchers: networks(&installed, Task::Matcher),
            masks: networks(&installed, Task::Masks),
            features: networks(&installed, Task::Features),
        }
    }

    /// The progress of all work.
    pub fn progress(&self) -> &'a dyn Progress {
        self.progress
    }

    /// Device and networks.
    pub fn environment(&self) -> (&'a Device, &'a Registry) {
        (self.device, self.registry)
    }

    /// Runs all stages of a setup that precede the training of splats.
    pub fn prepared(&mut self, setup: &Setup) -> Result<Prepared> {
        let s = self.stages(setup)?;
        let targets = [s.placed.target(), s.geometry.target(), s.aligned.target()];
        let progress = Recorded::new(self.progress);
        let made = s.build.graph.run(&targets, self.device, self.registry, &self.store, &progress)?;
        let (placed, geometry) = ((*made.get(s.placed)?).clone(), (*made.get(s.geometry)?).clone());
        let seconds = made.seconds_in_all(s.geometry);
        Ok(Prepared { placed, geometry, language: (*made.get(s.aligned)?).clone(), seconds })
    }

    /// Scores a training of [`Runner::prepared`] by protocol `field`; with `words`, lifts its
    /// language and scores true masks with synthetic features.
    pub fn scored(&self, prepared: &Prepared, trained: &Trained, words: bool) -> Result<EvalReport> {
        let context = Context { device: self.device, registry: self.registry, progress: self.progress };
        let (mut field, mut queries) = (LanguageField::default(), Vec::new());
        if words {
            let options = LanguageOptions::preset(Preset::Draft);
            let lift = stages::TrainLanguage { recipe: LIFT.recipe, options };
            field = lift.run((&prepared.placed, trained, &prepared.language), &context)?.field;
            queries = self.phrases().iter().map(|p| regions::query(p)).collect();
        }
        let evaluation = Evaluation::new((*self.truth).clone(), &trained.cameras, None)?;
        let scene = ScoredScene { splats: &trained.splats, backdrop: &trained.backdrop, field: &field };
        let questions = Questions { queries: &queries, options: QueryOptions::default() };
        score_field(self.device, scene, questions, evaluation, false, self.progress, &mut |_, _| Ok(()))
    }

    /// An encoder with its queries. Both are made once, because the built-in encoder compares each
    /// phrase with a thousand others.
    fn encoder(&mut self, choice: &SourceChoice) -> Result<&Encoder> {
        let known = self.encoders.iter().position(|e| e.choice == *choice);
        let index = match known {
            Some(index) => index,
            None => {
                let encoder = sources::make::<FeatureSources>(choice, self.registry, self.registry)?;
                let queries = encoder.with(|e| ask::embedded(&self.phrases(), e))?;
                self.encoders.push(Encoder { choice: choice.clone(), encoder, queries });
                self.encoders.len() - 1
            }
        };
        Ok(&self.encoders[index])
    }

    /// Phrases that the evaluation may query, in its order.
    fn phrases(&self) -> Vec<String> {
        let own = self.data.layout == Layout::Own;
        let is_queried = |p: &&String| !own || !BACKGROUND_LABELS.contains(&p.as_str());
        self.truth.labels.values().filter(is_queried).cloned().collect()
    }

    /// Scores features of labelled photos, without a scene.
    pub fn flat(&mut self, choice: &Flat) -> Result<Scored> {
        let (data, truth, progress) = (self.data.clone(), self.truth.clone(), self.progress);
        let Encoder { encoder, queries, .. } = self.encoder(&choice.features)?;
        let (encoder, queries) = (encoder.clone(), queries.clone());
        let mut masks = match &choice.masks {
            Some(masks) => Some(self.flat_masks(masks, encoder.clone())?),
            None => None,
        };
        let mut photo_of = |frame: &TruthFrame| match &mut masks {
            Some(masks) => Ok(flat::of_masks(masks.remove(&frame.stem).unwrap_or_default(), encoder.space())),
            None => flat::of_cells(&truth.image(frame)?, &encoder, progress),
        };
        match data.layout {
            Layout::Own => flat::field(&truth, &queries, progress, &mut photo_of),
            Layout::Published(kind) => flat::published(&data, kind, &queries, progress, &mut photo_of),
        }
    }

    /// Masks of every frame with features, by the frame's stem.
    fn flat_masks(
        &self,
        masks: &SourceChoice,
        encoder: SharedEncoder,
    ) -> Result<BTreeMap<String, ViewMasks>> {
        let frames = &self.truth.frames;
        let mut build = self.graph_builder(Regime::OWN, false);
        let posed = build.posed(self.photos(frames)?, known_cameras(frames))?;
        let found = sources::make::<MaskSources>(masks, self.registry, (&mut build, posed))?;
        let found = build.graph.add(stages::RegionFeatures { encoder }, (posed.placed, found));
        let progress = Recorded::new(self.progress);
        let made = build.graph.run(&[found.target()], self.device, self.registry, &self.store, &progress)?;
        Ok(frames.iter().map(|f| f.stem.clone()).zip(made.get(found)?.iter().cloned()).collect())
    }

    /// Runs the stages of a setup that did not run before; returns its results.
    pub fn outcome(&mut self, setup: &Setup) -> Result<RowFigures> {
        if let Some((_, known)) = self.done.iter().find(|(s, _)| s == setup) {
            return Ok(known.clone());
        }
        let s = self.stages(setup)?;
        let ends = [s.placed.target(), s.geometry.target(), s.aligned.target(), s.trained.target()];
        let targets = [&ends[..], &[s.language.target(), s.scored.target()]].concat();
        let progress = Recorded::new(self.progress);
        let made = s.build.graph.run(&targets, self.device, self.registry, &self.store, &progress)?;
        let (placed, language, scored) = (made.get(s.placed)?, made.get(s.language)?, made.get(s.scored)?);
        let levels = &language.field.levels;
        let codes = levels.iter().map(|l| l.codebook.members.iter().filter(|m| !m.is_empty()).count());
        let length = |l: &LevelField| match setup.recipe.reducer {
            // Its codes are shorter than the embeddings that they stand for.
            Reducer::Unreduced => l.codebook.embedding_dim,
            _ => l.codebook.code_dim,
        };
        let channels: usize = levels.iter().map(length).sum();
        let (trained, geometry) = (made.get(s.trained)?, made.get(s.geometry)?);
        let views: Vec<_> = trained.cameras.iter().zip(&geometry.depths).collect();
        let own: Vec<&Splats> = levels.iter().filter_map(|l| l.splats.as_ref()).collect();
        let models = if own.is_empty() { vec![&language.splats] } else { own };
        let figures = RowFigures {
            consistency: self.consistency(&placed.photos, &made.get(s.aligned)?.field)?,
            shape: Shape::of(&trained.splats, &models, &views),
            splats: language.splats.len(),
            codes: codes.collect(),
            feature_bytes: feature_bytes(language.splats.len(), channels, pixels(&placed)),
            seconds: made.seconds(s.aligned) + made.seconds(s.language) + made.seconds(s.scored),
            training_seconds: made.seconds(s.trained) + made.seconds(s.language),
            total_seconds: made.seconds_in_all(s.language),
            scored,
        };
        self.done.push((setup.clone(), figures.clone()));
        Ok(figures)
    }

    /// Makes the scene of a setup, without scores.
    pub fn scene(&mut self, setup: &Setup) -> Result<MadeScene> {
        let s = self.stages(setup)?;
        let targets = [s.placed.target(), s.aligned.target(), s.trained.target(), s.language.target()];
        let progress = Recorded::new(self.progress);
        let made = s.build.graph.run(&targets, self.device, self.registry, &self.store, &progress)?;
        Ok(MadeScene {
            placed: made.get(s.placed)?,
            aligned: made.get(s.aligned)?,
            trained: made.get(s.trained)?,
            language: made.get(s.language)?,
            queries: s.queries,
        })
    }

    /// Aligns the masks of a setup with each other, without training.
    pub fn aligned(&mut self, setup: &Setup) -> Result<Arc<Language>> {
        let s = self.stages(setup)?;
        let progress = Recorded::new(self.progress);
        let made =
            s.build.graph.run(&[s.aligned.target()], self.device, self.registry, &self.store, &progress)?;
        made.get(s.aligned)
    }

    /// The frames, labels and cameras of the data set.
    pub fn data(&self) -> &DataSet {
        &self.data
    }

    /// Agreement of the code maps of the photos, on the coarsest level with codes.
    fn consistency(&self, photos: &[Photo], field: &LanguageField) -> Result<Option<Consistency>> {
        let Some(level) = field.levels.iter().rfind(|l| !l.codebook.is_empty()) else { return Ok(None) };
        let maps = frames_of(&self.truth, photos)?.into_iter().zip(&level.targets);
        Consistency::of_frames(&self.truth, maps, &level.codebook)
    }
}

/// Networks of a task: the trained ones that are installed, and one entry for every other known
/// family.
fn networks(installed: &[Installed], task: Task) -> Vec<Network> {
    let network = |name: &str, family: &str, fetch: Option<&String>| Network {
        name: name.to_owned(),
        family: family.to_owned(),
        fetch: fetch.cloned(),
    };
    let trained = installed.iter().filter(|m| m.tasks.contains(&task) && !m.untrained());
    let mut all: Vec<Network> = trained.map(|m| network(&m.name, &m.family, None)).collect();
    for known in catalogue().iter().filter(|k| k.does(task)) {
        if all.iter().all(|n| n.family != known.family) {
            all.push(network(&known.family, &known.family, Some(&known.id)));
        }
    }
    all
}

/// `count` of the frames, spread evenly over their order.
fn spread_frames(frames: &[&TruthFrame], count: usize) -> Vec<TruthFrame> {
    photo::spread(frames.len(), count).into_iter().map(|i| frames[i].clone()).collect()
}

#[cfg(test)]
mod tests {
    use super::super::setup::{Regions, Sources};
    use super::*;
    use splatvk::progress::Silent;
    use splatvk::run::method::SPARSELGS;

    #[test]
    fn scope_excludes_photos_of_any_row() {
        let (device, registry) = (splatvk::gpu::open(None).unwrap(), Registry::open(None).unwrap());
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/breakfast");
        let data = DataSet::open("breakfast".into(), folder.as_ref(), None).unwrap();
        let runner = Runner::open(&device, &registry, data, &Silent);
        let row = |views: usize| {
            let Sources { init, matcher, .. } = Sources::default();
            let setup = Setup {
                regime: Regime::OWN,
                views,
                init,
                true_cameras: true,
                matcher,
                points: None,
                max_points: None,
                regions: Regions::Exact,
                recipe: SPARSELGS.recipe,
                iterations: 1,
                language_iterations: 1,
            };
            let (label, group, note) = (views.to_string(), String::new(), String::new());
            TableRow { label, group, runs: RowWork::Score(Box::new(setup)), note }
        };
        // Four photos and eight held-out views, of which the second row takes two.
        let scope = runner.scope([row(4), row(6)].iter());
        let photos = runner.frames(6).unwrap();
        assert_eq!((photos.len(), scope.frames.len()), (6, 6));
        assert!(photos.iter().all(|f| !scope.frames.contains(&f.stem)), "{scope:?}");
    }
}
