//! Bundle adjustment: cameras, focal lengths and points that minimise the robust reprojection error (Levenberg–Marquardt
//! in f64, points eliminated by the Schur complement).
use super::numeric::{cauchy, cauchy_weight, skew};
use crate::scene::Pose;
use crate::{Error, Result};
use glam::{DMat3, DVec2, DVec3};
use nalgebra::{DMatrix, DVector};

/// One sighting of a point.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Observation {
    pub(crate) camera: usize,
    pub(crate) point: usize,
    /// Measured position, pixels.
    pub(crate) pixel: DVec2,
    /// One standard deviation, pixels.
    pub(crate) sigma: f64,
}

/// Everything the adjustment changes, and what it may not.
#[derive(Clone, Debug, Default)]
pub(crate) struct Problem {
    /// World → camera; camera 0 stays fixed.
    pub(crate) poses: Vec<Pose>,
    /// Principal point per camera, pixels, fixed.
    pub(crate) centres: Vec<DVec2>,
    /// Which focal length each camera uses.
    pub(crate) group: Vec<usize>,
    /// Pixels of each camera per unit of its focal length: photos of one camera may be scaled differently.
    pub(crate) zoom: Vec<f64>,
    /// Focal lengths.
    pub(crate) focals: Vec<f64>,
    /// (ln f, σ of ln f) before seeing the images; σ = 0 holds the focal length fixed.
    pub(crate) priors: Vec<(f64, f64)>,
    pub(crate) points: Vec<DVec3>,
    pub(crate) observations: Vec<Observation>,
}

/// What an adjustment found.
#[derive(Clone, Debug)]
pub(crate) struct Outcome {
    /// σ of ln f per focal group.
    pub(crate) focal_log_sigma: Vec<f64>,
}

/// Normal equations: camera block (poses 1.., then focal groups), and per point its own block and coupling.
struct Normal {
    h: DMatrix<f64>,
    g: DVector<f64>,
    points: Vec<PointBlock>,
}

struct PointBlock {
    v: DMat3,
    g: DVec3,
    /// (parameter index, 3-vector coupling).
    coupling: Vec<(usize, DVec3)>,
}

impl Problem {
    /// Projection in camera frame and its pixel.
    fn project(&self, o: &Observation) -> (DVec3, DVec2) {
        let t = self.poses[o.camera].transform(self.points[o.point]);
        let f = self.focals[self.group[o.camera]] * self.zoom[o.camera];
        (t, DVec2::new(f * t.x / t.z, f * t.y / t.z) + self.centres[o.camera])
    }

    /// Reprojection residual of an observation, pixels; infinite behind the camera.
    pub(crate) fn residual(&self, o: &Observation) -> DVec2 {
        let (t, p) = self.project(o);
        if t.z > 0.0 { p - o.pixel } else { DVec2::INFINITY }
    }

    /// Robust cost; `c` is the Cauchy scale in standard deviations.
    pub(crate) fn cost(&self, c: f64) -> f64 {
        let data: f64 = self
            .observations
            .iter()
            .map(|o| {
                let (t, p) = self.project(o);
                // A point that a step pushes behind a camera must look expensive, but finite.
                if t.z > 1e-9 {
                    cauchy((p - o.pixel).length_squared() / (o.sigma * o.sigma), c)
                } else {
                    cauchy(1e12, c)
                }
            })
            .sum();
        data + self.prior_cost()
    }

    fn prior_cost(&self) -> f64 {
        self.focals
            .iter()
            .zip(&self.priors)
            .filter(|(_, p)| p.1 > 0.0)
            .map(|(f, p)| ((f.ln() - p.0) / p.1).powi(2))
            .sum()
    }

    fn camera_offset(&self, camera: usize) -> Option<usize> {
        camera.checked_sub(1).map(|c| 6 * c)
    }

    fn linearise(&self, c: f64) -> Normal {
        let pose_size = 6 * (self.poses.len() - 1);
        let n = pose_size + self.focals.len();
        let mut normal = Normal { h: DMatrix::zeros(n, n), g: DVector::zeros(n), points: Vec::new() };
        normal.points = (0..self.points.len())
            .map(|_| PointBlock { v: DMat3::ZERO, g: DVec3::ZERO, coupling: Vec::new() })
            .collect();
        for o in &self.observations {
            let (t, p) = self.project(o);
            if t.z <= 1e-9 {
                continue;
            }
            let r = (p - o.pixel) / o.sigma;
            let w = cauchy_weight(r.length_squared(), c);
            let f = self.focals[self.group[o.camera]] * self.zoom[o.camera];
            let s = f / (t.z * o.sigma);
            // Rows of ∂(u, v)/∂t, each a 3-vector.
            let rows = [DVec3::new(s, 0.0, -s * t.x / t.z), DVec3::new(0.0, s, -s * t.y / t.z)];
            let rotation = self.poses[o.camera].rotation;
            let (rt, kt) = (rotation.transpose(), skew(t));
            let block = &mut normal.points[o.point];
            for (axis, row) in rows.iter().enumerate() {
                let jp = rt * *row;
                // δt = ρ − [t]× θ, so ∂/∂θ = −rowᵀ[t]× = ([t]× row)ᵀ.
                let jt = kt * *row;
                // ∂(u, v)/∂ ln f is the centred pixel itself.
                let jf = s * [t.x, t.y][axis];
                let mut entries: Vec<(usize, f64)> = Vec::with_capacity(7);
                if let Some(base) = self.camera_offset(o.camera) {
                    for k in 0..3 {
                        entries.push((base + k, row[k]));
                        entries.push((base + 3 + k, jt[k]));
                    }
                }
                if self.priors[self.group[o.camera]].1 > 0.0 {
                    entries.push((pose_size + self.group[o.camera], jf));
                }
                let residual = r[axis];
                for &(i, a) in &entries {
                    normal.g[i] += w * a * residual;
                    for &(j, b) in &entries {
                        normal.h[(i, j)] += w * a * b;
                    }
                    match block.coupling.iter_mut().find(|e| e.0 == i) {
                        Some(e) => e.1 += jp * (w * a),
                        None => block.coupling.push((i, jp * (w * a))),
                    }
                }
                block.g += jp * (w * residual);
                block.v += DMat3::from_cols(jp * jp.x, jp * jp.y, jp * jp.z) * w;
            }
        }
        for (k, (f, p)) in self.focals.iter().zip(&self.priors).enumerate() {
            let i = pose_size + k;
            if p.1 > 0.0 {
                normal.h[(i, i)] += 1.0 / (p.1 * p.1);
                normal.g[i] += (f.ln() - p.0) / (p.1 * p.1);
            } else {
                normal.h[(i, i)] += 1.0;
            }
        }
        normal
    }

    /// The camera system after eliminating the points, with damping λ on every diagonal.
    fn reduce(normal: &Normal, lambda: f64) -> (DMatrix<f64>, DVector<f64>, Vec<DMat3>) {
        let (mut s, mut b) = (normal.h.clone(), normal.g.clone());
        for i in 0..b.len() {
            s[(i, i)] *= 1.0 + lambda;
        }
        let mut inverses = Vec::with_capacity(normal.points.len());
        for p in &normal.points {
            let mut v = p.v;
            // The tiny absolute term keeps unobserved points from making the block singular.
            for k in 0..3 {
                v.col_mut(k)[k] += lambda * p.v.col(k)[k] + 1e-12;
            }
            let inverse = v.inverse();
            let vg = inverse * p.g;
            for &(i, a) in &p.coupling {
                b[i] -= a.dot(vg);
                let va = inverse * a;
                for &(j, c) in &p.coupling {
                    s[(i, j)] -= va.dot(c);
                }
            }
            inverses.push(inverse);
        }
        (s, b, inverses)
    }

    fn stepped(&self, normal: &Normal, lambda: f64) -> Option<Problem> {
        let (s, b, inverses) = Self::reduce(normal, lambda);
        let d = s.cholesky()?.solve(&b);
        if !d.iter().all(|v| v.is_finite()) {
            return None;
        }
        let mut next = self.clone();
        for k in 1..self.poses.len() {
            let at = |i: usize| -d[6 * (k - 1) + i];
            let step = Pose::exp(DVec3::new(at(0), at(1), at(2)), DVec3::new(at(3), at(4), at(5)));
            next.poses[k] = step.compose(&self.poses[k]).orthonormalised();
        }
        let pose_size = 6 * (self.poses.len() - 1);
        for k in 0..self.focals.len() {
            // A step of more than e^0.5 in focal length is outside the linear range.
            next.focals[k] *= (-d[pose_size + k]).clamp(-0.5, 0.5).exp();
        }
        for (k, p) in normal.points.iter().enumerate() {
            let mut g = p.g;
            for &(i, a) in &p.coupling {
                g -= a * d[i];
            }
            next.points[k] -= inverses[k] * g;
        }
        Some(next)
    }

    /// Minimises the robust cost with Cauchy scale `c` (standard deviations).
    pub(crate) fn solve(&mut self, c: f64, max_steps: usize) -> Result<Outcome> {
        if self.poses.len() < 2 || self.observations.is_empty() {
            return Err(Error::work("bundle adjustment: needs two cameras with common points"));
        }
        let mut cost = self.cost(c);
        let mut lambda = 1e-4;
        for _ in 0..max_steps {
            let normal = self.linearise(c);
            let before = cost;
            for _ in 0..10 {
                if let Some(next) = self.stepped(&normal, lambda) {
                    let trial = next.cost(c);
                    if trial < cost {
                        (*self, cost) = (next, trial);
                        lambda = (lambda * 0.2).max(1e-10);
                        break;
                    }
                }
                lambda *= 8.0;
            }
            if before - cost <= 1e-8 * before {
                break;
            }
        }
        Ok(Outcome { focal_log_sigma: self.focal_sigma(c) })
    }

    /// σ of ln f per group from the inverse of the reduced system, scaled by the observed residual variance.
    fn focal_sigma(&self, c: f64) -> Vec<f64> {
        let normal = self.linearise(c);
        // Marginalise the points without damping; λ = 1e-9 only keeps numerical zeros positive.
        let (mut s, _, _) = Self::reduce(&normal, 1e-9);
        let pose_size = 6 * (self.poses.len() - 1);
        let n = s.nrows();
        // The unit of length is free: pin it along the direction that scales all translations.
        let gauge = DVector::from_fn(n, |i, _| {
            if i < pose_size && i % 6 < 3 { self.poses[1 + i / 6].translation[i % 6] } else { 0.0 }
        });
        let strength = s.trace() / n as f64 / gauge.norm_squared().max(1e-12);
        s += &gauge * gauge.transpose() * strength;
        let (mut sum, mut freedom) = (0.0, -(n as f64) - 3.0 * self.points.len() as f64);
        for o in &self.observations {
            let r2 = self.residual(o).length_squared() / (o.sigma * o.sigma);
            if r2.is_finite() {
                let w = cauchy_weight(r2, c);
                sum += w * r2;
                freedom += 2.0 * w;
            }
        }
        let variance = sum / freedom.max(1.0);
        let Some(inverse) = s.cholesky().map(|f| f.inverse()) else {
            return vec![f64::INFINITY; self.focals.len()];
        };
        (0..self.focals.len())
            .map(|k| {
                let i = pose_size + k;
                if self.priors[k].1 > 0.0 {
                    (inverse[(i, i)] * variance).sqrt().min(self.priors[k].1)
                } else {
                    0.0
                }
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::numeric::{Rng, rotation_angle};

    /// Four cameras on an arc of 60° around 200 points; pixel noise `noise`.
    fn scene(noise: f64) -> (Problem, Problem) {
        let mut rng = Rng::new(5);
        let mut p = Problem {
            centres: vec![DVec2::new(320.0, 240.0); 4],
            group: vec![0; 4],
            zoom: vec![1.0; 4],
            focals: vec![600.0],
            priors: vec![(576f64.ln(), 0.35)],
            ..Default::default()
        };
        for k in 0..4 {
            let turn = Pose::exp(DVec3::ZERO, DVec3::new(0.1 * k as f64, 0.35 * k as f64, 0.05));
            // Orbit about (0, 0, 3).
            let c = DVec3::new(0.0, 0.0, 3.0);
            p.poses.push(Pose { rotation: turn.rotation, translation: c - turn.rotation * c });
        }
        p.poses[0] = Pose::IDENTITY;
        for k in 0..200 {
            p.points.push(DVec3::new(rng.normal() * 0.5, rng.normal() * 0.4, 3.0 + rng.normal() * 0.4));
            for camera in 0..4 {
                let mut o = Observation { camera, point: k, pixel: DVec2::ZERO, sigma: 1.0 };
                o.pixel = p.project(&o).1 + DVec2::new(rng.normal(), rng.normal()) * noise;
                p.observations.push(o);
            }
        }
        let truth = p.clone();
        p.focals[0] *= 1.15;
        for k in 1..4 {
            let v = |rng: &mut Rng| DVec3::new(rng.normal(), rng.normal(), rng.normal()) * 0.02;
            p.poses[k] = Pose::exp(v(&mut rng), v(&mut rng)).compose(&p.poses[k]);
        }
        for x in &mut p.points {
            *x += DVec3::new(rng.normal(), rng.normal(), rng.normal()) * 0.03;
        }
        (p, truth)
    }

    #[test]
    fn exact_data_with_outliers_is_recovered() {
        let (mut p, truth) = scene(0.0);
        let mut rng = Rng::new(8);
        for o in p.observations.iter_mut().step_by(7) {
            o.pixel += DVec2::new(rng.normal(), rng.normal()) * 40.0;
        }
        p.priors[0].1 = 100.0;
        p.solve(4.0, 60).unwrap();
        p.solve(0.02, 60).unwrap();
        assert!((p.focals[0] / 600.0 - 1.0).abs() < 1e-4, "{}", p.focals[0]);
        for (a, b) in p.poses.iter().zip(&truth.poses) {
            assert!(rotation_angle(&(a.rotation * b.rotation.transpose())) < 1e-4);
        }
    }

    #[test]
    fn focal_sigma_predicts_the_scatter_of_the_estimate() {
        // σ of one run is compared with the actual error of that run: within a factor that a normal
        // deviate exceeds once in 10,000.
        let (mut p, _) = scene(1.0);
        let out = p.solve(1e3, 60).unwrap();
        let sigma = out.focal_log_sigma[0];
        assert!(sigma > 1e-4 && sigma < 0.02, "{sigma}");
        assert!((p.focals[0] / 600.0).ln().abs() < 3.9 * sigma, "{} {sigma}", p.focals[0]);
    }
}
