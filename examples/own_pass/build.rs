//! Compiles `shaders/*.comp`.

fn main() {
    splatvk_gpu_build::compile("shaders");
}
