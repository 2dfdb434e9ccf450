//! The published evaluation protocols, from their public file layouts
//! (docs/internals/method.md#protocols).
//!
//! [`open`] reads a data set's labels and lists the cameras to render and the texts to query; the
//! caller renders and decodes each frame and passes it to [`Protocol::add`]; [`Protocol::finish`]
//! returns the scores with their definitions. The project's own protocol, `field`, is
//! [`splatvk::eval`].
mod answers;
mod labels;
mod lerf;
mod ovs;
mod polygon;
mod scannet;
mod score;

#[cfg(test)]
mod tests;

pub use answers::{Asked, Clicked, Counts, Kind, Named, Photographs, Texts};
pub use labels::Labels;
pub use score::{
    CodeScores, DecodedView, LabelledView, Masks, Protocol, ProtocolKind, ProtocolReport, ProtocolSummary,
    Score,
};

use crate::Result;
use splatvk::scene::Camera;
use std::path::Path;

/// Reads the labels of a folder, frame by frame.
pub fn labels(kind: ProtocolKind, folder: &Path) -> Result<Labels> {
    match kind {
        ProtocolKind::Lerf => lerf::labels(folder),
        ProtocolKind::Ovs => ovs::labels(folder),
        ProtocolKind::ScanNet => scannet::labels(folder),
    }
}

/// Opens a data set under a protocol. `scene` holds the scene's cameras; `known` the data set's own
/// cameras, which place the frames that the scene was not made from (without them only the scene's
/// own photos are scored).
pub fn open(
    kind: ProtocolKind,
    folder: &Path,
    scene: &[Camera],
    known: &[Camera],
) -> Result<Box<dyn Protocol>> {
    Ok(match kind {
        ProtocolKind::Lerf => Box::new(lerf::Lerf::open(folder, scene, known)?),
        ProtocolKind::Ovs => Box::new(ovs::Ovs::open(folder, scene, known)?),
        ProtocolKind::ScanNet => Box::new(scannet::ScanNet::open(folder, scene, known)?),
    })
}
