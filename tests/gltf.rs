//! glTF files: round trips, and one-line errors for unreadable files.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::indexing_slicing)] // a panic is how a test fails
use serde_json::{Value, json};
use splatvk::format::gaussians;
use splatvk::scene::Splats;
use std::path::Path;

fn splats(n: usize, sh_degree: u32) -> Splats {
    let mut next = 0u32;
    let mut value = || {
        next += 1;
        (f64::from(next) * 12.9898).sin() as f32
    };
    let mut s = Splats { sh_degree, ..Splats::default() };
    for _ in 0..n {
        s.means.push([value(), value(), value()]);
        s.log_scales.push([value(), value(), value()]);
        let q = [value(), value(), value(), value()];
        let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        s.quats.push(q.map(|v| v / norm));
        s.opacity_logits.push(value());
        s.sh.extend((0..s.sh_len() * 3).map(|_| value()));
    }
    s
}

fn close(a: &[f32], b: &[f32], bound: f32, what: &str) {
    assert_eq!(a.len(), b.len(), "{what}");
    let worst = a.iter().zip(b).fold(0f32, |m, (x, y)| m.max((x - y).abs()));
    assert!(worst <= bound, "{what}: {worst}");
}

#[test]
fn gltf_and_glb_round_trip() {
    let folder = tempfile::tempdir().unwrap();
    for degree in 0..=3 {
        let s = splats(9, degree);
        for name in ["a.glb", "a.gltf"] {
            let path = folder.path().join(name);
            gaussians::write(&path, &s, None).unwrap();
            let back = gaussians::read(&path).unwrap().0;
            assert_eq!((back.len(), back.sh_degree), (9, degree));
            assert_eq!(back.means, s.means);
            close(back.log_scales.as_flattened(), s.log_scales.as_flattened(), 1e-6, "log scales");
            close(&back.opacity_logits, &s.opacity_logits, 1e-6, "opacities");
            close(&back.sh, &s.sh, 1e-6, "SH");
            for (a, b) in back.quats.iter().zip(&s.quats) {
                let dot: f32 = a.iter().zip(b).map(|(x, y)| x * y).sum();
                assert!(dot.abs() > 1.0 - 1e-6);
            }
        }
    }
}

/// Error of a text file of three Gaussians, altered by `change`.
fn refusal(folder: &Path, change: impl FnOnce(&mut Value)) -> String {
    let path = folder.join("b.gltf");
    gaussians::write(&path, &splats(3, 1), None).unwrap();
    let mut root: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    change(&mut root);
    std::fs::write(&path, root.to_string()).unwrap();
    let e = gaussians::read(&path).expect_err("a file that must be refused was read");
    assert_eq!((e.exit_code(), e.to_string().lines().count()), (2, 1), "{e}");
    e.to_string()
}

#[test]
fn gltf_refuses_unreadable_files() {
    let folder = tempfile::tempdir().unwrap();
    let assert_refusal = |change: fn(&mut Value), words: &str| {
        let text = refusal(folder.path(), change);
        assert!(text.contains(words), "{text}: says nothing of {words}");
    };
    assert_refusal(|r| r["meshes"][0]["primitives"][0]["extensions"] = json!({}), "not a file of Gaussians");
    assert_refusal(|r| r["meshes"][0]["primitives"][0]["mode"] = json!(4), "mode 0");
    assert_refusal(
        |r| r["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["kernel"] = json!("disc"),
        "kernel disc",
    );
    assert_refusal(
        |r| {
            r["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["colorSpace"] =
                json!("lin_rec709_display");
        },
        "colorSpace lin_rec709_display",
    );
    assert_refusal(
        |r| {
            let attributes = r["meshes"][0]["primitives"][0]["attributes"].as_object_mut().unwrap();
            attributes.remove("KHR_gaussian_splatting:SH_DEGREE_1_COEF_0");
        },
        "SH_DEGREE_1_COEF_0 is missing",
    );
    for name in
        ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_gaussian_splatting_compression_spz_2"]
    {
        let text = refusal(folder.path(), |r| r["extensionsRequired"] = json!([name]));
        assert!(text.contains(name) && text.contains("without compression"), "{text}");
    }
    assert_refusal(
        |r| r["extensionsRequired"] = json!(["EXT_unheard_of"]),
        "EXT_unheard_of, which splatvk does not know",
    );
    assert_refusal(
        |r| r["nodes"][0]["extensions"] = json!({ "EXT_mesh_gpu_instancing": {} }),
        "as a node of its own",
    );
    assert_refusal(
        |r| r["bufferViews"][0]["extensions"] = json!({ "KHR_meshopt_compression": {} }),
        "KHR_meshopt_compression",
    );
    assert_refusal(
        |r| {
            r["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["extensions"] =
                json!({ "KHR_gaussian_splatting_compression_spz_2": {} });
        },
        "KHR_gaussian_splatting_compression_spz_2",
    );
    assert_refusal(
        |r| r["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["kernel"] = json!(7),
        "kernel 7 is not supported",
    );
    assert_refusal(|r| r["nodes"][0]["scale"] = json!([1, 2, 1]), "stretches or mirrors");
    assert_refusal(|r| r["nodes"][0]["scale"] = json!([1, 1, -1]), "stretches or mirrors");
    assert_refusal(|r| r["nodes"][0]["children"] = json!([0]), "form a tree");
    assert_refusal(|r| r["scenes"][0]["nodes"] = json!([7]), "no node 7");
    assert_refusal(|r| r["nodes"][0]["mesh"] = json!(3), "no mesh 3");
    assert_refusal(|r| r["accessors"][1]["count"] = json!(2), "different numbers");
    assert_refusal(|r| r["accessors"][1]["count"] = json!(u64::MAX / 8), "ends early");
    assert_refusal(|r| r["accessors"][1]["componentType"] = json!(5125), "unknown type");
    assert_refusal(|r| r["accessors"][1]["type"] = json!("VEC2"), "VEC4 is needed");
    assert_refusal(|r| r["accessors"][1]["sparse"] = json!({}), "sparse");
    assert_refusal(|r| r["bufferViews"][2]["byteLength"] = json!(8), "ends early");
    assert_refusal(|r| r["bufferViews"][2]["byteStride"] = json!(4), "ends early");
    assert_refusal(|r| r["buffers"][0]["uri"] = json!("missing.bin"), "missing.bin");
    assert_refusal(|r| r["buffers"][0]["uri"] = json!("https://example.org/a.bin"), "not a local file");
    assert_refusal(|r| r["buffers"][0]["uri"] = json!("data:;base64,!"), "base64");
    // Scales of the drafts were logarithms: here the accessor of SCALE is that of the means, some
    // of them negative.
    assert_refusal(
        |r| {
            let attributes = r["meshes"][0]["primitives"][0]["attributes"].as_object_mut().unwrap();
            attributes["KHR_gaussian_splatting:SCALE"] = attributes["POSITION"].clone();
        },
        "a scale is negative",
    );
}

#[test]
fn gltf_reads_harmless_extensions() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.gltf");
    let s = splats(3, 1);
    gaussians::write(&path, &s, None).unwrap();
    let mut root: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    let names = [
        "KHR_gaussian_splatting",
        "KHR_mesh_quantization",
        "KHR_materials_unlit",
        "KHR_xmp_json_ld",
        "KHR_xmp",
    ];
    root["extensionsRequired"] = json!(names);
    root["extensionsUsed"] = json!(["KHR_materials_unlit", "EXT_unheard_of"]);
    let splatting = &mut root["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"];
    splatting["sortingMethod"] = json!("zDepth");
    splatting["weight"] = json!(3);
    let attributes = root["meshes"][0]["primitives"][0]["attributes"].as_object_mut().unwrap();
    attributes.insert("KHR_gaussian_splatting:SH_DEGREE_4_COEF_0".into(), json!(0));
    attributes.insert("KHR_gaussian_splatting:VELOCITY".into(), json!(0));
    std::fs::write(&path, root.to_string()).unwrap();
    let (back, _, notes) = gaussians::read_noted(&path).unwrap();
    assert_eq!(back.means, s.means);
    for words in ["EXT_unheard_of", "sortingMethod \"zDepth\"", "weight of KHR", "band 4", "VELOCITY"] {
        assert_eq!(notes.iter().filter(|n| n.contains(words)).count(), 1, "{words}: {notes:?}");
    }
    assert_eq!(notes.len(), 5, "{notes:?}");
}

/// Right, up and back in the file; right, down and forward in a scene.
#[test]
fn gltf_applies_all_parent_transforms() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("nodes.gltf");
    let s = Splats { means: vec![[1.0, -2.0, -3.0]], ..splats(1, 0) };
    gaussians::write(&path, &s, None).unwrap();
    let mut root: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    assert_eq!(root["accessors"][0]["min"], json!([1.0, 2.0, 3.0]));
    // (1, 2, 3) scaled is (2, 4, 6), half a turn about y makes it (−2, 4, −6), the node above (8,
    // 4, −6).
    root["nodes"] = json!([
        { "children": [1], "translation": [10, 0, 0] },
        { "mesh": 0, "rotation": [0, 1, 0, 0], "scale": [2, 2, 2] },
    ]);
    std::fs::write(&path, root.to_string()).unwrap();
    let back = gaussians::read(&path).unwrap().0;
    close(&back.means[0], &[8.0, -4.0, 6.0], 1e-5, "mean");
    close(&back.log_scales[0], &s.log_scales[0].map(|v| v + 2f32.ln()), 1e-5, "log scales");
}

/// As many nodes as are read, without scenes, so that every node without a parent is a root:
/// searching for each in all others took half a minute.
#[test]
fn gltf_reads_many_nodes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("many.gltf");
    gaussians::write(&path, &splats(3, 0), None).unwrap();
    let mut root: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    root.as_object_mut().unwrap().retain(|key, _| key != "scene" && key != "scenes");
    let nodes = root["nodes"].as_array_mut().unwrap();
    let first = nodes.len();
    nodes.extend((0..99_998).map(|_| json!({ "translation": [0, 0, 0] })));
    nodes.push(json!({ "children": [0, first, first + 1] }));
    std::fs::write(&path, root.to_string()).unwrap();
    let clock = std::time::Instant::now();
    assert_eq!(gaussians::read(&path).unwrap().0.len(), 3);
    let took = clock.elapsed();
    assert!(took < std::time::Duration::from_secs(5), "{took:?}");
    root["nodes"][first + 99_998]["children"] = json!([first + 99_999]);
    std::fs::write(&path, root.to_string()).unwrap();
    assert!(gaussians::read(&path).unwrap_err().to_string().contains("no node 100000"));
}

#[test]
fn gltf_refuses_truncated_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.glb");
    gaussians::write(&path, &splats(3, 0), None).unwrap();
    let whole = std::fs::read(&path).unwrap();
    for cut in 0..whole.len() {
        std::fs::write(&path, &whole[..cut]).unwrap();
        let e = gaussians::read(&path).err().unwrap_or_else(|| panic!("cut at {cut} is read"));
        assert_eq!((e.exit_code(), e.to_string().lines().count()), (2, 1), "cut at {cut}: {e}");
    }
}
