//! A loaded scene that is kept on the device for queries: what viewers, `splatvk query` and benchmarks call.
use super::view::{DecodedFrame, Viewer};
use crate::gpu::Device;
use crate::infer::{RegionEncoder, things};
use crate::query::highlight::Highlight;
use crate::query::presence::{Alternatives, Background, Evidence, Presence, ShownCodes};
use crate::query::select::{Selection, select};
use crate::query::{self, CANONICAL_PHRASES, QueryOptions, QueryResult, TextQuery};
use crate::report::viewer::{CodeNames, ShownAnswer};
use crate::scene::{Camera, LanguageField, Plane, Splats};
use crate::{Error, Result};
use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;

/// The scene on the device, its code maps in the set views, and the text encoder. A query costs the
/// embedding of its text and a gather and five box filters per camera; nothing is rendered for it.
///
/// ```no_run
/// # fn main() -> splatvk::Result<()> {
/// # use splatvk::{format::scene_dir, gpu::Device, infer::{Registry, words::RegionWords}, run::ask::QueryScene};
/// let scene = scene_dir::load("out/breakfast".as_ref())?;
/// let field = scene.language.ok_or_else(|| splatvk::Error::input("no language"))?;
/// let encoder = Box::new(RegionWords::load(Registry::open(None)?)?);
/// let mut ready = QueryScene::open(&Device::open(None)?, &scene.splats, field, encoder)?;
/// ready.set_views(&scene.cameras)?;
/// let answers = ready.ask("lemon", &Default::default())?;
/// println!("found in {} of {} views", answers.found(), answers.views.len());
/// # Ok(())
/// # }
/// ```
pub struct QueryScene {
    viewer: Viewer,
    field: LanguageField,
    encoder: Box<dyn RegionEncoder>,
    /// [C, D] unit rows of the canonical phrases.
    canonicals: Vec<f32>,
    others: Others,
    /// How well other things fit what the frames show, by the words before them.
    backgrounds: HashMap<String, Background>,
    frames: Vec<DecodedFrame>,
}

/// What texts could have said instead, [N, D], by the words before them.
type Others = HashMap<String, Arc<Vec<f32>>>;

/// One text as a query.
fn as_query(
    text: &str,
    encoder: &mut dyn RegionEncoder,
    canonicals: &[f32],
    others: &mut Others,
) -> Result<TextQuery> {
    let embedding = encoder.embed_texts(&[text])?;
    let things = match others.entry(things::form(text)) {
        Entry::Occupied(known) => known.get().clone(),
        Entry::Vacant(new) => {
            let rows = encoder.others(new.key())?;
            new.insert(Arc::new(rows)).clone()
        }
    };
    let alternatives = Alternatives { things, colours: encoder.recoloured(text)? };
    Ok(TextQuery { text: text.to_owned(), embedding, canonicals: canonicals.to_vec(), alternatives })
}

impl QueryScene {
    /// Uploads the scene and loads the text encoder, which must be of the field's space.
    pub fn open(
        device: &Device,
        splats: &Splats,
        field: LanguageField,
        mut encoder: Box<dyn RegionEncoder>,
    ) -> Result<Self> {
        if field.levels.iter().all(|l| l.codebook.is_empty()) {
            return Err(Error::input("the scene has no language; make one with splatvk run"));
        }
        let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
        let viewer = Viewer::new(device, splats, &field)?;
        let (others, backgrounds) = (Others::new(), HashMap::new());
        Ok(QueryScene { viewer, field, encoder, canonicals, others, backgrounds, frames: Vec::new() })
    }

    /// Renders and decodes the cameras that later queries are answered for.
    pub fn set_views(&mut self, cameras: &[Camera]) -> Result<&[DecodedFrame]> {
        self.frames.clear();
        self.backgrounds.clear();
        for camera in cameras {
            self.frames.push(self.viewer.view(camera)?);
        }
        Ok(&self.frames)
    }

    /// The phrases of the text model that name each code best: see [`RegionEncoder::names`].
    pub fn names(&mut self) -> Result<CodeNames> {
        names(self.encoder.as_mut(), &self.field, NAMES)
    }

    /// What embeds texts.
    pub fn encoder(&self) -> &dyn RegionEncoder {
        self.encoder.as_ref()
    }

    /// The scene's language.
    pub fn field(&self) -> &LanguageField {
        &self.field
    }

    /// The frames of the last [`QueryScene::look`].
    pub fn frames(&self) -> &[DecodedFrame] {
        &self.frames
    }

    /// The splats that a text means, whatever the views.
    pub fn select(&mut self, text: &str, options: &QueryOptions) -> Result<Selection> {
        let query = as_query(text, self.encoder.as_mut(), &self.canonicals, &mut self.others)?;
        select(&self.field, &query, options)
    }

    /// Answers a text in every frame.
    pub fn ask(&mut self, text: &str, options: &QueryOptions) -> Result<Answers> {
        let query = as_query(text, self.encoder.as_mut(), &self.canonicals, &mut self.others)?;
        let background = self.backgrounds.entry(things::form(text));
        answers_with(&self.frames, &self.field, &query, options, background)
    }
}

/// The answers to one text, one per photo.
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct Answers {
    /// The text of the query.
    pub text: String,
    /// Per photo.
    pub views: Vec<QueryResult>,
    /// Whether the scene shows what the text means; `None` where the text model knows too few texts to tell.
    pub evidence: Option<Evidence>,
    /// For the scene as a whole.
    pub highlight: Highlight,
}

impl Answers {
    /// For the interactive view.
    pub fn shown(&self) -> ShownAnswer<'_> {
        ShownAnswer {
            text: &self.text,
            found: self.found(),
            views: self.views.len(),
            presence: self.evidence.map(|e| e.presence),
            highlight: &self.highlight,
        }
    }

    /// Photos in which the text was found.
    pub fn found(&self) -> usize {
        self.views.iter().filter(|v| v.found).count()
    }

    /// The answer in a few words.
    pub fn verdict(&self) -> String {
        verdict(self.evidence.map(|e| e.presence), self.found(), self.views.len())
    }
}

/// An answer in a few words: "found in 3 of 4 photos".
pub fn verdict(presence: Option<Presence>, found: usize, views: usize) -> String {
    match presence {
        Some(Presence::Absent) => "not in this scene".to_owned(),
        Some(Presence::Unsure) => format!("unsure; if it is here, in {found} of {views} photos"),
        Some(Presence::Found) | None => format!("found in {found} of {views} photos"),
    }
}

/// Phrases of the text model that a viewer shows for a code.
pub const NAMES: usize = 5;

/// Per level and code the `best` phrases with their relevancy, best first; without phrases where the text model has no
/// list of its own.
pub fn names(encoder: &mut dyn RegionEncoder, field: &LanguageField, best: usize) -> Result<CodeNames> {
    let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
    let mut levels = Vec::with_capacity(field.levels.len());
    for level in &field.levels {
        let book = &level.codebook;
        let rows = book.embeddings.chunks_exact(book.embedding_dim.max(1));
        let named = encoder.names(&book.embeddings, best)?;
        let rate = |(row, list): (&[f32], Vec<(String, f32)>)| {
            list.into_iter()
                .map(|(name, cosine)| (name, query::relevancy(row, cosine.into(), &canonicals)))
                .collect()
        };
        levels.push(rows.zip(named).map(rate).collect());
    }
    Ok(levels)
}

/// The answers to one query in all frames.
pub fn answers(
    frames: &[DecodedFrame],
    field: &LanguageField,
    query: &TextQuery,
    options: &QueryOptions,
) -> Result<Answers> {
    answers_with(frames, field, query, options, HashMap::new().entry(String::new()))
}

/// The same, with a place for how well other things fit these frames.
fn answers_with(
    frames: &[DecodedFrame],
    field: &LanguageField,
    query: &TextQuery,
    options: &QueryOptions,
    background: Entry<'_, String, Background>,
) -> Result<Answers> {
    let codes: Vec<&[Plane<i32>]> = frames.iter().map(|f| f.codes.as_slice()).collect();
    let mut views = query::answer_all(&codes, field, query, options)?;
    let shown = ShownCodes::new(&codes, field, &query.canonicals);
    let background = background.or_insert_with(|| shown.background(&query.alternatives.things));
    let evidence = shown.evidence(&query.embedding, &query.alternatives.colours, background);
    if evidence.is_some_and(|e| e.presence == Presence::Absent) {
        views.iter_mut().for_each(|v| v.found = false);
    }
    let highlight = query::highlight::highlight(&codes, field, query, &views)?;
    Ok(Answers { text: query.text.clone(), views, evidence, highlight })
}

/// Embeds texts for [`crate::query::answer`].
pub fn embedded(texts: &[String], encoder: &mut dyn RegionEncoder) -> Result<Vec<TextQuery>> {
    if texts.is_empty() {
        return Ok(Vec::new());
    }
    let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
    let mut others = Others::new();
    texts.iter().map(|text| as_query(text, encoder, &canonicals, &mut others)).collect()
}
