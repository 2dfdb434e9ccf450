//! Photos to cameras, depth and points.
use crate::scene::{Camera, DepthMap, PointCloud};

/// What every geometry initialiser returns (ALGORITHMS 2.6). World frame: camera 0 of the run, OpenCV axes.
#[derive(Clone, Debug, Default)]
pub struct Geometry {
    /// One per photo, at the photo's working resolution.
    pub cameras: Vec<Camera>,
    /// One per photo, working resolution.
    pub depths: Vec<DepthMap>,
    /// Fused, de-duplicated points.
    pub points: PointCloud,
    /// One standard deviation of ln f, if the focal length was estimated.
    pub focal_log_sigma: Option<f64>,
    /// Name of the initialiser and of what it used, for run.json.
    pub method: String,
}
