//! Overlap of two photos, from matches before geometric verification.
use crate::math::median;
use glam::DVec2;

/// Inliers of the similarity between two photos.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct SimilarityInliers {
    /// Number of inliers.
    pub matches: usize,
    /// Median distance of the inliers from the similarity, over the image diagonal: approximately
    /// the parallax, since a similarity explains rotation and zoom of the camera.
    pub parallax: f64,
}

/// Inlier threshold, over the diagonal. Generous: depth moves corners by about as much between
/// photos 30° apart, and wrong matches are spread over the whole photo, of which this circle covers
/// 7 %.
const AGREES: f64 = 0.1;

/// Zoom between two photos beyond which matches are wrong more often than right.
const LARGEST_ZOOM: f64 = 3.0;

/// A similarity of the plane, q = a p + b with complex a: rotation, scale and translation.
#[derive(Clone, Copy)]
struct Similarity {
    a: DVec2,
    b: DVec2,
}

impl Similarity {
    fn product(x: DVec2, y: DVec2) -> DVec2 {
        DVec2::new(x.x * y.x - x.y * y.y, x.x * y.y + x.y * y.x)
    }

    /// Least squares over pairs of positions; `None` if degenerate or beyond [`LARGEST_ZOOM`].
    fn fit(pairs: &[(DVec2, DVec2)]) -> Option<Similarity> {
        let n = pairs.len() as f64;
        let mean = pairs.iter().fold((DVec2::ZERO, DVec2::ZERO), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
        let (mut top, mut bottom) = (DVec2::ZERO, 0.0);
        for (p, q) in pairs {
            let (p, q) = (*p - mean.0, *q - mean.1);
            top += Similarity::product(DVec2::new(p.x, -p.y), q);
            bottom += p.length_squared();
        }
        let a = top / bottom;
        let plausible = (1.0 / LARGEST_ZOOM..LARGEST_ZOOM).contains(&a.length());
        plausible.then(|| Similarity { a, b: mean.1 - Similarity::product(a, mean.0) })
    }

    fn distance(&self, (p, q): &(DVec2, DVec2)) -> f64 {
        (Similarity::product(self.a, *p) + self.b - *q).length()
    }
}

/// Inliers of the similarity with most of them. Matches are positions over the image diagonal, best
/// first. Deterministic: neighbours in the list form the hypotheses.
pub(super) fn similarity_inliers(matches: &[(DVec2, DVec2)]) -> SimilarityInliers {
    let inliers = |s: &Similarity| -> Vec<(DVec2, DVec2)> {
        matches.iter().filter(|m| s.distance(m) < AGREES).copied().collect()
    };
    let mut best: Vec<(DVec2, DVec2)> = Vec::new();
    // Six pairings of each match: at a third of right matches, 200 matches give over a hundred
    // right hypotheses.
    for stride in [1, 2, 3, 5, 8, 13] {
        for (m, n) in matches.iter().zip(matches.iter().skip(stride)) {
            // Closer points determine rotation and scale too poorly.
            if (m.0 - n.0).length() < 0.1 {
                continue;
            }
            let found = Similarity::fit(&[*m, *n]).map(|s| inliers(&s)).unwrap_or_default();
            if found.len() > best.len() {
                best = found;
            }
        }
    }
    let Some(fitted) = (best.len() > 2).then(|| Similarity::fit(&best)).flatten() else {
        return SimilarityInliers::default();
    };
    let mut distances: Vec<f64> = inliers(&fitted).iter().map(|m| fitted.distance(m)).collect();
    SimilarityInliers { matches: distances.len(), parallax: median(&mut distances).unwrap_or(0.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scattered(n: usize, seed: u32) -> Vec<DVec2> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f64 / (1 << 24) as f64
        };
        (0..n).map(|_| DVec2::new(0.8 * next(), 0.6 * next())).collect()
    }

    #[test]
    fn similarity_inliers_rotation_has_no_parallax() {
        let turn = |p: DVec2| DVec2::new(0.1 - 0.8 * p.y, 0.2 + 0.8 * p.x);
        let mut pairs: Vec<_> = scattered(60, 1).into_iter().map(|p| (p, turn(p))).collect();
        pairs.extend(scattered(60, 2).into_iter().zip(scattered(60, 3)));
        let link = similarity_inliers(&pairs);
        // Some of the 60 random matches fall into the circle.
        assert!((60..72).contains(&link.matches) && link.parallax < 0.01, "{link:?}");
    }

    #[test]
    fn similarity_inliers_random_matches_are_few() {
        let pairs: Vec<_> = scattered(60, 2).into_iter().zip(scattered(60, 3)).collect();
        assert!(similarity_inliers(&pairs).matches < 16, "{:?}", similarity_inliers(&pairs));
        assert_eq!(similarity_inliers(&[]), SimilarityInliers::default());
    }

    #[test]
    fn similarity_inliers_measure_parallax() {
        let moved = |(k, p): (usize, DVec2)| (p, p + DVec2::new(if k % 2 == 0 { 0.03 } else { -0.03 }, 0.0));
        let pairs: Vec<_> = scattered(80, 4).into_iter().enumerate().map(moved).collect();
        let link = similarity_inliers(&pairs);
        assert!(link.matches == 80 && (link.parallax - 0.03).abs() < 0.005, "{link:?}");
    }
}
