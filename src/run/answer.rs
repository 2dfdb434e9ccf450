//! The answer of a scene to one text: presence, instances with their positions, and the result in
//! every view.
use super::concepts::ConceptFindings;
use super::view::DecodedFrame;
use crate::Result;
use crate::pass::RenderedFrame;
use crate::query::frame::FrameSearch;
use crate::query::highlight::{Highlight, highlight};
use crate::query::instances::{Instance, Places, Visible};
use crate::query::maps::CodeMaps;
use crate::query::phrasing::Reading;
use crate::query::presence::{Background, Evidence, Presence, ShownCodes, ShownPixels};
use crate::query::select::{Selection, select};
use crate::query::{self, CanonicalCosines, QueryOptions, QueryResult, TextQuery};
use crate::report::viewer::ShownAnswer;
use crate::scene::{Camera, LanguageField, Splats, World};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::borrow::Cow;
use std::sync::{Arc, OnceLock};

/// Query data of a scene, prepared once.
pub struct Prepared {
    /// Positions of the splats.
    places: Places,
    /// Codes that the photos' cameras show.
    pub(super) shown: ShownPixels,
    /// Cosines of the codes to the canonical phrases of the first query.
    cosines: OnceLock<CanonicalCosines>,
}

/// The answers to one text: of the scene, and one per view.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Answers {
    /// The text of the query.
    pub text: String,
    /// The understood part of the text.
    pub reading: Reading,
    /// Result per view. Without a find the mask is empty; relevancy and location are those of the
    /// nearest code.
    pub views: Vec<QueryResult>,
    /// Whether the scene contains the subject of the text; `None` if the text model has too few
    /// texts to decide.
    pub presence: Option<Presence>,
    /// Share of other things that fit the scene at least as well, in (0, 1]; `None` like
    /// `presence`.
    pub p_value: Option<f32>,
    /// Agreement of the photos on the answer, 0 to 1 (docs/internals/method.md#reliability). `None`
    /// if it is unknown, or if there is no answer.
    pub reliability: Option<f64>,
    /// `reliability` of the part that each view shows.
    pub view_reliability: Vec<Option<f64>>,
    /// Splats of the answer, independent of the views; none for an absent text, nor for an unknown
    /// one that fits nothing.
    pub selection: Selection,
    /// Things of the answer, largest first; none for an absent text.
    pub instances: Vec<Instance>,
    /// Highlighting in the scene as a whole.
    pub highlight: Highlight,
    /// Whether every text has a mask ([`QueryOptions::published`]).
    pub published: bool,
    /// Findings of the network that looked at the photos; `None` where the scene's language answers.
    pub concepts: Option<ConceptFindings>,
}

impl Answers {
    /// The answer for the interactive view.
    pub fn shown(&self) -> ShownAnswer<'_> {
        ShownAnswer {
            text: &self.text,
            found: self.found(),
            views: self.views.len(),
            presence: self.presence,
            verdict: self.verdict(),
            notes: self.remarks(),
            highlight: &self.highlight,
        }
    }

    /// Number of views in which the text was found.
    pub fn found(&self) -> usize {
        self.views.iter().filter(|v| v.found).count()
    }

    /// The answer in a few words.
    pub fn verdict(&self) -> String {
        if self.published {
            let (masks, views) = (self.found(), self.views.len());
            return format!("a mask in {masks} of {views} photos; presence is not judged");
        }
        verdict(self.presence, &self.reading, self.found(), self.views.len())
    }

    /// The verdict, with the parts of the text that are not understood.
    pub fn sentence(&self) -> String {
        std::iter::once(self.verdict()).chain(self.remarks()).collect::<Vec<_>>().join("; ")
    }

    /// Notes that the verdict does not contain.
    pub fn remarks(&self) -> Vec<String> {
        self.reading.notes().into_iter().chain(self.concepts.as_ref().map(ConceptFindings::note)).collect()
    }

    /// Record of the text and its instances, as in `query --json` and run.json; `views` are the
    /// names of the views.
    pub fn record(&self, views: &[String], world: &World) -> Value {
        let metres = world.scale.as_ref().map(|s| s.metres_per_unit);
        let instances: Vec<Value> = self.instances.iter().map(|i| instance_json(i, views, metres)).collect();
        let mut record = json!({
            "text": self.text, "presence": self.presence, "p_value": self.p_value, "reliability": self.reliability,
            "phrasing": self.reading.phrasing, "vocabulary": self.reading.vocabulary, "instances": instances,
        });
        if let Some(concepts) = &self.concepts {
            record["concepts"] = concepts.record();
        }
        record
    }
}

fn instance_json(i: &Instance, views: &[String], metres_per_unit: Option<f64>) -> Value {
    let pixels: serde_json::Map<String, Value> =
        views.iter().zip(&i.pixels).map(|(name, pixel)| (name.clone(), json!(pixel))).collect();
    let mut entry = placement_json(i, 1.0);
    entry["metres"] = metres_per_unit.map_or(Value::Null, |unit| placement_json(i, unit));
    entry["splats"] = i.splats.len().into();
    entry["share"] = i.share.into();
    entry["reliability"] = json!(i.reliability);
    entry["pixels"] = pixels.into();
    entry
}

/// Centre and boxes of an instance in units of `1 / unit` scene units.
fn placement_json(i: &Instance, unit: f64) -> Value {
    let oriented = &i.oriented;
    let axes: Vec<_> = oriented.axes.iter().map(|axis| axis.to_array()).collect();
    json!({
        "centre": (i.centre * unit).to_array(),
        "box": { "min": (i.bounds[0] * unit).to_array(), "max": (i.bounds[1] * unit).to_array() },
        "oriented_box": {
            "centre": (oriented.centre * unit).to_array(), "axes": axes, "size": (oriented.size * unit).to_array(),
        },
    })
}

/// An answer in a few words: "found in 3 of 4 photos".
pub fn verdict(presence: Option<Presence>, reading: &Reading, found: usize, views: usize) -> String {
    match presence {
        _ if reading.is_unknown() && found == 0 => "the built-in words do not know it".to_owned(),
        _ if reading.is_unknown() => {
            format!("the built-in words do not know it; a guess in {found} of {views} photos")
        }
        Some(Presence::Absent) => "no sign of it".to_owned(),
        Some(Presence::Unsure) => format!("unsure; if it is here, in {found} of {views} photos"),
        Some(Presence::Found) | None => format!("found in {found} of {views} photos"),
    }
}

/// Things of a selection with their pixels in views, and the reliability of the parts that the views
/// show.
pub(super) fn things(
    places: &Places,
    selection: &Selection,
    (cameras, frames): (&[Camera], &[&RenderedFrame]),
) -> (Vec<Instance>, Vec<Option<f64>>) {
    let pairs = cameras.par_iter().zip(frames);
    let (visible, mut instances) = rayon::join(
        || -> Vec<Visible> { pairs.map(|(c, f)| places.visible(&selection.splats, c, &f.depth)).collect() },
        || match selection.found {
            true => places.instances(&selection.splats, selection.level),
            false => Vec::new(),
        },
    );
    instances.par_iter_mut().for_each(|instance| {
        instance.pixels = visible.iter().map(|v| places.pixel(instance, v)).collect();
    });
    let reliability = |v: &Visible| places.reliability(&v.splats(), selection.level);
    (instances, visible.par_iter().map(reliability).collect())
}

impl Prepared {
    /// Prepares a scene with the codes that its own cameras show.
    pub fn new(splats: &Splats, field: &LanguageField, shown: ShownPixels) -> Prepared {
        Prepared { places: Places::of(splats, field), shown, cosines: OnceLock::new() }
    }

    /// Prepares a scene with the frames of its own cameras.
    pub fn of_frames(splats: &Splats, field: &LanguageField, frames: &[DecodedFrame]) -> Prepared {
        Prepared::new(splats, field, ShownPixels::of(field, frames.iter().map(|f| f.maps.as_ref())))
    }

    /// Cosines of the codes to canonical phrases; those of a scene's queries are all the same.
    fn cosines(&self, field: &LanguageField, canonicals: &[f32]) -> Cow<'_, CanonicalCosines> {
        let known = self.cosines.get_or_init(|| CanonicalCosines::new(field, canonicals));
        match known.is_of(canonicals) {
            true => Cow::Borrowed(known),
            false => Cow::Owned(CanonicalCosines::new(field, canonicals)),
        }
    }

    /// Evidence for the presence of a text; `background` caches the fit of the other things of its
    /// form to this scene.
    fn evidence(
        &self,
        field: &LanguageField,
        query: &TextQuery,
        cosines: &CanonicalCosines,
        background: &mut Option<Background>,
    ) -> Option<Evidence> {
        let shown = ShownCodes::new(&self.shown, field, cosines);
        let background = background.get_or_insert_with(|| shown.background(&query.alternatives.things));
        let evidence = shown.evidence(&query.embedding, &query.alternatives, background);
        evidence.map(|e| if query.reading.is_doubtful() { e.in_doubt() } else { e })
    }

    /// Splats of the answer to a text; none if it does not fit the scene.
    fn select(&self, relevancy: &[Vec<f32>], fits: bool, options: &QueryOptions) -> Selection {
        let mut selection = select(&self.places, relevancy, options);
        if !fits {
            selection.splats.clear();
            selection.found = false;
        }
        selection
    }

    /// Things of a selection with their pixels in views, and the reliability of the parts that the
    /// views show.
    fn things(
        &self,
        selection: &Selection,
        (cameras, frames): (&[Camera], &[DecodedFrame]),
    ) -> (Vec<Instance>, Vec<Option<f64>>) {
        let rendered: Vec<&RenderedFrame> = frames.iter().map(|f| &f.rendered).collect();
        things(&self.places, selection, (cameras, &rendered))
    }

    /// Answers a text in views, which need not be the scene's own. `search` has the maps of these
    /// views on a device.
    pub fn answer(
        &self,
        field: &LanguageField,
        views: (&[Camera], &[DecodedFrame]),
        query: &TextQuery,
        options: &QueryOptions,
        background: &mut Option<Background>,
        search: Option<&mut dyn FrameSearch>,
    ) -> Result<Answers> {
        let cosines = self.cosines(field, &query.canonicals);
        let relevancy = cosines.relevancy(field, query, options)?;
        let evidence = match options.published {
            true => None,
            false => self.evidence(field, query, &cosines, background),
        };
        // Without evidence an unclear text is unsure.
        let doubt = query.reading.is_doubtful().then_some(Presence::Unsure);
        let fits = evidence.is_none_or(|e| e.presence != Presence::Absent);
        let presence = match query.reading.is_unknown() {
            true => doubt,
            false => evidence.map(|e| e.presence).or(doubt),
        };
        let selection = self.select(&relevancy, fits, options);
        let maps: Vec<Arc<CodeMaps>> = views.1.iter().map(|f| f.maps.clone()).collect();
        let mut answered = query::answer_all(&maps, &relevancy, options, search)?;
        let (instances, view_reliability) = self.things(&selection, views);
        for view in answered.iter_mut().filter(|v| !fits || !v.found) {
            view.mark_not_found();
        }
        let highlight = highlight(&maps, relevancy, &answered);
        Ok(Answers {
            text: query.text.clone(),
            reading: query.reading.clone(),
            views: answered,
            presence,
            p_value: evidence.map(|e| e.p_value),
            reliability: self.places.reliability(&selection.splats, selection.level),
            view_reliability,
            selection,
            instances,
            highlight,
            published: options.published,
            concepts: None,
        })
    }
}

#[cfg(test)]
mod tests {
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
        let codes = Image {
            width: SIZE,
            height: SIZE,
            data: pixels().map(|(x, y)| phrase_at(x, y) as i32).collect(),
        };
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
            assert!(
                page["presence"] == "absent" && page["found"] == 0 && page["codes"] == json!([]),
                "{page}"
            );
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
            (number(&record["reliability"]) - 0.5).abs() < 1e-9
                && balls.view_reliability == [balls.reliability]
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
}
