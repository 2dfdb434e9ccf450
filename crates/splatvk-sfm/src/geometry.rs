//! Cameras, depth and points of photos.
use crate::scene::{Camera, DepthMap, Lens, PointCloud};
use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// What every geometry initialiser returns (docs/internals/method.md#geometry). World frame: camera
/// 0 of the run, OpenCV axes.
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
    /// What was found of the optics, one per photo, if it was estimated.
    pub fitted: Vec<Fitted>,
    /// Name of the initialiser and of what it used, for run.json.
    pub method: String,
}

/// A triangulated point and where the photos show it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SparsePoint {
    /// World units.
    pub position: DVec3,
    /// RGB in [0, 1].
    pub colour: [f32; 3],
    /// (view, pixel position) of every observation; at least two, at most one per view.
    pub views: Vec<(usize, DVec2)>,
}

/// What the photos told of the optics of one of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Fitted {
    /// Its lens.
    pub lens: Lens,
    /// One standard deviation of ln f, k1, k2 and the principal point (x, y; original pixels); 0 =
    /// held where it is.
    pub sigmas: [f64; 5],
    /// Median distance of its sightings from where the model projects their points, working pixels.
    pub residual: f64,
    /// Share of its matches that agree with the cameras, of those on which its pairs with other
    /// photos agree by themselves.
    pub agreement: f64,
    /// Whether one pair of photos, whose matches are few or mostly contradict each other, is all
    /// that its place rests on.
    #[serde(default)]
    pub unconfirmed: bool,
    /// One standard deviation of the direction in which its camera looks, against that of the first
    /// photo, radians.
    pub rotation_sigma: f64,
    /// Photos of one number were explained with the same optics.
    pub camera: usize,
}

/// Cameras and the sparse points that fix them. World frame: camera 0; unit: the median depth of
/// the points is 1 where it is free, that of the given cameras otherwise.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct SparseModel {
    /// One per photo, at the photo's working resolution.
    pub cameras: Vec<Camera>,
    /// Triangulated points.
    pub points: Vec<SparsePoint>,
    /// One standard deviation of ln f, if the focal length was estimated.
    pub focal_log_sigma: Option<f64>,
    /// One per photo, if the optics were estimated. The cameras and the points' pixels are those of
    /// the pinhole that remains when the lens is taken out of the photo.
    pub fitted: Vec<Fitted>,
    /// Whether all that the photos agree on lies on one plane, as far as they tell.
    #[serde(default)]
    pub flat: bool,
}
