//! Which photos a run uses when more are given: sharp ones that overlap, from different places, and
//! that together show what all show.
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
/// Every pair is compared up to this many photos (780 pairs); beyond it every photo with
/// [`NEIGHBOURS`] likely ones.
const ALL_PAIRS: usize = 40;
const NEIGHBOURS: usize = 12;

/// Agreeing matches that make a usable link. Unrelated pairs reach 8 by chance (photos of a tower
/// from all sides); twice that leaves room.
const LINKED: usize = 16;
/// Agreeing matches at which a photo shows half of what another shows.
const HALF_SEEN: f64 = 40.0;
/// Parallax over the image diagonal below which two photos are from nearly the same place: at 60°
/// field of view and a scene as deep as it is far, a step of a fiftieth of the distance.
const SAME_PLACE: f64 = 0.006;
/// Of the fewer corners of two, the share that must match for them to show nearly the same.
const SAME_SHARE: f64 = 0.35;

/// What was chosen and why, for messages and run.json.
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
    /// Its name.
    pub photo: String,
    /// Why it is not used.
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

/// Why a photo is not used.
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
    /// The photos used show most of what it shows.
    #[serde(rename = "adds_little")]
    LittleNewArea,
    /// Its place among the others could not be found surely: so many percent of its matches agree
    /// with any cameras.
    Doubtful(u8),
}

/// Finds the photos of files, folders and videos and chooses `views` of them (`None`: all, at most
/// [`photo::DEFAULT_VIEWS`]), for [`photo::load_each`]. Says what it chose; without a choice, all
/// are used.
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
        // A list longer than this is not read; run.json has it all.
        const NAMED: usize = 6;
        let list = |names: &[&str]| {
            let more = names.len().saturating_sub(NAMED);
            let shown = names[..names.len() - more].join(", ");
            if more > 0 { format!("{shown} and {more} more") } else { shown }
        };
        let of = |wanted: &dyn Fn(&Reason) -> bool| -> Vec<&str> {
            self.left_out.iter().filter(|l| wanted(&l.reason)).map(|l| l.photo.as_str()).collect()
        };
        let mut parts = Vec::new();
        for (reason, words) in [
            (Reason::Blurred, "blurred"),
            (Reason::NoOverlap, "too little in common with the others"),
            (Reason::LittleNewArea, "the others show it"),
        ] {
            let names = of(&|r| *r == reason);
            if !names.is_empty() {
                parts.push(format!("{} ({words})", list(&names)));
            }
        }
        for same in &self.used {
            let names = of(&|r| matches!(r, Reason::Duplicate(n) if n == same));
            if !names.is_empty() {
                parts.push(format!("{} (nearly the same as {same})", list(&names)));
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

/// Features and sharpness of a candidate.
struct CandidateFeatures {
    features: Keypoints,
    /// Image diagonal in the features' pixels.
    diagonal: f64,
    sharpness: f64,
    /// Colours on a grid, for photos that are too many to compare all.
    signature: Vec<f32>,
}

/// A candidate at the size at which it is compared.
struct Look {
    small: RgbImage,
    sharpness: f64,
}

impl Look {
    fn of(image: &RgbImage) -> Look {
        let scale = (FEATURE_SIDE as f64 / image.width.max(image.height) as f64).min(1.0);
        let to = |n: usize| ((n as f64 * scale).round() as usize).max(1);
        let small = image.resized_by_area(to(image.width), to(image.height));
        Look { small, sharpness: sharpness::of(image) }
    }

    /// Features of the scene: `overlay` is what stands still in the frame.
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

/// Features of all candidates, without what stands still in all photos of one size.
fn features(looks: &[Look]) -> Vec<CandidateFeatures> {
    let overlays = still::overlays(looks.iter().map(|l| &l.small));
    looks.par_iter().zip(&overlays).map(|(look, overlay)| look.features(overlay.as_ref())).collect()
}

/// Indices of the chosen candidates in order, and the reasons. Deterministic.
pub fn choose(
    candidates: &[Candidate],
    wanted: usize,
    progress: &dyn Progress,
) -> Result<(Vec<usize>, Choice)> {
    progress.begin("choose", candidates.len() as u64);
    let done = AtomicU64::new(0);
    let look = |c: &Candidate| {
        progress.check()?;
        let seen = c.thumbnail(sharpness::SIDE, progress)?.map(|image| Look::of(&image));
        progress.step(done.fetch_add(1, Ordering::Relaxed) + 1, "");
        Ok(seen)
    };
    let looks: Vec<Result<Option<Look>>> = candidates.par_iter().map(look).collect();
    let looks = looks.into_iter().collect::<Result<Vec<_>>>()?;
    let there: Vec<usize> = (0..looks.len()).filter(|i| looks[*i].is_some()).collect();
    let looks: Vec<Look> = looks.into_iter().flatten().collect();
    let seen = features(&looks);
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
        let (a, b) = (&seen[i], &seen[j]);
        let matches = mutual_matches(&a.features, &b.features, RATIO);
        let points = |f: &Keypoints, d: f64, k: usize| f.points[k] / d;
        let ends: Vec<_> = matches
            .iter()
            .map(|m| (points(&a.features, a.diagonal, m.first), points(&b.features, b.diagonal, m.second)))
            .collect();
        progress.step(done.fetch_add(1, Ordering::Relaxed) + 1, "");
        Ok((i, j, overlap::agreement(&ends)))
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

/// The pairs to compare: all, or for many photos each with those of the most similar colours and
/// its neighbours in order.
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

/// Everything that the choice depends on.
struct Graph {
    links: Vec<Vec<SimilarityInliers>>,
    /// Sharpness over the median, at most 1.
    quality: Vec<f64>,
    same: Vec<Vec<bool>>,
}

/// What a set of photos is worth; smaller is better, compared from the left.
#[derive(Clone, Copy, PartialEq, PartialOrd)]
struct Cost {
    /// Groups of the set that no link joins.
    parts: usize,
    /// Minus what is seen of all.
    unseen: f64,
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
        // A photo that is linked to none shows another place, which is not to be covered.
        let counts = |i: &usize| self.links[*i].iter().any(|l| l.matches >= LINKED);
        let seen: f64 = (0..self.links.len()).filter(counts).map(best).sum();
        // Blur is paid for by itself, too: a blurred photo may be the only one of its place.
        let blur: f64 = set.iter().map(|&j| 1.0 - self.quality[j]).sum();
        Cost { parts, unseen: blur - seen }
    }

    /// Best set found by growing from every photo and then swapping single photos while that helps.
    fn choose(&self, wanted: usize) -> Vec<usize> {
        let n = self.links.len();
        let better = |a: &Cost, b: &Cost| a.partial_cmp(b) == Some(std::cmp::Ordering::Less);
        let grow = |start: usize| {
            let mut set = vec![start];
            while set.len() < wanted {
                let with = |j: usize| [&set[..], &[j]].concat();
                let free = (0..n).filter(|j| !set.contains(j)).map(|j| (self.cost(&with(j)), j));
                // On ties the first, so that the result does not depend on the machine.
                let best = free.reduce(|a, b| if better(&b.0, &a.0) { b } else { a });
                set.extend(best.map(|b| b.1));
            }
            (self.cost(&set), set)
        };
        let grown: Vec<(Cost, Vec<usize>)> = (0..n).into_par_iter().map(grow).collect();
        let Some((mut cost, mut set)) =
            grown.into_iter().reduce(|a, b| if better(&b.0, &a.0) { b } else { a })
        else {
            return Vec::new();
        };
        loop {
            let swaps = (0..set.len()).flat_map(|k| (0..n).map(move |j| (k, j)));
            let swapped = swaps.filter(|(_, j)| !set.contains(j)).map(|(k, j)| {
                let mut other = set.clone();
                other[k] = j;
                (self.cost(&other), other)
            });
            match swapped.reduce(|a, b| if better(&b.0, &a.0) { b } else { a }) {
                Some(next) if better(&next.0, &cost) => (cost, set) = next,
                _ => break,
            }
        }
        set.sort_unstable();
        set
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
