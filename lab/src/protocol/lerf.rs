//! LERF-OVS as LangSplat evaluates it (docs/internals/method.md#lerf-ovs): polygons and boxes per
//! labelled frame.
use super::labels::{Labels, numbered, paint};
use super::polygon;
use super::score::{
    DecodedView, LabelledView, Masks, OwnLabels, Protocol, ProtocolKind, ProtocolReport, Score,
    labelled_views, mask_iou, mean, summarise,
};
use crate::{Error, Result};
use serde::Deserialize;
use splatvk::eval::{MIN_OBJECT_PIXELS, ObjectMaps};
use splatvk::query::filter;
use splatvk::scene::{Camera, Image, MAX_PIXELS};
use splatvk_types::files;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Thresholds on the re-normalised map, the first one behind `miou`: the paper's, LangSplat's.
const THRESHOLDS: [(f32, &str, &str); 2] = [(0.6, "thr0.6", "miou"), (0.4, "thr0.4", "miou_thr0.4")];

/// Texts beside label files ([`super::Texts`]).
pub(super) const TEXTS: &str = "texts.json";

/// Truth of one prompt in one frame.
#[derive(Clone, Debug, Default)]
pub(super) struct Target {
    /// [H, W] at the label's size.
    pub mask: Image<bool>,
    /// x1, y1, x2, y2 in label pixels, both ends inclusive.
    pub boxes: Vec<[f64; 4]>,
}

/// Labels, and the scores so far.
pub(super) struct Lerf {
    views: Vec<LabelledView>,
    /// Truth of each view by prompt.
    targets: Vec<BTreeMap<String, Target>>,
    prompts: Vec<String>,
    scores: Vec<Score>,
}

#[derive(Deserialize)]
struct File {
    info: Info,
    objects: Vec<Object>,
}

#[derive(Deserialize)]
struct Info {
    width: usize,
    height: usize,
}

#[derive(Deserialize)]
struct Object {
    category: String,
    #[serde(default)]
    segmentation: Vec<[f64; 2]>,
    #[serde(default)]
    bbox: Vec<f64>,
}

/// Parses a label file. Objects of one category are one target: the union of their masks, and all
/// their boxes.
pub(super) fn parse(text: &str, path: &Path) -> Result<BTreeMap<String, Target>> {
    let file: File = files::parse_json(text.as_bytes())
        .map_err(|e| Error::input(format!("{}: not a LERF-OVS label file: {e}", path.display())))?;
    let (width, height) = (file.info.width, file.info.height);
    let invalid = |problem: String| Error::input(format!("{}: {problem}", path.display()));
    let mut names: Vec<&str> = file.objects.iter().map(|o| o.category.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    let numbers = file.objects.iter().flat_map(|o| o.segmentation.as_flattened().iter().chain(&o.bbox));
    // NaN compares false.
    if !numbers.into_iter().all(|v| v.abs() <= polygon::FARTHEST) {
        return Err(invalid(format!("a corner is beyond {} pixels; check its objects", polygon::FARTHEST)));
    }
    if names.len().saturating_mul(width).saturating_mul(height) as u64 > MAX_PIXELS {
        return Err(invalid(format!(
            "{} objects of {width} × {height} pixels are too many; check its \"info\"",
            names.len()
        )));
    }
    let mut targets: BTreeMap<String, Target> = BTreeMap::new();
    for object in file.objects {
        let empty = || Target { mask: Image::filled(width, height, false), boxes: Vec::new() };
        let target = targets.entry(object.category).or_insert_with(empty);
        polygon::fill(&mut target.mask, &object.segmentation);
        if let [x1, y1, x2, y2] = object.bbox[..] {
            target.boxes.push([x1.min(x2), y1.min(y2), x1.max(x2), y1.max(y2)]);
        }
    }
    Ok(targets)
}

impl Lerf {
    pub fn open(folder: &Path, scene: &[Camera], known: &[Camera]) -> Result<Self> {
        let (views, targets) = match OwnLabels::open(folder, scene)? {
            Some(own) => from_masks(own)?,
            None => {
                let mut labels = read_folder(folder)?;
                let stems: Vec<String> = labels.keys().cloned().collect();
                let views = labelled_views(&stems, scene, known)?;
                let targets = views.iter().map(|v| labels.remove(&v.stem).unwrap_or_default()).collect();
                (views, targets)
            }
        };
        let mut prompts: Vec<String> =
            targets.iter().flat_map(|t: &BTreeMap<String, Target>| t.keys().cloned()).collect();
        prompts.sort();
        prompts.dedup();
        Ok(Lerf { views, targets, prompts, scores: Vec::new() })
    }
}

pub(super) fn read_folder(folder: &Path) -> Result<BTreeMap<String, BTreeMap<String, Target>>> {
    let mut labels = BTreeMap::new();
    for entry in std::fs::read_dir(folder).map_err(Error::io(folder))? {
        let path = entry.map_err(Error::io(folder))?.path();
        if path.extension().is_some_and(|e| e == "json") && !path.ends_with(TEXTS) {
            let text = files::read_text(&path)?;
            let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
            labels.insert(stem, parse(&text, &path)?);
        }
    }
    if labels.is_empty() {
        return Err(Error::input(format!(
            "{}: no label files; --protocol lerf wants the folder of frame_*.json of one scene (LERF-OVS label/SCENE)",
            folder.display()
        )));
    }
    Ok(labels)
}

/// Label images in memory: a LERF scene has a handful of labelled frames.
#[derive(Debug)]
struct LabelImages(BTreeMap<String, Image<u32>>);

impl ObjectMaps for LabelImages {
    fn objects(&self, stem: &str) -> Result<Option<Image<u32>>> {
        Ok(self.0.get(stem).cloned())
    }
}

/// Reads the labels as one image of object indices per frame.
pub(super) fn labels(folder: &Path) -> Result<Labels> {
    let frames = read_folder(folder)?;
    let mut names: Vec<String> = frames.values().flat_map(|f| f.keys().cloned()).collect();
    names.sort();
    names.dedup();
    let phrases = numbered(names);
    let stems: Vec<String> = frames.keys().cloned().collect();
    let number = |name: &String| phrases.iter().find(|p| p.1 == name).map_or(0, |p| *p.0);
    let label_image = |targets: BTreeMap<String, Target>| {
        paint(targets.into_iter().map(|(name, target)| (number(&name), target.mask)).collect())
    };
    let images =
        frames.into_iter().filter_map(|(stem, targets)| Some((stem, label_image(targets)?))).collect();
    if phrases.is_empty() {
        return Err(Error::input(format!("{}: no object in any label file", folder.display())));
    }
    Ok(Labels { stems, phrases, maps: Arc::new(LabelImages(images)), cameras: Vec::new() })
}

/// Truth from the masks of a ground-truth folder, each object with its bounding box.
fn from_masks(own: OwnLabels) -> Result<(Vec<LabelledView>, Vec<BTreeMap<String, Target>>)> {
    let mut all = Vec::new();
    for view in &own.views {
        let mut targets = BTreeMap::new();
        if let Some(objects) = own.objects(view)? {
            for (label, phrase) in &own.phrases {
                let target = target_of(&objects, *label);
                if target.mask.data.iter().filter(|&&m| m).count() >= MIN_OBJECT_PIXELS {
                    targets.insert(phrase.clone(), target);
                }
            }
        }
        all.push(targets);
    }
    Ok((own.views, all))
}

fn target_of(objects: &Image<u32>, label: u32) -> Target {
    let data: Vec<bool> = objects.data.iter().map(|&o| o == label).collect();
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for (p, _) in data.iter().enumerate().filter(|(_, m)| **m) {
        let pixel = [(p % objects.width) as f64, (p / objects.width) as f64];
        (0..2).for_each(|k| (low[k], high[k]) = (low[k].min(pixel[k]), high[k].max(pixel[k])));
    }
    let boxes = if low[0] <= high[0] { vec![[low[0], low[1], high[0], high[1]]] } else { Vec::new() };
    Target { mask: Image { width: objects.width, height: objects.height, data }, boxes }
}

impl Protocol for Lerf {
    fn views(&self) -> &[LabelledView] {
        &self.views
    }

    fn prompts(&self) -> Vec<String> {
        self.prompts.clone()
    }

    fn add(&mut self, index: usize, decoded: &DecodedView) -> Result<Masks> {
        let view = &self.views[index];
        let mut masks = Masks::new();
        for (phrase, target) in &self.targets[index] {
            let Some(prompt) = self.prompts.iter().position(|p| p == phrase) else { continue };
            let levels = decoded.relevancy(prompt);
            let boxed: Vec<Image<f32>> = levels.iter().map(|(_, raw)| filter::box30(raw)).collect();
            let localised = Some(localised(&boxed, target));
            let blended: Vec<Image<f32>> =
                levels.iter().zip(&boxed).map(|((_, raw), b)| filter::blend(raw, b)).collect();
            let Some(best) = highest_level(&blended) else { continue };
            for (threshold, rule, _) in THRESHOLDS {
                let mask = filter::lerf_mask(&blended[best], threshold);
                self.scores.push(Score {
                    frame: view.stem.clone(),
                    split: view.split,
                    phrase: phrase.clone(),
                    rule,
                    iou: mask_iou(&mask, &target.mask)?,
                    level: Some(levels[best].0),
                    localised,
                    substituted: false,
                });
                if rule == THRESHOLDS[0].1 {
                    masks.push((phrase.clone(), mask));
                }
            }
        }
        Ok(masks)
    }

    fn finish(self: Box<Self>) -> ProtocolReport {
        ProtocolReport {
            protocol: ProtocolKind::Lerf,
            definitions: [
                "per frame and prompt: relevancy smoothed by a 30x30 mean, averaged with itself; the level with the \
                 highest peak answers (ties: the finer)",
                "mask: clip(2o-1, 0, 1) > 0.6 with o the min-max-normalised map, then a 7x7 majority; miou_thr0.4 the same \
                 with 0.4 (LangSplat)",
                "miou: plain mean of IoU over all (frame, prompt) pairs; several objects of one category are one mask",
                "localisation: share of pairs where a most relevant pixel of the 30x30 mean lies in a box of the truth",
                "train: labelled photos that the scene was made from (as the paper scores); test: other labelled frames",
            ]
            .map(String::from)
            .to_vec(),
            summary: summarise(&self.scores, THRESHOLDS[0].1, figures),
            main_rule: THRESHOLDS[0].1,
            scores: self.scores,
        }
    }
}

/// Figures of the scores of one split.
fn figures(scores: &[&Score]) -> BTreeMap<String, f64> {
    let mut out = BTreeMap::new();
    for (_, rule, name) in THRESHOLDS {
        let miou = mean(scores.iter().filter(|s| s.rule == rule).map(|s| s.iou));
        out.extend(miou.map(|m| (name.to_string(), m)));
    }
    let main = || scores.iter().filter(|s| s.rule == THRESHOLDS[0].1);
    let hits = main().filter_map(|s| s.localised).map(f64::from);
    out.extend(mean(hits).map(|m| ("localisation".to_string(), m)));
    out.insert("pairs".into(), main().count() as f64);
    out
}

fn peak(map: &Image<f32>) -> f32 {
    map.data.iter().copied().fold(f32::NEG_INFINITY, f32::max)
}

/// Index of the map with the highest peak; the first of equals.
fn highest_level(maps: &[Image<f32>]) -> Option<usize> {
    let peaks: Vec<f32> = maps.iter().map(peak).collect();
    let top = peaks.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    peaks.iter().position(|&p| p >= top)
}

/// Whether a pixel with the maximum of the best level lies in a box.
fn localised(boxed: &[Image<f32>], target: &Target) -> bool {
    let Some(map) = highest_level(boxed).map(|k| &boxed[k]) else { return false };
    let top = peak(map);
    map.data.iter().enumerate().filter(|(_, v)| **v == top).any(|(p, _)| {
        let x = rescaled(p % map.width, map.width, target.mask.width);
        let y = rescaled(p / map.width, map.height, target.mask.height);
        target.boxes.iter().any(|b| x >= b[0] && y >= b[1] && x <= b[2] && y <= b[3])
    })
}

/// Pixel index of the centre of pixel `p` after resizing an axis.
fn rescaled(p: usize, from: usize, to: usize) -> f64 {
    (p as f64 + 0.5) * to as f64 / from as f64 - 0.5
}
