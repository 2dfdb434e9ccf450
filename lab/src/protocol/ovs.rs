//! 3D-OVS (docs/internals/method.md#3d-ovs): the paper's rule, the same on normalised maps, the rule
//! of the authors' script, and the data set's own argmax.
use super::labels::{Labels, numbered, paint};
use super::score::{
    DecodedView, LabelledView, Masks, OwnLabels, Protocol, ProtocolKind, ProtocolReport, Score,
    labelled_views, mask_iou, mean, nearest, summarise,
};
use crate::{Error, Result};
use splatvk::eval::{BACKGROUND_LABELS, MIN_OBJECT_PIXELS, ObjectMaps, Split};
use splatvk::photo;
use splatvk::scene::{Camera, Image};
use splatvk_types::files;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// τ of the paper: minimum relevancy of a pixel of the answer.
const TAU: f32 = 0.8;
/// Minimum mask of a level that may answer, pixels of [`FULL_SIZE`] (paper).
const AREA: usize = 2000;
/// Pixels of the maps that the areas refer to: LangSplat reduces the photos to a height of 1080.
const FULL_SIZE: usize = 1440 * 1080;
/// Threshold if no level passes: share of the maximum of the best level.
const SUBSTITUTE: f32 = 0.95;
/// Threshold of the authors' script: share of the maximal cosine (its default; per scene .75 to
/// .95).
const BAR: f32 = 0.85;
/// Minimum mask in the authors' script, pixels of [`FULL_SIZE`].
const AUTHORS_AREA: usize = 3000;

const PAPER: &str = "paper";
const NORMALISED: &str = "normalised";
const AUTHORS: &str = "authors";
const ARGMAX: &str = "argmax";

/// Labels, and the scores so far.
pub(super) struct Ovs {
    views: Vec<LabelledView>,
    source: LabelSource,
    classes: Vec<String>,
    scores: Vec<Score>,
    /// Labelled pixels and correctly classified ones per split.
    pixels: BTreeMap<&'static str, [u64; 2]>,
}

enum LabelSource {
    /// `segmentations/`
    Folder(PathBuf),
    Own(OwnLabels),
}

impl Ovs {
    pub fn open(folder: &Path, scene: &[Camera], known: &[Camera]) -> Result<Self> {
        let (views, classes, source) = match OwnLabels::open(folder, scene)? {
            Some(own) => {
                // The argmax needs every label as a competitor, background labels included.
                let classes = own.truth.labels.values().cloned().collect();
                (own.views.clone(), classes, LabelSource::Own(own))
            }
            None => {
                let root = label_folder(folder);
                let classes = read_classes(&root)?;
                (labelled_views(&frames(&root)?, scene, known)?, classes, LabelSource::Folder(root))
            }
        };
        Ok(Ovs { views, source, classes, scores: Vec::new(), pixels: BTreeMap::new() })
    }

    /// Mask per class of a frame; `None` if the frame does not label it.
    fn truth(&self, view: &LabelledView) -> Result<Vec<Option<Image<bool>>>> {
        match &self.source {
            LabelSource::Folder(root) => {
                let class_mask = |class: &String| {
                    let path = root.join(&view.stem).join(format!("{class}.png"));
                    path.is_file().then(|| read_mask(&path)).transpose()
                };
                self.classes.iter().map(class_mask).collect()
            }
            LabelSource::Own(own) => {
                let Some(objects) = own.objects(view)? else { return Ok(vec![None; self.classes.len()]) };
                Ok(own.truth.labels.keys().map(|label| object_mask(&objects, *label)).collect())
            }
        }
    }
}

/// Mask of an object with at least [`MIN_OBJECT_PIXELS`].
fn object_mask(objects: &Image<u32>, label: u32) -> Option<Image<bool>> {
    let data: Vec<bool> = objects.data.iter().map(|&o| o == label).collect();
    let enough = data.iter().filter(|&&m| m).count() >= MIN_OBJECT_PIXELS;
    enough.then_some(Image { width: objects.width, height: objects.height, data })
}

/// Label folder of a scene's folder.
fn label_folder(folder: &Path) -> PathBuf {
    let inner = folder.join("segmentations");
    if inner.is_dir() { inner } else { folder.to_path_buf() }
}

/// Reads the labels as one image of object indices per frame.
pub(super) fn labels(folder: &Path) -> Result<Labels> {
    let root = label_folder(folder);
    let classes = read_classes(&root)?;
    let (stems, phrases) = (frames(&root)?, numbered(classes));
    let maps = Arc::new(Maps { root, phrases: phrases.clone() });
    Ok(Labels { stems, phrases, maps, cameras: Vec::new() })
}

#[derive(Debug)]
struct Maps {
    root: PathBuf,
    phrases: BTreeMap<u32, String>,
}

impl ObjectMaps for Maps {
    fn objects(&self, stem: &str) -> Result<Option<Image<u32>>> {
        let mut masks = Vec::new();
        for (label, class) in &self.phrases {
            let path = self.root.join(stem).join(format!("{class}.png"));
            if path.is_file() {
                masks.push((*label, read_mask(&path)?));
            }
        }
        Ok(paint(masks))
    }
}

fn read_classes(root: &Path) -> Result<Vec<String>> {
    let path = root.join("classes.txt");
    let text = files::read_text(&path).map_err(|e| {
        Error::input(format!("{e}; --protocol 3dovs wants a scene folder with segmentations/classes.txt"))
    })?;
    let classes: Vec<String> = text.lines().map(|l| l.trim().to_string()).filter(|l| !l.is_empty()).collect();
    if classes.is_empty() {
        Err(Error::input(format!("{}: no class in it", path.display())))
    } else {
        Ok(classes)
    }
}

fn frames(root: &Path) -> Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(root).map_err(Error::io(root))? {
        let path = entry.map_err(Error::io(root))?.path();
        if path.is_dir() {
            names.extend(path.file_name().map(|n| n.to_string_lossy().into_owned()));
        }
    }
    names.sort();
    Ok(names)
}

fn read_mask(path: &Path) -> Result<Image<bool>> {
    let image = photo::stored_pixels(path)?.to_luma8();
    let data = image.pixels().map(|p| p.0[0] > 127).collect();
    Ok(Image { width: image.width() as usize, height: image.height() as usize, data })
}

/// An answer: mask, level, whether the substitute threshold applied.
pub(super) type Answer = (Image<bool>, usize, bool);

fn threshold(map: &Image<f32>, above: f32) -> Image<bool> {
    Image { width: map.width, height: map.height, data: map.data.iter().map(|&v| v > above).collect() }
}

fn area(mask: &Image<bool>) -> usize {
    mask.data.iter().filter(|&&m| m).count()
}

/// Whether a mask of `pixels` has more than `least` pixels of [`FULL_SIZE`] in a map.
fn exceeds(pixels: usize, least: usize, map: &Image<f32>) -> bool {
    pixels * FULL_SIZE > least * map.data.len()
}

/// A map scaled from its minimum and maximum to 0 and 1; zeros for a map of one value.
fn normalised(map: &Image<f32>) -> Image<f32> {
    let low = map.data.iter().copied().fold(f32::INFINITY, f32::min);
    let range = maximum(map) - low;
    let scaled = |v: &f32| if range > 0.0 { (v - low) / range } else { 0.0 };
    Image { width: map.width, height: map.height, data: map.data.iter().map(scaled).collect() }
}

fn maximum(map: &Image<f32>) -> f32 {
    map.data.iter().copied().fold(f32::NEG_INFINITY, f32::max)
}

/// Rule of the paper: relevancy above τ per level; of the levels with more than 2000 such pixels,
/// the one with the highest mean. CLIP's relevancy hardly reaches τ; `scaled` applies it to
/// [`normalised`] maps, as LERF's protocol does with its threshold.
pub(super) fn paper_rule(levels: &[(usize, Image<f32>)], scaled: bool) -> Option<Answer> {
    let mut best: Option<(f64, Answer)> = None;
    for (level, map) in levels {
        let mask = if scaled { threshold(&normalised(map), TAU) } else { threshold(map, TAU) };
        let pixels = area(&mask);
        if !exceeds(pixels, AREA, map) {
            continue;
        }
        let inside = map.data.iter().zip(&mask.data).filter(|(_, m)| **m);
        let score = inside.map(|(v, _)| f64::from(*v)).sum::<f64>() / pixels as f64;
        if best.as_ref().is_none_or(|(s, _)| score > *s) {
            best = Some((score, (mask, *level, false)));
        }
    }
    if let Some((_, answer)) = best {
        return Some(answer);
    }
    let peak = levels.iter().map(|(_, m)| maximum(m)).fold(f32::NEG_INFINITY, f32::max);
    let (level, map) = levels.iter().find(|(_, m)| maximum(m) >= peak)?;
    Some((threshold(map, SUBSTITUTE * peak), *level, true))
}

/// Rule of the authors' script: cosine above 0.85 of its maximum on the levels m and l; the level
/// with the largest mask.
pub(super) fn authors_rule(levels: &[(usize, Image<f32>)]) -> Option<Answer> {
    let coarse: Vec<&(usize, Image<f32>)> = levels.iter().filter(|(l, _)| *l > 0).collect();
    let coarse = if coarse.is_empty() { levels.iter().collect() } else { coarse };
    let mut best: Option<(usize, Answer)> = None;
    for (level, map) in coarse {
        let mask = threshold(map, BAR * maximum(map));
        let pixels = area(&mask);
        if best.as_ref().is_none_or(|(n, _)| pixels > *n) {
            best = Some((pixels, (mask, *level, !exceeds(pixels, AUTHORS_AREA, map))));
        }
    }
    best.map(|(_, answer)| answer)
}

impl Protocol for Ovs {
    fn views(&self) -> &[LabelledView] {
        &self.views
    }

    fn prompts(&self) -> Vec<String> {
        self.classes.clone()
    }

    fn add(&mut self, index: usize, decoded: &DecodedView) -> Result<Masks> {
        let view = self.views[index].clone();
        let truth = self.truth(&view)?;
        let (mut masks, classes) = (Masks::new(), self.classes.clone());
        let best = decoded.best_prompt()?;
        let mut push = |class: usize, rule, iou, level, substituted| {
            self.scores.push(Score {
                frame: view.stem.clone(),
                split: view.split,
                phrase: classes[class].clone(),
                rule,
                iou,
                level,
                localised: None,
                substituted,
            });
        };
        for (class, target) in truth.iter().enumerate() {
            let Some(target) = target else { continue };
            let claimed = best.data.iter().map(|&k| k == class as i32).collect();
            let claimed = Image { width: best.width, height: best.height, data: claimed };
            push(class, ARGMAX, mask_iou(&claimed, target)?, None, false);
            if BACKGROUND_LABELS.contains(&classes[class].as_str()) {
                continue;
            }
            let relevancy = decoded.relevancy(class);
            if let Some((mask, level, substituted)) = paper_rule(&relevancy, false) {
                push(class, PAPER, mask_iou(&mask, target)?, Some(level), substituted);
                masks.push((classes[class].clone(), mask));
            }
            if let Some((mask, level, substituted)) = paper_rule(&relevancy, true) {
                push(class, NORMALISED, mask_iou(&mask, target)?, Some(level), substituted);
            }
            if let Some((mask, level, substituted)) = authors_rule(&decoded.cosine(class)) {
                push(class, AUTHORS, mask_iou(&mask, target)?, Some(level), substituted);
            }
        }
        let counted = accuracy(&best, &truth);
        let slot = self.pixels.entry(view.split.name()).or_default();
        *slot = [slot[0] + counted[0], slot[1] + counted[1]];
        Ok(masks)
    }

    fn finish(self: Box<Self>) -> ProtocolReport {
        ProtocolReport {
            protocol: ProtocolKind::Ovs,
            definitions: [
                "miou (the paper's text): per level relevancy > 0.8; of the levels with more than 2000 such pixels, of \
                 1440 x 1080, the one with the highest mean answers; where none has, relevancy > 0.95 of the best level's \
                 maximum (counted in `substituted`)",
                "miou_normalised: the same with each level's map scaled from its minimum and maximum to 0 and 1 for the \
                 threshold of 0.8 (counted in `substituted_normalised`)",
                "miou_authors (the authors' script): cosine > 0.85 of its maximum on levels m and l, the larger mask",
                "miou_argmax, accuracy_argmax (3D-OVS): every pixel goes to the class with the highest cosine at any level; \
                 accuracy over pixels that the truth labels",
                "each mIoU: plain mean over (frame, class) pairs that the truth labels; predictions resampled to the size \
                 of the truth",
            ]
            .map(String::from)
            .to_vec(),
            summary: summarise(&self.scores, PAPER, |scores| figures(scores, &self.pixels)),
            main_rule: PAPER,
            scores: self.scores,
        }
    }
}

/// Figures of the scores of one split; `pixels` are those of [`Ovs::pixels`].
fn figures(scores: &[&Score], pixels: &BTreeMap<&'static str, [u64; 2]>) -> BTreeMap<String, f64> {
    let mut out = BTreeMap::new();
    let rules = [
        (PAPER, "miou"),
        (NORMALISED, "miou_normalised"),
        (AUTHORS, "miou_authors"),
        (ARGMAX, "miou_argmax"),
    ];
    for (rule, name) in rules {
        let miou = mean(scores.iter().filter(|s| s.rule == rule).map(|s| s.iou));
        out.extend(miou.map(|m| (name.to_string(), m)));
    }
    let split = scores.first().map_or(Split::Train, |s| s.split);
    if let Some([all, right]) = pixels.get(split.name()).filter(|p| p[0] > 0) {
        out.insert("accuracy_argmax".into(), *right as f64 / *all as f64);
    }
    out.insert("pairs".into(), scores.iter().filter(|s| s.rule == PAPER).count() as f64);
    for (rule, name) in [(PAPER, "substituted"), (NORMALISED, "substituted_normalised")] {
        let substituted = scores.iter().filter(|s| s.rule == rule && s.substituted).count();
        out.insert(name.into(), substituted as f64);
    }
    out
}

/// (labelled pixels, correctly classified ones). Any of its classes is correct for a pixel of
/// several.
fn accuracy(best: &Image<i32>, truth: &[Option<Image<bool>>]) -> [u64; 2] {
    let Some(size) = truth.iter().flatten().next() else { return [0, 0] };
    let (mut all, mut right) = (0, 0);
    for y in 0..size.height {
        for x in 0..size.width {
            let has_label = |m: &Image<bool>| nearest(m, (x, y), (size.width, size.height));
            if !truth.iter().flatten().any(has_label) {
                continue;
            }
            all += 1;
            let k = nearest(best, (x, y), (size.width, size.height));
            let hit = usize::try_from(k).ok().and_then(|k| truth.get(k)?.as_ref()).is_some_and(has_label);
            right += u64::from(hit);
        }
    }
    [all, right]
}
