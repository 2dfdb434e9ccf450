fn main() {
    println!("cargo:rerun-if-changed=glsl");
    let compiler = shaderc::Compiler::new();
    if compiler.is_err() {
        println!("cargo:warning=no shaderc");
    }
}
