//! The graph of a setup, from photos to scores.
use super::super::colmap::StartFromPoints;
use super::super::data::Layout;
use super::super::setup::{Regime, Regions, Setup};
use super::super::stages::{
    EncoderEmbeddings, LabelEmbeddings, LabelledMasks, MaskEmbeddings, ObjectEmbeddings, Score,
    ScorePublished, Scored, SyntheticEmbeddings, SyntheticMasks,
};
use super::{Encoder, Runner};
use crate::Result;
use crate::generate::regions::{self, InjectedErrors};
use splatvk::eval::TruthFrame;
use splatvk::fit::{DensifyOptions, RgbOptions, Trained, TrainedLanguage};
use splatvk::language::{Language, ViewMasks};
use splatvk::photo::{self, Photo};
use splatvk::pipeline::{Graph, Output};
use splatvk::pose::Geometry;
use splatvk::query::TextQuery;
use splatvk::run::compat::query_options;
use splatvk::run::sources::{
    self, DepthSources, GeometrySources, GraphBuilder, MaskSources, MatchSources, PosedPhotos,
};
use splatvk::run::stages::{self, CameraOrigin, PlacedPhotos};
use splatvk::scene::Camera;
use std::path::PathBuf;

/// Graph of a setup, with the outputs that [`Runner`] reads.
pub(super) struct Stages {
    pub(super) build: GraphBuilder,
    pub(super) placed: Output<PlacedPhotos>,
    pub(super) geometry: Output<Geometry>,
    pub(super) trained: Output<Trained>,
    pub(super) aligned: Output<Language>,
    pub(super) language: Output<TrainedLanguage>,
    pub(super) scored: Output<Scored>,
    /// Queries of the evaluation's phrases, in its order.
    pub(super) queries: Vec<TextQuery>,
}

impl Runner<'_> {
    /// Builds the graph of a setup, up to its scores.
    pub(super) fn stages(&mut self, setup: &Setup) -> Result<Stages> {
        let regime = setup.regime;
        let frames = self.frames(setup.views)?;
        let photos = self.photos(&frames)?;
        let registry = self.registry;
        let given_features =
            matches!(&setup.regions, Regions::Found { features, .. } if features.argument.is_some());
        let mut build = self.graph_builder(regime, given_features);
        let posed = if setup.true_cameras {
            build.posed(photos, known_cameras(&frames))?
        } else {
            sources::make::<GeometrySources>(&setup.init, registry, (&mut build, photos))?
        };
        let PosedPhotos { placed, geometry } = posed;
        let matches = sources::make::<MatchSources>(&setup.matcher, registry, (&mut build, posed))?;
        let options = self.rgb_options(setup);
        let start = match setup.points.clone() {
            Some(model) => build.graph.add(StartFromPoints { model }, (geometry,)),
            None => geometry,
        };
        let trained = build.graph.add(stages::TrainColour { options, preview: None }, (placed, start));
        let RegionData { masks, embeddings, queries, space } = self.add_regions(setup, &mut build, posed)?;
        let (recipe, seed) = (setup.recipe, self.seed);
        let aligned = build.graph.add(stages::Align { recipe, space, seed }, (masks, matches, geometry));
        let options = regime.language(setup.language_iterations, seed);
        let language = build.graph.add(stages::TrainLanguage { recipe, options }, (placed, trained, aligned));
        let scene = (trained, language, embeddings);
        let scored = match self.data.layout {
            Layout::Own => {
                let options = query_options(regime.compat);
                build.graph.add(Score { truth: self.truth.clone(), queries: queries.clone(), options }, scene)
            }
            Layout::Published(kind) => {
                let score = ScorePublished { data: self.data.clone(), kind, queries: queries.clone() };
                build.graph.add(score, scene)
            }
        };
        Ok(Stages { build, placed, geometry, trained, aligned, language, scored, queries })
    }

    pub(super) fn graph_builder(&self, regime: Regime, given_features: bool) -> GraphBuilder {
        GraphBuilder {
            graph: Graph::default(),
            registry: self.registry.clone(),
            sam: regime.sam(),
            given_features,
            depth_prior: sources::default::<DepthSources>(),
            preset: regime.preset,
            seed: self.seed,
        }
    }

    pub(super) fn photos(&self, frames: &[TruthFrame]) -> Result<Vec<Photo>> {
        let paths: Vec<PathBuf> = frames.iter().map(|f| self.truth.folder.join(&f.file)).collect();
        photo::load_all(&paths, self.progress)
    }

    fn rgb_options(&self, setup: &Setup) -> RgbOptions {
        let mut options = RgbOptions::preset(setup.regime.preset).with_iterations(setup.iterations);
        options.seed = self.seed;
        options.init.max_points = setup.max_points.unwrap_or(options.init.max_points);
        if setup.points.is_some() {
            // Sparse points do not cover the surfaces.
            options.densify.get_or_insert(DensifyOptions::PUBLISHED);
        }
        setup.recipe.rgb(options)
    }

    /// Adds the stages of masks with features and of the true embeddings of objects in their space.
    fn add_regions(
        &mut self,
        setup: &Setup,
        build: &mut GraphBuilder,
        posed: PosedPhotos,
    ) -> Result<RegionData> {
        let (truth, placed) = (self.truth.clone(), posed.placed);
        let (masks, features) = match &setup.regions {
            Regions::Found { masks, features } => (masks, features),
            Regions::Exact => return Ok(self.synthetic(InjectedErrors::NONE, build, posed)),
            Regions::Flawed => {
                return Ok(self.synthetic(InjectedErrors::default_rates(self.seed), build, posed));
            }
            Regions::TrueSegmentation { features } => {
                let Encoder { encoder, queries, .. } = self.encoder(features)?;
                let (encoder, queries) = (encoder.clone(), queries.clone());
                let masks = LabelledMasks { truth: truth.clone(), encoder: encoder.clone() };
                let space = encoder.space().to_owned();
                return Ok(RegionData {
                    masks: build.graph.add(masks, (placed,)),
                    embeddings: build.graph.add(LabelEmbeddings { truth, encoder }, ()),
                    queries,
                    space,
                });
            }
        };
        let registry = self.registry;
        let Encoder { encoder, queries, .. } = self.encoder(features)?;
        let (encoder, queries, space) = (encoder.clone(), queries.clone(), encoder.space().to_owned());
        let found = sources::make::<MaskSources>(masks, registry, (build, posed))?;
        let masks = build.graph.add(stages::RegionFeatures { encoder: encoder.clone() }, (placed, found));
        let embeddings = if features.argument.is_some() {
            build.graph.add(MaskEmbeddings { truth }, (placed, masks))
        } else {
            build.graph.add(EncoderEmbeddings { truth, encoder }, (placed,))
        };
        Ok(RegionData { masks, embeddings, queries, space })
    }

    /// Adds the stages of true masks with synthetic features.
    fn synthetic(
        &self,
        flaws: InjectedErrors,
        build: &mut GraphBuilder,
        PosedPhotos { placed, .. }: PosedPhotos,
    ) -> RegionData {
        let truth = self.truth.clone();
        RegionData {
            masks: build.graph.add(SyntheticMasks { truth: truth.clone(), flaws }, (placed,)),
            embeddings: build.graph.add(SyntheticEmbeddings { truth, flaws }, (placed,)),
            queries: self.phrases().iter().map(|p| regions::query(p)).collect(),
            space: "synthetic".into(),
        }
    }
}

/// The true cameras of frames, each with the name of its photo.
pub(super) fn known_cameras(frames: &[TruthFrame]) -> CameraOrigin {
    let camera = |f: &TruthFrame| Camera { name: f.stem.clone(), ..f.camera.clone() }.into();
    CameraOrigin::Known(frames.iter().map(camera).collect::<Vec<_>>().into())
}

/// Outputs and queries of [`Runner::add_regions`].
struct RegionData {
    masks: Output<Vec<ViewMasks>>,
    embeddings: Output<ObjectEmbeddings>,
    queries: Vec<TextQuery>,
    space: String,
}
