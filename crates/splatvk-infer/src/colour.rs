//! The eleven basic colour terms of English (Berlin & Kay 1969) in pixels and texts.
use std::sync::OnceLock;

/// Number of terms.
pub const COUNT: usize = 11;

/// Term with other spellings and synonyms, and a typical sRGB colour.
const TERMS: [(&[&str], [u8; 3]); COUNT] = [
    (&["black"], [0, 0, 0]),
    (&["white"], [255, 255, 255]),
    (&["grey", "gray"], [128, 128, 128]),
    (&["red"], [200, 20, 20]),
    (&["orange"], [255, 140, 0]),
    (&["yellow"], [250, 220, 30]),
    (&["green"], [30, 140, 40]),
    (&["blue"], [30, 70, 190]),
    (&["purple", "violet"], [120, 40, 140]),
    (&["pink"], [250, 160, 180]),
    (&["brown"], [110, 65, 30]),
];

/// Standard deviation of a term in Lab: neighbouring colours of [`TERMS`] are 40 to 80 apart.
const SPREAD: f32 = 20.0;

/// CIE L*a*b* (D65) of an sRGB colour in [0, 1].
pub fn lab(rgb: [f32; 3]) -> [f32; 3] {
    let linear = rgb.map(|v| if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) });
    let dot = |m: [f32; 3]| m[0] * linear[0] + m[1] * linear[1] + m[2] * linear[2];
    let x = dot([0.412_456_4, 0.357_576_1, 0.180_437_5]) / 0.950_47;
    let y = dot([0.212_672_9, 0.715_152_2, 0.072_175]);
    let z = dot([0.019_333_9, 0.119_192, 0.950_304_1]) / 1.088_83;
    let f = |t: f32| if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 };
    [116.0 * f(y) - 16.0, 500.0 * (f(x) - f(y)), 200.0 * (f(y) - f(z))]
}

/// Probability of each term for a colour; sums to 1.
pub fn terms_of(rgb: [f32; 3]) -> [f32; COUNT] {
    static MIDDLES: OnceLock<[[f32; 3]; COUNT]> = OnceLock::new();
    let middles = MIDDLES.get_or_init(|| TERMS.map(|(_, rgb)| lab(rgb.map(|v| f32::from(v) / 255.0))));
    let here = lab(rgb);
    let distance = |m: &[f32; 3]| m.iter().zip(here).map(|(a, b)| (a - b).powi(2)).sum::<f32>();
    let exponents = middles.each_ref().map(|m| -distance(m) / (2.0 * SPREAD * SPREAD));
    let most = exponents.iter().copied().fold(f32::MIN, f32::max);
    let weights = exponents.map(|e| (e - most).exp());
    let total: f32 = weights.iter().sum();
    weights.map(|w| w / total)
}

/// [`terms_of`] the centre of the colour's cell in a table of 32³ cells: at most 4/255 off, and
/// fast enough for every pixel.
pub fn terms_near(rgb: [f32; 3]) -> &'static [f32; COUNT] {
    const CELLS: usize = 32;
    static TABLE: OnceLock<Vec<[f32; COUNT]>> = OnceLock::new();
    let middle = |i: usize| (i as f32 + 0.5) / CELLS as f32;
    let cell = |i: usize| terms_of([i / CELLS / CELLS, i / CELLS % CELLS, i % CELLS].map(middle));
    let table = TABLE.get_or_init(|| (0..CELLS.pow(3)).map(cell).collect());
    let [r, g, b] = rgb.map(|v| ((v * CELLS as f32).max(0.0) as usize).min(CELLS - 1));
    &table[(r * CELLS + g) * CELLS + b]
}

/// The terms in a text, evenly weighted; `None` if it names no colour.
pub fn terms_in(text: &str) -> Option<[f32; COUNT]> {
    let text = text.to_lowercase();
    let words: Vec<&str> = text.split(|c: char| !c.is_alphanumeric()).collect();
    let named = TERMS.each_ref().map(|(names, _)| names.iter().any(|n| words.contains(n)));
    let count = named.iter().filter(|s| **s).count() as f32;
    (count > 0.0).then(|| named.map(|s| if s { 1.0 / count } else { 0.0 }))
}

/// The eleven terms.
pub fn names() -> impl Iterator<Item = &'static str> {
    TERMS.iter().map(|(names, _)| names[0])
}

/// The terms without `word` among their spellings.
pub fn names_besides(word: &str) -> impl Iterator<Item = &'static str> {
    TERMS.iter().filter(move |(names, _)| !names.contains(&word)).map(|(names, _)| names[0])
}

/// The colour words of a text in its spelling, lower case.
pub fn words_in(text: &str) -> Vec<String> {
    let lower = text.to_lowercase();
    let words = lower.split(|c: char| !c.is_alphanumeric());
    words.filter(|w| TERMS.iter().any(|(names, _)| names.contains(w))).map(str::to_owned).collect()
}

/// A text without its colour words; the whole text if it has no other words.
pub fn without(text: &str) -> String {
    let is_colour = |w: &&str| TERMS.iter().any(|(names, _)| names.contains(&w.to_lowercase().as_str()));
    let rest: Vec<&str> = text.split_whitespace().filter(|w| !is_colour(w)).collect();
    if rest.is_empty() { text.to_owned() } else { rest.join(" ") }
}

/// The term nearest to a vector of [`direction`]'s space, and their cosine.
pub fn nearest_term(towards: &[f32]) -> (&'static str, f32) {
    let cosine = |i: usize| {
        let axis = std::array::from_fn(|k| if k == i { 1.0 } else { 0.0 });
        direction(&axis).iter().zip(towards).map(|(a, b)| a * b).sum::<f32>()
    };
    let best = (0..COUNT).map(|i| (i, cosine(i))).max_by(|a, b| a.1.total_cmp(&b.1));
    best.map_or(("", 0.0), |(i, cosine)| (TERMS[i].0[0], cosine))
}

/// Distribution over terms → direction: square roots (so that a dot product is a Bhattacharyya
/// coefficient) less their mean, scaled to unit length. An even distribution gives zero.
pub fn direction(distribution: &[f32; COUNT]) -> [f32; COUNT] {
    let roots = distribution.map(f32::sqrt);
    let mean = roots.iter().sum::<f32>() / COUNT as f32;
    let mut centred = roots.map(|r| r - mean);
    let norm = centred.iter().map(|c| c * c).sum::<f32>().sqrt();
    // Below this the distribution is even to within rounding.
    if norm < 1e-4 {
        return [0.0; COUNT];
    }
    centred.iter_mut().for_each(|c| *c /= norm);
    centred
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lab_agrees_with_published_values() {
        // Lindbloom's calculator, D65, sRGB.
        for (rgb, want) in [
            ([1.0, 1.0, 1.0], [100.0, 0.0, 0.0]),
            ([1.0, 0.0, 0.0], [53.24, 80.09, 67.2]),
            ([0.0, 0.0, 1.0], [32.3, 79.19, -107.86]),
        ] {
            for (got, want) in lab(rgb).into_iter().zip(want) {
                assert!((got - want).abs() < 0.05, "{rgb:?}: {:?}", lab(rgb));
            }
        }
    }

    #[test]
    fn colour_terms_of_pixels_and_texts() {
        let name = |rgb: [u8; 3]| {
            let terms = terms_of(rgb.map(|v| f32::from(v) / 255.0));
            let best = (0..COUNT).max_by(|a, b| terms[*a].total_cmp(&terms[*b])).unwrap();
            TERMS[best].0[0]
        };
        for (rgb, want) in [
            ([250, 235, 60], "yellow"),
            ([160, 20, 30], "red"),
            ([60, 90, 200], "blue"),
            ([90, 60, 35], "brown"),
            ([20, 20, 22], "black"),
            ([150, 150, 145], "grey"),
        ] {
            assert_eq!(name(rgb), want, "{rgb:?}");
        }
        for rgb in [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.2, 0.5, 0.9]] {
            let (exact, near) = (terms_of(rgb), terms_near(rgb));
            assert!(exact.iter().zip(near).all(|(a, b)| (a - b).abs() < 0.1), "{exact:?} {near:?}");
        }
        assert!(terms_in("a reddish thing").is_none());
        assert_eq!(["Blue mug", "orange", "redwood"].map(without), ["mug", "orange", "redwood"]);
        assert_eq!(terms_in("Gray-green stone").unwrap().iter().filter(|t| **t == 0.5).count(), 2);
        assert_eq!(direction(&[1.0 / COUNT as f32; COUNT]), [0.0; COUNT]);
    }
}
