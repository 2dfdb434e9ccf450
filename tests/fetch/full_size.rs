//! The open pack at its real sizes: graphs with the interfaces of the public files, padded with
//! unused weights.
use super::models::clip_graphs;
use super::server::{File, Server, plain};
use splatvk::fetch::{Client, Limits, fetch};
use splatvk::infer::Registry;
use splatvk::infer::catalogue::{CatalogueEntry, Source, catalogue};
use splatvk::infer::installed::{Task, inventory};
use splatvk::progress::Silent;
use splatvk_test_support::onnx::{Attribute, FLOAT, Onnx};
use std::collections::HashMap;

/// Bytes of the weights without a size in the catalogue: 393.0 MiB. The tokenizer of CLIP has none
/// either.
const DA3_WEIGHTS: u64 = 412_090_368;

/// Incompressible numbers, as in weights.
fn noise(count: u64) -> Vec<f32> {
    let mut state = 1u64;
    let mut next = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 40) as f32 / (1u64 << 24) as f32 - 0.5
    };
    (0..count).map(|_| next()).collect()
}

/// Pads a graph to about `bytes`.
fn filled(graph: Onnx, bytes: u64) -> Vec<u8> {
    let count = bytes / 4;
    graph.weight("unused", &[count], &noise(count)).encode()
}

/// A graph with constant outputs.
fn saying(mut graph: Onnx, outputs: &[(&str, &str, f32)]) -> Onnx {
    for (name, shape, value) in outputs {
        let dims: Vec<u64> = shape.split(' ').map(|d| d.parse().unwrap()).collect();
        let (kept, count) = (format!("the_{name}"), dims.iter().product::<u64>() as usize);
        graph = graph.output(name, shape).weight(&kept, &dims, &vec![*value; count]).node(
            "Identity",
            &kept,
            name,
            &[],
        );
    }
    graph
}

fn da3() -> Onnx {
    let graph = Onnx::new().input("pixel_values", FLOAT, "1 2 3 28 28").external(
        "unused",
        &[DA3_WEIGHTS / 4],
        "model.onnx_data",
    );
    let graph = saying(graph, &[("predicted_depth", "1 2 28 28", 2.0), ("confidence", "1 2 28 28", 5.0)]);
    let pose = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let graph = two_matrices("extrinsics", "1 2 3 4", &[1, 2, 3, 4], &pose, graph);
    let camera = [30.0, 0.0, 14.0, 0.0, 30.0, 14.0, 0.0, 0.0, 1.0];
    two_matrices("intrinsics", "1 2 3 3", &[1, 2, 3, 3], &camera, graph)
}

/// Adds an output with a matrix for each of two photos.
fn two_matrices(name: &str, shape: &str, dims: &[u64], one: &[f32], graph: Onnx) -> Onnx {
    let kept = format!("the_{name}");
    graph.output(name, shape).weight(&kept, dims, &one.repeat(2)).node("Identity", &kept, name, &[])
}

fn sam_encoder() -> Onnx {
    Onnx::new()
        .input("input_image", FLOAT, "height width 3")
        .output("image_embeddings", "1 1 1 1")
        .integers("shape", &[1, 1, 1, 1])
        .node("ReduceMax", "input_image", "brightest", &[("keepdims", Attribute::Int(1))])
        .node("Reshape", "brightest shape", "image_embeddings", &[])
}

fn sam_decoder() -> Onnx {
    let inputs = [
        ("image_embeddings", "1 1 1 1"),
        ("point_coords", "1 points 2"),
        ("point_labels", "1 points"),
        ("mask_input", "1 1 8 8"),
        ("has_mask_input", "1"),
        ("orig_im_size", "2"),
    ];
    let graph = inputs.into_iter().fold(Onnx::new(), |g, (name, shape)| g.input(name, FLOAT, shape));
    saying(graph, &[("low_res_masks", "1 4 8 8", 1.0), ("iou_predictions", "1 4", 0.9)])
}

/// Response of the server for each file of the pack.
fn bodies() -> HashMap<String, Vec<u8>> {
    let mut all = HashMap::new();
    for entry in catalogue().iter().filter(|k| k.packs.contains(&"open".into())) {
        for source in &entry.files {
            let size = source.bytes.unwrap_or(1_000_000);
            let body = match (entry.task, source.name.as_str()) {
                (Task::Geometry, "model.onnx") => da3().encode(),
                (Task::Geometry, _) => {
                    noise(DA3_WEIGHTS / 4).into_iter().flat_map(f32::to_le_bytes).collect()
                }
                (Task::Masks, "encoder.onnx") => filled(sam_encoder(), size),
                (Task::Masks, _) => filled(sam_decoder(), size),
                (_, "image.onnx") => filled(clip_graphs().0, size),
                (_, "text.onnx") => filled(clip_graphs().1, size),
                _ => clip_graphs().2.into_bytes(),
            };
            all.insert(source.from.clone(), body);
        }
    }
    all
}

/// The entry without checksums and sizes, as the server has other content.
fn as_served(entry: &CatalogueEntry) -> CatalogueEntry {
    let unpinned = |s: &Source| Source { bytes: None, sha256: None, ..s.clone() };
    CatalogueEntry { files: entry.files.iter().map(unpinned).collect(), ..entry.clone() }
}

#[test]
#[ignore = "1.1 GB; prints the figures of docs/use/models.md"]
fn open_pack_fetches_at_full_size() {
    let bodies: HashMap<String, File> =
        bodies().into_iter().map(|(from, body)| (from, File::new(&body))).collect();
    let server = Server::start(move |r, _, s| {
        let file = bodies.iter().find(|(from, _)| from.ends_with(&r.path));
        match file {
            Some((_, file)) => file.send(r, s),
            None => plain(s, "404 Not Found", &[]),
        }
    });
    let folder = tempfile::tempdir().unwrap();
    let registry = Registry::open(Some(folder.path())).unwrap();
    let client = Client::new(Some(&server.address), None, Limits::default()).unwrap();
    let began = std::time::Instant::now();
    let (mut total, mut checks) = (0, 0.0);
    for entry in catalogue().iter().filter(|k| k.packs.contains(&"open".into())) {
        let start = std::time::Instant::now();
        let report = fetch(&as_served(entry), &registry, folder.path(), &client, &Silent).unwrap();
        let bytes: u64 = report.files.iter().map(|f| f.downloaded).sum();
        let check: f64 = report.steps.iter().map(|s| s.seconds).sum();
        println!(
            "{}: {bytes} bytes in {:.1} s, of which check {check:.1} s",
            entry.id,
            start.elapsed().as_secs_f64()
        );
        (total, checks) = (total + bytes, checks + check);
    }
    println!(
        "open pack: {total} bytes in {:.1} s, of which checks {checks:.1} s",
        began.elapsed().as_secs_f64()
    );
    let found = inventory(&registry);
    for (task, name) in
        [(Task::Geometry, "da3"), (Task::Masks, "mobile_sam"), (Task::Features, "clip_vit_b32")]
    {
        assert_eq!(found.best(task).unwrap().name, name);
    }
    assert!(total > 1_000_000_000);
}
