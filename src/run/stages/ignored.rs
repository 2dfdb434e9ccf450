//! Photos and texts → the pixels of the things that the texts name.
use super::cameras::PlacedPhotos;
use super::language::SharedEncoder;
use super::shared;
use crate::Result;
use crate::infer::concepts::Concepts;
use crate::infer::installed::Installed;
use crate::language::ViewMasks;
use crate::pipeline::{Context, Lane, Output, Stage};
use crate::query::photos::{self, PhotoRegions};
use crate::query::{QueryOptions, TextQuery};
use crate::scene::Image;

/// Per text and photo the pixels of its things, [H, W].
pub type FoundPixels = Vec<Vec<Image<bool>>>;

/// Things found by the features of regions.
pub struct FindByWords {
    /// Encoder of the features.
    pub encoder: SharedEncoder,
    /// Embedded texts.
    pub queries: Vec<TextQuery>,
}

impl Stage for FindByWords {
    const NAME: &'static str = "ignore-words";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<Vec<ViewMasks>>,);
    type Output = FoundPixels;

    fn settings(&self) -> String {
        let texts: Vec<&str> = self.queries.iter().map(|q| q.text.as_str()).collect();
        format!("{} {texts:?}", self.encoder.identity())
    }

    fn run(self, (masks,): (&Vec<ViewMasks>,), context: &Context) -> Result<FoundPixels> {
        let progress = context.progress;
        progress.begin("ignore", self.queries.len() as u64);
        let space = self.encoder.space();
        let regions: Vec<PhotoRegions> =
            masks.iter().map(|m| PhotoRegions::new(m, space)).collect::<Result<_>>()?;
        let mut found = Vec::with_capacity(self.queries.len());
        for query in &self.queries {
            progress.check()?;
            found.push(photos::named(&regions, query, &QueryOptions::default())?.masks);
            progress.step(found.len() as u64, &query.text);
        }
        progress.end();
        Ok(found)
    }
}

/// Things found by a concept network.
pub struct FindByNetwork {
    model: Installed,
    texts: Vec<String>,
    settings: String,
}

impl FindByNetwork {
    /// Prepares the search for `texts`.
    pub fn new(model: Installed, texts: &[String]) -> Result<FindByNetwork> {
        let settings = format!("{} {texts:?}", shared::identity(&model)?);
        Ok(FindByNetwork { model, texts: texts.to_vec(), settings })
    }
}

impl Stage for FindByNetwork {
    const NAME: &'static str = "ignore-network";
    const LANE: Lane = Lane::Processor;
    type Inputs = (Output<PlacedPhotos>,);
    type Output = FoundPixels;

    fn settings(&self) -> String {
        self.settings.clone()
    }

    fn run(self, (placed,): (&PlacedPhotos,), context: &Context) -> Result<FoundPixels> {
        let progress = context.progress;
        let mut network = Concepts::load(self.model)?;
        let texts: Vec<&str> = self.texts.iter().map(String::as_str).collect();
        progress.begin("ignore", placed.photos.len() as u64);
        let mut found: FoundPixels = vec![Vec::new(); texts.len()];
        for (done, photo) in placed.photos.iter().enumerate() {
            progress.check()?;
            let (width, height) = (photo.image.width, photo.image.height);
            for (masks, of_text) in found.iter_mut().zip(network.find(&photo.image, &texts)?) {
                masks.push(of_text.mask(width, height));
            }
            progress.step(done as u64 + 1, &photo.stem);
        }
        progress.end();
        Ok(found)
    }
}
