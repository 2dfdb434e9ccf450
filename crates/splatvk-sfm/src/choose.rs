//! Selection of photos where more are given than wanted: sharp, overlapping, from different
//! positions, and together covering the scene.
use super::matching::{Keypoints, mutual_matches, valid_area};
use super::overlap::{self, SimilarityInliers};
use super::{sharpness, sift, still};
use crate::Result;
use crate::photo::{self, Candidate, PlainBorder};
use crate::progress::Progress;
use crate::scene::{Coverage, Image, RgbImage};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Long side at which corners are matched: enough to measure overlap, and cheap enough for a
/// hundred photos.
const FEATURE_SIDE: usize = 320;
/// Corners per photo. Matching costs their square: 5 ms a pair.
const FEATURES: usize = 300;
/// Lowe's ratio. Wrong matches cost little, since the count is that of matches that agree.
const RATIO: f32 = 0.85;
/// Most photos of which every pair is compared (780 pairs); beyond it every photo is compared with
/// [`NEIGHBOURS`] likely ones.
const ALL_PAIRS: usize = 40;
const NEIGHBOURS: usize = 12;

/// Fewest inliers of a usable link. Unrelated pairs reach 8 by chance (photos of a tower from all
/// sides); twice that leaves a margin.
const LINKED: usize = 16;
/// Inliers at which a photo shows half of another.
const HALF_SEEN: f64 = 40.0;
/// Parallax over the image diagonal below which two photos are from nearly the same place: at 60°
/// field of view and a scene as deep as it is far, a step of a fiftieth of the distance.
const SAME_PLACE: f64 = 0.006;
/// Least share of matches, of the smaller number of corners, at which two photos show nearly the
/// same.
const SAME_SHARE: f64 = 0.35;

/// The photos chosen and those left out, with reasons, for messages and run.json.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize)]
#[non_exhaustive]
pub struct Choice {
    /// Names of the photos used, in order.
    pub used: Vec<String>,
    /// The others, each with the reason.
    pub left_out: Vec<LeftOut>,
}

/// A photo that is not used. Stored as `[photo, reason]`.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(into = "(String, Reason)", from = "(String, Reason)")]
pub struct LeftOut {
    /// Name of the photo.
    pub photo: String,
    /// Reason for leaving it out.
    pub reason: Reason,
}

impl From<LeftOut> for (String, Reason) {
    fn from(l: LeftOut) -> (String, Reason) {
        (l.photo, l.reason)
    }
}

impl From<(String, Reason)> for LeftOut {
    fn from((photo, reason): (String, Reason)) -> LeftOut {
        LeftOut { photo, reason }
    }
}

/// Reason for leaving out a photo.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum Reason {
    /// Less sharp than the others.
    Blurred,
    /// Too few matches with the photos used.
    #[serde(rename = "nothing_in_common")]
    NoOverlap,
    /// The same picture, or taken from the same place, as this one.
    #[serde(rename = "nearly_the_same_as")]
    Duplicate(String),
    /// The photos used cover most of its content.
    #[serde(rename = "adds_little")]
    LittleNewArea,
    /// Its pose is uncertain: only this percentage of its matches agrees with any cameras.
    Doubtful(u8),
}

/// Gathers the photos of files, folders and videos and chooses `views` of them (`None`: all, at
/// most [`photo::DEFAULT_VIEWS`]), for [`photo::load_each`]. Reports the choice to `progress`;
/// without a choice, all are used.
pub fn photos(
    inputs: &[std::path::PathBuf],
    views: Option<usize>,
    progress: &dyn Progress,
) -> Result<(Vec<Candidate>, Option<Choice>)> {
    let candidates = photo::gather(inputs, progress)?;
    let wanted = photo::photo_count(candidates.len(), views)?;
    if wanted == candidates.len() {
        return Ok((candidates, None));
    }
    let (chosen, choice) = choose(&candidates, wanted, progress)?;
    progress.inform(&choice.message());
    Ok((chosen.into_iter().map(|i| candidates[i].clone()).collect(), Some(choice)))
}

impl Choice {
    /// "using 2 of 4 photos: a.jpg, b.jpg (sharp, …); left out: …".
    pub fn message(&self) -> String {
        let names_with = |wanted: &dyn Fn(&Reason) -> bool| -> Vec<&str> {
            self.left_out.iter().filter(|l| wanted(&l.reason)).map(|l| l.photo.as_str()).collect()
        };
        let mut parts = Vec::new();
        for (reason, words) in [
            (Reason::Blurred, "blurred"),
            (Reason::NoOverlap, "too little in common with the others"),
            (Reason::LittleNewArea, "the others show it"),
        ] {
            let names = names_with(&|r| *r == reason);
            if !names.is_empty() {
                parts.push(format!("{} ({words})", shortened_list(&names)));
            }
        }
        for same in &self.used {
            let names = names_with(&|r| matches!(r, Reason::Duplicate(n) if n == same));
            if !names.is_empty() {
                parts.push(format!("{} (nearly the same as {same})", shortened_list(&names)));
            }
        }
        let used: Vec<&str> = self.used.iter().map(String::as_str).collect();
        format!(
            "using {} of {} photos: {} (sharp, overlapping, from different places); left out: {}; --views changes how many",
            used.len(),
            used.len() + self.left_out.len(),
            used.join(", "),
            parts.join("; ")
        )
    }
}

/// At most six names, separated by commas; run.json has all of them.
fn shortened_list(names: &[&str]) -> String {
    const NAMED: usize = 6;
    let more = names.len().saturating_sub(NAMED);
    let shown = names[..names.len() - more].join(", ");
    if more > 0 { format!("{shown} and {more} more") } else { shown }
}

/// Features and sharpness of a candidate.
struct CandidateFeatures {
    features: Keypoints,
    /// Image diagonal in the features' pixels.
    diagonal: f64,
    sharpness: f64,
    /// Colours on a grid, for sets too large to compare all pairs.
    signature: Vec<f32>,
}

/// Reduced image and sharpness of a candidate.
struct Thumbnail {
    small: RgbImage,
    sharpness: f64,
}

impl Thumbnail {
    fn of(image: &RgbImage) -> Thumbnail {
        let scale = (FEATURE_SIDE as f64 / image.width.max(image.height) as f64).min(1.0);
        let to = |n: usize| ((n as f64 * scale).round() as usize).max(1);
        let small = image.resized_by_area(to(image.width), to(image.height));
        Thumbnail { small, sharpness: sharpness::measure(image) }
    }

    /// Features outside of `overlay`.
    fn features(&self, overlay: Option<&Image<bool>>) -> CandidateFeatures {
        let small = &self.small;
        // Margin 4: the descriptor's window at the finest scale.
        let coverage = overlay.map(|hidden| Coverage::without(None, hidden));
        let valid = valid_area(small, PlainBorder::default(), coverage.as_ref(), 4);
        CandidateFeatures {
            features: sift::detect(&small.luma(), &valid, FEATURES),
            diagonal: (small.width as f64).hypot(small.height as f64),
            sharpness: self.sharpness,
            signature: small.resized_by_area(8, 8).data.into_iter().flatten().collect(),
        }
    }
}

/// Features of all candidates, outside of the overlays that stand still in all photos of one size.
fn features(thumbnails: &[Thumbnail]) -> Vec<CandidateFeatures> {
    let overlays = still::overlays(thumbnails.iter().map(|l| &l.small));
    thumbnails
        .par_iter()
        .zip(&overlays)
        .map(|(thumbnail, overlay)| thumbnail.features(overlay.as_ref()))
        .collect()
}

/// Chooses `wanted` candidates. Returns their indices, ascending, and the reasons. Deterministic.
pub fn choose(
    candidates: &[Candidate],
    wanted: usize,
    progress: &dyn Progress,
) -> Result<(Vec<usize>, Choice)> {
    progress.begin("choose", candidates.len() as u64);
    let done = AtomicU64::new(0);
    let load = |c: &Candidate| {
        progress.check()?;
        let seen = c.thumbnail(sharpness::SIDE, progress)?.map(|image| Thumbnail::of(&image));
        progress.step(done.fetch_add(1, Ordering::Relaxed) + 1, "");
        Ok(seen)
    };
    let thumbnails: Vec<Result<Option<Thumbnail>>> = candidates.par_iter().map(load).collect();
    let thumbnails = thumbnails.into_iter().collect::<Result<Vec<_>>>()?;
    let there: Vec<usize> = (0..thumbnails.len()).filter(|i| thumbnails[*i].is_some()).collect();
    let thumbnails: Vec<Thumbnail> = thumbnails.into_iter().flatten().collect();
    let seen = features(&thumbnails);
    progress.end();
    photo::photo_count(seen.len(), Some(wanted))?;
    let links = links(&seen, progress)?;
    let graph = Graph::new(&seen, links);
    let chosen = graph.choose(wanted);
    let names: Vec<String> = there.iter().map(|i| candidates[*i].name()).collect();
    let choice = Choice {
        used: chosen.iter().map(|i| names[*i].clone()).collect(),
        left_out: (0..names.len())
            .filter(|i| !chosen.contains(i))
            .map(|i| LeftOut { photo: names[i].clone(), reason: graph.reason(i, &chosen, &names) })
            .collect(),
    };
    Ok((chosen.into_iter().map(|i| there[i]).collect(), choice))
}

/// [N, N] links, symmetric; pairs that were not compared are unlinked.
fn links(seen: &[CandidateFeatures], progress: &dyn Progress) -> Result<Vec<Vec<SimilarityInliers>>> {
    let n = seen.len();
    let pairs = pairs(seen);
    progress.begin("overlap", pairs.len() as u64);
    let done = AtomicU64::new(0);
    let compare = |&(i, j): &(usize, usize)| {
        progress.check()?;
        let link = link(&seen[i], &seen[j]);
        progress.step(done.fetch_add(1, Ordering::Relaxed) + 1, "");
        Ok((i, j, link))
    };
    let found = pairs.par_iter().map(compare).collect::<Result<Vec<_>>>()?;
    let mut links = vec![vec![SimilarityInliers::default(); n]; n];
    for (i, j, link) in found {
        links[i][j] = link;
        links[j][i] = link;
    }
    progress.end();
    Ok(links)
}

fn link(a: &CandidateFeatures, b: &CandidateFeatures) -> SimilarityInliers {
    let matches = mutual_matches(&a.features, &b.features, RATIO);
    let position = |c: &CandidateFeatures, k: usize| c.features.points[k] / c.diagonal;
    let ends: Vec<_> = matches.iter().map(|m| (position(a, m.first), position(b, m.second))).collect();
    overlap::similarity_inliers(&ends)
}

/// Pairs to compare: all, or for many photos each with those of the most similar colours and its
/// neighbours in order.
fn pairs(seen: &[CandidateFeatures]) -> Vec<(usize, usize)> {
    let n = seen.len();
    if n <= ALL_PAIRS {
        return (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).collect();
    }
    let distance = |i: usize, j: usize| -> f32 {
        let (a, b) = (&seen[i].signature, &seen[j].signature);
        a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
    };
    let mut pairs: Vec<(usize, usize)> = (0..n)
        .flat_map(|i| {
            let mut others: Vec<usize> = (0..n).filter(|j| *j != i).collect();
            others.sort_by(|a, b| distance(i, *a).total_cmp(&distance(i, *b)).then(a.cmp(b)));
            others.truncate(NEIGHBOURS);
            // Photos and frames taken one after the other.
            others.extend((i + 1..n).take(NEIGHBOURS / 3));
            others.into_iter().map(move |j| (i.min(j), i.max(j)))
        })
        .collect();
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// Links and quality of the candidates, from which the choice is made.
struct Graph {
    links: Vec<Vec<SimilarityInliers>>,
    /// Sharpness over the median, at most 1.
    quality: Vec<f64>,
    same: Vec<Vec<bool>>,
}

/// Cost of a set of photos; fields are compared in order, smaller is better.
#[derive(Clone, Copy, PartialEq, PartialOrd)]
struct Cost {
    /// Connected components of the set.
    parts: usize,
    /// Blur of the set, minus the share of all photos that it shows.
    unseen: f64,
}

impl Cost {
    fn is_below(&self, other: &Cost) -> bool {
        self.partial_cmp(other) == Some(std::cmp::Ordering::Less)
    }
}

/// The cheaper of two choices; the first on ties, so that the result does not depend on the
/// machine.
fn cheaper<T>(a: (Cost, T), b: (Cost, T)) -> (Cost, T) {
    if b.0.is_below(&a.0) { b } else { a }
}

impl Graph {
    fn new(seen: &[CandidateFeatures], links: Vec<Vec<SimilarityInliers>>) -> Graph {
        let mut all: Vec<f64> = seen.iter().map(|s| s.sharpness).collect();
        let median = crate::math::median(&mut all).unwrap_or(1.0).max(1e-9);
        let same = |i: usize, j: usize| {
            let fewer = seen[i].features.points.len().min(seen[j].features.points.len());
            let link = links[i][j];
            i != j && link.parallax < SAME_PLACE && link.matches as f64 > SAME_SHARE * fewer.max(1) as f64
        };
        let n = seen.len();
        Graph {
            quality: seen.iter().map(|s| (s.sharpness / median).min(1.0)).collect(),
            same: (0..n).map(|i| (0..n).map(|j| same(i, j)).collect()).collect(),
            links,
        }
    }

    /// Share of photo `i` that photo `j` shows, [0, 1].
    fn overlap_share(&self, i: usize, j: usize) -> f64 {
        let matches = self.links[i][j].matches as f64;
        if i == j || self.same[i][j] {
            1.0
        } else if self.links[i][j].matches < LINKED {
            0.0
        } else {
            matches / (matches + HALF_SEEN)
        }
    }

    fn joined(&self, i: usize, j: usize) -> bool {
        self.links[i][j].matches >= LINKED && !self.same[i][j]
    }

    fn cost(&self, set: &[usize]) -> Cost {
        let mut group: Vec<usize> = (0..set.len()).collect();
        for a in 0..set.len() {
            for b in 0..a {
                if group[a] != group[b] && self.joined(set[a], set[b]) {
                    let (from, to) = (group[a], group[b]);
                    group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
                }
            }
        }
        let parts = (0..set.len()).filter(|k| group.contains(k)).count();
        let best =
            |i: usize| set.iter().map(|&j| self.quality[j] * self.overlap_share(i, j)).fold(0.0, f64::max);
        // A photo without links shows another scene, which need not be covered.
        let counts = |i: &usize| self.links[*i].iter().any(|l| l.matches >= LINKED);
        let seen: f64 = (0..self.links.len()).filter(counts).map(best).sum();
        // Blur has a cost by itself, too: a blurred photo may be the only one of its place.
        let blur: f64 = set.iter().map(|&j| 1.0 - self.quality[j]).sum();
        Cost { parts, unseen: blur - seen }
    }

    /// Best set by greedy growth from every photo, followed by swaps of single photos as long as
    /// they help.
    fn choose(&self, wanted: usize) -> Vec<usize> {
        let n = self.links.len();
        let grown: Vec<(Cost, Vec<usize>)> =
            (0..n).into_par_iter().map(|start| self.grow(start, wanted)).collect();
        let Some((mut cost, mut set)) = grown.into_iter().reduce(cheaper) else {
            return Vec::new();
        };
        loop {
            let swaps = (0..set.len()).flat_map(|k| (0..n).map(move |j| (k, j)));
            let swapped = swaps.filter(|(_, j)| !set.contains(j)).map(|(k, j)| {
                let mut other = set.clone();
                other[k] = j;
                (self.cost(&other), other)
            });
            match swapped.reduce(cheaper) {
                Some(next) if next.0.is_below(&cost) => (cost, set) = next,
                _ => break,
            }
        }
        set.sort_unstable();
        set
    }

    /// Grows a set of `wanted` photos from one by the cheapest addition each.
    fn grow(&self, start: usize, wanted: usize) -> (Cost, Vec<usize>) {
        let mut set = vec![start];
        while set.len() < wanted {
            let with = |j: usize| [&set[..], &[j]].concat();
            let free = (0..self.links.len()).filter(|j| !set.contains(j));
            let best = free.map(|j| (self.cost(&with(j)), j)).reduce(cheaper);
            set.extend(best.map(|b| b.1));
        }
        (self.cost(&set), set)
    }

    fn reason(&self, i: usize, chosen: &[usize], names: &[String]) -> Reason {
        if self.quality[i] < sharpness::BLURRED {
            return Reason::Blurred;
        }
        if let Some(&j) = chosen.iter().find(|&&j| self.same[i][j]) {
            return Reason::Duplicate(names[j].clone());
        }
        match chosen.iter().any(|&j| self.links[i][j].matches >= LINKED) {
            true => Reason::LittleNewArea,
            false => Reason::NoOverlap,
        }
    }
}

#[cfg(test)]
mod tests;
