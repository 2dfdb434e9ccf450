//! Frames and scores of all protocols, and the decoded views of a scene.
use crate::{Error, Result};
use rayon::prelude::*;
use serde::Serialize;
use splatvk::eval::{Evaluation, GroundTruth, Split, to_scene};
use splatvk::photo::{join, stem};
use splatvk::pose::align::pose_errors;
use splatvk::query::{TextQuery, field_relevancy, relevancy_map};
use splatvk::scene::{Camera, Image, LanguageField};
use std::collections::BTreeMap;
use std::path::Path;

/// A published protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum ProtocolKind {
    /// LERF-OVS: one JSON of polygons and boxes per frame.
    Lerf,
    /// 3D-OVS: `segmentations/classes.txt` and one mask per frame and class.
    #[serde(rename = "3dovs")]
    Ovs,
    /// ScanNet with the eight labels of LSM.
    ScanNet,
}

/// A labelled frame with its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledView {
    /// File stem, the key of its labels.
    pub stem: String,
    /// Train = the scene was made from this photo.
    pub split: Split,
    /// Camera in the scene's world.
    pub camera: Camera,
}

/// Score of one prompt in one frame under one rule.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct Score {
    /// Frame file stem.
    pub frame: String,
    /// `train` or `test`.
    pub split: Split,
    /// The text of the query.
    pub phrase: String,
    /// Rule that cut the mask.
    pub rule: &'static str,
    /// Intersection over union with the truth.
    pub iou: f64,
    /// Level that answered, 0 = s; `None` if all levels compete per pixel.
    pub level: Option<usize>,
    /// Whether the most relevant pixel lies in a box of the truth; `None` if the protocol has no
    /// boxes.
    pub localised: Option<bool>,
    /// Whether no level met the rule, and its substitute answered.
    pub substituted: bool,
}

/// Means over one split.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ProtocolSummary {
    /// `miou` and the protocol's other figures.
    #[serde(flatten)]
    pub figures: BTreeMap<String, f64>,
    /// IoU per phrase or label, by the rule behind `miou`.
    pub iou: BTreeMap<String, f64>,
}

/// Scores of a data set, with their definitions.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct ProtocolReport {
    /// Name of the protocol.
    pub protocol: ProtocolKind,
    /// Definitions of the figures, one line each.
    pub definitions: Vec<String>,
    /// The [`Score::rule`] behind `miou`.
    #[serde(skip)]
    pub main_rule: &'static str,
    /// All scores.
    pub scores: Vec<Score>,
    /// Means per split that has frames.
    pub summary: BTreeMap<String, ProtocolSummary>,
}

/// Predicted masks: (phrase, mask).
pub type Masks = Vec<(String, Image<bool>)>;

/// A data set under a protocol.
pub trait Protocol {
    /// Labelled frames that have a camera.
    fn views(&self) -> &[LabelledView];
    /// Texts of the queries, in the order of [`CodeScores`].
    fn prompts(&self) -> Vec<String>;
    /// Scores the frame `views()[index]`; returns the masks of the protocol's first rule.
    fn add(&mut self, index: usize, decoded: &DecodedView) -> Result<Masks>;
    /// Computes the summaries and returns the report.
    fn finish(self: Box<Self>) -> ProtocolReport;
}

/// Score of each code for each prompt.
#[non_exhaustive]
pub struct CodeScores {
    /// [prompt][level][K]
    relevancy: Vec<Vec<Vec<f32>>>,
    /// [prompt][level][K]
    cosine: Vec<Vec<Vec<f32>>>,
}

impl CodeScores {
    /// Scores all codes of a field for all prompts.
    pub fn new(field: &LanguageField, prompts: &[TextQuery]) -> Result<Self> {
        let (mut relevancy, mut cosine) = (Vec::new(), Vec::new());
        for query in prompts {
            relevancy.push(field_relevancy(field, query)?);
            let levels = field.levels.iter().map(|l| {
                let rows = l.codebook.embeddings.chunks_exact(l.codebook.embedding_dim.max(1));
                rows.map(|row| row.iter().zip(&query.embedding).map(|(a, b)| a * b).sum()).collect()
            });
            cosine.push(levels.collect());
        }
        Ok(CodeScores { relevancy, cosine })
    }
}

/// One decoded frame.
pub struct DecodedView<'a> {
    /// Code per level and pixel, −1 = none.
    pub codes: &'a [Image<i32>],
    /// Scores of those codes.
    pub scores: &'a CodeScores,
}

impl DecodedView<'_> {
    /// (level, relevancy map) of the levels with codes; 0 for pixels without code.
    pub(super) fn relevancy(&self, prompt: usize) -> Vec<(usize, Image<f32>)> {
        let levels = self.codes.iter().zip(&self.scores.relevancy[prompt]).enumerate();
        let levels_with_codes = levels.filter(|(_, (_, values))| !values.is_empty());
        levels_with_codes.map(|(level, (codes, values))| (level, relevancy_map(codes, values))).collect()
    }

    /// (level, cosine map) of the levels with codes; −∞ for pixels without code.
    pub(super) fn cosine(&self, prompt: usize) -> Vec<(usize, Image<f32>)> {
        let levels = self.codes.iter().zip(&self.scores.cosine[prompt]).enumerate();
        let levels_with_codes = levels.filter(|(_, (_, values))| !values.is_empty());
        levels_with_codes
            .map(|(level, (codes, values))| {
                let data = codes.data.par_iter().map(|&k| cosine_of(values, k)).collect();
                (level, Image { width: codes.width, height: codes.height, data })
            })
            .collect()
    }

    /// Prompt with the highest cosine at any level per pixel, −1 for pixels without code; ties go
    /// to the earlier prompt.
    pub(super) fn best_prompt(&self) -> Result<Image<i32>> {
        let size =
            self.codes.first().ok_or_else(|| Error::work("the scene has no language level to query"))?;
        let mut best = Image::filled(size.width, size.height, (f32::NEG_INFINITY, -1i32));
        for prompt in 0..self.scores.cosine.len() {
            for (_, map) in self.cosine(prompt) {
                for (slot, &v) in best.data.iter_mut().zip(&map.data) {
                    if v > slot.0 {
                        *slot = (v, prompt as i32);
                    }
                }
            }
        }
        let data = best.data.iter().map(|b| b.1).collect();
        Ok(Image { width: best.width, height: best.height, data })
    }
}

/// Cosine of a code; −∞ for no code.
fn cosine_of(values: &[f32], code: i32) -> f32 {
    usize::try_from(code).ok().and_then(|k| values.get(k)).copied().unwrap_or(f32::NEG_INFINITY)
}

/// Value of `map` under the centre of pixel (x, y) of an image of another size.
pub(super) fn nearest<T: Copy>(map: &Image<T>, (x, y): (usize, usize), (width, height): (usize, usize)) -> T {
    let mx = ((x as f64 + 0.5) * map.width as f64 / width as f64) as usize;
    let my = ((y as f64 + 0.5) * map.height as f64 / height as f64) as usize;
    map.at(mx.min(map.width - 1), my.min(map.height - 1))
}

/// Intersection over union; the prediction is resampled to the truth's size by nearest pixel. 0 if
/// both are empty.
pub(super) fn mask_iou(predicted: &Image<bool>, truth: &Image<bool>) -> Result<f64> {
    if predicted.data.is_empty() {
        return Err(Error::work("eval: a mask without pixels"));
    }
    let (mut both, mut either) = (0u64, 0u64);
    for y in 0..truth.height {
        for x in 0..truth.width {
            let (p, t) = (nearest(predicted, (x, y), (truth.width, truth.height)), truth.at(x, y));
            both += u64::from(p && t);
            either += u64::from(p || t);
        }
    }
    Ok(both as f64 / either.max(1) as f64)
}

/// Cameras of the labelled frames: the scene's own for its photos; for others the known ones,
/// transformed by the similarity of the shared photos.
pub(super) fn labelled_views(
    stems: &[String],
    scene: &[Camera],
    known: &[Camera],
) -> Result<Vec<LabelledView>> {
    let names: Vec<&str> = known.iter().map(|c| c.name.as_str()).collect();
    let joined = |list: &[&str]| join(list, &names).map_err(|e| Error::input(format!("--cameras: {e}")));
    let of_scene = joined(&scene.iter().map(|c| c.name.as_str()).collect::<Vec<_>>())?;
    let of_labels = joined(&stems.iter().map(String::as_str).collect::<Vec<_>>())?;
    let pairs = scene.iter().zip(of_scene);
    let shared: Vec<(Camera, Camera)> =
        pairs.filter_map(|(c, k)| Some((c.clone(), known[k?].clone()))).collect();
    // The similarity needs two shared photos for its scale.
    let similarity = (shared.len() >= 2).then(|| {
        let (estimated, truth): (Vec<_>, Vec<_>) = shared.into_iter().unzip();
        pose_errors(&estimated, &truth, 1.0).similarity
    });
    let mut views = Vec::new();
    for (name, known_as) in stems.iter().zip(of_labels) {
        if let Some(camera) = scene.iter().find(|c| stem(&c.name) == *name) {
            views.push(LabelledView { stem: name.clone(), split: Split::Train, camera: camera.clone() });
        } else if let (Some(s), Some(k)) = (&similarity, known_as) {
            views.push(LabelledView {
                stem: name.clone(),
                split: Split::Test,
                camera: to_scene(&known[k], s),
            });
        }
    }
    if views.is_empty() {
        return Err(Error::input(format!(
            "none of the labelled frames ({}) is a photo of the scene; give --cameras with the data set's cameras, at \
             least two of them of photos that the scene was made from",
            stems.iter().take(5).cloned().collect::<Vec<_>>().join(", ")
        )));
    }
    Ok(views)
}

/// Labels of a `ground_truth.json` folder for the protocols that score masks per phrase.
pub(super) struct OwnLabels {
    pub(super) truth: GroundTruth,
    pub(super) views: Vec<LabelledView>,
    pub(super) phrases: Vec<(u32, String)>,
}

impl OwnLabels {
    pub(super) fn open(folder: &Path, scene: &[Camera]) -> Result<Option<Self>> {
        if !folder.join("ground_truth.json").is_file() {
            return Ok(None);
        }
        let truth = GroundTruth::read(folder)?;
        let evaluation = Evaluation::new(truth.clone(), scene, None)?;
        let phrases = evaluation.phrases();
        let cameras = evaluation.cameras().into_iter();
        let views = cameras.map(|(f, camera)| LabelledView { stem: f.stem, split: f.split, camera });
        Ok(Some(OwnLabels { truth, views: views.collect(), phrases }))
    }

    /// Object index per pixel of a view.
    pub(super) fn objects(&self, view: &LabelledView) -> Result<Option<Image<u32>>> {
        match self.truth.frames.iter().find(|f| f.stem == view.stem) {
            Some(frame) => self.truth.objects(frame),
            None => Ok(None),
        }
    }
}

pub(super) fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, n) = values.fold((0.0, 0usize), |(s, n), v| (s + v, n + 1));
    (n > 0).then(|| sum / n as f64)
}

/// Summary per split with scores: `figures`, and the mean IoU per phrase under `rule`.
pub(super) fn summarise(
    scores: &[Score],
    rule: &str,
    figures: impl Fn(&[&Score]) -> BTreeMap<String, f64>,
) -> BTreeMap<String, ProtocolSummary> {
    let mut out = BTreeMap::new();
    for split in [Split::Train, Split::Test, Split::Out] {
        let scores: Vec<&Score> = scores.iter().filter(|s| s.split == split).collect();
        if scores.is_empty() {
            continue;
        }
        let mut iou: BTreeMap<String, Vec<f64>> = BTreeMap::new();
        for s in scores.iter().filter(|s| s.rule == rule) {
            iou.entry(s.phrase.clone()).or_default().push(s.iou);
        }
        let iou = iou.into_iter().filter_map(|(k, v)| mean(v.into_iter()).map(|m| (k, m))).collect();
        out.insert(split.name().to_string(), ProtocolSummary { figures: figures(&scores), iou });
    }
    out
}
