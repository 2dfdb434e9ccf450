//! Cameras, depth and points of photos.
use crate::scene::{Camera, DepthMap, Lens, PointCloud};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Result of a geometry initialiser (docs/internals/method.md#geometry). World frame: camera 0 of
/// the run, OpenCV axes.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Geometry {
    /// One per photo, at the photo's working resolution.
    pub cameras: Vec<Camera>,
    /// One per photo, working resolution.
    pub depths: Vec<DepthMap>,
    /// Fused, de-duplicated points.
    pub points: PointCloud,
    /// One standard deviation of ln f, if the focal length was estimated.
    pub focal_log_sigma: Option<f64>,
    /// Estimated intrinsics and fit quality, one per photo, if they were estimated.
    pub fitted: Vec<Fitted>,
    /// Share of each photo that was taken for sky; empty where none was looked for.
    #[serde(default)]
    pub sky: Vec<f32>,
    /// Name of the initialiser and of its inputs, for run.json.
    pub method: String,
}

/// A triangulated point with its observations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SparsePoint {
    /// World units.
    pub position: DVec3,
    /// RGB in [0, 1].
    pub colour: [f32; 3],
    /// (view, pixel position) of every observation; at least two, at most one per view.
    pub views: Vec<(usize, DVec2)>,
}

/// Estimated intrinsics and fit quality of one photo.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Fitted {
    /// Lens distortion.
    pub lens: Lens,
    /// One standard deviation of ln f, k1, k2 and the principal point (x, y; original pixels); 0 =
    /// held fixed.
    pub sigmas: [f64; 5],
    /// Median reprojection error of its observations, working pixels.
    pub residual: f64,
    /// Share of the inliers of its two-view geometries that agree with the final cameras, too.
    pub agreement: f64,
    /// Whether its pose rests on a single pair of photos whose inliers are few or a minority.
    #[serde(default)]
    pub unconfirmed: bool,
    /// One standard deviation of the rotation of its camera against the first photo, radians.
    pub rotation_sigma: f64,
    /// Camera id; photos of one id share intrinsics.
    pub camera: usize,
}

/// Cameras and triangulated points. World frame: camera 0; unit: the median depth of the points
/// where scale is free, that of the given cameras otherwise.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct SparseModel {
    /// One per photo, at the photo's working resolution.
    pub cameras: Vec<Camera>,
    /// Triangulated points.
    pub points: Vec<SparsePoint>,
    /// One standard deviation of ln f, if the focal length was estimated.
    pub focal_log_sigma: Option<f64>,
    /// Estimated intrinsics and fit quality, one per photo, if they were estimated. Cameras and
    /// pixel positions are those of the undistorted photos.
    pub fitted: Vec<Fitted>,
    /// Whether the matches of all photos lie on one plane.
    #[serde(default)]
    pub flat: bool,
}
