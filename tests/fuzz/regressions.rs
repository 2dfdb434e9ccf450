//! Earlier findings that are small enough to generate: each stays within the limits of its reader.
use super::readers::{Limits, within};
use super::{ONE, seeds};
use splatlab::protocol::{self, ProtocolKind};
use splatvk::format::{cameras, colmap, gaussians, npy};
use splatvk::infer::adapter::Adapter;
use splatvk::infer::onnx;
use splatvk::{Error, Result};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::PoisonError;

/// Expects that `bytes` as a file called `name` are refused within the limits, with `words` in the
/// error.
fn assert_refused<T>(name: &str, bytes: &[u8], words: &str, read: impl Fn(&Path) -> Result<T>) {
    let _alone = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    let verdict = within(bytes.len(), (Limits::ROOM, Limits::TIME), || match read(&path) {
        Ok(_) => panic!("{name} is read"),
        Err(e) => {
            assert!(e.to_string().contains(words) && e.to_string().contains(name), "{e}");
            Err::<(), Error>(e)
        }
    });
    assert!(verdict.fault.is_none(), "{name}: {:?}", verdict.fault);
}

fn splats(path: &Path) -> Result<()> {
    gaussians::read(path).map(drop)
}

/// A `.gltf` with its buffer in `uri` and `nodes` nodes with one mesh of `count` Gaussians.
fn gltf(uri: &str, count: usize, nodes: usize) -> Vec<u8> {
    let parts = [("POSITION", 3), ("ROTATION", 4), ("SCALE", 3), ("OPACITY", 1), ("SH_DEGREE_0_COEF_0", 3)];
    let (mut attributes, mut accessors, mut views, mut at) = (serde_json::Map::new(), vec![], vec![], 0);
    for (k, (name, width)) in parts.iter().enumerate() {
        let name = if k == 0 { name.to_string() } else { format!("KHR_gaussian_splatting:{name}") };
        attributes.insert(name, k.into());
        let kind = if *width == 1 { "SCALAR".to_owned() } else { format!("VEC{width}") };
        accessors.push(
            serde_json::json!({ "bufferView": k, "componentType": 5126, "count": count, "type": kind }),
        );
        views.push(serde_json::json!({ "buffer": 0, "byteOffset": at, "byteLength": 4 * width * count }));
        at += 4 * width * count;
    }
    let mesh = serde_json::json!({ "primitives": [{
        "mode": 0, "attributes": attributes, "extensions": { "KHR_gaussian_splatting": {} }
    }] });
    let nodes = vec![serde_json::json!({ "mesh": 0 }); nodes];
    serde_json::json!({
        "asset": { "version": "2.0" }, "nodes": nodes, "meshes": [mesh], "accessors": accessors,
        "bufferViews": views, "buffers": [{ "byteLength": at, "uri": uri }],
    })
    .to_string()
    .into_bytes()
}

fn data_uri(bytes: usize) -> String {
    format!("data:application/octet-stream;base64,{}", "AAAA".repeat(bytes.div_ceil(3)))
}

#[test]
fn gltf_counts_mesh_instances_first() {
    let bytes = gltf(&data_uri(56_000), 1000, 90_000);
    assert_refused("a.gltf", &bytes, "show 90000000 Gaussians", splats);
    assert_refused("a.gltf", &gltf(&data_uri(56), 1, 200_000), "more than the 100000 that are read", splats);
    // Without scenes, finding the roots once took a search in all other nodes.
    let nodes: Vec<_> = (0..60_000).map(|k| serde_json::json!({ "children": [k + 1] })).collect();
    let chain = serde_json::json!({ "nodes": nodes }).to_string();
    assert_refused("a.gltf", chain.as_bytes(), "there is no node 60000", splats);
}

#[test]
fn gltf_buffers_stay_in_folder() {
    for uri in ["/dev/zero", "../a.bin", "b/../../a.bin", "/etc/hostname", "..\\a.bin"] {
        assert_refused("a.gltf", &gltf(uri, 1, 1), "outside of the file's folder", splats);
    }
    assert_refused("a.gltf", &gltf("none.bin", 1, 1), "none.bin", splats);
    #[cfg(unix)]
    {
        let outside = tempfile::NamedTempFile::new().unwrap();
        for (target, words) in
            [(PathBuf::from("/dev/zero"), "outside of"), (outside.path().to_path_buf(), "outside of")]
        {
            assert_refused("a.gltf", &gltf("link.bin", 1, 1), words, |path| {
                let link = path.with_file_name("link.bin");
                std::os::unix::fs::symlink(&target, &link).unwrap();
                splats(path)
            });
        }
    }
}

#[test]
fn npz_refuses_decompression_bomb() {
    let array = npy::encode(&npy::NpyArray::u8(&[100], vec![7; 100])).unwrap();
    assert_refused("a.npz", &zip_with_zeros(&array), "more follow", |p| npy::read_npz(p));
    let stated = std::str::from_utf8(&array[10..128]).unwrap().replace("(100,)", "(209715200,)");
    let header = [&array[..10], &stated.as_bytes()[..118]].concat();
    assert_refused("a.npz", &zip_with_zeros(&header), "far more than the file can hold", |p| {
        npy::read_npz(p)
    });
}

/// Archive of one array: `header`, then 200 MiB of zeros.
fn zip_with_zeros(header: &[u8]) -> Vec<u8> {
    let method = zip::CompressionMethod::Deflated;
    let options = zip::write::SimpleFileOptions::default().compression_method(method);
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    zip.start_file("a.npy", options).unwrap();
    zip.write_all(header).unwrap();
    (0..200).for_each(|_| zip.write_all(&[0; 1 << 20]).unwrap());
    zip.finish().unwrap().into_inner()
}

#[test]
fn compressed_count_is_checked_against_size() {
    let mut head = [0x5053_474eu32, 3, 50_000_000, 0].map(u32::to_le_bytes).concat();
    (head[12], head[13]) = (3, 12);
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gzip.write_all(&head).unwrap();
    gzip.write_all(&vec![0; 4 << 20]).unwrap();
    assert_refused("a.spz", &gzip.finish().unwrap(), "50000000 Gaussians are far more", splats);
}

#[test]
fn excessive_values_are_refused_early() {
    let columns: String = (0..60_000).map(|k| format!("property float f_rest_{k}\n")).collect();
    let ply = format!("ply\nformat binary_little_endian 1.0\nelement vertex 0\n{columns}end_header\n");
    assert_refused("a.ply", ply.as_bytes(), "", splats);
    let most = "element vertex 18446744073709551615\nproperty float x\nelement b 18446744073709551615\n";
    let ply = format!("ply\nformat ascii 1.0\n{most}end_header\n0\n");
    assert_refused("a.ply", ply.as_bytes(), "", splats);
    let numbers = "[0,0,0,0,0,0,0,0],".repeat(400_000);
    let json = format!("{{\"other\":[{numbers}0],\"frames\":[]}}");
    assert_refused("a.json", json.as_bytes(), "values, more than the", cameras::read);
    let frames = "{\"transform_matrix\":[]},".repeat(100_000);
    assert_refused("a.json", format!("{{\"frames\":[{frames}{{}}]}}").as_bytes(), "4 × 4", cameras::read);
}

#[test]
fn colmap_text_without_points_keeps_cameras() {
    let folder = tempfile::tempdir().unwrap();
    let image = |k: usize| format!("{k} 1 0 0 0 0 0 {k} 1 photo {k}.jpg\n");
    let read = |images: String| {
        std::fs::write(folder.path().join("cameras.txt"), "1 PINHOLE 64 48 70 70 32 24\n").unwrap();
        std::fs::write(folder.path().join("images.txt"), images).unwrap();
        colmap::read(folder.path()).map(|c| c.iter().map(|c| c.camera.name.clone()).collect::<Vec<_>>())
    };
    let wanted: Vec<String> = (1..=5).map(|k| format!("photo {k}.jpg")).collect();
    for between in ["", "\n", "1.5 2.5 -1 3 4 17\n", "# remark\n\n"] {
        assert_eq!(read((1..=5).map(|k| image(k) + between).collect()).unwrap(), wanted, "{between:?}");
    }
    // Some images have points, some lack even the line.
    let mixed = [image(1), image(2), "1 2 3\n".into(), image(3), "\n".into(), image(4), image(5)].concat();
    assert_eq!(read(mixed).unwrap(), wanted);
    let e = read(image(1) + "1.5 2.5\n" + &image(2)).unwrap_err().to_string();
    assert!(e.contains("images.txt: line 2"), "{e}");
}

#[test]
fn oversized_labels_are_refused() {
    // A line of that many pixels took 20 s, one of 1e19 never ended.
    assert_refused(
        "a.json",
        lerf_labels(16, 1e9, 1).as_bytes(),
        "a corner is beyond 1000000 pixels",
        read_lerf,
    );
    assert_refused("a.json", lerf_labels(14_000, 9.0, 2).as_bytes(), "2 objects of 14000", read_lerf);
}

fn read_lerf(p: &Path) -> splatvk::Result<()> {
    protocol::labels(ProtocolKind::Lerf, p.parent().unwrap()).map(drop)
}

fn lerf_labels(size: usize, corner: f64, objects: usize) -> String {
    let object = |k: usize| serde_json::json!({ "category": k.to_string(), "segmentation": [[0, 0], [corner, 1], [2, corner]] });
    let objects: Vec<_> = (0..objects).map(object).collect();
    serde_json::json!({ "info": { "width": size, "height": size }, "objects": objects }).to_string()
}

#[test]
fn adapter_checks_image_preparation() {
    let read = |p: &Path| Adapter::of_file(&p.with_file_name("m.onnx"));
    for (field, words) in [
        ("size = 518, multiple = 0", "between 1 and 16384"),
        ("size = 1000000000000", "between 1 and 16384"),
        ("size = 0", "between 1 and 16384"),
    ] {
        let image = format!("{{ mean = [0.5, 0.5, 0.5], std = [0.5, 0.5, 0.5], {field} }}");
        let text = format!("[[graph]]\npart = \"depth\"\nimage = {image}\n");
        assert_refused("adapter.toml", text.as_bytes(), words, read);
        let flat = text.replace("std = [0.5", "std = [0.0").replace(field, "size = 518");
        assert_refused("adapter.toml", flat.as_bytes(), "std positive", read);
    }
}

#[test]
fn oversized_colmap_sides_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for seed in seeds::colmap(true) {
        let mut bytes = seed.bytes;
        if seed.name == "cameras.bin" {
            // After the count, the id and the model: 64 + 2^32.
            bytes[8 + 8 + 4] = 1;
        }
        std::fs::write(folder.path().join(&seed.name), bytes).unwrap();
    }
    let e = colmap::read(folder.path()).unwrap_err().to_string();
    assert!(e.contains("cameras.bin: camera 1 has a side of 4294967360 pixels"), "{e}");
}

#[test]
fn graph_weights_stay_in_folder() {
    for place in ["../ab", "/ab.b"] {
        let whole = seeds::onnx();
        let at = whole.windows(5).position(|w| w == b"w.bin").unwrap();
        let bytes = [&whole[..at], place.as_bytes(), &whole[at + 5..]].concat();
        assert_refused("m.onnx", &bytes, "outside of its folder", onnx::read);
    }
}

#[test]
fn seed_containers_round_trip() {
    // The harness relies on this: containers restore their content.
    for seed in [seeds::npz("a"), seeds::checkpoint("a"), seeds::gzip("a"), seeds::picture("a.png")] {
        let container = seed.container.unwrap();
        let same = container(&seed.bytes, &mut |inside| inside.to_vec());
        let again = container(&same, &mut |inside| inside.to_vec());
        assert!(same == again && !same.is_empty());
    }
}
