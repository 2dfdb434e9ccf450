//! Queries to a scene on the device: for viewers, `splatvk query`, the C interface and benchmarks.
use super::answer::{Answers, Prepared};
use super::recent::AlternativesCache;
use super::view::{DecodedFrame, Viewer};
use crate::gpu::Device;
use crate::infer::{RegionEncoder, things};
use crate::query::phrasing::{self, Reading, Vocabulary};
use crate::query::presence::{Alternatives, ShownPixels};
use crate::query::{self, CANONICAL_PHRASES, QueryOptions, TextQuery};
use crate::report::viewer::CodeNames;
use crate::scene::{Camera, LanguageField, Splats};
use crate::{Error, Result};

/// Builds the query of a text. With `verbatim` all its words count, as in published protocols.
fn as_query(
    text: &str,
    encoder: &mut dyn RegionEncoder,
    canonicals: &[f32],
    alternatives_cache: &mut AlternativesCache,
    verbatim: bool,
) -> Result<TextQuery> {
    phrasing::check(text)?;
    let phrasing = if verbatim || encoder.has_table_entry(text) { None } else { phrasing::read(text) };
    let understood = phrasing.as_ref().map_or(text, |p| &p.answers_for).to_owned();
    let embedding = encoder.embed_texts(&[&understood])?;
    let form = things::form(&understood);
    let things = alternatives_cache.entry(&form, |form| encoder.embed_other_things(form))?.things.clone();
    let alternatives = Alternatives { things, colours: encoder.embed_recoloured(&understood)? };
    let vocabulary =
        encoder.find_nearest_word(&understood)?.map(|(known, nearest)| Vocabulary { known, nearest });
    let reading = Reading { phrasing, vocabulary };
    Ok(TextQuery { text: text.to_owned(), embedding, canonicals: canonicals.to_vec(), alternatives, reading })
}

/// Embeds texts for [`crate::query::answer`] with all their words.
pub fn embedded(texts: &[String], encoder: &mut dyn RegionEncoder) -> Result<Vec<TextQuery>> {
    queries(texts, encoder, true)
}

/// Builds the queries of texts. Unless `verbatim`, phrasing that no embedding carries is removed
/// first ([`phrasing`]).
pub fn queries(texts: &[String], encoder: &mut dyn RegionEncoder, verbatim: bool) -> Result<Vec<TextQuery>> {
    if texts.is_empty() {
        return Ok(Vec::new());
    }
    let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
    let mut alternatives_cache = AlternativesCache::default();
    texts.iter().map(|text| as_query(text, encoder, &canonicals, &mut alternatives_cache, verbatim)).collect()
}

/// Answers texts about one scene: text encoder, cached embeddings and the prepared scene.
pub(super) struct QuerySession {
    encoder: Box<dyn RegionEncoder>,
    /// [C, D] unit rows of the canonical phrases.
    canonicals: Vec<f32>,
    alternatives_cache: AlternativesCache,
    prepared: Prepared,
    /// Cameras of the scene whose views are not decoded yet.
    pending_views: Option<Vec<Camera>>,
}

impl QuerySession {
    /// Prepares a scene; the views of its own `cameras` decide the presence of a text.
    pub(super) fn open(
        mut encoder: Box<dyn RegionEncoder>,
        splats: &Splats,
        field: &LanguageField,
        cameras: &[Camera],
    ) -> Result<QuerySession> {
        if field.levels.iter().all(|l| l.codebook.is_empty()) {
            return Err(Error::input(
                "the scene has no language; only scenes made from photos by splatvk run have it",
            ));
        }
        let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
        Ok(QuerySession {
            encoder,
            canonicals,
            alternatives_cache: AlternativesCache::default(),
            prepared: Prepared::new(splats, field, ShownPixels::default()),
            pending_views: Some(cameras.to_vec()),
        })
    }

    /// Decodes the views of the scene's own cameras once, or takes `frames` if they are these
    /// views.
    fn decode_own_views(
        &mut self,
        viewer: &mut Viewer,
        field: &LanguageField,
        (cameras, frames): (&[Camera], &[DecodedFrame]),
    ) -> Result<()> {
        let Some(own) = self.pending_views.take() else { return Ok(()) };
        let shown = &mut self.prepared.shown;
        match own.is_empty() || own == cameras {
            true => frames.iter().for_each(|f| shown.add(field, &f.codes)),
            false => {
                for camera in &own {
                    shown.add(field, &viewer.codes(camera)?);
                }
            }
        }
        Ok(())
    }

    /// The understood part of a text.
    pub(super) fn reading(&mut self, text: &str) -> Result<Reading> {
        Ok(self.query(text)?.reading)
    }

    fn query(&mut self, text: &str) -> Result<TextQuery> {
        as_query(text, self.encoder.as_mut(), &self.canonicals, &mut self.alternatives_cache, false)
    }

    /// Answers a text in views.
    pub(super) fn ask(
        &mut self,
        text: &str,
        viewer: &mut Viewer,
        field: &LanguageField,
        views: (&[Camera], &[DecodedFrame]),
        options: &QueryOptions,
    ) -> Result<Answers> {
        let query = self.query(text)?;
        self.decode_own_views(viewer, field, views)?;
        let understood = query.reading.phrasing.as_ref().map_or(text, |p| &p.answers_for);
        let form = things::form(understood);
        let shared = self.alternatives_cache.entry(&form, |form| self.encoder.embed_other_things(form))?;
        self.prepared.answer(field, views, &query, options, &mut shared.background)
    }
}

/// The scene on the device, its code maps in the set views, and the text encoder. A query embeds
/// its text and runs a gather and five box filters per camera; it renders nothing.
///
/// ```no_run
/// # fn main() -> splatvk::Result<()> {
/// # use splatvk::{format::scene_dir, gpu, infer::{Registry, words::RegionWords}, run::ask::QueryScene};
/// let scene = scene_dir::load("out/breakfast".as_ref())?;
/// let field = scene.language.ok_or_else(|| splatvk::Error::input("no language"))?;
/// let encoder = Box::new(RegionWords::load(Registry::open(None)?)?);
/// let mut ready = QueryScene::open(&gpu::open(None)?, (&scene.splats, &scene.cameras), field, encoder)?;
/// ready.set_views(&scene.cameras)?;
/// let answers = ready.ask("lemon", &Default::default())?;
/// println!("{}; {} of it", answers.verdict(), answers.instances.len());
/// # Ok(())
/// # }
/// ```
pub struct QueryScene {
    viewer: Viewer,
    field: LanguageField,
    session: QuerySession,
    cameras: Vec<Camera>,
    frames: Vec<DecodedFrame>,
}

impl QueryScene {
    /// Uploads the scene and takes a text encoder of the field's space. The views of the scene's
    /// own `cameras` decide the presence of a text.
    pub fn open(
        device: &Device,
        (splats, cameras): (&Splats, &[Camera]),
        field: LanguageField,
        encoder: Box<dyn RegionEncoder>,
    ) -> Result<Self> {
        let session = QuerySession::open(encoder, splats, &field, cameras)?;
        let viewer = Viewer::new(device, splats, &field)?;
        Ok(QueryScene { viewer, field, session, cameras: Vec::new(), frames: Vec::new() })
    }

    /// Renders and decodes the cameras of later queries.
    pub fn set_views(&mut self, cameras: &[Camera]) -> Result<&[DecodedFrame]> {
        self.frames.clear();
        for camera in cameras {
            self.frames.push(self.viewer.view(camera)?);
        }
        self.cameras = cameras.to_vec();
        Ok(&self.frames)
    }

    /// The best phrases of the text model for each code: see [`RegionEncoder::name_regions`].
    pub fn names(&mut self) -> Result<CodeNames> {
        names(self.session.encoder.as_mut(), &self.field, NAMES)
    }

    /// The text encoder.
    pub fn encoder(&self) -> &dyn RegionEncoder {
        self.session.encoder.as_ref()
    }

    /// The scene's language.
    pub fn field(&self) -> &LanguageField {
        &self.field
    }

    /// The frames of the last [`QueryScene::set_views`].
    pub fn frames(&self) -> &[DecodedFrame] {
        &self.frames
    }

    /// Answers a text in every frame.
    pub fn ask(&mut self, text: &str, options: &QueryOptions) -> Result<Answers> {
        self.session.ask(text, &mut self.viewer, &self.field, (&self.cameras, &self.frames), options)
    }
}

/// Number of phrases per code in a viewer.
pub const NAMES: usize = 5;

/// Per level and code the `best` phrases with their relevancy, best first; no phrases if the text
/// model has no list of its own.
pub fn names(encoder: &mut dyn RegionEncoder, field: &LanguageField, best: usize) -> Result<CodeNames> {
    let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
    let mut levels = Vec::with_capacity(field.levels.len());
    for level in &field.levels {
        let book = &level.codebook;
        let rows = book.embeddings.chunks_exact(book.embedding_dim.max(1));
        let named = encoder.name_regions(&book.embeddings, best)?;
        let with_relevancy = |(row, list): (&[f32], Vec<(String, f32)>)| {
            list.into_iter()
                .map(|(name, cosine)| (name, query::relevancy(row, cosine.into(), &canonicals)))
                .collect()
        };
        levels.push(rows.zip(named).map(with_relevancy).collect());
    }
    Ok(levels)
}
