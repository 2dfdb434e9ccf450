use super::*;
use crate::infer::PresenceLevels;
use crate::infer::things;
use crate::query::CANONICAL_PHRASES;
use crate::query::phrasing::{Phrasing, Vocabulary};
use crate::query::presence::Alternatives;
use crate::scene::{Codebook, Image, LevelField, Pose, Scale};
use glam::DVec3;
use splatvk_test_support::embedding::{self, text_embedding};
use std::sync::Arc;

/// Side of the square images, pixels.
const SIZE: usize = 100;

/// Phrase index at a pixel of a wall of splats one unit in front of the camera, as wide as its
/// image, with two balls and a lemon in it.
fn phrase_at(x: usize, y: usize) -> usize {
    let within = |cx: i32, cy: i32| (x as i32 - cx).abs() <= 8 && (y as i32 - cy).abs() <= 8;
    match (within(20, 50) || within(80, 50), within(50, 80)) {
        (true, _) => 1,
        (_, true) => 2,
        _ => 0,
    }
}

struct Wall {
    field: LanguageField,
    prepared: Prepared,
    cameras: Vec<Camera>,
    frames: Vec<DecodedFrame>,
    things: Arc<Vec<f32>>,
}

fn wall() -> Wall {
    let phrases = ["plaster wall", "red ball", "lemon"];
    let pixels = || (0..SIZE * SIZE).map(|p| (p % SIZE, p / SIZE));
    let place = |(x, y): (usize, usize)| {
        [(x as f32 + 0.5) / SIZE as f32 - 0.5, (y as f32 + 0.5) / SIZE as f32 - 0.5, 1.0]
    };
    let count = SIZE * SIZE;
    let splats = Splats {
        means: pixels().map(place).collect(),
        log_scales: vec![[(0.5 / SIZE as f32).ln(); 3]; count],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![4.0; count],
        ..Splats::default()
    };
    let unit = |k: usize| (0..3).map(move |c| f32::from(u8::from(c == k)));
    let codebook = Codebook {
        embedding_dim: embedding::DIM,
        code_dim: 3,
        embeddings: phrases.iter().flat_map(|p| text_embedding(p)).collect(),
        codes: (0..3).flat_map(unit).collect(),
        ..Codebook::default()
    };
    let features = pixels().flat_map(|(x, y)| unit(phrase_at(x, y))).collect();
    let reliability = pixels().map(|(x, y)| if phrase_at(x, y) == 2 { 0.25 } else { 0.5 }).collect();
    let level = LevelField { codebook, features, reliability, ..LevelField::default() };
    let field = LanguageField {
        levels: vec![LevelField::default(), LevelField::default(), level],
        space: "test".into(),
    };
    let codes =
        Image { width: SIZE, height: SIZE, data: pixels().map(|(x, y)| phrase_at(x, y) as i32).collect() };
    let none = Image::filled(SIZE, SIZE, -1);
    let mut rendered = RenderedFrame::empty(SIZE, SIZE, 0);
    rendered.depth.data.fill(1.0);
    let frames = vec![DecodedFrame::new(rendered, vec![none.clone(), none, codes], None).unwrap()];
    let (size, focal) = (SIZE as u32, SIZE as f64);
    let cameras = vec![Camera {
        name: "a".into(),
        width: size,
        height: size,
        fx: focal,
        fy: focal,
        cx: 0.5 * focal,
        cy: 0.5 * focal,
        pose: Pose { rotation: glam::DMat3::IDENTITY, translation: DVec3::ZERO },
    }];
    let prepared = Prepared::of_frames(&splats, &field, &frames);
    let things = things::of_form("").iter().flat_map(|t| text_embedding(t)).collect();
    Wall { field, prepared, cameras, frames, things: Arc::new(things) }
}

/// A query in the rule-based embedding space of the tests.
fn rule_query(text: &str) -> TextQuery {
    TextQuery {
        text: text.to_owned(),
        embedding: text_embedding(text),
        canonicals: CANONICAL_PHRASES.iter().flat_map(|c| text_embedding(c)).collect(),
        ..TextQuery::default()
    }
}

impl Wall {
    fn ask(&self, text: &str, reading: Reading) -> Answers {
        self.ask_with(text, reading, &QueryOptions::default())
    }

    fn ask_with(&self, text: &str, reading: Reading, options: &QueryOptions) -> Answers {
        let alternatives = Alternatives {
            things: self.things.clone(),
            colours: Vec::new(),
            levels: PresenceLevels::default(),
        };
        let query = TextQuery { alternatives, reading, ..rule_query(text) };
        let views = (&self.cameras[..], &self.frames[..]);
        self.prepared.answer(&self.field, views, &query, options, &mut None, None).unwrap()
    }
}

/// The protocols of LERF and LangSplat score a mask for every text.
#[test]
fn published_answer_has_mask_for_absent_text() {
    let mut wall = wall();
    wall.things = Arc::new(text_embedding("lemon").repeat(100));
    let own = wall.ask("lemon", Reading::default());
    assert_eq!((own.presence, own.found()), (Some(Presence::Absent), 0));
    for compat in crate::run::compat::COMPATS {
        let options = crate::run::compat::query_options(Some(compat));
        let a = wall.ask_with("lemon", Reading::default(), &options);
        assert_eq!((a.presence, a.p_value, a.found()), (None, None, 1), "{}", compat.name);
        assert_eq!(a.verdict(), "a mask in 1 of 1 photos; presence is not judged");
        assert!(a.views[0].mask().data.contains(&true) && !a.selection.splats.is_empty());
    }
}

#[test]
fn absent_text_clears_whole_answer() {
    let mut wall = wall();
    // A hundred other things fit every text as well; the codes alone would give a find.
    for text in ["red ball", "lemon"] {
        wall.things = Arc::new(text_embedding(text).repeat(100));
        let a = wall.ask(text, Reading::default());
        assert_eq!(a.presence, Some(Presence::Absent));
        assert!(a.views[0].score > 0.5, "{}", a.views[0].score);
        let view = &a.views[0];
        assert!(!view.found && !view.mask().data.contains(&true) && a.found() == 0);
        assert!(view.relevancy().data.iter().any(|v| *v > 0.0), "the heat stays");
        assert!(a.instances.is_empty() && a.selection.splats.is_empty() && !a.selection.found);
        assert_eq!(a.verdict(), "no sign of it");
        let record = a.record(&["a".into()], &World::default());
        assert!(record["presence"] == "absent" && record["p_value"].as_f64().unwrap() >= 0.75);
        assert_eq!(record["instances"], json!([]));
        let page = a.shown().json();
        assert!(page["presence"] == "absent" && page["found"] == 0 && page["codes"] == json!([]), "{page}");
    }
}

#[test]
fn several_things_give_several_instances() {
    let wall = wall();
    let balls = wall.ask("red ball", Reading::default());
    assert_eq!((balls.presence, balls.instances.len()), (Some(Presence::Found), 2));
    let scale = Scale { metres_per_unit: 2.0, log_sigma: 0.1, stated: Vec::new() };
    let world = World { scale: Some(scale), ..World::default() };
    let record = balls.record(&["a".into()], &world);
    let list = record["instances"].as_array().unwrap();
    let number = |v: &Value| v.as_f64().unwrap();
    for (i, found) in list.iter().enumerate() {
        let x = number(&found["centre"][0]);
        assert!((x.abs() - 0.3).abs() < 0.01 && number(&found["centre"][1]).abs() < 0.01, "{found}");
        assert!((number(&found["metres"]["centre"][0]) - 2.0 * x).abs() < 1e-9);
        let edge = number(&found["box"]["max"][0]) - number(&found["box"]["min"][0]);
        // 17 pixels wide, 2 % of them outside on either side.
        assert!((edge - 0.16).abs() < 0.011 && number(&found["splats"]) == 289.0, "{found}");
        let sizes = [0, 1, 2].map(|k| number(&found["oriented_box"]["size"][k]));
        assert!(sizes[0] > 0.14 && sizes[1] > 0.14 && sizes[2] < 1e-6, "{sizes:?}");
        let pixel = balls.instances[i].pixels[0].unwrap();
        assert!((pixel[0] - 50.0 - 100.0 * x).abs() < 1.5 && (pixel[1] - 50.5).abs() < 1.5, "{pixel:?}");
        assert_eq!(found["pixels"]["a"], json!(pixel));
    }
    assert!(number(&list[0]["centre"][0]) * number(&list[1]["centre"][0]) < 0.0, "one left, one right");
    assert!(
        (number(&record["reliability"]) - 0.5).abs() < 1e-9 && balls.view_reliability == [balls.reliability]
    );
    let lemon = wall.ask("lemon", Reading::default());
    assert!(lemon.instances.len() == 1 && (lemon.instances[0].reliability.unwrap() - 0.25).abs() < 1e-9);
    // An occluded thing is not visible.
    let mut hidden = wall;
    hidden.frames[0].rendered.depth.data.fill(0.5);
    assert_eq!(hidden.ask("lemon", Reading::default()).instances[0].pixels, [None]);
}

fn unknown() -> Vocabulary {
    Vocabulary { known: false, nearest: None, not_english: vec!["Zitrone".into()] }
}

#[test]
fn doubtful_reading_is_unsure_at_most() {
    let wall = wall();
    assert_eq!(wall.ask("lemon", Reading::default()).presence, Some(Presence::Found));
    let cut = Phrasing { answers_for: "lemon".into(), not_understood: "on the plate".into() };
    for (reading, verdict, note) in [
        (
            Reading { phrasing: Some(cut), vocabulary: None },
            "unsure; if it is here, in 1 of 1 photos",
            "answers for “lemon”; “on the plate” is not understood",
        ),
        (
            Reading { phrasing: None, vocabulary: Some(unknown()) },
            "the built-in words do not know it; a guess in 1 of 1 photos",
            "“Zitrone” is not among their English words",
        ),
    ] {
        let a = wall.ask("lemon", reading);
        assert_eq!((a.presence, a.found()), (Some(Presence::Unsure), 1));
        assert_eq!(a.reading.notes(), [note]);
        assert_eq!((a.verdict().as_str(), a.sentence()), (verdict, format!("{verdict}; {note}")));
        assert_eq!(a.shown().json()["notes"], json!([note]));
        let record = a.record(&["a".into()], &World::default());
        let is_cut = record["phrasing"]["not_understood"] == "on the plate";
        assert!(is_cut || record["vocabulary"]["not_english"] == json!(["Zitrone"]), "{record}");
    }
}

#[test]
fn unknown_text_without_fit_is_unsure_and_shows_nothing() {
    let mut wall = wall();
    wall.things = Arc::new(text_embedding("lemon").repeat(100));
    let a = wall.ask("lemon", Reading { phrasing: None, vocabulary: Some(unknown()) });
    assert_eq!((a.presence, a.found(), a.instances.len()), (Some(Presence::Unsure), 0, 0));
    assert_eq!(a.verdict(), "the built-in words do not know it");
    let page = a.shown().json();
    assert!(page["verdict"] == a.verdict() && page["codes"] == json!([]), "{page}");
}
