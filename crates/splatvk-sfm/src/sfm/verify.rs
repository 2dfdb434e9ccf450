//! Descriptor matches between pairs of photos, and their geometric verification.
use super::detectors::{DetectorFeatures, affine_features};
use super::model::Model;
use super::neighbours;
use super::pair::{Matches, Pair, components, is_sure};
use super::tracks::KeypointMatch;
use super::unregistered::Unregistered;
use crate::choose::Reason;
use crate::homography::{self, FocalRange};
use crate::matching::{self, Match};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::RgbImage;
use crate::two_view;
use crate::{Error, Result};
use glam::DVec2;
use rayon::prelude::*;

/// Inlier threshold, share of the long side: 3 px at 640, three times the noise of learned
/// keypoints.
pub(super) const THRESHOLD: f64 = 3.0 / 640.0;

/// Fewest inliers of a usable pair: five always fit, 20 rarely agree by chance.
pub(super) const MIN_INLIERS: usize = 20;

/// Largest zoom between two photos of one place: that of usual lenses.
const LARGEST_ZOOM: f64 = 4.0;
/// Largest zoom between photos whose files state their focal lengths, which are rounded and change
/// with focus.
const SAME_ZOOM: f64 = 1.1;
/// Least zoom that differs from a translation: a camera that comes nearer by a twentieth without
/// parallax yields no depth.
const ZOOMED: f64 = 1.05;

/// Geometry of a pair of photos.
enum TwoViewGeometry {
    Verified(Pair),
    /// Too few inliers of any geometry.
    NoOverlap,
    /// The camera only rotated or zoomed, or did not move.
    NoParallax,
    /// Both photos are the same picture.
    Duplicate,
}

impl TwoViewGeometry {
    fn is_sure(&self) -> bool {
        matches!(self, TwoViewGeometry::Verified(pair) if pair.sure)
    }
}

/// Matches and verified pairs of photos.
pub(super) struct VerifiedMatches {
    /// Matches by descriptor.
    pub(super) putative: Vec<Matches>,
    pub(super) pairs: Vec<Pair>,
}

/// Verifies the matches of all photos. The error names the photos that verified pairs do not
/// connect with the others. Where sure pairs do not connect all photos, [`affine_features`] join
/// `detectors`.
pub(super) fn verify_all(
    photos: &[Photo],
    detectors: &mut Vec<DetectorFeatures>,
    putative: Vec<Matches>,
    empty: &Model,
    progress: &dyn Progress,
) -> Result<VerifiedMatches, Unregistered> {
    let (putative, named) = verify_pairs(photos, detectors, putative, empty, 0, progress)?;
    check_overlap(photos, &named)?;
    Ok(VerifiedMatches { putative, pairs: verified_pairs(named) })
}

/// Like [`verify_all`], for photos added to the first `known` ones, whose cameras are known: pairs
/// of those are matched but not verified. Unconnected photos are no error, duplicates are.
pub(super) fn verify_added(
    photos: &[Photo],
    detectors: &mut Vec<DetectorFeatures>,
    model: &Model,
    known: usize,
    progress: &dyn Progress,
) -> Result<VerifiedMatches, Unregistered> {
    let putative = putative_matches(photos, detectors, progress)?;
    let (putative, named) = verify_pairs(photos, detectors, putative, model, known, progress)?;
    if let Some((i, j, _)) = named.iter().find(|r| matches!(r.2, TwoViewGeometry::Duplicate)) {
        let (old, new) = (&photos[*i].stem, &photos[*j].stem);
        return Err(Unregistered {
            views: vec![(*j, Reason::Duplicate(old.clone()))],
            error: Error::input(format!("{new}: the same picture as {old}; give photos from other places")),
        });
    }
    Ok(VerifiedMatches { putative, pairs: verified_pairs(named) })
}

fn verified_pairs(named: Vec<(usize, usize, TwoViewGeometry)>) -> Vec<Pair> {
    let pair = |(_, _, geometry)| match geometry {
        TwoViewGeometry::Verified(pair) => Some(pair),
        _ => None,
    };
    named.into_iter().filter_map(pair).collect()
}

/// Matches of all pairs and the geometry of each, except for pairs of the first `known` photos.
fn verify_pairs(
    photos: &[Photo],
    detectors: &mut Vec<DetectorFeatures>,
    mut putative: Vec<Matches>,
    empty: &Model,
    known: usize,
    progress: &dyn Progress,
) -> Result<(Vec<Matches>, Vec<(usize, usize, TwoViewGeometry)>)> {
    let geometry_of = |pair: &Matches| match progress.cancelled() || pair.second < known {
        true => TwoViewGeometry::NoOverlap,
        false => verify(photos, pair, empty),
    };
    let mut geometries: Vec<TwoViewGeometry> = putative.par_iter().map(geometry_of).collect();
    progress.check()?;
    let unsure = unsure_pairs(photos.len(), &putative, &geometries, known);
    if !unsure.is_empty() {
        detectors.push(affine_features(photos));
    }
    for k in unsure {
        progress.check()?;
        let Matches { first, second, .. } = putative[k];
        let mut wide =
            Matches { first, second, list: without_repetitions(match_views(detectors, first, second)) };
        drop_static_matches(photos, &mut wide);
        let geometry = geometry_of(&wide);
        // More corners also agree by chance more often, as those of a mirrored photo.
        if geometry.is_sure() {
            (putative[k], geometries[k]) = (wide, geometry);
        }
    }
    progress.check()?;
    let named = putative.iter().zip(geometries).map(|(p, r)| (p.first, p.second, r)).collect();
    Ok((putative, named))
}

/// Indices of pairs between components of sure pairs that more corners may make sure; the first
/// `known` photos are one component.
fn unsure_pairs(
    photos: usize,
    putative: &[Matches],
    geometries: &[TwoViewGeometry],
    known: usize,
) -> Vec<usize> {
    let pairs = || putative.iter().zip(geometries);
    let sure = pairs().filter(|(p, r)| p.second < known || r.is_sure());
    let sure = sure.map(|(p, _)| (p.first, p.second));
    let component = components(photos, sure);
    let between = pairs().enumerate().filter(|(_, (p, r))| {
        component[p.first] != component[p.second]
            && !matches!(r, TwoViewGeometry::Duplicate | TwoViewGeometry::NoParallax)
    });
    between.map(|(k, _)| k).collect()
}

/// Descriptor matches of [`neighbours::pairs`].
pub(super) fn putative_matches(
    photos: &[Photo],
    detectors: &[DetectorFeatures],
    progress: &dyn Progress,
) -> Result<Vec<Matches>> {
    let pair = |(first, second)| {
        let list = if progress.cancelled() { Vec::new() } else { match_views(detectors, first, second) };
        let mut pair = Matches { first, second, list };
        drop_static_matches(photos, &mut pair);
        pair
    };
    let out = neighbours::pairs(detectors).into_par_iter().map(pair).collect();
    progress.check()?;
    Ok(out)
}

/// Descriptor matches between two views over all detectors, best first.
fn match_views(detectors: &[DetectorFeatures], i: usize, j: usize) -> Vec<(DVec2, DVec2, KeypointMatch)> {
    let mut all: Vec<(DVec2, DVec2, KeypointMatch)> = Vec::new();
    let (mut start_i, mut start_j) = (0, 0);
    for detector in detectors {
        let (a, b, ratio) = (&detector.keypoints[i], &detector.keypoints[j], detector.ratio);
        all.extend(matching::mutual_matches(a, b, ratio).into_iter().map(|m: Match| {
            let quality = m.quality / (1.0 - ratio as f64).max(0.1) * 0.15;
            let link =
                KeypointMatch { first: (i, start_i + m.first), second: (j, start_j + m.second), quality };
            (a.points[m.first], b.points[m.second], link)
        }));
        start_i += a.points.len();
        start_j += b.points.len();
    }
    all.sort_by(|a, b| b.2.quality.total_cmp(&a.2.quality).then(a.2.first.cmp(&b.2.first)));
    all
}

/// Drops matches without motion if both photos have an overlay, whose detected area may be too
/// small.
fn drop_static_matches(photos: &[Photo], pair: &mut Matches) {
    let (a, b) = (&photos[pair.first], &photos[pair.second]);
    if a.overlay.is_some()
        && b.overlay.is_some()
        && (a.image.width, a.image.height) == (b.image.width, b.image.height)
    {
        let still = 0.5 * THRESHOLD * a.image.width.max(a.image.height) as f64;
        pair.list.retain(|m| (m.0 - m.1).length() > still);
    }
}

/// Grid pitch on which two matches are at the same positions, pixels.
const SAME_PLACE: f64 = 2.0;

/// Matches without repetitions of better ones: a corner found in several compressed copies of a
/// photo counts once.
fn without_repetitions(matches: Vec<(DVec2, DVec2, KeypointMatch)>) -> Vec<(DVec2, DVec2, KeypointMatch)> {
    let mut taken = std::collections::HashSet::new();
    let cell = |p: DVec2| (p / SAME_PLACE).round().as_i64vec2();
    matches.into_iter().filter(|m| taken.insert((cell(m.0), cell(m.1)))).collect()
}

/// Verifies the matches of a pair by its two-view geometry.
fn verify(photos: &[Photo], pair: &Matches, empty: &Model) -> TwoViewGeometry {
    let (i, j, all) = (pair.first, pair.second, &pair.list);
    if same_picture(&photos[i].image, &photos[j].image) {
        return TwoViewGeometry::Duplicate;
    }
    let centred = |view: usize, p: DVec2| (p - empty.centres[view]) / empty.focal(view);
    let x: Vec<DVec2> = all.iter().map(|m| centred(i, m.0)).collect();
    let y: Vec<DVec2> = all.iter().map(|m| centred(j, m.1)).collect();
    let long = photos[i].image.width.max(photos[i].image.height) as f64;
    let threshold = THRESHOLD * long / empty.focal(i);
    let sigma = |v: usize| empty.priors[empty.camera_ids[v]].log_focal.1;
    let sigma = sigma(i).max(sigma(j));
    let rotation_zoom = || {
        let h = homography::estimate(&x, &y, threshold, empty.seed)?;
        let known = |v: usize| photos[v].exif_focal.is_some();
        let zoom = if known(i) && known(j) { SAME_ZOOM } else { LARGEST_ZOOM };
        let range = FocalRange { each: 2.0 * sigma, zoom: zoom.ln() };
        Some(homography::fit_rotation_zoom(&h, &x, &y, threshold, range))
    };
    let (rotation_zoom, found) =
        rayon::join(rotation_zoom, || two_view::estimate(&x, &y, threshold, sigma, empty.seed));
    let Some(found) = found.filter(|f| f.inliers.len() >= MIN_INLIERS) else {
        // A rotation so large that no translation explains the matches as well.
        let agree = rotation_zoom.map_or(0.0, |t| t.share(&x, &y, threshold) * x.len() as f64);
        return if is_sure(agree as usize, x.len()) {
            TwoViewGeometry::NoParallax
        } else {
            TwoViewGeometry::NoOverlap
        };
    };
    // Without translation only noise remains after the rotation: 0.6 of the threshold is about two
    // σ.
    let noise = 0.6 * threshold;
    let zoomed = rotation_zoom.filter(|t| t.zoom.ln().abs() > ZOOMED.ln()).is_some_and(|t| {
        let inliers = |p: &[DVec2]| -> Vec<DVec2> { found.inliers.iter().map(|k| p[*k]).collect() };
        t.residual(&inliers(&x), &inliers(&y)) < noise
    });
    if found.rotation_residual < noise || zoomed {
        return TwoViewGeometry::NoParallax;
    }
    let list = found.inliers.iter().map(|k| all[*k]).collect();
    let sure = is_sure(found.inliers.len(), all.len());
    TwoViewGeometry::Verified(Pair { matches: Matches { first: i, second: j, list }, geometry: found, sure })
}

/// Share of off-plane matches below which a photo shows only one plane.
const FLAT: f64 = 0.1;
/// Largest [`homography::perspective`] between two fronto-parallel views of a plane: that of one
/// tilted by 10° to 15° more than the other.
const STRAIGHT_ON: f64 = 0.1;

/// Whether each photo shows one fronto-parallel plane, or was taken from the same position as the
/// others: with every other photo one homography of little perspective explains all that agrees,
/// and at least one of these pairs is sure. Of a table seen obliquely only the top may match, while
/// the photo shows more.
pub(super) fn flat_photos(photos: &[Photo], putative: &[Matches], seed: u64) -> Vec<bool> {
    let half = |v: usize| DVec2::new(photos[v].image.width as f64, photos[v].image.height as f64) * 0.5;
    let found: Vec<Option<(bool, bool)>> = putative
        .par_iter()
        .map(|pair| planarity(pair, [half(pair.first), half(pair.second)], seed))
        .collect();
    let flat = |view: usize| {
        let own = putative.iter().zip(&found).filter(|(p, _)| [p.first, p.second].contains(&view));
        let own: Vec<(bool, bool)> = own.filter_map(|(_, found)| *found).collect();
        own.iter().all(|(flat, _)| *flat) && own.iter().any(|(_, sure)| *sure)
    };
    (0..photos.len()).map(flat).collect()
}

/// Whether a pair shows one fronto-parallel plane, and whether that is sure; `None` with too few
/// inliers. `centres`: the image centres.
fn planarity(pair: &Matches, centres: [DVec2; 2], seed: u64) -> Option<(bool, bool)> {
    let centred = pair.list.iter().map(|m| (m.0 - centres[0], m.1 - centres[1]));
    let (x, y): (Vec<DVec2>, Vec<DVec2>) = centred.unzip();
    let threshold = 2.0 * THRESHOLD * centres[0].max_element();
    let h = homography::estimate(&x, &y, threshold, seed)?;
    let (on, off) = homography::count_on_and_off_plane(&h, &x, &y, threshold, seed);
    let flat = (off as f64) < FLAT * (on + off) as f64;
    let sure = is_sure(on, x.len());
    let oblique = sure && homography::perspective(&h, centres[0]) > STRAIGHT_ON;
    (on + off >= MIN_INLIERS).then_some((flat && !oblique, sure))
}

/// True when two photos differ by less than re-compression does.
fn same_picture(a: &RgbImage, b: &RgbImage) -> bool {
    if (a.width, a.height) != (b.width, b.height) {
        return false;
    }
    let sum: f64 = a
        .data
        .iter()
        .zip(&b.data)
        .map(|(p, q)| (0..3).map(|k| (p[k] - q[k]).abs() as f64).sum::<f64>())
        .sum();
    sum / (3.0 * a.data.len().max(1) as f64) < 0.004
}

/// Returns an error unless the verified pairs connect all photos; it names those outside the
/// largest component.
fn check_overlap(
    photos: &[Photo],
    geometries: &[(usize, usize, TwoViewGeometry)],
) -> Result<(), Unregistered> {
    let n = photos.len();
    let name = |i: &usize, j: &usize| format!("{}–{}", photos[*i].stem, photos[*j].stem);
    let list = |test: fn(&TwoViewGeometry) -> bool| {
        geometries.iter().filter(|r| test(&r.2)).map(|r| name(&r.0, &r.1)).collect::<Vec<_>>().join(", ")
    };
    let same = list(|r| matches!(r, TwoViewGeometry::Duplicate));
    if !same.is_empty() {
        // Pairs are in the order of their first photo, which is kept.
        let mut views: Vec<(usize, Reason)> = Vec::new();
        for (i, j, _) in geometries.iter().filter(|r| matches!(r.2, TwoViewGeometry::Duplicate)) {
            if views.iter().all(|v| v.0 != *j) {
                views.push((*j, Reason::Duplicate(photos[*i].stem.clone())));
            }
        }
        views.sort_by_key(|v| v.0);
        let text = format!("identical photos: {same}; give photos from different positions");
        return Err(Unregistered { views, error: Error::input(text) });
    }
    let usable = geometries.iter().filter(|r| matches!(r.2, TwoViewGeometry::Verified(..)));
    let component = components(n, usable.map(|(i, j, _)| (*i, *j)));
    let size = |of: usize| component.iter().filter(|p| **p == of).count();
    let largest = (0..n).max_by_key(|p| (size(*p), std::cmp::Reverse(*p))).unwrap_or(0);
    let apart = (0..n).filter(|v| component[*v] != largest);
    let views: Vec<_> = apart.map(|v| (v, Reason::NoOverlap)).collect();
    if views.is_empty() {
        return Ok(());
    }
    let without_parallax = list(|r| matches!(r, TwoViewGeometry::NoParallax));
    let text = if without_parallax.is_empty() {
        let apart = list(|r| matches!(r, TwoViewGeometry::NoOverlap));
        format!(
            "photos do not overlap enough: {apart}; take photos that share at least half of what they show"
        )
    } else {
        format!(
            "no parallax between {without_parallax}: the camera only turned or zoomed; take the photos from different positions"
        )
    };
    Err(Unregistered { views, error: Error::input(text) })
}
