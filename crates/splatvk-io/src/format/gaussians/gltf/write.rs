//! Writer.
use super::layout::{BIN_CHUNK, EXTENSION, FLOAT, JSON_CHUNK, MAGIC, attribute, turned};
use crate::format::gaussians::usable;
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
    let (mut root, data) = document(splats);
    root["buffers"] = json!([{ "byteLength": data.len() }]);
    let mut text = root.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + text.len() + 8 + data.len();
    let mut out = Vec::with_capacity(total);
    for bytes in [MAGIC.to_le_bytes(), 2u32.to_le_bytes(), size_bytes(total, path)?] {
        out.extend(bytes);
    }
    for (chunk, kind) in [(text, JSON_CHUNK), (data, BIN_CHUNK)] {
        out.extend(size_bytes(chunk.len(), path)?);
        out.extend(kind.to_le_bytes());
        out.extend(chunk);
    }
    std::fs::write(path, out).map_err(Error::unwritable(path))
}

/// Bytes of a size in a `.glb`.
fn size_bytes(n: usize, path: &Path) -> Result<[u8; 4]> {
    u32::try_from(n).map(u32::to_le_bytes).map_err(|_| {
        let path = path.display();
        Error::work(format!("{path}: more than the 4 GiB of a .glb file; write a .ply instead"))
    })
}

/// Writes one text file with the buffer as a data URI, in the order of the scene.
pub fn write_gltf(path: &Path, splats: &Splats) -> Result<()> {
    usable::check_written(splats)?;
    let (mut root, data) = document(splats);
    let uri = format!("data:application/octet-stream;base64,{}", STANDARD.encode(&data));
    root["buffers"] = json!([{ "byteLength": data.len(), "uri": uri }]);
    std::fs::write(path, root.to_string()).map_err(Error::unwritable(path))
}

/// Document without its buffer, and the buffer.
fn document(splats: &Splats) -> (Value, Vec<u8>) {
    let mut s = splats.clone();
    transform::transform_splats(&mut s, &turned());
    let mut parts = Parts { count: s.len(), ..Parts::default() };
    parts.floats("POSITION".into(), "VEC3", s.means.as_flattened());
    if let Some(position) = parts.accessors.last_mut() {
        let bound = |pick: fn(f32, f32) -> f32, from: f32| {
            s.means.iter().fold([from; 3], |b, m| [0, 1, 2].map(|k| pick(b[k], m[k])))
        };
        // glTF requires the extent of positions.
        position["min"] = json!(bound(f32::min, f32::INFINITY));
        position["max"] = json!(bound(f32::max, f32::NEG_INFINITY));
    }
    let rotations: Vec<f32> = s
        .quats
        .iter()
        .flat_map(|q| {
            let norm = quaternion_norm(q);
            [1, 2, 3, 0].map(|k| q[k] / norm)
        })
        .collect();
    parts.floats(attribute("ROTATION"), "VEC4", &rotations);
    let scales: Vec<f32> = s.log_scales.as_flattened().iter().map(|v| v.exp()).collect();
    parts.floats(attribute("SCALE"), "VEC3", &scales);
    let opacities: Vec<f32> = s.opacity_logits.iter().map(|v| sigmoid(*v)).collect();
    parts.floats(attribute("OPACITY"), "SCALAR", &opacities);
    let width = 3 * s.sh_len();
    let coefficient = |k: usize| -> Vec<f32> {
        s.sh.chunks_exact(width).flat_map(|row| row[3 * k..3 * k + 3].iter().copied()).collect()
    };
    for degree in 0..=s.sh_degree as usize {
        for n in 0..=2 * degree {
            let name = attribute(&format!("SH_DEGREE_{degree}_COEF_{n}"));
            parts.floats(name, "VEC3", &coefficient(degree * degree + n));
        }
    }
    let fallback: Vec<u8> = coefficient(0)
        .chunks_exact(3)
        .zip(&opacities)
        .flat_map(|(dc, a)| [linear(dc[0]), linear(dc[1]), linear(dc[2]), *a])
        .flat_map(|v| ((v * 65535.0).round() as u16).to_le_bytes())
        .collect();
    const UNSIGNED_SHORT: u32 = 5123;
    parts.add("COLOR_0".into(), "VEC4", UNSIGNED_SHORT, &fallback);
    let root = json!({
        "asset": { "version": "2.0", "generator": concat!("splatvk ", env!("CARGO_PKG_VERSION")) },
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{ "nodes": [0] }],
        "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{
            "mode": 0,
            "attributes": parts.attributes,
            "extensions": { EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": "srgb_rec709_display",
                "projection": "perspective",
                "sortingMethod": "cameraDistance"
            } }
        }] }],
        "accessors": parts.accessors,
        "bufferViews": parts.views,
    });
    (root, parts.data)
}

/// Base colour of a splat in linear light, as glTF's vertex colours are.
fn linear(dc: f32) -> f32 {
    let v = (0.5 + SH_C0 * dc).clamp(0.0, 1.0);
    to_linear(v)
}

/// Attributes, one after the other in one buffer.
#[derive(Default)]
struct Parts {
    count: usize,
    data: Vec<u8>,
    attributes: serde_json::Map<String, Value>,
    accessors: Vec<Value>,
    views: Vec<Value>,
}

impl Parts {
    fn floats(&mut self, name: String, kind: &str, values: &[f32]) {
        self.add(name, kind, FLOAT, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>());
    }

    fn add(&mut self, name: String, kind: &str, component: u32, bytes: &[u8]) {
        const ARRAY_BUFFER: u32 = 34962;
        let view = json!({
            "buffer": 0, "byteOffset": self.data.len(), "byteLength": bytes.len(), "target": ARRAY_BUFFER
        });
        let mut accessor = json!({
            "bufferView": self.views.len(), "componentType": component, "count": self.count, "type": kind
        });
        if component != FLOAT {
            accessor["normalized"] = json!(true);
        }
        self.attributes.insert(name, json!(self.accessors.len()));
        self.accessors.push(accessor);
        self.views.push(view);
        self.data.extend_from_slice(bytes);
    }
}
