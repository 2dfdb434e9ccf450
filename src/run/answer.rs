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
    /// Findings of the network that looked at the photos; `None` where the scene's language
    /// answers.
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
pub(super) fn placement_json(i: &Instance, unit: f64) -> Value {
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

/// Things of a selection with their pixels in views, and the reliability of the parts that the
/// views show.
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

    /// Positions and codes of the splats.
    pub(super) fn places(&self) -> &Places {
        &self.places
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
mod tests;
