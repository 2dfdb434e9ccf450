//! What pairs of photos have in common: matches by descriptors, and the geometry on which they
//! agree.
use super::families::{Family, affine_family};
use super::model::Model;
use super::pair::{Matches, Pair, is_sure, parts};
use super::tracks::KeypointMatch;
use super::unplaced::Unplaced;
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

/// Agreement threshold as a fraction of the long side: 3 px at 640, three times the noise of
/// learned keypoints.
pub(super) const THRESHOLD: f64 = 3.0 / 640.0;

/// Fewest verified matches of a usable pair: five are fitted by anything, 20 agree by chance in few
/// cases.
pub(super) const MIN_INLIERS: usize = 20;

/// Largest zoom between two photos of one place that is looked for: that of usual lenses.
const LARGEST_ZOOM: f64 = 4.0;
/// The same for photos whose files state their focal lengths, which are rounded and change with
/// focus.
const SAME_ZOOM: f64 = 1.1;
/// Least zoom that is told from a camera that moved: one that comes nearer by a twentieth without
/// showing parallax shows no depth.
const ZOOMED: f64 = 1.05;

/// What two photos have in common.
enum Relation {
    Usable(Pair),
    /// Too few matches agree on any geometry.
    Apart,
    /// The camera only turned or zoomed, or did not move.
    NoParallax,
    /// The same picture twice.
    Same,
}

impl Relation {
    fn is_sure(&self) -> bool {
        matches!(self, Relation::Usable(pair) if pair.sure)
    }
}

/// All pairs (i < j), in order.
fn pairs_of(n: usize) -> Vec<(usize, usize)> {
    (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).collect()
}

/// What photos have in common.
pub(super) struct Related {
    /// Matches of all pairs by descriptor.
    pub(super) putative: Vec<Matches>,
    /// The pairs that agree on a geometry; they connect all photos.
    pub(super) pairs: Vec<Pair>,
}

/// Of the matches of all photos the pairs that agree on a geometry; an error that names the others
/// unless those connect all photos. Where photos are not connected surely, corners of
/// [`affine_family`] join `families`.
pub(super) fn related(
    photos: &[Photo],
    families: &mut Vec<Family>,
    putative: Vec<Matches>,
    empty: &Model,
    progress: &dyn Progress,
) -> Result<Related, Unplaced> {
    let (putative, named) = relations(photos, families, putative, empty, 0, progress)?;
    check_overlap(photos, &named)?;
    Ok(Related { putative, pairs: usable(named) })
}

/// The same for photos that join the first `known` ones, whose cameras are known: of pairs of those
/// only the matches. Nothing is said of a photo that no pair connects; one that is another once
/// more is an error.
pub(super) fn related_to(
    photos: &[Photo],
    families: &mut Vec<Family>,
    model: &Model,
    known: usize,
    progress: &dyn Progress,
) -> Result<Related, Unplaced> {
    let putative = putative_matches(photos, families, progress)?;
    let (putative, named) = relations(photos, families, putative, model, known, progress)?;
    if let Some((i, j, _)) = named.iter().find(|r| matches!(r.2, Relation::Same)) {
        let (old, new) = (&photos[*i].stem, &photos[*j].stem);
        return Err(Unplaced {
            views: vec![(*j, Reason::Duplicate(old.clone()))],
            error: Error::input(format!("{new}: the same picture as {old}; give photos from other places")),
        });
    }
    Ok(Related { putative, pairs: usable(named) })
}

fn usable(named: Vec<(usize, usize, Relation)>) -> Vec<Pair> {
    let pair = |(_, _, relation)| match relation {
        Relation::Usable(pair) => Some(pair),
        _ => None,
    };
    named.into_iter().filter_map(pair).collect()
}

/// Matches of all pairs, and what the pairs have in common, apart from those among the first
/// `known` photos.
fn relations(
    photos: &[Photo],
    families: &mut Vec<Family>,
    mut putative: Vec<Matches>,
    empty: &Model,
    known: usize,
    progress: &dyn Progress,
) -> Result<(Vec<Matches>, Vec<(usize, usize, Relation)>)> {
    let one = |pair: &Matches| match progress.cancelled() || pair.second < known {
        true => Relation::Apart,
        false => relate(photos, pair, empty),
    };
    let mut relations: Vec<Relation> = putative.par_iter().map(one).collect();
    progress.check()?;
    let unsure = unsure_pairs(photos.len(), &putative, &relations, known);
    if !unsure.is_empty() {
        families.push(affine_family(photos));
    }
    for k in unsure {
        progress.check()?;
        let Matches { first, second, .. } = putative[k];
        let mut wide = Matches { first, second, list: distinct(self::putative(families, first, second)) };
        drop_still(photos, &mut wide);
        let relation = one(&wide);
        // So many more corners also agree by chance more often, as those of a mirrored photo.
        if relation.is_sure() {
            (putative[k], relations[k]) = (wide, relation);
        }
    }
    progress.check()?;
    let named = putative.iter().zip(relations).map(|(p, r)| (p.first, p.second, r)).collect();
    Ok((putative, named))
}

/// Pairs between parts of the photos that sure pairs connect, as far as more corners may make them
/// sure; the first `known` photos are one part.
fn unsure_pairs(photos: usize, putative: &[Matches], relations: &[Relation], known: usize) -> Vec<usize> {
    let pairs = || putative.iter().zip(relations);
    let sure = pairs().filter(|(p, r)| p.second < known || r.is_sure());
    let sure = sure.map(|(p, _)| (p.first, p.second));
    let part = parts(photos, sure);
    let between = pairs().enumerate().filter(|(_, (p, r))| {
        part[p.first] != part[p.second] && !matches!(r, Relation::Same | Relation::NoParallax)
    });
    between.map(|(k, _)| k).collect()
}

/// Matches by descriptor between all views.
pub(super) fn putative_matches(
    photos: &[Photo],
    families: &[Family],
    progress: &dyn Progress,
) -> Result<Vec<Matches>> {
    let pair = |(first, second)| {
        let list = if progress.cancelled() { Vec::new() } else { putative(families, first, second) };
        let mut pair = Matches { first, second, list };
        drop_still(photos, &mut pair);
        pair
    };
    let views = families.first().map_or(0, |f| f.keypoints.len());
    let out = pairs_of(views).into_par_iter().map(pair).collect();
    progress.check()?;
    Ok(out)
}

/// Matches by descriptor between two views, all families, best first.
fn putative(families: &[Family], i: usize, j: usize) -> Vec<(DVec2, DVec2, KeypointMatch)> {
    let mut all: Vec<(DVec2, DVec2, KeypointMatch)> = Vec::new();
    let (mut start_i, mut start_j) = (0, 0);
    for family in families {
        let (a, b, ratio) = (&family.keypoints[i], &family.keypoints[j], family.ratio);
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

/// Drops matches that stand still where something in the frame of both photos does: beside what was
/// found of it there is more.
fn drop_still(photos: &[Photo], pair: &mut Matches) {
    let (a, b) = (&photos[pair.first], &photos[pair.second]);
    if a.overlay.is_some()
        && b.overlay.is_some()
        && (a.image.width, a.image.height) == (b.image.width, b.image.height)
    {
        let still = 0.5 * THRESHOLD * a.image.width.max(a.image.height) as f64;
        pair.list.retain(|m| (m.0 - m.1).length() > still);
    }
}

/// Pixels within which two matches of the same two places are one.
const SAME_PLACE: f64 = 2.0;

/// Without the repetitions of better matches: what is seen in several compressed versions of a
/// photo is still one corner.
fn distinct(matches: Vec<(DVec2, DVec2, KeypointMatch)>) -> Vec<(DVec2, DVec2, KeypointMatch)> {
    let mut taken = std::collections::HashSet::new();
    let cell = |p: DVec2| (p / SAME_PLACE).round().as_i64vec2();
    matches.into_iter().filter(|m| taken.insert((cell(m.0), cell(m.1)))).collect()
}

fn relate(photos: &[Photo], pair: &Matches, empty: &Model) -> Relation {
    let (i, j, all) = (pair.first, pair.second, &pair.list);
    if same_picture(&photos[i].image, &photos[j].image) {
        return Relation::Same;
    }
    let centred = |view: usize, p: DVec2| (p - empty.centres[view]) / empty.focal(view);
    let x: Vec<DVec2> = all.iter().map(|m| centred(i, m.0)).collect();
    let y: Vec<DVec2> = all.iter().map(|m| centred(j, m.1)).collect();
    let long = photos[i].image.width.max(photos[i].image.height) as f64;
    let threshold = THRESHOLD * long / empty.focal(i);
    let sigma = |v: usize| empty.priors[empty.group[v]].log_focal.1;
    let sigma = sigma(i).max(sigma(j));
    let turned = homography::homography(&x, &y, threshold, empty.seed).map(|h| {
        let known = |v: usize| photos[v].exif_focal.is_some();
        let zoom = if known(i) && known(j) { SAME_ZOOM } else { LARGEST_ZOOM };
        homography::turn(&h, &x, &y, threshold, FocalRange { each: 2.0 * sigma, zoom: zoom.ln() })
    });
    let found = two_view::estimate(&x, &y, threshold, sigma, empty.seed);
    let Some(found) = found.filter(|f| f.inliers.len() >= MIN_INLIERS) else {
        // A turn so wide that no move explains it as well.
        let agree = turned.map_or(0.0, |t| t.share(&x, &y, threshold) * x.len() as f64);
        return if is_sure(agree as usize, x.len()) { Relation::NoParallax } else { Relation::Apart };
    };
    // Without translation nothing but noise remains after the rotation: 0.6 of the threshold is
    // about two σ.
    let noise = 0.6 * threshold;
    let zoomed = turned.filter(|t| t.zoom.ln().abs() > ZOOMED.ln()).is_some_and(|t| {
        let of = |p: &[DVec2]| -> Vec<DVec2> { found.inliers.iter().map(|k| p[*k]).collect() };
        t.residual(&of(&x), &of(&y)) < noise
    });
    if found.rotation_residual < noise || zoomed {
        return Relation::NoParallax;
    }
    let list = found.inliers.iter().map(|k| all[*k]).collect();
    let sure = is_sure(found.inliers.len(), all.len());
    Relation::Usable(Pair { matches: Matches { first: i, second: j, list }, geometry: found, sure })
}

/// Share of matches off the plane that most of them lie on, below which a photo shows nothing but
/// that plane.
const FLAT: f64 = 0.1;
/// Change of scale along the picture up to which two photos see a plane straight on: that of one
/// tilted by 10° to 15° more than the other.
const STRAIGHT_ON: f64 = 0.1;

/// Per photo whether the matches show it to be of one plane seen straight on, or taken from the
/// same place as the others: one homography explains all that agree on anything with every other
/// photo, with one at least beyond doubt, and hardly has perspective. From the far side of a table
/// its top may be all that is matched, while the photo shows more.
pub(super) fn flat_photos(photos: &[Photo], putative: &[Matches], seed: u64) -> Vec<bool> {
    let half = |v: usize| DVec2::new(photos[v].image.width as f64, photos[v].image.height as f64) * 0.5;
    let one = |pair: &Matches| {
        let middle = [half(pair.first), half(pair.second)];
        let centred = pair.list.iter().map(|m| (m.0 - middle[0], m.1 - middle[1]));
        let (x, y): (Vec<DVec2>, Vec<DVec2>) = centred.unzip();
        let threshold = 2.0 * THRESHOLD * middle[0].max_element();
        let h = homography::homography(&x, &y, threshold, seed)?;
        let (on, off) = homography::on_and_off_plane(&h, &x, &y, threshold, seed);
        let flat = (off as f64) < FLAT * (on + off) as f64;
        let sure = is_sure(on, x.len());
        let oblique = sure && homography::perspective(&h, middle[0]) > STRAIGHT_ON;
        (on + off >= MIN_INLIERS).then_some((flat && !oblique, sure))
    };
    let found: Vec<Option<(bool, bool)>> = putative.par_iter().map(one).collect();
    let flat = |view: usize| {
        let own = putative.iter().zip(&found).filter(|(p, _)| [p.first, p.second].contains(&view));
        let own: Vec<(bool, bool)> = own.filter_map(|(_, found)| *found).collect();
        own.iter().all(|(flat, _)| *flat) && own.iter().any(|(_, sure)| *sure)
    };
    (0..photos.len()).map(flat).collect()
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

/// A clear error unless the usable pairs connect all photos; it names those outside the largest
/// part that they connect.
fn check_overlap(photos: &[Photo], relations: &[(usize, usize, Relation)]) -> Result<(), Unplaced> {
    let n = photos.len();
    let name = |i: &usize, j: &usize| format!("{}–{}", photos[*i].stem, photos[*j].stem);
    let list = |test: fn(&Relation) -> bool| {
        relations.iter().filter(|r| test(&r.2)).map(|r| name(&r.0, &r.1)).collect::<Vec<_>>().join(", ")
    };
    let same = list(|r| matches!(r, Relation::Same));
    if !same.is_empty() {
        // Pairs stand in the order of their first photo: that one stays.
        let mut views: Vec<(usize, Reason)> = Vec::new();
        for (i, j, _) in relations.iter().filter(|r| matches!(r.2, Relation::Same)) {
            if views.iter().all(|v| v.0 != *j) {
                views.push((*j, Reason::Duplicate(photos[*i].stem.clone())));
            }
        }
        views.sort_by_key(|v| v.0);
        let text = format!("identical photos: {same}; give photos from different positions");
        return Err(Unplaced { views, error: Error::input(text) });
    }
    let usable = relations.iter().filter(|r| matches!(r.2, Relation::Usable(..)));
    let part = parts(n, usable.map(|(i, j, _)| (*i, *j)));
    let size = |of: usize| part.iter().filter(|p| **p == of).count();
    let largest = (0..n).max_by_key(|p| (size(*p), std::cmp::Reverse(*p))).unwrap_or(0);
    let apart = (0..n).filter(|v| part[*v] != largest);
    let views: Vec<_> = apart.map(|v| (v, Reason::NoOverlap)).collect();
    if views.is_empty() {
        return Ok(());
    }
    let turned = list(|r| matches!(r, Relation::NoParallax));
    let text = if turned.is_empty() {
        let apart = list(|r| matches!(r, Relation::Apart));
        format!(
            "photos do not overlap enough: {apart}; take photos that share at least half of what they show"
        )
    } else {
        format!(
            "no parallax between {turned}: the camera only turned or zoomed; take the photos from different positions"
        )
    };
    Err(Unplaced { views, error: Error::input(text) })
}
