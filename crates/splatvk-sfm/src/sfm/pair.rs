//! Pairs of photos with a verified two-view geometry, and photos that only a doubtful one connects.
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

pub(super) struct Pair {
    /// The inliers.
    pub(super) matches: Matches,
    pub(super) geometry: TwoView,
    /// Whether the inliers pass [`SURE`].
    pub(super) sure: bool,
}

impl Pair {
    /// Indices of its views, ascending.
    pub(super) fn views(&self) -> (usize, usize) {
        (self.matches.first, self.matches.second)
    }
}

/// Fewest inliers, and their least share of all matches, of a sure pair: on the tuning sets wrong
/// geometries of two photos have up to 200 inliers, but less than half of all matches.
pub(super) const SURE: (usize, f64) = (100, 0.5);

/// Whether `inliers` of `all` matches make a sure pair.
pub(super) fn is_sure(inliers: usize, all: usize) -> bool {
    inliers >= SURE.0 && inliers as f64 >= SURE.1 * all as f64
}

/// Connected component of each photo, by its first photo.
pub(super) fn components(n: usize, linked: impl Iterator<Item = (usize, usize)>) -> Vec<usize> {
    let mut component: Vec<usize> = (0..n).collect();
    for (i, j) in linked {
        let (a, b) = (component[i].min(component[j]), component[i].max(component[j]));
        component.iter_mut().filter(|p| **p == b).for_each(|p| *p = a);
    }
    component
}

/// Whether each photo's pose rests on a single unsure pair: sure pairs connect it to at most half
/// of the photos, and fewer than two agreeing pairs connect these to the rest. `agrees`: per pair,
/// whether its matches agree with the cameras.
pub(super) fn unconfirmed(n: usize, pairs: &[Pair], agrees: &[bool]) -> Vec<bool> {
    let component = components(n, pairs.iter().filter(|p| p.sure).map(Pair::views));
    let leaves = |of: usize, p: &Pair| (component[p.views().0] == of) != (component[p.views().1] == of);
    let joined = |of: usize| pairs.iter().zip(agrees).filter(|(p, agrees)| **agrees && leaves(of, p)).count();
    let size = |of: usize| component.iter().filter(|p| **p == of).count();
    (0..n).map(|v| 2 * size(component[v]) <= n && joined(component[v]) < 2).collect()
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
    fn unconfirmed_unless_two_pairs_agree() {
        let mut pairs = vec![pair(0, 1, true), pair(1, 2, true), pair(2, 3, false)];
        assert_eq!(unconfirmed(4, &pairs, &[true; 3]), [false, false, false, true]);
        pairs.push(pair(1, 3, false));
        assert_eq!(unconfirmed(4, &pairs, &[true; 4]), [false; 4]);
        assert_eq!(unconfirmed(4, &pairs, &[true, true, true, false]), [false, false, false, true]);
        assert_eq!(unconfirmed(2, &[pair(0, 1, false)], &[true]), [true, true]);
        assert_eq!(unconfirmed(2, &[pair(0, 1, true)], &[true]), [false, false]);
    }
}
