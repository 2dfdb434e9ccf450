//! Terms of the objective of the colour stage. A stage states the terms that it uses; a term that
//! it does not name is off.
use super::views::{SizeBuffers, TrainView};
use crate::gpu::Recorder;
use crate::pass::bands::Band;
use crate::pass::regularise::{self, RatioPenalty};
use crate::pass::ssim_l1::ImageLoss;
use crate::scene::DepthMap;

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
}

impl Losses {
    /// The photos alone, with the weights of 3DGS (Kerbl et al. 2023).
    pub const PHOTOS: Losses = Losses { l1: 0.8, dssim: 0.2, depth: None, needles: None };

    /// The photos' part of the objective.
    pub(super) fn photos(&self, loss: &ImageLoss) -> f64 {
        loss.total(self.l1, self.dssim)
    }

    /// The depth maps, if the objective uses them.
    pub(super) fn depth_inputs<'d>(&self, depths: Option<&'d [DepthMap]>) -> Option<&'d [DepthMap]> {
        depths.filter(|_| self.depth.is_some())
    }

    /// Records the gradients by the rendered planes of a band.
    pub(super) fn record_image(
        &self,
        rec: &mut Recorder,
        stage: &SizeBuffers,
        item: &TrainView,
        band: &Band,
    ) {
        let frame = stage.raster.frame();
        let (target, sums) = (&item.target[band.index], (&stage.sums, stage.slot(band)));
        let (planes, gradient, weights) = (&frame.planes, &frame.planes_grad, [self.l1, self.dssim]);
        stage.loss.record(rec, band, planes, target, gradient, item.covered, weights, sums);
        // A view without depth clears the gradients of another view of its size.
        let (reference, weight) = match (&self.depth, &item.depth) {
            (Some(weight), Some((references, count))) => {
                (Some(&references[band.index]), weight / *count as f64)
            }
            _ => (None, 0.0),
        };
        regularise::record_depth(rec, frame, reference, weight);
        if let Some(alpha) = &item.alpha {
            // Weighted as one more channel of the L1 loss.
            let weight = self.l1 / f64::from(frame.width * frame.height);
            regularise::record_alpha(rec, frame, &alpha[band.index], weight);
        }
    }

    /// Penalty on the needles among `count` splats, whose gradient the update adds to those of the
    /// images.
    pub(super) fn ratio_penalty(&self, count: usize) -> Option<RatioPenalty> {
        self.needles.map(|weight| RatioPenalty { weight: weight / count as f64, limit: RATIO_LIMIT })
    }
}
