//! The stages of the commands, one kind of work per file. Each says what it needs and what it depends on
//! ([`crate::pipeline`]); the commands are lists of them.
mod answers;
mod cameras;
mod language;
pub mod masks;
mod matches;
mod shared;
mod splats;

pub use answers::{Answer, Decode};
pub use cameras::{CameraSource, Cameras, Depth, Placed};
pub use language::{Align, Embed, Name, SharedEncoder, TrainLanguage};
pub use masks::{Edges, GivenMasks, GraphMasks, MasksOr, NetworkMasks, Regions};
pub use matches::{DescriptorMatches, Descriptors, NetworkMatches};
pub use shared::identity;
pub use splats::TrainColour;
