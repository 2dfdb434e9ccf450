//! Compiles `glsl/*.comp` to SPIR-V and writes typed bindings for them to `OUT_DIR/shaders.rs`.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    // The major half of capi::SVK_ABI_VERSION: programs linked with another one do not load this
    // library.
    if std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "linux") {
        println!("cargo::rustc-cdylib-link-arg=-Wl,-soname,libsplatvk.so.1");
    }
    splatvk_gpu_build::compile("glsl");
}
