//! Compiles a folder of shaders into its folder `packed`: `cargo run --example pack -- glsl`.

use std::path::Path;

fn main() -> Result<(), String> {
    let folder = std::env::args().nth(1).ok_or("name the folder of shaders")?;
    splatvk_gpu_build::pack(Path::new(&folder))
}
