//! Planes in depth: an affine fit of inverse depth over the image, mergeable by adding moments.
use glam::{DMat3, DVec3};

/// Moments of (x, y, 1/z) over a region, x and y on the z = 1 plane. A 3D plane is affine in these coordinates.
#[derive(Clone, Copy, Default)]
pub(super) struct PlaneFit {
    n: f64,
    xx: DMat3,
    xd: DVec3,
    dd: f64,
}

/// Pixels below which a plane is noise.
const MIN_PIXELS: f64 = 40.0;

impl PlaneFit {
    pub fn add(&mut self, ray: (f64, f64), z: f32, confidence: f32) {
        if z <= 0.0 || confidence <= 0.0 {
            return;
        }
        let (v, d) = (DVec3::new(ray.0, ray.1, 1.0), 1.0 / z as f64);
        self.n += 1.0;
        self.xx += DMat3::from_cols(v * v.x, v * v.y, v * v.z);
        self.xd += v * d;
        self.dd += d * d;
    }
    pub fn merge(&mut self, other: &PlaneFit) {
        self.n += other.n;
        self.xx += other.xx;
        self.xd += other.xd;
        self.dd += other.dd;
    }
    /// Coefficients (a, b, c) of `1/z = a x + b y + c` and the mean squared residual.
    fn solve(&self) -> Option<(DVec3, f64)> {
        if self.n < MIN_PIXELS {
            return None;
        }
        // a slight pull towards a fronto-parallel plane keeps thin regions solvable
        let ridge = DMat3::from_diagonal(DVec3::new(1.0, 1.0, 0.0)) * (1e-6 * self.n);
        let plane = (self.xx + ridge).inverse() * self.xd;
        let residual = (self.dd - 2.0 * plane.dot(self.xd) + plane.dot(self.xx * plane)) / self.n;
        plane.is_finite().then_some((plane, residual.max(0.0)))
    }
    /// Centre in camera coordinates, and inward unit normal (pointing away from the camera).
    fn pose(&self, plane: DVec3) -> (DVec3, DVec3) {
        // a x + b y + c = 1/z with x = X/z: a X + b Y + c Z = 1
        let mean = self.xd / self.n;
        let centre = DVec3::new(self.xx.z_axis.x, self.xx.z_axis.y, self.n) / self.n;
        let z = 1.0 / mean.z.max(1e-9);
        (centre * z, plane.normalize_or_zero())
    }
    /// Evidence against two regions being one smooth or convex thing, in [0, 1]: 0 when one plane fits both, or
    /// when they meet in a convex ridge; towards 1 when they meet in a concave crease (where things stand on things).
    pub fn bend(a: &PlaneFit, b: &PlaneFit, noise: f64) -> f32 {
        let (Some((pa, ra)), Some((pb, rb))) = (a.solve(), b.solve()) else { return 0.0 };
        let mut both = *a;
        both.merge(b);
        let Some((_, rab)) = both.solve() else { return 0.0 };
        let inverse_depth = both.xd.z / both.n;
        let apart = (rab - (ra * a.n + rb * b.n) / both.n).max(0.0).sqrt();
        // in units of the depth noise of one pixel
        let misfit = apart / (noise * inverse_depth);
        let ((ca, na), (cb, nb)) = (a.pose(pa), b.pose(pb));
        let along = (ca - cb).normalize_or_zero();
        // normals point away from the camera: they close up across a ridge and open across a valley
        let valley = (na - nb).dot(along);
        let against = if valley > 0.0 { 1.0 } else { 0.3 };
        (against * (1.0 - (-misfit).exp())) as f32
    }
}
