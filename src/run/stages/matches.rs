//! Photos → dense matches between every two of them.
use super::Placed;
use crate::Result;
use crate::infer::installed::Installed;
use crate::infer::xfeat::DenseFeatures;
use crate::language::align::PairLinks;
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::pose::Geometry;
use crate::run::sources;

/// Dense descriptors of every photo.
pub struct Descriptors;

impl Stage for Descriptors {
    const NAME: &'static str = "descriptors";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Placed>,);
    type Output = Vec<DenseFeatures>;

    fn settings(&self) -> String {
        String::new()
    }

    fn run(self, (placed,): (&Placed,), context: &Context) -> Result<Vec<DenseFeatures>> {
        sources::dense(&super::images(&placed.photos), context.registry, context.progress)
    }
}

/// Descriptors compared along epipolar lines.
pub struct DescriptorMatches;

impl Stage for DescriptorMatches {
    const NAME: &'static str = "matches";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Vec<DenseFeatures>>, Output<Geometry>);
    type Output = Vec<PairLinks>;

    fn settings(&self) -> String {
        String::new()
    }

    fn codec() -> Option<Codec<Vec<PairLinks>>> {
        kept()
    }

    fn run(
        self,
        (dense, geometry): (&Vec<DenseFeatures>, &Geometry),
        context: &Context,
    ) -> Result<Vec<PairLinks>> {
        sources::matches(dense, geometry, context.progress)
    }
}

/// Warps of a dense matching network.
pub struct NetworkMatches {
    model: Installed,
    settings: String,
}

impl NetworkMatches {
    /// The network.
    pub fn new(model: Installed) -> Result<NetworkMatches> {
        let settings = super::identity(&model)?;
        Ok(NetworkMatches { model, settings })
    }
}

impl Stage for NetworkMatches {
    const NAME: &'static str = "network-matches";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Placed>,);
    type Output = Vec<PairLinks>;

    fn settings(&self) -> String {
        self.settings.clone()
    }

    fn codec() -> Option<Codec<Vec<PairLinks>>> {
        kept()
    }

    fn run(self, (placed,): (&Placed,), context: &Context) -> Result<Vec<PairLinks>> {
        sources::network_matches(&self.model, &placed.photos, context.progress)
    }
}
