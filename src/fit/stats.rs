//! Statistics of the RGB stage.
use super::sh_degree::ViewDependence;
use serde::{Deserialize, Serialize};

/// One point of the training curve.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// 1-based step.
    pub step: usize,
    /// Mean loss over the steps since the last point.
    pub loss: f64,
    /// Mean SSIM over those of these steps whose objective has it.
    pub ssim: Option<f64>,
    /// Mean over the views of their last measured PSNR, dB. Each point measures one view, which
    /// costs a copy of its render; views without a measurement are not in the mean.
    pub psnr: f64,
    /// Number of splats.
    pub splats: usize,
}

/// Statistics of a fit.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct FitStats {
    /// Training curve.
    pub curve: Vec<CurvePoint>,
    /// PSNR per training view with the returned cameras, dB.
    pub psnr: Vec<f64>,
    /// Splats at the start and at the end.
    pub splats: [usize; 2],
    /// Whether the refined cameras were kept.
    pub poses_refined: bool,
    /// Evidence of the photos for view-dependent colour; empty where it was not fitted.
    #[serde(default)]
    pub view_dependence: ViewDependence,
    /// Wall-clock time, seconds.
    pub seconds: f64,
}

impl FitStats {
    /// Mean PSNR over the training views, dB.
    pub fn mean_psnr(&self) -> f64 {
        self.psnr.iter().sum::<f64>() / self.psnr.len().max(1) as f64
    }
}
