//! For the tests and the laboratory of splatvk: the breakfast photos with their truth
//! ([`breakfast`]), an embedding space made by rule ([`embedding`]), ONNX files built byte by byte
//! ([`onnx`]), photos with exact depth ([`stereo`]), and toy networks ([`toys`]).
#![allow(clippy::unwrap_used, missing_docs)] // a panic is how a test fails

pub mod breakfast;
pub mod embedding;
pub mod onnx;
pub mod stereo;
pub mod toys;
