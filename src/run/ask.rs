//! Queries to a scene on the device: for viewers, `splatvk query`, the C interface and benchmarks.
use super::answer::{Answers, Prepared};
use super::recent::{AlternativesCache, RecentQueries};
use super::view::{DecodedFrame, Viewer};
use crate::gpu::Device;
use crate::infer::{RegionEncoder, things};
use crate::pass::query_peaks::DeviceSearch;
use crate::query::frame::FrameSearch;
use crate::query::instances::Places;
use crate::query::maps::CodeMaps;
use crate::query::phrasing::{self, Reading, Vocabulary};
use crate::query::presence::{Alternatives, ShownPixels};
use crate::query::{self, CANONICAL_PHRASES, QueryOptions, TextQuery};
use crate::report::viewer::CodeNames;
use crate::scene::{Camera, Image, LanguageField, Splats};
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::sync::Arc;

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
    let (embedding, word) = encoder.embed_and_look_up(&understood)?;
    let form = things::form(&understood);
    let things = alternatives_cache.entry(&form, |form| encoder.embed_other_things(form))?.things.clone();
    let (colours, levels) = (encoder.embed_recoloured(&understood)?, encoder.presence_levels());
    let alternatives = Alternatives { things, colours, levels };
    let vocabulary = word.map(|word| Vocabulary {
        known: word.nearest.is_some(),
        nearest: word.nearest,
        not_english: word.not_english,
    });
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
    /// Queries of the last texts.
    recent: RecentQueries,
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
            recent: RecentQueries::default(),
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
            true => frames.iter().for_each(|f| shown.add(field, &f.maps)),
            false => {
                for camera in &own {
                    shown.add(field, &CodeMaps::new(&viewer.codes(camera)?)?);
                }
            }
        }
        Ok(())
    }

    /// Positions and codes of the splats.
    fn places(&self) -> &Places {
        self.prepared.places()
    }

    /// The understood part of a text.
    pub(super) fn reading(&mut self, text: &str) -> Result<Reading> {
        Ok(self.query(text, false)?.reading.clone())
    }

    fn query(&mut self, text: &str, verbatim: bool) -> Result<Arc<TextQuery>> {
        let (encoder, alternatives) = (self.encoder.as_mut(), &mut self.alternatives_cache);
        let canonicals = &self.canonicals;
        self.recent
            .entry((text, verbatim), |text| as_query(text, encoder, canonicals, alternatives, verbatim))
    }

    /// Answers a text in views.
    pub(super) fn ask(
        &mut self,
        text: &str,
        viewer: &mut Viewer,
        field: &LanguageField,
        views: (&[Camera], &[DecodedFrame]),
        options: &QueryOptions,
        search: Option<&mut dyn FrameSearch>,
    ) -> Result<Answers> {
        let query = self.query(text, options.published)?;
        self.decode_own_views(viewer, field, views)?;
        let understood = query.reading.phrasing.as_ref().map_or(text, |p| &p.answers_for);
        let form = things::form(understood);
        let shared = self.alternatives_cache.entry(&form, |form| self.encoder.embed_other_things(form))?;
        self.prepared.answer(field, views, &query, options, &mut shared.background, search)
    }
}

/// The scene on the device, its code maps in the set views, and the text encoder. A query embeds
/// its text, unless it was asked before, and searches the code maps; it renders nothing.
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
    device: Device,
    /// The code maps of the frames on a device that searches them.
    search: Option<DeviceSearch>,
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
        Ok(QueryScene {
            viewer,
            field,
            session,
            cameras: Vec::new(),
            frames: Vec::new(),
            device: device.clone(),
            search: None,
        })
    }

    /// Renders and decodes the cameras of later queries.
    pub fn set_views(&mut self, cameras: &[Camera]) -> Result<&[DecodedFrame]> {
        self.search = None;
        self.frames.clear();
        for camera in cameras {
            self.frames.push(self.viewer.view(camera)?);
        }
        self.cameras = cameras.to_vec();
        let maps: Vec<Arc<CodeMaps>> = self.frames.iter().map(|f| f.maps.clone()).collect();
        let codes = self.field.levels.iter().map(|l| l.codebook.len()).max().unwrap_or(0);
        self.search = DeviceSearch::open(&self.device, &maps, codes)?;
        Ok(&self.frames)
    }

    /// The best phrases of the text model for each code: see [`RegionEncoder::name_regions`].
    pub fn names(&mut self) -> Result<CodeNames> {
        names(self.session.encoder.as_mut(), &self.field, NAMES)
    }

    /// Positions and codes of the splats.
    pub fn places(&self) -> &Places {
        self.session.places()
    }

    /// The text encoder.
    pub fn encoder(&self) -> &dyn RegionEncoder {
        self.session.encoder.as_ref()
    }

    /// The text encoder, for another scene.
    pub fn into_encoder(self) -> Box<dyn RegionEncoder> {
        self.session.encoder
    }

    /// The scene's language.
    pub fn field(&self) -> &LanguageField {
        &self.field
    }

    /// Forgets the queries of the last texts: the next text is embedded again.
    pub fn forget_texts(&mut self) {
        self.session.recent = RecentQueries::default();
    }

    /// The frames of the last [`QueryScene::set_views`].
    pub fn frames(&self) -> &[DecodedFrame] {
        &self.frames
    }

    /// Device milliseconds of the passes that search the frames; none where the processor does.
    pub fn time_passes(&self) -> Result<BTreeMap<String, f64>> {
        self.search.as_ref().map_or_else(|| Ok(BTreeMap::new()), DeviceSearch::time_passes)
    }

    /// Codes of one camera, as [`DecodedFrame::codes`].
    pub fn codes(&mut self, camera: &Camera) -> Result<Vec<Image<i32>>> {
        self.viewer.codes(camera)
    }

    /// Answers a text in every frame.
    pub fn ask(&mut self, text: &str, options: &QueryOptions) -> Result<Answers> {
        let views = (&self.cameras[..], &self.frames[..]);
        let search = self.search.as_mut().map(|search| search as &mut dyn FrameSearch);
        self.session.ask(text, &mut self.viewer, &self.field, views, options, search)
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
