//! Training: losses, schedules, pruning, pose refinement.
