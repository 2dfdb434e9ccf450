//! Compiles the shaders.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    splatvk_gpu_build::compile("shaders");
}
