//! Work as a graph of stages. Each declares its inputs, its output and the dependencies of the
//! output. The graph derives when a stage may run, which stages run in parallel, and whether an
//! output of an earlier run is still valid.
mod graph;
mod output;
mod stage;
mod store;
#[cfg(test)]
mod tests;

pub(crate) use graph::program;
pub use graph::{Graph, Outputs};
pub use output::{Inputs, Output};
pub use stage::{Context, Lane, Stage};
pub use store::{Codec, Key, Store, kept};
