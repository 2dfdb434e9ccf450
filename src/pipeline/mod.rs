//! Work as a graph of stages: each says what it needs, what it makes and what that depends on; when a stage may run, beside
//! which others, and whether its output is still there from an earlier run follows from that.
mod graph;
#[cfg(test)]
mod lost_device_tests;
mod output;
mod stage;
mod store;
#[cfg(test)]
mod tests;

pub use graph::{Graph, Made};
pub use output::{Inputs, Output};
pub use stage::{Context, Lane, Stage};
pub use store::{Codec, Key, Store, kept};
