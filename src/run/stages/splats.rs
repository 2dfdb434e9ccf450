//! Photos and geometry → splats.
use super::cameras::PlacedPhotos;
use super::shared;
use crate::Result;
use crate::fit::{self, RgbOptions, Trained};
use crate::pipeline::{Codec, Context, Lane, Output, Stage, kept};
use crate::pose::Geometry;

/// The colour stage.
pub struct TrainColour {
    /// How.
    pub options: RgbOptions,
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
        fit::train_rgb(
            context.device,
            &shared::images(&placed.photos),
            &geometry.cameras,
            &geometry.points,
            depths,
            &self.options,
            context.progress,
        )
    }
}
