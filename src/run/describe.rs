//! The part of a run that needs no GPU: what the photos show, in masks, features and words. It runs beside geometry and
//! training, which leave the processor mostly idle where the device is a GPU.
use super::{Networks, RunPlan, sources};
use crate::infer::{RegionEncoder, Registry};
use crate::language::{self, Language, ViewMasks, sam};
use crate::photo::Photo;
use crate::pose::Geometry;
use crate::progress::Progress;
use crate::query::TextQuery;
use crate::report::viewer::Names;
use crate::scene::RgbImage;
use crate::{Error, Result};

/// What it needs.
pub(super) struct Describer<'a> {
    pub plan: &'a RunPlan,
    pub photos: &'a [Photo],
    pub networks: &'a Networks,
    pub images: &'a [RgbImage],
    pub registry: &'a Registry,
    /// Masks from a folder; built-in ones otherwise.
    pub given: Option<Vec<ViewMasks>>,
    pub encoder: Box<dyn RegionEncoder>,
}

/// What it finds.
pub(super) struct Described {
    /// The plan's queries.
    pub queries: Vec<TextQuery>,
    /// Codebooks, targets and the alignment behind them.
    pub language: Language,
    /// The text model's own phrases per level and code.
    pub names: Names,
}

impl Describer<'_> {
    /// Does what the photos alone allow, then takes the geometry from `geometry`, which may wait for it.
    pub fn run<'g>(
        mut self,
        geometry: impl FnOnce() -> Result<&'g Geometry>,
        progress: &dyn Progress,
    ) -> Result<Described> {
        // First what can be refused: a phrase that a table of embeddings does not hold.
        let queries = sources::queries(&self.plan.queries, self.encoder.as_mut())?;
        // What needs no geometry comes before it: learned edges or a network's masks, descriptors or a network's warps.
        if let (None, Some(model)) = (&self.given, &self.networks.masks) {
            let masks = sam::masks(model, self.images, &self.plan.sam, progress)?;
            let some = masks.iter().flat_map(|m| &m.levels).any(|l| !l.quality.is_empty());
            // Untrained weights rarely give a stable mask; the stages after this one need some to work on.
            if some || !model.untrained() {
                self.given = Some(masks);
            } else {
                progress.warn(&format!(
                    "{}: no mask passes in untrained weights; built-in masks instead",
                    model.name
                ));
            }
        }
        let edges = match &self.given {
            Some(_) => Vec::new(),
            None => sources::edges(self.images, self.registry, progress)?,
        };
        let (warped, dense) = match &self.networks.matcher {
            Some(model) => (Some(sources::network_matches(model, self.photos, progress)?), Vec::new()),
            None => (None, sources::dense(self.images, self.registry, progress)?),
        };
        let geometry = geometry()?;
        let masks = match self.given.take() {
            Some(masks) => masks,
            None => sources::graph_masks(self.images, &edges, geometry, progress)?,
        };
        let masks = sources::with_features(masks, self.images, self.encoder.as_mut(), progress)?;
        let matches = match warped {
            Some(links) => links,
            None => sources::matches(&dense, geometry, progress)?,
        };
        let options = self.plan.recipe().build(self.encoder.space(), self.plan.seed);
        let (cameras, depths) = (&geometry.cameras, &geometry.depths);
        let language = language::build(&masks, cameras, depths, &matches, &options, progress)?;
        // As many as the page shows beside a selected thing.
        let names = super::ask::names(self.encoder.as_mut(), &language.field, super::ask::NAMES)?;
        Ok(Described { queries, language, names })
    }
}

/// The results of two lanes; of two errors the one that is not the mere consequence of the other.
pub(super) fn both<A, B>(front: Result<A>, beside: Result<B>) -> Result<(A, B)> {
    match (front, beside) {
        (Ok(a), Ok(b)) => Ok((a, b)),
        (Err(Error::Cancelled), Err(e)) | (Err(e), _) | (_, Err(e)) => Err(e),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cause_is_reported_and_not_the_stop_it_caused() {
        let cause = || Error::input("bad mask");
        let text = |r: Result<((), ())>| r.unwrap_err().to_string();
        assert_eq!(text(both(Err(Error::Cancelled), Err(cause()))), "bad mask");
        assert_eq!(text(both(Err(cause()), Err(Error::Cancelled))), "bad mask");
        assert_eq!(text(both(Ok(()), Err(cause()))), "bad mask");
        assert!(matches!(both::<(), ()>(Err(Error::Cancelled), Ok(())), Err(Error::Cancelled)));
    }
}
