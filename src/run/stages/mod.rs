//! The stages of the commands, one kind of work per file. Each says what it needs and what it depends on
//! ([`crate::pipeline`]); the commands are lists of them.
mod answers;
mod cameras;
mod language;
mod masks;
mod matches;
mod splats;

pub use answers::{Answer, Decode};
pub use cameras::{CameraSource, Cameras, Depth, Placed};
pub use language::{Align, Embed, Name, SharedEncoder, TrainLanguage};
pub use masks::{Edges, GivenMasks, GraphMasks, MasksOr, NetworkMasks, Regions};
pub use matches::{DescriptorMatches, Descriptors, NetworkMatches};
pub use splats::TrainColour;

use crate::Result;
use crate::infer::installed::Installed;
use crate::scene::RgbImage;

/// The working images of photos.
fn images(photos: &[crate::photo::Photo]) -> Vec<RgbImage> {
    photos.iter().map(|p| p.image.clone()).collect()
}

/// What an installed network is, for [`crate::pipeline::Stage::settings`].
pub fn identity(model: &Installed) -> Result<String> {
    let sums: Vec<String> = model.files()?.into_iter().map(|(_, sha256)| sha256).collect();
    Ok(format!("{} {sums:?}", model.name))
}
