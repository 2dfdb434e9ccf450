//! Networks and ONNX Runtime on the command line: listed, explained, and refused in one line.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is how a test fails
use std::path::Path;
use std::process::{Command, Stdio};

fn splatvk(args: &[&str], set: &[(&str, &str)]) -> (i32, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
    command.args(args).env_remove("SPLATVK_MODELS").stdin(Stdio::null());
    command.envs(set.iter().copied());
    let output = command.output().unwrap();
    let text = |b: &[u8]| String::from_utf8_lossy(b).into_owned();
    (output.status.code().unwrap_or(-1), text(&output.stdout), text(&output.stderr))
}

fn photos() -> String {
    format!("{}/tests/data/breakfast/images", env!("CARGO_MANIFEST_DIR"))
}

/// Returns the only error line of a run that must be refused with exit code 3: a part is missing or unusable.
fn refusal(args: &[&str], set: &[(&str, &str)]) -> String {
    let (code, _, stderr) = splatvk(args, set);
    let lines: Vec<&str> = stderr.lines().filter(|l| l.starts_with("splatvk: ")).collect();
    assert!(code == 3 && lines.len() == 1 && !stderr.contains("panicked"), "{code}: {stderr}");
    lines[0].to_string()
}

#[test]
fn models_lists_licence_and_source() {
    let (code, text, _) = splatvk(&["models", "list"], &[]);
    assert_eq!(code, 0);
    for part in [
        "Built-in pack",
        "Paper pack",
        "Open pack",
        "SAM ViT-H",
        "CC-BY-NC-SA-4.0",
        "tools/export/export_sam.py",
    ] {
        assert!(text.contains(part), "{part}: {text}");
    }
    let (_, text, _) = splatvk(&["models", "list", "--json"], &[]);
    let list: serde_json::Value = serde_json::from_str(&text).unwrap();
    let known = list["known"].as_array().unwrap();
    assert!(
        known
            .iter()
            .any(|k| k["id"] == "mast3r" && k["looked_for"].as_str().unwrap().ends_with("models/mast3r"))
    );
    assert!(list["models"].as_array().unwrap().iter().all(|m| m["pack"] == "built-in"));
}

#[test]
fn broken_network_fails_before_work() {
    let folder = tempfile::tempdir().unwrap();
    let home = std::env::var("SPLATVK_HOME").unwrap_or_default();
    let own = if home.is_empty() { dirs() } else { home };
    let models = format!("{}:{own}/models", folder.path().display());
    let out = folder.path().join("scene");
    let photos = photos();
    let run = |extra: &[&str]| {
        let mut args = vec!["run", &photos, "--out", out.to_str().unwrap(), "--models", &models];
        args.extend(extra);
        refusal(&args, &[])
    };
    let absent = run(&["--masks", "sam"]);
    for part in ["splatvk models fetch sam_vit_b", "tools/export/export_sam.py", "segment-anything"] {
        assert!(absent.contains(part), "{part}: {absent}");
    }
    std::fs::create_dir(folder.path().join("dust3r")).unwrap();
    std::fs::write(folder.path().join("dust3r/encoder.onnx"), b"\x08\x08cut off").unwrap();
    let broken = run(&["--init", "dust3r"]);
    assert!(broken.contains("dust3r/encoder.onnx: not a complete ONNX file"), "{broken}");
    let check = refusal(&["models", "check", "--models", &models], &[]);
    assert!(check.contains("dust3r/encoder.onnx"), "{check}");
    assert!(!out.exists());
}

/// `~/.local/share/splatvk`, found as the program finds it.
fn dirs() -> String {
    let set = |name: &str| std::env::var(name).ok().filter(|v| !v.is_empty());
    let data =
        set("XDG_DATA_HOME").unwrap_or_else(|| format!("{}/.local/share", set("HOME").unwrap_or_default()));
    format!("{data}/splatvk")
}

#[test]
fn unusable_onnx_runtime_is_named() {
    let photos = photos();
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("scene");
    let args = ["run", &photos, "--out", out.to_str().unwrap()];
    let missing = refusal(&args, &[("ORT_DYLIB_PATH", "/nonexistent/libonnxruntime.so")]);
    assert!(
        missing.contains("/nonexistent/libonnxruntime.so") && missing.contains("tools/setup"),
        "{missing}"
    );
    let library = folder.path().join("libonnxruntime.so");
    old_runtime(&library);
    let old = refusal(&args, &[("ORT_DYLIB_PATH", library.to_str().unwrap())]);
    assert!(old.contains("1.10.0") && old.contains(">= '1.24") && old.contains("tools/setup"), "{old}");
    assert!(!out.exists());
}

#[test]
fn unknown_provider_of_environment_is_refused() {
    let (code, stdout, _) = splatvk(&["doctor", "--json"], &[("SPLATVK_PROVIDER", "gpu")]);
    assert!(
        code == 3 && stdout.contains("provider gpu: unknown; choose one of auto, cpu"),
        "{code}: {stdout}"
    );
}

/// Builds a library that reports ONNX Runtime 1.10, with the two functions that a program calls
/// first.
fn old_runtime(library: &Path) {
    let source = library.with_extension("c");
    let code = "static const void *api(unsigned v) { (void)v; return 0; }\n\
                static const char *version(void) { return \"1.10.0\"; }\n\
                struct base { const void *(*api)(unsigned); const char *(*version)(void); };\n\
                static const struct base the_base = { api, version };\n\
                const struct base *OrtGetApiBase(void) { return &the_base; }\n";
    std::fs::write(&source, code).unwrap();
    let built = Command::new("cc").args(["-shared", "-fPIC", "-o"]).arg(library).arg(&source).status();
    assert!(built.unwrap().success(), "the C compiler that the build needs anyway");
}
