//! Runs setups, each stage once: setups that agree up to a stage share what that stage made.
use super::setup::{Init, Means, Setup, Source};
use crate::fit::{self, LanguageOptions, Preset, RgbOptions, Trained};
use crate::gpu::Device;
use crate::infer::installed::{Duty, inventory, known};
use crate::infer::{RegionEncoder, Registry, pairs};
use crate::language::align::PairLinks;
use crate::language::{self, ViewMasks};
use crate::photo::{self, Photo, stem};
use crate::pose::stereo::StereoOptions;
use crate::pose::{self, Geometry, InitChoice};
use crate::progress::Progress;
use crate::query::TextQuery;
use crate::query::eval::{Evaluation, Frame, GroundTruth, Report, Split};
use crate::run::score::score_field;
use crate::run::{FeatureSource, MaskSource, sources};
use crate::scene::{Camera, Plane, RgbImage};
use crate::synth::regions::{self, Flaws};
use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::rc::Rc;
use std::time::Instant;

/// Agreement of the rendered meaning with the true one in one frame.
#[derive(Clone, Debug, Serialize)]
pub struct Meaning {
    /// Frame file stem.
    pub frame: String,
    /// Held out or not.
    pub split: Split,
    /// Mean cosine over labelled pixels.
    pub similarity: f64,
    /// Mean square difference with every coordinate scaled to [0, 1] over the true meanings.
    pub mse: f64,
}

/// What came out of a setup.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Figures of protocol `field`.
    pub report: Report,
    /// Per frame.
    pub meaning: Vec<Meaning>,
    /// Splats of the finished scene.
    pub splats: usize,
    /// Codes per level.
    pub codes: Vec<usize>,
    /// Parameters, gradients, optimiser state and pixel planes of the features in training, bytes.
    pub feature_bytes: u64,
    /// Seconds of the language stage and of scoring.
    pub seconds: f64,
}

/// Masks with features, the questions, and what each object means.
struct Described {
    masks: Vec<ViewMasks>,
    queries: Vec<TextQuery>,
    /// Object index → unit embedding.
    meaning: BTreeMap<u32, Vec<f32>>,
    space: String,
}

/// Photos with their geometry.
struct Scene {
    photos: Vec<Photo>,
    images: Vec<RgbImage>,
    geometry: Geometry,
    matches: Vec<PairLinks>,
}

/// The machine, the data, and everything made so far.
pub struct Lab<'a> {
    device: Device,
    registry: Registry,
    /// The data set.
    pub truth: GroundTruth,
    seed: u64,
    progress: &'a dyn Progress,
    scenes: BTreeMap<String, Rc<Scene>>,
    trained: BTreeMap<String, Rc<Trained>>,
    described: BTreeMap<String, Rc<Described>>,
    outcomes: BTreeMap<String, Rc<Outcome>>,
}

fn key(value: &impl Serialize) -> Result<String> {
    serde_json::to_string(value).map_err(|e| Error::work(format!("ablate: {e}")))
}

/// Bytes that `channels` features of `splats` splats take while they are trained in views of `pixels` pixels: value, raw
/// value, gradient and two moments each, and a plane with its gradient per channel.
pub fn feature_bytes(splats: usize, channels: usize, pixels: usize) -> u64 {
    4 * channels as u64 * (5 * splats as u64 + 2 * pixels as u64)
}

impl<'a> Lab<'a> {
    /// Opens the machine and the data.
    pub fn open(
        device: Device,
        registry: Registry,
        truth: GroundTruth,
        seed: u64,
        progress: &'a dyn Progress,
    ) -> Self {
        Lab {
            device,
            registry,
            truth,
            seed,
            progress,
            scenes: BTreeMap::new(),
            trained: BTreeMap::new(),
            described: BTreeMap::new(),
            outcomes: BTreeMap::new(),
        }
    }

    /// Frames whose photos a scene of so many views is made from: train frames spread over their order, and held-out ones
    /// when they do not suffice.
    pub fn frames(&self, views: usize) -> Result<Vec<Frame>> {
        let of = |split| -> Vec<&Frame> { self.truth.frames.iter().filter(|f| f.split == split).collect() };
        let (train, test) = (of(Split::Train), of(Split::Test));
        let pick = |from: &[&Frame], n: usize| -> Vec<Frame> {
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
    pub fn means(&self) -> Means {
        let of = |split| self.truth.frames.iter().filter(|f| f.split == split).count();
        let there = inventory(&self.registry);
        let families = |duty| {
            let mut all: Vec<(String, bool)> = Vec::new();
            for model in known().iter().filter(|k| k.role == duty) {
                let installed = there
                    .models
                    .iter()
                    .any(|m| m.duties.contains(&duty) && m.family == model.family && !m.untrained());
                if all.iter().all(|(name, _)| *name != model.family) {
                    all.push((model.family.clone(), installed));
                }
            }
            all
        };
        // Half of the held-out frames must stay held out.
        let views = of(Split::Train) + of(Split::Test) / 2;
        Means { views, geometry: families(Duty::Geometry), features: families(Duty::Features) }
    }

    fn scene(&mut self, setup: &Setup) -> Result<Rc<Scene>> {
        let name = key(&(setup.views, &setup.init))?;
        if let Some(found) = self.scenes.get(&name) {
            return Ok(found.clone());
        }
        let frames = self.frames(setup.views)?;
        let paths: Vec<PathBuf> = frames.iter().map(|f| self.truth.folder.join(&f.file)).collect();
        let photos = photo::load_all(&paths, self.progress)?;
        let choice = match &setup.init {
            Init::Sfm => InitChoice::Sfm,
            Init::Network(name) => {
                let model = self.registry.installed(Duty::Geometry, name)?;
                let (views, maps) = pairs::pointmaps(&model, &photos, self.progress)?;
                InitChoice::Pointmaps(views, maps)
            }
            Init::TrueCameras => {
                let named = |f: &Frame| Camera { name: f.stem.clone(), ..f.camera.clone() };
                InitChoice::Cameras(frames.iter().map(named).collect())
            }
        };
        let (photos, geometry) = pose::initialise(
            &self.device,
            photos,
            &choice,
            &self.registry,
            &StereoOptions::preset(Preset::Draft),
            self.progress,
        )?;
        let images: Vec<RgbImage> = photos.iter().map(|p| p.image.clone()).collect();
        let dense = sources::dense(&images, &self.registry, self.progress)?;
        let matches = sources::matches(&dense, &geometry, self.progress)?;
        let scene = Rc::new(Scene { photos, images, geometry, matches });
        self.scenes.insert(name, scene.clone());
        Ok(scene)
    }

    fn trained(&mut self, setup: &Setup) -> Result<Rc<Trained>> {
        let optimise = setup.recipe.optimise;
        let name = key(&(setup.views, &setup.init, setup.max_points, setup.iterations, optimise))?;
        if let Some(found) = self.trained.get(&name) {
            return Ok(found.clone());
        }
        let scene = self.scene(setup)?;
        let mut options = RgbOptions::preset(Preset::Draft).with_iterations(setup.iterations);
        options.seed = self.seed;
        options.init.max_points = setup.max_points.unwrap_or(options.init.max_points);
        let options = setup.recipe.rgb(options);
        let g = &scene.geometry;
        let trained = fit::train_rgb(
            &self.device,
            &scene.images,
            &g.cameras,
            &g.points,
            Some(&g.depths),
            &options,
            self.progress,
        )?;
        let trained = Rc::new(trained);
        self.trained.insert(name, trained.clone());
        Ok(trained)
    }

    fn described(&mut self, setup: &Setup) -> Result<Rc<Described>> {
        let name = key(&(setup.views, &setup.init, &setup.source))?;
        if let Some(found) = self.described.get(&name) {
            return Ok(found.clone());
        }
        let scene = self.scene(setup)?;
        let described = match &setup.source {
            Source::Flawed(flaws) => self.synthetic(&scene, flaws)?,
            Source::Exact => self.synthetic(&scene, &Flaws::NONE)?,
            Source::BuiltIn => self.built_in(&scene, &FeatureSource::Words)?,
            Source::Network(name) => self.built_in(&scene, &FeatureSource::Network(name.clone()))?,
            Source::Dir(dir) => {
                let (masks, features) = (MaskSource::Dir(dir.clone()), FeatureSource::Dir(dir.clone()));
                let masks = sources::given_masks(&masks, &features, &scene.photos)?.unwrap_or_default();
                let mut encoder = sources::encoder(&features, &self.registry)?;
                let queries = self.queries(encoder.as_mut())?;
                let meaning = self.meaning_of_masks(&scene, &masks)?;
                Described { masks, queries, meaning, space: encoder.space().to_owned() }
            }
        };
        let described = Rc::new(described);
        self.described.insert(name, described.clone());
        Ok(described)
    }

    /// Phrases that the evaluation asks for, in its order.
    fn phrases(&self) -> Vec<(u32, String)> {
        let background = crate::query::eval::BACKGROUND_LABELS;
        let all = self.truth.labels.iter();
        all.filter(|(_, p)| !background.contains(&p.as_str())).map(|(k, p)| (*k, p.clone())).collect()
    }

    fn queries(&self, encoder: &mut dyn RegionEncoder) -> Result<Vec<TextQuery>> {
        let texts: Vec<String> = self.phrases().into_iter().map(|p| p.1).collect();
        sources::queries(&texts, encoder)
    }

    /// The frame of each photo of a scene.
    fn frames_of(&self, scene: &Scene) -> Result<Vec<&Frame>> {
        let find = |p: &Photo| {
            let frame = self.truth.frames.iter().find(|f| stem(&f.file) == p.stem);
            frame.ok_or_else(|| Error::work(format!("{}: not a frame of the data set", p.path.display())))
        };
        scene.photos.iter().map(find).collect()
    }

    fn synthetic(&self, scene: &Scene, flaws: &Flaws) -> Result<Described> {
        let made = regions::regions(&self.truth, &self.frames_of(scene)?, flaws)?;
        let queries = self.phrases().iter().map(|(_, p)| regions::query(p)).collect();
        Ok(Described { masks: made.masks, queries, meaning: made.meaning, space: "synthetic".into() })
    }

    fn built_in(&self, scene: &Scene, features: &FeatureSource) -> Result<Described> {
        let edges = sources::edges(&scene.images, &self.registry, self.progress)?;
        let masks = sources::graph_masks(&scene.images, &edges, &scene.geometry, self.progress)?;
        let mut encoder = sources::encoder(features, &self.registry)?;
        let masks = sources::with_features(masks, &scene.images, encoder.as_mut(), self.progress)?;
        let queries = self.queries(encoder.as_mut())?;
        let meaning = self.meaning_by(scene, encoder.as_mut())?;
        Ok(Described { masks, queries, meaning, space: encoder.space().to_owned() })
    }

    /// What an encoder says of each object's true mask, averaged over the photos.
    fn meaning_by(&self, scene: &Scene, encoder: &mut dyn RegionEncoder) -> Result<BTreeMap<u32, Vec<f32>>> {
        let mut sums = Sums::new(encoder.dim());
        for (frame, image) in self.frames_of(scene)?.into_iter().zip(&scene.images) {
            let Some(objects) = self.truth.objects(frame)? else { continue };
            let top = self.truth.labels.keys().max().map_or(0, |k| *k as usize);
            let data = objects.data.iter().map(|&o| o as i32).collect();
            let labels = Plane { width: objects.width, height: objects.height, data };
            let rows = encoder.embed_regions(image, &labels, top + 1)?;
            for (label, row) in rows.chunks_exact(encoder.dim()).enumerate() {
                sums.add(label as u32, row, 1.0);
            }
        }
        Ok(sums.unit())
    }

    /// What the given wholes say of each object, averaged over its pixels.
    fn meaning_of_masks(&self, scene: &Scene, masks: &[ViewMasks]) -> Result<BTreeMap<u32, Vec<f32>>> {
        let dim =
            masks.iter().flat_map(|v| &v.levels).find_map(|l| l.features.len().checked_div(l.quality.len()));
        let mut sums = Sums::new(dim.unwrap_or(0));
        for (frame, view) in self.frames_of(scene)?.into_iter().zip(masks) {
            let (Some(objects), Some(whole)) = (self.truth.objects(frame)?, view.levels.last()) else {
                continue;
            };
            if (objects.width, objects.height) != (whole.labels.width, whole.labels.height) {
                return Err(Error::input("ablate: masks and ground truth differ in size"));
            }
            for (&label, &mask) in objects.data.iter().zip(&whole.labels.data) {
                if let Ok(mask) = usize::try_from(mask) {
                    sums.add(label, &whole.features[mask * sums.dim..(mask + 1) * sums.dim], 1.0);
                }
            }
        }
        Ok(sums.unit())
    }

    /// Runs a setup, or returns what it gave before.
    pub fn outcome(&mut self, setup: &Setup) -> Result<Rc<Outcome>> {
        let name = key(setup)?;
        if let Some(found) = self.outcomes.get(&name) {
            return Ok(found.clone());
        }
        let scene = self.scene(setup)?;
        let (described, trained) = (self.described(setup)?, self.trained(setup)?);
        let clock = Instant::now();
        let build = setup.recipe.build(&described.space, self.seed);
        let g = &scene.geometry;
        let built =
            language::build(&described.masks, &g.cameras, &g.depths, &scene.matches, &build, self.progress)?;
        let options = LanguageOptions {
            iterations: setup.language_iterations,
            seed: self.seed,
            // Every row trains equally long.
            check_every: 0,
            ..LanguageOptions::preset(Preset::Draft)
        };
        let spoken = setup.recipe.speak(
            &self.device,
            &scene.images,
            &trained.cameras,
            &trained.splats,
            built.field,
            options,
            self.progress,
        )?;
        let evaluation = Evaluation::new(self.truth.clone(), &trained.cameras, None)?;
        let mut meaning = Vec::new();
        let scale = Scale::of(&described.meaning);
        let whole = spoken.field.levels.iter().rposition(|l| !l.codebook.is_empty());
        let report = score_field(
            &self.device,
            &spoken.splats,
            &spoken.field,
            &described.queries,
            evaluation,
            false,
            self.progress,
            &mut |frame, decoded| {
                let (Some(level), Some(objects)) = (whole, self.truth.objects(frame)?) else { return Ok(()) };
                let book = &spoken.field.levels[level].codebook;
                meaning.extend(agreement(
                    frame,
                    &decoded.codes[level],
                    book,
                    &objects,
                    &described.meaning,
                    &scale,
                ));
                Ok(())
            },
        )?;
        let pixels = scene.images.iter().map(|i| i.data.len()).max().unwrap_or(0);
        let channels: usize = spoken.field.levels.iter().map(|l| l.codebook.code_dim).sum();
        let outcome = Rc::new(Outcome {
            report,
            meaning,
            splats: spoken.splats.len(),
            codes: spoken
                .field
                .levels
                .iter()
                .map(|l| l.codebook.members.iter().filter(|m| !m.is_empty()).count())
                .collect(),
            feature_bytes: feature_bytes(spoken.splats.len(), channels, pixels),
            seconds: clock.elapsed().as_secs_f64(),
        });
        self.outcomes.insert(name, outcome.clone());
        Ok(outcome)
    }

    /// (splats, pixels of a photo, length of an embedding) of a setup, for figures that need no training.
    pub fn sizes(&mut self, setup: &Setup) -> Result<(usize, usize, usize)> {
        let (scene, trained, described) = (self.scene(setup)?, self.trained(setup)?, self.described(setup)?);
        let pixels = scene.images.iter().map(|i| i.data.len()).max().unwrap_or(0);
        let dim = described.queries.first().map_or(0, |q| q.embedding.len());
        Ok((trained.splats.len(), pixels, dim))
    }
}

/// Weighted sums of vectors per object.
struct Sums {
    dim: usize,
    rows: BTreeMap<u32, Vec<f32>>,
}

impl Sums {
    fn new(dim: usize) -> Self {
        Sums { dim, rows: BTreeMap::new() }
    }
    fn add(&mut self, label: u32, row: &[f32], weight: f32) {
        let sum = self.rows.entry(label).or_insert_with(|| vec![0.0; self.dim]);
        sum.iter_mut().zip(row).for_each(|(s, v)| *s += weight * v);
    }
    /// Unit vectors of those that are not zero.
    fn unit(mut self) -> BTreeMap<u32, Vec<f32>> {
        self.rows.values_mut().for_each(|row| crate::language::dir::normalise_rows(row, self.dim));
        self.rows.retain(|_, row| row.iter().any(|v| *v != 0.0));
        self.rows
    }
}

/// 1 / (max − min) per coordinate over the true meanings, squared; 0 where they do not differ.
struct Scale(Vec<f32>);

impl Scale {
    fn of(meaning: &BTreeMap<u32, Vec<f32>>) -> Self {
        let dim = meaning.values().next().map_or(0, Vec::len);
        let scale = |c: usize| {
            let (low, high) =
                meaning.values().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(v[c]), h.max(v[c])));
            // Coordinates of unit vectors that differ by less than this differ by rounding.
            if high - low > 1e-4 { 1.0 / (high - low).powi(2) } else { 0.0 }
        };
        Scale((0..dim).map(scale).collect())
    }
}

/// How well a decoded level agrees with the true meaning of each pixel's object; pixels without code or truth are left
/// out.
fn agreement(
    frame: &Frame,
    codes: &Plane<i32>,
    book: &crate::scene::Codebook,
    objects: &Plane<u32>,
    meaning: &BTreeMap<u32, Vec<f32>>,
    scale: &Scale,
) -> Option<Meaning> {
    let mut pairs: BTreeMap<(i32, u32), usize> = BTreeMap::new();
    if codes.data.len() != objects.data.len() {
        return None;
    }
    for (&k, &o) in codes.data.iter().zip(&objects.data).filter(|(k, _)| **k >= 0) {
        *pairs.entry((k, o)).or_default() += 1;
    }
    let (mut cosine, mut square, mut total) = (0.0f64, 0.0f64, 0usize);
    for ((k, o), n) in pairs {
        let Some(truth) = meaning.get(&o) else { continue };
        let d = book.embedding_dim;
        let row = &book.embeddings[k as usize * d..(k as usize + 1) * d];
        let dot: f32 = row.iter().zip(truth).map(|(a, b)| a * b).sum();
        let sum: f32 = row.iter().zip(truth).zip(&scale.0).map(|((a, b), s)| s * (a - b) * (a - b)).sum();
        cosine += n as f64 * f64::from(dot);
        square += n as f64 * f64::from(sum) / d as f64;
        total += n;
    }
    (total > 0).then(|| Meaning {
        frame: frame.stem.clone(),
        split: frame.split,
        similarity: cosine / total as f64,
        mse: square / total as f64,
    })
}
