//! Sub-pixel refinement of all observations, and further points predicted from the geometry.
use super::model::{Model, Track, TrackElement};
use super::patch::{Aligner, Facet, LumaGradients, RADIUS};
use super::scan::Scan;
use crate::scene::Image;
use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;

/// Detector index of photometrically aligned observations, after those of the detectors.
pub(super) const REFINED: usize = 2;
/// Detector index of observations aligned on images with more pixels.
pub(super) const FINE: usize = 3;
/// Least correlation of an aligned patch; views 75° apart reach 0.8 on a true match.
const MIN_NCC: f64 = 0.8;
/// Largest distance of a refined observation from its keypoint, pixels: about three times the
/// detectors' noise.
const MAX_MOVE: f64 = 3.0;
/// Largest forward–backward error, pixels.
const MAX_MISS: f64 = 0.3;
/// Neighbours that predict the local plane.
const NEIGHBOURS: usize = 8;

/// Points that a view observes: (pixel, inverse depth).
struct ViewPoints {
    points: Vec<(DVec2, f64)>,
}

impl ViewPoints {
    fn new(model: &Model, view: usize) -> ViewPoints {
        let points = model
            .tracks
            .iter()
            .filter_map(|t| {
                let s = t.elements.iter().find(|s| s.view == view)?;
                let (_, z) = model.project(view, t.position?)?;
                Some((s.pixel, 1.0 / z))
            })
            .collect();
        ViewPoints { points }
    }

    /// Local plane at a pixel from the nearest points, as inverse depth and relative slant; `None`
    /// with few neighbours within `reach` pixels. Robust: two rounds of re-weighting at 2 % of the
    /// depth.
    fn plane(&self, p: DVec2, reach: f64) -> Option<(f64, DVec2)> {
        let mut near: Vec<(f64, DVec2, f64)> =
            self.points.iter().map(|q| ((q.0 - p).length(), q.0 - p, q.1)).filter(|q| q.0 < reach).collect();
        if near.len() < 3 {
            return None;
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.2.total_cmp(&b.2)));
        near.truncate(NEIGHBOURS);
        let mut middle: Vec<f64> = near.iter().map(|n| n.2).collect();
        let scale = crate::math::median(&mut middle)?;
        let mut x = DVec3::new(scale, 0.0, 0.0);
        for _ in 0..3 {
            let (mut h, mut g) = (DMat3::ZERO, DVec3::ZERO);
            for (r, d, rho) in &near {
                let j = DVec3::new(1.0, d.x, d.y);
                let e = (rho - x.dot(j)) / (0.02 * scale);
                let w = 1.0 / (1.0 + e * e) / (1.0 + r / 10.0);
                h += DMat3::from_cols(j * j.x, j * j.y, j * j.z) * w;
                g += j * (w * rho);
            }
            // Ridge on the slant: collinear neighbours leave one direction open.
            h.y_axis.y += 4.0;
            h.z_axis.z += 4.0;
            x = h.inverse() * g;
        }
        (x.is_finite() && x.x > 0.2 * scale && x.x < 5.0 * scale)
            .then(|| (x.x, (DVec2::new(x.y, x.z) / x.x).clamp_length_max(0.01)))
    }
}

/// Index of the observation of the most central view: least total angle to the other views.
fn most_central(model: &Model, track: &Track, x: DVec3) -> usize {
    let ray = |v: usize| model.poses[v].map(|p| (x - p.centre()).normalize());
    let mut best = (f64::INFINITY, 0);
    for (k, s) in track.elements.iter().enumerate() {
        let Some(r) = ray(s.view) else { continue };
        let sum: f64 = track.elements.iter().filter_map(|o| ray(o.view)).map(|o| o.angle_between(r)).sum();
        if sum < best.0 {
            best = (sum, k);
        }
    }
    best.1
}

/// Aligns every observation with the patch of its track's most central view. Observations that do
/// not align keep position and detector; aligned ones get `detector`, so that their noise is
/// estimated separately. `reach`: distance up to which neighbours predict the local plane of a
/// point, pixels.
pub(super) fn refine(model: &mut Model, images: &[LumaGradients], detector: usize, reach: f64) {
    let fixed = &*model;
    let points: Vec<ViewPoints> =
        (0..fixed.poses.len()).into_par_iter().map(|v| ViewPoints::new(fixed, v)).collect();
    let aligner = Aligner::new(fixed, images);
    let moved: Vec<Option<Vec<TrackElement>>> =
        fixed.tracks.par_iter().map(|t| refine_track(&aligner, &points, t, detector, reach)).collect();
    for (t, m) in model.tracks.iter_mut().zip(moved) {
        if let Some(m) = m {
            t.elements = m;
        }
    }
}

fn refine_track(
    aligner: &Aligner,
    points: &[ViewPoints],
    track: &Track,
    detector: usize,
    reach: f64,
) -> Option<Vec<TrackElement>> {
    let (model, x) = (aligner.model, track.position?);
    let reference = most_central(model, track, x);
    let base = track.elements[reference];
    let z = model.project(base.view, x)?.1;
    let others: Vec<&TrackElement> = track.elements.iter().filter(|s| s.view != base.view).collect();
    let start = |f: &Facet| -> Vec<(usize, DVec2)> {
        others.iter().filter_map(|s| Some((s.view, s.pixel - aligner.project_centre(f, s.view)?))).collect()
    };
    let flat = Facet { view: base.view, pixel: base.pixel, inverse_depth: 1.0 / z, slant: DVec2::ZERO };
    let leaning = points[base.view].plane(base.pixel, reach).map(|p| Facet { slant: p.1, ..flat });
    let template = aligner.template(&flat)?;
    let score = |f: &Facet| -> f64 {
        start(f).iter().filter_map(|(v, s)| aligner.ncc(&template, f, *v, *s)).map(|n| n.max(0.0)).sum()
    };
    let facet = match leaning {
        Some(l) if score(&l) > score(&flat) => l,
        _ => flat,
    };
    let (facet, aligned) = aligner.align(&facet, &start(&facet), MIN_NCC)?;
    let mut out = track.elements.clone();
    let mut count = 0;
    for a in aligned {
        let Some(s) = out.iter_mut().find(|s| s.view == a.view) else { continue };
        let good = (s.pixel - a.pixel).length() < MAX_MOVE
            && aligner.round_trip(&facet, a.view, a.pixel).is_some_and(|m| m < MAX_MISS);
        if good {
            *s = TrackElement { pixel: a.pixel, detector, ..*s };
            count += 1;
        }
    }
    if count == 0 {
        return None;
    }
    // The reference patch defines the point, so its own position is exact.
    out[reference].detector = detector;
    Some(out)
}

/// Pitch of the grid on which further corners are picked, pixels.
const CELL: usize = 10;
/// Largest relative change of the predicted inverse depth that is tried.
const SEARCH: f64 = 0.06;
/// Least correlation of a predicted point, which no detector confirms.
const MIN_GUIDED_NCC: f64 = 0.88;

/// Adds points at corners without one: depth predicted from the neighbours, searched along the
/// epipolar lines, aligned photometrically in all views that show it. Returns their number.
pub(super) fn extend(model: &mut Model, images: &[LumaGradients], valid: &[Image<bool>]) -> usize {
    let fixed = &*model;
    let aligner = Aligner::new(fixed, images);
    let of_view = |view: usize| -> Vec<Track> {
        let points = ViewPoints::new(fixed, view);
        let corners = free_corners(&images[view], &valid[view], &points);
        corners.par_iter().filter_map(|p| predict_track(&aligner, &points, valid, view, *p)).collect()
    };
    let all: Vec<Track> = (0..fixed.poses.len()).into_par_iter().flat_map(of_view).collect();
    let count = all.len();
    model.tracks.extend(all);
    count
}

/// The strongest corner of each grid cell that is not near a known point.
fn free_corners(image: &LumaGradients, valid: &Image<bool>, points: &ViewPoints) -> Vec<DVec2> {
    let (w, h) = image.size();
    let margin = RADIUS as usize + 4;
    let (columns, rows) = (w / CELL + 1, h / CELL + 1);
    let mut taken = vec![false; columns * rows];
    for (p, _) in &points.points {
        let (x, y) = (p.x.max(0.0) as usize / CELL, p.y.max(0.0) as usize / CELL);
        if x < columns && y < rows {
            taken[y * columns + x] = true;
        }
    }
    let mut best: Vec<(f32, usize, usize)> = vec![(0.0, 0, 0); columns * rows];
    for y in margin..h.saturating_sub(margin) {
        for x in margin..w.saturating_sub(margin) {
            let cell = y / CELL * columns + x / CELL;
            if taken[cell] || !valid.at(x, y) {
                continue;
            }
            let c = image.cornerness(x, y);
            if c > best[cell].0 {
                best[cell] = (c, x, y);
            }
        }
    }
    // A gradient of 1 in 255 across the window in the weaker direction.
    let least = 49.0 * (1.0f32 / 255.0).powi(2);
    best.iter().filter(|b| b.0 > least).map(|b| DVec2::new(b.1 as f64 + 0.5, b.2 as f64 + 0.5)).collect()
}

fn predict_track(
    aligner: &Aligner,
    points: &ViewPoints,
    valid: &[Image<bool>],
    view: usize,
    pixel: DVec2,
) -> Option<Track> {
    let model = aligner.model;
    let (rho, slant) = points.plane(pixel, 60.0)?;
    let flat = Facet { view, pixel, inverse_depth: rho, slant };
    let template = aligner.template(&flat)?;
    let inside = |v: usize, p: DVec2| {
        let (x, y) = (p.x.max(0.0) as usize, p.y.max(0.0) as usize);
        x < valid[v].width && y < valid[v].height && valid[v].at(x, y)
    };
    let others: Vec<usize> = (0..model.poses.len())
        .filter(|v| *v != view && aligner.project_centre(&flat, *v).is_some_and(|p| inside(*v, p)))
        .collect();
    // Steps of about a pixel in the view where depth moves the point most.
    let swing = others
        .iter()
        .filter_map(|v| {
            let far = Facet { inverse_depth: rho * (1.0 + SEARCH), ..flat };
            Some((aligner.project_centre(&far, *v)? - aligner.project_centre(&flat, *v)?).length())
        })
        .fold(0.0, f64::max);
    let steps = (swing.ceil() as i32).clamp(1, 40);
    let scans: Vec<Scan> = others.iter().filter_map(|v| Scan::new(aligner, &template, &flat, *v)).collect();
    let mut best: Option<(f64, Facet)> = None;
    for k in -steps..=steps {
        let f = Facet { inverse_depth: rho * (1.0 + SEARCH * k as f64 / steps as f64), ..flat };
        let mut scores: Vec<f64> = scans.iter().filter_map(|s| s.ncc(f.inverse_depth)).collect();
        scores.sort_by(|a, b| b.total_cmp(a));
        // The best two views: a third may be occluded.
        scores.truncate(2);
        let score = scores.iter().sum::<f64>() / scores.len().max(1) as f64;
        if !scores.is_empty() && best.is_none_or(|b| score > b.0) {
            best = Some((score, f));
        }
    }
    let (score, facet) = best?;
    if score < 0.6 {
        return None;
    }
    let starts: Vec<(usize, DVec2)> = others.iter().map(|v| (*v, DVec2::ZERO)).collect();
    let (facet, aligned) = aligner.align(&facet, &starts, MIN_GUIDED_NCC)?;
    let observation = |v: usize, p: DVec2| TrackElement { view: v, pixel: p, sigma: 0.3, detector: REFINED };
    let mut elements = vec![observation(view, pixel)];
    for a in aligned {
        let missed = aligner.project_centre(&facet, a.view)?.distance(a.pixel);
        let back = aligner.round_trip(&facet, a.view, a.pixel);
        if missed < MAX_MOVE && back.is_some_and(|m| m < MAX_MISS) && a.ncc >= MIN_GUIDED_NCC {
            elements.push(observation(a.view, a.pixel));
        }
    }
    let position = model.triangulate(&elements, 1.5)?;
    (elements.len() >= 2).then_some(Track { position: Some(position), elements })
}
