//! The stages of `splatvk run`.
use super::networks::Networks;
use super::stages::{self, CameraSource, Placed, SharedEncoder};
use super::{
    Answers, FeatureSource, InitSource, MaskSource, RunPlan, language_options, rgb_options, sources,
};
use crate::Result;
use crate::fit::{Preset, Trained, TrainedLanguage};
use crate::format::cameras;
use crate::gpu::Device;
use crate::infer::Registry;
use crate::language::{Language, ViewMasks};
use crate::photo::Photo;
use crate::pipeline::{Graph, Output};
use crate::pose::Geometry;
use crate::report::viewer::Names;
use crate::run::view::DecodedFrame;

/// What a run asks of its stages.
pub(super) struct Scene {
    pub(super) placed: Output<Placed>,
    pub(super) geometry: Output<Geometry>,
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

/// Adds the stages of a plan. Within a lane they start in this order, so what needs no geometry comes before what does.
pub(super) fn scene(
    graph: &mut Graph,
    plan: &RunPlan,
    preset: Preset,
    device: &Device,
    photos: Vec<Photo>,
    networks: &Networks,
    registry: &Registry,
) -> Result<Scene> {
    let source = match (&plan.init, &networks.geometry) {
        (InitSource::Cameras(file), _) => CameraSource::Known(cameras::read(file)?),
        (InitSource::Given(cameras), _) => CameraSource::Known(cameras.clone()),
        (InitSource::Network(_), Some(model)) => CameraSource::Network(model.clone()),
        (InitSource::Sfm | InitSource::Network(_), _) => CameraSource::Sfm,
    };
    let encoder = SharedEncoder::new(
        sources::encoder(&plan.features, registry)?,
        sources::encoder_identity(&plan.features, registry)?,
    );
    let colour = rgb_options(plan, preset, device, photos.len());

    let placed = graph.add(stages::Cameras::new(photos, source)?, ());
    let geometry = graph.add(stages::Depth { preset }, (placed,));
    let trained = graph.add(stages::TrainColour { options: colour }, (placed, geometry));

    // First what can be refused: a phrase that a table of embeddings does not hold.
    let queries = graph.add(stages::Embed { encoder: encoder.clone(), texts: plan.queries.clone() }, ());
    let masks = masks(graph, plan, networks, placed, geometry)?;
    let matches = match &networks.matcher {
        Some(model) => graph.add(stages::NetworkMatches::new(model.clone())?, (placed,)),
        None => {
            let descriptors = graph.add(stages::Descriptors, (placed,));
            graph.add(stages::DescriptorMatches, (descriptors, geometry))
        }
    };
    let regions = graph.add(stages::Regions { encoder: encoder.clone() }, (placed, masks));
    let (recipe, seed, space) = (plan.recipe(), plan.seed, encoder.space().to_owned());
    let aligned = graph.add(stages::Align { recipe, space, seed }, (regions, matches, geometry));
    let names = graph.add(stages::Name { encoder }, (aligned,));

    let options = language_options(plan, preset);
    let language = graph.add(stages::TrainLanguage { recipe, options }, (placed, trained, aligned));
    let frames = graph.add(stages::Decode, (trained, language));
    let answers = graph.add(stages::Answer, (frames, language, queries));
    Ok(Scene { placed, geometry, trained, aligned, names, language, frames, answers })
}

fn masks(
    graph: &mut Graph,
    plan: &RunPlan,
    networks: &Networks,
    placed: Output<Placed>,
    geometry: Output<Geometry>,
) -> Result<Output<Vec<ViewMasks>>> {
    if let MaskSource::Dir(dir) = &plan.masks {
        let features = matches!(plan.features, FeatureSource::Dir(_));
        return Ok(graph.add(stages::GivenMasks { dir: dir.clone(), features }, (placed,)));
    }
    let of_network = match &networks.masks {
        Some(model) => Some(graph.add(stages::NetworkMasks::new(model.clone(), plan.sam)?, (placed,))),
        None => None,
    };
    if let (Some(found), Some(model)) = (of_network, &networks.masks)
        && !model.untrained()
    {
        return Ok(found);
    }
    let edges = graph.add(stages::Edges, (placed,));
    let built_in = graph.add(stages::GraphMasks, (placed, edges, geometry));
    Ok(of_network.map_or(built_in, |found| graph.add(stages::MasksOr, (found, built_in))))
}
