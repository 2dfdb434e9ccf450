//! The stages of `splatvk run`.
use super::answer::Answers;
use super::base::BaseScene;
use super::compat::query_options;
use super::plan::RunPlan;
use super::sources::{
    self, DepthSources, FeatureSources, GeometrySources, Given, GraphBuilder, MaskSources, MatchSources,
    PosedPhotos,
};
use super::stages::{self, CameraOrigin, PlacedPhotos, SharedEncoder};
use crate::fit::{Preset, Trained, TrainedLanguage};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::language::Language;
use crate::photo::Photo;
use crate::pipeline::{Graph, Output};
use crate::pose;
use crate::query::TextQuery;
use crate::report::viewer::CodeNames;
use crate::run::view::DecodedFrame;
use crate::scene::Up;
use crate::{Error, Result};
use std::sync::Arc;

/// Outputs of the stages of a run.
pub(super) struct SceneOutputs {
    pub(super) placed: Output<PlacedPhotos>,
    pub(super) geometry: Output<pose::Geometry>,
    pub(super) trained: Output<Trained>,
    pub(super) up: Output<Option<Up>>,
    pub(super) aligned: Output<Language>,
    pub(super) names: Output<CodeNames>,
    pub(super) language: Output<TrainedLanguage>,
    pub(super) frames: Output<Vec<DecodedFrame>>,
    pub(super) answers: Output<Vec<Answers>>,
}

impl SceneOutputs {
    /// For [`Graph::run`].
    pub(super) fn targets(&self) -> [usize; 9] {
        [
            self.placed.target(),
            self.geometry.target(),
            self.trained.target(),
            self.up.target(),
            self.aligned.target(),
            self.names.target(),
            self.language.target(),
            self.frames.target(),
            self.answers.target(),
        ]
    }
}

/// Refuses, before any work, what a source of the plan would refuse later.
pub(super) fn check(plan: &RunPlan, photos: &[Photo], registry: &Registry) -> Result<()> {
    let given = Given { photos, masks: &plan.masks, features: &plan.features };
    sources::check::<GeometrySources>(&plan.init, &given, registry)?;
    sources::check::<DepthSources>(&plan.depth_prior, &given, registry)?;
    sources::check::<MatchSources>(&plan.matcher, &given, registry)?;
    sources::check::<FeatureSources>(&plan.features, &given, registry)?;
    sources::check::<MaskSources>(&plan.masks, &given, registry)
}

/// Adds the stages of the plan. Within a lane they start in this order, so what needs no geometry
/// comes before what does.
pub(super) fn scene(
    build: &mut GraphBuilder,
    plan: &RunPlan,
    device: &Device,
    photos: Vec<Photo>,
) -> Result<SceneOutputs> {
    let (preset, registry) = (build.preset, build.registry.clone());
    let encoder = sources::make::<FeatureSources>(&plan.features, &registry, &registry)?;
    let options = plan.rgb_options(preset, device, photos.len());
    let posed = if plan.cameras.is_empty() {
        sources::make::<GeometrySources>(&plan.init, &registry, (build, photos))?
    } else {
        build.posed(photos, CameraOrigin::Known(plan.cameras.clone().into()))?
    };
    let PosedPhotos { placed, geometry } = posed;
    let trained = build.graph.add(stages::TrainColour { options }, (placed, geometry));
    let options = plan.view_dependent_options(preset);
    let trained = build.graph.add(stages::ViewDependence { options }, (placed, trained));
    let up = build.graph.add(stages::Upright, (placed, geometry, trained));

    // First what can be refused: a phrase that a table of embeddings does not hold.
    let embed = stages::EmbedQueries { encoder: encoder.clone(), texts: plan.queries.clone() };
    let queries = build.graph.add(embed, ());
    let masks = sources::make::<MaskSources>(&plan.masks, &registry, (build, posed))?;
    let matches = sources::make::<MatchSources>(&plan.matcher, &registry, (build, posed))?;
    let graph = &mut build.graph;
    let regions = graph.add(stages::RegionFeatures { encoder: encoder.clone() }, (placed, masks));
    let (recipe, seed, space) = (plan.recipe(), plan.seed, encoder.space().to_owned());
    let aligned = graph.add(stages::Align { recipe, space, seed }, (regions, matches, geometry));
    let aligned = Aligned { placed, geometry, trained, up, aligned, queries };
    Ok(aligned.answered(graph, plan, preset, encoder))
}

/// The same for photos that join a scene.
pub(super) fn added(
    build: &mut GraphBuilder,
    plan: &RunPlan,
    device: &Device,
    base: &Arc<BaseScene>,
    photos: Vec<Photo>,
) -> Result<SceneOutputs> {
    let (preset, seed, registry) = (build.preset, plan.seed, build.registry.clone());
    let encoder = sources::make::<FeatureSources>(&plan.features, &registry, &registry)?;
    if encoder.space() != base.field.space {
        return Err(Error::input(format!(
            "--features: the scene's features are {}, these would be {}; give the --features it was made with",
            base.field.space,
            encoder.space()
        )));
    }
    let known = base.known.photos.len();
    let options = plan.rgb_options(preset, device, known + photos.len());
    let graph = &mut build.graph;
    let placed = graph.add(stages::AddedCameras { base: base.clone(), photos, seed }, ());
    let geometry = graph.add(stages::AddedDepth { base: base.clone(), preset, seed }, (placed,));
    let trained = graph.add(stages::TrainOn { base: base.clone(), options }, (placed, geometry));
    let options = plan.view_dependent_options(preset);
    let trained = graph.add(stages::ViewDependence { options }, (placed, trained));
    let up = match &base.world.up {
        Some(up) => graph.add(stages::KnownUp(Some(up.clone())), ()),
        None => graph.add(stages::Upright, (placed, geometry, trained)),
    };
    let embed = stages::EmbedQueries { encoder: encoder.clone(), texts: plan.queries.clone() };
    let queries = graph.add(embed, ());
    let new = PosedPhotos {
        placed: graph.add(stages::OnlyAdded { known }, (placed,)),
        geometry: graph.add(stages::OnlyAddedGeometry { known }, (geometry,)),
    };
    let masks = sources::make::<MaskSources>(&plan.masks, &registry, (build, new))?;
    let graph = &mut build.graph;
    let regions = graph.add(stages::RegionFeatures { encoder: encoder.clone() }, (new.placed, masks));
    let recipe = plan.recipe();
    let align = recipe.build(encoder.space(), seed);
    let aligned =
        graph.add(stages::AlignAdded { base: base.clone(), options: align }, (regions, geometry, trained));
    let aligned = Aligned { placed, geometry, trained, up, aligned, queries };
    Ok(aligned.answered(graph, plan, preset, encoder))
}

/// What language training and answers start from.
struct Aligned {
    placed: Output<PlacedPhotos>,
    geometry: Output<pose::Geometry>,
    trained: Output<Trained>,
    up: Output<Option<Up>>,
    aligned: Output<Language>,
    queries: Output<Vec<TextQuery>>,
}

impl Aligned {
    /// Adds the stages that every list ends with.
    fn answered(
        self,
        graph: &mut Graph<'static>,
        plan: &RunPlan,
        preset: Preset,
        encoder: SharedEncoder,
    ) -> SceneOutputs {
        let Aligned { placed, geometry, trained, up, aligned, queries } = self;
        let names = graph.add(stages::NameCodes { encoder }, (aligned,));
        let (recipe, options) = (plan.recipe(), plan.language_options(preset));
        let language = graph.add(stages::TrainLanguage { recipe, options }, (placed, trained, aligned));
        let frames = graph.add(stages::DecodeViews, (trained, language));
        let options = query_options(plan.compat);
        let answers = graph.add(stages::AnswerQueries { options }, (trained, frames, language, queries));
        SceneOutputs { placed, geometry, trained, up, aligned, names, language, frames, answers }
    }
}
