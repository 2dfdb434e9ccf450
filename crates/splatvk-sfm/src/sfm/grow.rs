//! Incremental reconstruction from verified pairs: the pair with most inliers at good parallax
//! first, the other views by resection, an adjustment after each.
use super::model::{Model, Track};
use super::pair::Pair;
use super::tracks::TrackElements;
use crate::resect::resect;
use crate::scene::Pose;
use glam::{DVec2, DVec3};

/// A reconstruction that could not register all views.
pub(super) struct Stuck {
    pub(super) unregistered: Vec<usize>,
}

/// Fewest inliers for registering a view: six points determine pose and focal length, twice that
/// guards against chance.
pub(super) const MIN_RESECTION: usize = 12;

/// Score of a pair as the seed: inliers, discounted below 10° of parallax.
pub(super) fn seed_score(pair: &Pair) -> f64 {
    pair.geometry.inliers.len() as f64 * (pair.geometry.parallax / 10.0).min(1.0)
}

/// Of a model with n adjusted views, n over this number of further ones are registered without an
/// adjustment: none of a few photos, and the errors of few views do not add up.
const ADJUSTED_SHARE: usize = 8;

/// Registers all views, starting from the pair `seed`. `empty` holds centres, camera ids,
/// intrinsics and priors; `threshold` in pixels.
pub(super) fn grow(
    empty: &Model,
    tracks: &[TrackElements],
    pairs: &[Pair],
    seed: &Pair,
    threshold: f64,
) -> Result<Model, Stuck> {
    let mut model = empty.clone();
    model.tracks = tracks.iter().map(|t| Track { position: None, elements: t.clone() }).collect();
    model.poses[seed.matches.first] = Some(Pose::IDENTITY);
    model.poses[seed.matches.second] = Some(seed.geometry.pose);
    model.triangulate_all(2.0 * threshold);
    adjust_and_triangulate(&mut model, threshold);
    let views = model.poses.len();
    let mut adjusted = 2;
    loop {
        let unregistered: Vec<usize> = (0..views).filter(|v| model.poses[*v].is_none()).collect();
        if unregistered.is_empty() {
            break;
        }
        let best = unregistered
            .iter()
            .map(|&v| (resection(&model, v, threshold), v))
            .max_by_key(|(r, v)| (r.as_ref().map_or(0, |r| r.count), std::cmp::Reverse(*v)));
        match best {
            Some((Some(r), v)) if r.count >= MIN_RESECTION => {
                model.poses[v] = Some(r.pose);
                let camera = model.camera_ids[v];
                model.intrinsics[camera].focal *= r.stretch;
            }
            _ => match pose_from_pair(&model, pairs, &unregistered, threshold) {
                Some((v, pose)) => model.poses[v] = Some(pose),
                None => return Err(Stuck { unregistered }),
            },
        }
        model.triangulate_all(2.0 * threshold);
        let registered = views + 1 - unregistered.len();
        if registered == views || registered > adjusted + adjusted / ADJUSTED_SHARE {
            adjust_and_triangulate(&mut model, threshold);
            adjusted = registered;
        }
    }
    Ok(model)
}

/// Adjusts and triangulates twice, the second time with a tighter gate.
fn adjust_and_triangulate(model: &mut Model, threshold: f64) {
    for gate in [4.0, 2.0] {
        // A failed adjustment leaves the model unchanged; too few points then show as an
        // unregistered view.
        let _ = model.adjust(gate * threshold, 1.5, 25);
        model.triangulate_all(gate * threshold);
    }
}

/// Pose of a view from triangulated points.
pub(super) struct Resection {
    pub(super) pose: Pose,
    /// Focal length as a multiple of that in the model.
    pub(super) stretch: f64,
    /// Number of inliers.
    pub(super) count: usize,
}

/// Focal lengths tried for a view whose camera no registered view shares, as multiples of that in
/// the model: resection tolerates half a step of 1.4.
const STRETCHES: [f64; 5] = [1.0, 0.7, 1.4, 0.5, 2.0];

/// Registers a view from its observations of triangulated points.
pub(super) fn resection(model: &Model, view: usize, threshold: f64) -> Option<Resection> {
    let (mut world, mut pixels) = (Vec::<DVec3>::new(), Vec::<DVec2>::new());
    for t in &model.tracks {
        let Some(x) = t.position else { continue };
        if let Some(s) = t.elements.iter().find(|s| s.view == view) {
            world.push(x);
            pixels.push(model.undistorted(view, s.pixel));
        }
    }
    let camera = model.camera_ids[view];
    let known = (0..model.poses.len()).any(|v| model.camera_ids[v] == camera && model.poses[v].is_some());
    let sigma = if known { 0.0 } else { model.priors[camera].log_focal.1 };
    // A ratio of two focal lengths has √2 of the σ of one; ratios up to two σ are tried.
    let tried = STRETCHES.into_iter().filter(|s| s.ln().abs() <= 2.0 * 2f64.sqrt() * sigma);
    let resect_with = |stretch: f64| {
        let r = resect(&world, &pixels, model.focal(view) * stretch, 2.0 * threshold, 500, model.seed)?;
        Some(Resection { pose: r.pose, stretch, count: r.inliers.len() })
    };
    tried.filter_map(resect_with).max_by_key(|p| p.count)
}

/// Fallback for a view with few observations of triangulated points: the relative pose of its best
/// pair with a registered view, scaled by the depths of common points.
fn pose_from_pair(
    model: &Model,
    pairs: &[Pair],
    unregistered: &[usize],
    threshold: f64,
) -> Option<(usize, Pose)> {
    let mut best: Option<(usize, usize, Pose)> = None;
    for pair in pairs {
        let (first, second) = (pair.matches.first, pair.matches.second);
        let (registered, new, relative) = if unregistered.contains(&second) && !unregistered.contains(&first)
        {
            (first, second, pair.geometry.pose)
        } else if unregistered.contains(&first) && !unregistered.contains(&second) {
            (second, first, pair.geometry.pose.inverse())
        } else {
            continue;
        };
        let base = model.poses[registered]?;
        // Each common point yields a candidate scale; the one that most others agree with wins.
        let common: Vec<(DVec3, DVec2)> = model
            .tracks
            .iter()
            .filter_map(|t| Some((t.position?, t.elements.iter().find(|s| s.view == new)?.pixel)))
            .collect();
        let unit = relative.translation.normalize();
        for (x, pixel) in &common {
            let p = relative.rotation * base.transform(*x);
            let r = model.ray(new, *pixel);
            // p + s·unit ∥ r, least squares over s.
            let (a, b) = (unit.cross(r), -p.cross(r));
            let scale = a.dot(b) / a.length_squared().max(1e-12);
            if scale <= 0.0 {
                continue;
            }
            let pose = Pose { rotation: relative.rotation, translation: unit * scale }.compose(&base);
            let mut trial = model.clone();
            trial.poses[new] = Some(pose);
            let support = common
                .iter()
                .filter(|(x, p)| {
                    trial.project(new, *x).is_some_and(|(q, _)| (q - *p).length() < 2.0 * threshold)
                })
                .count();
            if support >= 5 && best.as_ref().is_none_or(|b| support > b.0) {
                best = Some((support, new, pose));
            }
        }
    }
    best.map(|(_, v, p)| (v, p))
}
