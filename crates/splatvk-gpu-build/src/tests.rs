#![allow(clippy::unwrap_used)] // a panic is how a test fails
use super::*;
use std::fs;

/// A folder of shaders, and the bindings generated for it or the error.
fn bindings(files: &[(&str, &str)]) -> Result<String, String> {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("shared")).unwrap();
    for (name, text) in files {
        fs::write(folder.path().join(name), text).unwrap();
    }
    let cache = tempfile::tempdir().unwrap();
    generate(folder.path(), cache.path())
}

fn shader(body: &str) -> String {
    format!(
        "#version 450\n#extension GL_GOOGLE_include_directive : require\nlayout(local_size_x = 64) in;\n{body}"
    )
}

#[test]
fn access_comes_from_the_code() {
    let text = shader(
        "layout(binding = 0) buffer From { uint from[]; };\n\
         layout(binding = 1) buffer To { float to[]; };\n\
         layout(binding = 2) buffer Both { int both[]; };\n\
         void main() { to[0] = float(from[0]); both[1] += 1; }",
    );
    let code = bindings(&[("copy.comp", &text)]).unwrap();
    for expected in [
        "pub mod copy {",
        "pub from: &'a Buffer<u32>",
        "pub to: &'a Buffer<f32>",
        "pub both: &'a Buffer<i32>",
        "name: \"from\", access: Access { read: true, write: false }",
        "name: \"to\", access: Access { read: false, write: true }",
        "name: \"both\", access: Access { read: true, write: true }",
        "pub const WORKGROUP: [u32; 3] = [64, 1, 1]",
    ] {
        assert!(code.contains(expected), "{expected}: {code}");
    }
}

#[test]
fn push_constants_keep_their_offsets() {
    let text = shader(
        "layout(push_constant) uniform Push { float a; vec3 b; mat2 c; uint d[2]; };\n\
         layout(binding = 0) buffer To { float to[]; };\n\
         void main() { to[0] = a + b.x + c[0][0] + float(d[1]); }",
    );
    let code = bindings(&[("push.comp", &text)]).unwrap();
    for expected in [
        "/// Byte 16.\n        pub b: [f32; 3]",
        "/// Byte 32.\n        pub c: [[f32; 2]; 2]",
        "pub d: [u32; 2]",
    ] {
        assert!(code.contains(expected), "{expected}: {code}");
    }
}

#[test]
fn variants_subgroups_and_atomics_multiply() {
    let text = format!(
        "{}{}",
        shader("#include \"gpu/atomic_float.glsl\"\n"),
        "// variants: CHANNELS=3,4\n// subgroups: 8,32\n\
         layout(binding = 0) buffer Sum { ATOMIC_FLOAT sum[]; };\n\
         void main() { ATOMIC_ADD(sum[CHANNELS], float(SUBGROUP_SIZE)); }"
    );
    let code = bindings(&[("add.comp", &text)]).unwrap();
    assert_eq!(code.matches("        Module {").count(), 2 * 2 * 2);
    assert!(code.contains("pub channels: u32") && code.contains("pub sum: &'a Buffer<f32>"), "{code}");
    assert!(code.contains("name: \"add[CHANNELS=4,SUBGROUP_SIZE=32,FLOAT_ATOMICS=0]\""), "{code}");
}

#[test]
fn constants_cross_to_rust() {
    let header = "const uint SIDE = 4, MASK = 0xffff0000u;\nconst float SCALE = 0.1;\n#define PIXELS 16\n";
    let text = shader(
        "#include \"shared/tile.glsl\"\n\
         layout(binding = 0) buffer To { float to[]; };\n\
         void main() { to[SIDE] = SCALE; }",
    );
    let code = bindings(&[("one.comp", &text), ("shared/tile.glsl", header)]).unwrap();
    for expected in [
        "pub const SIDE: u32 = 4;",
        "pub const MASK: u32 = 4294901760;",
        "pub const SCALE: f64 = 0.1;",
        "pub const PIXELS: i32 = 16;",
    ] {
        assert!(code.contains(expected), "{expected}: {code}");
    }
}

#[test]
fn unsupported_features_are_errors_with_a_place() {
    let to = "layout(binding = 0) buffer To { float to[]; };\n";
    for (body, reason) in [
        (format!("{to}void main() {{ to[0] = ; }}"), "broken.comp:5: error"),
        (format!("{to}#include \"shared/none.glsl\"\nvoid main() {{}}"), "broken.comp:5: error"),
        (
            "layout(binding = 0) uniform Block { float a; };\nlayout(binding = 1) buffer To { float to[]; };\n\
             void main() { to[0] = a; }"
                .to_owned(),
            "only storage buffers and push constants",
        ),
        (
            "layout(binding = 0) buffer To { float a; float b; };\nvoid main() { a = b; }".to_owned(),
            "`To` has several members",
        ),
        (
            "struct Pair { float a; vec2 b; };\nlayout(binding = 0) buffer To { Pair to[]; };\n\
             void main() { to[0].a = to[0].b.x; }"
                .to_owned(),
            "`Pair.b` has a gap",
        ),
        (
            format!("layout(push_constant) uniform Push {{ mat4 a; mat4 b; float c; }};\n{to}void main() {{ to[0] = c; }}"),
            "more than the 128",
        ),
    ] {
        let error = bindings(&[("broken.comp", &shader(&body))]).unwrap_err();
        assert!(error.contains(reason) && error.contains("broken.comp"), "{reason}: {error}");
    }
}

#[test]
fn unchanged_shaders_come_from_the_cache() {
    let (folder, cache) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let text = shader("layout(binding = 0) buffer To { float to[]; };\nvoid main() { to[0] = 1.0; }");
    fs::write(folder.path().join("one.comp"), &text).unwrap();
    let first = generate(folder.path(), cache.path()).unwrap();
    let modules = || fs::read_dir(cache.path().join("spirv")).unwrap().count();
    assert_eq!(modules(), 2, "one optimised, one for reflection");
    assert_eq!(generate(folder.path(), cache.path()).unwrap(), first);
    assert_eq!(modules(), 2);
    fs::write(folder.path().join("one.comp"), text.replace("1.0", "2.0")).unwrap();
    assert_ne!(generate(folder.path(), cache.path()).unwrap(), first);
}

#[test]
fn bindings_include_modules_by_relative_paths() {
    let (folder, cache) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let text = shader("layout(binding = 0) buffer To { float to[]; };\nvoid main() { to[0] = 1.0; }");
    fs::write(folder.path().join("one.comp"), &text).unwrap();
    let code = generate(folder.path(), cache.path()).unwrap();
    let path = code.split("include_bytes!(\"").nth(1).and_then(|c| c.split('"').next()).unwrap();
    assert!(path.starts_with("spirv/") && cache.path().join(path).exists(), "{path}");
}
