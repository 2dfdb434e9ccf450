//! Scoring a scene against known cameras, depth and object masks: the building blocks of `splatvk eval`.
//!
//! A caller opens [`GroundTruth`], asks [`Evaluation::cameras`] for every frame's camera in the scene's world, renders
//! it, answers each label's phrase with [`super::answer`] and hands both to [`Evaluation::add_frame`]; the figures
//! agree with an independent scorer that reads only the files written.
mod truth;

#[cfg(test)]
mod tests;

pub use truth::{Frame, GroundTruth, Split};

use super::QueryResult;
use crate::format::picture;
use crate::pass::metrics;
use crate::pose::align::{PoseErrors, Similarity, pose_errors};
use crate::scene::{Camera, Plane, Pose, RgbImage};
use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Labels of surfaces behind the objects; the scorer leaves them out of mIoU.
pub const BACKGROUND_LABELS: [&str; 6] =
    ["wooden table", "dark wooden table", "brick wall", "plaster wall", "grey carpet", "marble floor"];

/// Views that show fewer pixels of an object do not count for it.
pub const MIN_OBJECT_PIXELS: usize = 100;

/// What the figures of the report are.
const DEFINITIONS: [&str; 5] = [
    "poses: after the similarity that maps the scene's cameras of the train frames onto the true ones",
    "images: PSNR and SSIM of the 8-bit render; depth: median of |z - z_true| / z_true where both are known",
    "mask: the codes of the chosen level that are nearly as relevant as the best one in the frame, without smoothing; objects \
     of at least 100 pixels, surfaces behind them left out",
    "miou: plain mean of IoU over all (object, frame) pairs; localisation: share of pairs whose most relevant pixel lies on \
     the object",
    "train: photos that the scene was made from; test: held-out frames",
];

/// Pixels less opaque than this have no depth to compare.
const SOLID: f32 = 0.5;

/// One rendered frame.
#[derive(Clone, Debug, Default)]
pub struct Rendered {
    /// Colours over the scene's background.
    pub rgb: RgbImage,
    /// Accumulated opacity.
    pub alpha: Plane<f32>,
    /// Camera z in scene units, 0 where nothing is.
    pub depth: Plane<f32>,
}

/// Pose errors of one train view.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PoseScore {
    /// Frame file stem.
    pub frame: String,
    /// Degrees, after the similarity that best maps the scene onto the truth.
    pub rotation_degrees: f64,
    /// Distance of the centres over the mean depth.
    pub centre_fraction: f64,
    /// |f / f_true − 1|.
    pub focal_relative: f64,
}

/// Image and depth scores of one frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ImageScore {
    /// Frame file stem.
    pub frame: String,
    /// `train` or `test`.
    pub split: Split,
    /// dB, of the 8-bit picture that is written, within a photo's plain frame if it has one.
    pub psnr: f64,
    /// Structural similarity, 11×11 Gaussian window.
    pub ssim: f64,
    /// Median of |z − z_true| / z_true where both are known.
    pub depth_median_relative: Option<f64>,
}

/// How one phrase did in one frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MaskScore {
    /// Frame file stem.
    pub frame: String,
    /// `train` or `test`.
    pub split: Split,
    /// Object index in the ground truth.
    pub label: u32,
    /// Its phrase.
    pub phrase: String,
    /// Intersection over union of the predicted mask and the object.
    pub iou: f64,
    /// The most relevant pixel lies on the object.
    pub localised: bool,
    /// Level that answered, 0 = s.
    pub level: usize,
    /// Best relevancy in the frame.
    pub score: f32,
    /// Whether the query passed the absolute threshold.
    pub found: bool,
}

/// Means over one split.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Summary {
    /// Mean PSNR, dB.
    pub psnr: Option<f64>,
    /// Mean SSIM.
    pub ssim: Option<f64>,
    /// Mean over frames of the median relative depth error.
    pub depth_median_relative: Option<f64>,
    /// Plain mean over all (object, view) pairs.
    pub miou: Option<f64>,
    /// Share of (object, view) pairs whose most relevant pixel lies on the object.
    pub localisation: Option<f64>,
    /// Mean IoU per phrase.
    pub iou: BTreeMap<String, f64>,
}

/// Everything `splatvk eval` reports.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Report {
    /// What each figure is, one line each.
    pub definitions: Vec<String>,
    /// Per train view.
    pub poses: Vec<PoseScore>,
    /// Per rendered frame.
    pub images: Vec<ImageScore>,
    /// Per object and frame; background labels are not listed.
    pub masks: Vec<MaskScore>,
    /// Means per split, `train` and `test`.
    pub summary: BTreeMap<String, Summary>,
}

/// Collects scores frame by frame.
pub struct Evaluation {
    truth: GroundTruth,
    similarity: Similarity,
    out: Option<PathBuf>,
    report: Report,
}

impl Evaluation {
    /// Matches the scene's cameras (by file stem) with the train frames and finds the similarity scene → truth from
    /// them alone. With `out`, renders and masks are written there.
    pub fn new(truth: GroundTruth, scene: &[Camera], out: Option<&Path>) -> Result<Self> {
        let mut pairs: Vec<(Camera, &Frame)> = Vec::new();
        for frame in truth.frames.iter().filter(|f| f.split == Split::Train) {
            let found = scene.iter().find(|c| stem(&c.name) == frame.stem);
            pairs.extend(found.map(|c| (c.clone(), frame)));
        }
        if pairs.len() < 2 {
            return Err(Error::input(format!(
                "{}: {} of its train frames are views of the scene, at least 2 are needed; is it another scene's \
                 ground truth?",
                truth.folder.display(),
                pairs.len()
            )));
        }
        let frames: Vec<&Frame> = pairs.iter().map(|(_, f)| *f).collect();
        let mean_depth = truth.mean_depth(&frames)?;
        let estimated: Vec<Camera> = pairs.iter().map(|(c, _)| c.clone()).collect();
        let known: Vec<Camera> = frames.iter().map(|f| f.camera.clone()).collect();
        let errors = pose_errors(&estimated, &known, mean_depth);
        let report = Report { poses: pose_scores(&frames, &errors), ..Report::default() };
        Ok(Evaluation { similarity: errors.similarity, out: out.map(Path::to_path_buf), report, truth })
    }

    /// The frames and, for each, the camera of the truth expressed in the scene's world, at the truth's size.
    pub fn cameras(&self) -> Vec<(Frame, Camera)> {
        self.truth.frames.iter().map(|f| (f.clone(), to_scene(&f.camera, &self.similarity))).collect()
    }

    /// (object index, phrase) to ask for; background labels are left out.
    pub fn phrases(&self) -> Vec<(u32, String)> {
        let all = self.truth.labels.iter();
        all.filter(|(_, p)| !BACKGROUND_LABELS.contains(&p.as_str())).map(|(k, p)| (*k, p.clone())).collect()
    }

    /// Scores one frame; `answers` holds the result per asked object index, in frame size.
    pub fn add_frame(
        &mut self,
        frame: &Frame,
        rendered: &Rendered,
        answers: &[(u32, QueryResult)],
    ) -> Result<()> {
        let target = self.truth.image(frame)?;
        let shown = quantised(&rendered.rgb);
        if (shown.width, shown.height) != (target.width, target.height) {
            return Err(Error::work(format!(
                "{}: rendered {}x{}, the photo is {}x{}",
                frame.stem, shown.width, shown.height, target.width, target.height
            )));
        }
        let depth = self.truth.depth(frame)?;
        // A white or black frame around a photo is no part of the scene.
        let border = crate::photo::Frame::of(&target);
        let (inner, photo) = (border.crop(&shown), border.crop(&target));
        self.report.images.push(ImageScore {
            frame: frame.stem.clone(),
            split: frame.split,
            psnr: metrics::psnr(&inner, &photo),
            ssim: metrics::ssim(&inner, &photo),
            depth_median_relative: depth.and_then(|d| depth_error(rendered, &d, self.similarity.scale)),
        });
        if let Some(out) = &self.out {
            let path = out.join("renders").join(format!("{}.png", frame.stem));
            make_parent(&path)?;
            picture::write_png(&path, &shown)?;
            for (label, answer) in answers {
                let path = out.join("masks").join(label.to_string()).join(format!("{}.png", frame.stem));
                make_parent(&path)?;
                picture::write_mask_png(&path, &answer.mask)?;
            }
        }
        let Some(objects) = self.truth.objects(frame)? else { return Ok(()) };
        for (label, answer) in answers {
            let Some(phrase) = self.truth.labels.get(label) else { continue };
            let size = objects.data.iter().filter(|&&o| o == *label).count();
            if size < MIN_OBJECT_PIXELS || BACKGROUND_LABELS.contains(&phrase.as_str()) {
                continue;
            }
            let (x, y) = answer.location;
            self.report.masks.push(MaskScore {
                frame: frame.stem.clone(),
                split: frame.split,
                label: *label,
                phrase: phrase.clone(),
                iou: iou(&answer.mask, &objects, *label)?,
                localised: x < objects.width && y < objects.height && objects.at(x, y) == *label,
                level: answer.level,
                score: answer.score,
                found: answer.found,
            });
        }
        Ok(())
    }

    /// The report with its means.
    pub fn finish(mut self) -> Report {
        self.report.definitions = DEFINITIONS.map(String::from).to_vec();
        for split in [Split::Train, Split::Test] {
            let summary = summarise(&self.report, split);
            self.report.summary.insert(split.name().to_string(), summary);
        }
        self.report
    }
}

fn pose_scores(frames: &[&Frame], errors: &PoseErrors) -> Vec<PoseScore> {
    let rows = frames.iter().zip(&errors.rotation_degrees).zip(&errors.centre).zip(&errors.focal);
    let score = |(((f, r), c), k): (((&&Frame, &f64), &f64), &f64)| PoseScore {
        frame: f.stem.clone(),
        rotation_degrees: *r,
        centre_fraction: *c,
        focal_relative: *k,
    };
    rows.map(score).collect()
}

fn summarise(report: &Report, split: Split) -> Summary {
    let mean = |v: Vec<f64>| (!v.is_empty()).then(|| v.iter().sum::<f64>() / v.len() as f64);
    let images: Vec<&ImageScore> = report.images.iter().filter(|i| i.split == split).collect();
    let masks: Vec<&MaskScore> = report.masks.iter().filter(|m| m.split == split).collect();
    let mut per_phrase: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for m in &masks {
        per_phrase.entry(m.phrase.clone()).or_default().push(m.iou);
    }
    Summary {
        psnr: mean(images.iter().map(|i| i.psnr).collect()),
        ssim: mean(images.iter().map(|i| i.ssim).collect()),
        depth_median_relative: mean(images.iter().filter_map(|i| i.depth_median_relative).collect()),
        miou: mean(masks.iter().map(|m| m.iou).collect()),
        localisation: mean(masks.iter().map(|m| f64::from(m.localised)).collect()),
        iou: per_phrase.into_iter().filter_map(|(k, v)| mean(v).map(|m| (k, m))).collect(),
    }
}

/// Intersection over union of a mask (resampled to the truth's size by nearest pixel) and one object; 0 when both are
/// empty.
pub fn iou(mask: &Plane<bool>, objects: &Plane<u32>, label: u32) -> Result<f64> {
    if mask.data.len() != mask.width * mask.height || mask.data.is_empty() {
        return Err(Error::work("eval: a mask without pixels"));
    }
    let (mut both, mut either) = (0u64, 0u64);
    for y in 0..objects.height {
        let my = ((y as f64 + 0.5) * mask.height as f64 / objects.height as f64) as usize;
        for x in 0..objects.width {
            let mx = ((x as f64 + 0.5) * mask.width as f64 / objects.width as f64) as usize;
            let (p, t) = (mask.at(mx, my), objects.at(x, y) == label);
            both += u64::from(p && t);
            either += u64::from(p || t);
        }
    }
    Ok(both as f64 / either.max(1) as f64)
}

/// A camera of the true world in the scene's world: the truth is `s R x + t` of the scene.
pub fn to_scene(camera: &Camera, scene_to_truth: &Similarity) -> Camera {
    let Similarity { scale, rotation, translation } = *scene_to_truth;
    let pose = Pose {
        rotation: camera.pose.rotation * rotation,
        // R_c (s R x + t) + τ, divided by s so that depth is in scene units
        translation: (camera.pose.rotation * translation + camera.pose.translation) / scale,
    };
    Camera { pose, ..camera.clone() }
}

fn depth_error(rendered: &Rendered, truth: &Plane<f32>, scale: f64) -> Option<f64> {
    let pairs = rendered.depth.data.iter().zip(&rendered.alpha.data).zip(&truth.data);
    let solid = pairs.filter(|((z, a), t)| **z > 0.0 && **a >= SOLID && **t > 0.0);
    let mut errors: Vec<f64> =
        solid.map(|((z, _), t)| (*z as f64 * scale - *t as f64).abs() / *t as f64).collect();
    if errors.is_empty() {
        return None;
    }
    let middle = errors.len() / 2;
    Some(*errors.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// The picture as an 8-bit file holds it, so that figures can be recomputed from the files.
fn quantised(image: &RgbImage) -> RgbImage {
    let data = image.data.iter().map(|c| c.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() / 255.0)).collect();
    RgbImage { width: image.width, height: image.height, data }
}

fn stem(name: &str) -> &str {
    Path::new(name).file_stem().and_then(|s| s.to_str()).unwrap_or(name)
}

fn make_parent(path: &Path) -> Result<()> {
    path.parent().map_or(Ok(()), |p| std::fs::create_dir_all(p).map_err(Error::io(p)))
}
