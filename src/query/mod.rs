//! Text queries and evaluation.
