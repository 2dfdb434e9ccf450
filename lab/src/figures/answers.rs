//! Questions about labelled frames, and the answers of a scene.
use crate::Result;
use crate::ablate::{Layout, MadeScene, Runner};
use splatvk::eval::{BACKGROUND_LABELS, Evaluation, GroundTruth, Split, TruthFrame};
use splatvk::gpu::Device;
use splatvk::query::{CanonicalCosines, QueryResult, TextQuery, answer_all};
use splatvk::run::Compat;
use splatvk::run::compat::query_options;
use splatvk::run::view::Viewer;
use splatvk::scene::{Camera, Image, RgbImage};
use std::collections::BTreeMap;

/// A phrase about a frame that shows the thing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Question {
    shot: usize,
    label: u32,
    /// Pixels of the thing.
    pixels: usize,
}

/// A labelled frame.
struct Shot {
    frame: TruthFrame,
    photo: RgbImage,
    objects: Image<u32>,
}

/// Labelled frames that are scored: held-out ones, or photos where a published protocol scores
/// those.
pub(super) struct Shots {
    truth: GroundTruth,
    layout: Layout,
    list: Vec<Shot>,
    questions: Vec<Question>,
}

impl Shots {
    /// Reads the frames for scenes of `views` photos.
    pub(super) fn of(lab: &Runner, views: usize) -> Result<Shots> {
        let data = lab.data();
        let (truth, layout) = (data.truth.clone(), data.layout);
        let frames = match layout {
            Layout::Own => truth.frames.iter().filter(|f| f.split == Split::Test).cloned().collect(),
            Layout::Published(_) => lab.frames(views)?,
        };
        let mut list = Vec::new();
        for frame in frames {
            let Some(objects) = truth.objects(&frame)? else { continue };
            let (width, height) = (frame.camera.width as usize, frame.camera.height as usize);
            let photo = truth.image(&frame)?.resized_by_area(width, height);
            list.push(Shot { frame, photo, objects: nearest(&objects, width, height) });
        }
        let questions = list.iter().enumerate().flat_map(|(shot, s)| questions(&truth, shot, &s.objects));
        Ok(Shots { questions: questions.collect(), truth, layout, list })
    }

    /// At most `most` questions of different phrases, about the largest things, each in the frame
    /// with most of it.
    pub(super) fn largest(&self, most: usize) -> Vec<Question> {
        let mut best: BTreeMap<u32, Question> = BTreeMap::new();
        for q in &self.questions {
            let kept = best.entry(q.label).or_insert(*q);
            if q.pixels > kept.pixels {
                *kept = *q;
            }
        }
        let mut all: Vec<Question> = best.into_values().collect();
        all.sort_by_key(|q| std::cmp::Reverse(q.pixels));
        all.truncate(most);
        all
    }

    /// Phrase and frame.
    pub(super) fn name(&self, q: &Question) -> String {
        format!("{}, {}", self.truth.labels[&q.label], self.list[q.shot].frame.stem)
    }

    pub(super) fn photo(&self, q: &Question) -> &RgbImage {
        &self.list[q.shot].photo
    }

    /// Pixels of the labelled thing.
    pub(super) fn mask(&self, q: &Question) -> Image<bool> {
        let objects = &self.list[q.shot].objects;
        let data = objects.data.iter().map(|label| *label == q.label).collect();
        Image { width: objects.width, height: objects.height, data }
    }

    /// IoU of an answer with the labelled thing.
    pub(super) fn iou(&self, q: &Question, answer: &QueryResult) -> f64 {
        let (mask, truth) = (answer.mask(), self.mask(q));
        let count = |both: fn(bool, bool) -> bool| {
            mask.data.iter().zip(&truth.data).filter(|(a, b)| both(**a, **b)).count()
        };
        count(|a, b| a && b) as f64 / count(|a, b| a || b).max(1) as f64
    }

    /// Cameras of the frames in the world of a scene.
    fn cameras(&self, scene: &[Camera]) -> Result<Vec<Camera>> {
        let all: Vec<(String, Camera)> = match self.layout {
            Layout::Own => {
                let evaluation = Evaluation::new(self.truth.clone(), scene, None)?;
                evaluation.cameras().into_iter().map(|(f, camera)| (f.stem, camera)).collect()
            }
            Layout::Published(_) => scene.iter().map(|c| (c.name.clone(), c.clone())).collect(),
        };
        let camera_of = |shot: &Shot| {
            let (frame, stem) = (&shot.frame, &shot.frame.stem);
            let found = all.iter().find(|(name, _)| splatvk::photo::stem(name) == *stem);
            let (width, height) = (frame.camera.width, frame.camera.height);
            found
                .map(|(_, camera)| camera.resized(width, height))
                .ok_or_else(|| crate::Error::work(format!("{stem}: the scene has no camera of this photo")))
        };
        self.list.iter().map(camera_of).collect()
    }
}

/// Questions about the things of a frame.
fn questions(truth: &GroundTruth, shot: usize, objects: &Image<u32>) -> Vec<Question> {
    let mut pixels: BTreeMap<u32, usize> = BTreeMap::new();
    objects.data.iter().for_each(|label| *pixels.entry(*label).or_default() += 1);
    let is_asked = |label: &u32| {
        truth.labels.get(label).is_some_and(|phrase| !BACKGROUND_LABELS.contains(&phrase.as_str()))
    };
    let shown = pixels.into_iter().filter(|(label, _)| is_asked(label));
    shown.map(|(label, pixels)| Question { shot, label, pixels }).collect()
}

/// The labels at another size: those of the nearest pixels.
fn nearest(labels: &Image<u32>, width: usize, height: usize) -> Image<u32> {
    let index = |i: usize, to: usize, from: usize| ((2 * i + 1) * from / (2 * to)).min(from - 1);
    let label =
        |i: usize| labels.at(index(i % width, width, labels.width), index(i / width, height, labels.height));
    Image { width, height, data: (0..width * height).map(label).collect() }
}

/// Answers of the scene of one method to all questions.
pub(super) struct Answered {
    pub(super) method: &'static str,
    answers: BTreeMap<(usize, u32), QueryResult>,
}

impl Answered {
    /// Asks a scene.
    pub(super) fn by(
        method: &'static str,
        lab: &Runner,
        scene: &MadeScene,
        shots: &Shots,
        compat: Option<&Compat>,
    ) -> Result<Answered> {
        let options = query_options(compat);
        let field = &scene.language.field;
        let phrases: BTreeMap<&str, &TextQuery> =
            scene.queries.iter().map(|q| (q.text.as_str(), q)).collect();
        let (device, _): (&Device, _) = lab.environment();
        let mut viewer = Viewer::new(device, &scene.language.splats, field)?;
        let mut answers = BTreeMap::new();
        for (shot, camera) in shots.cameras(&scene.trained.cameras)?.iter().enumerate() {
            let view = viewer.view(camera)?;
            for q in shots.questions.iter().filter(|q| q.shot == shot) {
                let Some(query) = phrases.get(shots.truth.labels[&q.label].as_str()) else { continue };
                let cosines = CanonicalCosines::new(field, &query.canonicals);
                let relevancy = cosines.relevancy(field, query, &options)?;
                let found = answer_all(std::slice::from_ref(&view.maps), &relevancy, &options, None)?;
                answers.extend(found.into_iter().map(|answer| ((shot, q.label), answer)));
            }
        }
        Ok(Answered { method, answers })
    }

    pub(super) fn answer(&self, q: &Question) -> &QueryResult {
        &self.answers[&(q.shot, q.label)]
    }

    /// Questions with the smallest IoU, the worst first.
    pub(super) fn worst(&self, shots: &Shots, most: usize) -> Vec<Question> {
        let mut all: Vec<(f64, Question)> =
            shots.questions.iter().map(|q| (shots.iou(q, self.answer(q)), *q)).collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0));
        all.into_iter().take(most).map(|(_, q)| q).collect()
    }
}
