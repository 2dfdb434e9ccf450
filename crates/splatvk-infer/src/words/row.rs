//! Layout of a row of `words`: meaning, classes, colour, stuff, and the rest of a text.
use crate::classify::CLASSES;
use crate::{colour, stuff, text};

pub(super) const MEANING_AT: usize = 0;
pub(super) const CLASSES_AT: usize = text::DIM;
pub(super) const COLOUR_AT: usize = CLASSES_AT + CLASSES;
pub(super) const STUFF_AT: usize = COLOUR_AT + colour::COUNT;
/// Names of the embedding spaces with their lengths, today's first.
pub(super) const SPACES: [(&str, usize); 2] =
    [("words-2", STUFF_AT + stuff::COUNT + 1), ("words-1", STUFF_AT + 1)];

/// Shares of the squared length: meaning, classes, colour. Measured on breakfast (40 phrase–view
/// pairs, perfect masks): 36 to 39 right for meaning 0.1–0.25, colour 0.3; 28 without colour; 24
/// without the class block.
pub(super) const SHARES: [f32; 3] = [0.15, 0.55, 0.3];

/// Writes a text's blocks of meaning, classes and stuff.
pub(super) fn fill_text(row: &mut [f32], meaning: &[f32], weights: &[f32]) {
    let known: f32 = weights.iter().sum();
    let (classes, kinds) = weights.split_at(CLASSES);
    fill(row, MEANING_AT, SHARES[0] * known, meaning.iter().copied());
    fill(row, CLASSES_AT, SHARES[1], classes.iter().map(|w| w.sqrt()));
    fill(stuff_of(row), 0, SHARES[1], kinds.iter().map(|w| w.sqrt()));
}

/// The stuff block of a row; empty in a row of `words-1`.
pub(super) fn stuff_of(row: &mut [f32]) -> &mut [f32] {
    let rest = row.len() - 1;
    &mut row[STUFF_AT..rest]
}

/// Probability of a class or kind of stuff in a region's row.
pub(super) fn probability(region: &[f32], class: usize) -> f32 {
    let at = if class < CLASSES { CLASSES_AT + class } else { STUFF_AT + class - CLASSES };
    // The last coordinate is no class.
    let root = if at + 1 < region.len() { region[at] } else { 0.0 };
    root * root / SHARES[1]
}

/// Gives a region's row the kinds of surface that it may be, with their names [8, 384]: the classes
/// have the rest of the posterior.
pub(super) fn add_stuff(row: &mut [f32], kinds: &[f32; stuff::COUNT], names: &[f32]) {
    let things = 1.0 - kinds.iter().sum::<f32>().min(1.0);
    let length = |block: &[f32]| block.iter().map(|v| v * v).sum::<f32>().sqrt();
    let classes = length(&row[CLASSES_AT..COLOUR_AT]);
    if classes == 0.0 {
        return;
    }
    row[CLASSES_AT..COLOUR_AT].iter_mut().for_each(|v| *v *= things.sqrt());
    fill(stuff_of(row), 0, classes * classes, kinds.iter().map(|p| p.sqrt()));
    let meaning = &mut row[MEANING_AT..CLASSES_AT];
    let before = length(meaning);
    meaning.iter_mut().for_each(|v| *v *= things / before.max(f32::MIN_POSITIVE));
    for (p, name) in kinds.iter().zip(names.chunks_exact(text::DIM)) {
        meaning.iter_mut().zip(name).for_each(|(m, n)| *m += p * n);
    }
    let after = length(meaning).max(f32::MIN_POSITIVE);
    meaning.iter_mut().for_each(|v| *v *= before / after);
}

/// Writes a unit block with `share` of the squared length.
pub(super) fn fill(row: &mut [f32], start: usize, share: f32, values: impl IntoIterator<Item = f32>) {
    row[start..].iter_mut().zip(values).for_each(|(r, v)| *r = share.sqrt() * v);
}
