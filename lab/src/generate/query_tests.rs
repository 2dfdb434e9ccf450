//! Queries on features that know the words exactly: those of generated regions.
use super::regions;
use splatvk::infer::things;
use splatvk::query::presence::*;
use splatvk::query::{TextQuery, field_relevancy};
use splatvk::scene::{Codebook, Image, LanguageField, LevelField};
use splatvk_test_support::embedding::{DIM, text_embedding};

/// A scene that shows some phrases, each as one code with the feature of its text, and a speck of
/// another one.
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
fn what_is_there_is_found_and_what_is_not_is_not() {
    let present = ["red book", "blue mug", "lemon", "wooden table", "green can"];
    let (field, maps) = field(&present, "trombone");
    let pixels = ShownPixels::of(&field, &[&maps]);
    let ask = |text: &str, form: &str| {
        let query = regions::query(text);
        let shown = ShownCodes::new(&pixels, &field, &query.canonicals);
        let rows: Vec<f32> = things::of_form(form).iter().flat_map(|o| text_embedding(o)).collect();
        shown.evidence(&query.embedding, &query.alternatives.colours, &shown.background(&rows)).unwrap()
    };
    for (text, form) in [("red book", "red"), ("blue mug", "blue"), ("lemon", ""), ("green can", "green")] {
        assert_eq!(ask(text, form).presence, Presence::Found, "{text}: {:?}", ask(text, form));
    }
    // A speck is nothing, although its code is the phrase itself.
    assert_ne!(ask("trombone", "").presence, Presence::Found, "{:?}", ask("trombone", ""));
    let absent = ["iguana", "sarcophagus", "zeppelin", "turnip", "bollard", "tuba", "pelmet"];
    let found = absent.iter().filter(|t| ask(t, "").presence == Presence::Found).count();
    assert!(found <= 1, "{:?}", absent.map(|t| (t, ask(t, "").p_value)));
    // A thing that is there in another colour is not found.
    assert_ne!(ask("green mug", "green").presence, Presence::Found, "{:?}", ask("green mug", "green"));
    // Without the same form every red thing would be a red book.
    let (same, plain) = (ask("red trombone", "red").p_value, ask("red trombone", "").p_value);
    assert!(same > FOUND && plain <= FOUND, "{same} {plain}");
}

#[test]
fn nothing_is_said_without_other_things() {
    let (field, maps) = field(&["lemon"], "speck");
    let query = regions::query("lemon");
    let pixels = ShownPixels::of(&field, &[&maps]);
    let shown = ShownCodes::new(&pixels, &field, &query.canonicals);
    assert_eq!(shown.evidence(&query.embedding, &[], &Background::default()), None);
    let nothing = ShownPixels::default();
    let empty = ShownCodes::new(&nothing, &field, &query.canonicals);
    assert_eq!(empty.evidence(&query.embedding, &[], &empty.background(&vec![1.0; 100 * DIM])), None);
}

#[test]
fn a_named_colour_tells_alike_things_apart_where_features_know_it() {
    let phrases = ["yellow brick", "green brick", "lemon"];
    let codebook = Codebook {
        embedding_dim: DIM,
        embeddings: phrases.iter().flat_map(|p| text_embedding(p)).collect(),
        ..Codebook::default()
    };
    let level = LevelField { codebook, ..LevelField::default() };
    let field = LanguageField { levels: vec![level], ..LanguageField::default() };
    let ask = |text: &str| {
        let seeing = regions::query(text);
        let blind = TextQuery { alternatives: Alternatives::default(), ..seeing.clone() };
        [blind, seeing].map(|q| field_relevancy(&field, &q).unwrap().concat())
    };
    let [blind, seeing] = ask("yellow brick");
    assert!(blind[1] > 0.7 && seeing[1] == 0.5, "{blind:?} {seeing:?}");
    assert_eq!(blind[0], seeing[0]);
    // There is no red one: what is alike stays the nearest.
    let [blind, seeing] = ask("red brick");
    assert_eq!(blind, seeing);
}
