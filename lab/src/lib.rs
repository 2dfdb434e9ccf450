//! The laboratory of splatvk: the tables of the paper's experiments ([`ablate`]), its pictures
//! ([`figures`]), data with ground truth ([`generate`]), the alignment alone ([`alignment`]),
//! quality against seconds of training ([`curve`]), panoptic quality ([`panoptic`]), sizes of
//! things ([`sizes`]), evaluation protocols ([`protocol`]), and their commands ([`cli`], program
//! `splatlab`). It is not part of the installed program.
#![warn(missing_docs)]
// [N, 3] in the docs states a shape; rustdoc takes it for a link.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod ablate;
pub mod alignment;
pub mod cli;
pub mod curve;
pub mod figures;
pub mod generate;
pub mod panoptic;
pub mod protocol;
pub mod sizes;

pub use splatvk::{Error, Result};
