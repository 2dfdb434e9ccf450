//! What the masks depend on. Measurements are means of the best-of-three IoU and of that with one level per object
//! (`splatvk bench masks`) over the tuning sets of `docs/method.md#graph-masks`.
use crate::scene::Plane;

/// Blur before anything is compared, pixels.
pub(super) const SMOOTHING: f32 = 0.5;

/// Difference of mean colours that counts as 63 % of a certain one, Lab units: it is plain to see.
pub(super) const DIFFERENT: f32 = 20.0;

/// Least difference, so that size and enclosure order the merges of equal regions, too.
pub(super) const EQUAL: f32 = 1e-4;

/// How an image is cut into masks.
#[derive(Clone, Debug, PartialEq)]
pub struct GraphOptions {
    /// Felzenszwalb–Huttenlocher scale of the superpixels, Lab units · pixels at 640 × 480.
    pub superpixel_scale: f32,
    /// Smallest superpixel, pixels at 640 × 480.
    pub min_superpixel: f32,
    /// A certain learned boundary between two pixels, Lab units of difference.
    pub superpixel_edge: f32,
    /// Weight of the learned boundary in the cost of a merge, beside that of the colours; both lie in [0, 1].
    pub edge: f32,
    /// How much a full enclosure lowers the cost.
    pub enclosure: f32,
    /// Exponent of the smaller region's share of the image.
    pub size_power: f32,
    /// Exponent of a mask's mean contour strength in its score.
    pub contour_power: f32,
    /// Exponents of its area on levels s, m, l.
    pub area_powers: [f32; 3],
    /// Smallest masks of levels s, m, l, share of the image.
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

/// Everything the tree is built from.
pub(super) struct Cues<'a> {
    pub(super) labels: Plane<i32>,
    pub(super) count: usize,
    pub(super) lab: Vec<[f32; 3]>,
    pub(super) edges: &'a Plane<f32>,
}
