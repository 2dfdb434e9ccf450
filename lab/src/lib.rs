//! The laboratory of splatvk: the tables of the paper's experiments ([`ablate`]), data with ground
//! truth ([`generate`]), and their commands ([`cli`], program `splatlab`). Nothing that a user
//! installs contains it.
#![warn(missing_docs)]
// [N, 3] in the docs states a shape; rustdoc takes it for a link.
#![allow(rustdoc::broken_intra_doc_links)]

pub mod ablate;
pub mod cli;
pub mod generate;

pub use splatvk::{Error, Result};
