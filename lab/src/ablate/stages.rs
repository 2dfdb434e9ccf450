//! Stages of experiments: masks and features from ground truth, true embeddings of objects, and
//! figures.
use super::consistency::Consistency;
use super::data::DataSet;
use crate::generate::regions::{self, InjectedErrors};
use crate::protocol::{self, CodeScores, DecodedView, ProtocolKind, ProtocolReport};
use crate::{Error, Result};
use serde::Serialize;
use splatvk::eval::{EvalReport, Evaluation, GroundTruth, Split, TruthFrame};
use splatvk::fit::{Trained, TrainedLanguage};
use splatvk::language::{LevelMasks, ViewMasks, dir};
use splatvk::math::dot;
use splatvk::photo::Photo;
use splatvk::photo::stem;
use splatvk::pipeline::{Context, Lane, Output, Stage};
use splatvk::query::{QueryOptions, TextQuery};
use splatvk::run::score::{Questions, ScoredScene, score_field};
use splatvk::run::stages::{PlacedPhotos, SharedEncoder};
use splatvk::run::view::Viewer;
use splatvk::scene::{Codebook, Image, LanguageField, Splats};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Object index → its true unit embedding.
pub(super) type ObjectEmbeddings = BTreeMap<u32, Vec<f32>>;

/// Agreement of decoded embeddings with the true ones in one frame.
#[derive(Clone, Debug, Serialize)]
pub struct EmbeddingAgreement {
    /// File stem of the frame.
    pub frame: String,
    /// Split of the frame.
    pub split: Split,
    /// Mean cosine over labelled pixels.
    pub similarity: f64,
    /// Mean square difference, with every coordinate scaled to [0, 1] over the true embeddings.
    pub mse: f64,
}

/// Figures of a scene.
#[derive(Clone, Debug, Default)]
#[non_exhaustive]
pub struct Scored {
    /// Figures of protocol `field`; empty where the data set has a published layout.
    pub report: EvalReport,
    /// Figures of the published protocol of the data set's layout.
    pub published: Option<ProtocolReport>,
    /// Agreement of embeddings, per frame.
    pub agreement: Vec<EmbeddingAgreement>,
    /// Agreement of the decoded maps of all frames with each other, by true depth, on the coarsest
    /// level with codes.
    pub decoded: Option<Consistency>,
    /// Images of the models of single levels, where levels have models of their own.
    pub models: Vec<EvalReport>,
}

/// Ground-truth frame of each photo.
pub(super) fn frames_of<'t>(truth: &'t GroundTruth, photos: &[Photo]) -> Result<Vec<&'t TruthFrame>> {
    let frame_of = |p: &Photo| {
        let frame = truth.frames.iter().find(|f| stem(&f.file) == p.stem);
        frame.ok_or_else(|| Error::work(format!("{}: not a frame of the data set", p.path.display())))
    };
    photos.iter().map(frame_of).collect()
}

/// Makes true masks with synthetic features.
pub(super) struct SyntheticMasks {
    pub(super) truth: Arc<GroundTruth>,
    pub(super) flaws: InjectedErrors,
}

impl Stage for SyntheticMasks {
    const NAME: &'static str = "synthetic-masks";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Vec<ViewMasks>;

    fn settings(&self) -> String {
        format!("{:?} {:?}", self.truth.folder, self.flaws)
    }

    fn run(self, (placed,): (&PlacedPhotos,), _: &Context) -> Result<Vec<ViewMasks>> {
        Ok(regions::regions(&self.truth, &frames_of(&self.truth, &placed.photos)?, &self.flaws)?.masks)
    }
}

/// Makes the true embeddings of objects in the space of [`SyntheticMasks`].
pub(super) struct SyntheticEmbeddings {
    pub(super) truth: Arc<GroundTruth>,
    pub(super) flaws: InjectedErrors,
}

impl Stage for SyntheticEmbeddings {
    const NAME: &'static str = "synthetic-embeddings";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = ObjectEmbeddings;

    fn settings(&self) -> String {
        format!("{:?} {:?}", self.truth.folder, self.flaws)
    }

    fn run(self, (placed,): (&PlacedPhotos,), _: &Context) -> Result<ObjectEmbeddings> {
        Ok(regions::regions(&self.truth, &frames_of(&self.truth, &placed.photos)?, &self.flaws)?.embeddings)
    }
}

/// Computes each object's embedding of its true mask by an encoder, averaged over the photos.
pub(super) struct EncoderEmbeddings {
    pub(super) truth: Arc<GroundTruth>,
    pub(super) encoder: SharedEncoder,
}

impl Stage for EncoderEmbeddings {
    const NAME: &'static str = "encoder-embeddings";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = ObjectEmbeddings;

    fn settings(&self) -> String {
        format!("{:?} {}", self.truth.folder, self.encoder.identity())
    }

    fn run(self, (placed,): (&PlacedPhotos,), context: &Context) -> Result<ObjectEmbeddings> {
        let mut sums: Option<Sums> = None;
        for (frame, photo) in frames_of(&self.truth, &placed.photos)?.into_iter().zip(&placed.photos) {
            let Some(objects) = self.truth.objects(frame)? else { continue };
            let top = self.truth.labels.keys().max().map_or(0, |k| *k as usize);
            let data = objects.data.iter().map(|&o| o as i32).collect();
            let labels = Image { width: objects.width, height: objects.height, data };
            let (dim, rows) = self.encoder.with(|e| {
                e.embed_regions(&photo.image, &labels, top + 1, context.progress).map(|rows| (e.dim(), rows))
            })?;
            let sums = sums.get_or_insert_with(|| Sums::new(dim));
            for (label, row) in rows.chunks_exact(dim).enumerate() {
                sums.add(label as u32, row, 1.0);
            }
        }
        Ok(sums.map(Sums::unit).unwrap_or_default())
    }
}

/// Computes each object's embedding from the given masks of level l, averaged over its pixels.
pub(super) struct MaskEmbeddings {
    pub(super) truth: Arc<GroundTruth>,
}

impl Stage for MaskEmbeddings {
    const NAME: &'static str = "mask-embeddings";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>, Output<Vec<ViewMasks>>);
    type Output = ObjectEmbeddings;

    fn settings(&self) -> String {
        format!("{:?}", self.truth.folder)
    }

    fn run(self, (placed, masks): (&PlacedPhotos, &Vec<ViewMasks>), _: &Context) -> Result<ObjectEmbeddings> {
        let levels = masks.iter().flat_map(|v| &v.levels);
        let dim = levels.into_iter().find_map(|l| l.features.len().checked_div(l.quality.len()));
        let mut sums = Sums::new(dim.unwrap_or(0));
        for (frame, view) in frames_of(&self.truth, &placed.photos)?.into_iter().zip(masks) {
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
}

/// Queries the finished scene for every object in every frame, by protocol `field`.
pub(super) struct Score {
    pub(super) truth: Arc<GroundTruth>,
    /// Queries of the evaluation's phrases, in its order.
    pub(super) queries: Vec<TextQuery>,
    /// Options of the answers.
    pub(super) options: QueryOptions,
}

impl Stage for Score {
    const NAME: &'static str = "score";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<Trained>, Output<TrainedLanguage>, Output<ObjectEmbeddings>);
    type Output = Scored;

    fn settings(&self) -> String {
        // The queries are of the space of the language, which is an input.
        format!("{:?} {:?}", self.truth.folder, self.options)
    }

    fn run(
        self,
        (trained, language, embeddings): (&Trained, &TrainedLanguage, &ObjectEmbeddings),
        context: &Context,
    ) -> Result<Scored> {
        let evaluation = Evaluation::new((*self.truth).clone(), &trained.cameras, None)?;
        let (mut agreements, mut decoded_maps) = (Vec::new(), Vec::new());
        let scale = Scale::of(embeddings);
        let levels = &language.field.levels;
        let whole = levels.iter().rposition(|l| !l.codebook.is_empty());
        let report = score_field(
            context.device,
            ScoredScene { splats: &language.splats, backdrop: &trained.backdrop, field: &language.field },
            Questions { queries: &self.queries, options: self.options.clone() },
            evaluation,
            false,
            context.progress,
            &mut |frame, decoded| {
                let Some(level) = whole else { return Ok(()) };
                decoded_maps.push((frame.stem.clone(), decoded.codes[level].clone()));
                let Some(objects) = self.truth.objects(frame)? else { return Ok(()) };
                let book = &levels[level].codebook;
                agreements.extend(agreement(
                    frame,
                    &decoded.codes[level],
                    book,
                    &objects,
                    embeddings,
                    &scale,
                ));
                Ok(())
            },
        )?;
        let models = levels.iter().filter_map(|l| l.splats.as_ref());
        let models = models.map(|splats| self.images(trained, splats, context)).collect::<Result<_>>()?;
        let frame_of = |stem: &String| self.truth.frames.iter().find(|f| f.stem == *stem);
        let maps = decoded_maps.iter().filter_map(|(stem, codes)| Some((frame_of(stem)?, codes)));
        let decoded = match whole {
            Some(level) => Consistency::of_frames(&self.truth, maps, &levels[level].codebook)?,
            None => None,
        };
        Ok(Scored { report, agreement: agreements, published: None, decoded, models })
    }
}

impl Score {
    /// Scores the images of the model of one level.
    fn images(&self, trained: &Trained, splats: &Splats, context: &Context) -> Result<EvalReport> {
        let evaluation = Evaluation::new((*self.truth).clone(), &trained.cameras, None)?;
        let (backdrop, field) = (&trained.backdrop, &LanguageField::default());
        let scene = ScoredScene { splats, backdrop, field };
        let none = Questions { queries: &[], options: QueryOptions::default() };
        score_field(context.device, scene, none, evaluation, false, context.progress, &mut |_, _| Ok(()))
    }
}

/// Scores the finished scene by a published protocol.
pub(super) struct ScorePublished {
    pub(super) data: Arc<DataSet>,
    pub(super) kind: ProtocolKind,
    /// Queries of every phrase that the data set labels.
    pub(super) queries: Vec<TextQuery>,
}

impl Stage for ScorePublished {
    const NAME: &'static str = "score-published";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<Trained>, Output<TrainedLanguage>, Output<ObjectEmbeddings>);
    type Output = Scored;

    fn settings(&self) -> String {
        format!("{:?}", self.data.truth.folder)
    }

    fn run(
        self,
        (trained, language, embeddings): (&Trained, &TrainedLanguage, &ObjectEmbeddings),
        context: &Context,
    ) -> Result<Scored> {
        let truth = &self.data.truth;
        let mut protocol = protocol::open(self.kind, &self.data.labels, &trained.cameras, &self.data.known)?;
        let queries = queries_for(&protocol.prompts(), &self.queries);
        let scores = CodeScores::new(&language.field, &queries)?;
        let mut viewer = Viewer::new(context.device, &language.splats, &language.field)?;
        let (levels, scale) = (&language.field.levels, Scale::of(embeddings));
        let whole = levels.iter().rposition(|l| !l.codebook.is_empty());
        let mut agreements = Vec::new();
        let views = protocol.views().to_vec();
        context.progress.begin("eval", views.len() as u64);
        for (i, view) in views.iter().enumerate() {
            context.progress.check()?;
            let decoded = viewer.view(&view.camera)?;
            protocol.add(i, &DecodedView { codes: &decoded.codes, scores: &scores })?;
            let frame = truth.frames.iter().find(|f| f.stem == view.stem);
            if let (Some(level), Some(frame)) = (whole, frame)
                && let Some(objects) = truth.objects(frame)?
            {
                let (codes, book) = (&decoded.codes[level], &levels[level].codebook);
                let found = agreement(frame, codes, book, &objects, embeddings, &scale);
                agreements.extend(found.map(|a| EmbeddingAgreement { split: view.split, ..a }));
            }
            context.progress.step(i as u64 + 1, "");
        }
        context.progress.end();
        let published = Some(protocol.finish());
        Ok(Scored { published, agreement: agreements, ..Scored::default() })
    }
}

/// The queries of these texts, in their order; texts without a query are left out.
pub(super) fn queries_for(texts: &[String], queries: &[TextQuery]) -> Vec<TextQuery> {
    texts.iter().filter_map(|text| queries.iter().find(|q| q.text == *text)).cloned().collect()
}

/// Text of pixels without a label. Left without a mask, they would take the codes of neighbouring
/// objects.
const UNLABELLED: &str = "background";

/// Makes true masks on every level, each with the embedding of its label's text; pixels without a
/// label are one more mask.
pub(super) struct LabelledMasks {
    pub(super) truth: Arc<GroundTruth>,
    pub(super) encoder: SharedEncoder,
}

impl Stage for LabelledMasks {
    const NAME: &'static str = "labelled-masks";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Vec<ViewMasks>;

    fn settings(&self) -> String {
        format!("{:?} {}", self.truth.folder, self.encoder.identity())
    }

    fn run(self, (placed,): (&PlacedPhotos,), _: &Context) -> Result<Vec<ViewMasks>> {
        let words = label_embeddings(&self.truth, &self.encoder)?;
        let unlabelled = self.encoder.with(|e| e.embed_texts(&[UNLABELLED]))?;
        let mut views = Vec::new();
        for (frame, photo) in frames_of(&self.truth, &placed.photos)?.into_iter().zip(&placed.photos) {
            let objects = self.truth.objects(frame)?.ok_or_else(|| {
                Error::input(format!("{}: no true masks of {}", self.truth.folder.display(), frame.stem))
            })?;
            if (objects.width, objects.height) != (photo.image.width, photo.image.height) {
                return Err(Error::input(format!("{}: masks and photo differ in size", frame.stem)));
            }
            let shown: Vec<u32> = words.keys().copied().filter(|k| objects.data.contains(k)).collect();
            let index = |o: &u32| shown.iter().position(|k| k == o).unwrap_or(shown.len()) as i32;
            let labels: Vec<i32> = objects.data.iter().map(index).collect();
            let background = labels.contains(&(shown.len() as i32)).then_some(&unlabelled);
            let features = shown.iter().map(|k| &words[k]).chain(background).flatten().copied();
            let level = LevelMasks {
                labels: Image { width: objects.width, height: objects.height, data: labels },
                quality: vec![1.0; shown.len() + usize::from(background.is_some())],
                features: features.collect(),
                whole: Vec::new(),
            };
            views.push(ViewMasks { levels: vec![level; 3] });
        }
        Ok(views)
    }
}

/// Embeds the texts of the labels, in the space of [`LabelledMasks`].
pub(super) struct LabelEmbeddings {
    pub(super) truth: Arc<GroundTruth>,
    pub(super) encoder: SharedEncoder,
}

impl Stage for LabelEmbeddings {
    const NAME: &'static str = "label-embeddings";
    const LANE: Lane = Lane::Processor;
    type Inputs = ();
    type Output = ObjectEmbeddings;

    fn settings(&self) -> String {
        format!("{:?} {}", self.truth.folder, self.encoder.identity())
    }

    fn run(self, (): (), _: &Context) -> Result<ObjectEmbeddings> {
        label_embeddings(&self.truth, &self.encoder)
    }
}

fn label_embeddings(truth: &GroundTruth, encoder: &SharedEncoder) -> Result<ObjectEmbeddings> {
    let texts: Vec<&str> = truth.labels.values().map(String::as_str).collect();
    let rows = encoder.with(|e| e.embed_texts(&texts).map(|rows| (e.dim(), rows)));
    let (dim, rows) = rows?;
    Ok(truth.labels.keys().copied().zip(rows.chunks_exact(dim.max(1)).map(<[f32]>::to_vec)).collect())
}

/// Weighted sums of vectors per object.
struct Sums {
    dim: usize,
    rows: ObjectEmbeddings,
}

impl Sums {
    fn new(dim: usize) -> Self {
        Sums { dim, rows: ObjectEmbeddings::new() }
    }
    fn add(&mut self, label: u32, row: &[f32], weight: f32) {
        let sum = self.rows.entry(label).or_insert_with(|| vec![0.0; self.dim]);
        sum.iter_mut().zip(row).for_each(|(s, v)| *s += weight * v);
    }
    /// Normalises the sums and drops those that are zero.
    fn unit(mut self) -> ObjectEmbeddings {
        self.rows.values_mut().for_each(|row| dir::normalise_rows(row, self.dim));
        self.rows.retain(|_, row| row.iter().any(|v| *v != 0.0));
        self.rows
    }
}

/// Squared reciprocal of (max − min) per coordinate over the true embeddings; 0 where they do not
/// differ.
struct Scale(Vec<f32>);

impl Scale {
    fn of(embeddings: &ObjectEmbeddings) -> Self {
        let dim = embeddings.values().next().map_or(0, Vec::len);
        let coordinate_scale = |c: usize| {
            let (low, high) =
                embeddings.values().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(v[c]), h.max(v[c])));
            // Smaller differences of coordinates of unit vectors are rounding.
            if high - low > 1e-4 { 1.0 / (high - low).powi(2) } else { 0.0 }
        };
        Scale((0..dim).map(coordinate_scale).collect())
    }
}

/// Agreement of a decoded level with the true embedding of each pixel's object; pixels without a
/// code or an embedding are left out.
fn agreement(
    frame: &TruthFrame,
    codes: &Image<i32>,
    book: &Codebook,
    objects: &Image<u32>,
    embeddings: &ObjectEmbeddings,
    scale: &Scale,
) -> Option<EmbeddingAgreement> {
    let mut pairs: BTreeMap<(i32, u32), usize> = BTreeMap::new();
    // Index of the decoded pixel at the centre of labelled pixel `k`, along an axis; sizes differ.
    let decoded_index = |k: usize, from: usize, to: usize| ((2 * k + 1) * to / (2 * from)).min(to - 1);
    for (p, &o) in objects.data.iter().enumerate() {
        let (x, y) = (p % objects.width, p / objects.width);
        let column = decoded_index(x, objects.width, codes.width);
        let k = codes.at(column, decoded_index(y, objects.height, codes.height));
        if k >= 0 {
            *pairs.entry((k, o)).or_default() += 1;
        }
    }
    let (mut cosine, mut square, mut total) = (0.0f64, 0.0f64, 0usize);
    for ((k, o), n) in pairs {
        let Some(truth) = embeddings.get(&o) else { continue };
        let d = book.embedding_dim;
        // Means over photos are shorter than 1.
        let mut row = book.embeddings[k as usize * d..(k as usize + 1) * d].to_vec();
        dir::normalise_rows(&mut row, d);
        let sum: f32 = row.iter().zip(truth).zip(&scale.0).map(|((a, b), s)| s * (a - b) * (a - b)).sum();
        cosine += n as f64 * dot(&row, truth);
        square += n as f64 * f64::from(sum) / d as f64;
        total += n;
    }
    (total > 0).then(|| EmbeddingAgreement {
        frame: frame.stem.clone(),
        split: frame.split,
        similarity: cosine / total as f64,
        mse: square / total as f64,
    })
}
