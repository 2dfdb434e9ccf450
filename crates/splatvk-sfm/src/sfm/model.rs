//! State of a reconstruction: cameras, points and their observations.
use crate::Result;
use crate::bundle::{Adjusted, DisplacementSigmas, Intrinsics, IntrinsicsPrior, Observation, Problem};
use crate::scene::{Lens, Pose};
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Largest effective number of independent observations of a photo set. Neighbouring observations
/// have correlated errors (a bent surface taken for flat, JPEG, a moved shadow), so that thousands
/// more add little information on the intrinsics. On the tuning sets a spurious principal point
/// offset or distortion lowers the cost by up to 0.3 %, one that moves pixels by 5 by 1.3 % and
/// more; with 2000 the criterion requires 0.8 %. The same number makes the stated σ of the focal
/// length as large as its errors there.
const MAX_INDEPENDENT: f64 = 2000.0;
/// Pairs of photos with which [`MAX_INDEPENDENT`] was determined. Fewer pairs count in proportion,
/// since correlated errors do not repeat in another pair: two photos alone hardly determine their
/// intrinsics.
const PAIRS: f64 = 6.0;

/// Degrees of freedom in which residuals are assumed to have their σ, so that few observations,
/// which a model overfits, do not yield a smaller one.
const ASSUMED: f64 = 20.0;

/// Variance factor of the residuals, at most 1. Two photos leave one residual component per point,
/// and none of errors along the epipolar lines: their residuals are small whatever the errors.
fn variance_factor(problem: &Problem) -> f64 {
    if problem.poses.len() < 3 {
        return 1.0;
    }
    let (sum, degrees) = problem.squares(2.0);
    ((sum + ASSUMED) / (degrees.max(0.0) + ASSUMED)).min(1.0)
}

/// σ of the principal point offset, share of the long side: stabilised sensors move by up to a
/// hundredth.
pub(super) const PRINCIPAL_POINT_SIGMA: f64 = 0.007;

/// Observation of a point in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TrackElement {
    pub(super) view: usize,
    pub(super) pixel: DVec2,
    /// One standard deviation, pixels.
    pub(super) sigma: f64,
    /// Index of the detector that measured it; each has its own noise.
    pub(super) detector: usize,
}

/// A point with its observations; `position` is `None` until it is triangulated.
#[derive(Clone, Debug)]
pub(super) struct Track {
    pub(super) position: Option<DVec3>,
    pub(super) elements: Vec<TrackElement>,
}

/// Intrinsics that an adjustment refines.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RefinedIntrinsics {
    /// The focal length.
    Focal,
    /// Focal length and radial distortion.
    Radial,
    /// Focal length and principal point.
    PrincipalPoint,
    /// All of them.
    Full,
}

impl RefinedIntrinsics {
    pub(super) const ALL: [RefinedIntrinsics; 4] = [
        RefinedIntrinsics::Focal,
        RefinedIntrinsics::Radial,
        RefinedIntrinsics::PrincipalPoint,
        RefinedIntrinsics::Full,
    ];

    /// The prior, with σ = 0 for everything that is held.
    fn hold_others(self, prior: &IntrinsicsPrior) -> IntrinsicsPrior {
        let (radial, centre) = (
            matches!(self, RefinedIntrinsics::Radial | RefinedIntrinsics::Full),
            matches!(self, RefinedIntrinsics::PrincipalPoint | RefinedIntrinsics::Full),
        );
        IntrinsicsPrior {
            lens: if radial { prior.lens } else { [0.0; 2] },
            principal_point_offset: if centre { prior.principal_point_offset } else { 0.0 },
            ..*prior
        }
    }

    /// The intrinsics, with everything that is held at its prior mean.
    fn reset_others(self, intrinsics: &Intrinsics) -> Intrinsics {
        let prior = self.hold_others(&IntrinsicsPrior {
            log_focal: (0.0, 1.0),
            lens: [1.0; 2],
            principal_point_offset: 1.0,
        });
        Intrinsics {
            lens: if prior.lens[0] > 0.0 { intrinsics.lens } else { Lens::NONE },
            principal_point_offset: if prior.principal_point_offset > 0.0 {
                intrinsics.principal_point_offset
            } else {
                DVec2::ZERO
            },
            ..*intrinsics
        }
    }
}

/// Cameras by view and tracks; poses of unregistered views are `None`.
#[derive(Clone, Debug)]
pub(super) struct Model {
    pub(super) poses: Vec<Option<Pose>>,
    /// Image centre of each view, pixels.
    pub(super) centres: Vec<DVec2>,
    /// Camera id of each view: index into `intrinsics` and `priors`.
    pub(super) camera_ids: Vec<usize>,
    /// Camera ids by the data of the files, [`crate::photo::cameras_by_file`].
    pub(super) camera_ids_by_file: Vec<usize>,
    /// Camera ids, numbered in any way, if only photos share one whose files name camera and zoom.
    pub(super) camera_ids_by_exif: Vec<usize>,
    /// Pixels of the view per original pixel.
    pub(super) zoom: Vec<f64>,
    /// Per camera id.
    pub(super) intrinsics: Vec<Intrinsics>,
    /// Per camera id.
    pub(super) priors: Vec<IntrinsicsPrior>,
    /// Intrinsics that adjustments refine, except where σ of the prior is 0.
    pub(super) refined: RefinedIntrinsics,
    pub(super) tracks: Vec<Track>,
    /// Seed of RANSAC.
    pub(super) seed: u64,
}

/// Least triangulation angle of a usable point: below it the depth is mostly noise.
pub(super) const MIN_ANGLE_DEGREES: f64 = 1.0;

/// Most pairs of observations that a track of many is triangulated from. If half of the
/// observations are wrong, a quarter of the pairs are right.
const MAX_PAIRS: usize = 28;

impl Model {
    pub(super) fn focal(&self, view: usize) -> f64 {
        self.intrinsics[self.camera_ids[view]].focal * self.zoom[view]
    }

    pub(super) fn lens(&self, view: usize) -> Lens {
        self.intrinsics[self.camera_ids[view]].lens
    }

    /// Principal point, pixels.
    pub(super) fn principal_point(&self, view: usize) -> DVec2 {
        self.centres[view] + self.intrinsics[self.camera_ids[view]].principal_point_offset * self.zoom[view]
    }

    /// Long side of a view's photo, original pixels.
    pub(super) fn long_side(&self, view: usize) -> f64 {
        2.0 * self.centres[view].max_element() / self.zoom[view]
    }

    /// Whether the prior of any camera admits larger principal point offsets than those of whole
    /// photos.
    pub(super) fn has_crops(&self) -> bool {
        (0..self.camera_ids.len()).any(|v| {
            self.priors[self.camera_ids[v]].principal_point_offset
                > 2.0 * PRINCIPAL_POINT_SIGMA * self.long_side(v)
        })
    }

    /// Number of intrinsics parameters that adjustments refine.
    pub(super) fn intrinsics_parameters(&self) -> usize {
        self.priors.iter().map(|p| self.refined.hold_others(p).count()).sum()
    }

    /// Effective number of independent observations in so many residual components.
    pub(super) fn effective_observations(&self, components: usize) -> f64 {
        let views = self.poses.iter().flatten().count() as f64;
        let pairs = (0.5 * views * (views - 1.0)).clamp(1.0, PAIRS);
        (MAX_INDEPENDENT * pairs / PAIRS).min(components as f64)
    }

    /// Number of residual components of all observations.
    pub(super) fn residual_components(&self) -> usize {
        self.tracks.iter().map(|t| 2 * t.elements.len()).sum()
    }

    /// The model with other camera ids, numbered in any way. Each camera gets intrinsics and prior
    /// of its first view; views of one camera must have the same prior.
    pub(super) fn with_camera_ids(&self, camera_ids: &[usize]) -> Model {
        let mut out =
            Model { camera_ids: Vec::new(), intrinsics: Vec::new(), priors: Vec::new(), ..self.clone() };
        let mut ids = Vec::new();
        for (view, id) in camera_ids.iter().enumerate() {
            let known = ids.iter().position(|i| i == id);
            out.camera_ids.push(known.unwrap_or(ids.len()));
            if known.is_none() {
                ids.push(*id);
                out.intrinsics.push(self.intrinsics[self.camera_ids[view]]);
                out.priors.push(self.priors[self.camera_ids[view]]);
            }
        }
        out
    }

    /// The model with separate intrinsics for every view that may have them; `None` where the files
    /// leave no choice.
    pub(super) fn with_separate_intrinsics(&self) -> Option<Model> {
        let separate = self.with_camera_ids(&self.camera_ids_by_exif);
        (separate.camera_ids != self.camera_ids_by_file).then_some(separate)
    }

    /// Scales images, observations and σ by `ratios`, one per view.
    pub(super) fn rescale_images(&mut self, ratios: &[f64]) {
        for (v, r) in ratios.iter().enumerate() {
            self.centres[v] *= *r;
            self.zoom[v] *= *r;
        }
        for s in self.tracks.iter_mut().flat_map(|t| &mut t.elements) {
            s.pixel *= ratios[s.view];
            s.sigma *= ratios[s.view];
        }
    }

    /// Keeps at most about `limit` tracks, evenly over their order, and returns all of them.
    pub(super) fn thin(&mut self, limit: usize) -> Vec<Track> {
        let every = self.tracks.len().div_ceil(limit).max(1);
        let few = self.tracks.iter().step_by(every).cloned().collect();
        std::mem::replace(&mut self.tracks, few)
    }

    /// Clone without tracks.
    pub(super) fn clone_without_tracks(&self) -> Model {
        Model {
            poses: self.poses.clone(),
            centres: self.centres.clone(),
            camera_ids: self.camera_ids.clone(),
            camera_ids_by_file: self.camera_ids_by_file.clone(),
            camera_ids_by_exif: self.camera_ids_by_exif.clone(),
            zoom: self.zoom.clone(),
            intrinsics: self.intrinsics.clone(),
            priors: self.priors.clone(),
            refined: self.refined,
            tracks: Vec::new(),
            seed: self.seed,
        }
    }

    /// Viewing ray in the camera frame, z = 1.
    pub(super) fn ray(&self, view: usize, pixel: DVec2) -> DVec3 {
        self.lens(view).undistort((pixel - self.principal_point(view)) / self.focal(view)).extend(1.0)
    }

    /// Undistorted pixel relative to the principal point, at the same focal length.
    pub(super) fn undistorted(&self, view: usize, pixel: DVec2) -> DVec2 {
        self.ray(view, pixel).truncate() * self.focal(view)
    }

    /// Pixel and depth of a world point; `None` in an unregistered view and behind the camera.
    pub(super) fn project(&self, view: usize, world: DVec3) -> Option<(DVec2, f64)> {
        let t = self.poses[view]?.transform(world);
        let distorted = || self.lens(view).distort(DVec2::new(t.x, t.y) / t.z);
        (t.z > 1e-9).then(|| (distorted() * self.focal(view) + self.principal_point(view), t.z))
    }

    /// Reprojection error, pixels; infinite behind the camera.
    pub(super) fn reprojection_error(&self, s: &TrackElement, world: DVec3) -> f64 {
        self.project(s.view, world).map_or(f64::INFINITY, |(p, _)| (p - s.pixel).length())
    }

    /// Median reprojection error of a view, pixels; 0 without observations.
    pub(super) fn median_error(&self, view: usize) -> f64 {
        let of_track = |t: &Track| {
            let s = t.elements.iter().find(|s| s.view == view)?;
            Some(self.reprojection_error(s, t.position?)).filter(|e| e.is_finite())
        };
        let mut all: Vec<f64> = self.tracks.iter().filter_map(of_track).collect();
        crate::math::median(&mut all).unwrap_or(0.0)
    }

    /// Triangulates the registered observations: least squares on ray distances, then Gauss–Newton
    /// on pixels. `None` where an error is not below `threshold` pixels, the point is behind a
    /// camera, or the rays are nearly parallel.
    pub(super) fn triangulate(&self, elements: &[TrackElement], threshold: f64) -> Option<DVec3> {
        let registered: Vec<(&TrackElement, Pose)> =
            elements.iter().filter_map(|s| Some((s, self.poses[s.view]?))).collect();
        if registered.len() < 2 {
            return None;
        }
        let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
        for (s, pose) in &registered {
            let d = (pose.rotation.transpose() * self.ray(s.view, s.pixel)).normalize();
            let p = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            a += p;
            b += p * pose.centre();
        }
        if a.determinant().abs() < 1e-12 {
            return None;
        }
        let mut x = a.inverse() * b;
        for _ in 0..5 {
            let (mut h, mut g) = (DMat3::ZERO, DVec3::ZERO);
            for (s, pose) in &registered {
                let t = pose.transform(x);
                if t.z <= 1e-9 {
                    return None;
                }
                let (f, lens) = (self.focal(s.view), self.lens(s.view));
                let at = DVec2::new(t.x, t.y) / t.z;
                let r = lens.distort(at) * f + self.principal_point(s.view) - s.pixel;
                let jacobian = lens.jacobian(at) * (f / t.z);
                let rows = [0, 1].map(|k| jacobian.row(k).extend(-jacobian.row(k).dot(at)));
                for (row, r) in rows.iter().zip([r.x, r.y]) {
                    let j = pose.rotation.transpose() * *row / s.sigma;
                    h += DMat3::from_cols(j * j.x, j * j.y, j * j.z);
                    g += j * (r / s.sigma);
                }
            }
            if h.determinant().abs() < 1e-300 {
                return None;
            }
            x -= h.inverse() * g;
        }
        let good = x.is_finite()
            && registered.iter().all(|(s, _)| self.reprojection_error(s, x) < threshold)
            && self.triangulation_angle(x, elements) >= MIN_ANGLE_DEGREES;
        good.then_some(x)
    }

    /// Largest angle between two rays of a point, degrees.
    pub(super) fn triangulation_angle(&self, x: DVec3, elements: &[TrackElement]) -> f64 {
        let rays: Vec<DVec3> =
            elements.iter().filter_map(|s| Some((x - self.poses[s.view]?.centre()).normalize())).collect();
        let mut best: f64 = 0.0;
        for i in 0..rays.len() {
            for j in 0..i {
                best = best.max(rays[i].angle_between(rays[j]));
            }
        }
        best.to_degrees()
    }

    /// Triangulates every track anew: from all observations, or, where these do not agree, from the
    /// pair with the largest support. Observations are kept; tracks that do not triangulate have no
    /// position.
    pub(super) fn triangulate_all(&mut self, threshold: f64) {
        let position = |t: &Track| {
            let all = self.triangulate(&t.elements, threshold);
            all.or_else(|| self.triangulate_best_pair(&t.elements, threshold))
        };
        let positions: Vec<Option<DVec3>> = self.tracks.par_iter().map(position).collect();
        for (t, p) in self.tracks.iter_mut().zip(positions) {
            t.position = p;
        }
    }

    /// Position from the pair of observations that most others agree with.
    fn triangulate_best_pair(&self, elements: &[TrackElement], threshold: f64) -> Option<DVec3> {
        let registered: Vec<&TrackElement> =
            elements.iter().filter(|s| self.poses[s.view].is_some()).collect();
        let pairs: Vec<(usize, usize)> =
            (0..registered.len()).flat_map(|i| (0..i).map(move |j| (j, i))).collect();
        let count = pairs.len().min(MAX_PAIRS);
        let mut best: Option<(usize, DVec3)> = None;
        for (j, i) in (0..count).map(|k| pairs[k * pairs.len() / count]) {
            let Some(x) = self.triangulate(&[*registered[j], *registered[i]], threshold) else { continue };
            let support = registered.iter().filter(|o| self.reprojection_error(o, x) < threshold).count();
            if best.is_none_or(|b| support > b.0) {
                best = Some((support, x));
            }
        }
        best.map(|b| b.1)
    }

    /// Adjustment problem of the registered views and triangulated points, over observations with
    /// errors below `gate` pixels; and the view and track indices of its poses and points.
    fn problem(&self, gate: f64, refined: RefinedIntrinsics) -> (Problem, Vec<usize>, Vec<usize>) {
        let views: Vec<usize> = (0..self.poses.len()).filter(|v| self.poses[*v].is_some()).collect();
        let mut local = vec![usize::MAX; self.poses.len()];
        let mut problem = Problem {
            intrinsics: self.intrinsics.iter().map(|o| refined.reset_others(o)).collect(),
            priors: self.priors.iter().map(|p| refined.hold_others(p)).collect(),
            ..Default::default()
        };
        for (k, &v) in views.iter().enumerate() {
            local[v] = k;
            problem.poses.extend(self.poses[v]);
            problem.centres.push(self.centres[v]);
            problem.camera_ids.push(self.camera_ids[v]);
            problem.zoom.push(self.zoom[v]);
        }
        let mut used = Vec::new();
        for (k, t) in self.tracks.iter().enumerate() {
            let Some(x) = t.position else { continue };
            let near: Vec<&TrackElement> =
                t.elements.iter().filter(|s| self.reprojection_error(s, x) < gate).collect();
            if near.len() < 2 {
                continue;
            }
            let point = problem.points.len();
            problem.points.push(x);
            used.push(k);
            problem.observations.extend(near.iter().map(|s| Observation {
                view: local[s.view],
                point,
                pixel: s.pixel,
                sigma: s.sigma,
            }));
        }
        // Priors are scaled to the effective number of observations ([`MAX_INDEPENDENT`]), and to
        // residuals that are below the least σ.
        let observations = 2 * problem.observations.len();
        let share = self.effective_observations(observations) / observations.max(1) as f64;
        let scale = (share / variance_factor(&problem)).sqrt();
        problem.priors.iter_mut().for_each(|p| p.scale_sigmas(scale));
        (problem, views, used)
    }

    /// Adjusts cameras and points over observations with errors below `gate` pixels; `c` is the
    /// Cauchy scale in standard deviations. The first registered view stays fixed.
    pub(super) fn adjust(&mut self, gate: f64, c: f64, steps: usize) -> Result<Adjusted> {
        let (mut problem, views, used) = self.problem(gate, self.refined);
        let outcome = problem.solve(c, steps)?;
        for (k, &v) in views.iter().enumerate() {
            self.poses[v] = Some(problem.poses[k]);
        }
        self.intrinsics = problem.intrinsics;
        for (k, x) in used.into_iter().zip(problem.points) {
            self.tracks[k].position = Some(x);
        }
        Ok(outcome)
    }

    /// Standard deviations of all intrinsics and of the rotations under displaced observations, by
    /// `by(long side)` pixels at the border of the photos.
    pub(super) fn displacement_sigmas(&self, by: impl Fn(f64) -> f64) -> Option<DisplacementSigmas> {
        let (problem, views, _) = self.problem(f64::INFINITY, RefinedIntrinsics::Full);
        let half_long: Vec<f64> = views.iter().map(|v| self.centres[*v].max_element()).collect();
        let displaced: Vec<f64> = half_long.iter().map(|h| by(2.0 * h)).collect();
        problem.displacement_sigmas(2.0, &half_long, &displaced)
    }

    /// Drops observations with errors from `gate` pixels, then points with fewer than two left or
    /// too small an angle.
    pub(super) fn prune(&mut self, gate: f64) {
        let mut tracks = std::mem::take(&mut self.tracks);
        tracks.retain_mut(|t| {
            let Some(x) = t.position else { return false };
            t.elements.retain(|s| self.reprojection_error(s, x) < gate);
            t.elements.len() >= 2 && self.triangulation_angle(x, &t.elements) >= MIN_ANGLE_DEGREES
        });
        self.tracks = tracks;
    }

    /// Estimates σ of the observations of each detector from their residuals.
    pub(super) fn estimate_sigma(&mut self) {
        let detectors =
            self.tracks.iter().flat_map(|t| &t.elements).map(|s| s.detector + 1).max().unwrap_or(0);
        for detector in 0..detectors {
            let mut squares = Vec::new();
            for t in &self.tracks {
                let Some(x) = t.position else { continue };
                // n observations leave 2n − 3 free residual components.
                let n = t.elements.len() as f64;
                let share = 2.0 * n / (2.0 * n - 3.0);
                let of_detector = t.elements.iter().filter(|s| s.detector == detector);
                squares.extend(
                    of_detector
                        .map(|s| self.reprojection_error(s, x).powi(2) * share)
                        .filter(|e| e.is_finite()),
                );
            }
            // The median of the squared length of a 2-D normal deviate is 2 ln 2 σ².
            let Some(middle) = crate::math::median(&mut squares) else { continue };
            // Below 0.05 px the lens, not the detector, limits; a smaller σ would only freeze the
            // solution.
            let sigma = (middle / (2.0 * std::f64::consts::LN_2)).sqrt().max(0.05);
            for s in self.tracks.iter_mut().flat_map(|t| &mut t.elements).filter(|s| s.detector == detector) {
                s.sigma = sigma;
            }
        }
    }

    /// Transforms the world so that the pose of view 0 is the identity and the median depth over
    /// the observations is 1.
    pub(super) fn normalise(&mut self) {
        let Some(first) = self.poses[0] else { return };
        let model = &*self;
        let mut depths: Vec<f64> = model
            .tracks
            .iter()
            .filter_map(|t| t.position.map(|x| (t, x)))
            .flat_map(|(t, x)| t.elements.iter().filter_map(move |s| model.project(s.view, x)))
            .map(|(_, z)| z)
            .collect();
        let Some(scale) = crate::math::median(&mut depths) else { return };
        let back = first.inverse();
        for pose in self.poses.iter_mut().flatten() {
            *pose = pose.compose(&back).orthonormalised();
            pose.translation /= scale;
        }
        self.poses[0] = Some(Pose::IDENTITY);
        for x in self.tracks.iter_mut().filter_map(|t| t.position.as_mut()) {
            *x = first.transform(*x) / scale;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn problem_scales_priors_to_effective_observations() {
        let prior =
            IntrinsicsPrior { log_focal: (6.0, 0.35), lens: [0.05, 0.02], principal_point_offset: 4.0 };
        let offset_sigma = |tracks: usize, views: usize, off: f64| {
            let pixel = DVec2::new(50.0 + off, 50.0);
            let element = |view| TrackElement { view, pixel, sigma: 1.0, detector: 0 };
            let track = Track { position: Some(DVec3::Z), elements: (0..views).map(element).collect() };
            let model = Model {
                poses: vec![Some(Pose::IDENTITY); views],
                centres: vec![DVec2::splat(50.0); views],
                camera_ids: vec![0; views],
                camera_ids_by_file: vec![0; views],
                camera_ids_by_exif: vec![0; views],
                zoom: vec![1.0; views],
                intrinsics: vec![Intrinsics {
                    focal: 100.0,
                    lens: Lens::NONE,
                    principal_point_offset: DVec2::ZERO,
                }],
                priors: vec![prior],
                refined: RefinedIntrinsics::Full,
                tracks: vec![track; tracks],
                seed: 0,
            };
            let problem = model.problem(f64::INFINITY, RefinedIntrinsics::Full).0;
            assert_eq!(problem.observations.len(), views * tracks);
            problem.priors[0].principal_point_offset
        };
        // Four residual components a track; of two photos 333 count.
        assert!((offset_sigma(80, 2, 0.0) - 4.0).abs() < 1e-12);
        let share = MAX_INDEPENDENT / PAIRS / 8000.0;
        assert!((offset_sigma(2000, 2, 0.0) - 4.0 * share.sqrt()).abs() < 1e-12);
        // Three photos count as three pairs. Without residuals: 12,000 components, 6000 coordinates
        // of points, 12 parameters of poses and 5 of the intrinsics.
        let share = 3.0 * MAX_INDEPENDENT / PAIRS / 12e3;
        assert!((offset_sigma(2000, 3, 2.0) - 4.0 * share.sqrt()).abs() < 1e-12);
        let variance = ASSUMED / (12e3 - 6e3 - 17.0 + ASSUMED);
        assert!((offset_sigma(2000, 3, 0.0) - 4.0 * (share / variance).sqrt()).abs() < 1e-9);
    }
}
