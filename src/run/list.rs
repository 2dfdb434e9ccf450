//! The stages of `splatvk run`.
use super::ask::Answers;
use super::plan::RunPlan;
use super::sources::{self, Build, Features, Geometry, Given, Masks, Matches, PosedPhotos};
use super::stages::{self, CameraSource, Placed};
use crate::Result;
use crate::fit::{Trained, TrainedLanguage};
use crate::gpu::Device;
use crate::infer::Registry;
use crate::language::Language;
use crate::photo::Photo;
use crate::pipeline::Output;
use crate::pose;
use crate::report::viewer::Names;
use crate::run::view::DecodedFrame;

/// What a run asks of its stages.
pub(super) struct Scene {
    pub(super) placed: Output<Placed>,
    pub(super) geometry: Output<pose::Geometry>,
    pub(super) trained: Output<Trained>,
    pub(super) aligned: Output<Language>,
    pub(super) names: Output<Names>,
    pub(super) language: Output<TrainedLanguage>,
    pub(super) frames: Output<Vec<DecodedFrame>>,
    pub(super) answers: Output<Vec<Answers>>,
}

impl Scene {
    /// For [`Graph::run`].
    pub(super) fn targets(&self) -> [usize; 8] {
        [
            self.placed.target(),
            self.geometry.target(),
            self.trained.target(),
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
    sources::check::<Geometry>(&plan.init, &given, registry)?;
    sources::check::<Matches>(&plan.matcher, &given, registry)?;
    sources::check::<Features>(&plan.features, &given, registry)?;
    sources::check::<Masks>(&plan.masks, &given, registry)
}

/// Adds the stages of the plan. Within a lane they start in this order, so what needs no geometry comes before what does.
pub(super) fn scene(build: &mut Build, plan: &RunPlan, device: &Device, photos: Vec<Photo>) -> Result<Scene> {
    let (preset, registry) = (build.preset, build.registry.clone());
    let encoder = sources::make::<Features>(&plan.features, &registry, &registry)?;
    let options = plan.rgb_options(preset, device, photos.len());
    let posed = if plan.cameras.is_empty() {
        sources::make::<Geometry>(&plan.init, &registry, (build, photos))?
    } else {
        build.posed(photos, CameraSource::Known(plan.cameras.clone()))?
    };
    let PosedPhotos { placed, geometry } = posed;
    let trained = build.graph.add(stages::TrainColour { options }, (placed, geometry));

    // First what can be refused: a phrase that a table of embeddings does not hold.
    let embed = stages::Embed { encoder: encoder.clone(), texts: plan.queries.clone() };
    let queries = build.graph.add(embed, ());
    let masks = sources::make::<Masks>(&plan.masks, &registry, (build, posed))?;
    let matches = sources::make::<Matches>(&plan.matcher, &registry, (build, posed))?;
    let graph = &mut build.graph;
    let regions = graph.add(stages::Regions { encoder: encoder.clone() }, (placed, masks));
    let (recipe, seed, space) = (plan.recipe(), plan.seed, encoder.space().to_owned());
    let aligned = graph.add(stages::Align { recipe, space, seed }, (regions, matches, geometry));
    let names = graph.add(stages::Name { encoder }, (aligned,));

    let options = plan.language_options(preset);
    let language = graph.add(stages::TrainLanguage { recipe, options }, (placed, trained, aligned));
    let frames = graph.add(stages::Decode, (trained, language));
    let answers = graph.add(stages::Answer, (frames, language, queries));
    Ok(Scene { placed, geometry, trained, aligned, names, language, frames, answers })
}
