//! A loaded scene that is kept on the device for queries: what viewers, `splatvk query` and benchmarks call.
use super::view::{DecodedFrame, Viewer};
use crate::gpu::Device;
use crate::infer::RegionEncoder;
use crate::query::highlight::Highlight;
use crate::query::select::{Selection, select};
use crate::query::{self, CANONICAL_PHRASES, QueryOptions, QueryResult, TextQuery};
use crate::report::viewer::{CodeNames, ShownAnswer};
use crate::scene::{Camera, LanguageField, Plane, Splats};
use crate::{Error, Result};

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
    frames: Vec<DecodedFrame>,
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
        Ok(QueryScene { viewer, field, encoder, canonicals, frames: Vec::new() })
    }

    /// Renders and decodes the cameras that later queries are answered for.
    pub fn set_views(&mut self, cameras: &[Camera]) -> Result<&[DecodedFrame]> {
        self.frames.clear();
        for camera in cameras {
            self.frames.push(self.viewer.view(camera)?);
        }
        Ok(&self.frames)
    }

    /// The phrases of the text model that name each code best: see [`RegionEncoder::names`].
    pub fn names(&mut self) -> Result<CodeNames> {
        names(self.encoder.as_mut(), &self.field, NAMES)
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
        let embedding = self.encoder.embed_texts(&[text])?;
        let query = TextQuery { text: text.to_owned(), embedding, canonicals: self.canonicals.clone() };
        select(&self.field, &query, options)
    }

    /// Answers a text in every frame.
    pub fn ask(&mut self, text: &str, options: &QueryOptions) -> Result<Answers> {
        let embedding = self.encoder.embed_texts(&[text])?;
        let query = TextQuery { text: text.to_owned(), embedding, canonicals: self.canonicals.clone() };
        answers(&self.frames, &self.field, &query, options)
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
            highlight: &self.highlight,
        }
    }

    /// Photos in which the text was found.
    pub fn found(&self) -> usize {
        self.views.iter().filter(|v| v.found).count()
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
    let codes: Vec<&[Plane<i32>]> = frames.iter().map(|f| f.codes.as_slice()).collect();
    let views = query::answer_all(&codes, field, query, options)?;
    let highlight = query::highlight::highlight(&codes, field, query, &views)?;
    Ok(Answers { text: query.text.clone(), views, highlight })
}

/// Embeds texts for [`crate::query::answer`].
pub fn embedded(texts: &[String], encoder: &mut dyn RegionEncoder) -> Result<Vec<TextQuery>> {
    if texts.is_empty() {
        return Ok(Vec::new());
    }
    let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
    let list: Vec<&str> = texts.iter().map(String::as_str).collect();
    let rows = encoder.embed_texts(&list)?;
    let query = |(text, row): (&String, &[f32])| TextQuery {
        text: text.clone(),
        embedding: row.to_vec(),
        canonicals: canonicals.clone(),
    };
    Ok(texts.iter().zip(rows.chunks_exact(encoder.dim())).map(query).collect())
}
