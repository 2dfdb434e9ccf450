//! Report of `splatvk eval`.
use super::{InstanceScore, LengthScore, ShownScore, Split};
use serde::Serialize;
use std::collections::BTreeMap;

/// Definitions of the figures of the report.
pub(super) const DEFINITIONS: [&str; 12] = [
    "poses: after the similarity that maps the scene's cameras of the train frames onto the true ones",
    "relative_poses: over all pairs of train frames, the angle between the relative rotations and between the directions of \
     the baselines; auc_N: area under the share of pairs whose larger angle is below x, x from 0 to N degrees, exact",
    "up_degrees: angle between the scene's up and the true one, after the same similarity; null where either is not known",
    "lengths: |l / l_true - 1| when one other length, any, gave the scene its scale, over 20000 pairs of lengths; surface: \
     between pixels of a grid of 8 x 6 per train frame, in one frame or two, that are at least a tenth of the mean depth apart; \
     cameras: between the centres of the train frames",
    "images: PSNR and SSIM of the 8-bit render; psnr_colour_fit: after the gain and offset per channel that bring the render \
     closest to the photo (least squares per frame), for photos whose exposure and white balance differ",
    "depth: median of |z - z_true| / z_true at the cameras' scale where both are known; AbsRel (mean of |s z - z_true| / \
     z_true) and delta (share with a ratio below 1.25) with s = median z_true / median z per frame, as usual for depth \
     without known scale",
    "mask: the codes of the chosen level that are nearly as relevant as the best one in the frame, without smoothing; objects \
     of at least 100 pixels, surfaces behind them left out",
    "miou: plain mean of IoU over all (object, frame) pairs; localisation: share of pairs whose most relevant pixel lies on \
     the object",
    "instances: things in space that answer a phrase, and the objects that it means; centre_distance: from the middle of what the \
     train frames show of each to that of the nearest thing, in units of the truth",
    "train: photos that the scene was made from; test: held-out frames; out: held-out frames beside the photos",
    "shown: pixels whose true surface a train frame shows, by true depth within 1 %; psnr and psnr_white of a frame are over \
     them, over black and over white. transparent: share of all pixels with alpha < 0.9. confetti: share of all pixels with a \
     colour that no train frame has near their point: mean, red - green or blue - green of the 8-bit render over alpha is \
     0.1 outside of the range in a window of 3 % of the width around its place, in every train frame that has that place",
    "refined: held-out frames again, each with the focal length and principal point that the scene found for its own photos \
     (focal_relative and centre_shift against the truth's), from a camera moved until the frozen scene's render is closest to \
     the photo; kept only where psnr_colour_fit rises. Everything outside `refined` is from the cameras as given",
];

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
    /// Share of pixels whose depth at that scale has a ratio below 1.25.
    pub depth_delta: Option<f64>,
}

/// Scores of one frame over the surfaces that the photos show.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[non_exhaustive]
pub struct FrameShown {
    /// Frame file stem.
    pub frame: String,
    /// Role of the frame.
    pub split: Split,
    /// dB over black.
    pub psnr: f64,
    /// dB over white.
    pub psnr_white: f64,
    /// Opacity and foreign colours.
    #[serde(flatten)]
    pub score: ShownScore,
}

/// Score of one phrase in one frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MaskScore {
    /// Frame file stem.
    pub frame: String,
    /// `train` or `test`.
    pub split: Split,
    /// Object index in the ground truth.
    pub label: u32,
    /// Phrase of the object.
    pub phrase: String,
    /// Intersection over union of the predicted mask and the object.
    pub iou: f64,
    /// Whether the most relevant pixel lies on the object.
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
    /// Mean PSNR over what the photos show, dB; this and the next six `None` without true depth.
    pub psnr_shown: Option<f64>,
    /// Mean PSNR over what the photos show, over white, dB.
    pub psnr_shown_white: Option<f64>,
    /// Mean share of what the photos show with alpha < 0.5.
    pub alpha_below_50: Option<f64>,
    /// Mean share of what the photos show with alpha < 0.9.
    pub alpha_below_90: Option<f64>,
    /// Mean share of what the photos show with alpha < 0.99.
    pub alpha_below_99: Option<f64>,
    /// Mean share of all pixels with alpha < 0.9.
    pub transparent: Option<f64>,
    /// Mean share of pixels with a colour that no photo has near their point.
    pub confetti: Option<f64>,
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
    /// Area under the recall curve up to 3 degrees; pairs with a frame that the scene lacks count
    /// as failures.
    pub auc_3: Option<f64>,
    /// The same area up to 5 degrees.
    pub auc_5: Option<f64>,
    /// The same area up to 30 degrees.
    pub auc_30: Option<f64>,
}

/// Displacement of a refined held-out camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RefinedView {
    /// Frame file stem.
    pub frame: String,
    /// Whether the refined camera is used.
    pub kept: bool,
    /// Rotation, degrees.
    pub rotation_degrees: f64,
    /// Displacement of the centre over the scene's median depth.
    pub centre_fraction: f64,
    /// Estimated focal length over the true one, minus 1.
    pub focal_relative: f64,
    /// Estimated principal point minus the true one, pixels.
    pub centre_shift: [f64; 2],
}

/// Held-out frames from refined cameras.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct RefinedScore {
    /// Displacement of each camera.
    pub views: Vec<RefinedView>,
    /// Image scores, as in the report.
    pub images: Vec<ImageScore>,
    /// Mask scores, as in the report.
    pub masks: Vec<MaskScore>,
    /// Means.
    pub summary: SplitSummary,
}

/// Scores of `splatvk eval`.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[non_exhaustive]
pub struct EvalReport {
    /// Definitions of the figures, one line each.
    pub definitions: Vec<String>,
    /// Pose errors per train view.
    pub poses: Vec<PoseScore>,
    /// Pose errors per pair of train views.
    pub relative_poses: RelativeScore,
    /// Angle between the scene's up and the true one, degrees; `None` if either is unknown.
    pub up_degrees: Option<f64>,
    /// Errors of lengths between surfaces; `None` without true depth.
    pub surface_lengths: Option<LengthScore>,
    /// Errors of lengths between cameras.
    pub camera_lengths: Option<LengthScore>,
    /// Scores per rendered frame.
    pub images: Vec<ImageScore>,
    /// Scores per frame with true depth over what the photos show.
    pub shown: Vec<FrameShown>,
    /// Scores per object and frame, without background labels.
    pub masks: Vec<MaskScore>,
    /// Instances per phrase.
    pub instances: Vec<InstanceScore>,
    /// Means per split: `train`, `test`, and `out` where the truth has such frames.
    pub summary: BTreeMap<String, SplitSummary>,
    /// Held-out frames from refined cameras, if requested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refined: Option<RefinedScore>,
}
