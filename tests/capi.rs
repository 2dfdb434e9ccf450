//! The C header is what the code says.
#![allow(clippy::unwrap_used, clippy::expect_used)] // a panic is how a test fails
use std::path::Path;

#[test]
fn the_header_is_generated_from_the_code() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut builder = cbindgen::Builder::new()
        .with_config(cbindgen::Config::from_file(root.join("cbindgen.toml")).unwrap());
    for part in ["context", "train", "scene", "render", "types"] {
        builder = builder.with_src(root.join(format!("src/capi/{part}.rs")));
    }
    let mut made = Vec::new();
    builder.generate().unwrap().write(&mut made);
    let (made, file) = (String::from_utf8(made).unwrap(), root.join("include/splatvk.h"));
    if std::env::var("SPLATVK_BLESS").is_ok() {
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::write(&file, &made).unwrap();
    }
    let kept = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(kept == made, "include/splatvk.h is out of date: SPLATVK_BLESS=1 cargo test --test capi");
}
