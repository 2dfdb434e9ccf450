//! The public files of the open pack at their real sizes: graphs with their interfaces, padded with
//! unused weights.
use super::models::siglip_graphs;
use super::server::{File, Server, plain};
use splatvk::fetch::{Client, Limits, fetch};
use splatvk::infer::Registry;
use splatvk::infer::catalogue::{CatalogueEntry, Source, catalogue};
use splatvk::infer::installed::{Task, inventory};
use splatvk::progress::Silent;
use splatvk_test_support::onnx::{FLOAT, INT64, Onnx};
use std::collections::HashMap;

/// About the bytes of SigLIP 2's text tower, which has no size in the catalogue.
const SIGLIP_TEXT: u64 = 1_129_000_000;

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

/// A file of external weights.
fn weights(bytes: u64) -> Vec<u8> {
    noise(bytes / 4).into_iter().flat_map(f32::to_le_bytes).collect()
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

fn sam_encoder(weights: u64) -> Onnx {
    let graph = Onnx::new().input("pixel_values", FLOAT, "1 3 1024 1024").external(
        "unused",
        &[weights / 4],
        "vision_encoder.onnx_data",
    );
    let levels = [
        ("image_embeddings.0", "1 1 4 4"),
        ("image_embeddings.1", "1 1 2 2"),
        ("image_embeddings.2", "1 1 1 1"),
    ];
    levels.into_iter().fold(graph, |graph, (name, shape)| saying(graph, &[(name, shape, 1.0)]))
}

fn sam_decoder(weights: u64) -> Onnx {
    let graph = Onnx::new()
        .input("input_points", FLOAT, "1 1 points 2")
        .input("input_labels", INT64, "1 1 points")
        .input("input_boxes", FLOAT, "1 boxes 4")
        .input("image_embeddings.0", FLOAT, "1 1 4 4")
        .input("image_embeddings.1", FLOAT, "1 1 2 2")
        .input("image_embeddings.2", FLOAT, "1 1 1 1")
        .external("unused", &[weights / 4], "prompt_encoder_mask_decoder.onnx_data");
    saying(graph, &[("pred_masks", "1 1 3 8 8", 1.0), ("iou_scores", "1 1 3", 0.9)])
}

/// Models of the pack that are not exported.
fn public() -> impl Iterator<Item = &'static CatalogueEntry> {
    catalogue().iter().filter(|k| k.packs.contains(&"open".into()) && !k.files.is_empty())
}

/// Response of the server for each file of the pack.
fn bodies() -> HashMap<String, Vec<u8>> {
    let mut all = HashMap::new();
    for entry in public() {
        let sizes: HashMap<&str, u64> =
            entry.files.iter().map(|s| (s.name.as_str(), s.bytes.unwrap_or(SIGLIP_TEXT))).collect();
        for source in &entry.files {
            let size = sizes[source.name.as_str()];
            let body = match (entry.task, source.name.as_str()) {
                (Task::Masks, "vision_encoder.onnx") => {
                    sam_encoder(sizes["vision_encoder.onnx_data"]).encode()
                }
                (Task::Masks, "prompt_encoder_mask_decoder.onnx") => {
                    sam_decoder(sizes["prompt_encoder_mask_decoder.onnx_data"]).encode()
                }
                (Task::Masks, _) => weights(size),
                (_, "image.onnx") => filled(siglip_graphs().0, size),
                (_, "text.onnx") => filled(siglip_graphs().1, size),
                _ => siglip_graphs().2.into_bytes(),
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
#[ignore = "1.7 GB; prints the figures of docs/use/models.md"]
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
    for entry in public() {
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
    for (task, name) in [(Task::Masks, "sam2_small"), (Task::Features, "siglip2_b16")] {
        assert_eq!(found.best(task).unwrap().name, name);
    }
    assert!(total > 1_600_000_000);
}
