//! `splatvk models fetch` with a local server: failures of networks, disks and processes; a model
//! is complete or absent.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
#[allow(dead_code)] // other tests use the rest
#[path = "../fixture/command.rs"]
mod command;
mod download;
mod full_size;
mod models;
mod server;

use sha2::{Digest, Sha256};

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}
