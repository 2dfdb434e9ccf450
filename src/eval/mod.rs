//! Scoring a scene against known cameras, depth and object masks: the building blocks of `splatvk
//! eval`.
//!
//! A caller opens [`GroundTruth`], takes every frame's camera in the scene's world from
//! [`Evaluation::cameras`], renders it, answers each label's phrase with [`crate::query::answer`]
//! and passes both to [`Evaluation::add_frame`]; the scores agree with an independent scorer that
//! reads only the written files.
mod figures;
mod instances;
mod lengths;
mod report;
mod shown;
mod text;
mod truth;

#[cfg(test)]
mod tests;

pub use figures::{DepthScore, colour_fit, depth_score, iou};
pub use instances::InstanceScore;
pub use lengths::LengthScore;
pub use report::{
    EvalReport, FrameShown, ImageScore, MaskScore, PairScore, PoseScore, RefinedScore, RefinedView,
    RelativeScore, SplitSummary,
};
pub use shown::{PhotoView, ShownScore, on_white, shown_pixels, shown_score};
pub use truth::{GroundTruth, ObjectMaps, Split, TruthFrame};

use crate::format::picture;
use crate::pass::metrics;
use crate::photo::stem;
use crate::pose::align::{PoseErrors, pose_errors};
use crate::pose::relative::{auc, pair_errors};
use crate::query::QueryResult;
use crate::query::instances::Instance;
use crate::scene::{Camera, Image, Pose, RgbImage, Similarity, Up, World};
use crate::{Error, Result};
use figures::quantised;
use glam::{DVec2, DVec3};
use lengths::length_score;
use report::DEFINITIONS;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Labels of surfaces behind the objects, excluded from mIoU.
pub const BACKGROUND_LABELS: [&str; 6] =
    ["wooden table", "dark wooden table", "brick wall", "plaster wall", "grey carpet", "marble floor"];

/// Minimum number of pixels of an object in a view that counts for it.
pub const MIN_OBJECT_PIXELS: usize = 100;

/// Columns and rows of the pixels whose distances are compared with the true ones.
const LENGTH_GRID: [usize; 2] = [8, 6];
/// Minimum of these lengths as a share of the mean depth: shorter ones would measure the noise of
/// their ends.
const LEAST_LENGTH: f64 = 0.1;

/// One rendered frame.
#[derive(Clone, Debug, Default)]
pub struct Rendered {
    /// Colours over black.
    pub rgb: RgbImage,
    /// Colours over the scene's backdrop, where it has one.
    pub filled: Option<RgbImage>,
    /// Accumulated opacity.
    pub alpha: Image<f32>,
    /// Camera z in scene units, 0 = no surface.
    pub depth: Image<f32>,
}

/// Focal ratio and offset of the principal point of the scene's cameras against the truth: medians
/// over the train frames.
#[derive(Clone, Copy, Debug, PartialEq)]
struct IntrinsicsOffset {
    /// Focal length over the true one.
    focal: f64,
    /// Principal point minus the true one, share of the width and of the height.
    centre: [f64; 2],
}

impl IntrinsicsOffset {
    fn between(estimated: &[Camera], known: &[Camera]) -> IntrinsicsOffset {
        let median = |value: &dyn Fn(&Camera, &Camera) -> f64| {
            let mut all: Vec<f64> = estimated.iter().zip(known).map(|(e, k)| value(e, k)).collect();
            crate::math::median(&mut all).unwrap_or(0.0)
        };
        let [focal, cx, cy]: [fn(&Camera) -> f64; 3] =
            [|c| c.fx / f64::from(c.width), |c| c.cx / f64::from(c.width), |c| c.cy / f64::from(c.height)];
        IntrinsicsOffset {
            focal: median(&|e, k| focal(e) / focal(k)),
            centre: [median(&|e, k| cx(e) - cx(k)), median(&|e, k| cy(e) - cy(k))],
        }
    }
}

/// Collects scores frame by frame.
pub struct Evaluation {
    truth: GroundTruth,
    similarity: Similarity,
    intrinsics_offset: IntrinsicsOffset,
    out: Option<PathBuf>,
    /// Surface points in train frames: (scene, truth).
    surface: Vec<(DVec3, DVec3)>,
    /// The train frames with true depth.
    photos: Vec<PhotoView>,
    /// Mean true depth.
    mean_depth: f64,
    report: EvalReport,
}

impl Evaluation {
    /// Matches the scene's cameras (by file stem) with the train frames and computes the similarity
    /// scene → truth from them alone. With `out`, renders and masks are written there.
    pub fn new(truth: GroundTruth, scene: &[Camera], out: Option<&Path>) -> Result<Self> {
        let mut pairs: Vec<(Camera, &TruthFrame)> = Vec::new();
        let requested = truth.frames.iter().filter(|f| f.split == Split::Train).count();
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
        let relative_poses = relative_score(&frames, &estimated, &known, requested);
        let centres: Vec<_> =
            estimated.iter().zip(&known).map(|(e, k)| (e.pose.centre(), k.pose.centre())).collect();
        let report = EvalReport {
            poses: pose_scores(&frames, &errors),
            relative_poses,
            camera_lengths: length_score(&centres, 0.0),
            ..EvalReport::default()
        };
        let (similarity, intrinsics_offset) =
            (errors.similarity, IntrinsicsOffset::between(&estimated, &known));
        let out = out.map(Path::to_path_buf);
        let photos = photo_views(&truth)?;
        Ok(Evaluation {
            similarity,
            intrinsics_offset,
            out,
            surface: Vec::new(),
            photos,
            mean_depth,
            report,
            truth,
        })
    }

    /// Scores the scene's direction up, if known.
    pub fn add_world(&mut self, world: &World) {
        let angle = |up: &Up, truth: DVec3| (self.similarity.rotation * up.direction).angle_between(truth);
        let known = world.up.as_ref().zip(self.truth.up);
        self.report.up_degrees = known.map(|(up, truth)| angle(up, truth).to_degrees());
    }

    /// The frames, each with its true camera in the scene's world, at the truth's size.
    pub fn cameras(&self) -> Vec<(TruthFrame, Camera)> {
        self.truth.frames.iter().map(|f| (f.clone(), to_scene(&f.camera, &self.similarity))).collect()
    }

    /// A true camera with the intrinsics that the scene estimated for its own photos. A photo by
    /// the same physical camera shows this view if the estimate is right.
    pub fn with_scene_intrinsics(&self, camera: &Camera) -> Camera {
        let IntrinsicsOffset { focal, centre: [x, y] } = self.intrinsics_offset;
        Camera {
            fx: camera.fx * focal,
            fy: camera.fy * focal,
            cx: camera.cx + x * f64::from(camera.width),
            cy: camera.cy + y * f64::from(camera.height),
            ..camera.clone()
        }
    }

    /// (object index, phrase) of the queries, without background labels.
    pub fn phrases(&self) -> Vec<(u32, String)> {
        let all = self.truth.labels.iter();
        all.filter(|(_, p)| !BACKGROUND_LABELS.contains(&p.as_str())).map(|(k, p)| (*k, p.clone())).collect()
    }

    /// Scores the instances of each of [`Evaluation::phrases`], in their order.
    pub fn add_instances(&mut self, found: &[Vec<Instance>]) -> Result<()> {
        let phrases = self.phrases();
        let middles = instances::middles(&self.truth, phrases.clone(), MIN_OBJECT_PIXELS)?;
        let score = |(found, (_, phrase)): (&Vec<Instance>, &(u32, String))| {
            instances::score(&middles, phrase, found, &self.similarity)
        };
        self.report.instances = found.iter().zip(&phrases).filter_map(score).collect();
        Ok(())
    }

    /// The photo of a frame.
    pub fn photo(&self, frame: &TruthFrame) -> Result<RgbImage> {
        self.truth.image(frame)
    }

    /// Scores one frame; `answers` holds (object index, result) at frame size.
    pub fn add_frame(
        &mut self,
        frame: &TruthFrame,
        rendered: &Rendered,
        answers: &[(u32, QueryResult)],
    ) -> Result<()> {
        let (image, masks) = self.score(frame, rendered, answers, self.out.as_deref())?;
        if frame.split == Split::Train {
            self.add_surface(frame, rendered)?;
        }
        self.add_shown(frame, rendered)?;
        self.report.images.push(image);
        self.report.masks.extend(masks);
        Ok(())
    }

    /// Collects surface points of a train frame with true depth.
    fn add_surface(&mut self, frame: &TruthFrame, rendered: &Rendered) -> Result<()> {
        let Some(truth) = self.truth.depth(frame)? else { return Ok(()) };
        let camera = to_scene(&frame.camera, &self.similarity);
        let [columns, rows] = LENGTH_GRID;
        for k in 0..columns * rows {
            let (x, y) = ((2 * (k % columns) + 1) * truth.width, (2 * (k / columns) + 1) * truth.height);
            let (x, y) = (x / (2 * columns), y / (2 * rows));
            let (z, z_true) = (f64::from(rendered.depth.at(x, y)), f64::from(truth.at(x, y)));
            if z > 0.0 && z_true > 0.0 {
                let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
                self.surface.push((camera.unproject(pixel, z), frame.camera.unproject(pixel, z_true)));
            }
        }
        Ok(())
    }

    /// Scores a frame with true depth over the surfaces that train frames show.
    fn add_shown(&mut self, frame: &TruthFrame, rendered: &Rendered) -> Result<()> {
        let Some(depth) = self.truth.depth(frame)? else { return Ok(()) };
        if self.photos.is_empty() {
            return Ok(());
        }
        let (camera, target) = (&frame.camera, self.truth.image(frame)?);
        let shown = shown_pixels(camera, &depth, &self.photos);
        if !shown.contains(&true) {
            return Ok(());
        }
        let scale = self.similarity.scale as f32;
        let depth = rendered.depth.data.iter().map(|z| z * scale).collect();
        let depth = Image { data: depth, ..rendered.depth };
        let (rgb, alpha) = (quantised(&rendered.rgb), rendered.alpha.clone());
        let view = Rendered { rgb, filled: None, alpha, depth };
        let psnr = |image: &RgbImage| metrics::psnr_masked(image, &target, |i| shown[i]);
        self.report.shown.push(FrameShown {
            frame: frame.stem.clone(),
            split: frame.split,
            psnr: psnr(&view.rgb),
            psnr_white: psnr(&on_white(&view)),
            score: shown_score(camera, &view, &shown, &self.photos),
        });
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
        let shown = quantised(rendered.filled.as_ref().unwrap_or(&rendered.rgb));
        if (shown.width, shown.height) != (target.width, target.height) {
            return Err(Error::work(format!(
                "{}: rendered {}x{}, the photo is {}x{}",
                frame.stem, shown.width, shown.height, target.width, target.height
            )));
        }
        let depth = self.truth.depth(frame)?;
        let depth =
            depth.and_then(|d| depth_score(&rendered.depth, &rendered.alpha, &d, self.similarity.scale));
        // A plain border around a photo is not part of the scene.
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
                iou: iou(&answer.mask(), &objects, *label)?,
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
        self.report.surface_lengths = length_score(&self.surface, LEAST_LENGTH * self.mean_depth);
        self.report.definitions = DEFINITIONS.map(String::from).to_vec();
        let has_out = self.truth.frames.iter().any(|f| f.split == Split::Out);
        for split in [Split::Train, Split::Test].into_iter().chain(has_out.then_some(Split::Out)) {
            let summary = summarise(&self.report.images, &self.report.masks, &self.report.shown, split);
            self.report.summary.insert(split.name().to_string(), summary);
        }
        if let Some(refined) = &mut self.report.refined {
            refined.summary = summarise(&refined.images, &refined.masks, &[], Split::Test);
        }
        self.report
    }
}

fn pose_scores(frames: &[&TruthFrame], errors: &PoseErrors) -> Vec<PoseScore> {
    let rows = frames.iter().zip(&errors.rotation_degrees).zip(&errors.centre).zip(&errors.focal);
    rows.map(|(((frame, rotation), centre), focal)| PoseScore {
        frame: frame.stem.clone(),
        rotation_degrees: *rotation,
        centre_fraction: *centre,
        focal_relative: *focal,
    })
    .collect()
}

/// Scores relative poses. `requested` train frames are in the truth; a frame that the scene lacks
/// fails in all its pairs.
fn relative_score(
    frames: &[&TruthFrame],
    estimated: &[Camera],
    known: &[Camera],
    requested: usize,
) -> RelativeScore {
    let errors = pair_errors(estimated, known);
    let missing = requested * requested.saturating_sub(1) / 2 - errors.len();
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

fn mean(values: Vec<f64>) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The train frames that have true depth.
fn photo_views(truth: &GroundTruth) -> Result<Vec<PhotoView>> {
    let mut photos = Vec::new();
    for frame in truth.frames.iter().filter(|f| f.split == Split::Train) {
        if let Some(depth) = truth.depth(frame)? {
            photos.push(PhotoView::new(frame.camera.clone(), &truth.image(frame)?, depth));
        }
    }
    Ok(photos)
}

fn summarise(images: &[ImageScore], masks: &[MaskScore], shown: &[FrameShown], split: Split) -> SplitSummary {
    let shown: Vec<&FrameShown> = shown.iter().filter(|s| s.split == split).collect();
    let shown = |value: &dyn Fn(&FrameShown) -> f64| mean(shown.iter().map(|s| value(s)).collect());
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
        psnr_shown: shown(&|s| s.psnr),
        psnr_shown_white: shown(&|s| s.psnr_white),
        alpha_below_50: shown(&|s| s.score.alpha_below_50),
        alpha_below_90: shown(&|s| s.score.alpha_below_90),
        alpha_below_99: shown(&|s| s.score.alpha_below_99),
        transparent: shown(&|s| s.score.transparent),
        confetti: shown(&|s| s.score.confetti),
        iou: per_phrase.into_iter().filter_map(|(k, v)| mean(v).map(|m| (k, m))).collect(),
    }
}

/// Transforms a camera of the true world to the scene's world: truth = `s R x + t` of the scene.
pub fn to_scene(camera: &Camera, scene_to_truth: &Similarity) -> Camera {
    let Similarity { scale, rotation, translation } = *scene_to_truth;
    let pose = Pose {
        rotation: camera.pose.rotation * rotation,
        // R_c (s R x + t) + τ, divided by s so that depth is in scene units.
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
        picture::write_mask_png(&path, &answer.mask())?;
    }
    Ok(())
}

fn make_parent(path: &Path) -> Result<()> {
    path.parent().map_or(Ok(()), |p| std::fs::create_dir_all(p).map_err(Error::unwritable(p)))
}
