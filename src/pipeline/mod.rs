//! Work as a graph of stages: each declares its inputs, its output and what that depends on; when a
//! stage may run, beside which others, and whether its output is still there from an earlier run
//! follows from that.
mod graph;
mod output;
mod stage;
mod store;
#[cfg(test)]
mod tests;

pub use graph::{Graph, Outputs};
pub use output::{Inputs, Output};
pub use stage::{Context, Lane, Stage};
pub use store::{Codec, Key, Store, kept};
