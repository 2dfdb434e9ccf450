//! Writer.
use super::layout::{EXTENSION, attribute, turned};
use crate::format::gaussians::usable;
use crate::format::glb::{self, Numbers};
use crate::format::transform;
use crate::math::quaternion_norm;
use crate::math::sigmoid;
use crate::scene::{SH_C0, Splats, to_linear};
use crate::{Error, Result};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use std::path::Path;

/// Writes a binary file, in the order of the scene.
pub fn write_glb(path: &Path, splats: &Splats) -> Result<()> {
    usable::check_written(splats)?;
    let (root, data) = document(splats);
    glb::write(path, root, data)
}

/// Writes one text file with the buffer as a data URI, in the order of the scene.
pub fn write_gltf(path: &Path, splats: &Splats) -> Result<()> {
    usable::check_written(splats)?;
    let (mut root, data) = document(splats);
    let uri = format!("data:application/octet-stream;base64,{}", STANDARD.encode(&data));
    root["buffers"] = json!([{ "byteLength": data.len(), "uri": uri }]);
    std::fs::write(path, root.to_string()).map_err(Error::unwritable(path))
}

/// Splats with a name, as a node of a file.
pub struct Node<'a> {
    /// Name, as other programs list it.
    pub name: &'a str,
    /// The splats.
    pub splats: &'a Splats,
    /// Application data of the node, an object.
    pub extras: Value,
}

/// Writes a binary file with a node per entry below one node of the name `root`.
pub fn write_nodes(path: &Path, root: &str, nodes: &[Node]) -> Result<()> {
    nodes.iter().try_for_each(|node| usable::check_written(node.splats))?;
    let mut numbers = Numbers::default();
    let mesh =
        |node: &Node| json!({ "name": node.name, "primitives": [primitive(node.splats, &mut numbers)] });
    let meshes: Vec<Value> = nodes.iter().map(mesh).collect();
    let children: Vec<usize> = (1..=nodes.len()).collect();
    let mut list = vec![json!({ "name": root, "children": children })];
    let named = nodes.iter().enumerate();
    list.extend(named.map(|(k, node)| json!({ "name": node.name, "mesh": k, "extras": node.extras })));
    let (root, data) = with_nodes(&list, &meshes, numbers);
    glb::write(path, root, data)
}

/// Document of one node without its buffer, and the buffer.
fn document(splats: &Splats) -> (Value, Vec<u8>) {
    let mut numbers = Numbers::default();
    let mesh = json!({ "primitives": [primitive(splats, &mut numbers)] });
    with_nodes(&[json!({ "mesh": 0 })], &[mesh], numbers)
}

/// Document without its buffer, and the buffer. The first node is the root.
fn with_nodes(nodes: &[Value], meshes: &[Value], numbers: Numbers) -> (Value, Vec<u8>) {
    let root = json!({
        "asset": { "version": "2.0", "generator": concat!("splatvk ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": numbers.accessors,
        "bufferViews": numbers.views,
    });
    (root, numbers.data)
}

/// Appends the attributes of splats and returns their primitive.
fn primitive(splats: &Splats, numbers: &mut Numbers) -> Value {
    let mut s = splats.clone();
    transform::transform_splats(&mut s, &turned());
    let mut attributes = serde_json::Map::new();
    attributes.insert("POSITION".into(), json!(numbers.positions(&s.means)));
    let rotations: Vec<f32> = s
        .quats
        .iter()
        .flat_map(|q| {
            let norm = quaternion_norm(q);
            [1, 2, 3, 0].map(|k| q[k] / norm)
        })
        .collect();
    attributes.insert(attribute("ROTATION"), json!(numbers.floats("VEC4", 4, &rotations)));
    let scales: Vec<f32> = s.log_scales.as_flattened().iter().map(|v| v.exp()).collect();
    attributes.insert(attribute("SCALE"), json!(numbers.floats("VEC3", 3, &scales)));
    let opacities: Vec<f32> = s.opacity_logits.iter().map(|v| sigmoid(*v)).collect();
    attributes.insert(attribute("OPACITY"), json!(numbers.floats("SCALAR", 1, &opacities)));
    let width = 3 * s.sh_len();
    let coefficient = |k: usize| -> Vec<f32> {
        s.sh.chunks_exact(width).flat_map(|row| row[3 * k..3 * k + 3].iter().copied()).collect()
    };
    for degree in 0..=s.sh_degree as usize {
        for n in 0..=2 * degree {
            let name = attribute(&format!("SH_DEGREE_{degree}_COEF_{n}"));
            attributes.insert(name, json!(numbers.floats("VEC3", 3, &coefficient(degree * degree + n))));
        }
    }
    let fallback: Vec<f32> = coefficient(0)
        .chunks_exact(3)
        .zip(&opacities)
        .flat_map(|(dc, a)| [linear(dc[0]), linear(dc[1]), linear(dc[2]), *a])
        .collect();
    attributes.insert("COLOR_0".into(), json!(numbers.shares("VEC4", 4, &fallback)));
    json!({
        "mode": 0,
        "attributes": attributes,
        "extensions": { EXTENSION: {
            "kernel": "ellipse",
            "colorSpace": "srgb_rec709_display",
            "projection": "perspective",
            "sortingMethod": "cameraDistance"
        } }
    })
}

/// Base colour of a splat in linear light, as glTF's vertex colours are.
fn linear(dc: f32) -> f32 {
    let v = (0.5 + SH_C0 * dc).clamp(0.0, 1.0);
    to_linear(v)
}
