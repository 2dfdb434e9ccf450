//! Compiles a folder of GLSL compute shaders to SPIR-V 1.5 and writes Rust bindings for them.
//!
//! The bindings are typed: a buffer of the wrong element type or a missing push constant is a
//! compile error. Barriers need no declaration: the generated tables state how each shader accesses
//! each buffer, and `splatvk_gpu::Recorder` derives the barriers from them.
//!
//! `build.rs`:
//!
//! ```no_run
//! splatvk_gpu_build::compile("shaders");
//! ```
//!
//! `src/lib.rs`, for `shaders/double.comp` with a buffer block `Values` and a push constant
//! `count`:
//!
//! ```ignore
//! pub mod shaders {
//!     include!(concat!(env!("OUT_DIR"), "/shaders.rs"));
//! }
//!
//! recorder.dispatch_threads(
//!     shaders::double::call(
//!         &shaders::double::Bindings { values: &values },
//!         &shaders::double::Push { count },
//!     ),
//!     [count, 1, 1],
//! );
//! ```
//!
//! # Folder
//! - `NAME.comp` becomes the module `shaders::NAME`. `NAME` is snake case.
//! - `shared/NAME.glsl` is a header, included as `#include "shared/NAME.glsl"`. Its constants
//!   become the module `shaders::shared::NAME`.
//! - `#include "gpu/atomic_float.glsl"` brings this crate's float atomics: `ATOMIC_ADD` compiles to
//!   native atomics and to a compare-and-swap loop, and the device picks one.
//!
//! # Directives
//! - `// variants: CHANNELS=3,4,20` compiles the shader once per value of the macro `CHANNELS`.
//!   Several lines combine as a Cartesian product.
//! - `// subgroups: 8,16,32,64` compiles it once per subgroup size (macro `SUBGROUP_SIZE`). The
//!   device picks the size that it runs with.
//!
//! # Generated items
//! | item | content |
//! |---|---|
//! | `shaders::NAME::Bindings<'a>` | one field `&'a Buffer<T>` per storage buffer, named after its block in snake case; `T` is `f32`, `i32`, `u32` or a structure |
//! | `shaders::NAME::Push` | the push constants as Rust types; `bytes()` writes them at their reflected offsets |
//! | `shaders::NAME::Variant` | one field per `// variants:` macro |
//! | `shaders::NAME::call(..)` | a `splatvk_gpu::Call` from `Variant`, `Bindings` and `Push`, of which absent ones are left out |
//! | `shaders::NAME::WORKGROUP` | `local_size`, if all variants share it |
//! | `shaders::NAME::CONSTANT` | each `const` and `#define` of the file whose value is known at build time; floats are `f64` |
//! | `shaders::NAME::FAMILY` | all compiled modules of the file |
//! | `shaders::structs::NAME` | each structure that a storage buffer holds, as `bytemuck::Pod` |
//! | `shaders::FAMILIES`, `shaders::CONSTANTS` | all of them, for tests |
//!
//! # Limits
//! Storage buffers in descriptor set 0 and push constants up to 128 bytes; one member per block;
//! literal workgroup sizes, no specialisation constants; structures without unnamed padding.
//! Anything else is an error that names the file and the line or the block.
//!
//! # Publishing
//! A crate can be published with `OUT_DIR/shaders.rs` and the modules that it includes, as the
//! folder `packed` in the folder of shaders. It depends on this one with `default-features = false`,
//! and whoever builds it needs no shaderc.
//!
//! # Requirements
//! The feature `compile` (default) takes libshaderc, as the `shaderc` crate finds or builds it.
//! Without the feature nothing is compiled and `packed` is taken.
#[cfg(feature = "compile")]
mod compile;
#[cfg(feature = "compile")]
mod constants;
#[cfg(feature = "compile")]
mod generate;
#[cfg(feature = "compile")]
mod reflect;
#[cfg(feature = "compile")]
mod source;

use std::path::{Path, PathBuf};

/// Compiles the shaders of `folder` and writes `OUT_DIR/shaders.rs`. For `build.rs`.
///
/// `folder` is relative to the package. Cargo runs the build script again when a file of the folder
/// changes; unchanged shaders come from a cache in `OUT_DIR`. Each error becomes a `cargo::error`
/// line such as `shaders/double.comp:12: error: …`, which fails the build.
pub fn compile(folder: impl AsRef<Path>) {
    let out = std::env::var_os("OUT_DIR").ok_or("OUT_DIR is not set: call this in build.rs");
    let written = out.map_err(str::to_owned).and_then(|out| {
        let path = PathBuf::from(&out).join("shaders.rs");
        let code = bindings(folder.as_ref(), Path::new(&out))?;
        std::fs::write(&path, code).map_err(|e| format!("{}: {e}", path.display()))
    });
    if let Err(message) = written {
        for line in message.lines().filter(|l| !l.trim().is_empty()) {
            println!("cargo::error={line}");
        }
    }
}

#[cfg(feature = "compile")]
fn bindings(folder: &Path, cache: &Path) -> Result<String, String> {
    generate(folder, cache)
}

#[cfg(not(feature = "compile"))]
fn bindings(folder: &Path, _: &Path) -> Result<String, String> {
    let packed = folder.join("packed/shaders.rs");
    println!("cargo::rerun-if-changed={}", packed.display());
    let absolute = packed.canonicalize().map_err(|e| {
        format!("{}: {e}; the feature `compile` of splatvk-gpu-build compiles the shaders", packed.display())
    })?;
    Ok(format!("include!({:?});", absolute.display().to_string()))
}

/// The Rust source of the bindings, to be written into `cache`: it includes the compiled modules,
/// which `cache` keeps, by paths relative to itself. Prints `cargo::rerun-if-changed` lines.
///
/// # Errors
/// The messages of all shaders that do not compile or use something unsupported, one per line.
#[cfg(feature = "compile")]
pub fn generate(folder: &Path, cache: &Path) -> Result<String, String> {
    let sources = source::collect(folder)?;
    compile::Compiler::warm(cache, &sources);
    let compiler = compile::Compiler::new(cache)?;
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
    let shared: Vec<_> = source::shared(folder)?
        .into_iter()
        .map(|(name, text)| (format!("{}/shared/{name}.glsl", folder.display()), name, text))
        .map(|(path, name, text)| generate::Shared { path, name, constants: constants::of(&text) })
        .collect();
    generate::shaders(&families, &shared)
}

#[cfg(all(test, feature = "compile"))]
mod tests;
