//! For the tests of splatvk: the breakfast photos with their truth ([`breakfast`]), ONNX files
//! built byte by byte ([`onnx`]), photos with exact depth ([`stereo`]), and toy networks
//! ([`toys`]).
#![allow(clippy::unwrap_used, missing_docs)] // a panic is how a test fails

pub mod breakfast;
pub mod onnx;
pub mod stereo;
pub mod toys;
