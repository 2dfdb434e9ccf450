//! Photos and geometry → splats.
use super::cameras::PlacedPhotos;
use super::shared;
use crate::Result;
use crate::fit::{self, RgbOptions, Trained, ViewDependentOptions};
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::pose::Geometry;
use crate::progress::Progress;
use crate::run::preview::{Preview, Renewals, Renewing};

/// The colour stage.
pub struct TrainColour {
    /// Options of the training.
    pub options: RgbOptions,
    /// Where to show a preview while it runs.
    pub preview: Option<Preview>,
}

impl Stage for TrainColour {
    const NAME: &'static str = "splats";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<PlacedPhotos>, Output<Geometry>);
    type Output = Trained;

    fn settings(&self) -> String {
        format!("{:?}", self.options)
    }

    fn codec() -> Option<Codec<Trained>> {
        kept()
    }

    fn run(self, (placed, geometry): (&PlacedPhotos, &Geometry), context: &Context) -> Result<Trained> {
        let depths = (!geometry.depths.is_empty()).then_some(geometry.depths.as_slice());
        let (targets, coverage) = shared::targets(&placed.photos);
        let photos = shared::posed(&targets, &geometry.cameras, depths, &coverage);
        let options = &self.options;
        let train = |progress: &dyn Progress| fit::train_photos(context.device, photos, &geometry.points, options, progress);
        let Some(preview) = &self.preview else { return train(context.progress) };
        let renewals = Renewals::new();
        std::thread::scope(|scope| {
            scope.spawn(|| preview.show(placed, geometry, options, &renewals, context.progress));
            train(&Renewing { progress: context.progress, to: &renewals })
        })
    }
}

/// Fits view-dependent colour where the photos support it.
pub struct ViewDependence {
    /// Options of the fit.
    pub options: ViewDependentOptions,
}

impl Stage for ViewDependence {
    const NAME: &'static str = "view dependence";
    const LANE: Lane = Lane::Device;
    type Inputs = (Output<PlacedPhotos>, Output<Trained>);
    type Output = Trained;

    fn settings(&self) -> String {
        format!("{:?}", self.options)
    }

    fn codec() -> Option<Codec<Trained>> {
        kept()
    }

    fn run(self, (placed, trained): (&PlacedPhotos, &Trained), context: &Context) -> Result<Trained> {
        let (images, coverage) = shared::targets(&placed.photos);
        // If every photo shows the same points equally bright, no degree is tried.
        let matt = placed.photos.iter().all(|p| p.light.explains_the_photo());
        let degree = self.options.degree.or(matt.then_some(0));
        let options = ViewDependentOptions { degree, ..self.options };
        let trained = trained.clone();
        fit::fit_view_dependent(context.device, &images, &coverage, trained, &options, context.progress)
    }
}
