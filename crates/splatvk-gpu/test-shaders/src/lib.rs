//! The shaders in `shaders/`, with their generated bindings.
include!(concat!(env!("OUT_DIR"), "/shaders.rs"));
