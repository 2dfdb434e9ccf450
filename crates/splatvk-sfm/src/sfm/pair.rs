//! Pairs of photos whose matches agree on a geometry, and which photos only a doubtful one joins to
//! the others.
use super::tracks::KeypointMatch;
use crate::two_view::TwoView;
use glam::DVec2;

/// Matches between two views.
pub(super) struct Matches {
    pub(super) first: usize,
    pub(super) second: usize,
    /// (pixel, pixel, link), best first.
    pub(super) list: Vec<(DVec2, DVec2, KeypointMatch)>,
}

/// Two views whose matches agree on a geometry.
pub(super) struct Pair {
    /// Those that agree.
    pub(super) matches: Matches,
    pub(super) geometry: TwoView,
    /// Whether so many of all matches agree that the geometry is right beyond doubt.
    pub(super) sure: bool,
}

impl Pair {
    /// Its photos, ascending.
    pub(super) fn views(&self) -> (usize, usize) {
        (self.matches.first, self.matches.second)
    }
}

/// Agreeing matches, and their share of all, from which on a pair is taken for sure: on the tuning
/// sets wrong geometries of two photos have up to 200 matches, but less than half of all.
pub(super) const SURE: (usize, f64) = (100, 0.5);

/// Whether `agree` matches of `all` leave no doubt.
pub(super) fn is_sure(agree: usize, all: usize) -> bool {
    agree >= SURE.0 && agree as f64 >= SURE.1 * all as f64
}

/// Per photo the part that links connect it to, by the first photo of that part.
pub(super) fn parts(n: usize, linked: impl Iterator<Item = (usize, usize)>) -> Vec<usize> {
    let mut part: Vec<usize> = (0..n).collect();
    for (i, j) in linked {
        let (a, b) = (part[i].min(part[j]), part[i].max(part[j]));
        part.iter_mut().filter(|p| **p == b).for_each(|p| *p = a);
    }
    part
}

/// Per photo whether a single unsure pair is all that joins its part of the photos to the rest:
/// nothing confirms what that pair says. A part of more than half of the photos is where the others
/// are missing. `agrees`: per pair, whether its matches agree with the cameras.
pub(super) fn unconfirmed(n: usize, pairs: &[Pair], agrees: &[bool]) -> Vec<bool> {
    let part = parts(n, pairs.iter().filter(|p| p.sure).map(Pair::views));
    let leaves = |of: usize, p: &Pair| (part[p.views().0] == of) != (part[p.views().1] == of);
    let joined = |of: usize| pairs.iter().zip(agrees).filter(|(p, agrees)| **agrees && leaves(of, p)).count();
    let size = |of: usize| part.iter().filter(|p| **p == of).count();
    (0..n).map(|v| 2 * size(part[v]) <= n && joined(part[v]) < 2).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Pose;

    fn pair(first: usize, second: usize, sure: bool) -> Pair {
        let geometry = TwoView {
            pose: Pose::IDENTITY,
            stretch: 1.0,
            inliers: Vec::new(),
            parallax: 0.0,
            rotation_residual: 0.0,
        };
        Pair { matches: Matches { first, second, list: Vec::new() }, geometry, sure }
    }

    #[test]
    fn two_pairs_that_agree_confirm_a_photo_and_one_does_not() {
        let mut pairs = vec![pair(0, 1, true), pair(1, 2, true), pair(2, 3, false)];
        assert_eq!(unconfirmed(4, &pairs, &[true; 3]), [false, false, false, true]);
        pairs.push(pair(1, 3, false));
        assert_eq!(unconfirmed(4, &pairs, &[true; 4]), [false; 4]);
        assert_eq!(unconfirmed(4, &pairs, &[true, true, true, false]), [false, false, false, true]);
        assert_eq!(unconfirmed(2, &[pair(0, 1, false)], &[true]), [true, true]);
        assert_eq!(unconfirmed(2, &[pair(0, 1, true)], &[true]), [false, false]);
    }
}
