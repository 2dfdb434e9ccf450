//! Pairs of photos that are matched: all of a few photos, of many each photo with the most similar
//! ones.
use super::detectors::DetectorFeatures;
use crate::matching::{self, Keypoints};
use rayon::prelude::*;
use std::cmp::Reverse;

/// Most photos of which all pairs are matched.
const ALL_PAIRS: usize = 16;
/// Photos that each of many is matched with, at least: half of the photos around a table overlap,
/// and a point is seen well enough by a dozen.
const NEIGHBOURS: usize = 8;
/// Strongest corners that compare two photos. They take 1 % of the time of all 4000.
const SAMPLE: usize = 400;

/// Pairs (i < j) to match, in order.
pub(super) fn pairs(detectors: &[DetectorFeatures]) -> Vec<(usize, usize)> {
    let keypoints = detectors.first().map_or(&[][..], |d| &d.keypoints);
    let all: Vec<(usize, usize)> = all_pairs(keypoints.len());
    if keypoints.len() <= ALL_PAIRS {
        return all;
    }
    let strongest: Vec<Keypoints> = keypoints.par_iter().map(|k| k.first(SAMPLE)).collect();
    let ratio = detectors[0].ratio;
    let matches = |&(i, j): &(usize, usize)| {
        (matching::mutual_matches(&strongest[i], &strongest[j], ratio).len(), i, j)
    };
    most_similar(keypoints.len(), all.par_iter().map(matches).collect())
}

fn all_pairs(n: usize) -> Vec<(usize, usize)> {
    (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j))).collect()
}

/// Of pairs (similarity, i, j): those of each photo with its [`NEIGHBOURS`] most similar ones, and a
/// spanning tree of most similar pairs, so that no group of photos stays apart.
fn most_similar(n: usize, mut scored: Vec<(usize, usize, usize)>) -> Vec<(usize, usize)> {
    scored.sort_by_key(|&(score, i, j)| (Reverse(score), i, j));
    let mut degree = vec![0; n];
    let mut group: Vec<usize> = (0..n).collect();
    let mut kept: Vec<(usize, usize)> = Vec::new();
    for (_, i, j) in scored {
        let joins = group[i] != group[j];
        if joins || degree[i].min(degree[j]) < NEIGHBOURS {
            kept.push((i, j));
            degree[i] += 1;
            degree[j] += 1;
        }
        if joins {
            let (from, to) = (group[i], group[j]);
            group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
        }
    }
    kept.sort_unstable();
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Photos along a line in two groups, each similar to those near it in its group.
    fn line(n: usize) -> Vec<(usize, usize, usize)> {
        let similarity = |i: usize, j: usize| match (2 * i < n) == (2 * j < n) {
            true => 100 - i.abs_diff(j),
            false => 0,
        };
        all_pairs(n).into_iter().map(|(i, j)| (similarity(i, j), i, j)).collect()
    }

    #[test]
    fn neighbours_come_first_and_nobody_stays_apart() {
        let pairs = most_similar(40, line(40));
        assert!(pairs.len() < 40 * NEIGHBOURS, "{} pairs", pairs.len());
        for v in 0..40 {
            let own = pairs.iter().filter(|p| p.0 == v || p.1 == v).count();
            assert!(own >= NEIGHBOURS, "photo {v}: {own}");
        }
        assert!((0..39).all(|v| v == 19 || pairs.contains(&(v, v + 1))));
        let across = pairs.iter().filter(|p| p.0 < 20 && p.1 >= 20).count();
        assert_eq!(across, 1, "the spanning tree joins the groups once");
    }
}
