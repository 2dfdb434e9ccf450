//! What one match says of two cameras and two depth maps: residuals with their derivatives.
use crate::numeric::skew;
use crate::scene::{ModelView, Pose};
use glam::{DMat3, DVec2, DVec3};

/// Pitch of the depth-correction grid, model pixels.
pub(super) const PITCH: f64 = 16.0;
/// Cauchy scale of the relative depth.
const DEPTH_SCALE: f64 = 0.02;

/// Depth-correction grid of one view.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lattice {
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl Lattice {
    pub(super) fn new(view: &ModelView) -> Lattice {
        let count = |n: usize| (n as f64 / PITCH).ceil() as usize + 1;
        Lattice { columns: count(view.width), rows: count(view.height) }
    }

    pub(super) fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// The corners to the right of a corner and below it.
    pub(super) fn later_neighbours(&self, i: usize) -> impl Iterator<Item = usize> {
        let right = (i % self.columns + 1 < self.columns).then_some(i + 1);
        let below = (i / self.columns + 1 < self.rows).then_some(i + self.columns);
        right.into_iter().chain(below)
    }

    /// Corner indices and bilinear weights at a position.
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
    /// Relative to the principal point.
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

/// Camera unknowns of a pair: six of each pose, then two focal lengths, then two log scales.
pub(super) const SLOTS: usize = 16;

/// The slot of a side's first pose unknown, of its focal length and of its log scale.
pub(super) fn slots(side: usize) -> (usize, usize, usize) {
    (6 * side, 12 + side, 14 + side)
}

/// From one side of a pair to the other.
pub(super) struct Direction {
    /// Camera of the point → camera that sees it.
    pub(super) relative: Pose,
    /// Focal lengths of both, model pixels.
    pub(super) focals: [f64; 2],
    /// Which side of the pair the point is of: 0 or 1.
    pub(super) side: usize,
    /// Cauchy scale of reprojections, pixels.
    pub(super) pixel_scale: f64,
}

/// Residuals (u, v in Cauchy scales; relative depth in Cauchy scales) with derivatives.
pub(super) struct Row {
    pub(super) r: [f64; 3],
    /// By the camera unknowns of the pair.
    pub(super) camera: [[f64; SLOTS]; 3],
    /// By ln depth of the point.
    pub(super) along: [f64; 3],
    /// Of the third by ln depth of the pixel that it is seen at; the others do not depend on it.
    pub(super) away: f64,
}

impl Direction {
    /// Residuals of end `a`, `depths[0]` deep, against end `b`, `depths[1]` deep; `None` behind the
    /// camera.
    pub(super) fn residual(&self, a: &End, b: &End, depths: [f64; 2]) -> Option<[f64; 3]> {
        self.seen(a, b, depths).map(|s| s.0)
    }

    /// Residuals, the point in its own camera and in the one that sees it.
    fn seen(&self, a: &End, b: &End, depths: [f64; 2]) -> Option<([f64; 3], DVec3, DVec3)> {
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
        let (r, y, t) = self.seen(a, b, depths)?;
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
        // T ← exp(ρ, θ) T: δt = ρ − [t]× θ; the inverse moves the other way, in the first camera's
        // frame: δy = −ρ + [y]× θ.
        let (turn_b, turn_a) = (skew(t), relative * skew(y));
        for c in 0..3 {
            set(pose_b + c, DVec3::AXES[c]);
            set(pose_b + 3 + c, -turn_b.col(c));
            set(pose_a + c, -relative.col(c));
            set(pose_a + 3 + c, turn_a.col(c));
        }
        set(focal_a, relative * DVec3::new(-y.x, -y.y, 0.0));
        let along = jt.map(|j| j.dot(relative * y));
        let away = -t.z / (depths[1] * DEPTH_SCALE);
        (0..3).for_each(|i| camera[i][kappa_a] = along[i]);
        camera[2][kappa_b] = away;
        (camera[0][focal_b], camera[1][focal_b]) = (k * t.x, k * t.y);
        Some(Row { r, camera, along, away })
    }
}
