//! Bundle adjustment: cameras, their optics and points that minimise the robust reprojection error (Levenberg–Marquardt
//! in f64, points eliminated by the Schur complement).
use super::numeric::{cauchy, cauchy_weight, skew};
use crate::scene::{Lens, Pose};
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

/// What the photos of one camera share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Optics {
    /// Focal length, original pixels.
    pub(crate) focal: f64,
    /// Radial distortion.
    pub(crate) lens: Lens,
    /// Principal point from the middle of the photo, original pixels.
    pub(crate) shift: DVec2,
}

/// Number of parameters of [`Optics`]: ln f, k1, k2, shift.
const OPTICS: usize = 5;

/// What is known of optics before the images are seen, as normal deviates. σ = 0 holds a parameter where it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct OpticsPrior {
    /// ln f and its σ.
    pub(crate) log_focal: (f64, f64),
    /// σ of k1 and k2 around 0.
    pub(crate) lens: [f64; 2],
    /// σ of the shift around 0, original pixels.
    pub(crate) shift: f64,
}

impl OpticsPrior {
    /// Number of parameters that it leaves free.
    pub(crate) fn count(&self) -> usize {
        let radial = self.lens.iter().filter(|s| **s > 0.0).count();
        usize::from(self.log_focal.1 > 0.0) + radial + 2 * usize::from(self.shift > 0.0)
    }

    /// σ of every parameter, in the order of [`Outcome::sigmas`].
    pub(crate) fn sigmas(&self) -> [f64; OPTICS] {
        [self.log_focal.1, self.lens[0], self.lens[1], self.shift, self.shift]
    }

    /// (distance from the prior's mean, σ) of every parameter.
    fn deviations(&self, o: &Optics) -> [(f64, f64); OPTICS] {
        [
            (o.focal.ln() - self.log_focal.0, self.log_focal.1),
            (o.lens.k1, self.lens[0]),
            (o.lens.k2, self.lens[1]),
            (o.shift.x, self.shift),
            (o.shift.y, self.shift),
        ]
    }
}

/// Everything the adjustment changes, and what it may not.
#[derive(Clone, Debug, Default)]
pub(crate) struct Problem {
    /// World → camera; camera 0 stays fixed.
    pub(crate) poses: Vec<Pose>,
    /// Middle of each photo, pixels.
    pub(crate) centres: Vec<DVec2>,
    /// Which optics each camera uses.
    pub(crate) group: Vec<usize>,
    /// Pixels of each camera per original pixel of its optics: photos of one camera may be scaled differently.
    pub(crate) zoom: Vec<f64>,
    /// Per group.
    pub(crate) optics: Vec<Optics>,
    /// Per group.
    pub(crate) priors: Vec<OpticsPrior>,
    pub(crate) points: Vec<DVec3>,
    pub(crate) observations: Vec<Observation>,
}

/// What an adjustment found.
#[derive(Clone, Debug)]
pub(crate) struct Outcome {
    /// Robust cost, in squared standard deviations.
    pub(crate) cost: f64,
    /// σ of ln f, k1, k2 and the shift per group, from the observations and the priors; 0 where held.
    pub(crate) sigmas: Vec<[f64; OPTICS]>,
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
        let (optics, zoom) = (&self.optics[self.group[o.camera]], self.zoom[o.camera]);
        let seen = optics.lens.distort(DVec2::new(t.x, t.y) / t.z);
        (t, seen * (optics.focal * zoom) + optics.shift * zoom + self.centres[o.camera])
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
        let all = self.optics.iter().zip(&self.priors).flat_map(|(o, p)| p.deviations(o));
        all.filter(|(_, sigma)| *sigma > 0.0).map(|(d, sigma)| (d / sigma).powi(2)).sum()
    }

    fn camera_offset(&self, camera: usize) -> Option<usize> {
        camera.checked_sub(1).map(|c| 6 * c)
    }

    fn linearise(&self, c: f64) -> Normal {
        let pose_size = 6 * (self.poses.len() - 1);
        let n = pose_size + OPTICS * self.optics.len();
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
            let (optics, zoom) = (&self.optics[self.group[o.camera]], self.zoom[o.camera]);
            let f = optics.focal * zoom / o.sigma;
            let x = DVec2::new(t.x, t.y) / t.z;
            let bend = optics.lens.jacobian(x);
            // Rows of ∂(u, v)/∂t, each a 3-vector: through x = (X, Y)/Z and the lens.
            let rows = [0, 1].map(|axis| {
                let by = bend.row(axis) * (f / t.z);
                DVec3::new(by.x, by.y, -by.dot(x))
            });
            let r2 = x.length_squared();
            let seen = optics.lens.distort(x);
            let free = self.priors[self.group[o.camera]].deviations(optics).map(|d| d.1 > 0.0);
            let rotation = self.poses[o.camera].rotation;
            let (rt, kt) = (rotation.transpose(), skew(t));
            let block = &mut normal.points[o.point];
            for (axis, row) in rows.iter().enumerate() {
                let jp = rt * *row;
                // δt = ρ − [t]× θ, so ∂/∂θ = −rowᵀ[t]× = ([t]× row)ᵀ.
                let jt = kt * *row;
                // ∂(u, v)/∂ ln f is the centred pixel itself.
                let mut by = [f * seen[axis], f * x[axis] * r2, f * x[axis] * r2 * r2, 0.0, 0.0];
                by[3 + axis] = zoom / o.sigma;
                let mut entries: Vec<(usize, f64)> = Vec::with_capacity(6 + OPTICS);
                if let Some(base) = self.camera_offset(o.camera) {
                    for k in 0..3 {
                        entries.push((base + k, row[k]));
                        entries.push((base + 3 + k, jt[k]));
                    }
                }
                let base = pose_size + OPTICS * self.group[o.camera];
                entries.extend((0..OPTICS).filter(|k| free[*k] && by[*k] != 0.0).map(|k| (base + k, by[k])));
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
        let all = self.optics.iter().zip(&self.priors).flat_map(|(o, p)| p.deviations(o));
        for (k, (distance, sigma)) in all.enumerate() {
            let i = pose_size + k;
            if sigma > 0.0 {
                normal.h[(i, i)] += 1.0 / (sigma * sigma);
                normal.g[i] += distance / (sigma * sigma);
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
        for (k, optics) in next.optics.iter_mut().enumerate() {
            let step = |j: usize| -d[pose_size + OPTICS * k + j];
            // Steps beyond e^0.5 in focal length or 0.1 in the lens are outside the linear range.
            optics.focal *= step(0).clamp(-0.5, 0.5).exp();
            optics.lens.k1 += step(1).clamp(-0.1, 0.1);
            optics.lens.k2 += step(2).clamp(-0.1, 0.1);
            optics.shift += DVec2::new(step(3), step(4));
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
        Ok(Outcome { cost, sigmas: self.sigmas(c) })
    }

    /// σ of the optics from the inverse of the reduced system, scaled by the observed residual variance.
    fn sigmas(&self, c: f64) -> Vec<[f64; OPTICS]> {
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
        let inverse = s.cholesky().map(|f| f.inverse());
        let sigma = |group: usize, k: usize, prior: f64| {
            let i = pose_size + OPTICS * group + k;
            let seen = inverse.as_ref().map_or(f64::INFINITY, |m| (m[(i, i)] * variance).sqrt());
            seen.min(prior)
        };
        let of = |(group, (o, p)): (usize, (&Optics, &OpticsPrior))| {
            let priors = p.deviations(o).map(|d| d.1);
            std::array::from_fn(|k| sigma(group, k, priors[k]))
        };
        self.optics.iter().zip(&self.priors).enumerate().map(of).collect()
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
            optics: vec![Optics { focal: 600.0, lens: Lens::NONE, shift: DVec2::ZERO }],
            priors: vec![OpticsPrior { log_focal: (576f64.ln(), 0.35), ..Default::default() }],
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
        p.optics[0] = Optics { focal: p.optics[0].focal * 1.15, lens: Lens::NONE, shift: DVec2::ZERO };
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
        p.priors[0].log_focal.1 = 100.0;
        p.solve(4.0, 60).unwrap();
        p.solve(0.02, 60).unwrap();
        assert!((p.optics[0].focal / 600.0 - 1.0).abs() < 1e-4, "{}", p.optics[0].focal);
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
        let sigma = out.sigmas[0][0];
        assert!(sigma > 1e-4 && sigma < 0.02, "{sigma}");
        assert!((p.optics[0].focal / 600.0).ln().abs() < 3.9 * sigma, "{} {sigma}", p.optics[0].focal);
    }

    #[test]
    fn lens_and_principal_point_are_recovered_where_they_are_free() {
        let (mut p, _) = scene(0.0);
        let truth = Optics { focal: 600.0, lens: Lens { k1: -0.12, k2: 0.03 }, shift: DVec2::new(4.0, -3.0) };
        let (mut wide, _) = scene(0.0);
        wide.optics[0] = truth;
        // The rig of `scene` before it was disturbed, seen through that lens.
        let (_, rig) = scene(0.0);
        wide.poses.clone_from(&rig.poses);
        wide.points.clone_from(&rig.points);
        for (k, o) in wide.observations.iter().enumerate() {
            // Exact: the priors must not be felt.
            p.observations[k] = Observation { pixel: wide.project(o).1, sigma: 1e-3, ..*o };
        }
        let free = OpticsPrior { log_focal: (576f64.ln(), 0.35), lens: [0.5; 2], shift: 20.0 };
        let mut held = p.clone();
        p.priors[0] = free;
        p.solve(1e9, 200).unwrap();
        let found = p.optics[0];
        assert!((found.focal / 600.0 - 1.0).abs() < 1e-3, "{found:?}");
        assert!((found.lens.k1 + 0.12).abs() < 2e-3 && (found.lens.k2 - 0.03).abs() < 1e-2, "{found:?}");
        assert!((found.shift - truth.shift).length() < 0.5, "{found:?}");
        let out = held.solve(1e9, 100).unwrap();
        assert_eq!((held.optics[0].lens, held.optics[0].shift), (Lens::NONE, DVec2::ZERO));
        assert_eq!(out.sigmas[0][1..], [0.0; 4], "what is held has no doubt");
    }

    #[test]
    fn the_gradient_is_the_derivative_of_the_cost() {
        let (mut p, _) = scene(1.0);
        p.priors[0] = OpticsPrior { log_focal: (576f64.ln(), 0.35), lens: [0.1; 2], shift: 5.0 };
        p.optics[0] =
            Optics { focal: 620.0, lens: Lens { k1: 0.05, k2: -0.04 }, shift: DVec2::new(2.0, 1.0) };
        let c = 1e3;
        let normal = p.linearise(c);
        let pose_size = 6 * (p.poses.len() - 1);
        let change = |k: usize, h: f64| {
            let mut q = p.clone();
            let o = &mut q.optics[0];
            match k {
                0 => o.focal *= h.exp(),
                1 => o.lens.k1 += h,
                2 => o.lens.k2 += h,
                3 => o.shift.x += h,
                _ => o.shift.y += h,
            }
            q.cost(c)
        };
        for k in 0..OPTICS {
            let h = 1e-6;
            let numeric = (change(k, h) - change(k, -h)) / (2.0 * h);
            // The normal equations hold half the derivative; 1e-4 of it is the error of the difference.
            let analytic = 2.0 * normal.g[pose_size + k];
            assert!((numeric - analytic).abs() < 1e-4 * analytic.abs().max(1.0), "{k}: {numeric} {analytic}");
        }
    }
}
