//! The growing reconstruction: cameras, points and their sightings.
use crate::Result;
use crate::bundle::{Adjusted, Bent, Observation, Optics, OpticsPrior, Problem};
use crate::scene::{Lens, Pose};
use glam::{DMat3, DVec2, DVec3};

/// Most independent observations that the sightings of a set count as. Neighbours err alike: what
/// shifts one (a bent surface taken for flat, JPEG, a moved shadow) shifts those around it, so that
/// thousands of sightings more say little more of the optics. On the tuning sets a principal point
/// or lens that is not there lowers the cost by up to 0.3 %, one that moves pixels by 5 by 1.3 %
/// and more; with 2000 the criterion asks for 0.8 %. The same number makes the stated σ of the
/// focal length as large as its errors there.
const MAX_INDEPENDENT: f64 = 2000.0;
/// Pairs of photos that [`MAX_INDEPENDENT`] was found with. Each pair has its own share of it,
/// since what its sightings have in common does not repeat in another: two photos alone say little
/// of their optics.
const PAIRS: f64 = 6.0;

/// Degrees of freedom in which residuals are assumed to have their σ, so that few sightings, which
/// a model fits too well, do not state a smaller one.
const ASSUMED: f64 = 20.0;

/// Variance of the residuals where it is below what their σ states. Of two photos every point
/// leaves one component, and errors along the epipolar lines leave none: their residuals are small
/// whatever the errors.
fn variance(problem: &Problem) -> f64 {
    if problem.poses.len() < 3 {
        return 1.0;
    }
    let (sum, freedom) = problem.squares(2.0);
    ((sum + ASSUMED) / (freedom.max(0.0) + ASSUMED)).min(1.0)
}

/// σ of the principal point from the middle, as a share of the long side: stabilised sensors move
/// by up to a hundredth.
pub(super) const SHIFT_SIGMA: f64 = 0.007;

/// One sighting of a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Sighting {
    pub(super) view: usize,
    pub(super) pixel: DVec2,
    /// One standard deviation, pixels.
    pub(super) sigma: f64,
    /// Which detector measured it: each has its own noise.
    pub(super) family: usize,
}

/// A point; without a position it is not (yet) triangulated.
#[derive(Clone, Debug)]
pub(super) struct Track {
    pub(super) position: Option<DVec3>,
    pub(super) sightings: Vec<Sighting>,
}

/// What of the optics an adjustment may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Freedom {
    /// The focal length.
    Focal,
    /// Focal length and radial distortion.
    Radial,
    /// Focal length and principal point.
    Centre,
    /// All of it.
    Full,
}

impl Freedom {
    pub(super) const ALL: [Freedom; 4] = [Freedom::Focal, Freedom::Radial, Freedom::Centre, Freedom::Full];

    /// The prior with everything else held.
    fn of(self, prior: &OpticsPrior) -> OpticsPrior {
        let (radial, centre) = (
            matches!(self, Freedom::Radial | Freedom::Full),
            matches!(self, Freedom::Centre | Freedom::Full),
        );
        OpticsPrior {
            lens: if radial { prior.lens } else { [0.0; 2] },
            shift: if centre { prior.shift } else { 0.0 },
            ..*prior
        }
    }

    /// The optics with everything that is not free at its prior.
    fn reset(self, optics: &Optics) -> Optics {
        let prior = self.of(&OpticsPrior { log_focal: (0.0, 1.0), lens: [1.0; 2], shift: 1.0 });
        Optics {
            lens: if prior.lens[0] > 0.0 { optics.lens } else { Lens::NONE },
            shift: if prior.shift > 0.0 { optics.shift } else { DVec2::ZERO },
            ..*optics
        }
    }
}

/// Cameras by view (`None` = not registered) and tracks.
#[derive(Clone, Debug)]
pub(super) struct Model {
    pub(super) poses: Vec<Option<Pose>>,
    /// Middle of each photo, pixels.
    pub(super) centres: Vec<DVec2>,
    /// Optics of each view.
    pub(super) group: Vec<usize>,
    /// The same if all photos that look alike by their files share a camera.
    pub(super) alike: Vec<usize>,
    /// The same, numbered in any way, if only photos share one whose files name camera and zoom.
    pub(super) separable: Vec<usize>,
    /// Pixels of the view per original pixel.
    pub(super) zoom: Vec<f64>,
    /// Per group.
    pub(super) optics: Vec<Optics>,
    /// Per group.
    pub(super) priors: Vec<OpticsPrior>,
    /// What adjustments change; nothing where the prior's σ is 0.
    pub(super) freedom: Freedom,
    pub(super) tracks: Vec<Track>,
    /// Of the samples that are drawn.
    pub(super) seed: u64,
}

/// Least angle between two rays of a usable point: below it the depth is mostly noise.
pub(super) const MIN_ANGLE_DEGREES: f64 = 1.0;

impl Model {
    pub(super) fn focal(&self, view: usize) -> f64 {
        self.optics[self.group[view]].focal * self.zoom[view]
    }

    pub(super) fn lens(&self, view: usize) -> Lens {
        self.optics[self.group[view]].lens
    }

    /// Principal point, pixels.
    pub(super) fn principal_point(&self, view: usize) -> DVec2 {
        self.centres[view] + self.optics[self.group[view]].shift * self.zoom[view]
    }

    /// Long side of a view's photo, original pixels.
    pub(super) fn long_side(&self, view: usize) -> f64 {
        2.0 * self.centres[view].max_element() / self.zoom[view]
    }

    /// Whether the principal point of any photo may be farther off its middle than a camera puts
    /// it.
    pub(super) fn has_crops(&self) -> bool {
        (0..self.group.len())
            .any(|v| self.priors[self.group[v]].shift > 2.0 * SHIFT_SIGMA * self.long_side(v))
    }

    /// Parameters of the optics that adjustments change.
    pub(super) fn parameters(&self) -> usize {
        self.priors.iter().map(|p| self.freedom.of(p).count()).sum()
    }

    /// Independent observations that so many residual components of the placed photos count as.
    pub(super) fn independent(&self, observations: usize) -> f64 {
        let views = self.poses.iter().flatten().count() as f64;
        let pairs = (0.5 * views * (views - 1.0)).clamp(1.0, PAIRS);
        (MAX_INDEPENDENT * pairs / PAIRS).min(observations as f64)
    }

    /// Residual components of the sightings.
    pub(super) fn observations(&self) -> usize {
        self.tracks.iter().map(|t| 2 * t.sightings.len()).sum()
    }

    /// The same model with other photos sharing optics, each group with those of its first view.
    /// `group` numbers them in any way; views of one group must have the same prior.
    pub(super) fn regrouped(&self, group: &[usize]) -> Model {
        let mut out = Model { group: Vec::new(), optics: Vec::new(), priors: Vec::new(), ..self.clone() };
        let mut names = Vec::new();
        for (view, name) in group.iter().enumerate() {
            let known = names.iter().position(|n| n == name);
            out.group.push(known.unwrap_or(names.len()));
            if known.is_none() {
                names.push(*name);
                out.optics.push(self.optics[self.group[view]]);
                out.priors.push(self.priors[self.group[view]]);
            }
        }
        out
    }

    /// The same model with optics of its own for every view that may have some; `None` where all
    /// that look alike must share.
    pub(super) fn with_separate_optics(&self) -> Option<Model> {
        let separate = self.regrouped(&self.separable);
        (separate.group != self.alike).then_some(separate)
    }

    /// The same model on images of another size: `ratios` per view.
    pub(super) fn magnify(&mut self, ratios: &[f64]) {
        for (v, r) in ratios.iter().enumerate() {
            self.centres[v] *= *r;
            self.zoom[v] *= *r;
        }
        for s in self.tracks.iter_mut().flat_map(|t| &mut t.sightings) {
            s.pixel *= ratios[s.view];
            s.sigma *= ratios[s.view];
        }
    }

    /// The model without its tracks.
    pub(super) fn clone_optics(&self) -> Model {
        Model {
            poses: self.poses.clone(),
            centres: self.centres.clone(),
            group: self.group.clone(),
            alike: self.alike.clone(),
            separable: self.separable.clone(),
            zoom: self.zoom.clone(),
            optics: self.optics.clone(),
            priors: self.priors.clone(),
            freedom: self.freedom,
            tracks: Vec::new(),
            seed: self.seed,
        }
    }

    /// Camera-frame ray, z = 1.
    pub(super) fn ray(&self, view: usize, pixel: DVec2) -> DVec3 {
        self.lens(view).undistort((pixel - self.principal_point(view)) / self.focal(view)).extend(1.0)
    }

    /// Where a pinhole of the same focal length around the principal point would show the pixel,
    /// relative to that point.
    pub(super) fn straight(&self, view: usize, pixel: DVec2) -> DVec2 {
        self.ray(view, pixel).truncate() * self.focal(view)
    }

    /// Pixel and depth of a world point in a registered view.
    pub(super) fn project(&self, view: usize, world: DVec3) -> Option<(DVec2, f64)> {
        let t = self.poses[view]?.transform(world);
        let seen = || self.lens(view).distort(DVec2::new(t.x, t.y) / t.z);
        (t.z > 1e-9).then(|| (seen() * self.focal(view) + self.principal_point(view), t.z))
    }

    /// Reprojection distance in pixels; infinite when it cannot be seen.
    pub(super) fn error(&self, s: &Sighting, world: DVec3) -> f64 {
        self.project(s.view, world).map_or(f64::INFINITY, |(p, _)| (p - s.pixel).length())
    }

    /// Median reprojection distance of a view's sightings, pixels; 0 without any.
    pub(super) fn residual(&self, view: usize) -> f64 {
        let of_track = |t: &Track| {
            let s = t.sightings.iter().find(|s| s.view == view)?;
            Some(self.error(s, t.position?)).filter(|e| e.is_finite())
        };
        let mut all: Vec<f64> = self.tracks.iter().filter_map(of_track).collect();
        crate::math::median(&mut all).unwrap_or(0.0)
    }

    /// Position from the registered sightings: least squares on ray distances, then Gauss–Newton on
    /// pixels. `None` when the rays do not meet within `threshold` pixels in front of every camera,
    /// or are nearly parallel.
    pub(super) fn triangulate(&self, sightings: &[Sighting], threshold: f64) -> Option<DVec3> {
        let seen: Vec<(&Sighting, Pose)> =
            sightings.iter().filter_map(|s| Some((s, self.poses[s.view]?))).collect();
        if seen.len() < 2 {
            return None;
        }
        let (mut a, mut b) = (DMat3::ZERO, DVec3::ZERO);
        for (s, pose) in &seen {
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
            for (s, pose) in &seen {
                let t = pose.transform(x);
                if t.z <= 1e-9 {
                    return None;
                }
                let (f, lens) = (self.focal(s.view), self.lens(s.view));
                let at = DVec2::new(t.x, t.y) / t.z;
                let r = lens.distort(at) * f + self.principal_point(s.view) - s.pixel;
                let bend = lens.jacobian(at) * (f / t.z);
                let rows = [0, 1].map(|k| bend.row(k).extend(-bend.row(k).dot(at)));
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
            && seen.iter().all(|(s, _)| self.error(s, x) < threshold)
            && self.angle(x, sightings) >= MIN_ANGLE_DEGREES;
        good.then_some(x)
    }

    /// Largest angle between two rays of a point, degrees.
    pub(super) fn angle(&self, x: DVec3, sightings: &[Sighting]) -> f64 {
        let rays: Vec<DVec3> =
            sightings.iter().filter_map(|s| Some((x - self.poses[s.view]?.centre()).normalize())).collect();
        let mut best: f64 = 0.0;
        for i in 0..rays.len() {
            for j in 0..i {
                best = best.max(rays[i].angle_between(rays[j]));
            }
        }
        best.to_degrees()
    }

    /// Triangulates every track anew; outlying sightings are dropped when the rest agrees. Tracks
    /// that do not triangulate keep their sightings and have no position.
    pub(super) fn triangulate_all(&mut self, threshold: f64) {
        let positions: Vec<Option<DVec3>> = self
            .tracks
            .iter()
            .map(|t| {
                if let Some(x) = self.triangulate(&t.sightings, threshold) {
                    return Some(x);
                }
                // Any two sightings that agree with most others.
                let s = &t.sightings;
                let mut best: Option<(usize, DVec3)> = None;
                for i in 0..s.len() {
                    for j in 0..i {
                        let Some(x) = self.triangulate(&[s[j], s[i]], threshold) else { continue };
                        let support = s.iter().filter(|o| self.error(o, x) < threshold).count();
                        if best.is_none_or(|b| support > b.0) {
                            best = Some((support, x));
                        }
                    }
                }
                best.map(|b| b.1)
            })
            .collect();
        for (t, p) in self.tracks.iter_mut().zip(positions) {
            t.position = p;
        }
    }

    /// The registered views and triangulated points as an adjustment problem, over the sightings
    /// within `gate` pixels; and which views and tracks stand behind its cameras and points.
    fn problem(&self, gate: f64, freedom: Freedom) -> (Problem, Vec<usize>, Vec<usize>) {
        let views: Vec<usize> = (0..self.poses.len()).filter(|v| self.poses[*v].is_some()).collect();
        let mut local = vec![usize::MAX; self.poses.len()];
        let mut problem = Problem {
            optics: self.optics.iter().map(|o| freedom.reset(o)).collect(),
            priors: self.priors.iter().map(|p| freedom.of(p)).collect(),
            ..Default::default()
        };
        for (k, &v) in views.iter().enumerate() {
            local[v] = k;
            problem.poses.extend(self.poses[v]);
            problem.centres.push(self.centres[v]);
            problem.group.push(self.group[v]);
            problem.zoom.push(self.zoom[v]);
        }
        let mut used = Vec::new();
        for (k, t) in self.tracks.iter().enumerate() {
            let Some(x) = t.position else { continue };
            let near: Vec<&Sighting> = t.sightings.iter().filter(|s| self.error(s, x) < gate).collect();
            if near.len() < 2 {
                continue;
            }
            let point = problem.points.len();
            problem.points.push(x);
            used.push(k);
            problem.observations.extend(near.iter().map(|s| Observation {
                camera: local[s.view],
                point,
                pixel: s.pixel,
                sigma: s.sigma,
            }));
        }
        // The sightings count as fewer independent ones ([`MAX_INDEPENDENT`]); priors are weighed
        // against those, by the residuals where these are below the least σ.
        let observations = 2 * problem.observations.len();
        let share = self.independent(observations) / observations.max(1) as f64;
        let scale = (share / variance(&problem)).sqrt();
        problem.priors.iter_mut().for_each(|p| p.narrow(scale));
        (problem, views, used)
    }

    /// Adjusts cameras and points over the sightings within `gate` pixels; `c` is the Cauchy scale
    /// in standard deviations. The first registered view stays where it is.
    pub(super) fn adjust(&mut self, gate: f64, c: f64, steps: usize) -> Result<Adjusted> {
        let (mut problem, views, used) = self.problem(gate, self.freedom);
        let outcome = problem.solve(c, steps)?;
        for (k, &v) in views.iter().enumerate() {
            self.poses[v] = Some(problem.poses[k]);
        }
        self.optics = problem.optics;
        for (k, x) in used.into_iter().zip(problem.points) {
            self.tracks[k].position = Some(x);
        }
        Ok(outcome)
    }

    /// Changes of the parameters by displaced sightings, `by(long side)` pixels at the border of
    /// the photos, of all optics and the rotations.
    pub(super) fn bent(&self, by: impl Fn(f64) -> f64) -> Option<Bent> {
        let (problem, views, _) = self.problem(f64::INFINITY, Freedom::Full);
        let half_long: Vec<f64> = views.iter().map(|v| self.centres[*v].max_element()).collect();
        let displaced: Vec<f64> = half_long.iter().map(|h| by(2.0 * h)).collect();
        problem.bent(2.0, &half_long, &displaced)
    }

    /// Drops sightings farther than `gate` from their point, then points with fewer than two left
    /// or too little parallax.
    pub(super) fn prune(&mut self, gate: f64) {
        let mut tracks = std::mem::take(&mut self.tracks);
        tracks.retain_mut(|t| {
            let Some(x) = t.position else { return false };
            t.sightings.retain(|s| self.error(s, x) < gate);
            t.sightings.len() >= 2 && self.angle(x, &t.sightings) >= MIN_ANGLE_DEGREES
        });
        self.tracks = tracks;
    }

    /// Sets σ of every sighting from the residuals of its detector family.
    pub(super) fn weigh(&mut self) {
        let families = self.tracks.iter().flat_map(|t| &t.sightings).map(|s| s.family + 1).max().unwrap_or(0);
        for family in 0..families {
            let mut squares = Vec::new();
            for t in &self.tracks {
                let Some(x) = t.position else { continue };
                // n sightings leave 2n − 3 free residual components.
                let n = t.sightings.len() as f64;
                let share = 2.0 * n / (2.0 * n - 3.0);
                let of_family = t.sightings.iter().filter(|s| s.family == family);
                squares.extend(of_family.map(|s| self.error(s, x).powi(2) * share).filter(|e| e.is_finite()));
            }
            // The median of the squared length of a 2-D normal deviate is 2 ln 2 σ².
            let Some(middle) = crate::math::median(&mut squares) else { continue };
            // Below 0.05 px the lens, not the detector, limits; a smaller σ would only freeze the
            // solution.
            let sigma = (middle / (2.0 * std::f64::consts::LN_2)).sqrt().max(0.05);
            for s in self.tracks.iter_mut().flat_map(|t| &mut t.sightings).filter(|s| s.family == family) {
                s.sigma = sigma;
            }
        }
    }

    /// Moves the world so that view 0 is the identity and the median depth of the points over their
    /// sightings is 1.
    pub(super) fn normalise(&mut self) {
        let Some(first) = self.poses[0] else { return };
        let model = &*self;
        let mut depths: Vec<f64> = model
            .tracks
            .iter()
            .filter_map(|t| t.position.map(|x| (t, x)))
            .flat_map(|(t, x)| t.sightings.iter().filter_map(move |s| model.project(s.view, x)))
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
    fn priors_are_weighed_against_what_the_sightings_are_worth() {
        let prior = OpticsPrior { log_focal: (6.0, 0.35), lens: [0.05, 0.02], shift: 4.0 };
        let shift = |tracks: usize, views: usize, off: f64| {
            let pixel = DVec2::new(50.0 + off, 50.0);
            let sighting = |view| Sighting { view, pixel, sigma: 1.0, family: 0 };
            let track = Track { position: Some(DVec3::Z), sightings: (0..views).map(sighting).collect() };
            let model = Model {
                poses: vec![Some(Pose::IDENTITY); views],
                centres: vec![DVec2::splat(50.0); views],
                group: vec![0; views],
                alike: vec![0; views],
                separable: vec![0; views],
                zoom: vec![1.0; views],
                optics: vec![Optics { focal: 100.0, lens: Lens::NONE, shift: DVec2::ZERO }],
                priors: vec![prior],
                freedom: Freedom::Full,
                tracks: vec![track; tracks],
                seed: 0,
            };
            let problem = model.problem(f64::INFINITY, Freedom::Full).0;
            assert_eq!(problem.observations.len(), views * tracks);
            problem.priors[0].shift
        };
        // Four residual components a track; of two photos 333 count.
        assert!((shift(80, 2, 0.0) - 4.0).abs() < 1e-12);
        let share = MAX_INDEPENDENT / PAIRS / 8000.0;
        assert!((shift(2000, 2, 0.0) - 4.0 * share.sqrt()).abs() < 1e-12);
        // Three photos count as three pairs. Without residuals: 12,000 components, 6000 coordinates
        // of points, 12 parameters of poses and 5 of the optics.
        let share = 3.0 * MAX_INDEPENDENT / PAIRS / 12e3;
        assert!((shift(2000, 3, 2.0) - 4.0 * share.sqrt()).abs() < 1e-12);
        let variance = ASSUMED / (12e3 - 6e3 - 17.0 + ASSUMED);
        assert!((shift(2000, 3, 0.0) - 4.0 * (share / variance).sqrt()).abs() < 1e-9);
    }
}
