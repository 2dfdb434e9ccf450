//! How many pixels of the photos every splat covers. Splats without any are guesses: a surface
//! continued beyond the photos' borders or behind a nearer one, or the inside of a thing.
use super::Splats;

/// Splats that cover less of the photos than this, in pixels, are unseen: they leave no trace in
/// any photo. Below this bound a splat also starts without a feature
/// (docs/internals/method.md#lifting).
const MIN_PIXELS: f32 = 0.05;

/// Blending weight of every splat in the photos; empty where unknown, as for a bare file of
/// Gaussians.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Seen {
    /// [N] pixels: blending weights, summed over the pixels of all photos.
    pub pixels: Vec<f32>,
}

impl Seen {
    /// Whether no photo shows a splat; false where unknown.
    pub fn is_unseen(&self, splat: usize) -> bool {
        self.pixels.get(splat).is_some_and(|p| *p < MIN_PIXELS)
    }

    /// Number of splats that no photo shows.
    pub fn unseen(&self) -> usize {
        (0..self.pixels.len()).filter(|i| self.is_unseen(*i)).count()
    }

    /// Rows of the splats that some photo shows.
    pub fn rows(&self, splats: &Splats) -> Vec<usize> {
        (0..splats.len()).filter(|i| !self.is_unseen(*i)).collect()
    }

    /// Indices of the `most` splats with the largest summed blending weight over the photos;
    /// ascending.
    pub fn most_shown(&self, splats: &Splats, most: usize) -> Vec<usize> {
        let mut rows = self.rows(splats);
        let pixels = |i: usize| self.pixels.get(i).copied().unwrap_or(0.0);
        rows.sort_by(|a, b| pixels(*b).total_cmp(&pixels(*a)));
        rows.truncate(most);
        rows.sort_unstable();
        rows
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_coverage_is_not_unseen() {
        let splats = Splats { means: vec![[0.0; 3]; 3], ..Splats::default() };
        let seen = Seen { pixels: vec![3.0, 0.01, 0.0] };
        assert_eq!((seen.unseen(), seen.rows(&splats)), (2, vec![0]));
        assert_eq!((Seen::default().unseen(), Seen::default().rows(&splats)), (0, vec![0, 1, 2]));
    }

    #[test]
    fn most_shown_keeps_largest_weights() {
        let splats = Splats { means: vec![[0.0; 3]; 4], ..Splats::default() };
        let seen = Seen { pixels: vec![0.5, 3.0, 0.0, 1.0] };
        assert_eq!(seen.most_shown(&splats, 2), [1, 3]);
        assert_eq!(seen.most_shown(&splats, 9), [0, 1, 3]);
    }
}
