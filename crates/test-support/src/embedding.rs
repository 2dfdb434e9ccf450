//! An embedding space made by rule, which imitates that of CLIP on crops of one room.
//!
//! All image features share a large common part, so that two different objects have a cosine near
//! 0.65 and one object from two sides 0.9, while an image and its phrase reach about 0.25. Every
//! word has a fixed direction, so that phrases with a common word are alike ("red can", "red
//! book"), and every phrase has an embedding.
use splatvk_types::math::Random;

/// Length of an embedding, that of CLIP ViT-B/16.
pub const DIM: usize = 512;

/// Length of the part that an image feature has in common with its phrase; the common part of all
/// images has length 1.
pub const PHRASE_SHARE: f32 = 0.6;

/// A direction that belongs to a name.
fn direction(name: &str) -> Vec<f32> {
    // FNV-1a: stable across platforms and releases.
    let hash =
        name.bytes().fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    let mut random = Random::new(hash);
    let mut v: Vec<f32> = (0..DIM).map(|_| random.normal() as f32).collect();
    normalise(&mut v);
    v
}

fn add(to: &mut [f32], v: &[f32], weight: f32) {
    to.iter_mut().zip(v).for_each(|(a, b)| *a += weight * b);
}

/// Direction of a phrase: the sum of those of its words, the last one 1.5 times.
fn phrase_direction(phrase: &str) -> Vec<f32> {
    let words: Vec<String> = phrase.to_lowercase().split_whitespace().map(str::to_owned).collect();
    let mut sum = vec![0.0; DIM];
    for (k, word) in words.iter().enumerate() {
        add(&mut sum, &direction(&format!("word {word}")), if k + 1 == words.len() { 1.5 } else { 1.0 });
    }
    normalise(&mut sum);
    sum
}

/// Unit embedding of any text.
pub fn text_embedding(phrase: &str) -> Vec<f32> {
    let mut sum = direction("every text");
    add(&mut sum, &phrase_direction(phrase), PHRASE_SHARE);
    normalise(&mut sum);
    sum
}

/// Unit feature of an image region: its phrase by `share`, and directions of its own.
pub fn region_feature(
    phrase: &str,
    share: f32,
    own: &[(&str, f32)],
    noise: f32,
    random: &mut Random,
) -> Vec<f32> {
    let mut sum = direction("every image");
    add(&mut sum, &phrase_direction(phrase), share);
    for (name, weight) in own {
        add(&mut sum, &direction(name), *weight);
    }
    let mut v: Vec<f32> = (0..DIM).map(|_| random.normal() as f32).collect();
    normalise(&mut v);
    add(&mut sum, &v, noise);
    normalise(&mut sum);
    sum
}

/// Scales a vector to length 1.
fn normalise(v: &mut [f32]) {
    let scale = 1.0 / v.iter().map(|v| v * v).sum::<f32>().sqrt();
    v.iter_mut().for_each(|v| *v *= scale);
}
