//! Arithmetic that several folders share; depends on nothing else here.
mod random;
mod statistics;

pub use random::Random;
pub use statistics::{median, quantile};
