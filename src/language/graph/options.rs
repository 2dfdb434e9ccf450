//! Weights, and the cues that they weigh.
use crate::scene::{Camera, DepthMap, Plane};

/// Weights of the merge cost; every cue lies in [0, 1].
#[derive(Clone, Debug, PartialEq)]
pub struct MergeOptions {
    /// χ² distance of the colour histograms.
    pub colour: f32,
    /// Difference of the mean colours.
    pub mean: f32,
    /// χ² distance of the texture histograms.
    pub texture: f32,
    /// Mean colour gradient along the shared border.
    pub gradient: f32,
    /// Mean learned boundary strength along the shared border.
    pub edge: f32,
    /// Relative depth step across the shared border.
    pub step: f32,
    /// Relative depth step that counts as 63 % of a certain discontinuity.
    pub step_scale: f32,
    /// Planes that do not continue each other.
    pub bend: f32,
    /// Relative depth error of one pixel that the bend term takes for noise.
    pub depth_noise: f64,
    /// How much a full enclosure lowers the cost.
    pub enclosure: f32,
    /// Exponent of the smaller region's share of the image.
    pub size_power: f32,
}

impl Default for MergeOptions {
    fn default() -> Self {
        MergeOptions {
            colour: 1.0,
            mean: 1.0,
            texture: 0.65,
            gradient: 0.85,
            edge: 5.0,
            step: 1.2,
            step_scale: 0.045,
            bend: 0.17,
            depth_noise: 0.019,
            enclosure: 0.7,
            size_power: 0.48,
        }
    }
}

/// How an image is cut into masks.
#[derive(Clone, Debug, PartialEq)]
pub struct GraphOptions {
    /// Merge cost.
    pub merge: MergeOptions,
    /// Felzenszwalb–Huttenlocher scale of the superpixels, Lab units · pixels at 640 × 480.
    pub scale: f32,
    /// Smallest superpixel, pixels at 640 × 480.
    pub min_superpixel: f32,
    /// Smallest mask of level s, share of the image; m and l allow four and sixteen times that.
    pub min_mask: f32,
    /// Exponent of a region's area in its persistence.
    pub area_power: f32,
    /// Exponent of the mean contour strength.
    pub contour_power: f32,
    /// Exponent of the lifetime.
    pub life_power: f32,
    /// Share of its area that a region may gain or lose and still be the same region.
    pub same: f32,
    /// Merge costs below this count as this: differences that small are noise.
    pub floor: f32,
}

impl Default for GraphOptions {
    fn default() -> Self {
        GraphOptions {
            merge: MergeOptions::default(),
            scale: 20.0,
            min_superpixel: 29.0,
            min_mask: 8e-4,
            area_power: 1.0,
            contour_power: 3.2,
            life_power: 0.425,
            same: 0.085,
            floor: 0.025,
        }
    }
}

/// Everything the tree is built from.
pub(super) struct Cues<'a> {
    pub(super) labels: Plane<i32>,
    pub(super) count: usize,
    pub(super) lab: Vec<[f32; 3]>,
    pub(super) gradient: Plane<f32>,
    pub(super) edges: Option<&'a Plane<f32>>,
    pub(super) depth: Option<&'a DepthMap>,
    pub(super) camera: Option<&'a Camera>,
}

impl Cues<'_> {
    /// Direction of a pixel on the z = 1 plane.
    pub(super) fn ray(&self, x: usize, y: usize) -> (f64, f64) {
        let pixel = glam::DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        self.camera.map_or((pixel.x, pixel.y), |c| {
            let r = c.ray(pixel);
            (r.x, r.y)
        })
    }
    /// Signed relative depth step from pixel p to its neighbour q, measured two pixels to each side of the border
    /// since depth maps blur discontinuities over about that width.
    pub(super) fn depth_step(&self, p: usize, q: usize) -> Option<f32> {
        const REACH: isize = 2;
        let depth = &self.depth?.depth;
        let delta = q as isize - p as isize;
        let (row, width) = ((p / depth.width) as isize, depth.width as isize);
        let at = |base: usize, k: isize| {
            let index = base as isize + k * delta;
            // a horizontal step must stay in its row
            let inside = (0..depth.data.len() as isize).contains(&index);
            (inside && (delta.abs() != 1 || index / width == row)).then(|| depth.data[index as usize])
        };
        let (a, b) = (at(p, -REACH)?, at(q, REACH)?);
        (a > 0.0 && b > 0.0).then(|| 2.0 * (b - a) / (a + b))
    }
}
