//! Structure from motion: the built-in initialiser that needs no large model.
mod finish;
mod grow;
mod known;
mod model;
mod optics;
mod patch;
mod refine;
mod tracks;

use super::bundle::{Optics, OpticsPrior};
use super::matching::{self, Features, Match};
use super::two_view::{self, TwoView};
use super::{SparseModel, sift};
use crate::photo::Photo;
use crate::progress::Progress;
use crate::scene::{Camera, Lens, Plane, RgbImage};
use crate::{Error, Result};
use finish::{Evidence, finish};
use glam::DVec2;
use grow::{Pair, grow};
pub use known::with_cameras;
use model::{Freedom, Model, Sighting};
use rayon::prelude::*;
use tracks::Link;

/// ln f of a photo without EXIF: 0.9 × the long side covers phones (0.8) to normal lenses (1.2) within one σ.
const FOCAL_GUESS: f64 = 0.9;
const FOCAL_SIGMA: f64 = 0.35;
/// EXIF focal lengths are rounded and sensors are cropped.
const EXIF_SIGMA: f64 = 0.05;
/// Radial distortion at the corner of a photo, as a share of the radius: below a hundredth where a phone has corrected it, a
/// twentieth for plain wide lenses.
const LENS_SIGMA: f64 = 0.05;
/// Principal point from the middle, as a share of the long side: stabilised sensors move by up to a hundredth.
const SHIFT_SIGMA: f64 = 0.007;
/// Agreement threshold as a fraction of the long side: 3 px at 640, three times the noise of learned keypoints.
const THRESHOLD: f64 = 3.0 / 640.0;
/// Fewest verified matches of a usable pair: five are fitted by anything, 20 agree by chance in few cases.
const MIN_INLIERS: usize = 20;

/// What two photos have in common.
enum Relation {
    Usable(TwoView, Vec<Link>),
    /// Too few matches agree on any geometry.
    Apart,
    /// The camera only turned, or did not move.
    NoParallax,
    /// The same picture twice.
    Same,
}

/// Cameras and sparse points from photos and their learned features (one per photo; may be empty, then only the
/// built-in corner detector is used).
pub fn reconstruct(photos: &[Photo], features: &[Features], progress: &dyn Progress) -> Result<SparseModel> {
    if photos.len() < 2 {
        return Err(Error::input("cameras need at least two photos; give two or more"));
    }
    progress.begin("cameras", STEPS);
    progress.step(0, "corners");
    let families = corner_families(photos, features, progress)?;
    progress.step(1, "matches");
    let empty = empty_model(photos);
    let putative = putative_matches(&families, progress)?;
    let relations = relate_all(photos, &putative, &empty, progress)?;
    explain(photos, &relations)?;
    progress.step(2, "poses");
    let keypoints: Vec<Vec<Sighting>> = (0..photos.len()).map(|v| keypoints(&families, v)).collect();
    let model = assemble(photos, &keypoints, empty, relations, progress)?;
    progress.step(3, "refining");
    let model = finish(photos, model, &Evidence { putative, keypoints }, progress)?;
    progress.step(STEPS, &format!("{} points", model.points.len()));
    progress.end();
    Ok(model)
}

/// Steps of the progress bar: corners, matches, poses, refinement, extension.
const STEPS: u64 = 5;

/// Strongest corners kept per photo: matching stays below a second for four photos.
const MAX_CORNERS: usize = 4000;

/// Pixels next to the image edge that hold no features: their neighbourhood is cut off.
const MARGIN: usize = 4;

/// Features per detector family (built-in corners first, then the learned ones if given) and photo.
fn corner_families(
    photos: &[Photo],
    features: &[Features],
    progress: &dyn Progress,
) -> Result<Vec<Vec<Features>>> {
    progress.check()?;
    let own: Vec<Features> = photos
        .par_iter()
        .map(|p| sift::detect(&p.image.luma(), &matching::valid_area(&p.image, p.frame, MARGIN), MAX_CORNERS))
        .collect();
    progress.check()?;
    let mut families = vec![own];
    if features.len() == photos.len() {
        families.push(known::masked(photos, features));
    }
    Ok(families)
}

/// Features on valid pixels.
fn within(f: &Features, valid: &Plane<bool>) -> Features {
    let mut out = Features { dim: f.dim, ..Default::default() };
    for (k, p) in f.points.iter().enumerate() {
        let (x, y) = (p.x.max(0.0) as usize, p.y.max(0.0) as usize);
        if x < valid.width && y < valid.height && valid.at(x, y) {
            out.points.push(*p);
            out.descriptors.extend_from_slice(&f.descriptors[k * f.dim..(k + 1) * f.dim]);
        }
    }
    out
}

/// EXIF focal lengths of one camera that differ more come from different zoom settings.
const SAME_ZOOM: f64 = 0.03;

/// Focal groups and priors: photos of one size, camera model and zoom share a focal length; photos without EXIF share by
/// size. Portrait and landscape of one camera share too, although their working sizes differ.
fn empty_model(photos: &[Photo]) -> Model {
    let zoom: Vec<f64> =
        photos.iter().map(|p| 0.5 * (p.to_working.scale[0] + p.to_working.scale[1])).collect();
    // Focal length in original pixels.
    let exif = |v: usize| photos[v].exif_focal.map(|f| f / zoom[v]);
    let long = |v: usize| photos[v].original_size.0.max(photos[v].original_size.1);
    let alike = |a: usize, b: usize| {
        let (p, q) = (&photos[a], &photos[b]);
        let size =
            |p: &Photo| (p.original_size.0.max(p.original_size.1), p.original_size.0.min(p.original_size.1));
        let zoomed = match (exif(a), exif(b)) {
            (Some(f), Some(g)) => (f / g - 1.0).abs() > SAME_ZOOM,
            (None, None) => false,
            _ => true,
        };
        size(p) == size(q) && p.camera_model == q.camera_model && !zoomed
    };
    // The first photo of each group stands for it.
    let mut firsts: Vec<usize> = Vec::new();
    let mut group = Vec::new();
    for v in 0..photos.len() {
        let g = firsts.iter().position(|f| alike(*f, v)).unwrap_or_else(|| {
            firsts.push(v);
            firsts.len() - 1
        });
        group.push(g);
    }
    let priors: Vec<OpticsPrior> = firsts
        .iter()
        .enumerate()
        .map(|(g, &v)| {
            let log_focal = match exif(v) {
                Some(f) => (f.ln(), EXIF_SIGMA),
                None => ((FOCAL_GUESS * long(v) as f64).ln(), FOCAL_SIGMA),
            };
            let short = photos[v].original_size.0.min(photos[v].original_size.1);
            let corner = 0.5 * f64::hypot(long(v) as f64, short as f64) / log_focal.0.exp();
            // Upright photos of a camera that was turned hold its principal point in other places.
            let members = || photos.iter().zip(&group).filter(|m| *m.1 == g).map(|m| m.0);
            let one_way = members().all(|p| p.original_size == photos[v].original_size);
            OpticsPrior {
                log_focal,
                lens: [LENS_SIGMA / corner.powi(2), 0.5 * LENS_SIGMA / corner.powi(4)],
                shift: if one_way { SHIFT_SIGMA * long(v) as f64 } else { 0.0 },
            }
        })
        .collect();
    Model {
        poses: vec![None; photos.len()],
        centres: photos
            .iter()
            .map(|p| DVec2::new(p.image.width as f64, p.image.height as f64) * 0.5)
            .collect(),
        alike: group.clone(),
        group,
        zoom,
        optics: priors
            .iter()
            .map(|p| Optics { focal: p.log_focal.0.exp(), lens: Lens::NONE, shift: DVec2::ZERO })
            .collect(),
        priors,
        freedom: Freedom::Focal,
        tracks: Vec::new(),
    }
}

/// All pairs (i < j), in order.
fn pairs_of(n: usize) -> Vec<(usize, usize)> {
    (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).collect()
}

fn relate_all(
    photos: &[Photo],
    putative: &[Putative],
    empty: &Model,
    progress: &dyn Progress,
) -> Result<Vec<(usize, usize, Relation)>> {
    let out = putative
        .par_iter()
        .map(|pair| {
            let relation = match progress.cancelled() {
                true => Relation::Apart,
                false => relate(photos, pair, empty),
            };
            (pair.first, pair.second, relation)
        })
        .collect();
    progress.check()?;
    Ok(out)
}

/// What two views have in common by the looks of their features.
struct Putative {
    first: usize,
    second: usize,
    /// (pixel, pixel, link), best first.
    matches: Vec<(DVec2, DVec2, Link)>,
}

fn putative_matches(families: &[Vec<Features>], progress: &dyn Progress) -> Result<Vec<Putative>> {
    let pair = |(first, second)| {
        let matches = if progress.cancelled() { Vec::new() } else { putative(families, first, second) };
        Putative { first, second, matches }
    };
    let views = families.first().map_or(0, Vec::len);
    let out = pairs_of(views).into_par_iter().map(pair).collect();
    progress.check()?;
    Ok(out)
}

/// Matches by descriptor between two views, all families, best first.
fn putative(families: &[Vec<Features>], i: usize, j: usize) -> Vec<(DVec2, DVec2, Link)> {
    let mut all: Vec<(DVec2, DVec2, Link)> = Vec::new();
    let (mut start_i, mut start_j) = (0, 0);
    for (k, family) in families.iter().enumerate() {
        let (a, b) = (&family[i], &family[j]);
        // Learned descriptors are compared more leniently: their second-best is close by design of the training.
        let ratio = if k == 0 { 0.85 } else { 0.97 };
        all.extend(matching::mutual_matches(a, b, ratio).into_iter().map(|m: Match| {
            let quality = m.quality / (1.0 - ratio as f64).max(0.1) * 0.15;
            let link = Link { first: (i, start_i + m.first), second: (j, start_j + m.second), quality };
            (a.points[m.first], b.points[m.second], link)
        }));
        start_i += a.points.len();
        start_j += b.points.len();
    }
    all.sort_by(|a, b| b.2.quality.total_cmp(&a.2.quality).then(a.2.first.cmp(&b.2.first)));
    all
}

fn relate(photos: &[Photo], pair: &Putative, empty: &Model) -> Relation {
    let (i, j, all) = (pair.first, pair.second, &pair.matches);
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
    let Some(found) = two_view::estimate(&x, &y, threshold, sigma) else { return Relation::Apart };
    if found.inliers.len() < MIN_INLIERS {
        return Relation::Apart;
    }
    // Without translation nothing but noise remains after the rotation: 0.6 of the threshold is about two σ.
    if found.rotation_residual < 0.6 * threshold {
        return Relation::NoParallax;
    }
    let links = found.inliers.iter().map(|k| all[*k].2).collect();
    Relation::Usable(found, links)
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

/// A clear error unless the usable pairs connect all photos.
fn explain(photos: &[Photo], relations: &[(usize, usize, Relation)]) -> Result<()> {
    let n = photos.len();
    let name = |i: &usize, j: &usize| format!("{}–{}", photos[*i].stem, photos[*j].stem);
    let list = |test: fn(&Relation) -> bool| {
        relations.iter().filter(|r| test(&r.2)).map(|r| name(&r.0, &r.1)).collect::<Vec<_>>().join(", ")
    };
    let same = list(|r| matches!(r, Relation::Same));
    if !same.is_empty() {
        return Err(Error::input(format!("identical photos: {same}; give photos from different positions")));
    }
    let mut reached = vec![false; n];
    reached[0] = true;
    for _ in 0..n {
        for (i, j, r) in relations {
            if matches!(r, Relation::Usable(..)) && (reached[*i] || reached[*j]) {
                (reached[*i], reached[*j]) = (true, true);
            }
        }
    }
    if reached.iter().all(|r| *r) {
        return Ok(());
    }
    let turned = list(|r| matches!(r, Relation::NoParallax));
    if !turned.is_empty() {
        return Err(Error::input(format!(
            "no parallax between {turned}: the camera only turned; take the photos from different positions"
        )));
    }
    let apart = list(|r| matches!(r, Relation::Apart));
    Err(Error::input(format!(
        "photos do not overlap enough: {apart}; take photos that share at least half of what they show"
    )))
}

/// All keypoints of a view, numbered as the links number them.
fn keypoints(families: &[Vec<Features>], view: usize) -> Vec<Sighting> {
    let all = families.iter().enumerate().flat_map(|(k, f)| f[view].points.iter().map(move |p| (k, *p)));
    all.map(|(family, pixel)| Sighting { view, pixel, sigma: 1.0, family }).collect()
}

fn assemble(
    photos: &[Photo],
    points: &[Vec<Sighting>],
    mut empty: Model,
    relations: Vec<(usize, usize, Relation)>,
    progress: &dyn Progress,
) -> Result<Model> {
    let (mut pairs, mut links) = (Vec::new(), Vec::new());
    for (first, second, relation) in relations {
        if let Relation::Usable(geometry, l) = relation {
            links.extend(l);
            pairs.push(Pair { first, second, geometry });
        }
    }
    let tracks = tracks::join(&mut links, points);
    // The pair estimates vote on the focal stretch, weighted by matches and parallax.
    for g in 0..empty.optics.len() {
        let (mut sum, mut weight) = (0.0, 1e-9);
        for p in pairs.iter().filter(|p| empty.group[p.first] == g || empty.group[p.second] == g) {
            let w = grow::seed_score(p);
            sum += w * p.geometry.stretch.ln();
            weight += w;
        }
        empty.optics[g].focal *= (sum / weight).exp();
    }
    let long = photos[0].image.width.max(photos[0].image.height) as f64;
    let threshold = THRESHOLD * long;
    pairs.sort_by(|a, b| grow::seed_score(b).total_cmp(&grow::seed_score(a)));
    let mut stuck: Option<Vec<usize>> = None;
    for seed in pairs.iter().take(3) {
        progress.check()?;
        match grow(&empty, &tracks, &pairs, seed, threshold) {
            Ok(model) => return Ok(model),
            Err(s) => stuck = Some(s.left),
        }
    }
    let names: Vec<&str> = stuck.unwrap_or_default().iter().map(|v| photos[*v].stem.as_str()).collect();
    Err(Error::input(format!(
        "no camera position found for {}; these photos share too little with the others: replace them or add photos in between",
        names.join(", ")
    )))
}

fn colour_at(image: &RgbImage, p: DVec2) -> [f32; 3] {
    image.at((p.x.max(0.0) as usize).min(image.width - 1), (p.y.max(0.0) as usize).min(image.height - 1))
}

fn cameras_of(photos: &[Photo], model: &Model) -> Result<Vec<Camera>> {
    photos
        .iter()
        .enumerate()
        .map(|(v, p)| {
            let pose = model.poses[v]
                .ok_or_else(|| Error::work(format!("no camera position found for {}", p.stem)))?;
            Ok(Camera {
                name: p.path.file_name().map_or_else(|| p.stem.clone(), |n| n.to_string_lossy().into()),
                width: p.image.width as u32,
                height: p.image.height as u32,
                fx: model.focal(v),
                fy: model.focal(v),
                cx: model.principal_point(v).x,
                cy: model.principal_point(v).y,
                pose,
            })
        })
        .collect()
}

#[cfg(test)]
mod tests;
