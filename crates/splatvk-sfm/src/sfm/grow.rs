//! From verified pairs to a reconstruction: the pair with most matches at good parallax first, the
//! other views by resection, an adjustment after each.
use super::model::{Model, Track};
use super::pair::Pair;
use super::tracks::Sightings;
use crate::resect::resect;
use crate::scene::Pose;
use glam::{DVec2, DVec3};

/// Why a reconstruction could not grow to all views.
pub(super) struct Stuck {
    /// Views without a camera.
    pub(super) left: Vec<usize>,
}

/// Fewest agreeing points for placing a view: six fix pose and focal length, twice that guards
/// against chance.
pub(super) const MIN_RESECTION: usize = 12;

/// Usefulness of a pair as the seed: matches, discounted below 10° of parallax.
pub(super) fn seed_score(pair: &Pair) -> f64 {
    pair.geometry.inliers.len() as f64 * (pair.geometry.parallax / 10.0).min(1.0)
}

/// Grows a model over all views. `empty` holds centres, groups, optics and priors; `threshold` in
/// pixels.
pub(super) fn grow(
    empty: &Model,
    tracks: &[Sightings],
    pairs: &[Pair],
    seed: &Pair,
    threshold: f64,
) -> Result<Model, Stuck> {
    let mut model = empty.clone();
    model.tracks = tracks.iter().map(|t| Track { position: None, sightings: t.clone() }).collect();
    model.poses[seed.matches.first] = Some(Pose::IDENTITY);
    model.poses[seed.matches.second] = Some(seed.geometry.pose);
    model.triangulate_all(2.0 * threshold);
    adjust_and_triangulate(&mut model, threshold);
    let views = model.poses.len();
    loop {
        let left: Vec<usize> = (0..views).filter(|v| model.poses[*v].is_none()).collect();
        if left.is_empty() {
            break;
        }
        let best = left
            .iter()
            .map(|&v| (resection(&model, v, threshold), v))
            .max_by_key(|(r, v)| (r.as_ref().map_or(0, |r| r.count), std::cmp::Reverse(*v)));
        match best {
            Some((Some(r), v)) if r.count >= MIN_RESECTION => {
                model.poses[v] = Some(r.pose);
                let group = model.group[v];
                model.optics[group].focal *= r.stretch;
            }
            _ => match by_pair(&model, pairs, &left, threshold) {
                Some((v, pose)) => model.poses[v] = Some(pose),
                None => return Err(Stuck { left }),
            },
        }
        model.triangulate_all(2.0 * threshold);
        adjust_and_triangulate(&mut model, threshold);
    }
    Ok(model)
}

/// Adjusts, triangulates again with the better cameras, adjusts.
fn adjust_and_triangulate(model: &mut Model, threshold: f64) {
    for gate in [4.0, 2.0] {
        // An adjustment that fails leaves the model as it is; too few points show up as a stuck
        // view.
        let _ = model.adjust(gate * threshold, 1.5, 25);
        model.triangulate_all(gate * threshold);
    }
}

/// Pose of a view from triangulated points that it shows.
pub(super) struct Resection {
    pub(super) pose: Pose,
    /// Focal length as a multiple of the one that the view came with.
    pub(super) stretch: f64,
    /// Points that agree.
    pub(super) count: usize,
}

/// Focal lengths tried for a view that shares its own with no placed view: resection bears half a
/// step of 1.4.
const STRETCHES: [f64; 5] = [1.0, 0.7, 1.4, 0.5, 2.0];

/// Pose of a view from its sightings of triangulated points.
pub(super) fn resection(model: &Model, view: usize, threshold: f64) -> Option<Resection> {
    let (mut world, mut pixels) = (Vec::<DVec3>::new(), Vec::<DVec2>::new());
    for t in &model.tracks {
        let Some(x) = t.position else { continue };
        if let Some(s) = t.sightings.iter().find(|s| s.view == view) {
            world.push(x);
            pixels.push(model.straight(view, s.pixel));
        }
    }
    let group = model.group[view];
    let known = (0..model.poses.len()).any(|v| model.group[v] == group && model.poses[v].is_some());
    let sigma = if known { 0.0 } else { model.priors[group].log_focal.1 };
    // A ratio of two focal lengths has √2 of the σ of one; two of it.
    let tried = STRETCHES.into_iter().filter(|s| s.ln().abs() <= 2.0 * 2f64.sqrt() * sigma);
    let place = |stretch: f64| {
        let r = resect(&world, &pixels, model.focal(view) * stretch, 2.0 * threshold, 500, model.seed)?;
        Some(Resection { pose: r.pose, stretch, count: r.inliers.len() })
    };
    tried.filter_map(place).max_by_key(|p| p.count)
}

/// Fallback for a view with few tracks into the model: the relative pose of its best pair with a
/// placed view, scaled by the depths of the points both see.
fn by_pair(model: &Model, pairs: &[Pair], left: &[usize], threshold: f64) -> Option<(usize, Pose)> {
    let mut best: Option<(usize, usize, Pose)> = None;
    for pair in pairs {
        let (first, second) = (pair.matches.first, pair.matches.second);
        let (placed, new, relative) = if left.contains(&second) && !left.contains(&first) {
            (first, second, pair.geometry.pose)
        } else if left.contains(&first) && !left.contains(&second) {
            (second, first, pair.geometry.pose.inverse())
        } else {
            continue;
        };
        let base = model.poses[placed]?;
        // Candidate scales: each common point proposes one, and the one most others agree with
        // wins.
        let common: Vec<(DVec3, DVec2)> = model
            .tracks
            .iter()
            .filter_map(|t| Some((t.position?, t.sightings.iter().find(|s| s.view == new)?.pixel)))
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
