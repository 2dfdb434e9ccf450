//! Queries on features that are the exact text embeddings: those of generated regions.
use super::regions;
use splatvk::infer::things;
use splatvk::query::maps::CodeMaps;
use splatvk::query::presence::*;
use splatvk::query::{CanonicalCosines, QueryOptions, TextQuery};
use splatvk::scene::{Codebook, Image, LanguageField, LevelField};
use splatvk_test_support::embedding::{DIM, text_embedding};

/// A language field and a rendered label map that show each phrase as one code with the embedding
/// of its text, and `speck` in a single pixel.
fn field(phrases: &[&str], speck: &str) -> (LanguageField, Vec<Image<i32>>) {
    let dim = DIM;
    let embeddings: Vec<f32> = phrases.iter().chain([&speck]).flat_map(|p| text_embedding(p)).collect();
    let count = phrases.len() + 1;
    let codebook = Codebook {
        embedding_dim: dim,
        code_dim: 3,
        embeddings,
        codes: vec![0.0; 3 * count],
        ..Codebook::default()
    };
    let mut map = Image::filled(100, 100, 0);
    map.data.iter_mut().enumerate().for_each(|(i, k)| *k = (i % phrases.len()) as i32);
    map.data[0] = phrases.len() as i32;
    let level = LevelField { codebook, ..LevelField::default() };
    (LanguageField { levels: vec![level], ..LanguageField::default() }, vec![map])
}

#[test]
fn evidence_separates_present_from_absent() {
    let present = ["red book", "blue mug", "lemon", "wooden table", "green can"];
    let (field, maps) = field(&present, "trombone");
    let pixels = ShownPixels::of(&field, [&CodeMaps::new(&maps).unwrap()]);
    let evidence = |text: &str, form: &str| {
        let query = regions::query(text);
        let shown = ShownCodes::new(&pixels, &field, &CanonicalCosines::new(&field, &query.canonicals));
        let rows: Vec<f32> = things::of_form(form).iter().flat_map(|o| text_embedding(o)).collect();
        shown.evidence(&query.embedding, &query.alternatives, &shown.background(&rows)).unwrap()
    };
    for (text, form) in [("red book", "red"), ("blue mug", "blue"), ("lemon", ""), ("green can", "green")] {
        assert_eq!(evidence(text, form).presence, Presence::Found, "{text}: {:?}", evidence(text, form));
    }
    // A single pixel is not found, although its code is the phrase itself.
    assert_ne!(evidence("trombone", "").presence, Presence::Found, "{:?}", evidence("trombone", ""));
    let absent = ["iguana", "sarcophagus", "zeppelin", "turnip", "bollard", "tuba", "pelmet"];
    let found = absent.iter().filter(|t| evidence(t, "").presence == Presence::Found).count();
    assert!(found <= 1, "{:?}", absent.map(|t| (t, evidence(t, "").p_value)));
    // A thing that is present in another colour is not found.
    let green_mug = evidence("green mug", "green");
    assert_ne!(green_mug.presence, Presence::Found, "{green_mug:?}");
    // Without other things of the same form every red thing would pass as a red book.
    let levels = regions::query("red trombone").alternatives.levels;
    let (same, plain) = (evidence("red trombone", "red").p_value, evidence("red trombone", "").p_value);
    assert!(same > levels.found && plain <= levels.found, "{same} {plain}");
}

#[test]
fn evidence_needs_pixels_and_background() {
    let (field, maps) = field(&["lemon"], "speck");
    let query = regions::query("lemon");
    let pixels = ShownPixels::of(&field, [&CodeMaps::new(&maps).unwrap()]);
    let shown = ShownCodes::new(&pixels, &field, &CanonicalCosines::new(&field, &query.canonicals));
    assert_eq!(shown.evidence(&query.embedding, &query.alternatives, &Background::default()), None);
    let nothing = ShownPixels::default();
    let empty = ShownCodes::new(&nothing, &field, &CanonicalCosines::new(&field, &query.canonicals));
    assert_eq!(
        empty.evidence(&query.embedding, &query.alternatives, &empty.background(&vec![1.0; 100 * DIM])),
        None
    );
}

#[test]
fn named_colour_separates_similar_things() {
    let phrases = ["yellow brick", "green brick", "lemon"];
    let codebook = Codebook {
        embedding_dim: DIM,
        embeddings: phrases.iter().flat_map(|p| text_embedding(p)).collect(),
        ..Codebook::default()
    };
    let level = LevelField { codebook, ..LevelField::default() };
    let field = LanguageField { levels: vec![level], ..LanguageField::default() };
    // Relevancy without and with the same thing in other colours as alternatives.
    let relevancies = |text: &str, published: bool| {
        let options = QueryOptions { published, ..QueryOptions::default() };
        let with = regions::query(text);
        let without = TextQuery { alternatives: Alternatives::default(), ..with.clone() };
        [without, with].map(|q| {
            CanonicalCosines::new(&field, &q.canonicals).relevancy(&field, &q, &options).unwrap().concat()
        })
    };
    let [without, with] = relevancies("yellow brick", false);
    assert!(without[1] > 0.7 && with[1] == 0.5, "{without:?} {with:?}");
    assert_eq!(without[0], with[0]);
    // No brick is red: bricks of other colours keep their relevancy.
    let [without, with] = relevancies("red brick", false);
    assert_eq!(without, with);
    // Published protocols have no rule of colours.
    let [without, with] = relevancies("yellow brick", true);
    assert_eq!(without, with);
}
