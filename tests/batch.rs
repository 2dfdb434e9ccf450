//! `splatvk batch`: with a stand-in for the rows, and with whole scenes.
#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, clippy::panic)] // a panic is how a test fails
mod fixture;

use fixture::command::{refuses, splatvk, text};
use serde_json::Value;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// Makes a row in place of the program: the id states the outcome, and the n-th attempt is known by
/// a file. The key is a checksum of the row.
const STAND_IN: &str = r#"#!/bin/sh
row=$(cat)
id=$(printf %s "$row" | sed 's/.*"id":"\([^"]*\)".*/\1/')
key=$(printf %s "$row" | sha256sum | cut -c1-64)
error() { printf '{"event":"error","message":"%s","kind":"%s","exit_code":%s}\n' "$1" "$2" "$3" >&2; exit "$3"; }
case "$*" in *--key*)
    [ "$id" = wrong ] && error 'there is no option x' input 2
    printf '{"key":"%s","splatvk":"0","inputs":[],"photos":2}\n' "$key"; exit ;;
esac
while [ $# -gt 0 ]; do
    case $1 in --out) out=$2 ;; --max-size) size=$2 ;; esac
    shift
done
attempts=$(dirname "$(dirname "$out")")/../attempts-$id
printf x >> "$attempts"
n=$(wc -c < "$attempts")
case $id in
    alone) error 'they do not overlap' input 2 ;;
    lost) [ "$n" -gt 2 ] || error 'the device was lost' device-lost 5 ;;
    never) error 'the device was lost' device-lost 5 ;;
    full) [ -n "$size" ] || error 'no memory' memory 5 ;;
    killed) [ "$n" -gt 1 ] || kill -9 $$ ;;
    slow*) sleep 60 & echo $! > "$attempts.pid"; wait ;;
esac
mkdir -p "$out/scene"
printf '{"key":"%s","seconds":1,"size":"%s"}' "$key" "$size" > "$out/_SUCCESS.json"
"#;

struct Batch {
    folder: tempfile::TempDir,
}

impl Batch {
    fn new(rows: &[&str]) -> Batch {
        let batch = Batch { folder: tempfile::tempdir().unwrap() };
        let program = batch.at("stand-in");
        std::fs::write(&program, STAND_IN).unwrap();
        std::fs::set_permissions(&program, PermissionsExt::from_mode(0o755)).unwrap();
        let line = |id: &&str| format!("{{\"id\": \"{id}\", \"input\": \"x\"}}\n");
        std::fs::write(batch.at("rows.jsonl"), rows.iter().map(line).collect::<String>()).unwrap();
        batch
    }

    fn at(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn command(&self, options: &[&str]) -> Command {
        let mut command = splatvk();
        command.env("SPLATVK_PROGRAM", self.at("stand-in")).arg("batch").arg(self.at("rows.jsonl"));
        command.arg("--out").arg(self.at("out")).arg("--json").args(options);
        command
    }

    fn run(&self, code: i32, options: &[&str]) -> Value {
        let output = self.command(options).output().unwrap();
        assert_eq!(output.status.code(), Some(code), "{}", text(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap_or_default()
    }

    fn attempts(&self, id: &str) -> usize {
        std::fs::read(self.at(&format!("attempts-{id}"))).map_or(0, |b| b.len())
    }

    fn json(&self, name: &str) -> Value {
        let text = std::fs::read(self.at("out").join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        serde_json::from_slice(&text).unwrap()
    }

    fn failure(&self, id: &str) -> String {
        self.json(&format!("_failed/{id}.json"))["kind"].as_str().unwrap().to_owned()
    }

    fn leftovers(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.at("out/_attempts")).unwrap();
        entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect()
    }
}

fn number(value: &Value, name: &str) -> u64 {
    value[name].as_u64().unwrap_or_else(|| panic!("{name}: {value}"))
}

#[test]
fn retries_follow_the_kind_of_failure() {
    let batch = Batch::new(&["good", "wrong", "alone", "lost", "never", "full", "killed"]);
    let counts = batch.run(1, &["--retries", "2", "--per-device", "3"]);
    assert_eq!((number(&counts, "done"), number(&counts, "failed")), (4, 3), "{counts}");
    let attempts = ["good", "wrong", "alone", "lost", "never", "full", "killed"].map(|id| batch.attempts(id));
    assert_eq!(attempts, [1, 0, 1, 3, 3, 2, 2]);
    assert_eq!(batch.json("full/_SUCCESS.json")["size"], "560", "seven tenths of a CPU's 800 pixels");
    assert_eq!(["wrong", "alone", "never"].map(|id| batch.failure(id)), ["refused", "refused", "transient"]);
    assert!(batch.leftovers().is_empty(), "{:?}", batch.leftovers());
    let summary = std::fs::read_to_string(batch.at("out/summary.csv")).unwrap();
    assert!(summary.contains("\nlost,done,1.0,") && summary.contains("\nalone,refused,"), "{summary}");
    let page = std::fs::read_to_string(batch.at("out/index.html")).unwrap();
    assert!(page.contains("4 of 7 captures are done, 3 failed") && page.contains("they do not overlap"));

    // Finished and refused rows are not touched again, others are tried.
    let again = batch.run(1, &["--retries", "0"]);
    assert_eq!(
        (number(&again, "kept"), number(&again, "done"), number(&again, "failed")),
        (4, 0, 3),
        "{again}"
    );
    assert_eq!((batch.attempts("good"), batch.attempts("alone"), batch.attempts("never")), (1, 1, 4));
    batch.run(1, &["--only", "failed", "--retries", "0"]);
    assert_eq!((batch.attempts("good"), batch.attempts("alone")), (1, 2));
}

#[test]
fn changed_row_is_made_anew() {
    let batch = Batch::new(&["a", "b"]);
    batch.run(0, &[]);
    let key = batch.json("a/_SUCCESS.json")["key"].clone();
    let rows = std::fs::read_to_string(batch.at("rows.jsonl")).unwrap();
    std::fs::write(batch.at("rows.jsonl"), rows.replacen("\"x\"", "\"y\"", 1)).unwrap();
    let plan = batch.run(0, &["--dry-run"]);
    assert_eq!((number(&plan, "make"), plan["rows"][1]["plan"].as_str()), (1, Some("done")));
    let counts = batch.run(0, &[]);
    assert_eq!((number(&counts, "done"), number(&counts, "kept")), (1, 1));
    assert_ne!(batch.json("a/_SUCCESS.json")["key"], key);
    assert_eq!((batch.attempts("a"), batch.attempts("b")), (2, 1));
}

#[test]
fn plan_makes_nothing() {
    let batch = Batch::new(&["a"]);
    batch.run(0, &["--dry-run"]);
    let plan = Batch::new(&["a", "wrong"]).run(2, &["--dry-run"]);
    assert_eq!(plan["rows"][1]["plan"], "refused: there is no option x");
    assert!(!batch.at("out").exists());
}

#[test]
fn too_many_failures_end_a_batch() {
    let rows: Vec<String> = (0..10).map(|i| format!("never{i}")).collect();
    let batch = Batch::new(&rows.iter().map(String::as_str).collect::<Vec<_>>());
    let stand_in = std::fs::read_to_string(batch.at("stand-in")).unwrap();
    std::fs::write(batch.at("stand-in"), stand_in.replace("never)", "never*)")).unwrap();
    let counts = batch.run(1, &["--retries", "0", "--max-failures", "20%"]);
    assert_eq!((number(&counts, "failed"), number(&counts, "left")), (3, 7));
}

#[test]
fn late_rows_end_with_their_processes() {
    let batch = Batch::new(&["slow", "good"]);
    let started = Instant::now();
    batch.run(1, &["--timeout", "1s"]);
    assert!(started.elapsed() < Duration::from_secs(30));
    assert_eq!((batch.failure("slow").as_str(), batch.attempts("good")), ("timeout", 1));
    wait_for("its process to end", || !is_alive(&batch.at("attempts-slow.pid")));
}

#[test]
fn rows_end_with_a_killed_batch_and_are_made_later() {
    let batch = Batch::new(&["slow"]);
    let mut first = batch.command(&[]).spawn().unwrap();
    wait_for("the row to begin", || batch.attempts("slow") == 1);
    // Another batch leaves a row alone that is being made.
    let second = batch.run(0, &["--timeout", "1s"]);
    assert_eq!((number(&second, "elsewhere"), batch.attempts("slow")), (1, 1));
    first.kill().unwrap();
    first.wait().unwrap();
    assert!(!batch.leftovers().is_empty());
    std::fs::write(batch.at("stand-in"), STAND_IN.replace("slow*)", "none)")).unwrap();
    wait_for("the lock to open", || number(&batch.run(0, &[]), "elsewhere") == 0);
    assert!(batch.at("out/slow/_SUCCESS.json").is_file() && batch.leftovers().is_empty());
}

#[test]
fn shards_make_every_row_once() {
    let batch = Batch::new(&["a", "b", "c", "d", "e"]);
    let count = |shard: &str| number(&batch.run(0, &["--shard", shard]), "done");
    assert_eq!((count("0/2"), count("1/2")), (3, 2));
    assert_eq!(number(&batch.run(0, &[]), "kept"), 5);
}

#[test]
fn wrong_command_lines_are_refused() {
    let batch = Batch::new(&["a"]);
    refuses(&mut command_of(&batch, &["--shard", "2/2"]), 2, &["parts count from 0"]);
    refuses(&mut command_of(&batch, &["--timeout", "soon"]), 2, &["90s"]);
    refuses(&mut command_of(&batch, &["--devices", "no such"]), 2, &["no Vulkan device matches `no such`"]);
    std::fs::write(batch.at("rows.jsonl"), "{\"id\": \"a\"}\n").unwrap();
    refuses(&mut command_of(&batch, &[]), 2, &["rows.jsonl, line 1: missing field `input`"]);
    let mut ray = command_of(&batch, &["--engine", "ray"]);
    refuses(ray.env("SPLATVK_PYTHON", "/no/python"), 3, &["splatvk[batch]", "/no/python"]);
    assert!(!batch.at("out").exists());
}

fn command_of(batch: &Batch, options: &[&str]) -> Command {
    batch.command(options)
}

fn wait_for(event: &str, happened: impl Fn() -> bool) {
    let started = Instant::now();
    while !happened() {
        assert!(started.elapsed() < Duration::from_secs(30), "waited for {event}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Whether the process whose number is in a file runs.
fn is_alive(file: &Path) -> bool {
    let number = std::fs::read_to_string(file).unwrap();
    let state = std::fs::read_to_string(format!("/proc/{}/stat", number.trim()));
    state.is_ok_and(|s| !s.contains(") Z "))
}

/// Two captures, of which one is asked and exported, beside one that cannot be made.
#[test]
fn scenes_of_a_batch_are_those_of_run() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for (set, photos) in [("table", 2), ("lonely", 1)] {
        std::fs::create_dir(at(set)).unwrap();
        for i in 0..photos {
            let photo = image::open(fixture::data(&format!("breakfast/images/train_0{i}.jpg"))).unwrap();
            let small = photo.resize_exact(240, 180, image::imageops::FilterType::Triangle);
            small.to_rgb8().save(at(set).join(format!("{i}.png"))).unwrap();
        }
    }
    let options = r#""options": {"iterations": 30, "language_iterations": 4, "deterministic": true}"#;
    let rows = format!(
        r#"{{"id": "table", "input": "table/*.png", {options}, "queries": ["lemon", "wall"], "exports": ["glb", "colmap", "t.spz"]}}
{{"id": "lonely", "input": "lonely"}}
{{"id": "odd", "input": "table", "options": {{"iteration": 3}}}}
{{"id": "odder", "input": "table", "exports": ["obj"]}}"#
    );
    std::fs::write(at("rows.jsonl"), rows).unwrap();
    let batch = |options: &[&str]| {
        let mut command = splatvk();
        command.current_dir("/").arg("batch").arg(at("rows.jsonl")).arg("--out").arg(at("out"));
        command.arg("--json").args(options).output().unwrap()
    };
    let output = batch(&[]);
    let counts: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((number(&counts, "done"), number(&counts, "failed")), (1, 3), "{}", text(&output.stderr));
    let failure = |id: &str| std::fs::read_to_string(at("out/_failed").join(format!("{id}.json"))).unwrap();
    assert!(failure("lonely").contains("refused"), "{}", failure("lonely"));
    assert!(failure("odd").contains("there is no option iteration"), "{}", failure("odd"));
    assert!(failure("odder").contains("export obj"), "{}", failure("odder"));
    let success: Value =
        serde_json::from_slice(&std::fs::read(at("out/table/_SUCCESS.json")).unwrap()).unwrap();
    assert_eq!(success["answers"][0]["text"], "lemon");
    // The wall is recognised by its shape; no class of the classifier is a wall.
    assert_eq!(
        (&success["answers"][1]["text"], &success["answers"][1]["presence"]),
        (&"wall".into(), &"found".into())
    );
    assert!(
        success["psnr"].as_f64().unwrap() > 10.0 && success["device"]["uuid"].as_str().unwrap().len() == 36
    );
    for file in ["table.glb", "t.spz", "colmap/cameras.txt"] {
        assert!(at("out/table/exports").join(file).is_file(), "{file}");
    }

    let mut run = splatvk();
    run.arg("run").arg(at("table")).arg("--out").arg(at("own")).args(["--iterations", "30"]);
    run.args(["--language-iterations", "4", "--deterministic", "--query", "lemon", "--query", "wall"]);
    let made = run.args(["--query", "Apfel"]).output().unwrap();
    let summary = String::from_utf8_lossy(&made.stdout);
    assert!(
        made.status.success() && summary.contains("“Apfel” is not among their English words"),
        "{summary}"
    );
    for file in ["point_cloud.ply", "language/features.npz", "cameras/transforms.json", "seen.npy"] {
        let read = |scene: &str| std::fs::read(at(scene).join(file)).unwrap();
        assert!(read("own") == read("out/table/scene"), "{file}");
    }
    let kept: Value = serde_json::from_slice(&batch(&[]).stdout).unwrap();
    assert_eq!(number(&kept, "kept"), 1, "{kept}");
}
