//! Scoring a scene against known cameras, depth and object masks: the building blocks of `splatvk eval`.
//!
//! A caller opens [`GroundTruth`], asks [`Evaluation::cameras`] for every frame's camera in the scene's world, renders
//! it, answers each label's phrase with [`super::answer`] and hands both to [`Evaluation::add_frame`]; the figures
//! agree with an independent scorer that reads only the files written.
mod figures;
mod text;
mod truth;

#[cfg(test)]
mod tests;

pub use figures::{DepthScore, colour_fit, depth_score, iou};
pub use truth::{GroundTruth, Split, TruthFrame};

use super::QueryResult;
use crate::format::picture;
use crate::pass::metrics;
use crate::photo::stem;
use crate::pose::align::{PoseErrors, pose_errors};
use crate::pose::relative::{auc, pair_errors};
use crate::scene::{Camera, Plane, Pose, RgbImage, Similarity};
use crate::{Error, Result};
use figures::quantised;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Labels of surfaces behind the objects; the scorer leaves them out of mIoU.
pub const BACKGROUND_LABELS: [&str; 6] =
    ["wooden table", "dark wooden table", "brick wall", "plaster wall", "grey carpet", "marble floor"];

/// Views that show fewer pixels of an object do not count for it.
pub const MIN_OBJECT_PIXELS: usize = 100;

/// What the figures of the report are.
const DEFINITIONS: [&str; 8] = [
    "poses: after the similarity that maps the scene's cameras of the train frames onto the true ones",
    "relative_poses: over all pairs of train frames, the angle between the relative rotations and between the directions of \
     the baselines; auc_N: area under the share of pairs whose larger angle is below x, x from 0 to N degrees, exact",
    "images: PSNR and SSIM of the 8-bit render; psnr_colour_fit: after the gain and offset per channel that bring the render \
     closest to the photo (least squares per frame), for photos whose exposure and white balance differ",
    "depth: median of |z - z_true| / z_true at the cameras' scale where both are known; AbsRel (mean of |s z - z_true| / \
     z_true) and delta (share with a ratio below 1.25) with s = median z_true / median z per frame, as usual for depth \
     without known scale",
    "mask: the codes of the chosen level that are nearly as relevant as the best one in the frame, without smoothing; objects \
     of at least 100 pixels, surfaces behind them left out",
    "miou: plain mean of IoU over all (object, frame) pairs; localisation: share of pairs whose most relevant pixel lies on \
     the object",
    "train: photos that the scene was made from; test: held-out frames",
    "refined: held-out frames again, each with the focal length and principal point that the scene found for its own photos \
     (focal_relative and centre_shift against the truth's), from a camera moved until the frozen scene's render is closest to \
     the photo; kept only where psnr_colour_fit rises. Everything outside `refined` is from the cameras as given",
];

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
#[non_exhaustive]
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
#[non_exhaustive]
pub struct ImageScore {
    /// Frame file stem.
    pub frame: String,
    /// `train` or `test`.
    pub split: Split,
    /// dB, of the 8-bit picture that is written, within a photo's plain frame if it has one.
    pub psnr: f64,
    /// Structural similarity, 11×11 Gaussian window.
    pub ssim: f64,
    /// dB, after a gain and an offset per channel.
    pub psnr_colour_fit: f64,
    /// Median of |z − z_true| / z_true where both are known.
    pub depth_median_relative: Option<f64>,
    /// Mean of |s z − z_true| / z_true, s from the medians.
    pub depth_abs_rel: Option<f64>,
    /// Share of pixels whose depth, so scaled, is off by less than 1.25.
    pub depth_delta: Option<f64>,
}

/// How one phrase did in one frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
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
pub struct SplitSummary {
    /// Mean PSNR, dB.
    pub psnr: Option<f64>,
    /// Mean SSIM.
    pub ssim: Option<f64>,
    /// Mean PSNR after the colour fit, dB.
    pub psnr_colour_fit: Option<f64>,
    /// Mean over frames of the median relative depth error.
    pub depth_median_relative: Option<f64>,
    /// Mean over frames of AbsRel.
    pub depth_abs_rel: Option<f64>,
    /// Mean over frames of the share with a ratio below 1.25.
    pub depth_delta: Option<f64>,
    /// Plain mean over all (object, view) pairs.
    pub miou: Option<f64>,
    /// Share of (object, view) pairs whose most relevant pixel lies on the object.
    pub localisation: Option<f64>,
    /// Mean IoU per phrase.
    pub iou: BTreeMap<String, f64>,
}

/// One pair of train views.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct PairScore {
    /// Frame file stems.
    pub frames: [String; 2],
    /// Angle between the relative rotations, degrees.
    pub rotation_degrees: f64,
    /// Angle between the directions of the baselines, degrees.
    pub direction_degrees: Option<f64>,
}

/// Relative poses of the train views.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct RelativeScore {
    /// All pairs of train views that the scene has.
    pub pairs: Vec<PairScore>,
    /// Area under the recall curve up to 3 degrees; pairs with a frame that the scene lacks count as failures.
    pub auc_3: Option<f64>,
    /// Up to 5 degrees.
    pub auc_5: Option<f64>,
    /// Up to 30 degrees.
    pub auc_30: Option<f64>,
}

/// How far a held-out camera was moved.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RefinedView {
    /// Frame file stem.
    pub frame: String,
    /// Whether the moved camera is used.
    pub kept: bool,
    /// Turn, degrees.
    pub rotation_degrees: f64,
    /// Shift of the centre over the scene's median depth.
    pub centre_fraction: f64,
    /// Focal length that it has over the true one, minus 1.
    pub focal_relative: f64,
    /// Principal point that it has minus the true one, pixels.
    pub centre_shift: [f64; 2],
}

/// Focal ratio and offset of the principal point of the scene's cameras against the truth: medians over the train frames.
#[derive(Clone, Copy, Debug, PartialEq)]
struct OpticsOffset {
    /// Focal length over the true one.
    focal: f64,
    /// Principal point minus the true one, share of the width and of the height.
    centre: [f64; 2],
}

impl OpticsOffset {
    fn of(estimated: &[Camera], known: &[Camera]) -> OpticsOffset {
        let median = |value: &dyn Fn(&Camera, &Camera) -> f64| {
            let mut all: Vec<f64> = estimated.iter().zip(known).map(|(e, k)| value(e, k)).collect();
            crate::math::median(&mut all).unwrap_or(0.0)
        };
        let of_width = |c: &Camera, x: f64| x / f64::from(c.width);
        let of_height = |c: &Camera, y: f64| y / f64::from(c.height);
        OpticsOffset {
            focal: median(&|e, k| of_width(e, e.fx) / of_width(k, k.fx)),
            centre: [
                median(&|e, k| of_width(e, e.cx) - of_width(k, k.cx)),
                median(&|e, k| of_height(e, e.cy) - of_height(k, k.cy)),
            ],
        }
    }
}

/// Held-out frames from refined cameras.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct RefinedScore {
    /// What moved.
    pub views: Vec<RefinedView>,
    /// As in the report.
    pub images: Vec<ImageScore>,
    /// As in the report.
    pub masks: Vec<MaskScore>,
    /// Means.
    pub summary: SplitSummary,
}

/// Everything `splatvk eval` reports.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct EvalReport {
    /// What each figure is, one line each.
    pub definitions: Vec<String>,
    /// Per train view.
    pub poses: Vec<PoseScore>,
    /// Per pair of train views.
    pub relative_poses: RelativeScore,
    /// Per rendered frame.
    pub images: Vec<ImageScore>,
    /// Per object and frame; background labels are not listed.
    pub masks: Vec<MaskScore>,
    /// Means per split, `train` and `test`.
    pub summary: BTreeMap<String, SplitSummary>,
    /// Held-out frames from refined cameras, if asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refined: Option<RefinedScore>,
}

/// Collects scores frame by frame.
pub struct Evaluation {
    truth: GroundTruth,
    similarity: Similarity,
    optics_offset: OpticsOffset,
    out: Option<PathBuf>,
    report: EvalReport,
}

impl Evaluation {
    /// Matches the scene's cameras (by file stem) with the train frames and finds the similarity scene → truth from
    /// them alone. With `out`, renders and masks are written there.
    pub fn new(truth: GroundTruth, scene: &[Camera], out: Option<&Path>) -> Result<Self> {
        let mut pairs: Vec<(Camera, &TruthFrame)> = Vec::new();
        let asked = truth.frames.iter().filter(|f| f.split == Split::Train).count();
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
        let frames: Vec<&TruthFrame> = pairs.iter().map(|(_, f)| *f).collect();
        let mean_depth = truth.mean_depth(&frames)?;
        let estimated: Vec<Camera> = pairs.iter().map(|(c, _)| c.clone()).collect();
        let known: Vec<Camera> = frames.iter().map(|f| f.camera.clone()).collect();
        let errors = pose_errors(&estimated, &known, mean_depth);
        let relative_poses = relative(&frames, &estimated, &known, asked);
        let report =
            EvalReport { poses: pose_scores(&frames, &errors), relative_poses, ..EvalReport::default() };
        let (similarity, optics_offset) = (errors.similarity, OpticsOffset::of(&estimated, &known));
        Ok(Evaluation { similarity, optics_offset, out: out.map(Path::to_path_buf), report, truth })
    }

    /// The frames and, for each, the camera of the truth expressed in the scene's world, at the truth's size.
    pub fn cameras(&self) -> Vec<(TruthFrame, Camera)> {
        self.truth.frames.iter().map(|f| (f.clone(), to_scene(&f.camera, &self.similarity))).collect()
    }

    /// A camera of the truth with the optics that the scene found for its own photos: what a photo taken with the same
    /// camera shows of the scene if the scene is right about itself.
    pub fn with_scene_optics(&self, camera: &Camera) -> Camera {
        let OpticsOffset { focal, centre: [x, y] } = self.optics_offset;
        Camera {
            fx: camera.fx * focal,
            fy: camera.fy * focal,
            cx: camera.cx + x * f64::from(camera.width),
            cy: camera.cy + y * f64::from(camera.height),
            ..camera.clone()
        }
    }

    /// (object index, phrase) to ask for; background labels are left out.
    pub fn phrases(&self) -> Vec<(u32, String)> {
        let all = self.truth.labels.iter();
        all.filter(|(_, p)| !BACKGROUND_LABELS.contains(&p.as_str())).map(|(k, p)| (*k, p.clone())).collect()
    }

    /// The photo of a frame.
    pub fn photo(&self, frame: &TruthFrame) -> Result<RgbImage> {
        self.truth.image(frame)
    }

    /// Scores one frame; `answers` holds the result per asked object index, in frame size.
    pub fn add_frame(
        &mut self,
        frame: &TruthFrame,
        rendered: &Rendered,
        answers: &[(u32, QueryResult)],
    ) -> Result<()> {
        let (image, masks) = self.score(frame, rendered, answers, self.out.as_deref())?;
        self.report.images.push(image);
        self.report.masks.extend(masks);
        Ok(())
    }

    /// Scores a held-out frame again, from a refined camera; its files go into `refined/`.
    pub fn add_refined(
        &mut self,
        frame: &TruthFrame,
        view: RefinedView,
        rendered: &Rendered,
        answers: &[(u32, QueryResult)],
    ) -> Result<()> {
        let out = self.out.as_ref().map(|o| o.join("refined"));
        let (image, masks) = self.score(frame, rendered, answers, out.as_deref())?;
        let refined = self.report.refined.get_or_insert_default();
        refined.views.push(view);
        refined.images.push(image);
        refined.masks.extend(masks);
        Ok(())
    }

    fn score(
        &self,
        frame: &TruthFrame,
        rendered: &Rendered,
        answers: &[(u32, QueryResult)],
        out: Option<&Path>,
    ) -> Result<(ImageScore, Vec<MaskScore>)> {
        let target = self.truth.image(frame)?;
        let shown = quantised(&rendered.rgb);
        if (shown.width, shown.height) != (target.width, target.height) {
            return Err(Error::work(format!(
                "{}: rendered {}x{}, the photo is {}x{}",
                frame.stem, shown.width, shown.height, target.width, target.height
            )));
        }
        let depth = self.truth.depth(frame)?;
        let depth =
            depth.and_then(|d| depth_score(&rendered.depth, &rendered.alpha, &d, self.similarity.scale));
        // A white or black frame around a photo is no part of the scene.
        let border = crate::photo::PlainBorder::of(&target);
        let (inner, photo) = (border.crop(&shown), border.crop(&target));
        let image = ImageScore {
            frame: frame.stem.clone(),
            split: frame.split,
            psnr: metrics::psnr(&inner, &photo),
            ssim: metrics::ssim(&inner, &photo),
            psnr_colour_fit: metrics::psnr(&colour_fit(&inner, &photo), &photo),
            depth_median_relative: depth.map(|d| d.median_relative),
            depth_abs_rel: depth.map(|d| d.abs_rel),
            depth_delta: depth.map(|d| d.delta),
        };
        if let Some(out) = out {
            write_files(out, &frame.stem, &shown, answers)?;
        }
        Ok((image, self.mask_scores(frame, answers)?))
    }

    fn mask_scores(&self, frame: &TruthFrame, answers: &[(u32, QueryResult)]) -> Result<Vec<MaskScore>> {
        let Some(objects) = self.truth.objects(frame)? else { return Ok(Vec::new()) };
        let mut scores = Vec::new();
        for (label, answer) in answers {
            let Some(phrase) = self.truth.labels.get(label) else { continue };
            let size = objects.data.iter().filter(|&&o| o == *label).count();
            if size < MIN_OBJECT_PIXELS || BACKGROUND_LABELS.contains(&phrase.as_str()) {
                continue;
            }
            let (x, y) = answer.location;
            scores.push(MaskScore {
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
        Ok(scores)
    }

    /// The report with its means.
    pub fn finish(mut self) -> EvalReport {
        self.report.definitions = DEFINITIONS.map(String::from).to_vec();
        for split in [Split::Train, Split::Test] {
            let summary = summarise(&self.report.images, &self.report.masks, split);
            self.report.summary.insert(split.name().to_string(), summary);
        }
        if let Some(refined) = &mut self.report.refined {
            refined.summary = summarise(&refined.images, &refined.masks, Split::Test);
        }
        self.report
    }
}

fn pose_scores(frames: &[&TruthFrame], errors: &PoseErrors) -> Vec<PoseScore> {
    let rows = frames.iter().zip(&errors.rotation_degrees).zip(&errors.centre).zip(&errors.focal);
    let score = |(((f, r), c), k): (((&&TruthFrame, &f64), &f64), &f64)| PoseScore {
        frame: f.stem.clone(),
        rotation_degrees: *r,
        centre_fraction: *c,
        focal_relative: *k,
    };
    rows.map(score).collect()
}

/// `asked`: train frames of the truth; a frame that the scene lacks fails in all its pairs.
fn relative(frames: &[&TruthFrame], estimated: &[Camera], known: &[Camera], asked: usize) -> RelativeScore {
    let errors = pair_errors(estimated, known);
    let missing = asked * asked.saturating_sub(1) / 2 - errors.len();
    let pairs = errors.iter().map(|e| PairScore {
        frames: e.pair.map(|k| frames[k].stem.clone()),
        rotation_degrees: e.rotation_degrees,
        direction_degrees: e.direction_degrees,
    });
    RelativeScore {
        pairs: pairs.collect(),
        auc_3: auc(&errors, missing, 3.0),
        auc_5: auc(&errors, missing, 5.0),
        auc_30: auc(&errors, missing, 30.0),
    }
}

fn summarise(images: &[ImageScore], masks: &[MaskScore], split: Split) -> SplitSummary {
    let mean = |v: Vec<f64>| (!v.is_empty()).then(|| v.iter().sum::<f64>() / v.len() as f64);
    let images: Vec<&ImageScore> = images.iter().filter(|i| i.split == split).collect();
    let masks: Vec<&MaskScore> = masks.iter().filter(|m| m.split == split).collect();
    let mut per_phrase: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for m in &masks {
        per_phrase.entry(m.phrase.clone()).or_default().push(m.iou);
    }
    SplitSummary {
        psnr: mean(images.iter().map(|i| i.psnr).collect()),
        ssim: mean(images.iter().map(|i| i.ssim).collect()),
        psnr_colour_fit: mean(images.iter().map(|i| i.psnr_colour_fit).collect()),
        depth_median_relative: mean(images.iter().filter_map(|i| i.depth_median_relative).collect()),
        depth_abs_rel: mean(images.iter().filter_map(|i| i.depth_abs_rel).collect()),
        depth_delta: mean(images.iter().filter_map(|i| i.depth_delta).collect()),
        miou: mean(masks.iter().map(|m| m.iou).collect()),
        localisation: mean(masks.iter().map(|m| f64::from(m.localised)).collect()),
        iou: per_phrase.into_iter().filter_map(|(k, v)| mean(v).map(|m| (k, m))).collect(),
    }
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

fn write_files(out: &Path, stem: &str, shown: &RgbImage, answers: &[(u32, QueryResult)]) -> Result<()> {
    let path = out.join("renders").join(format!("{stem}.png"));
    make_parent(&path)?;
    picture::write_png(&path, shown)?;
    for (label, answer) in answers {
        let path = out.join("masks").join(label.to_string()).join(format!("{stem}.png"));
        make_parent(&path)?;
        picture::write_mask_png(&path, &answer.mask)?;
    }
    Ok(())
}

fn make_parent(path: &Path) -> Result<()> {
    path.parent().map_or(Ok(()), |p| std::fs::create_dir_all(p).map_err(Error::unwritable(p)))
}
