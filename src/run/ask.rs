//! Questions to a scene that is kept on the device: what viewers, `splatvk query`, the C interface
//! and benchmarks call.
use super::answer::{Answers, Prepared};
use super::recent::RecentOthers;
use super::view::{DecodedFrame, Viewer};
use crate::gpu::Device;
use crate::infer::{RegionEncoder, things};
use crate::query::phrasing::{self, Reading, Vocabulary};
use crate::query::presence::{Alternatives, ShownPixels};
use crate::query::{self, CANONICAL_PHRASES, QueryOptions, TextQuery};
use crate::report::viewer::CodeNames;
use crate::scene::{Camera, LanguageField, Splats};
use crate::{Error, Result};

/// One text as a query. With `verbatim` all its words count, as published protocols have it.
fn as_query(
    text: &str,
    encoder: &mut dyn RegionEncoder,
    canonicals: &[f32],
    others: &mut RecentOthers,
    verbatim: bool,
) -> Result<TextQuery> {
    phrasing::check(text)?;
    let phrasing = if verbatim || encoder.has_table_entry(text) { None } else { phrasing::read(text) };
    let asked = phrasing.as_ref().map_or(text, |p| &p.answers_for).to_owned();
    let embedding = encoder.embed_texts(&[&asked])?;
    let things = others.of(&things::form(&asked), |form| encoder.embed_other_things(form))?.things.clone();
    let alternatives = Alternatives { things, colours: encoder.embed_recoloured(&asked)? };
    let vocabulary = encoder.find_nearest_word(&asked)?.map(|(known, nearest)| Vocabulary { known, nearest });
    let reading = Reading { phrasing, vocabulary };
    Ok(TextQuery { text: text.to_owned(), embedding, canonicals: canonicals.to_vec(), alternatives, reading })
}

/// Embeds texts for [`crate::query::answer`], all their words.
pub fn embedded(texts: &[String], encoder: &mut dyn RegionEncoder) -> Result<Vec<TextQuery>> {
    queries(texts, encoder, true)
}

/// Texts as queries: of phrasing that no embedding carries the rest is asked ([`phrasing`]), unless
/// they are taken `verbatim`.
pub fn queries(texts: &[String], encoder: &mut dyn RegionEncoder, verbatim: bool) -> Result<Vec<TextQuery>> {
    if texts.is_empty() {
        return Ok(Vec::new());
    }
    let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
    let mut others = RecentOthers::default();
    texts.iter().map(|text| as_query(text, encoder, &canonicals, &mut others, verbatim)).collect()
}

/// What turns texts into answers about one scene: its text encoder, what that has embedded so far,
/// and the scene prepared.
pub(super) struct Questions {
    encoder: Box<dyn RegionEncoder>,
    /// [C, D] unit rows of the canonical phrases.
    canonicals: Vec<f32>,
    others: RecentOthers,
    prepared: Prepared,
    /// Cameras whose views tell what the scene shows, until they have been looked at.
    unseen: Option<Vec<Camera>>,
}

impl Questions {
    /// About a scene; what its own `cameras` show tells whether something is in it.
    pub(super) fn open(
        mut encoder: Box<dyn RegionEncoder>,
        splats: &Splats,
        field: &LanguageField,
        cameras: &[Camera],
    ) -> Result<Questions> {
        if field.levels.iter().all(|l| l.codebook.is_empty()) {
            return Err(Error::input(
                "the scene has no language; only scenes made from photos by splatvk run have it",
            ));
        }
        let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
        Ok(Questions {
            encoder,
            canonicals,
            others: RecentOthers::default(),
            prepared: Prepared::new(splats, field, ShownPixels::default()),
            unseen: Some(cameras.to_vec()),
        })
    }

    /// Looks at the scene from its own cameras, or takes the frames where they are theirs.
    fn look(
        &mut self,
        viewer: &mut Viewer,
        field: &LanguageField,
        (cameras, frames): (&[Camera], &[DecodedFrame]),
    ) -> Result<()> {
        let Some(own) = self.unseen.take() else { return Ok(()) };
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

    /// What is understood of a text.
    pub(super) fn reading(&mut self, text: &str) -> Result<Reading> {
        Ok(self.query(text)?.reading)
    }

    fn query(&mut self, text: &str) -> Result<TextQuery> {
        as_query(text, self.encoder.as_mut(), &self.canonicals, &mut self.others, false)
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
        self.look(viewer, field, views)?;
        let asked = query.reading.phrasing.as_ref().map_or(text, |p| &p.answers_for);
        let shared = self.others.of(&things::form(asked), |form| self.encoder.embed_other_things(form))?;
        self.prepared.answer(field, views, &query, options, &mut shared.background)
    }
}

/// The scene on the device, its code maps in the set views, and the text encoder. A query costs the
/// embedding of its text and a gather and five box filters per camera; nothing is rendered for it.
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
    questions: Questions,
    cameras: Vec<Camera>,
    frames: Vec<DecodedFrame>,
}

impl QueryScene {
    /// Uploads the scene and loads the text encoder, which must be of the field's space. Whether
    /// something is in the scene is told by what its own `cameras` show.
    pub fn open(
        device: &Device,
        (splats, cameras): (&Splats, &[Camera]),
        field: LanguageField,
        encoder: Box<dyn RegionEncoder>,
    ) -> Result<Self> {
        let questions = Questions::open(encoder, splats, &field, cameras)?;
        let viewer = Viewer::new(device, splats, &field)?;
        Ok(QueryScene { viewer, field, questions, cameras: Vec::new(), frames: Vec::new() })
    }

    /// Renders and decodes the cameras that later queries are answered for.
    pub fn set_views(&mut self, cameras: &[Camera]) -> Result<&[DecodedFrame]> {
        self.frames.clear();
        for camera in cameras {
            self.frames.push(self.viewer.view(camera)?);
        }
        self.cameras = cameras.to_vec();
        Ok(&self.frames)
    }

    /// The phrases of the text model that name each code best: see [`RegionEncoder::name_regions`].
    pub fn names(&mut self) -> Result<CodeNames> {
        names(self.questions.encoder.as_mut(), &self.field, NAMES)
    }

    /// What embeds texts.
    pub fn encoder(&self) -> &dyn RegionEncoder {
        self.questions.encoder.as_ref()
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
        self.questions.ask(text, &mut self.viewer, &self.field, (&self.cameras, &self.frames), options)
    }
}

/// Phrases of the text model that a viewer shows for a code.
pub const NAMES: usize = 5;

/// Per level and code the `best` phrases with their relevancy, best first; without phrases where
/// the text model has no list of its own.
pub fn names(encoder: &mut dyn RegionEncoder, field: &LanguageField, best: usize) -> Result<CodeNames> {
    let canonicals = encoder.embed_texts(&CANONICAL_PHRASES)?;
    let mut levels = Vec::with_capacity(field.levels.len());
    for level in &field.levels {
        let book = &level.codebook;
        let rows = book.embeddings.chunks_exact(book.embedding_dim.max(1));
        let named = encoder.name_regions(&book.embeddings, best)?;
        let rate = |(row, list): (&[f32], Vec<(String, f32)>)| {
            list.into_iter()
                .map(|(name, cosine)| (name, query::relevancy(row, cosine.into(), &canonicals)))
                .collect()
        };
        levels.push(rows.zip(named).map(rate).collect());
    }
    Ok(levels)
}
