//! Residuals of one match and their derivatives by cameras and depth corrections.
use crate::numeric::skew;
use crate::scene::{ModelView, Pose};
use glam::{DMat3, DVec2, DVec3};

/// Pitch of the depth-correction grid, model pixels.
pub(super) const PITCH: f64 = 16.0;
/// Cauchy scale of the relative depth.
const DEPTH_SCALE: f64 = 0.02;

/// Number of corners along a side of `n` pixels.
fn corner_count(n: usize) -> usize {
    (n as f64 / PITCH).ceil() as usize + 1
}

/// Depth-correction grid of one view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lattice {
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl Lattice {
    pub(super) fn new(view: &ModelView) -> Lattice {
        Lattice { columns: corner_count(view.width), rows: corner_count(view.height) }
    }

    pub(super) fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// Corners to the right of a corner and below it.
    pub(super) fn later_neighbours(&self, i: usize) -> impl Iterator<Item = usize> {
        let right = (i % self.columns + 1 < self.columns).then_some(i + 1);
        let below = (i / self.columns + 1 < self.rows).then_some(i + self.columns);
        right.into_iter().chain(below)
    }

    /// Corner indices and bilinear weights at a position in model pixels.
    pub(super) fn corners(&self, p: DVec2) -> ([usize; 4], [f64; 4]) {
        let u = (p / PITCH).max(DVec2::ZERO);
        let x = (u.x as usize).min(self.columns - 2);
        let y = (u.y as usize).min(self.rows - 2);
        let (fx, fy) = (u.x - x as f64, u.y - y as f64);
        let i = y * self.columns + x;
        let w = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        ([i, i + 1, i + self.columns, i + self.columns + 1], w)
    }
}

/// One end of a match.
#[derive(Clone, Copy, Debug)]
pub(super) struct End {
    /// Position relative to the principal point, model pixels.
    pub(super) pixel: DVec2,
    /// Canonical depth.
    pub(super) depth: f64,
    pub(super) corners: [usize; 4],
    pub(super) weights: [f64; 4],
}

impl End {
    /// Global depth, from the view's log scale and corrections.
    pub(super) fn depth(&self, kappa: f64, grid: &[f64]) -> f64 {
        let a: f64 = self.corners.iter().zip(self.weights).map(|(c, w)| w * grid[*c]).sum();
        self.depth * (kappa + a).exp()
    }
}

/// Camera unknowns of a pair: six per pose, then two focal lengths, then two log scales.
pub(super) const SLOTS: usize = 16;

/// Slots of the first pose unknown, the focal length and the log scale of a side.
pub(super) fn slots(side: usize) -> (usize, usize, usize) {
    (6 * side, 12 + side, 14 + side)
}

/// Reprojection of points of one side of a pair into the other.
pub(super) struct Direction {
    /// Camera of the point → camera of the pixel.
    pub(super) relative: Pose,
    /// Focal lengths of both cameras, model pixels.
    pub(super) focals: [f64; 2],
    /// Side of the point: 0 or 1.
    pub(super) side: usize,
    /// Cauchy scale of reprojections, pixels.
    pub(super) pixel_scale: f64,
}

/// Residuals (u, v and relative depth, each in Cauchy scales) with derivatives.
pub(super) struct Row {
    pub(super) r: [f64; 3],
    /// Derivatives by the camera unknowns of the pair.
    pub(super) camera: [[f64; SLOTS]; 3],
    /// Derivatives by ln depth of the point.
    pub(super) by_point_depth: [f64; 3],
    /// Derivative of the third residual by ln depth of the pixel; the others do not depend on it.
    pub(super) by_pixel_depth: f64,
}

impl Direction {
    /// Residuals of the point of end `a` against end `b`, with `depths` in this order; `None`
    /// behind the camera.
    pub(super) fn residual(&self, a: &End, b: &End, depths: [f64; 2]) -> Option<[f64; 3]> {
        self.reprojection(a, b, depths).map(|s| s.0)
    }

    /// Residuals, and the point in its own camera and in the other.
    fn reprojection(&self, a: &End, b: &End, depths: [f64; 2]) -> Option<([f64; 3], DVec3, DVec3)> {
        let y = DVec3::new(a.pixel.x / self.focals[0], a.pixel.y / self.focals[0], 1.0) * depths[0];
        let t = self.relative.transform(y);
        if t.z <= 1e-9 {
            return None;
        }
        let d = (DVec2::new(t.x, t.y) * (self.focals[1] / t.z) - b.pixel) / self.pixel_scale;
        Some(([d.x, d.y, (t.z / depths[1] - 1.0) / DEPTH_SCALE], y, t))
    }

    /// Residuals with their derivatives.
    pub(super) fn row(&self, a: &End, b: &End, depths: [f64; 2]) -> Option<Row> {
        let (r, y, t) = self.reprojection(a, b, depths)?;
        let k = self.focals[1] / (t.z * self.pixel_scale);
        // ∂r/∂t, one row per residual.
        let jt = [
            DVec3::new(k, 0.0, -k * t.x / t.z),
            DVec3::new(0.0, k, -k * t.y / t.z),
            DVec3::new(0.0, 0.0, 1.0 / (depths[1] * DEPTH_SCALE)),
        ];
        let mut camera = [[0.0; SLOTS]; 3];
        let mut set = |slot: usize, d: DVec3| (0..3).for_each(|i| camera[i][slot] = jt[i].dot(d));
        let ((pose_a, focal_a, kappa_a), (pose_b, focal_b, kappa_b)) =
            (slots(self.side), slots(1 - self.side));
        let relative: DMat3 = self.relative.rotation;
        // T ← exp(ρ, θ) T: δt = ρ − [t]× θ; the inverse for the first camera: δy = −ρ + [y]× θ.
        let (rotation_b, rotation_a) = (skew(t), relative * skew(y));
        for c in 0..3 {
            set(pose_b + c, DVec3::AXES[c]);
            set(pose_b + 3 + c, -rotation_b.col(c));
            set(pose_a + c, -relative.col(c));
            set(pose_a + 3 + c, rotation_a.col(c));
        }
        set(focal_a, relative * DVec3::new(-y.x, -y.y, 0.0));
        let by_point_depth = jt.map(|j| j.dot(relative * y));
        let by_pixel_depth = -t.z / (depths[1] * DEPTH_SCALE);
        (0..3).for_each(|i| camera[i][kappa_a] = by_point_depth[i]);
        camera[2][kappa_b] = by_pixel_depth;
        (camera[0][focal_b], camera[1][focal_b]) = (k * t.x, k * t.y);
        Some(Row { r, camera, by_point_depth, by_pixel_depth })
    }
}
