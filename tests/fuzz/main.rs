//! Every reader of untrusted bytes with damaged files: no panic, a result within a second, memory
//! in proportion to the file (docs/use/formats.md#limits), and errors that blame the input.
//!
//! Coverage-guided fuzzers need a nightly compiler, and on stable Rust their front ends only
//! generate random bytes; so valid files are damaged here ([`mutate`]), contents of containers with
//! corrected checksums and lengths ([`readers`]).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // a panic is how a test fails
mod heap;
mod mutate;
mod readers;
mod regressions;
mod seeds;

use heap::Heap;
use mutate::Random;
use readers::{Reader, Verdict};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use tempfile::TempDir;

#[global_allocator]
static HEAP: Heap = Heap::new();

/// One reader at a time: the peak of the heap is that of the whole process.
static ONE: Mutex<()> = Mutex::new(());

/// Default duration, seconds, all readers together.
const SECONDS: u64 = 20;

/// Number of findings after which the next reader runs.
const MOST_FINDINGS: usize = 5;

/// `SPLATVK_FUZZ_SECONDS` sets the duration, `SPLATVK_FUZZ_SEED` another sequence,
/// `SPLATVK_FUZZ_ONLY` one reader.
#[test]
fn readers_survive_damaged_files() {
    let _alone = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let number = |name: &str| std::env::var(name).ok().map(|v| v.parse::<u64>().expect(name));
    let seconds = number("SPLATVK_FUZZ_SECONDS").unwrap_or(SECONDS);
    let only = std::env::var("SPLATVK_FUZZ_ONLY").ok();
    let seed = number("SPLATVK_FUZZ_SEED").unwrap_or(1000);
    let kept = Path::new(env!("CARGO_TARGET_TMPDIR")).join("fuzz");
    let all = readers::all();
    let all: Vec<Reader> = all.into_iter().filter(|r| only.as_ref().is_none_or(|o| r.name == o)).collect();
    assert!(!all.is_empty(), "no such reader");
    let share = Duration::from_secs(seconds) / all.len() as u32;
    let mut findings = Vec::new();
    for reader in &all {
        let folder = memory_folder();
        reader.lay_out(folder.path());
        let whole = reader.run(folder.path());
        assert!(whole.read, "{}: its own file is refused: {:?} {:?}", reader.name, whole.error, whole.fault);
        let (mut random, began) = (Random::new(seed), Instant::now());
        let (mut runs, mut read, mut found, mut longest) = (0u64, 0u64, 0, Duration::ZERO);
        while began.elapsed() < share && found < MOST_FINDINGS {
            let (name, bytes) = reader.damaged(&mut random);
            std::fs::write(folder.path().join(name), &bytes).unwrap();
            let verdict = judged(reader, folder.path());
            (runs, read, longest) = (runs + 1, read + u64::from(verdict.read), longest.max(verdict.time));
            if let Some(fault) = &verdict.fault {
                found += 1;
                let file = keep(&kept, reader, name, &bytes, found);
                findings.push(format!("{} {name}: {fault}; kept as {}", reader.name, file.display()));
                println!("{}", findings[findings.len() - 1]);
            }
            std::fs::write(folder.path().join(name), reader.whole(name)).unwrap();
        }
        println!(
            "{:<16} {runs:>8} executions, {read:>8} read, longest {:>4} ms, {found} findings",
            reader.name,
            longest.as_millis()
        );
    }
    assert!(findings.is_empty(), "{} findings:\n{}", findings.len(), findings.join("\n"));
}

/// A folder in memory where possible: a file system on a disk is slow to rewrite files.
fn memory_folder() -> TempDir {
    let shared = Path::new("/dev/shm");
    if shared.is_dir() { TempDir::new_in(shared) } else { TempDir::new() }.unwrap()
}

/// Verdict of a reader; slow runs are repeated, as the machine may have been busy.
fn judged(reader: &Reader, folder: &Path) -> Verdict {
    let mut verdict = reader.run(folder);
    for _ in 0..2 {
        if verdict.time > reader.time {
            verdict = reader.run(folder);
        }
    }
    verdict
}

fn keep(folder: &Path, reader: &Reader, name: &str, bytes: &[u8], count: usize) -> PathBuf {
    std::fs::create_dir_all(folder).unwrap();
    let file = folder.join(format!("{}-{count}-{}", reader.name, name.replace('/', "_")));
    std::fs::write(&file, bytes).unwrap();
    file
}
