//! Masks → aligned things with codes → splats that carry them; embeddings of texts.
use super::cameras::PlacedPhotos;
use super::shared;
use crate::fit::{LanguageOptions, Trained, TrainedLanguage};
use crate::infer::RegionEncoder;
use crate::language::align::PairLinks;
use crate::language::{self, Language, ViewMasks};
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::pose::Geometry;
use crate::query::TextQuery;
use crate::report::viewer::CodeNames;
use crate::run::ask;
use crate::run::method::Recipe;
use crate::sync::lock;
use crate::{Error, Result};
use std::sync::{Arc, Mutex, PoisonError};

/// An encoder that several stages share, one at a time.
#[derive(Clone)]
pub struct SharedEncoder {
    encoder: Arc<Mutex<Box<dyn RegionEncoder>>>,
    identity: String,
    space: String,
}

impl SharedEncoder {
    /// Wraps an encoder; `identity` names its models with their checksums.
    pub fn new(encoder: Box<dyn RegionEncoder>, identity: String) -> SharedEncoder {
        let space = encoder.space().to_owned();
        SharedEncoder {
            encoder: Arc::new(Mutex::new(encoder)),
            identity: format!("{space} {identity}"),
            space,
        }
    }

    /// Name of the embedding space.
    pub fn space(&self) -> &str {
        &self.space
    }

    /// Changes to another revision of the encoder's space; `false` if the encoder has none of this
    /// name.
    pub fn use_space(&mut self, space: &str) -> bool {
        let known = self.with(|e| e.use_space(space));
        if known && self.space != space {
            self.identity = format!("{space} {}", self.identity);
            self.space = space.to_owned();
        }
        known
    }

    /// The encoder itself, if nothing else shares it.
    pub fn into_inner(self) -> Result<Box<dyn RegionEncoder>> {
        let alone = Arc::into_inner(self.encoder).ok_or_else(|| Error::work("the encoder is in use"))?;
        Ok(alone.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    /// Identity of its models.
    pub fn identity(&self) -> &str {
        &self.identity
    }

    /// Runs `call` with exclusive access to the encoder.
    pub fn with<T>(&self, call: impl FnOnce(&mut dyn RegionEncoder) -> T) -> T {
        call(lock(&self.encoder).as_mut())
    }
}

/// Embeds the texts of the queries.
pub struct EmbedQueries {
    /// Text encoder.
    pub encoder: SharedEncoder,
    /// Texts of the queries.
    pub texts: Vec<String>,
    /// Whether all words count, as in published protocols.
    pub verbatim: bool,
}

impl Stage for EmbedQueries {
    const NAME: &'static str = "queries";
    const LANE: Lane = Lane::Processor;
    type Inputs = ();
    type Output = Vec<TextQuery>;

    fn settings(&self) -> String {
        format!("{} {:?} {}", self.encoder.identity(), self.texts, self.verbatim)
    }

    fn run(self, (): (), context: &Context) -> Result<Vec<TextQuery>> {
        context.progress.begin("texts", self.texts.len() as u64);
        let queries = self.encoder.with(|e| {
            let queries = ask::queries(&self.texts, e, self.verbatim)?;
            for text in &self.texts {
                if let Some(name) = e.embedding_source(text) {
                    context.progress.inform(&format!("“{text}” embedded by {name}"));
                }
            }
            e.embedding_warning().iter().for_each(|warning| context.progress.warn(warning));
            Ok(queries)
        });
        context.progress.end();
        queries
    }
}

/// Aligns masks across photos and assigns a code to every thing.
pub struct Align {
    /// The method.
    pub recipe: Recipe,
    /// Name of the embedding space.
    pub space: String,
    /// Seed of the code layout.
    pub seed: u64,
}

impl Stage for Align {
    const NAME: &'static str = "alignment";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Vec<ViewMasks>>, Output<Vec<PairLinks>>, Output<Geometry>);
    type Output = Language;

    fn settings(&self) -> String {
        format!("{:?}", self.recipe.build(&self.space, self.seed))
    }

    fn codec() -> Option<Codec<Language>> {
        kept()
    }

    fn run(
        self,
        (masks, matches, geometry): (&Vec<ViewMasks>, &Vec<PairLinks>, &Geometry),
        context: &Context,
    ) -> Result<Language> {
        let options = self.recipe.build(&self.space, self.seed);
        language::build(masks, &geometry.cameras, &geometry.depths, matches, &options, context.progress)
    }
}

/// Phrases of the text model for every code.
pub struct NameCodes {
    /// Text encoder.
    pub encoder: SharedEncoder,
}

impl Stage for NameCodes {
    const NAME: &'static str = "names";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Language>,);
    type Output = CodeNames;

    fn settings(&self) -> String {
        self.encoder.identity().to_owned()
    }

    fn run(self, (language,): (&Language,), context: &Context) -> Result<CodeNames> {
        context.progress.begin("names", 1);
        // As many as the page shows beside a selected thing.
        let names = self.encoder.with(|e| ask::names(e, &language.field, ask::NAMES));
        context.progress.end();
        names
    }
}

/// The language stage.
pub struct TrainLanguage {
    /// The method.
    pub recipe: Recipe,
    /// Options of the training.
    pub options: LanguageOptions,
}

impl Stage for TrainLanguage {
    const NAME: &'static str = "language";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<PlacedPhotos>, Output<Trained>, Output<Language>);
    type Output = TrainedLanguage;

    fn settings(&self) -> String {
        format!("{:?} {:?}", self.recipe, self.options)
    }

    fn codec() -> Option<Codec<TrainedLanguage>> {
        kept()
    }

    fn run(
        self,
        (placed, trained, language): (&PlacedPhotos, &Trained, &Language),
        context: &Context,
    ) -> Result<TrainedLanguage> {
        let (targets, coverage) = shared::targets(&placed.photos);
        self.recipe.train_language(
            context.device,
            shared::posed(&targets, &trained.cameras, None, &coverage),
            &trained.splats,
            language.field.clone(),
            self.options,
            context.progress,
        )
    }
}
