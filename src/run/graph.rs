//! The stages of a run as a graph.
use super::answer::Answers;
use super::base::BaseScene;
use super::compat::query_options;
use super::config::{LanguageConfig, ReconstructionConfig};
use super::preview::Preview;
use super::sources::{
    self, DepthSources, FeatureSources, GeometrySources, Given, GraphBuilder, MaskSources, MatchSources,
    PosedPhotos,
};
use super::stages::{self, CameraOrigin, GivenViews, PlacedPhotos, SharedEncoder};
use crate::fit::{Trained, TrainedLanguage};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::language::{Language, ViewMasks};
use crate::photo::Photo;
use crate::pipeline::Output;
use crate::pose;
use crate::query::TextQuery;
use crate::report::viewer::CodeNames;
use crate::run::view::DecodedFrame;
use crate::scene::Up;
use crate::{Error, Result};
use std::sync::Arc;

/// A graph under construction, with the settings that its stages take.
pub(super) struct ScenePlan<'a> {
    pub(super) build: GraphBuilder,
    pub(super) config: &'a ReconstructionConfig,
    pub(super) queries: &'a [String],
    pub(super) device: &'a Device,
    pub(super) preview: Option<Preview>,
}

/// Outputs of the stages of a run.
pub(super) struct SceneOutputs {
    pub(super) placed: Output<PlacedPhotos>,
    pub(super) geometry: Output<pose::Geometry>,
    pub(super) trained: Output<Trained>,
    pub(super) up: Output<Option<Up>>,
    pub(super) language: Option<LanguageOutputs>,
}

/// Outputs of the stages of the language.
pub(super) struct LanguageOutputs {
    pub(super) aligned: Output<Language>,
    pub(super) names: Output<CodeNames>,
    pub(super) language: Output<TrainedLanguage>,
    pub(super) frames: Output<Vec<DecodedFrame>>,
    pub(super) answers: Output<Vec<Answers>>,
}

impl SceneOutputs {
    /// Targets for [`crate::pipeline::Graph::run`].
    pub(super) fn targets(&self) -> Vec<usize> {
        let mut targets =
            vec![self.placed.target(), self.geometry.target(), self.trained.target(), self.up.target()];
        if let Some(LanguageOutputs { aligned, names, language, frames, answers }) = &self.language {
            targets.extend([
                aligned.target(),
                names.target(),
                language.target(),
                frames.target(),
                answers.target(),
            ]);
        }
        targets
    }
}

/// Validates the sources before any work.
pub(super) fn check(config: &ReconstructionConfig, photos: &[Photo], registry: &Registry) -> Result<()> {
    let defaults = LanguageConfig::default();
    let language = config.language.as_ref();
    let LanguageConfig { masks, features, .. } = language.unwrap_or(&defaults);
    let given = Given { photos, masks, features };
    sources::check::<GeometrySources>(&config.geometry.init, &given, registry)?;
    sources::check::<DepthSources>(&config.geometry.depth_prior, &given, registry)?;
    let Some(language) = language else { return Ok(()) };
    sources::check::<MatchSources>(&language.matcher, &given, registry)?;
    sources::check::<FeatureSources>(&language.features, &given, registry)?;
    sources::check::<MaskSources>(&language.masks, &given, registry)
}

/// Encoder and queries, shared by the language stages.
struct QueryInputs {
    encoder: SharedEncoder,
    queries: Output<Vec<TextQuery>>,
}

impl ScenePlan<'_> {
    /// Adds the stages of a new scene. Within a lane they start in this order, so that stages that
    /// need no geometry come before those that do.
    pub(super) fn scene(&mut self, photos: Vec<Photo>, origin: Option<CameraOrigin>) -> Result<SceneOutputs> {
        let registry = self.build.registry.clone();
        let encoder = self.encoder()?;
        let options = self.config.rgb_options(self.build.preset, self.device, photos.len());
        let posed = match origin {
            Some(origin) => self.build.posed(photos, origin)?,
            None => {
                let init = &self.config.geometry.init;
                sources::make::<GeometrySources>(init, &registry, (&mut self.build, photos))?
            }
        };
        let PosedPhotos { placed, geometry } = posed;
        let train = stages::TrainColour { options, preview: self.preview.take() };
        let trained = self.build.graph.add(train, (placed, geometry));
        let trained = self.view_dependence(placed, trained);
        let up = self.build.graph.add(stages::Upright, (placed, geometry, trained));
        let language = match (&self.config.language, encoder) {
            (Some(language), Some(encoder)) => {
                // Queries come first: a table of embeddings may lack one of their phrases.
                let query_inputs = self.query_inputs(encoder);
                self.share_processor(geometry);
                let build = &mut self.build;
                let masks = sources::make::<MaskSources>(&language.masks, &registry, (build, posed))?;
                let build = &mut self.build;
                let matches = sources::make::<MatchSources>(&language.matcher, &registry, (build, posed))?;
                let regions = self.described(&query_inputs.encoder, posed, masks);
                let recipe = language.recipe(self.config.training.preset);
                let (seed, space) = (self.build.seed, query_inputs.encoder.space().to_owned());
                let align = stages::Align { recipe, space, seed };
                let aligned = self.build.graph.add(align, (regions, matches, geometry));
                self.language(query_inputs, placed, trained, aligned)
            }
            _ => None,
        };
        Ok(SceneOutputs { placed, geometry, trained, up, language })
    }

    /// Adds the stages of photos that join a scene.
    pub(super) fn added(&mut self, base: &Arc<BaseScene>, photos: Vec<Photo>) -> Result<SceneOutputs> {
        let (preset, seed, registry) = (self.build.preset, self.build.seed, self.build.registry.clone());
        let mut encoder = self.encoder()?;
        if let Some(encoder) = &mut encoder
            && !encoder.use_space(&base.field.space)
        {
            return Err(Error::input(format!(
                "--features: the scene's features are {}, these would be {}; give the --features it was made with",
                base.field.space,
                encoder.space()
            )));
        }
        let known = base.known.photos.len();
        let options = self.config.rgb_options(preset, self.device, known + photos.len());
        let graph = &mut self.build.graph;
        let placed = graph.add(stages::AddedCameras { base: base.clone(), photos, seed }, ());
        let geometry = graph.add(stages::AddedDepth { base: base.clone(), preset, seed }, (placed,));
        let trained = graph.add(stages::TrainOn { base: base.clone(), options }, (placed, geometry));
        let trained = self.view_dependence(placed, trained);
        let graph = &mut self.build.graph;
        let up = match &base.world.up {
            Some(up) => graph.add(stages::KnownUp(Some(up.clone())), ()),
            None => graph.add(stages::Upright, (placed, geometry, trained)),
        };
        let language = match (&self.config.language, encoder) {
            (Some(language), Some(encoder)) => {
                let query_inputs = self.query_inputs(encoder);
                self.share_processor(geometry);
                let graph = &mut self.build.graph;
                let new = PosedPhotos {
                    placed: graph.add(stages::OnlyAdded { known }, (placed,)),
                    geometry: graph.add(stages::OnlyAddedGeometry { known }, (geometry,)),
                };
                let build = &mut self.build;
                let masks = sources::make::<MaskSources>(&language.masks, &registry, (build, new))?;
                let regions = self.described(&query_inputs.encoder, new, masks);
                let recipe = language.recipe(self.config.training.preset);
                let options = recipe.build(query_inputs.encoder.space(), seed);
                let align = stages::AlignAdded { base: base.clone(), options };
                let aligned = self.build.graph.add(align, (regions, geometry, trained));
                self.language(query_inputs, placed, trained, aligned)
            }
            _ => None,
        };
        Ok(SceneOutputs { placed, geometry, trained, up, language })
    }

    /// Adds the stages that give the splats of `views` language.
    pub(super) fn labelled(&mut self, mut views: GivenViews) -> Result<SceneOutputs> {
        let registry = self.build.registry.clone();
        let encoder = self.encoder()?;
        let graph = &mut self.build.graph;
        let placed = graph.add(stages::GivenPhotos::new(&mut views), ());
        let geometry = graph.add(stages::GivenGeometry, (placed,));
        let GivenViews { identity, splats, up, shows_photos, .. } = views;
        let trained = graph.add(stages::GivenSplats { identity, splats }, (geometry,));
        let up = match up.is_none() && shows_photos {
            true => graph.add(stages::Upright, (placed, geometry, trained)),
            false => graph.add(stages::KnownUp(up), ()),
        };
        let (Some(language), Some(encoder)) = (&self.config.language, encoder) else {
            return Ok(SceneOutputs { placed, geometry, trained, up, language: None });
        };
        let (recipe, posed) =
            (language.recipe(self.config.training.preset), PosedPhotos { placed, geometry });
        let query_inputs = self.query_inputs(encoder);
        let masks = sources::make::<MaskSources>(&language.masks, &registry, (&mut self.build, posed))?;
        let regions = self.described(&query_inputs.encoder, posed, masks);
        let (seed, space) = (self.build.seed, query_inputs.encoder.space().to_owned());
        let graph = &mut self.build.graph;
        let matches = graph.add(stages::ReprojectedMatches, (geometry,));
        let aligned = graph.add(stages::Align { recipe, space, seed }, (regions, matches, geometry));
        let language = self.config.language_options(self.build.preset).map(|options| {
            let lift = stages::LiftLanguage(stages::TrainLanguage { recipe, options });
            let language = self.build.graph.add(lift, (placed, trained, aligned));
            self.answered(query_inputs, trained, aligned, language)
        });
        Ok(SceneOutputs { placed, geometry, trained, up, language })
    }

    /// Adds the features of masks: those of the encoder, then the shapes of their surfaces.
    fn described(
        &mut self,
        encoder: &SharedEncoder,
        posed: PosedPhotos,
        masks: Output<Vec<ViewMasks>>,
    ) -> Output<Vec<ViewMasks>> {
        let PosedPhotos { placed, geometry } = posed;
        let regions = stages::RegionFeatures { encoder: encoder.clone() };
        let regions = self.build.graph.add(regions, (placed, masks));
        let surfaces = stages::SurfaceFeatures { encoder: encoder.clone() };
        self.build.graph.add(surfaces, (placed, regions, geometry))
    }

    /// The encoder of the features; `None` without language.
    fn encoder(&self) -> Result<Option<SharedEncoder>> {
        let registry = &self.build.registry;
        let language = self.config.language.as_ref();
        language.map(|l| sources::make::<FeatureSources>(&l.features, registry, registry)).transpose()
    }

    /// On a CPU device the networks of the language wait for the geometry: the first picture is there
    /// sooner, and training has time for them beside it.
    fn share_processor(&mut self, geometry: Output<pose::Geometry>) {
        if self.device.info().is_cpu {
            self.build.graph.after(geometry);
        }
    }

    fn view_dependence(&mut self, placed: Output<PlacedPhotos>, trained: Output<Trained>) -> Output<Trained> {
        let options = self.config.view_dependent_options(self.build.preset);
        self.build.graph.add(stages::ViewDependence { options }, (placed, trained))
    }

    fn query_inputs(&mut self, encoder: SharedEncoder) -> QueryInputs {
        let compat = self.config.language.as_ref().and_then(|language| language.compat);
        let (texts, verbatim) = (self.queries.to_vec(), query_options(compat).published);
        let embed = stages::EmbedQueries { encoder: encoder.clone(), texts, verbatim };
        QueryInputs { queries: self.build.graph.add(embed, ()), encoder }
    }

    /// Adds the stages from aligned codes to answers; `None` without language.
    fn language(
        &mut self,
        query_inputs: QueryInputs,
        placed: Output<PlacedPhotos>,
        trained: Output<Trained>,
        aligned: Output<Language>,
    ) -> Option<LanguageOutputs> {
        let config = self.config.language.as_ref()?;
        let (recipe, options) =
            (config.recipe(self.config.training.preset), self.config.language_options(self.build.preset)?);
        let train = stages::TrainLanguage { recipe, options };
        let language = self.build.graph.add(train, (placed, trained, aligned));
        Some(self.answered(query_inputs, trained, aligned, language))
    }

    /// Adds the stages from splats with features to answers.
    fn answered(
        &mut self,
        QueryInputs { encoder, queries }: QueryInputs,
        trained: Output<Trained>,
        aligned: Output<Language>,
        language: Output<TrainedLanguage>,
    ) -> LanguageOutputs {
        let compat = self.config.language.as_ref().and_then(|language| language.compat);
        let graph = &mut self.build.graph;
        let names = graph.add(stages::NameCodes { encoder }, (aligned,));
        let frames = graph.add(stages::DecodeViews, (trained, language));
        let options = query_options(compat);
        let answers = graph.add(stages::AnswerQueries { options }, (trained, frames, language, queries));
        LanguageOutputs { aligned, names, language, frames, answers }
    }
}
