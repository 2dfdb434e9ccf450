//! Compiles `glsl/*.comp` to SPIR-V 1.5 and writes `OUT_DIR/shaders.rs`: for every shader a Rust module with typed
//! bindings, push constants, workgroup size and constants, and the structures of storage buffers, so that host and shader
//! cannot drift.
//! The form of the generated code is documented in `src/gpu/mod.rs`.

#[path = "build/compile.rs"]
mod compile;
#[path = "build/constants.rs"]
mod constants;
#[path = "build/generate.rs"]
mod generate;
#[path = "build/reflect.rs"]
mod reflect;
#[path = "build/source.rs"]
mod source;

use std::path::{Path, PathBuf};

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=build");
    // The major half of capi::SVK_ABI_VERSION: programs linked with another one do not load this library.
    if std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "linux") {
        println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libsplatvk.so.1");
    }
    if let Err(message) = build() {
        // One `cargo::error` line per line of the message: GLSL errors arrive as `glsl/name.comp:12: error: ...`.
        for line in message.lines().filter(|l| !l.trim().is_empty()) {
            println!("cargo::error={line}");
        }
    }
}

fn build() -> Result<(), String> {
    let out_dir = PathBuf::from(std::env::var("OUT_DIR").map_err(|e| format!("OUT_DIR: {e}"))?);
    let glsl = Path::new("glsl");
    let sources = source::collect(glsl)?;
    compile::Compiler::warm(&out_dir, &sources);
    let compiler = compile::Compiler::new(&out_dir)?;
    let mut families = Vec::new();
    let mut errors = Vec::new();
    for source in &sources {
        match compiler.family(source) {
            Ok(family) => families.push(family),
            Err(message) => errors.push(message),
        }
    }
    if !errors.is_empty() {
        return Err(errors.join("\n"));
    }
    let shared: Vec<_> =
        source::shared(glsl)?.into_iter().map(|(name, text)| (name, constants::of(&text))).collect();
    let code = generate::shaders(&families, &shared)?;
    let path = out_dir.join("shaders.rs");
    std::fs::write(&path, code).map_err(|e| format!("{}: {e}", path.display()))
}
