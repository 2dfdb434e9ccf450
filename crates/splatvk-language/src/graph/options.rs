//! Parameters of the masks. The docs of each give the mean of four figures for other values; the
//! defaults give 0.948. The figures are the best-of-three IoU and the IoU with one level per object
//! (`splatvk bench masks`), each on breakfast and on generated scenes (tuning sets,
//! `docs/internals/method.md#graph-masks`). Differences below 0.005 are noise.
use crate::scene::Image;

/// σ of the blur before superpixels, pixels. 0.8, the value of Felzenszwalb and Huttenlocher:
/// 0.940.
pub(super) const SMOOTHING: f32 = 0.5;

/// Difference of mean colours with 63 % of the largest cost, Lab units: a plainly visible one. 10:
/// 0.946, 40: 0.944.
pub(super) const DIFFERENT: f32 = 20.0;

/// Smallest cost of a difference, so that size and enclosure also order the merges of equal
/// regions.
pub(super) const EQUAL: f32 = 1e-4;

/// Options of the segmentation.
#[derive(Clone, Debug, PartialEq)]
pub struct GraphOptions {
    /// Felzenszwalb–Huttenlocher scale of the superpixels, Lab units · pixels at 640 × 480. 5:
    /// 0.947, 20: 0.947.
    pub superpixel_scale: f32,
    /// Smallest superpixel, pixels at 640 × 480. 15: 0.949, but twice as many regions to merge; 60:
    /// 0.946.
    pub min_superpixel: f32,
    /// Lab difference equivalent to a learned boundary of probability 1 between two pixels. 20:
    /// 0.946, 80: 0.946.
    pub superpixel_edge: f32,
    /// Weight of the learned boundary in the cost of a merge, beside that of the colours; both lie
    /// in [0, 1]. 1: 0.946, 4: 0.944.
    pub edge: f32,
    /// Share by which full enclosure lowers the cost, so that print joins the thing under it. 0:
    /// 0.929, 0.2: 0.944, 0.6: 0.947.
    pub enclosure: f32,
    /// Exponent of the smaller region's share of the image; ½ makes it a width. 0.25: 0.947, 0.75:
    /// 0.946.
    pub size_power: f32,
    /// Exponent of a mask's mean contour strength in its score. 2.5: 0.933, 4: 0.947, 7: 0.946, 10:
    /// 0.939.
    pub contour_power: f32,
    /// Exponents of a mask's area in its score on levels s, m, l: on s the size has no weight. Half
    /// of them: 0.946, ¾: 0.948, 1½ times: 0.935.
    pub area_powers: [f32; 3],
    /// Smallest masks of levels s, m, l, share of the image, four times from level to level: with
    /// smaller values print and specks become masks, with larger ones things are missed. Half of
    /// them: 0.920, 1½ times: 0.931, twice: 0.905.
    pub min_masks: [f32; 3],
}

impl Default for GraphOptions {
    fn default() -> Self {
        GraphOptions {
            superpixel_scale: 10.0,
            min_superpixel: 30.0,
            superpixel_edge: 40.0,
            edge: 2.0,
            enclosure: 0.4,
            size_power: 0.5,
            contour_power: 5.0,
            area_powers: [0.0, 1.0 / 3.0, 2.0 / 3.0],
            min_masks: [0.002, 0.008, 0.032],
        }
    }
}

/// Inputs of the merge tree.
pub(super) struct Cues<'a> {
    pub(super) labels: Image<i32>,
    pub(super) count: usize,
    pub(super) lab: Vec<[f32; 3]>,
    pub(super) edges: &'a Image<f32>,
}
