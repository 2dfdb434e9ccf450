//! Photos → dense matches between every pair of them.
use super::cameras::PlacedPhotos;
use super::shared;
use crate::Result;
use crate::infer::installed::Installed;
use crate::infer::warp;
use crate::infer::xfeat::{DenseFeatures, XFeat};
use crate::language::align::{PairLinks, links_from_warps};
use crate::language::matcher;
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::pose::Geometry;

/// Dense descriptors of every photo.
pub struct Descriptors;

impl Stage for Descriptors {
    const NAME: &'static str = "descriptors";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Vec<DenseFeatures>;

    fn settings(&self) -> String {
        String::new()
    }

    fn run(self, (placed,): (&PlacedPhotos,), context: &Context) -> Result<Vec<DenseFeatures>> {
        let progress = context.progress;
        progress.begin("descriptors", placed.photos.len() as u64);
        let mut xfeat = XFeat::load(context.registry)?;
        let mut dense = Vec::with_capacity(placed.photos.len());
        for photo in &placed.photos {
            progress.check()?;
            dense.push(xfeat.dense(&photo.image)?);
            progress.step(dense.len() as u64, "");
        }
        progress.end();
        Ok(dense)
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
        let progress = context.progress;
        let pairs: Vec<(usize, usize)> = pairs(dense.len()).collect();
        progress.begin("match", pairs.len() as u64);
        let mut links = Vec::with_capacity(pairs.len());
        for (i, j) in pairs {
            progress.check()?;
            let cameras = (&geometry.cameras[i], &geometry.cameras[j]);
            let (forward, backward) = matcher::xfeat(&dense[i], &dense[j], cameras);
            links.push(links_from_warps(i, j, &forward, &backward));
            progress.step(links.len() as u64, "");
        }
        progress.end();
        Ok(links)
    }
}

/// Warps of a dense matching network.
pub struct NetworkMatches {
    model: Installed,
    settings: String,
}

impl NetworkMatches {
    /// Prepares the matching by a network.
    pub fn new(model: Installed) -> Result<NetworkMatches> {
        let settings = shared::identity(&model)?;
        Ok(NetworkMatches { model, settings })
    }
}

impl Stage for NetworkMatches {
    const NAME: &'static str = "network-matches";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = Vec<PairLinks>;

    fn settings(&self) -> String {
        self.settings.clone()
    }

    fn codec() -> Option<Codec<Vec<PairLinks>>> {
        kept()
    }

    fn run(self, (placed,): (&PlacedPhotos,), context: &Context) -> Result<Vec<PairLinks>> {
        let mut warps = warp::warps(&self.model, &placed.photos, context.progress)?.into_iter();
        let links = |((i, j), (there, back)): (_, (_, _))| links_from_warps(i, j, &there, &back);
        Ok(pairs(placed.photos.len()).zip(&mut warps).map(links).collect())
    }
}

/// Every unordered pair of views.
fn pairs(views: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..views).flat_map(move |i| (i + 1..views).map(move |j| (i, j)))
}
