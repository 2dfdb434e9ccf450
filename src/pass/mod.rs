//! One file per GPU pass, each with its CPU twin.
