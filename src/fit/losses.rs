//! Terms of the objective of the colour stage. A stage states the terms that it uses; a term that
//! it does not name is off.
use super::views::{TrainView, Views, slot};
use crate::gpu::Recorder;
use crate::pass::bands::Band;
use crate::pass::regularise::{self, RatioPenalty};
use crate::pass::ssim_l1::ImageLoss;
use crate::scene::{Coverage, Outside};

/// Ratio of the axes of a splat up to which it is no needle.
const RATIO_LIMIT: f32 = 8.0;

/// The terms of an objective.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Losses {
    /// Weight of mean |render − photo|, and of the alpha that a transparent photo states.
    pub l1: f64,
    /// Weight of 1 − SSIM.
    pub dssim: f64,
    /// Weight of mean |z − d| / d over the pixels with confident stereo depth d.
    pub depth: Option<f64>,
    /// Weight of `mean max(0, s_max/s_min − 8)`, against needles.
    pub needles: Option<f64>,
    /// Weight of Σ |1 − A| over the used pixels of photos without transparency, divided by the
    /// number of all pixels: every pixel shows something, also where it is black.
    pub opacity: Option<f64>,
}

impl Losses {
    /// The photos alone, with the weights of 3DGS (Kerbl et al. 2023).
    pub const PHOTOS: Losses = Losses { l1: 0.8, dssim: 0.2, depth: None, needles: None, opacity: None };

    /// The photos' part of the objective.
    pub(super) fn photos(&self, loss: &ImageLoss) -> f64 {
        if self.dssim > 0.0 { loss.total(self.l1, self.dssim) } else { self.l1 * loss.l1 }
    }

    /// Warped photos: their edges are less sharp than those of photos, and their depth is the
    /// depth that warps them.
    pub(super) const VIRTUAL: Losses =
        Losses { l1: 0.4, dssim: 0.0, depth: Some(0.02), needles: Some(1e-3), opacity: Some(0.75) };

    /// Target alpha of the pixels of a photo, −1 where there is none, and its
    /// weight per pixel.
    pub(super) fn wanted_alpha(&self, pixels: usize, coverage: Option<&Coverage>) -> Option<(Vec<f32>, f64)> {
        let (alpha, weight) = match (coverage, self.opacity) {
            // Weighted as one more channel of the L1 loss.
            (Some(c), _) if c.outside == Outside::Empty => (c.share.data.clone(), self.l1),
            (Some(c), Some(weight)) => {
                (c.weights().data.iter().map(|w| if *w > 0.0 { 1.0 } else { -1.0 }).collect(), weight)
            }
            (None, Some(weight)) => (vec![1.0; pixels], weight),
            (_, None) => return None,
        };
        Some((alpha, weight / pixels as f64))
    }

    /// Records the gradients by the rendered planes of a band.
    pub(super) fn record_image(&self, rec: &mut Recorder, views: &Views, item: &TrainView, band: &Band) {
        let frame = views.raster.frame();
        let (target, sums) = (&item.target[band.index], (&views.sums, slot(band)));
        let (planes, gradient, weights) = (&frame.planes, &frame.planes_grad, [self.l1, self.dssim]);
        let bands = (&item.bands, band);
        views.loss.record(rec, bands, planes, target, gradient, item.covered, weights, sums);
        // A view without depth clears the gradients of another view.
        let depth = match (&self.depth, &item.depth) {
            (Some(weight), Some((references, count))) => {
                Some((&references[band.index], weight / *count as f64))
            }
            _ => None,
        };
        let alpha = item.alpha.as_ref().map(|(alpha, weight)| (&alpha[band.index], *weight));
        regularise::record_depth_and_alpha(rec, frame, depth, alpha);
    }

    /// Penalty on the needles among `count` splats, whose gradient the update adds to those of the
    /// images.
    pub(super) fn ratio_penalty(&self, count: usize) -> Option<RatioPenalty> {
        self.needles.map(|weight| RatioPenalty { weight: weight / count as f64, limit: RATIO_LIMIT })
    }
}
