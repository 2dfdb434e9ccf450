//! File formats and the scene directory.
