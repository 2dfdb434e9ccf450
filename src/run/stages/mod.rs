//! The stages of the commands, one kind of work per file. Each declares its inputs and its settings
//! ([`crate::pipeline`]); the commands are lists of them.
mod added;
mod answers;
mod cameras;
mod given;
mod ignored;
mod language;
pub mod masks;
mod matches;
mod prior;
mod shared;
mod splats;

pub use added::{AddedCameras, AddedDepth, AlignAdded, KnownUp, OnlyAdded, OnlyAddedGeometry, TrainOn};
pub use answers::{AnswerQueries, DecodeViews};
pub use cameras::{CameraOrigin, Cameras, DenseDepth, KnownGeometry, PlacedPhotos, Upright};
pub use given::{GivenGeometry, GivenPhotos, GivenSplats, GivenViews, LiftLanguage, ReprojectedMatches};
pub use ignored::{FindByNetwork, FindByWords};
pub use language::{Align, EmbedQueries, NameCodes, SharedEncoder, TrainLanguage};
pub use masks::{
    ContourMaps, GivenMasks, GraphMasks, MasksOrFallback, NetworkMasks, RegionFeatures, SurfaceFeatures,
};
pub use matches::{DescriptorMatches, Descriptors, NetworkMatches};
pub use prior::{DepthPriors, PriorOrigin};
pub use shared::{identity, keypoints};
pub use splats::{TrainColour, ViewDependence};
